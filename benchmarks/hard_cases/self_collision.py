"""Bodies that touch themselves: a twisted mat, a closing clamp, two fast sheets, a squeezed jack."""

import numpy as np

import taisoft as ts
from taisoft.fem.reference import gravity_mass, lumped_mass
from taisoft.scene.key_frames import KeyFrames

from ..reference_cases.record import face
from .case import ANALYTIC, DEEPEST, OK, OLD_NORMALS, PROPOSED, Case, Must, Session, firm, implicit
from .shapes import COR, SNH, WEIGHTLESS, box, not_finite, one_body, rest_at_last, voxels

GAINED = "what steps after the release add to the momentum, over the impulses of contacts"
LAWS = (COR, SNH)
FLOOR = 0.05  # volume floor of the material in variants that are not the catalogue's, whose materials have none


def mat_twist(session: Session, seed: int, seconds: float, volume_floor: float) -> dict[str, float]:
    """S1: a mat's ends turn against each other; nodes start up to 0.1 mm aside, along its normal.

    volume_floor: of its material, 0 in the catalogue; so in S4.
    """
    mesh = box((20, 20, 1), (1.0, 1.0, 0.02))
    scene, body = one_body("mat", mesh, law=SNH, young=2e4, poisson=0.4, volume_floor=volume_floor)
    turn = np.array([np.radians(72.0) * 5.0, 0.0, 0.0])
    for side in (-0.5, 0.5):
        body.move(face(0, side), KeyFrames([0.0, 5.0], rotations=[WEIGHTLESS, np.sign(side) * turn]))
    free = np.abs(mesh.vertices[:, 0]) < 0.499
    offset = np.random.default_rng(seed).uniform(-1e-4, 1e-4, mesh.n_verts) * free
    with session.simulator(scene) as sim:
        x = mesh.vertices.copy()
        x[:, 2] += offset
        sim.set_state(x)
        (cut,) = session.watch(sim, round(seconds / 0.04), lambda: len(sim.intersecting_triangles()))
    return {
        "pairs of triangles that cut each other, most": max(cut),
        "pairs of triangles that cut each other, over triangles": max(cut) / len(mesh.surface),
        DEEPEST: session.largest("max_penetration"),
        "inverted tets, most": session.largest("n_inverted"),
        "steps that did not converge": session.unconverged,
        "contacts, most": session.largest("n_contacts"),
    }


def clamp(session: Session, law: str) -> dict[str, float]:
    """S2: the arms of a C are pressed together, held and released; without gravity."""
    filled = np.ones((8, 7, 2), dtype=bool)
    filled[2:, 2:5] = False
    mesh = voxels(filled, 0.02, (0.08, 0.07, 0.02))
    scene, body = one_body("clamp", mesh, law=law, young=5e4, poisson=0.4, friction=0.3, mass_damping=2.0)
    for y, travel in ((0.14, -0.04), (0.0, 0.04)):
        moved = KeyFrames([0.0, 1.0, 1.5], [WEIGHTLESS, (0.0, travel, 0.0), (0.0, travel, 0.0)], release=True)
        body.move(lambda X, y=y: (np.abs(X[:, 0] - 0.16) < 1e-9) & (np.abs(X[:, 1] - y) < 1e-9), moved)
    mass = gravity_mass(body)
    with session.simulator(scene) as sim:
        read = (lambda: mass @ sim.velocities()), (lambda: np.abs(sim.contacts().impulse).sum())
        momenta, impulses = session.watch(sim, 450, *read)
        found = rest_at_last(sim, 0.16)
        decay = 1.0 + body.material.mass_damping * sim.dt  # of an implicit Euler step without forces
    free = np.array(momenta[151:])  # the step that ends at 1.5 s is prescribed
    gained = np.linalg.norm(decay * free[1:] - free[:-1], axis=1).max() if len(free) > 1 else np.nan
    return found | {
        "contacts, most": session.largest("n_contacts"),
        DEEPEST: session.largest("max_penetration"),
        GAINED: gained / max(impulses),
    }


def sheets(session: Session, parts: str) -> dict[str, float]:
    """S3: two sheets fly at each other, each at 15 m/s, as two bodies or as two parts of one."""
    sheet = box((8, 1, 8), (0.2, 0.005, 0.2))
    rubber = ts.Material(law=SNH, young=1e6, poisson=0.3, density=1000.0)
    scene, apart = ts.Scene(gravity=WEIGHTLESS), np.array([0.0, 0.0125, 0.0])
    n = sheet.n_verts
    toward = np.array([0.0, 15.0, 0.0])
    if parts == "two bodies":
        scene.add_body(sheet, rubber, name="lower", position=-apart, velocity=toward)
        scene.add_body(sheet, rubber, name="upper", position=apart, velocity=-toward)
    else:
        both = ts.TetMesh(
            np.concatenate([sheet.vertices - apart, sheet.vertices + apart]), np.concatenate([sheet.tets, sheet.tets + n])
        )
        scene.add_body(both, rubber, name="both", velocity=np.repeat([toward, -toward], n, axis=0))
    mass = np.concatenate([lumped_mass(body) for body in scene.bodies])

    def gap() -> float:
        y = sim.positions()[:, 1]
        return y[n:].mean() - y[:n].mean()

    with session.simulator(scene) as sim:
        gaps, momenta = session.watch(sim, 30, gap, lambda: np.linalg.norm(mass @ sim.velocities()))
        sentences = " ".join(session.problems)
    return {
        "least distance between the sheets' middles [m]": min(gaps),
        "momentum over that of one sheet, most": max(momenta) / (15.0 * mass[:n].sum()),
        "sentences that name speed, thickness and a safe dt": all(word in sentences for word in ("thick", "dt", "m/s")),
        "sentences or order kept": min(gaps) > 0.0,
        DEEPEST: session.largest("max_penetration"),
    }


def jack(session: Session, law: str, volume_floor: float) -> dict[str, float]:
    """S4: three crossed bars between six planes that close to less than half and open again."""
    filled = np.zeros((5, 5, 5), dtype=bool)
    filled[:, 2, 2] = filled[2, :, 2] = filled[2, 2, :] = True
    mesh = voxels(filled.repeat(2, 0).repeat(2, 1).repeat(2, 2), 0.02)
    scene, _ = one_body("jack", mesh, law=law, young=1e4, poisson=0.4, mass_damping=2.0, volume_floor=volume_floor)
    depths, planes = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = -side * np.eye(3)[axis]
            inward = 0.06 * normal
            path = KeyFrames([0.0, 1.0, 1.5, 2.5], [WEIGHTLESS, inward, inward, WEIGHTLESS])
            scene.add_obstacle(ts.HalfSpace(-0.11 * normal, normal), name=f"plane {'xyz'[axis]}{side:+g}", path=path)
            planes.append((-0.11 * normal, normal, path))

    def look(sim, k, report):
        if report is None or report.converged:
            x = sim.positions()
            depths.append(max(((point + path(sim.time)[0] - x) @ normal).max() for point, normal, path in planes))

    with session.simulator(scene) as sim:
        session.run_steps(sim, 650, look)
        found = rest_at_last(sim, 0.2)
        lost = not_finite(sim.positions())
    return found | {
        "numbers that are not finite in the last state": lost,
        "deepest in a plane after steps that count as converged [m]": max(depths),
        "deepest in a plane or in itself after any step [m]": session.largest("max_penetration"),
        "pairs of triangles that cross, most": session.largest("crossings"),
        "steps that did not converge": session.unconverged,
        "inverted tets, most": session.largest("n_inverted"),
    }


ROLLS = Must(OK, "a mat can be rolled up without crossing itself: incremental potential contact does so on finer meshes of it")
ROLLS_FIRM = Must(OK, f"{firm(FLOOR)}, the roll cannot squeeze a tet flat")
S1 = Case("S1", "twisted mat", mat_twist)
TWISTS = (("A", 2.5, 10, 0.0), ("B", 5.0, 1, 0.0), (f"B, volume floor {FLOOR:g}", 5.0, 1, FLOOR))
for level, seconds, seeds, floor in TWISTS:
    for seed in range(seeds):
        settings = implicit(0.04, self_collision=True)
        parameters = {"seed": seed, "seconds": seconds, "volume_floor": floor}
        S1.add_variant(f"{level}, start {seed}", settings, ROLLS_FIRM if floor else ROLLS, reference=False, **parameters)
S1.add_limit("pairs of triangles that cut each other, most", 0.0, PROPOSED, seconds=2.5)
S1.add_limit("pairs of triangles that cut each other, over triangles", 1e-3, PROPOSED, seconds=5.0)
S1.add_limit(DEEPEST, 5e-3, PROPOSED, seconds=5.0)
S1.add_shortfall(*OLD_NORMALS)

CLOSES = Must(OK, "the arms touch, give way and spring back: nothing keeps them from their rest shape")
S2 = Case("S2", "closing clamp", clamp, size=0.16)
for law in LAWS:
    for precision in ("f32", "f64"):
        settings = implicit(0.01, self_collision=True, precision=precision)
        S2.add_variant(f"{law}, {precision}", settings, CLOSES, law=law)
S2.add_limit("contacts, most", 1.0, ANALYTIC, at_least=True)
S2.add_limit(DEEPEST, 1e-3, PROPOSED)
S2.add_limit("shape error at the end, over L", 5e-3, PROPOSED)
S2.add_limit(GAINED, 1e-6, ANALYTIC, precision="f64")

MEET = Must(
    OK,
    "two sheets meet and part again, which shorter parts of the step can follow; the catalogue lets the step be refused, but "
    "there is an answer",
)
S3 = Case("S3", "two sheets meet at 30 m/s", sheets, size=0.2, quick=("two bodies",))
for parts in ("two bodies", "two parts of one"):
    # momentum is kept as well as Newton's method balances forces
    settings = implicit(1 / 120, self_collision=parts != "two bodies", newton_tolerance=1e-6)
    S3.add_variant(parts, settings, MEET, parts=parts)
S3.add_limit("least distance between the sheets' middles [m]", 0.0, ANALYTIC, at_least=True)
S3.add_limit("momentum over that of one sheet, most", 1e-6, ANALYTIC)

FITS = Must(OK, "the jack fills 83 % of the room that the planes leave it, so that it fits without crossing itself")
FITS_FIRM = Must(OK, f"{firm(FLOOR)}, the planes cannot squeeze a tet flat")
S4 = Case("S4", "trash compactor", jack, size=0.2)
for floor in (0.0, FLOOR):
    for law in LAWS:
        name, settings = law + (f", volume floor {floor:g}" if floor else ""), implicit(0.01, self_collision=True)
        S4.add_variant(name, settings, FITS_FIRM if floor else FITS, reference=False, law=law, volume_floor=floor)
S4.add_limit("numbers that are not finite in the last state", 0.0, PROPOSED)
S4.add_limit(
    "deepest in a plane after steps that count as converged [m]",
    1e-3,
    PROPOSED,
    note="how deep the jack is in itself, which no limit is asked of, is told beside it",
)
S4.add_limit("shape error at the end, over L", 1e-2, PROPOSED)
S4.add_limit("inverted tets at the end", 0.0, PROPOSED)
S4.add_shortfall(*OLD_NORMALS)
S4.add_shortfall(
    "the arms, squeezed to half their room, turn two or three tets inside out, which recover when the planes open, as the laws "
    "allow: shorter steps arrive at the same snap, and a bound that keeps volumes positive could only hold the jack back",
    "a material that stiffens where a tet is squeezed to a twentieth of its volume, as in the variants with a volume floor",
    volume_floor=0.0,
)

CASES = (S1, S2, S3, S4)
