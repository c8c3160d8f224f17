"""Coloured Gauss-Seidel (report, algorithm 7): one colour after another, all contacts of a colour in parallel.

Contacts of one colour share no movable node, so their changes of w are added, as in sequential order. (Line 15 of the report
averages them, which solves a different problem.) The result is that of serial Gauss-Seidel in the order of the colours, which is
also what runs on one thread. `colouring` groups the contacts, once before the solve.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.gauss_seidel import relax, relaxation, sweep
from taisoft.contact.problem import ContactProblem

BATCH = 4  # colours per launch: a launch costs more than a loop in it

__all__ = ["relaxation", "sweep", "sweep_parallel"]


@kernel
def relax_colours(p: ti.template(), first: ti.i32):
    """Relax the contacts of BATCH colours from `first` on, each colour on all threads."""
    for q in ti.static(range(BATCH)):
        for k in range(_start(p, first + q), _start(p, first + q + 1)):
            relax(p, p.order[k])


@ti.func
def _start(p: ti.template(), colour):
    """Start of a colour in `order`; the end of the last colour for any later one."""
    return p.colour_start[ti.min(colour, p.count[1])]


def sweep_parallel(p: ContactProblem, colours: int) -> None:
    """Relax every contact once, on all threads."""
    for first in range(0, colours, BATCH):
        relax_colours(p, first)
