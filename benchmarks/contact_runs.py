"""Measurements of `contact.py`: contact problems of explicit steps with every solver, whole steps by kind, implicit runs.

A film starts at the first impulse. In each frame, every solver solves the contact problem of the last step, from the impulses of
the previous step; the run itself continues with the default solver. NumPy computes the residual of each solution,
|r - prox(r - f (W r + b))| / |r| with W = J M^-1 J^T, from the fields of the problem.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.sparse as sp

import taisoft as ts
from taisoft.cli.scene_file import load_scene, shipped_folder
from taisoft.contact import SOLVERS
from taisoft.contact.augmented_lagrangian import find_residual
from taisoft.contact.colouring import colour_contacts
from taisoft.contact.matrix_contacts import jacobian
from taisoft.contact.problem import ContactProblem
from taisoft.contact.solve import solve
from taisoft.dynamics import explicit_contact_stepper
from taisoft.dynamics.explicit_batch import Batch
from taisoft.dynamics.explicit_contact_stepper import MAX_SWEEPS

from .kinds import watching
from .runner import clock, patched

GOAL = 1e-4  # residual, that of explicit steps in f32
SERIAL, COLOURED = "gauss_seidel", "coloured_gauss_seidel"
EXPLICIT, FPS = {"dt": 1 / 240, "integrator": "symplectic_euler"}, 60.0  # steps and frames of films [s, 1/s]
LATEST = 2.0  # [s] time limit for the first impulse
ROUNDS = 3
SETTINGS = ("integrator", "contact_solver", "contact_tolerance", "newton_tolerance", "linear_tolerance", "dt")
MESHES = Path(__file__).resolve().parents[1].parent / "shared" / "meshes"  # beside the repository
DROPPED = {"bunny": "bunny.msh", "bar": "bar-2523.msh", "octocat": "octocat.msh", "Armadillo": "Armadillo13K.msh"}
HEIGHT, DROP_DT = 0.05, 0.01  # from which the meshes, 1 m large, fall [m]; their steps [s]


# --- problems -----------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """A solver on one problem. residual: by NumPy; seconds: per round, including the colouring."""

    sweeps: int = 0
    residual: float = 0.0
    seconds: list[float] = field(default_factory=list)
    colouring: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Median over the rounds [s]."""
        return float(np.median(self.seconds))

    @property
    def per_sweep(self) -> float:
        """Time per sweep without colouring [s]."""
        return float(np.median(np.subtract(self.seconds, self.colouring))) / max(1, self.sweeps)


@contextmanager
def observe_problems(observe: Callable[[ContactProblem], None]) -> Iterator[None]:
    """Context that calls observe(problem) before each contact solve of explicit steps; it must not change the problem."""
    plain = explicit_contact_stepper.begin_solve

    def observed(p, *rest):
        observe(p)
        return plain(p, *rest)

    with patched(explicit_contact_stepper, "begin_solve", observed), patched(Batch, "suits", lambda self: False):
        yield


def make_residual(p: ContactProblem) -> Callable[[np.ndarray], float]:
    """A function that returns the residual of impulses (k,3) in this problem."""
    k = int(p.count[0])
    J, b, mu = jacobian(p), p.b.to_numpy()[:k].ravel(), p.friction.to_numpy()[:k]
    W = (J @ sp.diags(p.inverse_mass.to_numpy().ravel()) @ J.T).tocsr()
    return lambda r: find_residual(W, b, mu, r)


def outcomes(p: ContactProblem, forms: dict[str, ContactProblem], start: np.ndarray, rounds: int = ROUNDS) -> dict[str, Outcome]:
    """Solve `p` to GOAL from the impulses `start` (capacity, 3) with solvers in turn; `p` is restored.

    forms: name of each solver -> the problem, or `replace(p, serial=False)` for loops on all threads.
    """
    r, order, k = p.r.to_numpy(), p.sweep.order.to_numpy(), int(p.count[0])
    residual_of, found = make_residual(p), {name: Outcome() for name in forms}
    for _ in range(rounds):
        for name, form in forms.items():
            p.r.from_numpy(start)
            p.sweep.order.from_numpy(order)
            begin = clock()
            if name == COLOURED:
                colour_contacts(form)
            coloured = clock()
            result = solve(form, name, GOAL, MAX_SWEEPS)
            found[name].seconds.append(clock() - begin)
            found[name].colouring.append(coloured - begin)
            found[name].sweeps = result.iterations
            found[name].residual = residual_of(p.r.to_numpy()[:k])
    p.r.from_numpy(r)
    p.sweep.order.from_numpy(order)
    return found


# --- scenes -------------------------------------------------------------------------------------------------------------


@dataclass
class Film:
    """Frames of an explicit run. outcomes: of each solver per frame; found: contacts before reduction."""

    scene: str
    tets: int
    dt: float
    stable_dt: float
    time: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    found: list[int] = field(default_factory=list)
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)

    def missed(self, solver: str) -> int:
        """Number of solves with a residual above GOAL; NumPy's sums round differently from the kernels'."""
        return sum(not outcome.residual <= 1.001 * GOAL for outcome in self.outcomes[solver])


def open_demo(name: str, arch: str, refine: int | None = None, geometry: str | None = None, **settings) -> ts.Simulator:
    """A simulator of a demo's scene in f32; without settings, with the demo's own. refine: number of refinements."""
    scene, own = load_scene(name, refine=refine)
    for body in scene.bodies:
        body.collision = geometry or body.collision
    settings = settings or {key: own[key] for key in SETTINGS if key in own}
    return ts.Simulator(scene, precision="f32", arch=arch, **settings)


def n_tets(sim: ts.Simulator) -> int:
    """Number of tets."""
    return sum(body.mesh.n_tets for body in sim.scene.bodies)


def to_impulses(sim: ts.Simulator) -> None:
    """Step until a contact has an impulse. Raises SimulationError after LATEST seconds."""
    last = sim.time + LATEST
    while not sim._dynamics.contact.problem.r.to_numpy()[: sim._dynamics.contact.n_contacts].any():
        if sim.time > last:
            raise ts.SimulationError(f"no contact has an impulse within {LATEST:g} s")
        sim.step()


def measure_film(name: str, sim: ts.Simulator, frames: int) -> Film:
    """A film of `frames` frames, without those whose contacts need no impulse."""
    film = Film(name, n_tets(sim), sim.dt, sim.stable_dt)
    known: list[ContactProblem] = []

    def observe(p: ContactProblem) -> None:
        forms = dict.fromkeys(SOLVERS, p)
        if p not in known:  # the first, or one with more room
            known.append(p)
            outcomes(p, forms, p.r.to_numpy(), 1)  # compiles
        if make_residual(p)(np.zeros((int(p.count[0]), 3))) == 0.0:
            return
        for solver, outcome in outcomes(p, forms, p.r.to_numpy()).items():
            film.outcomes.setdefault(solver, []).append(outcome)
        film.time.append(sim.time)
        film.contacts.append(int(p.count[0]))
        film.found.append(sim._dynamics.contact.detection.counts.found)

    sim.reset()
    to_impulses(sim)
    per_frame = max(1, round(1 / (FPS * sim.dt)))
    for _ in range(frames):
        for _ in range(per_frame - 1):
            sim.step()
        with observe_problems(observe):
            sim.step()
    return film


# --- whole steps --------------------------------------------------------------------------------------------------------


@dataclass
class Profile:
    """Steps from the first impulse on. whole: wall seconds of each `step` with its report; kinds: mean seconds by kind, see
    `kinds.py`, of the same steps when repeated."""

    scene: str
    integrator: str
    geometry: str
    dt: float
    whole: list[float] = field(default_factory=list)
    kinds: dict[str, float] = field(default_factory=dict)
    contacts: list[int] = field(default_factory=list)
    sweeps: list[int] = field(default_factory=list)
    residual: float = 0.0


@dataclass
class Run:
    """An implicit run: lists over its steps with contacts; wall: seconds of all steps without compilation."""

    scene: str
    tets: int
    settings: str
    status: str
    problems: list[str]
    simulated: float
    wall: float
    seconds: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    outer: list[int] = field(default_factory=list)
    newton: list[int] = field(default_factory=list)
    linear: list[int] = field(default_factory=list)


def measure_steps(name: str, sim: ts.Simulator, steps: int) -> Profile:
    """Steps from the first impulse on, then the same by kind."""
    found = Profile(name, sim.settings.integrator, sim.scene.bodies[0].collision, sim.dt)
    _to_contact(sim)  # compiles
    _to_contact(sim)
    for _ in range(steps):
        begin = clock()
        report = sim.step()
        found.whole.append(clock() - begin)
        found.contacts.append(report.n_contacts)
        found.sweeps.append(report.contact_iterations)
        found.residual = max(found.residual, report.contact_residual)
    _to_contact(sim)
    with watching() as spend:
        found.kinds = spend(lambda: [sim.step() for _ in range(steps)], steps).seconds
    return found


def _to_contact(sim: ts.Simulator) -> None:
    """Go from the start to the step after the first impulse."""
    sim.reset()
    to_impulses(sim)
    sim.step()


def measure_run(name: str, sim: ts.Simulator, seconds: float) -> Run:
    """Implicit steps for some seconds."""
    spent: list[float] = []
    done = sim.run(seconds, fps=None, on_step=lambda _report, took: spent.append(took))
    settings = f"{sim.settings.integrator}, dt = {1e3 * sim.dt:.3g} ms"
    run = Run(name, n_tets(sim), settings, done.status, done.problems, done.sim_seconds, done.wall_seconds)
    for report, took in zip(done.step_reports, spent):
        if report.n_contacts:
            run.seconds.append(took)
            run.contacts.append(report.n_contacts)
            run.outer.append(report.contact_iterations)
            run.newton.append(report.newton_iterations)
            run.linear.append(report.linear_iterations)
    return run


# --- real meshes --------------------------------------------------------------------------------------------------------


def real_meshes() -> dict[str, Path]:
    """Name and file of the meshes of DROPPED that are there: in assets, or in shared/meshes beside the repository."""
    folders = [folder for folder in (shipped_folder("assets"), MESHES) if folder]
    paths = {name: folder / file for folder in reversed(folders) for name, file in DROPPED.items() if (folder / file).is_file()}
    return {name: paths[name] for name in DROPPED if name in paths}


def open_drop(path: Path, arch: str) -> ts.Simulator:
    """A simulator of a real mesh, scaled to 1 m, that falls to the ground."""
    scene, mesh = ts.Scene(), ts.read_mesh(path)
    x = mesh.vertices / np.ptp(mesh.vertices, axis=0).max()
    rubber = ts.Material(young=2e5, poisson=0.4, density=1000.0, friction=0.5)
    scene.add_body(ts.TetMesh(x, mesh.tets), rubber, name="figure", position=(0.0, HEIGHT - x[:, 1].min(), 0.0))
    scene.add_ground(friction=0.5)
    return ts.Simulator(scene, dt=DROP_DT, integrator="implicit_euler", precision="f32", arch=arch)
