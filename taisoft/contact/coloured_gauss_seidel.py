"""Coloured Gauss-Seidel (report, algorithm 7): colour after colour, the contacts of one colour at once.

Contacts of one colour share no node that can move, so their changes of w are added, as one after the other they would be (the
report's line 15 averages them, which solves another problem), and the result is that of serial Gauss-Seidel in the order of the
colours. On one thread it is that. `colouring` groups the contacts, once before the solve.
"""

import taichi as ti

from taisoft.contact.gauss_seidel import relax, relaxation, sweep
from taisoft.contact.problem import ContactProblem
from taisoft.runtime import kernel

AT_ONCE = 4  # colours of a launch, which costs more than a loop in it

__all__ = ["relaxation", "sweep", "sweep_at_once"]


@kernel
def relax_colours(p: ti.template(), first: ti.i32):
    """The contacts of a few colours from `first` on, each colour on all threads."""
    for q in ti.static(range(AT_ONCE)):
        for k in range(_start(p, first + q), _start(p, first + q + 1)):
            relax(p, p.order[k])


@ti.func
def _start(p: ti.template(), colour):
    """Where a colour starts in `order`; behind the last one, where that ends."""
    return p.colour_start[ti.min(colour, p.count[1])]


def sweep_at_once(p: ContactProblem, colours: int) -> None:
    """Every contact once, on all threads."""
    for first in range(0, colours, AT_ONCE):
        relax_colours(p, first)
