"""All hard cases, group by group."""

from . import contact, geometry, material, scale, self_collision, time_step
from .case import Case, Variant

GROUPS: dict[str, tuple[Case, ...]] = {  # by the catalogue's names
    "material": material.CASES,
    "time step": time_step.TIME_STEP,
    "ratios": scale.RATIOS,
    "contact & friction": contact.CASES,
    "self-collision": self_collision.CASES,
    "degenerate geometry": geometry.CASES,
    "extremes of scale": scale.SCALE,
    "long run": time_step.LONG_RUN,
}
CASES: tuple[Case, ...] = tuple(case for cases in GROUPS.values() for case in cases)
VARIANTS: dict[str, tuple[Case, Variant]] = {f"{case.id}: {one.name}": (case, one) for case in CASES for one in case.variants}
