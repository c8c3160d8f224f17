"""Extremes of scale.

R: bodies that differ a thousandfold and more in mass or stiffness. X: sizes from 1 um to 1 km, a body that flies away, more
contacts than there is room for.
"""

import warnings

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError

from ..reference_cases.record import face
from .case import ANALYTIC, DEEPEST, INVERTED, OK, PROPOSED, REFUSED, STOPPED, Case, Must, Session, explicit, implicit
from .shapes import COR, DOWN, SNH, G, box, cube, not_finite, one_body, turned

SCALES = (1e-6, 1e-3, 1e3)
FORCE = "force on the plane over the weight, less 1, most of the last 0.5 s"
BETWEEN = "force between the slabs over the upper one's weight, less 1, most of the last 0.5 s"
THICKNESS = "thickness of the soft slab over that by statics, less 1"
SLOWEST = "longest step over the median"
OFF = "tip off that at 1 m, over L"


def masses(session: Session, level: str) -> dict[str, float]:
    """R1: a heavy cube on a light one, of the same size (A), or of ten times its size (B)."""
    scene = ts.Scene(gravity=DOWN)
    upper, height, soft, stiff, density = {"A": (cube(3, 0.1), 0.17, 1e7, 1e7, 1e5), "B": (cube(4, 1.0), 0.62, 1e6, 1e8, 1e4)}[
        level
    ]
    rubber = ts.Material(law=SNH, young=soft, poisson=0.4, density=1e3, friction=0.5)
    scene.add_body(cube(3, 0.1), rubber, name="lower", position=(0, 0.06, 0))
    heavy = ts.Material(law=SNH, young=stiff, poisson=0.4, density=density, friction=0.5)
    scene.add_body(upper, heavy, name="upper", position=(0, height, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane", friction=0.5)
    weight = G * sum(body.material.density * body.mesh.volumes.sum() for body in scene.bodies)
    with session.simulator(scene) as sim:
        (forces,) = session.watch(sim, 120, lambda: -sim.contact_force("plane")[1])
        lost = not_finite(sim.positions())
    seconds = np.array(session.step_seconds)
    return {
        FORCE: np.abs(np.array(forces[-20:]) / weight - 1.0).max(),
        DEEPEST: session.largest("max_penetration"),
        SLOWEST: seconds.max() / np.median(seconds),
        "numbers that are not finite in the last state": lost,
        "inverted tets, most": session.largest("n_inverted"),
        "steps that did not converge": session.unconverged,
    }


def stiffnesses(session: Session) -> dict[str, float]:
    """R2: a soft slab on one ten thousand times as stiff. The plane bears 1.7 % of it: its corners hang down."""
    scene, mesh = ts.Scene(gravity=DOWN), box((12, 1, 12), (1.0, 0.05, 1.0))
    stiff = ts.Material(law=SNH, young=1e8, poisson=0.4, density=2000.0, friction=0.1)
    soft = ts.Material(law=SNH, young=1e4, poisson=0.4, density=1000.0, friction=0.1)
    upper = turned(mesh, np.pi / 4, 1)
    scene.add_body(mesh, stiff, name="lower", position=(0, 0.025, 0))
    scene.add_body(upper, soft, name="upper", position=(0, 0.085, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane", friction=0.1)
    inside = (np.abs(upper.vertices.reshape(13, 2, 13, 3)[:, 0, :, [0, 2]]) < 0.35).all(axis=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*its own weight strains it")
        made = session.simulator(scene)

    def force() -> float:
        c = sim.contacts()
        between = (c.body_a == "lower") & (c.body_b == "upper")
        return -c.impulse[between].sum(axis=0)[1] / sim.dt

    with made as sim:
        (forces,) = session.watch(sim, 120, force)
        y = sim.positions("upper")[:, 1].reshape(13, 2, 13)
    thickness, reference = (y[:, 1] - y[:, 0])[inside].mean(), static_thickness(upper, soft, inside)
    return {
        DEEPEST: session.largest("max_penetration"),
        BETWEEN: np.abs(np.array(forces[-20:]) / (50.0 * G) - 1.0).max(),
        THICKNESS: abs(thickness / reference - 1.0),
    }


def static_thickness(mesh: ts.TetMesh, soft: ts.Material, inside: np.ndarray) -> float:
    """Mean thickness there [m] of the soft slab by statics, its whole lower side held. What differs, friction of 0.1 and the
    corners that hang down, is far from where it is measured, or moves it by less than the 2 % that are asked."""
    scene = ts.Scene(gravity=DOWN)
    scene.add_body(mesh, soft, name="slab").fix(lambda X: X[:, 1] < -0.024)
    x = ts.solve_static(scene).positions("slab")[:, 1].reshape(13, 2, 13)
    return float((x[:, 1] - x[:, 0])[inside].mean())


def scaled_bar(session: Session, law: str, scale: float, steps: int) -> tuple[np.ndarray, int]:
    """Path of the tip (k,3) over the scale [m], and the iterations, of a clamped bar of 0.5 m times the scale."""
    mesh = box((10, 2, 2), scale * np.array([0.5, 0.1, 0.1]), (0.25 * scale, 0.0, 0.0))
    speed = np.zeros((mesh.n_verts, 3))
    speed[:, 1] = (mesh.vertices[:, 0] / (0.5 * scale)) ** 2
    scene, body = one_body("bar", mesh, velocity=speed, law=law, young=1e5, poisson=0.4)
    body.fix(lambda X: X[:, 0] < 1e-6 * scale)
    tip = face(0, 0.5)(mesh.vertices / scale)
    with session.simulator(scene, dt=scale * session.variant.settings["dt"]) as sim:
        before = session.total("newton_iterations") + session.total("linear_iterations")
        (path,) = session.watch(sim, steps, lambda: sim.positions()[tip].mean(axis=0), follow=scale == 1.0)
    return np.array(path) / scale, session.total("newton_iterations") + session.total("linear_iterations") - before


def scales(session: Session, law: str, steps: int) -> dict[str, float]:
    """X1: the same problem at other sizes; times are those of the waves, so that all lengths scale exactly."""
    path, iterations = scaled_bar(session, law, 1.0, steps)
    numbers, worst, count = {}, 0.0, 0.0
    for scale in SCALES:
        other, needed = scaled_bar(session, law, scale, steps)
        off = np.linalg.norm(other - path, axis=1).max() / 0.5 if len(other) == len(path) else np.nan
        numbers[f"size {scale:g} m: {OFF}"] = off
        worst = max(worst, off) if np.isfinite(off) else np.nan
        count = max(count, abs(needed / iterations - 1.0) if iterations else needed)
    return {f"{OFF}, most": worst, "iterations over those at 1 m, less 1": count} | numbers


def flyer_scene(with_flyer: bool) -> ts.Scene:
    """A cube "A" that rests on a plane, and beside it "B", which is shot away."""
    scene = ts.Scene(gravity=DOWN)
    rubber = ts.Material(law=SNH, young=1e6, poisson=0.3, density=1000.0)
    scene.add_body(cube(3, 0.1), rubber, name="A", position=(0, 0.05, 0))
    if with_flyer:
        scene.add_body(cube(3, 0.1), rubber, name="B", position=(1, 0.05, 0), velocity=(1e4, 1e4, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane")
    return scene


def flyer(session: Session, spoilt: bool) -> dict[str, float]:
    """X2: a cube at rest, and one that flies away at 1e4 m/s; spoilt: whose velocity becomes NaN after step 50."""

    def run(with_flyer: bool) -> tuple[np.ndarray, int, np.ndarray]:
        path, memory = [], []

        def look(sim, k, report):
            path.append(sim.positions("A"))
            memory.append(sum(sim.field_bytes.values()))
            if spoilt and with_flyer and k == 50:
                spoil(sim, "B")

        with session.simulator(flyer_scene(with_flyer)) as sim:
            result = session.run_steps(sim, 300, look, follow=with_flyer)
            return np.array(path), result.steps, memory[-1] / memory[1] - 1.0

    alone, _, _ = run(False)
    both, steps, growth = run(True)
    sentences = " ".join(session.problems)
    return {
        "A's path off that without B [m]": np.abs(both - alone[: len(both)]).max(),
        "growth of memory": growth,
        "steps": steps,
        "sentences that name body 'B'": "body 'B'" in sentences,
    }


def spoil(sim: ts.Simulator, body: str) -> None:
    """Make a velocity of a body NaN, behind the simulator's back: from outside none can be set."""
    x, v = sim._dynamics.state.state()
    v[sim._dynamics.state.layout.nodes([b.name for b in sim.scene.bodies].index(body)).start] = np.nan
    sim._dynamics.state.set_state(x, v)


def bin_scene(**capacities) -> ts.Scene:
    """27 cubes of 0.05 m over a bin of 0.2 x 0.2 m."""
    scene, mesh = ts.Scene(gravity=DOWN), cube(2, 0.05)
    rubber = ts.Material(law=SNH, young=1e5, poisson=0.3, density=1000.0, friction=0.4)
    rng = np.random.default_rng(0)
    for k in range(27):
        i, j, l = k // 9 - 1, k // 3 % 3, k % 3 - 1
        place = np.array([0.06 * i, 0.04 + 0.06 * j, 0.06 * l]) + rng.uniform(-4e-3, 4e-3, 3)
        scene.add_body(mesh, rubber, name=f"cube {k}", position=place)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), friction=0.4)
    for inward in ((1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1)):
        scene.add_obstacle(ts.HalfSpace(-0.1 * np.array(inward), inward), friction=0.4)
    scene.collision = ts.CollisionSettings(**capacities)
    return scene


def flood(session: Session, capacities: dict, broad_phase: str) -> dict[str, float]:
    """X3: cubes fall into a bin, with buffers for 64 pairs and contacts, beside a run with room enough where they may grow."""

    def run(**given) -> tuple[np.ndarray, dict]:
        with session.simulator(bin_scene(broad_phase=broad_phase, **given)) as sim:
            session.run_steps(sim, 200, follow=False)
            return sim.positions(), sim.buffer_growths

    small, grown = None, {}
    try:
        small, grown = run(**capacities)
    except SimulationError as error:
        session.refuse(str(error))
    sentences = " ".join(session.problems)
    numbers = {
        "buffers that grew": len(grown),
        "sentences with needed and available counts": "entries are needed" in sentences and "max_capacity allows" in sentences,
        "dropped contacts": session.total("dropped_contacts"),
    }
    if small is not None and "max_capacity" not in capacities:
        numbers["off the run with room enough [m]"] = np.abs(small - run()[0]).max()
    return numbers


BEARS = Must(OK, "the lower cube bears 0.1 MPa, a hundredth of its stiffness")
CRUSHED = Must(
    OK,
    "the weight asks 9.8 MPa of the lower cube, whose law bears 2.1 MPa at most: it is crushed, its tets may turn inside "
    "out, and the plane bears the upper cube; the catalogue lets it fail, but there is an answer",
    (INVERTED,),
)
R1 = Case("R1", "mass ratio of 1e4", masses, size=0.1)
R1.add_variant("A", implicit(0.025), BEARS, level="A")
R1.add_variant("B", implicit(0.025), CRUSHED, level="B")
R1.add_limit(FORCE, 0.01, ANALYTIC, level="A")
R1.add_limit(DEEPEST, 5e-4, PROPOSED, level="A")
R1.add_limit(DEEPEST, 2e-3, PROPOSED, level="B")
R1.add_limit("numbers that are not finite in the last state", 0.0, PROPOSED)
R1.add_limit(SLOWEST, 10.0, PROPOSED, cost=True)
R1.add_shortfall(
    "the impact that crushes the soft cube is cut into many short substeps, each with its own Newton iterations, as it "
    "must be; a step at rest is one",
    "fewer Newton iterations for a substep with contacts",
    level="B",
)

LIES = Must(OK, "the soft slab bears its own weight, a twentieth of its stiffness, and comes to lie on the stiff one")
R2 = Case("R2", "stiffness ratio of 1e4", stiffnesses)
R2.add_variant("neo-Hookean", implicit(0.025), LIES)
R2.add_limit(DEEPEST, 2e-3, PROPOSED)
R2.add_limit(THICKNESS, 0.02, ANALYTIC)
R2.add_limit(BETWEEN, 0.02, ANALYTIC)

SCALES_EXACTLY = Must(OK, "lengths and times scale together, so that every size has the same answer")
X1 = Case("X1", "the same problem at 1 um, 1 mm, 1 m, 1 km", scales, size=0.5, quick=(f"{COR}, symplectic_euler, f64",))
for law in (COR, SNH):
    for settings, steps in ((implicit(5e-3), 100), (explicit(1e-3), 500)):
        for precision in ("f32", "f64"):
            name = f"{law}, {settings['integrator']}, {precision}"
            X1.add_variant(name, settings | {"precision": precision}, SCALES_EXACTLY, law=law, steps=steps)
X1.add_limit(f"{OFF}, most", 1e-4, ANALYTIC, precision="f32")
X1.add_limit(f"{OFF}, most", 1e-9, ANALYTIC, precision="f64")
X1.add_limit("iterations over those at 1 m, less 1", 0.2, ANALYTIC, cost=True)

FLIES = Must(OK, "a fast body far away is a body as any other, and nothing to the one at rest")
POISONED = Must(STOPPED, "no answer follows from NaN: the step that meets it must end the run and name the body")
X2 = Case("X2", "the one that flies away", flyer, size=0.1, quick=("NaN at step 50",))
X2.add_variant("1e4 m/s", implicit(0.01), FLIES, spoilt=False)
X2.add_variant("NaN at step 50", implicit(0.01), POISONED, reference=False, spoilt=True)
X2.add_limit("A's path off that without B [m]", 1e-7, PROPOSED)
X2.add_limit("growth of memory", 0.1, PROPOSED, cost=True, spoilt=False)
X2.add_limit("steps", 50.0, ANALYTIC, spoilt=True)
X2.add_limit("sentences that name body 'B'", 1.0, ANALYTIC, at_least=True, spoilt=True)

GROWING, FORBIDDEN = {"initial_capacity": 64}, {"initial_capacity": 64, "max_capacity": 64}
GROWS = Must(OK, "with memory that may grow the cubes fall as in buffers with room enough")
FULL = {
    "bvh": Must(REFUSED, "the first step lists more than 64 pairs of triangles that are near; nothing may be dropped"),
    "spatial_hash": Must(REFUSED, "the cells hold more than the 64 that max_capacity allows; nothing may be dropped"),
}
X3 = Case("X3", "contact flood with a small buffer", flood, size=0.05)
for phase, full in FULL.items():
    X3.add_variant(f"64, growing, {phase}", implicit(0.01), GROWS, False, capacities=GROWING, broad_phase=phase)
    X3.add_variant(f"64 at most, {phase}", implicit(0.01), full, False, capacities=FORBIDDEN, broad_phase=phase)
X3.add_limit("off the run with room enough [m]", 1e-6, PROPOSED, capacities=GROWING)
X3.add_limit("buffers that grew", 1.0, PROPOSED, at_least=True, capacities=GROWING)
X3.add_limit("sentences with needed and available counts", 1.0, PROPOSED, at_least=True, capacities=FORBIDDEN)
X3.add_limit("dropped contacts", 0.0, ANALYTIC)

RATIOS, SCALE = (R1, R2), (X1, X2, X3)
