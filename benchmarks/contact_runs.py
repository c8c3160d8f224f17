"""What `contact.py` measures: contact problems of explicit steps, solved by every solver; costs of steps; implicit runs.

A film goes on from the first impulse, frame after frame; of each frame the contact problem of its last step is taken where its
solve would begin, and solved by every solver, from the impulses of the step before and from none. Each solve is judged in NumPy,
from the fields that say what the problem is: J from nodes, weights and frames, W = J M^-1 J^T, and the residual
|r - prox(r - f (W r + b))| / |r| of what the solver left. The steps themselves are those of the default solver.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.contact import SOLVERS
from taisoft.contact.augmented_lagrangian import find_residual
from taisoft.contact.colouring import colour_contacts
from taisoft.contact.problem import NODES, ContactProblem
from taisoft.contact.solve import solve
from taisoft.dynamics import explicit_contact_stepper
from taisoft.dynamics.explicit_contact_stepper import MAX_SWEEPS

from .runner import REST, Stopwatch, clock, patched, timed

GOAL = 1e-4  # residual, that of explicit steps in f32
SERIAL, COLOURED = "gauss_seidel", "coloured_gauss_seidel"
THREADED = ", all threads"  # behind the name of a solver whose loops run on all threads
DT, FPS = 1 / 240, 60.0  # of explicit steps and films [s, 1/s]
LATEST = 2.0  # [s] by which bodies must have met
WARM, COLD = "from the step before", "from none"
ROUNDS, COLD_ROUNDS = 3, 1
SETTINGS = ("integrator", "contact_solver", "contact_tolerance", "newton_tolerance", "linear_tolerance", "dt")
# parts of an explicit step: what is called, where it is looked up
PARTS = {
    "search": ("find", "closing"),
    "problem": ("begin", "set_free_velocities", "find_factors"),
    "solve": ("colour_contacts", "solve"),
    "elasticity": ("keep_state", "predict", "move"),
}


# --- problems -----------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """A solver on one problem. residual: the judge's; seconds: of each round, those of the colouring included."""

    sweeps: int = 0
    residual: float = 0.0
    seconds: list[float] = field(default_factory=list)
    colouring: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Of the rounds [s]."""
        return float(np.median(self.seconds))

    @property
    def per_sweep(self) -> float:
        """A sweep's share of what the colouring leaves [s]."""
        return float(np.median(np.subtract(self.seconds, self.colouring))) / max(1, self.sweeps)


@contextmanager
def observe_problems(observe: Callable[[ContactProblem], None]) -> Iterator[None]:
    """Each contact problem of explicit steps is shown to `look` when its solve would begin; it must leave it as it was."""
    plain = explicit_contact_stepper.solve

    def observed(p, *rest):
        observe(p)
        return plain(p, *rest)

    with patched(explicit_contact_stepper, "solve", observed):
        yield


def contact_jacobian(p: ContactProblem) -> sp.csr_matrix:
    """J (3k, 3 n_nodes): velocities of nodes to those of contacts, rows (normal, t1, t2) of each."""
    k = int(p.count[0])
    node, weight = p.node.to_numpy()[:k], p.weight.to_numpy()[:k]
    normal, tangent = p.normal.to_numpy()[:k], p.tangent.to_numpy()[:k]
    frame = np.stack([normal, tangent, np.cross(normal, tangent)], axis=1)
    c, j = np.nonzero(np.arange(NODES) < p.arity.to_numpy()[:k, None])
    row, column = (3 * c)[:, None, None] + np.arange(3)[:, None], (3 * node[c, j])[:, None, None] + np.arange(3)
    row, column = np.broadcast_arrays(row, column)
    entries = weight[c, j][:, None, None] * frame[c]
    return sp.csr_matrix((entries.ravel(), (row.ravel(), column.ravel())), shape=(3 * k, 3 * p.n_nodes))


def make_residual(p: ContactProblem) -> Callable[[np.ndarray], float]:
    """The residual of impulses (k,3) in this problem."""
    k = int(p.count[0])
    J, b, mu = contact_jacobian(p), p.b.to_numpy()[:k].ravel(), p.friction.to_numpy()[:k]
    W = (J @ sp.diags(p.inverse_mass.to_numpy().ravel()) @ J.T).tocsr()
    return lambda r: find_residual(W, b, mu, r)


class Solvers:
    """The solvers by name, on the problems of one simulator.

    threads: also those whose loops run on all threads, where the simulator's own run on one.
    """

    def __init__(self, threads: bool):
        self._threads, self._of, self._at_once = threads, None, None

    def names(self, p: ContactProblem) -> list[str]:
        """Of the solvers that `p` is solved by."""
        threaded = [f"{name}{THREADED}" for name in SOLVERS if name != SERIAL] if self._threads and p.serial else []
        return [*SOLVERS, *threaded]

    def _form(self, p: ContactProblem, name: str) -> tuple[ContactProblem, str]:
        if not name.endswith(THREADED):
            return p, name
        if self._of is not p:  # kernels are compiled for each form
            self._of, self._at_once = p, replace(p, serial=False)
        return self._at_once, name.removesuffix(THREADED)

    def outcomes(
        self, p: ContactProblem, start: np.ndarray, rounds: int, names: Iterable[str] | None = None
    ) -> dict[str, Outcome]:
        """Solve `p` to GOAL from the impulses `start` (capacity, 3) by each solver, in turns; `p` is left as it was."""
        r, order, k = p.r.to_numpy(), p.order.to_numpy(), int(p.count[0])
        names = self.names(p) if names is None else list(names)
        judge, found = make_residual(p), {name: Outcome() for name in names}
        for _ in range(rounds):
            for name in names:
                form, method = self._form(p, name)
                p.r.from_numpy(start)
                p.order.from_numpy(order)
                begin = clock()
                if method == COLOURED:
                    colour_contacts(form)
                coloured = clock()
                result = solve(form, method, GOAL, MAX_SWEEPS)
                found[name].seconds.append(clock() - begin)
                found[name].colouring.append(coloured - begin)
                found[name].sweeps = result.iterations
                found[name].residual = judge(p.r.to_numpy()[:k])
        p.r.from_numpy(r)
        p.order.from_numpy(order)
        return found


# --- scenes -------------------------------------------------------------------------------------------------------------


@dataclass
class Film:
    """Frames of an explicit run. outcomes: start -> solver -> of each frame; found: contacts before their reduction."""

    scene: str
    tets: int
    dt: float
    stable_dt: float
    time: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    found: list[int] = field(default_factory=list)
    outcomes: dict[str, dict[str, list[Outcome]]] = field(default_factory=lambda: {WARM: {}, COLD: {}})

    @property
    def solvers(self) -> list[str]:
        """Their names."""
        return list(self.outcomes[WARM])

    def of(self, solver: str, start: str = WARM) -> list[Outcome]:
        """A solver's outcomes, frame by frame."""
        return self.outcomes[start][solver]

    def missed(self, solvers: list[str]) -> int:
        """Solves by these whose residual is above GOAL, by the judge; its sums round otherwise than the kernels'."""
        return sum(not o.residual <= 1.001 * GOAL for name in solvers for start in self.outcomes for o in self.of(name, start))


@dataclass
class StepCost:
    """Explicit steps from the first impulse on. whole: wall seconds of each `step`, its report included; parts: of the same
    steps, done again."""

    scene: str
    solver: str
    whole: list[float]
    parts: dict[str, list[float]]
    contacts: list[int]
    sweeps: list[int]
    residual: float
    problems: list[str]


@dataclass
class Run:
    """An implicit run: lists over its steps with contacts; wall: of all steps, without compiling."""

    scene: str
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


def open_scene(name: str, arch: str, refine: int | None = None, **settings) -> ts.Simulator:
    """A simulator of a demo's scene in f32, refined so often; settings as they are, else the demo's own."""
    scene, own = load_scene(name, refine=refine)
    settings = settings or {key: own[key] for key in SETTINGS if key in own}
    return ts.Simulator(scene, precision="f32", arch=arch, **settings)


def open_explicit(name: str, arch: str, refine: int | None = None) -> ts.Simulator:
    """The same in explicit steps."""
    return open_scene(name, arch, refine, dt=DT, integrator="symplectic_euler")


def to_impulses(sim: ts.Simulator) -> None:
    """Step until contacts bear something, if they do not. Raises SimulationError where that takes too long."""
    last = sim.time + LATEST
    while not sim._dynamics.contact.problem.r.to_numpy()[: sim._dynamics.contact.n_contacts].any():
        if sim.time > last:
            raise ts.SimulationError(f"no contact bears anything within {LATEST:g} s")
        sim.step()


def measure_film(name: str, sim: ts.Simulator, frames: int, solvers: Solvers) -> Film:
    """A film of so many frames; those whose contacts need no impulse are left out."""
    tets = sum(body.mesh.n_tets for body in sim.scene.bodies)
    film = Film(name, tets, sim.dt, sim.stable_dt)
    known: list[ContactProblem] = []

    def observe(p: ContactProblem) -> None:
        if p not in known:  # the first, or one with more room
            known.append(p)
            solvers.outcomes(p, p.r.to_numpy(), 1)  # compiles
        if make_residual(p)(np.zeros((int(p.count[0]), 3))) == 0.0:
            return
        for start, rounds, r in ((WARM, ROUNDS, p.r.to_numpy()), (COLD, COLD_ROUNDS, np.zeros((p.capacity, 3)))):
            for solver, outcome in solvers.outcomes(p, r, rounds).items():
                film.outcomes[start].setdefault(solver, []).append(outcome)
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


def explicit_places(sim: ts.Simulator) -> list[tuple[str, object, str]]:
    """Where the parts of the simulator's explicit steps are called, for `Stopwatch.on`."""
    contact = sim._dynamics.contact
    owners = {"find": contact.detection, "closing": contact.measures, "begin": contact}
    return [(part, owners.get(name, explicit_contact_stepper), name) for part, names in PARTS.items() for name in names]


def measure_step(name: str, sim: ts.Simulator, steps: int) -> StepCost:
    """What a step costs from the first impulse on; then the same steps again for their parts."""
    sim.reset()
    to_impulses(sim)
    cost = StepCost(name, sim._dynamics.stepper.method, [], {part: [] for part in (*PARTS, REST)}, [], [], 0.0, [])
    for _ in range(steps):
        begin = clock()
        report = sim.step()
        cost.whole.append(clock() - begin)
        cost.contacts.append(report.n_contacts)
        cost.sweeps.append(report.contact_iterations)
        cost.residual = max(cost.residual, report.contact_residual)
        cost.problems += report.problems
    sim.reset()
    to_impulses(sim)
    watch = Stopwatch()
    with watch.on(explicit_places(sim)):
        for _ in range(steps):
            spent = watch.parts_of(sim.step)
            for part, seconds in cost.parts.items():
                seconds.append(spent.get(part, 0.0))
    return cost


def measure_run(name: str, sim: ts.Simulator, seconds: float) -> Run:
    """Some seconds of the demo's own implicit steps."""
    spent: list[float] = []
    plain = sim.advance

    def advance(n: int):
        report, seconds = timed(lambda: plain(n))
        spent.append(seconds)
        return report

    with patched(sim, "advance", advance):
        done = sim.run(seconds, fps=None)
    s = sim.settings
    run = Run(name, f"{s.integrator}, dt = {1e3 * s.dt:.3g} ms", done.status, done.problems, done.sim_seconds, done.wall_seconds)
    for report, took in zip(done.step_reports, spent):
        if report.n_contacts:
            run.seconds.append(took)
            run.contacts.append(report.n_contacts)
            run.outer.append(report.contact_iterations)
            run.newton.append(report.newton_iterations)
            run.linear.append(report.linear_iterations)
    return run
