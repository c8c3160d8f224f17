"""Augmented Lagrangian for a W that is given as a matrix, on the host, by islands of contacts that W joins.

An outer iterate takes r to the solution of r+ = prox(r - R (W r+ + b)), R = rho F with F the r-factors: a proximal step, in which
W + R^-1 stands for W and can be inverted even where W is singular. Inside is Newton's method on
    G(q) = q - prox(q - F (W' q + b')),   W' = W + R^-1,   b' = b - R^-1 r,
with the derivative of the prox, friction disks that open with q_n included. Steps are taken whole: the residual of a nonsmooth
system must be let rise before the right contacts are found to slip, stick or part, and a line search on it holds that up.
Where whole steps lead nowhere, a second try damps them; where that fails too, rho shrinks, and the smaller it is, the nearer is
r+ to r and the easier to find. rho grows again with success.
Sources: Alart and Curnier 1991 for the laws as a prox and their derivative; Rockafellar 1976 for the outer iterates.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from taisoft.contact.graph import matrix_graph
from taisoft.contact.numpy_prox import find_factors, natural_map, prox, relative

DENSE = 90  # rows of an island up to which its equations are solved as a dense matrix; a larger one may be spread over threads
START, MOST, LEAST = 1e4, 1e7, 1e-2  # rho
STEPS = 10  # Newton steps of an outer iterate
GOAL = 1e-2  # share of |G| that they bring it down to
HALVINGS = 6


@dataclass
class _Island:
    """Contacts that W joins with one another, and with no others."""

    contact: np.ndarray  # (k,)
    W: sp.bsr_matrix  # (3k,3k)
    row: np.ndarray  # (blocks,) contact of each block of W
    diagonal: np.ndarray  # (k,) blocks of W on its diagonal
    b: np.ndarray  # (3k,)
    friction: np.ndarray  # (k,)
    factor: np.ndarray  # (k,2)
    r: np.ndarray  # (k,3)
    rho: float = START
    changed: float = 0.0  # |r - prox(r - f u)|
    size: float = 0.0  # |r|

    @property
    def residual(self) -> float:
        return relative(self.changed, self.size)

    def measure(self) -> None:
        self.changed = float(np.linalg.norm(natural_map(self.W, self.b, self.friction, self.factor, self.r)))
        self.size = float(np.linalg.norm(self.r))


def solve(
    W: sp.csr_matrix, b: np.ndarray, friction: np.ndarray, r: np.ndarray, tolerance: float, max_iterations: int
) -> tuple[np.ndarray, list[float]]:
    """Impulses (k,3) from the start r (k,3), and the residual at the start and after each outer iterate.

    W: (3k,3k), which may be singular and a little unsymmetric; b: (3k,). tolerance: of the residual.
    """
    islands = _islands(W, b, friction, prox(r, friction))
    history = [_residual(islands)]
    while history[-1] > tolerance and len(history) <= max_iterations:
        size = sum(i.size**2 for i in islands)
        for island in islands:
            # the islands' parts of the residual add up to less than it may be
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
    """The islands of all contacts that something can move; the others' impulses stay 0."""
    factor = find_factors(W)
    # a tangential factor of 0 says that tangents do not matter; Newton's method wants a number
    factor[:, 1] = np.where(factor[:, 1] > 0.0, factor[:, 1], factor[:, 0])
    count, label = connected_components(matrix_graph(W), directed=False)
    moved = np.flatnonzero(factor[:, 0] > 0.0)
    order = moved[np.argsort(label[moved], kind="stable")]
    islands = []
    for contact in np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []:
        rows = (3 * contact[:, None] + np.arange(3)).ravel()
        part = W[rows][:, rows].tobsr((3, 3))
        row = np.repeat(np.arange(len(contact)), np.diff(part.indptr))
        diagonal = np.flatnonzero(part.indices == row)
        islands.append(_Island(contact, part, row, diagonal, b[rows], friction[contact], factor[contact], r[contact]))
        islands[-1].measure()
    return islands


def _advance(i: _Island) -> None:
    """One outer iterate of an island."""
    q, found = _newton(i, damped=False)
    if not found:
        q, found = _newton(i, damped=True)
    before, changed, size, residual = i.r, i.changed, i.size, i.residual
    i.r = prox(q, i.friction)
    i.measure()
    better = i.residual <= residual
    # a small rho gives the proximal step, which leads nearer in its own measure though the residual may rise
    if found and (better or i.rho <= 100.0):
        i.rho = min(MOST, i.rho * (10.0 if better else 3.0))
    elif not i.residual < 0.5 * residual:
        i.r, i.changed, i.size = before, changed, size
        i.rho = max(LEAST, 0.1 * i.rho)


def _newton(i: _Island, damped: bool) -> tuple[np.ndarray, bool]:
    """q (k,3) with a small G(q), and whether it was found. damped: steps are halved until |G| falls."""
    f = i.factor[:, [0, 1, 1]].ravel()
    weight, soft = 1.0 / np.sqrt(f), 1.0 / (i.rho * f)
    q = i.r.ravel()
    b = i.b - soft * q

    def look(q: np.ndarray):
        G, D = _linearise(q, f * (i.W @ q + soft * q + b), i.friction)
        return G, D, np.linalg.norm(weight * G)

    G, D, size = look(q)
    goal = GOAL * size
    for _ in range(STEPS):
        if not size > goal:
            break
        step = _step(i, soft, f, G, D)
        if step is None or not np.all(np.isfinite(step)):
            return q.reshape(-1, 3), False
        share = 1.0
        for _ in range(HALVINGS if damped else 1):
            trial = q + share * step
            new = look(trial)
            if new[2] < (1.0 - 1e-4 * share) * size:
                break
            share *= 0.5
        else:
            if damped:
                return q.reshape(-1, 3), False
        q, (G, D, size) = trial, new
    return q.reshape(-1, 3), bool(size <= goal)


def _linearise(q: np.ndarray, change: np.ndarray, friction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """G (3k,) = q - prox(z), z = q - change, and the derivative (k,3,3) of prox at z."""
    z = (q - change).reshape(-1, 3)
    p = prox(z, friction)
    pressed = z[:, 0] > 0.0
    size = np.hypot(z[:, 1], z[:, 2])
    slips = pressed & (size > p[:, 0] * friction)
    D = np.zeros((len(z), 3, 3))
    D[pressed, 0, 0] = 1.0
    sticks = pressed & ~slips
    D[sticks, 1, 1] = D[sticks, 2, 2] = 1.0
    e = z[slips, 1:] / size[slips, None]
    share = friction[slips] * z[slips, 0] / size[slips]
    D[slips, 1:, 1:] = share[:, None, None] * (np.eye(2) - e[:, :, None] * e[:, None, :])
    D[slips, 1:, 0] = friction[slips, None] * e
    return q - p.ravel(), D


def _step(i: _Island, soft: np.ndarray, f: np.ndarray, G: np.ndarray, D: np.ndarray) -> np.ndarray | None:
    """Newton's step (3k,): (1 - D (1 - F W')) step = -G; None where it cannot be found."""
    k = len(D)
    blocks = i.W.data.copy()
    blocks[i.diagonal] += soft.reshape(k, 3, 1) * np.eye(3)
    blocks = (D * f.reshape(k, 1, 3))[i.row] @ blocks
    blocks[i.diagonal] += np.eye(3) - D
    try:
        if 3 * k > DENSE:
            return splu(sp.bsr_matrix((blocks, i.W.indices, i.W.indptr)).tocsc()).solve(-G)
        J = np.zeros((k, k, 3, 3))
        J[i.row, i.W.indices] = blocks
        return np.linalg.solve(J.transpose(0, 2, 1, 3).reshape(3 * k, 3 * k), -G)
    except (np.linalg.LinAlgError, RuntimeError):  # RuntimeError: splu says "exactly singular"
        return None
