"""All hard cases, group by group."""

from . import contact, geometry, long_run, material, ratios, scale, self_collision, time_step
from .record import Case

GROUPS = (material, time_step, ratios, contact, self_collision, geometry, scale, long_run)
CASES: tuple[Case, ...] = tuple(case for group in GROUPS for case in group.CASES)
