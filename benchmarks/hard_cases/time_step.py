"""Steps at their limits, and very many of them.

T: the explicit limit, large implicit steps, a fast impact, a stiff cube. L: a free spin of 1e5 steps, a minute at rest, a run
that is stopped and goes on in another process.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.fem.reference import lumped_mass
from taisoft.output.report import peak_memory
from taisoft.scene.key_frames import KeyFrames

from ..children import in_child
from ..reference_cases.record import face
from .case import (
    ANALYTIC,
    DEEPEST,
    FAILED,
    INVERTED,
    MEASURED,
    OK,
    PROPOSED,
    STOPPED,
    Case,
    Must,
    Session,
    explicit,
    firm,
    implicit,
    refusal,
)
from .contact import on_slope, stack_scene
from .shapes import COR, DOWN, SNH, WEIGHTLESS, box, cube, not_finite, one_body, voxels

LAWS = (COR, SNH)
STABLE_DT = 2.240e-3  # [s] of T1's bar, by power iteration
FLOOR = 0.2  # volume floor of T3's variants that have one
TWIST_STEPS = (0.002, 0.01, 0.05, 0.2, 1.0)  # [s] of T2


def bracket(session: Session, law: str) -> dict[str, float]:
    """T1: a clamped bar falls in explicit steps below and above the limit."""
    scene, bar = one_body("bar", box((20, 4, 4), (1.0, 0.2, 0.2)), (0.0, -0.981, 0.0), law=law, young=1e5, poisson=0.4)
    bar.fix(face(0, -0.5))
    dt = session.variant.settings["dt"]
    numbers = {}
    if session.variant.settings.get("allow_unstable"):
        message = refusal(lambda: session.simulator(scene, allow_unstable=False))
        numbers["refused without allow_unstable"] = "stability limit" in message
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        sim = session.simulator(scene)
    with sim:
        (farthest,) = session.watch(sim, 2000, lambda: np.linalg.norm(sim.positions(), axis=1).max())
        return numbers | {
            "estimated limit of dt over 2.240e-3 s, less 1": abs(sim.stable_dt / STABLE_DT - 1.0),
            "farthest point of all steps [m]": max(farthest),
            "warned before the first step": any("stability limit" in str(one.message) for one in warned),
            "steps until the run was stopped": session.steps,
            "numbers that are not finite in the last state": not_finite(sim.positions()),
            "dt over the limit": dt / sim.stable_dt,
        }


def twist(session: Session, law: str) -> dict[str, float]:
    """T2: both ends of a rod turn by 360 degrees in 5 s, in steps from 2 ms to 1 s; each compared with the finest."""
    numbers, finest, ends = {}, None, np.pi * np.array([2.0, 0.0, 0.0])
    for dt in TWIST_STEPS:
        scene, body = one_body("rod", box((20, 2, 2), (1.0, 0.1, 0.1)), law=law, young=1e4, poisson=0.4)
        for side in (-0.5, 0.5):
            body.move(face(0, side), KeyFrames([0.0, 5.0], rotations=[WEIGHTLESS, np.sign(side) * ends]))
        with session.simulator(scene, dt=dt) as sim:
            before = session.seconds
            result = session.run_steps(sim, round(5.0 / dt))
            x = sim.positions()
        finest = x if finest is None else finest
        what = f"dt {dt:g} s: "
        off = np.linalg.norm(x - finest, axis=1).max()
        numbers[what + "distance to dt 0.002 s, over L"] = off if result.status != FAILED else np.nan
        numbers[what + "inverted tets, most"] = max((r.n_inverted for r in result.step_reports), default=0)
        numbers[what + "largest residual"] = max((r.residual for r in result.step_reports), default=np.nan)
        numbers[what + "steps that did not converge"] = sum(not r.converged for r in result.step_reports)
        numbers[what + "wall time [s]"] = session.seconds - before
    return numbers


def ball() -> ts.TetMesh:
    """Voxels of 4 mm with their middle in a ball of 40 mm."""
    middles = (np.arange(10) - 4.5) * 0.004
    r = np.linalg.norm(np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), axis=-1), axis=-1)
    return voxels(r < 0.02, 0.004)


def impact(session: Session, steps: int, volume_floor: float) -> dict[str, float]:
    """T3: a ball flies at 67 m/s against a wall. volume_floor: of its material, 0 in the catalogue."""
    rubber = {"law": SNH, "young": 1e7, "poisson": 0.45, "density": 1150.0, "friction": 0.0, "volume_floor": volume_floor}
    scene, body = one_body("ball", ball(), position=(0.0, 0.03, 0.0), velocity=(0.0, -67.0, 0.0), **rubber)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="wall", friction=0.0)
    mass = lumped_mass(body)
    with session.simulator(scene) as sim:
        first = mass @ sim.velocities()
        energies, forces = session.watch(sim, steps, lambda: sim.energies().total, lambda: sim.contact_force("ball")[1])
        change = (mass @ sim.velocities() - first)[1]
    return {
        "mean velocity away from the wall at the end [m/s]": (change + first[1]) / mass.sum(),
        DEEPEST: session.largest("max_penetration"),
        "largest energy over that of the start": max(energies) / energies[0],
        "inverted tets at the end": session.reports[-1].n_inverted,
        "contact impulses over the change of momentum, less 1": abs(
            sum(force * sim.dt for force in forces[1:]) * session.finer / change - 1.0
        ),
    }


def stiff_cube(session: Session, law: str) -> dict[str, float]:
    """T4: a cube of 1 GPa lands and rests, in steps a thousand times those of an explicit integrator."""
    scene, _ = one_body("cube", cube(4, 0.1), DOWN, (0, 0.15, 0), law=law, young=1e9, poisson=0.3, friction=0.5)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane", friction=0.5)
    with session.simulator(scene) as sim:
        session.run_steps(sim, 120)
        height = sim.positions().mean(axis=0)[1]
    late = [report.kinetic for report in session.reports if report.time > 1.5]
    return {
        DEEPEST: session.largest("max_penetration"),
        "kinetic energy after 1.5 s [J]": max(late),
        "height of its middle less 0.05 m [m]": abs(height - 0.05),
    }


def free_spin(session: Session, law: str) -> dict[str, float]:
    """L1: a free cube flies and spins for 1e5 steps."""
    mesh = cube(4, 0.1)
    speed = np.cross([0.0, 0.0, 20.0], mesh.vertices) + [1.0, 0.5, 0.0]
    scene, body = one_body("cube", mesh, velocity=speed, law=law, young=1e5, poisson=0.4)
    mass = lumped_mass(body)

    def spin() -> np.ndarray:
        x, v = sim.positions(), sim.velocities()
        return mass @ np.cross(x - mass @ x / mass.sum(), v - mass @ v / mass.sum())

    with session.simulator(scene) as sim:
        read = (lambda: mass @ sim.velocities()), spin, (lambda: sim.energies().total)
        momenta, spins, energies = session.watch(sim, 100_000, *read, every=100)

    def drift(values) -> float:
        values = np.array(values)
        return np.linalg.norm(values - values[0], axis=1).max() / np.linalg.norm(values[0])

    energies = np.array(energies)
    return {
        "drift of the momentum": drift(momenta),
        "drift of the angular momentum": drift(spins),
        "drift of the energy": np.abs(energies / energies[0] - 1.0).max(),
    }


def rest(session: Session) -> dict[str, float]:
    """L2: a cube on a slope neither creeps nor shakes in 60 s, and costs the same all the time."""
    soft = ts.Material(law=COR, young=1e5, poisson=0.3, density=1000.0)
    with session.simulator(on_slope(cube(4, 0.1), soft, np.radians(10.0), 0.5)) as sim:
        session.run_steps(sim, 100)
        start, fields, peak = sim.positions(), sum(sim.field_bytes.values()), peak_memory()
        (displacements,) = session.watch(sim, 5900, lambda: np.abs(sim.positions() - start).max())
        seconds = np.array(session.step_seconds)
        return {
            "creep after 1 s, most [m]": max(displacements),
            "kinetic energy after 1 s, most [J]": max(report.kinetic for report in session.reports if report.time > 1.0),
            "growth of the fields after 1 s": sum(sim.field_bytes.values()) / fields - 1.0,
            "growth of the process's peak memory after 1 s": peak_memory() / peak - 1.0,
            "time of the last 1000 steps over that of the first": np.median(seconds[-1000:]) / np.median(seconds[:1000]),
        }


def resume(session: Session) -> dict[str, float]:
    """L3: 200 steps of a stack at once, against 100, a checkpoint, and 100 more in another process."""
    frames = []
    with tempfile.TemporaryDirectory() as folder, session.simulator(stack_scene(None)) as sim:
        saved = Path(folder) / "checkpoint.npz"

        def look(sim, k, report):
            if k == 100:
                sim.save_checkpoint(saved)
            if k > 100:
                frames.append(np.stack([sim.positions(), sim.velocities()]))

        session.run_steps(sim, 200, look)
        touching = session.reports[99].n_contacts
        resumed = np.array(in_child("the resumed run", frames_from, str(saved)))
    different = [k for k, (a, b) in enumerate(zip(frames, resumed)) if not np.array_equal(a, b)]
    return {
        "contacts when it was stopped": touching,
        "frames": min(len(frames), len(resumed)),
        "frames that differ in a bit": len(different),
        "largest difference [m]": np.abs(np.array(frames)[:, 0] - resumed[:, 0]).max() if len(frames) == len(resumed) else np.nan,
    }


def frames_from(saved: str) -> list:
    """Positions [m] and velocities [m/s], two lists of the nodes', of each of the 100 steps after a checkpoint of L3."""
    with ts.Simulator.load_checkpoint(saved, stack_scene(None)) as sim:
        found = []
        for _ in range(100):
            sim.step()
            found.append([sim.positions().tolist(), sim.velocities().tolist()])
    return found


STABLE = Must(OK, "2 ms are below the limit of 2.24 ms, so that the motion stays bounded")
UNSTABLE = Must(
    STOPPED,
    "2.5 ms are beyond the limit of 2.24 ms, which allow_unstable lets pass: the motion grows until tets turn inside "
    "out, and must be stopped before a number is not finite",
    (INVERTED,),
)
T1 = Case("T1", "bracket of the explicit limit", bracket, quick=(f"{COR}, dt 0.002 s", f"{SNH}, dt 0.0025 s"))
for law in LAWS:
    for dt, must in ((2.0e-3, STABLE), (2.5e-3, UNSTABLE)):
        settings = explicit(dt, allow_unstable=dt > STABLE_DT)
        T1.add_variant(f"{law}, dt {dt:g} s", settings, must, reference=dt < STABLE_DT, law=law)
T1.add_limit("estimated limit of dt over 2.240e-3 s, less 1", 0.15, MEASURED)
T1.add_limit("farthest point of all steps [m]", 1.0, MEASURED, dt=2.0e-3)
T1.add_limit("refused without allow_unstable", 1.0, MEASURED, at_least=True, dt=2.5e-3)
T1.add_limit("warned before the first step", 1.0, MEASURED, at_least=True, dt=2.5e-3)
T1.add_limit("steps until the run was stopped", 59.0, MEASURED, dt=2.5e-3)
T1.add_limit("numbers that are not finite in the last state", 0.0, MEASURED)

TWISTS = Must(OK, "an implicit step of any length has a solution; the catalogue lets the long ones fail, if they say so")
T2 = Case("T2", "one twist of a rod, dt from 0.002 to 1 s", twist)
for law in LAWS:
    T2.add_variant(law, implicit(TWIST_STEPS[0]), TWISTS, reference=False, law=law)
for dt in TWIST_STEPS[:3]:
    T2.add_limit(f"dt {dt:g} s: distance to dt 0.002 s, over L", 0.05, PROPOSED)
    T2.add_limit(f"dt {dt:g} s: inverted tets, most", 0.0, PROPOSED)

BOUNCES = Must(OK, "rubber stands 67 m/s, as a golf ball does: it flattens, keeps its energy and flies back")
BOUNCES_FIRM = Must(OK, f"{BOUNCES.reason}; {firm(FLOOR)}")
T3 = Case("T3", "a ball at 67 m/s on a wall", impact, size=0.04)
for floor in (0.0, FLOOR):
    name, must = (f", volume floor {floor:g}", BOUNCES_FIRM) if floor else ("", BOUNCES)
    T3.add_variant("implicit" + name, implicit(2e-5), must, steps=200, volume_floor=floor)
    T3.add_variant("explicit" + name, explicit(2e-6), must, steps=2000, volume_floor=floor)
T3.add_limit("mean velocity away from the wall at the end [m/s]", 0.0, PROPOSED, at_least=True)
T3.add_limit(DEEPEST, 1e-4, PROPOSED)
T3.add_limit("largest energy over that of the start", 1.001, PROPOSED)
T3.add_limit("inverted tets at the end", 0.0, PROPOSED)
T3.add_limit("contact impulses over the change of momentum, less 1", 0.01, PROPOSED)
T3.add_shortfall(
    "mean dilatation, the default of linear tets from a Poisson's ratio of 0.45, keeps volumes of patches, so that the impact "
    "turns up to three tets inside out, which recover at once; local dilatation, which inverts none, bends too little",
    "a material that stiffens where a tet is squeezed, as in the variants with a volume floor",
    volume_floor=0.0,
)

LANDS = Must(OK, "a stiff cube lands and rests; long steps only damp its waves")
T4 = Case("T4", "a cube of 1 GPa in steps of 1/60 s", stiff_cube, size=0.1, quick=(COR,))
for law in LAWS:
    T4.add_variant(law, implicit(1 / 60, precision="f64"), LANDS, law=law)
T4.add_limit(DEEPEST, 1e-3, PROPOSED)
T4.add_limit("kinetic energy after 1.5 s [J]", 1e-6, PROPOSED)
T4.add_limit("height of its middle less 0.05 m [m]", 1e-3, PROPOSED)

SPINS = Must(OK, "a free body keeps its momenta, and symplectic steps below the limit keep its energy in bounds")
L1 = Case("L1", "free spin, 1e5 steps", free_spin, size=0.1)
for law in LAWS:
    for precision in ("f32", "f64"):
        L1.add_variant(f"{law}, {precision}", explicit(5.6e-4, precision=precision), SPINS, law=law)
for precision, momentum, angular in (("f32", 1e-4, 1e-4), ("f64", 1e-12, 1e-10)):
    L1.add_limit("drift of the momentum", momentum, MEASURED, precision=precision)
    L1.add_limit("drift of the angular momentum", angular, MEASURED, precision=precision)
L1.add_limit("drift of the energy", 0.02, MEASURED)

RESTS = Must(OK, "the slope's tangent of 0.18 is below the friction of 0.5, so that the cube stays where it is")
L2 = Case("L2", "sixty seconds at rest", rest, size=0.1)
L2.add_variant(COR, implicit(0.01), RESTS)
L2.add_limit("creep after 1 s, most [m]", 1e-4, PROPOSED)
L2.add_limit("kinetic energy after 1 s, most [J]", 1e-8, PROPOSED)
L2.add_limit("growth of the fields after 1 s", 0.02, PROPOSED, cost=True)
L2.add_limit("growth of the process's peak memory after 1 s", 0.02, PROPOSED, cost=True)
L2.add_limit("time of the last 1000 steps over that of the first", 1.1, PROPOSED, cost=True)

GOES_ON = Must(OK, "a checkpoint holds all that the next step depends on")
L3 = Case("L3", "stop and go on", resume, size=5.0)
L3.add_variant(SNH, implicit(0.025), GOES_ON, reference=False)
L3.add_limit("contacts when it was stopped", 1.0, ANALYTIC, at_least=True)
L3.add_limit("frames", 100.0, ANALYTIC, at_least=True)
L3.add_limit("frames that differ in a bit", 0.0, PROPOSED)

TIME_STEP, LONG_RUN = (T1, T2, T3, T4), (L1, L2, L3)
