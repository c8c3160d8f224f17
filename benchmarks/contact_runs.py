"""Measurements of `contact.py`: contact problems of explicit steps with every solver.

A film starts at the first impulse. In each frame, every solver solves the contact problem of the last step, from the impulses of
the previous step and from zero; the run itself continues with the default solver. NumPy computes the residual of each solution,
|r - prox(r - f (W r + b))| / |r| with W = J M^-1 J^T, from the fields of the problem.
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
from taisoft.contact.matrix_contacts import jacobian
from taisoft.contact.problem import ContactProblem
from taisoft.contact.solve import solve
from taisoft.dynamics import explicit_contact_stepper
from taisoft.dynamics.explicit_contact_stepper import MAX_SWEEPS

from .runner import clock, patched

GOAL = 1e-4  # residual, that of explicit steps in f32
SERIAL, COLOURED = "gauss_seidel", "coloured_gauss_seidel"
THREADED = ", all threads"  # suffix of solvers whose loops run on all threads
EXPLICIT, FPS = {"dt": 1 / 240, "integrator": "symplectic_euler"}, 60.0  # steps and frames of films [s, 1/s]
LATEST = 2.0  # [s] time limit for the first impulse
WARM, COLD = "from the step before", "from none"
ROUNDS, COLD_ROUNDS = 3, 1
SETTINGS = ("integrator", "contact_solver", "contact_tolerance", "newton_tolerance", "linear_tolerance", "dt")


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
    plain = explicit_contact_stepper.solve

    def observed(p, *rest):
        observe(p)
        return plain(p, *rest)

    with patched(explicit_contact_stepper, "solve", observed):
        yield


def make_residual(p: ContactProblem) -> Callable[[np.ndarray], float]:
    """A function that returns the residual of impulses (k,3) in this problem."""
    k = int(p.count[0])
    J, b, mu = jacobian(p), p.b.to_numpy()[:k].ravel(), p.friction.to_numpy()[:k]
    W = (J @ sp.diags(p.inverse_mass.to_numpy().ravel()) @ J.T).tocsr()
    return lambda r: find_residual(W, b, mu, r)


class Solvers:
    """The solvers by name, for the problems of one simulator.

    threads: include solvers on all threads if the simulator's own run on one.
    """

    def __init__(self, threads: bool):
        self._threads, self._of, self._at_once = threads, None, None

    def names(self, p: ContactProblem) -> list[str]:
        """Names of the solvers for `p`."""
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
        """Solve `p` to GOAL from the impulses `start` (capacity, 3) with each solver in turn; `p` is restored."""
        r, order, k = p.r.to_numpy(), p.sweep.order.to_numpy(), int(p.count[0])
        names = self.names(p) if names is None else list(names)
        residual_of, found = make_residual(p), {name: Outcome() for name in names}
        for _ in range(rounds):
            for name in names:
                form, method = self._form(p, name)
                p.r.from_numpy(start)
                p.sweep.order.from_numpy(order)
                begin = clock()
                if method == COLOURED:
                    colour_contacts(form)
                coloured = clock()
                result = solve(form, method, GOAL, MAX_SWEEPS)
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
    """Frames of an explicit run. outcomes: start -> solver -> outcome per frame; found: contacts before reduction."""

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
        """Names of the solvers."""
        return list(self.outcomes[WARM])

    def of(self, solver: str, start: str = WARM) -> list[Outcome]:
        """Outcomes of a solver per frame."""
        return self.outcomes[start][solver]

    def missed(self, solvers: list[str]) -> int:
        """Number of solves with a residual above GOAL; NumPy's sums round differently from the kernels'."""
        return sum(not o.residual <= 1.001 * GOAL for name in solvers for start in self.outcomes for o in self.of(name, start))


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


def measure_film(name: str, sim: ts.Simulator, frames: int, solvers: Solvers) -> Film:
    """A film of `frames` frames, without those whose contacts need no impulse."""
    film = Film(name, n_tets(sim), sim.dt, sim.stable_dt)
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
