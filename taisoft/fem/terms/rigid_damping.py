"""Damping of the strain rate of rigid bodies in implicit steps with contacts: a tet that stores the energy of an impact rebounds.

    f_a = -V F S grad N_a,   S = eta (E - E_hat) / beta,   E = (F^T F - I) / 2,
E_hat the combination of earlier strains that x_hat is of positions, so that S = eta dE/dt of the scheme, eta the viscosity. A
symmetric S keeps momentum and angular momentum, and E is the same before and after a finite rotation, so a step that turns the
body has no resistance. In the matrix the blocks are
    V eta [((grad N_a.grad N_b) F F^T + (F grad N_b) (F grad N_a)^T) / 2 + (grad N_a.(E - E_hat) grad N_b) I] / beta.
The part with E - E_hat may be indefinite, and is left out of a projected matrix.
"""

import taichi as ti

from taisoft.fem.lanes import add_entry
from taisoft.fem.rigid_tets import gradient_of, green_strain
from taisoft.scene.rigid import FRAME

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = "rigid_damping", False, False, True, True


@ti.func
def count(m: ti.template()):
    """Number of tets."""
    return m.rigid_tets.n


@ti.func
def _strain_change(m: ti.template(), k, F):
    """E - E_hat of tet k with deformation gradient F."""
    E = green_strain(F)
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            E[r, c] -= m.rigid_tets.strain[k][3 * r + c]
    return E


@ti.func
def prepare(m: ti.template(), k):
    """Compute the forces on the nodes of tet k from the present x."""
    F = gradient_of(m, m.state.x, k)
    P = (m.rigid_tets.viscosity[k] * m.rigid_tets.rate[0]) * (F @ _strain_change(m, k, F))
    for a in range(FRAME):
        m.rigid_tets.force[FRAME * k + a] = -(P @ m.rigid_tets.gradient[FRAME * k + a])


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N], after `prepare`."""
    f = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    at = m.rigid_tets.number[i]
    if at >= 0:
        f = m.rigid_tets.force[at]
    return ti.cast(f, m.real)


@ti.func
def add_stiffness(m: ti.template(), A: ti.template(), i, beta, projected):
    """Add row i of beta times the damping to A. projected: without the part that may be indefinite."""
    at = m.rigid_tets.number[i]
    if at >= 0:
        k, own = at // FRAME, m.rigid_tets.gradient[at]
        F = gradient_of(m, m.state.x, k)
        E = _strain_change(m, k, F)
        B, Fa, viscosity = F @ F.transpose(), F @ own, beta * m.rigid_tets.viscosity[k]
        if m.rigid_tets.rate[0] == 0.0:
            viscosity = 0.0
        for b in range(FRAME):
            g = m.rigid_tets.gradient[FRAME * k + b]
            Fb, geometric = F @ g, own.dot(E @ g)
            if projected != 0:
                geometric = 0.0
            entry = m.rigid_tets.pair_at[FRAME * at + b]
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    block = 0.5 * (own.dot(g) * B[r, c] + Fb[r] * Fa[c])
                    if ti.static(r == c):
                        block += geometric
                    add_entry(m, A, i, entry, 4 * c + r, viscosity * block)
