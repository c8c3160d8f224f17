"""Thick spheres of the benchmarks."""

from benchmarks.reference_cases.spheres import hold_planes, inside, thick_sphere

__all__ = ["hold_planes", "inside", "thick_sphere"]
