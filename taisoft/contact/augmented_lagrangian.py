"""Augmented Lagrangian for a W given as a matrix, on the host, separately for each island of contacts that W couples.

An outer iteration takes r to the solution of r+ = prox(r - R (W r+ + b)), R = rho F with F the r-factors: a proximal step, in
which W + R^-1 replaces W and is invertible even if W is singular. Newton's method solves
    G(q) = q - prox(q - F (W' q + b')) = 0,   W' = W + R^-1,   b' = b - R^-1 r,
with the derivative of the prox, including that of the disk's radius in q_n. Full steps are taken first: the residual of a
nonsmooth system may have to rise before the contacts that slip, stick and separate are found; a line search delays that.
If full steps fail, a second attempt damps them. If that fails too, rho shrinks: the smaller it is, the closer r+ is to r and the
easier to find. rho grows again on success.
The problem is that of `problem`, in NumPy, with impulses r (k,3).
Sources: Alart and Curnier 1991 for the laws as a prox and their derivative; Rockafellar 1976 for the outer iteration.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from taisoft.contact.colouring import matrix_graph
from taisoft.ranges import owners

DENSE = 90  # largest island, in rows, with a dense solve; that of a larger one may run on several threads
RHO_START, RHO_MAX, RHO_MIN = 1e4, 1e7, 1e-2
MAX_STEPS = 10  # Newton steps of an outer iteration
REDUCTION = 1e-2  # of |G| in an outer iteration
MAX_HALVINGS = 6


# --- the problem ------------------------------------------------------------------------------------------------------


def find_factors(W: sp.spmatrix) -> np.ndarray:
    """r-factors (k,2) of normal and tangents from the diagonal of W (3k,3k); 0 where the diagonal is not positive."""
    d = W.diagonal().reshape(-1, 3)
    d = np.stack([d[:, 0], d[:, 1:].max(axis=1, initial=0.0)], axis=1)
    return np.divide(1.0, d, out=np.zeros_like(d), where=d > 0.0)


def prox(z: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Project z (k,3) to admissible impulses (k,3): first the normal part, then the tangential part onto its friction disk."""
    found = z.copy()
    np.maximum(z[:, 0], 0.0, out=found[:, 0])
    size, radius = np.hypot(z[:, 1], z[:, 2]), friction * found[:, 0]
    slips = size > radius
    found[slips, 1:] *= (radius[slips] / size[slips])[:, None]
    return found


def natural_map(u: np.ndarray, friction: np.ndarray, factor: np.ndarray, r: np.ndarray) -> np.ndarray:
    """r - prox(r - f u) at velocities u (k,3), (k,3)."""
    return r - prox(r - factor[:, [0, 1, 1]] * u, friction)


def relative(changed: float, size: float) -> float:
    """Residual from |r - prox(r - f u)| and |r|; 1 if r is 0 but not a solution."""
    return changed / size if size > 0.0 else float(changed != 0.0)


def find_residual(W, b: np.ndarray, friction: np.ndarray, r: np.ndarray) -> float:
    """|r - prox(r - f (W r + b))| / |r|, f of `find_factors`."""
    return residual_at((W @ r.ravel() + b).reshape(-1, 3), friction, find_factors(W), r)


def residual_at(u: np.ndarray, friction: np.ndarray, factor: np.ndarray, r: np.ndarray) -> float:
    """|r - prox(r - f u)| / |r| at velocities u (k,3)."""
    return float(relative(np.linalg.norm(natural_map(u, friction, factor, r)), np.linalg.norm(r)))


# --- the method -------------------------------------------------------------------------------------------------------


@dataclass
class _Island:
    """Contacts that W couples with one another and with no others."""

    contact: np.ndarray  # (k,)
    W: sp.bsr_matrix  # (3k,3k)
    row: np.ndarray  # (blocks,) contact of each block of W
    diagonal: np.ndarray  # (k,) indices of the diagonal blocks of W
    b: np.ndarray  # (3k,)
    friction: np.ndarray  # (k,)
    factor: np.ndarray  # (k,2)
    rho: float = RHO_START
    r: np.ndarray = field(init=False)  # (k,3)
    changed: float = field(init=False)  # |r - prox(r - f u)|
    size: float = field(init=False)  # |r|

    @property
    def residual(self) -> float:
        return relative(self.changed, self.size)

    def take(self, r: np.ndarray) -> None:
        self.r, self.size = r, float(np.linalg.norm(r))
        u = (self.W @ r.ravel() + self.b).reshape(-1, 3)
        self.changed = float(np.linalg.norm(natural_map(u, self.friction, self.factor, r)))


def solve(
    W: sp.csr_matrix,
    b: np.ndarray,
    friction: np.ndarray,
    r: np.ndarray,
    tolerance: float,
    max_iterations: int,
    is_over: Callable[[], bool] = lambda: False,
) -> tuple[np.ndarray, list[float]]:
    """Return impulses (k,3), starting from r (k,3), and the residual at the start and after each outer iteration.

    W: (3k,3k), may be singular and slightly unsymmetric; b: (3k,). tolerance: bound on the residual.
    is_over: whether to end before the next iteration.
    """
    islands = _islands(W, b, friction, prox(r, friction))
    history = [_residual(islands)]
    while history[-1] > tolerance and len(history) <= max_iterations and not is_over():
        size = sum(i.size**2 for i in islands)
        for island in islands:
            # if every island is below this, their sum is below the tolerance
            if island.changed**2 > 0.5 * tolerance**2 * max(island.size**2, size / len(islands)):
                _advance(island)
        history.append(_residual(islands))
    result = np.zeros((len(friction), 3))
    for island in islands:
        result[island.contact] = island.r
    return result, history


def _residual(islands: list[_Island]) -> float:
    return relative(sum(i.changed**2 for i in islands) ** 0.5, sum(i.size**2 for i in islands) ** 0.5)


def _islands(W: sp.csr_matrix, b: np.ndarray, friction: np.ndarray, r: np.ndarray) -> list[_Island]:
    """The islands of all movable contacts; the impulses of the others stay 0."""
    factor = find_factors(W)
    # a tangential factor of 0 means that tangents do not matter; Newton's method needs a positive one
    factor[:, 1] = np.where(factor[:, 1] > 0.0, factor[:, 1], factor[:, 0])
    count, island_of = connected_components(matrix_graph(W), directed=False)
    movable = np.flatnonzero(factor[:, 0] > 0.0)
    order = movable[np.argsort(island_of[movable], kind="stable")]
    islands = []
    for contact in np.split(order, np.flatnonzero(np.diff(island_of[order])) + 1) if len(order) else []:
        rows = (3 * contact[:, None] + np.arange(3)).ravel()
        part = W[rows][:, rows].tobsr((3, 3))
        row = owners(np.diff(part.indptr))
        diagonal = np.flatnonzero(part.indices == row)
        islands.append(_Island(contact, part, row, diagonal, b[rows], friction[contact], factor[contact]))
        islands[-1].take(r[contact])
    return islands


def _advance(i: _Island) -> None:
    """One outer iteration of an island."""
    q, converged = _newton(i, damped=False)
    if not converged:
        q, converged = _newton(i, damped=True)
    previous, residual = i.r, i.residual
    i.take(prox(q, i.friction))
    better = i.residual <= residual
    # with a small rho the proximal step approaches the solution in its own norm, even if the residual rises
    if converged and (better or i.rho <= 100.0):
        i.rho = min(RHO_MAX, i.rho * (10.0 if better else 3.0))
    elif not i.residual < 0.5 * residual:
        i.take(previous)
        i.rho = max(RHO_MIN, 0.1 * i.rho)


def _newton(i: _Island, damped: bool) -> tuple[np.ndarray, bool]:
    """Return q (k,3) with a small G(q), and whether it was found. damped: halve steps until |G| decreases."""
    f = i.factor[:, [0, 1, 1]].ravel()
    weight, R_inverse = 1.0 / np.sqrt(f), 1.0 / (i.rho * f)
    q = i.r.ravel()
    b = i.b - R_inverse * q

    def evaluate(q: np.ndarray):
        G, D = _linearise(q, f * (i.W @ q + R_inverse * q + b), i.friction)
        return G, D, np.linalg.norm(weight * G)

    G, D, size = evaluate(q)
    target = REDUCTION * size
    for _ in range(MAX_STEPS):
        if not size > target:
            break
        step = _step(i, R_inverse, f, G, D)
        if step is None or not np.all(np.isfinite(step)):
            return q.reshape(-1, 3), False
        length = 1.0
        for _ in range(MAX_HALVINGS if damped else 1):
            trial = q + length * step
            new = evaluate(trial)
            if new[2] < (1.0 - 1e-4 * length) * size:
                break
            length *= 0.5
        else:
            if damped:
                return q.reshape(-1, 3), False
        q, (G, D, size) = trial, new
    return q.reshape(-1, 3), bool(size <= target)


def _linearise(q: np.ndarray, change: np.ndarray, friction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """G (3k,) = q - prox(z), z = q - change, and the derivative D (k,3,3) of prox at z."""
    z = (q - change).reshape(-1, 3)
    p = prox(z, friction)
    closed = z[:, 0] > 0.0
    size = np.hypot(z[:, 1], z[:, 2])
    slips = closed & (size > p[:, 0] * friction)
    D = np.zeros((len(z), 3, 3))
    D[closed, 0, 0] = 1.0
    sticks = closed & ~slips
    D[sticks, 1, 1] = D[sticks, 2, 2] = 1.0
    e = z[slips, 1:] / size[slips, None]
    scale = friction[slips] * z[slips, 0] / size[slips]
    D[slips, 1:, 1:] = scale[:, None, None] * (np.eye(2) - e[:, :, None] * e[:, None, :])
    D[slips, 1:, 0] = friction[slips, None] * e
    return q - p.ravel(), D


def _step(i: _Island, R_inverse: np.ndarray, f: np.ndarray, G: np.ndarray, D: np.ndarray) -> np.ndarray | None:
    """Newton step (3k,): (1 - D (1 - F W')) step = -G; None if the system is singular.

    Where D is 0, the contact is open, and its step -G; only the others are unknown.
    """
    k = len(D)
    blocks = i.W.data.copy()
    blocks[i.diagonal] += R_inverse.reshape(k, 3, 1) * np.eye(3)
    blocks = (D * f.reshape(k, 1, 3))[i.row] @ blocks
    blocks[i.diagonal] += np.eye(3) - D
    try:
        if 3 * k > DENSE:
            closed, step = np.repeat(D.any(axis=(1, 2)), 3), -G
            rows = sp.bsr_matrix((blocks, i.W.indices, i.W.indptr)).tocsr()[closed].tocsc()
            step[closed] = splu(rows[:, closed]).solve(rows[:, ~closed] @ G[~closed] - G[closed])
            return step
        J = np.zeros((k, k, 3, 3))
        J[i.row, i.W.indices] = blocks
        return np.linalg.solve(J.transpose(0, 2, 1, 3).reshape(3 * k, 3 * k), -G)
    except (np.linalg.LinAlgError, RuntimeError):  # RuntimeError: splu says "exactly singular"
        return None
