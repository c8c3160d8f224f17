"""Semismooth Newton method for a contact problem with a dense W: few iterations from a start near the solution.

A root of F(r) = r - prox(r - f (W r + b)) is sought with a derivative of prox, in which the friction disk's radius follows the
normal impulse. Redundant contacts, whose W is singular, are separated by a shift. Steps are full: |F| may have to rise before
the contacts that slip, stick and separate are found. Where it rises for long, a larger shift begins anew. The shifts were
chosen on 813 problems of four scenes: steps that were shortened until |F| fell failed in 181, full ones with the first shift in
25, with all three in 3.
Source: Alart and Curnier, "A mixed formulation for frictional contact problems prone to Newton like solution methods", CMAME 92,
1991. Weakness: far from the solution it may cycle.
"""

from collections.abc import Callable

import numpy as np

from taisoft.contact.augmented_lagrangian import prox

SHIFTS = 1e-5, 1e-3, 1e-2  # times the derivative of prox, added to that of F, whose entries are of the order of 1
MAX_RISING = 8  # iterations in a row without a smaller |F|, after which the next shift is taken


def solve(
    W: np.ndarray,
    b: np.ndarray,
    friction: np.ndarray,
    r: np.ndarray,
    factor: np.ndarray,
    holds: Callable[[np.ndarray], bool],
    near: float,
    most: int,
) -> tuple[np.ndarray, int] | None:
    """Return admissible impulses (k,3) that hold, and the number of iterations; None if no shift leads to any within `most`.

    W: (3k,3k); r: (k,3), the start; b: (3k,); friction: (k,); factor: (k,2), f. near: |F| over |r| below which r may hold.
    """
    k, f = len(friction), factor[:, [0, 1, 1]]
    scaled, start, n = (f.reshape(-1, 1) * W).reshape(k, 3, 3 * k), r, 0
    for shift in SHIFTS:
        r, lowest, n_rising = start, np.inf, 0
        for _ in range(most + 1):
            z = r - f * (W @ r.reshape(-1) + b).reshape(-1, 3)
            F = r - prox(z, friction)
            size = np.linalg.norm(F)
            # rounding may leave r a little outside its cone
            if size <= near * np.linalg.norm(r) and holds(admissible := prox(r, friction)):
                return admissible, n
            n_rising = 0 if size < lowest else n_rising + 1
            lowest = min(size, lowest)
            if n_rising == MAX_RISING or not np.isfinite(size):
                break
            try:
                r, n = r - _step(scaled, z, F, friction, shift), n + 1
            except np.linalg.LinAlgError:
                return None
    return None


def _step(scaled: np.ndarray, z: np.ndarray, F: np.ndarray, friction: np.ndarray, shift: float) -> np.ndarray:
    """Newton's step (k,3). scaled: f W (k,3,3k); z: (k,3), of which F (k,3) contains prox. Raises numpy.linalg.LinAlgError."""
    k, step, presses = len(friction), F.copy(), np.flatnonzero(z[:, 0] > 0.0)  # the impulses of others become 0
    D, own = derivative(z[presses], friction[presses]), np.arange(len(presses))
    rows = D @ scaled[presses]
    step[presses] = 0.0
    rest = F[presses] - rows @ step.reshape(-1)
    slope = rows.reshape(-1, k, 3)[:, presses].reshape(len(own), 3, len(own), 3)
    slope[own, :, own, :] += np.eye(3) - (1.0 - shift) * D
    step[presses] = np.linalg.solve(slope.reshape(rest.size, rest.size), rest.reshape(-1)).reshape(-1, 3)
    return step


def derivative(z: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """A derivative (k,3,3) of prox at z (k,3)."""
    size, radius = np.hypot(z[:, 1], z[:, 2]), friction * z[:, 0]
    presses = z[:, 0] > 0.0
    sticks, slips = presses & (size <= radius), presses & (size > radius)
    D = np.zeros((len(z), 3, 3))
    D[presses, 0, 0] = 1.0
    D[sticks, 1, 1] = D[sticks, 2, 2] = 1.0
    e = z[slips, 1:] / size[slips, None]
    D[slips, 1:, 0] = friction[slips, None] * e
    D[slips, 1:, 1:] = (radius / np.maximum(size, 1e-300))[slips, None, None] * (np.eye(2) - e[:, :, None] * e[:, None, :])
    return D
