"""Conjugate gradients with a preconditioner on the host, for `multigrid`: vectors in f64, products A p by a kernel.

The iteration stops as that of `pcg` does: on sqrt(r.z) relative to the start, on a direction of negative curvature, and at a
maximum number of iterations. In f32 a direction is rounded before its product, so that the product is that of the direction used.
Weakness: on the CPU only, whose arrays the host can access.
"""

import math
from collections.abc import Callable

import numpy as np

from taisoft.fem.model import Model
from taisoft.linear import block_csr
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.pcg_work import MAX_NEGATIVE_STEP, LinearResult, PcgWork


def solve(
    m: Model,
    A: BlockCsr,
    w: PcgWork,
    tolerance: float,
    max_iterations: int,
    precondition: Callable[[np.ndarray], np.ndarray],
    low_rank: tuple[np.ndarray, np.ndarray] | None = None,
) -> LinearResult:
    """Solve for w.y given w.rhs, as `pcg.solve` without coupling and for all nodes.

    precondition: symmetric positive definite on the free axes, from a residual (3 n_nodes) f64; 0 on the others. If rounding
    keeps it from being so, the solve ends without convergence. low_rank: (G, s), rows (k, 3 n_nodes) and factors (k,): G^T s G is
    added to A.
    """
    free = m.free.host.astype(np.float64).reshape(-1)
    r = free * w.rhs.host.reshape(-1)
    y, p, rz, beta = np.zeros_like(r), np.zeros_like(r), 0.0, 0.0
    status = {"converged": False, "negative": False}
    count, limit = 0, 0.0
    while True:
        z = precondition(r)
        last, rz = rz, inner_product(r, z)
        if count == 0:
            limit = tolerance * tolerance * rz
        else:
            beta = rz / last
        status["converged"] = 0.0 <= rz <= limit
        if status["converged"] or not rz > 0.0 or count >= max_iterations:
            break
        w.p.host[...] = (z + beta * p).reshape(-1, 3)
        block_csr.multiply(m, A, w.p, w.q)
        p, q = w.p.host.astype(np.float64).reshape(-1), free * w.q.host.reshape(-1)
        if low_rank is not None:
            G, s = low_rank
            q += np.einsum("k,kn->n", s * np.einsum("kn,n->k", G, p), G)
        curvature = inner_product(p, q)
        if not curvature > 0.0:
            y += (min(rz / -curvature, MAX_NEGATIVE_STEP) if curvature < 0.0 else MAX_NEGATIVE_STEP) * p
            status["negative"] = True
            break
        y += (rz / curvature) * p
        r -= (rz / curvature) * q
        count += 1
    w.y.host[...] = y.reshape(-1, 3)
    return LinearResult(count, **status)


def inner_product(a: np.ndarray, b: np.ndarray) -> float:
    """a.b, without BLAS, which would start threads for these few numbers and sum in an order that depends on their number."""
    return float(np.einsum("n,n->", a, b))


def norm(a: np.ndarray) -> float:
    """|a|, likewise."""
    return math.sqrt(inner_product(a, a))
