"""Single precision, in its own file because a process holds one precision at a time:

* explicit and implicit steps follow the oracle to rounding, and Newton stops at rounding;
* forces on slivers are accurate: where a mesh has nearly flat tets, F = Ds Dm^-1 is formed in f64;
* nearly incompressible bodies with mean dilatation follow double precision;
* a state that f32 cannot hold is rejected.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.fem.terms import elasticity
from tests.collision.rotations import rotation
from tests.dynamics.following import follow, simulator
from tests.dynamics.scenes import COR, built, cube, driven_scene, dynamics, element, rubber


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_euler"])
def test_steps_match_the_oracle(integrator):
    """Positions are f64; velocities and forces are rounded to 6e-8, and rounding of the strain causes forces of 0.01 N."""
    scene, settings = driven_scene(mass_damping=3.0, order=2), {}
    if integrator == "implicit_euler":
        settings = {"newton_tolerance": 1e-7, "linear_tolerance": 1e-6}
    with simulator(scene, integrator, "f32", **settings) as sim:
        follow(sim, integrator, 9, 2e-5)


def flying_cube() -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    flight = {"position": (300.0, -200.0, 100.0), "velocity": (20.0, 3.0, -7.0)}
    scene.add_body(cube(), rubber(young=1e7), **flight, **element(2))
    return scene


def test_rounding_of_large_positions_and_velocities_does_not_delay_convergence():
    """An undeformed body without weight: its residual is rounding only."""
    with ts.Simulator(flying_cube(), integrator="implicit_euler", precision="f32") as sim:
        start = sim.positions()
        for _ in range(20):
            report = sim.step()
            assert report.converged and report.newton_iterations <= 3
        flown = start + sim.time * np.array([20.0, 3.0, -7.0])
        assert np.abs(sim.positions() - flown).max() < 1e-5 and report.elastic < 1e-3


def test_default_tolerances():
    with dynamics(flying_cube(), integrator="implicit_euler", precision="f32") as system:
        assert system.stepper.tolerance == 1e-4 and system.stepper.linear_tolerance is None


def test_state_beyond_the_range_of_f32_is_rejected():
    with simulator(driven_scene(), "symplectic_euler", "f32") as sim:
        v = np.zeros((20, 3))
        v[17, 1] = 1e39
        with pytest.raises(ts.SceneError, match="velocities: node 17 is not finite or too large for f32"):
            sim.set_state(velocities=v)


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


def test_compressed_corotational_cube_converges():
    """Steps count as converged when the residual reaches the rounding of F and R."""
    scene = ts.Scene(gravity=(0, 0, 0))
    mesh = ts.box_mesh((4, 4, 4), (0.1, 0.1, 0.1), pattern="six")
    body = scene.add_body(mesh, rubber(COR), name="cube")
    body.fix(lambda X: X[:, 1] < -0.049)
    body.move(lambda X: X[:, 1] > 0.049, ts.KeyFrames([0.0, 0.2], [(0, 0, 0), (0, -0.05, 0)]))
    with ts.Simulator(scene, dt=0.01) as sim:
        reports = [sim.step() for _ in range(60)]
    assert all(report.converged for report in reports)
    assert max(report.newton_iterations for report in reports) <= 20
    assert reports[-1].min_volume_ratio < 0.6


# --- slivers ----------------------------------------------------------------------------------------------------------

FLATNESS = 1e-4  # volume of the worst tet over the mean


@pytest.fixture
def bar_with_slivers() -> ts.Scene:
    """A bar with one inner vertex moved close to the opposite faces of its tets."""
    regular = ts.box_mesh((4, 2, 2), (0.4, 0.1, 0.1))
    x = regular.vertices.copy()
    inner = np.linalg.norm(x, axis=1).argmin()
    x[inner, 2] = 0.05 * (1.0 - FLATNESS)
    scene = ts.Scene(gravity=(0, -1, 0))
    with pytest.warns(UserWarning):
        mesh = ts.TetMesh(x, regular.tets)
    scene.add_body(mesh, rubber("corotational"), name="bar").fix(lambda X: X[:, 0] < -0.199)
    return scene


def test_forces_on_slivers_match_the_oracle(bar_with_slivers):
    with built(bar_with_slivers, "f32") as rig:
        assert rig.model.strain_real == ti.f64 and rig.model.Dm_inv.dtype == ti.f64
        rng, force = np.random.default_rng(3), rig.vectors("force")
        x = rig.oracle.rest @ rotation((1, 2, 3), 0.8).T + 1e-6 * rng.standard_normal(rig.oracle.rest.shape) + (3.0, -2.0, 1.0)
        rig.model.state.x.from_numpy(x)
        elasticity.elastic_forces(rig.model)
        elasticity.gather_forces(rig.model, force)
        # Strains of 1e-6 in flat tets cause about 1 % of stress; rounding of F to f32 would change a tenth of that.
        expected = rig.oracle.force(x)
        assert np.abs(force.to_numpy() - expected).max() < 1e-4 * np.abs(expected).max()


def test_steps_with_slivers_converge(bar_with_slivers):
    with ts.Simulator(bar_with_slivers, dt=0.01) as sim:
        reports = [sim.step() for _ in range(3)]
    assert all(report.converged for report in reports)
    assert max(report.newton_iterations for report in reports) <= 4


def test_regular_meshes_use_single_precision():
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1)), rubber(), name="bar")
    with built(scene, "f32") as rig:
        assert rig.model.strain_real == rig.model.Dm_inv.dtype == ti.f32


def test_nearly_incompressible_bodies_follow_double_precision():
    ends = []
    for precision in ("f32", "f64"):
        scene = ts.Scene()
        body = scene.add_body(ts.box_mesh((6, 2, 2), (3, 1, 1)), ts.Material(young=1e6, poisson=0.499), dilatation="mean")
        body.fix(lambda X: X[:, 0] < -1.49)
        with ts.Simulator(scene, dt=1 / 60, precision=precision) as sim:
            reports = [sim.step() for _ in range(20)]
            assert all(r.converged and not r.problems for r in reports)
            ends.append(sim.positions())
    assert np.abs(ends[0] - ends[1]).max() < 1e-3 * np.ptp(ends[1])
