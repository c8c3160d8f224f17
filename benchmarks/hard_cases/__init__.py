"""All hard cases, group by group."""

from . import contact, geometry, long_run, material, ratios, scale, self_collision, time_step
from .record import Case

GROUPS: dict[str, tuple[Case, ...]] = {  # by the catalogue's names
    "material": material.CASES,
    "time step": time_step.CASES,
    "ratios": ratios.CASES,
    "contact & friction": contact.CASES,
    "self-collision": self_collision.CASES,
    "degenerate geometry": geometry.CASES,
    "extremes of scale": scale.CASES,
    "long run": long_run.CASES,
}
CASES: tuple[Case, ...] = tuple(case for cases in GROUPS.values() for case in cases)
