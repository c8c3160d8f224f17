"""Nearly flat tets in single precision, where the rounding of F = Ds Dm^-1 would be a strain of its own:

* forces are the oracle's to rounding, wherever the body lies and however it is turned;
* F is formed in f64 where a mesh has slivers, and only there;
* implicit steps converge in a few Newton iterations.
"""

import numpy as np
import pytest
import taichi as ti
from rotations import rotation
from scenes import built, rubber

import taisoft as ts
from taisoft.fem.terms import elasticity

FLAT = 1e-4  # volume of the worst tet over the mean


def sliver_mesh(flatness: float) -> ts.TetMesh:
    """A bar with one inner vertex moved close to the opposite faces of its tets."""
    good = ts.box_mesh((4, 2, 2), (0.4, 0.1, 0.1))
    x = good.vertices.copy()
    inner = np.linalg.norm(x, axis=1).argmin()
    x[inner, 2] = 0.05 * (1.0 - flatness)
    return ts.TetMesh(x, good.tets)


@pytest.fixture
def scene():
    made = ts.Scene(gravity=(0, -1, 0))
    with pytest.warns(UserWarning):
        mesh = sliver_mesh(FLAT)
    made.add_body(mesh, rubber("corotational"), name="bar").fix(lambda X: X[:, 0] < -0.199)
    return made


def test_forces_are_the_oracles(scene):
    with built(scene, "f32") as rig:
        assert rig.model.strain_real == ti.f64 and rig.model.Dm_inv.dtype == ti.f64
        rng, force = np.random.default_rng(3), rig.vectors("force")
        x = rig.oracle.rest @ rotation((1, 2, 3), 0.8).T + 1e-6 * rng.standard_normal(rig.oracle.rest.shape) + (3.0, -2.0, 1.0)
        rig.model.state.x.from_numpy(x)
        elasticity.elastic_forces(rig.model)
        elasticity.gather_forces(rig.model, force)
        # strains of 1e-6 over flat tets are some 1 % of stress; a rounding of F in f32 would be a tenth of that
        expected = rig.oracle.force(x)
        assert np.abs(force.to_numpy() - expected).max() < 1e-4 * np.abs(expected).max()


def test_steps_converge(scene):
    with ts.Simulator(scene, dt=0.01) as sim:
        reports = [sim.step() for _ in range(3)]
    assert all(report.converged for report in reports)
    assert max(report.newton_iterations for report in reports) <= 4


def test_regular_meshes_keep_single_precision():
    plain = ts.Scene()
    plain.add_body(ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1)), rubber(), name="bar")
    with built(plain, "f32") as rig:
        assert rig.model.strain_real == rig.model.Dm_inv.dtype == ti.f32
