"""The contact patch test: blocks of different meshes that are pressed together uniformly are strained uniformly.

Stresses and displacements are those of uniaxial compression, and pressures at the nodes those applied: of linear and quadratic
tets, with and without friction, along every axis, also in a stack, on a mesh obstacle and on a rigid body.
"""

import pytest

from benchmarks.reference_cases.pressures import CASES


@pytest.mark.parametrize("case", [case for case in CASES if not case.fine], ids=lambda case: case.name)
def test_a_uniform_pressure_passes_between_meshes(case):
    checks = list(case.compute({}, "cpu"))
    assert len(checks) == 4 and not [check for check in checks if not check.passed]
