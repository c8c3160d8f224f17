"""Jacobi (report, algorithm 4): all contacts in parallel, using the impulses of the last sweep.

The friction disk, too, uses the normal impulse of the last sweep; `hybrid` differs only in this.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact import r_factor_bounds as bounds
from taisoft.contact.problem import STEP, ContactProblem, velocity
from taisoft.contact.prox import into_disk, prox, scaled


@ti.func
def relaxation(p: ti.template(), c, with_momentum):
    """Fraction of its r-factors that contact c uses, with momentum or without."""
    return bounds.gershgorin(p, c)


@ti.func
def relaxed(p: ti.template(), c, new_disk: ti.template()):
    """Impulse of contact c after one prox step. new_disk: whether the friction disk uses the new normal impulse."""
    r = p.r[c]
    z = r - scaled(p.state[STEP] * p.relaxation[c] * p.factor[c], velocity(p, c))
    new = prox(z, p.friction[c])
    if ti.static(not new_disk):
        new = into_disk([new[0], z[1], z[2]], p.friction[c] * r[0])
    return new


@ti.func
def swap(p: ti.template(), c):
    """Swap the new impulse of contact c, held in sweep_start, with its present one."""
    new = p.sweep_start[c]
    p.sweep_start[c] = p.r[c]
    p.r[c] = new


@ti.func
def sweep_all(p: ti.template(), new_disk: ti.template()):
    """Relax every contact once, on this thread."""
    for c in range(p.count[0]):
        p.sweep_start[c] = relaxed(p, c, new_disk)
    for c in range(p.count[0]):
        swap(p, c)


@ti.func
def sweep(p: ti.template()):
    """Relax every contact once, on this thread."""
    sweep_all(p, False)


@kernel
def sweep_all_parallel(p: ti.template(), new_disk: ti.template()):
    """Relax every contact once, on all threads."""
    for c in range(p.count[0]):
        p.sweep_start[c] = relaxed(p, c, new_disk)
    for c in range(p.count[0]):
        swap(p, c)


def sweep_parallel(p: ContactProblem, _colours: int) -> None:
    """Relax every contact once, on all threads."""
    sweep_all_parallel(p, False)
