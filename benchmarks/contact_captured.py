"""Contact problems of explicit steps, taken where their solve would begin, and solved by every solver from one start.

Each solve is judged in NumPy, from the fields that say what the problem is: J from nodes, weights and frames, W = J M^-1 J^T,
and the residual |r - prox(r - f (W r + b))| / |r| of what the solver left.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.contact import SOLVERS
from taisoft.contact.augmented_lagrangian import find_residual
from taisoft.contact.colouring import colour_contacts
from taisoft.contact.problem import NODES, ContactProblem
from taisoft.contact.solve import solve
from taisoft.dynamics import explicit_contact_stepper
from taisoft.dynamics.explicit_contact_stepper import MAX_SWEEPS

GOAL = 1e-4  # residual, that of explicit steps in f32
SERIAL, COLOURED = "gauss_seidel", "coloured_gauss_seidel"
THREADED = ", all threads"  # behind the name of a solver whose loops run on all threads


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


def clock() -> float:
    """Now [s], when the machine has done all it was told."""
    ti.sync()
    return time.perf_counter()


@contextmanager
def patched(owner, name: str, value) -> Iterator[None]:
    """An attribute of an object or a module has this value meanwhile."""
    own, before = name in vars(owner), getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)


@contextmanager
def shown(look: Callable[[ContactProblem], None]) -> Iterator[None]:
    """Each contact problem of explicit steps is shown to `look` when its solve would begin; it must leave it as it was."""
    plain = explicit_contact_stepper.solve

    def looked_at(p, *rest):
        look(p)
        return plain(p, *rest)

    with patched(explicit_contact_stepper, "solve", looked_at):
        yield


# --- the judge --------------------------------------------------------------------------------------------------------


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


def make_judge(p: ContactProblem) -> Callable[[np.ndarray], float]:
    """The residual of impulses (k,3) in this problem."""
    k = int(p.count[0])
    J, b, mu = contact_jacobian(p), p.b.to_numpy()[:k].ravel(), p.friction.to_numpy()[:k]
    W = (J @ sp.diags(p.inverse_mass.to_numpy().ravel()) @ J.T).tocsr()
    return lambda r: find_residual(W, b, mu, r)


# --- the solvers ------------------------------------------------------------------------------------------------------


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
        judge, found = make_judge(p), {name: Outcome() for name in names}
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
