"""Hybrid (report, algorithm 5): Jacobi, but friction with the new normal part."""

import taichi as ti

from taisoft.contact.jacobi import relaxation, sweep_all, sweep_all_at_once
from taisoft.contact.problem import ContactProblem

__all__ = ["relaxation", "sweep", "sweep_at_once"]


@ti.func
def sweep(p: ti.template()):
    """Every contact once, on this thread."""
    sweep_all(p, True)


def sweep_at_once(p: ContactProblem, _colours: int) -> None:
    """Every contact once, on all threads."""
    sweep_all_at_once(p, True)
