"""Steps at their limits: the explicit one, large implicit ones, a fast impact, a stiff cube."""

import warnings

import numpy as np

import taisoft as ts
from taisoft.fem.reference import lumped_mass
from taisoft.scene.key_frames import KeyFrames

from ..reference_cases.record import face
from .record import FAILED, INVERTED, MEASURED, OK, PROPOSED, STOPPED, Case, Criterion, Must, Variant
from .session import Session, refusal
from .shapes import COR, DOWN, SNH, WEIGHTLESS, box, cube, voxels

LAWS = (COR, SNH)
IMPLICIT, EXPLICIT = "implicit_euler", "symplectic_euler"
STABLE_DT = 2.240e-3  # [s] of T1's bar, by power iteration
TWIST_STEPS = (0.002, 0.01, 0.05, 0.2, 1.0)  # [s] of T2


def bracket(session: Session, law: str) -> dict[str, float]:
    """T1: a clamped bar falls in explicit steps below and above the limit."""
    scene = ts.Scene(gravity=(0.0, -0.981, 0.0))
    soft = ts.Material(law=law, young=1e5, poisson=0.4, density=1000.0)
    scene.add_body(box((20, 4, 4), (1.0, 0.2, 0.2)), soft, name="bar").fix(face(0, -0.5))
    dt = session.variant.settings["dt"]
    numbers = {}
    if session.variant.settings.get("allow_unstable"):
        said = refusal(lambda: session.simulator(scene, allow_unstable=False))
        numbers["refused without allow_unstable"] = float("stability limit" in said)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sim = session.simulator(scene)
    with sim:
        farthest = []
        result = session.go(sim, 2000, lambda sim, k, report: farthest.append(np.linalg.norm(sim.positions(), axis=1).max()))
        return numbers | {
            "estimated limit of dt over 2.240e-3 s, less 1": abs(sim.stable_dt / STABLE_DT - 1.0),
            "farthest point of all steps [m]": max(farthest),
            "warned before the first step": float(any("stability limit" in str(one.message) for one in told)),
            "steps until the run was stopped": float(result.steps),
            "numbers that are not finite in the last state": float(not np.isfinite(sim.positions()).all()),
            "dt over the limit": dt / sim.stable_dt,
        }


def twist(session: Session, law: str) -> dict[str, float]:
    """T2: both ends of a rod turn by 360 degrees in 5 s, in steps from 2 ms to 1 s; each held against the finest."""
    numbers, finest, ends = {}, None, np.pi * np.array([2.0, 0.0, 0.0])
    for dt in TWIST_STEPS:
        scene = ts.Scene(gravity=WEIGHTLESS)
        soft = ts.Material(law=law, young=1e4, poisson=0.4, density=1000.0)
        body = scene.add_body(box((20, 2, 2), (1.0, 0.1, 0.1)), soft, name="rod")
        for side in (-0.5, 0.5):
            body.move(face(0, side), KeyFrames([0.0, 5.0], rotations=[WEIGHTLESS, np.sign(side) * ends]))
        with session.simulator(scene, dt=dt) as sim:
            before = session.seconds
            result = session.go(sim, round(5.0 / dt))
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


def impact(session: Session, steps: int) -> dict[str, float]:
    """T3: a ball flies at 67 m/s against a wall."""
    scene = ts.Scene(gravity=WEIGHTLESS)
    rubber = ts.Material(law=SNH, young=1e7, poisson=0.45, density=1150.0, friction=0.0)
    body = scene.add_body(ball(), rubber, name="ball", position=(0.0, 0.03, 0.0), velocity=(0.0, -67.0, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="wall", friction=0.0)
    mass = lumped_mass(body)
    with session.simulator(scene) as sim:
        impulse, energies = [], []

        def look(sim, k, report):
            energies.append(sim.energies().total)
            impulse.append(sim.contact_force("ball")[1] * sim.dt if k else 0.0)

        first = mass @ sim.velocities()
        session.go(sim, steps, look)
        change = (mass @ sim.velocities() - first)[1]
    return {
        "mean velocity away from the wall at the end [m/s]": (change + first[1]) / mass.sum(),
        "deepest penetration after any step [m]": session.deepest,
        "largest energy over that of the start": max(energies) / energies[0],
        "inverted tets at the end": float(session.reports[-1].n_inverted),
        "contact impulses over the change of momentum, less 1": abs(sum(impulse) * session.finer / change - 1.0),
    }


def stiff_cube(session: Session, law: str) -> dict[str, float]:
    """T4: a cube of 1 GPa lands and rests, in steps a thousand times those of an explicit integrator."""
    scene = ts.Scene(gravity=DOWN)
    stiff = ts.Material(law=law, young=1e9, poisson=0.3, density=1000.0, friction=0.5)
    scene.add_body(cube(4, 0.1), stiff, name="cube", position=(0, 0.15, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane", friction=0.5)
    with session.simulator(scene) as sim:
        session.go(sim, 120)
        height = sim.positions().mean(axis=0)[1]
    late = [report.kinetic for report in session.reports if report.time > 1.5]
    return {
        "deepest penetration after any step [m]": session.deepest,
        "kinetic energy after 1.5 s [J]": max(late),
        "height of its middle less 0.05 m [m]": abs(height - 0.05),
    }


ABOVE = {"dt": 2.5e-3}
STABLE = Must(OK, "2 ms are below the limit of 2.24 ms, so that the motion stays bounded")
UNSTABLE = Must(
    STOPPED,
    "2.5 ms are beyond the limit of 2.24 ms, which allow_unstable lets pass: the motion grows until tets turn inside "
    "out, and must be stopped before a number is not finite",
    (INVERTED,),
)
T1 = Case(
    "T1",
    "bracket of the explicit limit",
    bracket,
    tuple(
        Variant(
            f"{law}, dt {dt:g} s",
            {"dt": dt, "integrator": EXPLICIT, "allow_unstable": dt > STABLE_DT},
            {"law": law},
            must,
            reference=dt < STABLE_DT,
        )
        for law in LAWS
        for dt, must in ((2.0e-3, STABLE), (2.5e-3, UNSTABLE))
    ),
    (
        Criterion("estimated limit of dt over 2.240e-3 s, less 1", 0.15, MEASURED),
        Criterion("farthest point of all steps [m]", 1.0, MEASURED, of={"dt": 2.0e-3}),
        Criterion("refused without allow_unstable", 1.0, MEASURED, at_least=True, of=ABOVE),
        Criterion("warned before the first step", 1.0, MEASURED, at_least=True, of=ABOVE),
        Criterion("steps until the run was stopped", 59.0, MEASURED, of=ABOVE),
        Criterion("numbers that are not finite in the last state", 0.0, MEASURED),
    ),
    size=1.0,
    quick=(f"{COR}, dt 0.002 s", f"{SNH}, dt 0.0025 s"),
)

TWISTS = Must(OK, "an implicit step of any length has a solution; the catalogue lets the long ones fail, if they say so")
T2 = Case(
    "T2",
    "one twist of a rod, dt from 0.002 to 1 s",
    twist,
    tuple(Variant(law, {"dt": TWIST_STEPS[0], "integrator": IMPLICIT}, {"law": law}, TWISTS, reference=False) for law in LAWS),
    tuple(
        Criterion(f"dt {dt:g} s: {what}", limit, PROPOSED)
        for dt in TWIST_STEPS
        if dt <= 0.05
        for what, limit in (("distance to dt 0.002 s, over L", 0.05), ("inverted tets, most", 0.0))
    ),
    size=1.0,
)

BOUNCES = Must(OK, "rubber stands 67 m/s, as a golf ball does: it flattens, keeps its energy and flies back")
T3 = Case(
    "T3",
    "a ball at 67 m/s on a wall",
    impact,
    (
        Variant("implicit", {"dt": 2e-5, "integrator": IMPLICIT}, {"steps": 200}, BOUNCES),
        Variant("explicit", {"dt": 2e-6, "integrator": EXPLICIT}, {"steps": 2000}, BOUNCES),
    ),
    (
        Criterion("mean velocity away from the wall at the end [m/s]", 0.0, PROPOSED, at_least=True),
        Criterion("deepest penetration after any step [m]", 1e-4, PROPOSED),
        Criterion("largest energy over that of the start", 1.001, PROPOSED),
        Criterion("inverted tets at the end", 0.0, PROPOSED),
        Criterion("contact impulses over the change of momentum, less 1", 0.01, PROPOSED),
    ),
    size=0.04,
)

LANDS = Must(OK, "a stiff cube lands and rests; long steps only damp its waves")
T4 = Case(
    "T4",
    "a cube of 1 GPa in steps of 1/60 s",
    stiff_cube,
    tuple(Variant(law, {"dt": 1 / 60, "integrator": IMPLICIT, "precision": "f64"}, {"law": law}, LANDS) for law in LAWS),
    (
        Criterion("deepest penetration after any step [m]", 1e-3, PROPOSED),
        Criterion("kinetic energy after 1.5 s [J]", 1e-6, PROPOSED),
        Criterion("height of its middle less 0.05 m [m]", 1e-3, PROPOSED),
    ),
    size=0.1,
    quick=(COR,),
)

CASES = (T1, T2, T3, T4)
