"""Hybrid (report, algorithm 5): Jacobi, but the friction disk uses the new normal impulse."""

import taichi as ti

from taisoft.contact.jacobi import relaxation, sweep_all, sweep_all_parallel
from taisoft.contact.problem import ContactProblem

__all__ = ["relaxation", "sweep", "sweep_parallel"]


@ti.func
def sweep(p: ti.template()):
    """Relax every contact once, on this thread."""
    sweep_all(p, True)


def sweep_parallel(p: ContactProblem, _colours: int) -> None:
    """Relax every contact once, on all threads."""
    sweep_all_parallel(p, True)
