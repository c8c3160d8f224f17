"""The reference problems as data: every case that `benchmarks/references.py` runs, in the order of its table."""

from . import contact, motion, pointwise, statics, vibration
from .record import Case

CASES: tuple[Case, ...] = (*pointwise.CASES, *statics.CASES, *vibration.CASES, *motion.CASES, *contact.CASES)
PROBLEMS: tuple[str, ...] = tuple(dict.fromkeys(case.problem for case in CASES))
