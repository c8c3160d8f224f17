"""Coloured Gauss-Seidel (report, algorithm 7): colour after colour, the contacts of one colour at once.

Contacts of one colour share no node that can move, so their changes of w are added, as one after the other they would be (the
report's line 15 averages them, which solves another problem), and the result is that of serial Gauss-Seidel in the order of the
colours. On one thread it is that. `colouring` groups the contacts, once before the solve.
"""

import taichi as ti

from taisoft.contact.gauss_seidel import relax, share, sweep
from taisoft.contact.problem import ContactProblem
from taisoft.runtime import kernel

__all__ = ["share", "sweep", "sweep_at_once"]


@kernel
def relax_colour(p: ti.template(), colour: ti.i32):
    """The contacts of one colour, on all threads."""
    for k in range(p.colour_start[colour], p.colour_start[colour + 1]):
        relax(p, p.order[k])


def sweep_at_once(p: ContactProblem) -> None:
    """Every contact once, on all threads."""
    for colour in range(int(p.count[1])):
        relax_colour(p, colour)
