"""Stiffness blocks K_ab between the nodes of each tet, before summation over tets.

A linear tet has A_kl = V dP(e grad l_k) grad l_l between its corners, six blocks (k < l). A quadratic one has
    K_ab = sum_q w_q sum_kl s_ak(q) s_bl(q) A_kl(q),   grad N_a = sum_k s_ak grad l_k,   A_kk = -sum_l A_kl (l other than k).
The six A_kl of each quadrature point go to a scratch part of the buffer and are added from there to the node pairs.
"""

import numpy as np
import taichi as ti

from taisoft.fem.lanes import (
    broadcast,
    deformation_gradient,
    gradients_at,
    load_lanes,
    position_differences,
    rest_gradients,
    rest_gradients_of_F,
    store_lanes,
    volume_ratio_at,
    volumes,
    with_additions,
)
from taisoft.fem.laws import dpk1_projected, prepare_projected
from taisoft.fem.mean_dilatation import stress_constants
from taisoft.fem.node_graph import PAIRS
from taisoft.fem.pattern import MATRIX_BLOCKS
from taisoft.mesh.quadratic import Quadrature, shape_derivatives

N_PAIRS = len(PAIRS[2])


def pair_terms(rules: list[Quadrature]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terms by which the six A_kl of a quadratic tet contribute to its node pairs, for the p points of the given rules.

    Returns (13,) the first term of each A_kl, followed by that of its transpose; (terms,) the node pair of each term;
    (p, terms) the factors, including quadrature weights.
    """
    weights = np.concatenate([r.weights for r in rules])
    s = shape_derivatives(2, np.concatenate([r.points for r in rules]))
    terms: list[dict[int, np.ndarray]] = [{} for _ in range(12)]  # A_01, its transpose A_10, A_02, ...
    for n, (a, b) in enumerate(PAIRS[2]):
        for k in range(4):
            for l in range(4):
                factor = weights * s[:, a, k] * s[:, b, l]
                for other in range(4) if k == l else (l,):
                    if other != k and factor.any():
                        factors = terms[2 * PAIRS[1].index((min(k, other), max(k, other))) + (k > other)]
                        factors[n] = factors.get(n, 0.0) + (-factor if k == l else factor)
    start = np.cumsum([0] + [len(factors) for factors in terms])
    pairs = np.array([n for factors in terms for n in factors])
    return start, pairs, np.stack([factor for factors in terms for factor in factors.values()], axis=1)


@ti.func
def element_blocks(m: ti.template(), g: ti.template(), A: ti.template(), b, projected: ti.template()):
    """Write K_ab of the node pairs of block b of group g to A.element."""
    X, N = position_differences(m, g, b), rest_gradients_of_F(m, g, b)
    p = stress_constants(m, g, b, m.real)
    M = rest_gradients(m, b, m.real)
    V = volumes(m, b, m.real)
    base = g.matrix_at + (b - g.first) * (MATRIX_BLOCKS[g.order] * 9)
    if ti.static(g.order == 2):
        for k in range(N_PAIRS * 9):
            store_lanes(m, A.element, base + k, broadcast(ti.cast(0.0, m.real), m.lanes))
    for q in range(g.n_points):
        F = deformation_gradient(m, g, X, N, b, q, m.real)
        G, U = gradients_at(m, g, M, b, q, m.real), V * volume_ratio_at(m, g, b, q, m.real)
        at = base + (N_PAIRS * 9 if ti.static(g.order == 2) else 0)
        if ti.static(projected):
            S = prepare_projected(g.law, F, with_additions(m, g, p, b, q, m.real))
            projected_blocks(m, A, g.law, at, S, G, U)
        else:
            S = g.law.prepare(F, with_additions(m, g, p, b, q, m.real))
            exact_blocks(m, A, g.law, at, F, S, G, U)
        if ti.static(g.order == 2):
            scatter_terms(m, A, base, at, g.points_at + q)


@ti.func
def scatter_terms(m: ti.template(), A: ti.template(), base, at, row):
    """Add the scratch blocks A_kl of quadrature point `row` to the node pairs of a quadratic tet."""
    for n in range(6):
        B = [load_lanes(m, A.element, at + (9 * n + e)) for e in ti.static(range(9))]
        for transposed in ti.static(range(2)):
            for u in range(A.term_start[2 * n + transposed], A.term_start[2 * n + transposed + 1]):
                w, out = A.term_factor[row, u], base + 9 * A.term_pair[u]
                for e in ti.static(range(9)):
                    entry = B[ti.static(3 * (e % 3) + e // 3 if transposed else e)]
                    store_lanes(m, A.element, out + e, load_lanes(m, A.element, out + e) + w * entry)


@ti.func
def exact_blocks(m: ti.template(), A: ti.template(), law: ti.template(), base, F, S, M, V):
    """Write K_ab of the corner pairs by the law's closed form, from `base` on.

    The gradients g of corners 1, 2, 3 are the rows of M; K_0b is minus the sum over a of K_ab.
    """
    g = [[M[3 * a], M[3 * a + 1], M[3 * a + 2]] for a in ti.static(range(3))]
    K11, K22, K33 = law.block(F, S, g[0], g[0]), law.block(F, S, g[1], g[1]), law.block(F, S, g[2], g[2])
    # the rows of law.block(ga, gb) are the force at b: its transpose is K_ab
    K21, K31, K32 = law.block(F, S, g[0], g[1]), law.block(F, S, g[0], g[2]), law.block(F, S, g[1], g[2])
    for i in ti.static(range(3)):
        for k in ti.static(range(3)):
            store_lanes(m, A.element, base + (3 * i + k), -V * (K11[3 * i + k] + K21[3 * i + k] + K31[3 * i + k]))
            store_lanes(m, A.element, base + (9 * 1 + 3 * i + k), -V * (K21[3 * k + i] + K22[3 * i + k] + K32[3 * i + k]))
            store_lanes(m, A.element, base + (9 * 2 + 3 * i + k), -V * (K31[3 * k + i] + K32[3 * k + i] + K33[3 * i + k]))
            store_lanes(m, A.element, base + (9 * 3 + 3 * i + k), V * K21[3 * k + i])
            store_lanes(m, A.element, base + (9 * 4 + 3 * i + k), V * K31[3 * k + i])
            store_lanes(m, A.element, base + (9 * 5 + 3 * i + k), V * K32[3 * k + i])


@ti.func
def projected_blocks(m: ti.template(), A: ti.template(), law: ti.template(), base, S, M, V):
    """Write K_ab of the projected second derivative, one column at a time: unrolled, it takes seconds to compile."""
    for a in ti.static(range(3)):
        for k in range(3):
            # unit displacement of corner a + 1 along axis k
            unit = [ti.select(k == r, ti.cast(1.0, m.real), ti.cast(0.0, m.real)) for r in ti.static(range(3))]
            D = [unit[r] * M[3 * a + c] for r in ti.static(range(3)) for c in ti.static(range(3))]
            T = dpk1_projected(law, S, D)
            store_column(m, A, base, a, k, T, M, V)


@ti.func
def store_column(m: ti.template(), A: ti.template(), base, a: ti.template(), k, T, M, V):
    """Write column k of the blocks K_(c+1)(a+1) between corner a + 1 and the others, as row k of K_(a+1)(c+1)."""
    for r in ti.static(range(3)):
        g = [V * (T[3 * r] * M[3 * c] + T[3 * r + 1] * M[3 * c + 1] + T[3 * r + 2] * M[3 * c + 2]) for c in ti.static(range(3))]
        g0 = -(g[0] + g[1] + g[2])
        # pair (0, a + 1) has index a: entry (r, k) of K_0a
        store_lanes(m, A.element, base + (9 * a + 3 * r + k), g0)
        for c in ti.static(range(3)):
            if ti.static(c > a):
                # pair (a + 1, c + 1) has index a + c + 2: K_(c+1)(a+1)[r, k] is K_(a+1)(c+1)[k, r]
                store_lanes(m, A.element, base + (9 * (a + c + 2) + 3 * k + r), g[c])
