"""Tetrahedra in kernels, four at a time in SIMD lanes: gradients of nodal fields, forces from stresses, node sums.

With d_a = x_a - x_0 and c_a(q) = dN_a/d(l_1, l_2, l_3) at a quadrature point,
    F_q = D_q Dm^-1,  D_q = sum_a d_a c_a(q)^T,     f_a = -V sum_q w_q (P_q Dm^-T) c_a(q),  f_0 = -sum_a f_a.
For order 1, c_a are the unit vectors, one point suffices, and F = Ds Dm^-1. In bodies with curved edges, Dm is the Jacobian of
the rest shape at each point, and w_q the fraction of the volume there.
"""

from collections.abc import Callable
from typing import Any

import taichi as ti

from taisoft.backend.runtime import CPU_LANES, compiled_function
from taisoft.backend.tracing import untraced
from taisoft.fem.laws.table import table_constants
from taisoft.fem.math3 import ddot, dot, matmul_tn

FIRST_LANE_MASK = 2**31 - CPU_LANES  # of an index: it shows the compiler that those of the other lanes do not overflow


def _storing(real: Any, number: int) -> Callable:
    """Return a function that is compiled once and called, which stores a vector of lanes in a row.

    LLVM merges such stores, and vectorises what is stored, only if it can prove that their addresses are adjacent. The address of
    an array is reloaded before each store, which prevents the proof; that of a function's argument is not.
    """

    @compiled_function(number)
    def store(out: ti.types.ndarray(dtype=real, ndim=1), at: ti.i32, values: ti.types.vector(CPU_LANES, real)):
        first = at & FIRST_LANE_MASK
        for q in ti.static(range(CPU_LANES)):
            out[first + q] = values[q]

    return store


STORE = {ti.f32: _storing(ti.f32, 1_000_001), ti.f64: _storing(ti.f64, 1_000_002)}


@ti.func
def broadcast(value, lanes: ti.template()):
    """The same number in every lane."""
    return ti.Vector([value for q in ti.static(range(lanes))])


@ti.func
def rest_gradients(m: ti.template(), b, real: ti.template()):
    """Dm^-1 of the tets of block b (nine lane entries) [1/m]."""
    return [ti.Vector([ti.cast(m.Dm_inv[b, c, q], real) for q in ti.static(range(m.lanes))]) for c in ti.static(range(9))]


@ti.func
def volumes(m: ti.template(), b, real: ti.template()):
    """Rest volumes of the tets of block b [m^3]; 0 in padding lanes."""
    return ti.Vector([ti.cast(m.volume[b, q], real) for q in ti.static(range(m.lanes))])


@ti.func
def law_constants(m: ti.template(), g: ti.template(), b, real: ti.template()):
    """Law constants of the tets of block b of group g, without those of additions."""
    return table_constants(m, b, 0, g.law.N_CONSTANTS, real)


@untraced
def with_additions(m, g, p, b, q, real):
    """`law_constants` p, with those of the law's additions at quadrature point q after the law's own."""
    n, added = g.law.N_CONSTANTS, []
    for addition in getattr(g.law, "additions", ()):
        added += addition.constants(m, g, b, q, real)
    return p[:n] + added + p[n:]


@ti.func
def differences(m: ti.template(), g: ti.template(), field: ti.template(), b, real: ti.template()):
    """Nodal values of block b of group g relative to node 0: entry 3 (a - 1) + r is component r of node a.

    Subtracts in the field's precision (f64 for positions), then rounds to `real`.
    """
    at = g.nodes_at + (b - g.first) * (g.n_nodes * m.lanes)
    p = [[field[m.nodes[at + (a * m.lanes + q)]] for q in ti.static(range(m.lanes))] for a in ti.static(range(g.n_nodes))]
    return [
        ti.Vector([ti.cast(p[a][q][r] - p[0][q][r], real) for q in ti.static(range(m.lanes))])
        for a in ti.static(range(1, g.n_nodes))
        for r in ti.static(range(3))
    ]


@ti.func
def curved_at(m: ti.template(), g: ti.template(), b, q, c: ti.template(), real: ti.template()):
    """Number c of the rest shape of block b at quadrature point q, per lane, see `Model.curved`."""
    row = g.curved_at + (b - g.first) * g.n_points + q
    return ti.Vector([ti.cast(m.curved[row, c, l], real) for l in ti.static(range(m.lanes))])


@ti.func
def gradients_at(m: ti.template(), g: ti.template(), M, b, q, real: ti.template()):
    """Dm^-1 at quadrature point q of block b: M, that of the tets, unless they are curved."""
    if ti.static(g.curved):
        return [curved_at(m, g, b, q, c, real) for c in ti.static(range(9))]
    else:
        return M


@ti.func
def volume_ratio_at(m: ti.template(), g: ti.template(), b, q, real: ti.template()):
    """Volume per reference volume at quadrature point q of block b over its mean, which is 1 in straight tets."""
    if ti.static(g.curved):
        return curved_at(m, g, b, q, 9, real)
    else:
        return ti.cast(1.0, real)


@ti.func
def weight_at(m: ti.template(), g: ti.template(), b, q, real: ti.template()):
    """Weight of quadrature point q of block b of group g, as a fraction of the volume."""
    w = volume_ratio_at(m, g, b, q, real)
    if ti.static(g.order == 2):
        w = ti.cast(m.points[g.points_at + q, 0], real) * w
    return w


@ti.func
def derivatives_at(m: ti.template(), g: ti.template(), q, real: ti.template()):
    """c_a at quadrature point q of an order 2 group: entry 3 (a - 1) + c, 27 numbers."""
    return [ti.cast(m.points[g.points_at + q, 1 + k], real) for k in ti.static(range(27))]


@ti.func
def gradient_at(m: ti.template(), g: ti.template(), E, M, b, q, real: ti.template()):
    """Gradient with respect to rest positions at quadrature point q: F if E holds the differences of x. M: `rest_gradients`."""
    if ti.static(g.order == 1):
        return matmul_tn(E, M)  # E holds D by columns
    else:
        C = derivatives_at(m, g, q, real)
        D = [ddot(E[r::3], C[c::3]) for c in ti.static(range(3)) for r in ti.static(range(3))]
        return matmul_tn(D, gradients_at(m, g, M, b, q, real))


@ti.func
def rest_gradients_of_F(m: ti.template(), g: ti.template(), b):
    """Dm^-1 of the tets of block b in the precision in which F is formed: f64 if a mesh has slivers, and in rigid bodies."""
    return rest_gradients(m, b, g.strain_real)


@ti.func
def position_differences(m: ti.template(), g: ti.template(), b):
    """`differences` of the positions in the precision in which F is formed."""
    return differences(m, g, m.state.x, b, g.strain_real)


@ti.func
def deformation_gradient(m: ti.template(), g: ti.template(), X, N, b, q, real: ti.template()):
    """F at quadrature point q, rounded to `real`. X: `position_differences`; N: `rest_gradients_of_F`."""
    if ti.static(g.strain_real == real):
        return gradient_at(m, g, X, N, b, q, real)
    else:
        F = gradient_at(m, g, X, N, b, q, g.strain_real)
        return [ti.cast(F[k], real) for k in ti.static(range(9))]


@ti.func
def zero_forces(m: ti.template(), g: ti.template()):
    """Zero-initialised accumulator for `add_forces`."""
    return [broadcast(ti.cast(0.0, g.real), m.lanes) for k in ti.static(range(3 * (g.n_nodes - 1)))]


@ti.func
def add_forces(m: ti.template(), g: ti.template(), S: ti.template(), P, M, b, q):
    """Add the contribution of stress P at quadrature point q to S, forces per volume: entry 3 (a - 1) + i, nodes a >= 1."""
    w, G = weight_at(m, g, b, q, g.real), gradients_at(m, g, M, b, q, g.real)
    H = [w * dot(P[3 * i : 3 * i + 3], G[3 * c : 3 * c + 3]) for c in ti.static(range(3)) for i in ti.static(range(3))]
    if ti.static(g.order == 1):
        for k in ti.static(range(9)):
            S[k] += H[k]
    else:
        C = derivatives_at(m, g, q, g.real)
        for a in ti.static(range(9)):
            for i in ti.static(range(3)):
                S[3 * a + i] += H[i] * C[3 * a] + H[3 + i] * C[3 * a + 1] + H[6 + i] * C[3 * a + 2]


@ti.func
def load_lanes(m: ti.template(), source: ti.template(), at):
    """Load the vector of lanes that begins at entry `at * lanes`."""
    first = (at * m.lanes) & (2**31 - m.lanes)
    return ti.Vector([source[first + q] for q in ti.static(range(m.lanes))])


@ti.func
def store_lanes(m: ti.template(), out: ti.template(), at, values):
    """Store a vector of lanes from entry `at * lanes` on."""
    if ti.static(m.lanes == CPU_LANES):
        STORE[m.real](out, at * m.lanes, ti.cast(values, m.real))
    else:
        out[at] = values[0]


@ti.func
def store_forces(m: ti.template(), g: ti.template(), b, S):
    """Write the nodal forces -V S [N] of block b to `State.element_force`."""
    V, base = -volumes(m, b, g.real), g.force_at + (b - g.first) * (3 * g.n_nodes)
    for i in ti.static(range(3)):
        total = broadcast(ti.cast(0.0, g.real), m.lanes)
        for a in ti.static(range(1, g.n_nodes)):
            f = V * S[3 * a - 3 + i]
            total += f
            store_lanes(m, m.state.element_force, base + 3 * a + i, f)
        store_lanes(m, m.state.element_force, base + i, -total)


@ti.func
def mass_times(m: ti.template(), i, u: ti.template()):
    """(M u)_i in f64, u a field of nodal 3-vectors."""
    s = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    if ti.static(m.consistent):
        s = ti.cast(m.mass_matrix.diagonal[i], ti.f64) * ti.cast(u[i], ti.f64)
        for half in range(2):
            row = i + half * m.n_nodes
            for k in range(m.mass_matrix.row_start[row], m.mass_matrix.row_start[row + 1]):
                s += ti.cast(m.mass_matrix.value[k], ti.f64) * ti.cast(u[m.mass_matrix.column[k]], ti.f64)
    else:
        s = ti.cast(m.mass[i], ti.f64) * ti.cast(u[i], ti.f64)
    return s


@ti.func
def gather(m: ti.template(), i):
    """Sum of the tets' forces on node i [N], in a fixed order."""
    f = ti.Vector([0.0, 0.0, 0.0], m.real)
    for k in range(m.gather_start[i], m.gather_start[i + 1]):
        e = m.gather_entry[k]
        f += ti.Vector([m.state.element_force[e], m.state.element_force[e + m.lanes], m.state.element_force[e + 2 * m.lanes]])
    return f


@ti.func
def add_entry(m: ti.template(), A: ti.template(), i, at, place: ti.template(), value):
    """Add a number at one place of block `at` of a matrix, or of the diagonal block of row i if at is negative."""
    if at < 0:
        A.diagonal[i][place] += ti.cast(value, m.real)
    else:
        A.value[at][place] += ti.cast(value, m.real)
