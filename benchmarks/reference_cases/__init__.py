"""The reference problems as data: every case that `benchmarks/references.py` runs, in the order of its table."""

from . import (
    connections,
    contact,
    layers,
    locking,
    motion,
    pointwise,
    pressing,
    pressures,
    rigid,
    spheres,
    statics,
    vibration,
    viscosity,
)
from .record import Case

PARTS = (
    pointwise,
    statics,
    layers,
    locking,
    spheres,
    vibration,
    motion,
    contact,
    pressing,
    pressures,
    connections,
    rigid,
    viscosity,
)
CASES: tuple[Case, ...] = tuple(case for part in PARTS for case in part.CASES)
PROBLEMS: tuple[str, ...] = tuple(dict.fromkeys(case.problem for case in CASES))
