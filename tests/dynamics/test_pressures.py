"""The contact patch test: blocks of different meshes that are pressed together uniformly are strained uniformly.

Stresses and displacements are those of uniaxial compression, and pressures at the nodes those applied: of linear and quadratic
tets, with and without friction, along every axis, also in a stack, on a mesh obstacle and on a rigid body. With a small margin,
means carry the load, too.
"""

import pytest

import taisoft as ts
from benchmarks.reference_cases.pressures import CASES


@pytest.mark.parametrize("case", [case for case in CASES if not case.fine], ids=lambda case: case.name)
def test_a_uniform_pressure_passes_between_meshes(case):
    checks = list(case.compute({}, "cpu"))
    assert len(checks) == 4 and not [check for check in checks if not check.passed]


def test_means_carry_the_load_with_a_small_margin():
    scene = ts.Scene()
    scene.collision = ts.CollisionSettings(margin=6e-4)
    scene.add_body(ts.box_mesh((2, 2, 2), (0.2, 0.2, 0.2)), ts.Material(young=1e5), name="low").fix(lambda X: X[:, 1] < -0.099)
    scene.add_body(ts.box_mesh((3, 3, 3), (0.2, 0.2, 0.2)), ts.Material(young=1e5), name="top", position=(0, 0.2003, 0))
    with ts.Simulator(scene, dt=0.01) as sim:
        for _ in range(6):
            sim.step()
        c = sim.contacts()
    force = (c.impulse * c.normal).sum(axis=1)
    assert force[c.kind == "mortar"].sum() > 0.9 * force.sum() > 0.0
