"""Linear tetrahedra: shape functions, quadrature, mass, and their lane-packed form. All element geometry is here.

X(xi) = sum N_a X_a with N_1..N_3 = xi, N_0 = 1 - xi_1 - xi_2 - xi_3; F = Ds Dm^-1 is constant over the element, so one
quadrature point of weight V is exact. Rows of Dm^-1 are the rest gradients of N_1..N_3; that of N_0 is minus their sum.
"""

import numpy as np
import taichi as ti


def inverse_rest_edges(vertices: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dm^-1 (m,3,3) [1/m], with Dm's columns X1-X0, X2-X0, X3-X0, and the rest volumes (m,) [m^3].

    The order of a tet's vertices does not matter: F is the same for each, and the volume is taken as positive.
    """
    corner = vertices[tets]
    Dm = (corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1)
    return np.linalg.inv(Dm), np.abs(np.linalg.det(Dm)) / 6.0


def shape_gradients(Dm_inv: np.ndarray) -> np.ndarray:
    """Rest gradients (m,4,3) [1/m] of the four shape functions."""
    return np.concatenate([-Dm_inv.sum(axis=1, keepdims=True), Dm_inv], axis=1)


def lumped_mass(tets: np.ndarray, volumes: np.ndarray, density: float, n_verts: int) -> np.ndarray:
    """A quarter of each tet's mass to each of its vertices: (n_verts,) [kg]."""
    return np.bincount(tets.reshape(-1), np.repeat(0.25 * density * volumes, 4), n_verts)


def traction_forces(vertices: np.ndarray, triangles: np.ndarray, traction: np.ndarray) -> np.ndarray:
    """Nodal forces (n,3) [N] of a uniform dead traction (3,) [Pa] per reference area on triangles (k,3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = np.bincount(triangles.reshape(-1), np.repeat(area / 3.0, 3), len(vertices))
    return share[:, None] * np.asarray(traction, dtype=np.float64)


@ti.func
def broadcast(value, lanes: ti.template()):
    """The same number in every lane."""
    return ti.Vector([value for q in ti.static(range(lanes))])


@ti.func
def edge_gradient(m: ti.template(), field: ti.template(), b, real: ti.template()):
    """Gradient over the rest shape of a nodal vector field, for the tets of block b: F when the field is x.

    Differences of nodal values are formed in the field's own precision (f64 for positions), then rounded to `real`.
    """
    p0 = [field[m.verts[b, 0, q]] for q in ti.static(range(m.lanes))]
    p1 = [field[m.verts[b, 1, q]] for q in ti.static(range(m.lanes))]
    p2 = [field[m.verts[b, 2, q]] for q in ti.static(range(m.lanes))]
    p3 = [field[m.verts[b, 3, q]] for q in ti.static(range(m.lanes))]
    D = [
        ti.Vector([ti.cast((p1, p2, p3)[c][q][r] - p0[q][r], real) for q in ti.static(range(m.lanes))])
        for r in ti.static(range(3))
        for c in ti.static(range(3))
    ]
    M = rest_gradients(m, b, real)
    return [
        D[3 * i] * M[j] + D[3 * i + 1] * M[3 + j] + D[3 * i + 2] * M[6 + j]
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]


@ti.func
def rest_gradients(m: ti.template(), b, real: ti.template()):
    """Dm^-1 of the tets of block b (nine lane entries) [1/m]."""
    return [
        ti.Vector([ti.cast(m.Dm_inv[b, c, q], real) for q in ti.static(range(m.lanes))]) for c in ti.static(range(9))
    ]


@ti.func
def volumes(m: ti.template(), b, real: ti.template()):
    """Rest volumes of the tets of block b [m^3]; 0 in padding lanes."""
    return ti.Vector([ti.cast(m.volume[b, q], real) for q in ti.static(range(m.lanes))])


@ti.func
def law_constants(m: ti.template(), b, real: ti.template()):
    """The four law constants of block b's body [Pa and pure numbers], in every lane."""
    body = m.block_body[b]
    return [broadcast(ti.cast(m.law_constants[body, k], real), m.lanes) for k in ti.static(range(4))]


@ti.func
def store_corner_forces(m: ti.template(), b, P):
    """Write the nodal forces -V P grad N_a [N] of block b to its corner buffer, lane by lane (which keeps it SIMD)."""
    M = rest_gradients(m, b, m.real)
    V = -volumes(m, b, m.real)
    H = [
        V * (P[3 * i] * M[3 * c] + P[3 * i + 1] * M[3 * c + 1] + P[3 * i + 2] * M[3 * c + 2])
        for c in ti.static(range(3))
        for i in ti.static(range(3))
    ]
    base = b * (12 * m.lanes)
    for i in ti.static(range(3)):
        H0 = -(H[i] + H[3 + i] + H[6 + i])
        for q in ti.static(range(m.lanes)):
            m.corner[base + (i * m.lanes + q)] = H0[q]
        for c in ti.static(range(3)):
            for q in ti.static(range(m.lanes)):
                m.corner[base + ((3 * c + 3 + i) * m.lanes + q)] = H[3 * c + i][q]


@ti.func
def gather(m: ti.template(), i):
    """Sum of the corner forces at node i, in a fixed order."""
    f = ti.Vector([0.0, 0.0, 0.0], m.real)
    for k in range(m.gather_start[i], m.gather_start[i + 1]):
        e = m.gather_entry[k]
        f += ti.Vector([m.corner[e], m.corner[e + m.lanes], m.corner[e + 2 * m.lanes]])
    return f
