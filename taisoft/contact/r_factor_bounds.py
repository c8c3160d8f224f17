"""Bounds on the fraction of its r-factors that a contact may use so that a sweep does not overshoot.

With B the blocks of F^1/2 W F^1/2, F the r-factors, a step of the fraction s along the velocity lowers the energy of the
impulses if s B <= 1. For contacts relaxed sequentially only the diagonal block counts: s = 1 / |B_cc|. For contacts relaxed in
parallel the whole row does: s_c = 1 / sum_d |B_cd| (block Gershgorin). This adapts to the local density of contacts; a single
number from the largest eigenvalue of F W would slow all contacts down to the worst one.
The norms are upper bounds: sqrt(|B|_1 |B|_inf) for a matrix, absolute values of the weights over nodes.
"""

import taichi as ti

from taisoft.contact.problem import NODES, own_block


@ti.func
def _roots(p: ti.template(), c):
    """Square roots of the r-factors of contact c, by component."""
    n, t = ti.sqrt(p.factor[c][0]), ti.sqrt(p.factor[c][1])
    return ti.Vector([n, t, t])


@ti.func
def _norm(B, a, b):
    """Upper bound of the 2-norm of diag(a) B diag(b)."""
    columns, rows = ti.Vector([0.0, 0.0, 0.0], ti.f64), ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for i, j in ti.static(ti.ndrange(3, 3)):
        size = ti.abs(a[i] * B[i, j] * b[j])
        columns[j] += size
        rows[i] += size
    return ti.sqrt(columns.max() * rows.max())


@ti.func
def _inverse(total):
    return ti.select(total > 0.0, 1.0 / total, 1.0)


@ti.func
def sequential(p: ti.template(), c):
    """Fraction in (0, 1] for sequential relaxation; 1 if no node's inverse mass differs between axes."""
    a = _roots(p, c)
    return ti.min(1.0, _inverse(_norm(own_block(p, c), a, a)))


@ti.func
def gershgorin(p: ti.template(), c):
    """Fraction in (0, 1] for parallel relaxation."""
    total = ti.cast(0.0, ti.f64)
    a = _roots(p, c)
    if ti.static(p.matrix):
        for k in range(p.row_start[c], p.row_start[c + 1]):
            B = ti.Matrix.zero(ti.f64, 3, 3)
            for i, j in ti.static(ti.ndrange(3, 3)):
                B[i, j] = p.block[k, 3 * i + j]
            total += _norm(B, a, _roots(p, p.column[k]))
    else:
        for k in range(p.arity[c]):
            i = p.node[c, k]
            weights = ti.cast(0.0, ti.f64)
            for e in range(p.entry_start[i], p.entry_start[i + 1]):
                d = p.entry[e] // NODES
                weights += ti.abs(p.weight[d, p.entry[e] % NODES]) * _roots(p, d).max()
            total += ti.abs(p.weight[c, k]) * p.inverse_mass[i].max() * a.max() * weights
    return ti.min(1.0, _inverse(total))
