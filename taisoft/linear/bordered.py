"""Parts of bordered systems A y - G^T q = -r, G y = c with few rows of G, for `dynamics.multipliers`."""

import numpy as np


def solve_active(
    N: np.ndarray,
    start: np.ndarray,
    missing: np.ndarray,
    values: np.ndarray,
    shift: np.ndarray,
    penalty: np.ndarray,
    one_sided: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Factors s (k,) of z, and new multipliers (k,), by an active-set method over those that are one-sided.

    N (k,k): beta g.z; start: beta g.y_0; shift: of the residual's multipliers from the values. Active ones reach
    start + N s = missing; the others get the value 0, and start + N s >= missing. None if that is singular or not found.
    """
    k = len(missing)
    active = np.ones(k, dtype=bool)
    for _ in range(2 * k + 2):
        lagging = np.eye(k) - penalty[:, None] * N  # change of the values with s, where they are not active
        A = np.where(active[:, None], N, lagging)
        b = np.where(active, missing - start, penalty * start - values - shift)
        if (s := solve_small(A, b)) is None:
            return None
        reached = start + N @ s
        found = values + shift + s - penalty * reached
        pushes, too_long = active & one_sided & (found < 0.0), ~active & (reached < missing)
        if not (pushes.any() or too_long.any()):
            return s, np.where(active, found, 0.0)
        active = active & ~pushes if pushes.any() else active | too_long
    return None


def products(G: np.ndarray, z: np.ndarray) -> np.ndarray:
    """G z^T of rows (k, n) and (l, n), without BLAS, whose threads cost more and whose sums depend on their number."""
    return np.einsum("kn,ln->kl", G, z)


def solve_small(A: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """A^-1 b (k,); None if A is singular or the result not finite."""
    try:
        x = np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        return None
    return x if np.isfinite(x).all() else None
