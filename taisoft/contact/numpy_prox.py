"""The frictional contact problem in NumPy: W as a matrix, impulses r (k,3). See `problem` for the formulas."""

import numpy as np
import scipy.sparse as sp


def find_factors(W: sp.spmatrix) -> np.ndarray:
    """r-factors (k,2) of normal and tangents from the diagonal of W (3k,3k); 0 where the diagonal is not positive."""
    d = W.diagonal().reshape(-1, 3)
    d = np.stack([d[:, 0], d[:, 1:].max(axis=1, initial=0.0)], axis=1)
    return np.divide(1.0, d, out=np.zeros_like(d), where=d > 0.0)


def prox(z: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Project z (k,3) to admissible impulses (k,3): first the normal part, then the tangential part onto its friction disk."""
    normal = np.maximum(z[:, 0], 0.0)
    size, radius = np.hypot(z[:, 1], z[:, 2]), friction * normal
    scale = np.divide(radius, size, out=np.ones_like(size), where=size > radius)
    return np.column_stack([normal, scale * z[:, 1], scale * z[:, 2]])


def natural_map(W, b: np.ndarray, friction: np.ndarray, factor: np.ndarray, r: np.ndarray) -> np.ndarray:
    """r - prox(r - f (W r + b)), (k,3)."""
    u = (W @ r.ravel() + b).reshape(-1, 3)
    return r - prox(r - factor[:, [0, 1, 1]] * u, friction)


def relative(changed: float, size: float) -> float:
    """Residual from |r - prox(r - f u)| and |r|; 1 if r is 0 but not a solution."""
    return changed / size if size > 0.0 else float(changed != 0.0)


def residual(W, b: np.ndarray, friction: np.ndarray, factor: np.ndarray, r: np.ndarray) -> float:
    """|r - prox(r - f (W r + b))| / |r|."""
    return float(relative(np.linalg.norm(natural_map(W, b, friction, factor, r)), np.linalg.norm(r)))
