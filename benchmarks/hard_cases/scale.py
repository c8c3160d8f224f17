"""Extremes of scale: sizes from 1 um to 1 km, a body that flies away, more contacts than there is room for."""

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError

from ..reference_cases.record import face
from .record import ANALYTIC, OK, PROPOSED, REFUSED, STOPPED, Case, Criterion, Must, Shortfall, Variant
from .session import Session
from .shapes import COR, DOWN, SNH, WEIGHTLESS, box, cube

IMPLICIT, EXPLICIT = "implicit_euler", "symplectic_euler"
SCALES = (1e-6, 1e-3, 1e3)


def scaled_bar(session: Session, law: str, scale: float, steps: int) -> tuple[np.ndarray, int]:
    """Path of the tip (k,3) over the scale [m], and the iterations, of a clamped bar of 0.5 m times the scale."""
    scene = ts.Scene(gravity=WEIGHTLESS)
    mesh = box((10, 2, 2), scale * np.array([0.5, 0.1, 0.1]), (0.25 * scale, 0.0, 0.0))
    speed = np.zeros((mesh.n_verts, 3))
    speed[:, 1] = (mesh.vertices[:, 0] / (0.5 * scale)) ** 2
    soft = ts.Material(law=law, young=1e5, poisson=0.4, density=1000.0)
    body = scene.add_body(mesh, soft, name="bar", velocity=speed)
    body.fix(lambda X: X[:, 0] < 1e-6 * scale)
    tip = face(0, 0.5)(mesh.vertices / scale)
    path = []
    with session.simulator(scene, dt=scale * session.variant.settings["dt"]) as sim:
        result = session.go(
            sim, steps, lambda sim, k, report: path.append(sim.positions()[tip].mean(axis=0)), follow=scale == 1.0
        )
    return np.array(path) / scale, sum(r.newton_iterations + r.linear_iterations for r in result.step_reports)


def scales(session: Session, law: str, steps: int) -> dict[str, float]:
    """X1: the same problem at other sizes; times are those of the waves, so that all lengths scale exactly."""
    path, iterations = scaled_bar(session, law, 1.0, steps)
    numbers, worst, count = {}, 0.0, 0.0
    for scale in SCALES:
        other, needed = scaled_bar(session, law, scale, steps)
        off = np.linalg.norm(other - path, axis=1).max() / 0.5 if len(other) == len(path) else np.nan
        numbers[f"size {scale:g} m: tip off that at 1 m, over L"] = off
        worst = max(worst, off) if np.isfinite(off) else np.nan
        count = max(count, abs(needed / iterations - 1.0) if iterations else float(needed))
    return {"tip off that at 1 m, over L, most": worst, "iterations over those at 1 m, less 1": count} | numbers


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
            result = session.go(sim, 300, look, follow=with_flyer)
            return np.array(path), result.steps, memory[-1] / memory[1] - 1.0

    alone, _, _ = run(False)
    both, steps, growth = run(True)
    told = " ".join(session.problems)
    return {
        "A's path off that without B [m]": np.abs(both - alone[: len(both)]).max(),
        "growth of memory": growth,
        "steps": float(steps),
        "sentences that name body 'B'": float("body 'B'" in told),
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
            session.go(sim, 200, follow=False)
            return sim.positions(), sim.buffer_growths

    small, grown = None, {}
    try:
        small, grown = run(**capacities)
    except SimulationError as error:
        session.refuse(str(error))
    sentences = " ".join(session.problems)
    numbers = {
        "buffers that grew": float(len(grown)),
        "sentences with needed and available counts": float(
            "entries are needed" in sentences and "max_capacity allows" in sentences
        ),
        "dropped contacts": float(sum(report.dropped_contacts for report in session.reports)),
    }
    if small is not None and "max_capacity" not in capacities:
        numbers["off the run with room enough [m]"] = np.abs(small - run()[0]).max()
    return numbers


SCALES_EXACTLY = Must(OK, "lengths and times scale together, so that every size has the same answer")
X1 = Case(
    "X1",
    "the same problem at 1 um, 1 mm, 1 m, 1 km",
    scales,
    tuple(
        Variant(
            f"{law}, {kind}, {precision}",
            {"dt": dt, "integrator": kind, "precision": precision},
            {"law": law, "steps": steps},
            SCALES_EXACTLY,
        )
        for law in (COR, SNH)
        for kind, dt, steps in ((IMPLICIT, 5e-3, 100), (EXPLICIT, 1e-3, 500))
        for precision in ("f32", "f64")
    ),
    (
        Criterion("tip off that at 1 m, over L, most", 1e-4, ANALYTIC, of={"precision": "f32"}),
        Criterion("tip off that at 1 m, over L, most", 1e-9, ANALYTIC, of={"precision": "f64"}),
        Criterion("iterations over those at 1 m, less 1", 0.2, ANALYTIC, cost=True),
    ),
    size=0.5,
    quick=(f"{COR}, {EXPLICIT}, f64",),
)

FLYING, SPOILT = {"spoilt": False}, {"spoilt": True}
FLIES = Must(OK, "a fast body far away is a body as any other, and nothing to the one at rest")
POISONED = Must(STOPPED, "no answer follows from NaN: the step that meets it must end the run and name the body")
X2 = Case(
    "X2",
    "the one that flies away",
    flyer,
    (
        Variant("1e4 m/s", {"dt": 0.01, "integrator": IMPLICIT}, FLYING, FLIES),
        Variant("NaN at step 50", {"dt": 0.01, "integrator": IMPLICIT}, SPOILT, POISONED, reference=False),
    ),
    (
        Criterion("A's path off that without B [m]", 1e-7, PROPOSED),
        Criterion("growth of memory", 0.1, PROPOSED, of=FLYING, cost=True),
        Criterion("steps", 50.0, ANALYTIC, of=SPOILT),
        Criterion("sentences that name body 'B'", 1.0, ANALYTIC, at_least=True, of=SPOILT),
    ),
    size=0.1,
    quick=("NaN at step 50",),
)

GROWING, FORBIDDEN = {"initial_capacity": 64}, {"initial_capacity": 64, "max_capacity": 64}
GROWS = Must(OK, "with memory that may grow the cubes fall as in buffers with room enough")
FULL = {
    "spatial_hash": Must(REFUSED, "the cells hold more than the 64 that max_capacity allows; nothing may be dropped"),
    "bvh": Must(STOPPED, "no list is longer than 64 before the cubes touch; then contacts are more, none to be dropped"),
}
X3 = Case(
    "X3",
    "contact flood with a small buffer",
    flood,
    tuple(
        Variant(
            f"{what}, {phase}", {"dt": 0.01, "integrator": IMPLICIT}, {"capacities": given, "broad_phase": phase}, must, False
        )
        for phase in ("bvh", "spatial_hash")
        for what, given, must in (("64, growing", GROWING, GROWS), ("64 at most", FORBIDDEN, FULL[phase]))
    ),
    (
        Criterion("off the run with room enough [m]", 1e-6, PROPOSED, of={"capacities": GROWING}),
        Criterion("buffers that grew", 1.0, PROPOSED, at_least=True, of={"capacities": GROWING}),
        Criterion("sentences with needed and available counts", 1.0, PROPOSED, at_least=True, of={"capacities": FORBIDDEN}),
        Criterion("dropped contacts", 0.0, ANALYTIC),
    ),
    size=0.05,
    shortfalls=(
        Shortfall(
            "multipliers stall: in one step, with 472 contacts, the contact laws end at a residual of 1.25e-4, where f32 asks "
            "1e-4, and no lower in f64; memory has no part in it, the run with room enough does the same",
            "a second-order step on the multipliers once it is settled which contacts press and which slide",
            of={"capacities": GROWING},
        ),
    ),
)

CASES = (X1, X2, X3)
