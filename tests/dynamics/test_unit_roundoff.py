"""Single precision, in a file that sorts last because a process holds the kernels of one precision at a time:

* implicit steps follow the oracle to rounding, and Newton stops at rounding;
* forces on slivers are accurate: where a mesh has nearly flat tets, F = Ds Dm^-1 is formed in f64;
* a state that f32 cannot hold is rejected.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.fem.terms import elasticity
from tests.collision.rotations import rotation
from tests.dynamics.following import follow, simulator
from tests.dynamics.scenes import built, cube, dynamics, rubber


def test_steps_match_the_oracle():
    """Positions are f64; velocities and forces are rounded to 6e-8, and rounding of the strain causes forces of 0.01 N."""
    scene = ts.Scene()
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="beam", velocity=(0.4, 0.1, -0.2))
    body.fix(lambda X: X[:, 0] < -0.49)
    with simulator(scene, "implicit_euler", "f32", newton_tolerance=1e-7, linear_tolerance=1e-6) as sim:
        follow(sim, "implicit_euler", 9, 2e-5)
        v = np.zeros((12, 3))
        v[7, 1] = 1e39
        with pytest.raises(ts.SceneError, match="velocities: node 7 is not finite or too large for f32"):
            sim.set_state(velocities=v)


def test_rounding_of_large_positions_and_velocities_does_not_delay_convergence():
    """An undeformed body without weight: its residual is rounding only."""
    scene, velocity = ts.Scene(gravity=(0, 0, 0)), np.array([20.0, 3.0, -7.0])
    scene.add_body(cube(), rubber(young=1e7), position=(300.0, -200.0, 100.0), velocity=velocity)
    with dynamics(scene, integrator="implicit_euler", precision="f32") as made:
        assert made.stepper.tolerance == 1e-4 and made.stepper.linear_tolerance is None
        start = made.state.state()[0]
        for _ in range(20):
            report = made.advance(1)
            assert report.converged and report.newton_iterations <= 3
        assert np.abs(made.state.state()[0] - start - made.state.time * velocity).max() < 1e-5 and report.elastic < 1e-3


def test_thin_stiff_sheet_converges():
    """Rounding keeps the residual above the tolerance and, once the sheet bends, above the noise estimate."""
    scene = ts.Scene()
    stiff = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0)
    sheet = scene.add_body(ts.box_mesh((10, 2, 5), (4, 0.05, 4)), stiff, name="sheet")
    sheet.fix(lambda X: np.abs(X[:, 0]) > 1.9)
    with ts.Simulator(scene, integrator="implicit_euler", dt=0.01, precision="f32") as sim:
        reports = [sim.step() for _ in range(20)]
    assert all(report.converged for report in reports)
    assert max(report.newton_iterations for report in reports) <= 6


FLATNESS = 1e-4  # volume of the worst tet over the mean


def test_forces_on_slivers_match_the_oracle():
    """One inner vertex of a bar is close to the opposite faces of its tets. Regular meshes use single precision."""
    regular, simple = ts.box_mesh((4, 2, 2), (0.4, 0.1, 0.1)), ts.Scene()
    simple.add_body(regular, rubber(), name="bar")
    with built(simple, "f32") as rig:
        assert rig.model.groups[0].strain_real == rig.model.Dm_inv.dtype == ti.f32
    x = regular.vertices.copy()
    x[np.linalg.norm(x, axis=1).argmin(), 2] = 0.05 * (1.0 - FLATNESS)
    scene = ts.Scene(gravity=(0, -1, 0))
    with pytest.warns(UserWarning):
        mesh = ts.TetMesh(x, regular.tets)
    scene.add_body(mesh, rubber(), name="bar")
    with built(scene, "f32") as rig:
        assert rig.model.groups[0].strain_real == rig.model.Dm_inv.dtype == ti.f64
        rng, force = np.random.default_rng(3), rig.vectors("force")
        x = rig.oracle.rest @ rotation((1, 2, 3), 0.8).T + 1e-6 * rng.standard_normal(rig.oracle.rest.shape) + (3.0, -2.0, 1.0)
        rig.model.state.x.from_numpy(x)
        elasticity.elastic_forces(rig.model)
        elasticity.gather_forces(rig.model, force)
        # Strains of 1e-6 in flat tets cause about 1 % of stress; rounding of F to f32 would change a tenth of that.
        expected = rig.oracle.force(x)
        assert np.abs(force.to_numpy() - expected).max() < 1e-4 * np.abs(expected).max()
