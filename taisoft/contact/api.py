"""`solve_contact_problem`: solve a frictional contact problem given as a matrix."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.contact import SOLVERS, augmented_lagrangian
from taisoft.contact.colouring import colour_greedy, matrix_graph, store
from taisoft.contact.problem import ContactProblem, build_matrix_problem, fill_matrix_problem
from taisoft.contact.solve import solve
from taisoft.display import short_repr
from taisoft.errors import SceneError
from taisoft.scene.checks import array, choice, number

METHODS = (*SOLVERS, "augmented_lagrangian", "auto")
AUTO_SWEEPS = 100  # of Gauss-Seidel, before "auto" switches to an augmented Lagrangian
KERNEL_TOLERANCE = 0.999  # of the tolerance: the kernels stop slightly below it, since their sums round differently from NumPy's


@dataclass(frozen=True)
class ContactSolution:
    """Result of `solve_contact_problem`.

    impulse: (3k,) [N s]. residual: |r - prox(r - f (W r + b))| / |r|, recomputed for `impulse`; converged: whether it is
    within the tolerance. residual_history: at the start and after each iteration; its last entry can exceed `residual`, since
    the best impulses are returned. iterations: sweeps, and outer iterations of the augmented Lagrangian.
    """

    impulse: np.ndarray
    residual: float
    residual_history: list[float]
    iterations: int
    converged: bool

    __repr__ = short_repr


def solve_contact_problem(
    W, b, mu, method: str = "gauss_seidel", tolerance: float = 1e-8, max_iterations: int = 1000
) -> ContactSolution:
    """Find impulses r that satisfy the laws of Signorini and Coulomb with u = W r + b, in float64.

    W: (3k,3k) array or scipy sparse matrix [1/kg], per contact (normal, t1, t2); it may be singular and slightly unsymmetric.
    b: (3k,) velocities without impulses [m/s]. mu: (k,) coefficients of friction. k may be 0. tolerance: bound on the residual
    |r - prox(r - f u)| / |r|, f = 1 / W_nn for normals, 1 / max(W_t1t1, W_t2t2) for both tangents. method:
        gauss_seidel, jacobi, hybrid, coloured_gauss_seidel    sweeps, with momentum;
        augmented_lagrangian    Newton's method on the host; each outer iteration counts as one;
        auto    Gauss-Seidel sweeps, then an augmented Lagrangian, which needs few iterations from there.
    A contact with W_nn = 0 cannot be moved: it is left out and its impulse is 0. W_nn < 0 is an error.
    Raises SceneError for invalid input.
    """
    W, b, mu = _checked(W, b, mu)
    choice(method, "method", METHODS)
    number(tolerance, "tolerance", above=0.0)
    if isinstance(max_iterations, bool) or not isinstance(max_iterations, (int, np.integer)) or max_iterations < 1:
        raise SceneError(f"max_iterations must be a whole number of at least 1, not {max_iterations!r}")
    auto, limit = method == "auto", int(max_iterations)
    first, sweeps = ("gauss_seidel", min(AUTO_SWEEPS, limit)) if auto else (method, limit)
    r, history = _run(first, W, b, mu, np.zeros((len(mu), 3)), tolerance, sweeps)
    remaining = limit + 1 - len(history)
    if auto and remaining and history[-1] > tolerance:
        r, outer = _run("augmented_lagrangian", W, b, mu, r, tolerance, remaining)
        history += outer[1:]
    residual = augmented_lagrangian.find_residual(W, b, mu, r)
    return ContactSolution(r.ravel(), residual, history, len(history) - 1, residual <= tolerance)


def _checked(W, b, mu) -> tuple[sp.csr_matrix, np.ndarray, np.ndarray]:
    if not sp.issparse(W):
        W = np.asarray(W)
        W = W.reshape(0, 0) if W.size == 0 else W
    if W.ndim != 2 or W.shape[0] != W.shape[1] or W.shape[0] % 3:
        raise SceneError(f"W has shape {W.shape}: it must be (3k, 3k), three rows per contact")
    if W.dtype.kind not in "fiu":
        raise SceneError(f"W must hold real numbers, not {W.dtype}")
    W = sp.csr_matrix(W, dtype=np.float64, copy=True)
    W.sum_duplicates()
    entries = W.tocoo()
    bad = np.flatnonzero(~np.isfinite(entries.data))
    if len(bad):
        raise SceneError(f"W[{entries.row[bad[0]]}, {entries.col[bad[0]]}] is {entries.data[bad[0]]}, not finite")
    negative = np.flatnonzero(W.diagonal() < 0.0)
    if len(negative):
        i = negative[0]
        raise SceneError(f"W[{i}, {i}] is {W[i, i]:g}: it cannot be negative, since an impulse must not pull its contact back")
    n = W.shape[0]
    b, mu = array(b, "b", ((n,),)), array(mu, "mu", ((n // 3,),))
    negative = np.flatnonzero(mu < 0.0)
    if len(negative):
        raise SceneError(f"mu[{negative[0]}] is {mu[negative[0]]:g}: a coefficient of friction cannot be negative")
    return W, b, mu


def _run(method: str, W, b, mu, r: np.ndarray, tolerance: float, max_iterations: int) -> tuple[np.ndarray, list[float]]:
    """Impulses (k,3) from the start r, and the residual at the start and after each iteration."""
    if not len(mu):
        return r, [0.0]
    if method == "augmented_lagrangian":
        return augmented_lagrangian.solve(W, b, mu, r, tolerance, max_iterations)
    with _problem(W, b, mu) as p:
        if method == "coloured_gauss_seidel":
            store(p, colour_greedy(matrix_graph(W)))
        result = solve(p, method, KERNEL_TOLERANCE * tolerance, max_iterations, every=1, history=True)
        return p.r.to_numpy(len(mu)), result.history


@contextmanager
def _problem(W: sp.csr_matrix, b: np.ndarray, mu: np.ndarray) -> Iterator[ContactProblem]:
    """The problem in fields with zero impulses, on the open runtime or a new one."""
    arch, precision = open_kind() or ("cpu", "f64")
    runtime = open_runtime(arch, precision, "solve_contact_problem")
    try:
        W = W.tobsr((3, 3))
        p = build_matrix_problem(FieldArena(), len(mu), len(W.indices), runtime.on_cpu)
        fill_matrix_problem(p, W, b, mu)
        yield p
    finally:
        runtime.close()
