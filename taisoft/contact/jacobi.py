"""Jacobi (report, algorithm 4): all contacts at once, each with the impulses of the last sweep.

The friction disk is that of the last sweep's normal part. `hybrid` shares all but this.
"""

import taichi as ti

from taisoft.contact import r_factor_bounds as bounds
from taisoft.contact.problem import STEP, ContactProblem, velocity
from taisoft.contact.prox import into_disk, prox, scaled
from taisoft.runtime import kernel


@ti.func
def relaxation(p: ti.template(), c, beyond):
    """Share of its r-factors that contact c takes, with momentum or without."""
    return bounds.gershgorin(p, c)


@ti.func
def relaxed(p: ti.template(), c, fresh: ti.template()):
    """One prox of contact c. fresh: whether the friction disk is that of the new normal part."""
    r = p.r[c]
    z = r - scaled(p.state[STEP] * p.relaxation[c] * p.factor[c], velocity(p, c))
    new = prox(z, p.friction[c])
    if ti.static(not fresh):
        new = into_disk([new[0], z[1], z[2]], p.friction[c] * r[0])
    return new


@ti.func
def exchange(p: ti.template(), c):
    """The new impulses become the present ones, those become the guess."""
    new = p.guess[c]
    p.guess[c] = p.r[c]
    p.r[c] = new


@ti.func
def sweep_all(p: ti.template(), fresh: ti.template()):
    """Every contact once, on this thread."""
    for c in range(p.count[0]):
        p.guess[c] = relaxed(p, c, fresh)
    for c in range(p.count[0]):
        exchange(p, c)


@ti.func
def sweep(p: ti.template()):
    """Every contact once, on this thread."""
    sweep_all(p, False)


@kernel
def sweep_all_at_once(p: ti.template(), fresh: ti.template()):
    """Every contact once, on all threads."""
    for c in range(p.count[0]):
        p.guess[c] = relaxed(p, c, fresh)
    for c in range(p.count[0]):
        exchange(p, c)


def sweep_at_once(p: ContactProblem, _colours: int) -> None:
    """Every contact once, on all threads."""
    sweep_all_at_once(p, False)
