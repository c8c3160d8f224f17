"""Cases of `regression.py`, as data.

Each case measures a few numbers and compares them with a reference; the error is the largest difference over the largest number
of the reference. A reference is a formula, or the same scene in f64 with an eighth of the step, computed and stored by --update.
Cases whose iterations change by more than the margins for a change of 1e-7 in the mesh, such as stacks of flush cubes, are
excluded.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.backend.runtime import open_runtime
from taisoft.scene.scene import Scene

from .collision_cases import DEEP_PENETRATION, SHEET, cubes_setup
from .collision_runs import Rig
from .contact_runs import SETTINGS
from .hard_cases.contact import on_slope
from .hard_cases.shapes import SNH, G, box
from .reference_cases.record import LAWS, face
from .runner import timed

# settings of a reference: fraction of the step, and tolerances that hold even in the step in which sliding ends
FINER = {"dt": 1 / 8, "contact_tolerance": 1e-5, "newton_tolerance": 1e-6}
ROUNDING = {"f32": 1e-5, "f64": 1e-9}  # change of errors by another order of summation
ANGLE, FRICTION = np.arctan(0.5), 0.3  # of the slope
METHODS = ("gauss_seidel", "coloured_gauss_seidel", "jacobi", "hybrid", "augmented_lagrangian")


@dataclass
class Found:
    """Result of a computation. measured: the compared numbers; counts: iterations and the like; seconds: without compilation."""

    measured: list[float]
    counts: dict[str, int]
    status: str = "ok"
    field_bytes: int = 0
    seconds: float = 0.0
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Case:
    """A computation. what: the numbers and their reference, in words; reference: arch -> expected numbers; slack: error due to
    rounding; quick: always run by the tests."""

    name: str
    what: str
    precision: str
    run: Callable[[str], Found] = field(repr=False)
    reference: Callable[[str], list[float]] = field(repr=False)
    slack: float
    quick: bool = False


# --- motions ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """A scene run for some seconds. read: simulator -> compared numbers; settings: of the simulator, without precision."""

    build: Callable[[], Scene]
    seconds: float
    read: Callable[[ts.Simulator], np.ndarray]
    settings: dict

    def run(self, precision: str, arch: str) -> Found:
        """Run the scene."""
        with ts.Simulator(self.build(), precision=precision, arch=arch, **self.settings) as sim:
            result, seconds = timed(partial(sim.run, self.seconds, fps=None))
            reports = result.step_reports
            counts = {
                "steps": result.steps,
                "newton": sum(r.newton_iterations for r in reports),
                "linear": sum(r.linear_iterations for r in reports),
                "contact": sum(r.contact_iterations for r in reports),
                "contacts": max(r.n_contacts for r in reports),
            }
            counts = {name: n for name, n in counts.items() if n}
            field_bytes = sum(sim.field_bytes.values())
            return Found(self.read(sim).tolist(), counts, result.status, field_bytes, seconds, result.problems)

    def finer(self, arch: str) -> list[float]:
        """The same numbers in f64 with finer steps. Raises SimulationError if the run is not ok."""
        finer = replace(self, settings=self.settings | FINER | {"dt": FINER["dt"] * self.settings["dt"]})
        found = finer.run("f64", arch)
        if found.status != "ok":
            raise ts.SimulationError(f"a reference ended {found.status}: {'; '.join(found.problems[:2])}")
        return found.measured


def motion(name, what, precision, build, seconds, read, exact=None, quick=False, slack=None, **settings) -> Case:
    """A case that is a motion. exact: expected numbers, if there is a formula."""
    one = Motion(build, seconds, read, settings)
    reference = one.finer if exact is None else lambda arch: list(exact)
    return Case(name, what, precision, partial(one.run, precision), reference, slack or ROUNDING[precision], quick)


def beam(law: str = "SNH", cells: tuple = (8, 2, 2), order: int = 1) -> Scene:
    """A beam of 2 x 0.5 x 0.5 m, clamped at its left end."""
    scene = ts.Scene(gravity=(0, -G, 0))
    body = scene.add_body(ts.box_mesh(cells, (2, 0.5, 0.5)), ts.Material(law=LAWS[law], young=1e6, poisson=0.3), order=order)
    body.fix(face(0, -1.0))
    return scene


def mean_displacement(sim: ts.Simulator) -> np.ndarray:
    """Mean displacement of the last body's nodes (3,) [m]."""
    body = sim.scene.bodies[-1]
    return (sim.positions(body.name) - body.rest_positions - body.position).mean(axis=0)


def cube_on_slope() -> Scene:
    """A cube on a slope of 1:2 that it slides down."""
    cube = ts.Material(law=SNH, young=1e6, poisson=0.3, density=1000.0)
    return on_slope(box((2, 2, 2), (0.1,) * 3), cube, ANGLE, FRICTION)


def slide_distance(sim: ts.Simulator) -> np.ndarray:
    """Distance by which the cube slid (1,) [m]."""
    return np.array([mean_displacement(sim) @ (np.cos(ANGLE), -np.sin(ANGLE), 0.0)])


def slid(seconds: float) -> list[float]:
    """Distance by which a rigid cube slides [m]."""
    return [float(0.5 * G * (np.sin(ANGLE) - FRICTION * np.cos(ANGLE)) * seconds**2)]


def demo(name: str, precision: str, seconds: float) -> Case:
    """The start of a demo with its own settings: mean displacement of the last body."""
    from taisoft.cli.scene_file import load_scene

    own = {key: value for key, value in load_scene(name)[1].items() if key in SETTINGS}
    what = f"mean displacement of the last body after {seconds:g} s; reference: f64 with an eighth of the step"
    return motion(f"demo {name}", what, precision, lambda: load_scene(name)[0], seconds, mean_displacement, **own)


# --- the others -------------------------------------------------------------------------------------------------------


def static(tolerance: float, order: int, arch: str) -> Found:
    """The equilibrium of the beam: mean displacement of its nodes."""
    settings = {"newton_tolerance": tolerance, "precision": "f64", "arch": arch}
    with ts.Simulator(beam("SNH", order=order), dt=1.0, integrator="static", **settings) as sim:
        report, seconds = timed(sim.step)
        measured = (sim.positions() - sim.scene.bodies[0].rest_positions).mean(axis=0)
        counts = {"newton": report.newton_iterations, "linear": report.linear_iterations}
        status = "ok" if report.converged else "not converged"
        return Found(measured.tolist(), counts, status, sum(sim.field_bytes.values()), seconds)


def search(setup, arch: str) -> Found:
    """A search for contacts: the least gap."""
    with closing(open_runtime(arch, "f32", "the regression cases")) as runtime, Rig(setup, "proximity", runtime) as rig:
        rig.search()
        _, seconds = timed(rig.search)
        d = rig.detection
        counts = {name: int(getattr(d.counts, name)) for name in ("triangles", "active", "found", "contacts")}
        counts["pairs"] = rig.n_pairs()
        c = d.contacts()
        return Found([float(c.gap[c.kind != "mortar"].min())], counts, "ok", sum(d.field_bytes.values()), seconds)


def random_problem(n: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """W, b and mu of n contacts that share nodes at random, W positive definite."""
    rng = np.random.default_rng(5)
    J = np.kron(rng.normal(size=(n, n // 3)) * (rng.uniform(size=(n, n // 3)) < 3 / n), np.eye(3))
    turns = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    J = np.einsum("kij,kjm->kim", turns, J.reshape(n, 3, -1)).reshape(3 * n, -1)
    b = rng.normal(size=(n, 3)) - (1.0, 0.0, 0.0)
    return J @ J.T + 0.5 * np.eye(3 * n), b.reshape(-1), np.full(n, 0.4)


def contact_problem(arch: str) -> Found:
    """The sum of the normal impulses of that problem by each solver, and how many iterations each took. On the processor."""
    W, b, mu = random_problem()
    found = Found([], {})
    for method in METHODS:
        solution, seconds = timed(partial(ts.solve_contact_problem, W, b, mu, method=method, tolerance=1e-8, max_iterations=5000))
        found.measured.append(float(solution.impulse[::3].sum()))
        found.counts[method], found.seconds = solution.iterations, found.seconds + seconds
        found.status = found.status if solution.converged else f"{method} did not converge"
    return found


def tight_contact_problem(arch: str) -> list[float]:
    """The same numbers by one solver to 1e-13."""
    solution = ts.solve_contact_problem(*random_problem(), method="gauss_seidel", tolerance=1e-13, max_iterations=100_000)
    return [float(solution.impulse[::3].sum())] * len(METHODS)


RADIUS, THICK, ARM = 0.11, 0.2, 0.6  # of a strip bent to a U, whose arms are 2 RADIUS - THICK apart


def bent_strip() -> Scene:
    """A strip bent to a half turn, its arms nearly touching, without gravity."""
    turn = np.pi * RADIUS
    mesh = ts.box_mesh((24, 2, 4), (turn + 2 * ARM, THICK, 0.4), pattern="six")
    s, y, z = mesh.vertices.T
    angle, beyond, r = np.clip(s, -turn / 2, turn / 2) / RADIUS, np.maximum(np.abs(s) - turn / 2, 0.0), RADIUS - y
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.collision = ts.CollisionSettings(margin=0.04)
    scene.add_body(ts.TetMesh(np.stack([beyond - r * np.cos(angle), -r * np.sin(angle), z], axis=1), mesh.tets), ts.Material())
    return scene


def self_collision(arch: str) -> Found:
    """Contacts of the strip with itself: the least gap."""
    with ts.Simulator(bent_strip(), dt=1e-3, self_collision=True, arch=arch) as sim:
        sim.detect_contacts()
        contacts, seconds = timed(sim.detect_contacts)
        counts = {"found": int(contacts.found), "contacts": len(contacts.gap)}
        return Found([float(contacts.gap.min())], counts, "ok", sum(sim.field_bytes.values()), seconds)


# --- all ------------------------------------------------------------------------------------------------------------------

TIP = "mean displacement of the nodes after 0.2 s; reference: f64 with an eighth of the step"
FALL = {"integrator": "velocity_verlet", "dt": 1e-3, "slack": 2e-6}  # the error is mostly rounding
SWING = {"integrator": "bdf2", "dt": 0.01}
SLOPE = "distance down the slope after 0.4 s; reference: a rigid cube"
GAP = "smallest gap; reference: as built"

CASES: tuple[Case, ...] = (  # grouped by precision, since another one restarts Taichi
    motion("explicit beam SNH", TIP, "f32", beam, 0.2, mean_displacement, quick=True, **FALL),
    motion("explicit beam COR", TIP, "f32", partial(beam, "COR"), 0.2, mean_displacement, **FALL),
    motion("explicit beam SVK", TIP, "f32", partial(beam, "SVK"), 0.2, mean_displacement, **FALL),
    motion("implicit beam SNH", TIP, "f32", beam, 0.2, mean_displacement, quick=True, **SWING),
    motion("explicit slope", SLOPE, "f32", cube_on_slope, 0.4, slide_distance, slid(0.4), integrator="symplectic_euler", dt=8e-4),
    demo("cube_on_box", "f32", 0.5),
    Case("search, two cubes", GAP, "f32", partial(search, cubes_setup(3)), lambda _: [-DEEP_PENETRATION / 3], 1e-6, quick=True),
    Case("search, sheet and cube", GAP, "f32", partial(search, SHEET), lambda arch: [-2e-4], 1e-6),
    Case("self-collision", GAP, "f32", self_collision, lambda arch: [2 * RADIUS - THICK], 1e-9),
    motion("implicit slope", SLOPE, "f64", cube_on_slope, 0.4, slide_distance, slid(0.4), integrator="implicit_euler", dt=0.01),
    motion("implicit beam COR", TIP, "f64", partial(beam, "COR"), 0.2, mean_displacement, **SWING),
    motion("implicit beam SVK", TIP, "f64", partial(beam, "SVK"), 0.2, mean_displacement, **SWING),
    motion("quadratic beam", TIP, "f64", partial(beam, "SNH", (4, 1, 1), 2), 0.2, mean_displacement, **SWING),
    *(
        Case(
            f"static beam, order {order}",
            "mean displacement of the nodes; reference: a solution to 1e-12",
            "f64",
            partial(static, 1e-6, order),
            lambda arch, order=order: static(1e-12, order, arch).measured,
            1e-8,
        )
        for order in (1, 2)
    ),
    Case(
        "contact problem",
        "sums of the normal impulses; reference: a solution to 1e-13",
        "f64",
        contact_problem,
        tight_contact_problem,
        1e-8,
        quick=True,
    ),
)
