"""Steps in f32, in a file of their own, since a process holds one precision at a time:

* explicit and implicit ones follow the oracle to the rounding;
* with nothing to do, rounding is no reason for Newton to go on;
* a squeezed corotational cube comes to rest: steps end at the rounding of F and R, as converged;
* a state that f32 cannot hold is refused.
"""

import numpy as np
import pytest
from following import follow, simulator
from scenes import COR, cube, driven_scene, element, rubber

import taisoft as ts


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_euler"])
def test_single_precision_follows(integrator):
    """Positions are f64; velocities and forces are rounded to 6e-8, and a strain's rounding makes forces of 0.01 N."""
    scene, settings = driven_scene(mass_damping=3.0, order=2), {}
    if integrator == "implicit_euler":
        settings = {"newton_tolerance": 1e-7, "linear_tolerance": 1e-6}
    with simulator(scene, integrator, "f32", **settings) as sim:
        follow(sim, integrator, 9, 2e-5)


def test_nothing_to_do():
    """At rest and without weight, where positions and velocities are large: rounding is no reason to go on."""
    scene = ts.Scene(gravity=(0, 0, 0))
    flight = {"position": (300.0, -200.0, 100.0), "velocity": (20.0, 3.0, -7.0)}
    scene.add_body(cube(), rubber(young=1e7), **flight, **element(2))
    with ts.Simulator(scene, integrator="implicit_euler", precision="f32") as sim:
        assert sim._dynamics.stepper.tolerance == 1e-4 and sim._dynamics.stepper.linear_tolerance is None
        start = sim.positions()
        for _ in range(20):
            report = sim.step()
            assert report.converged and report.newton_iterations <= 3
        flown = start + sim.time * np.array([20.0, 3.0, -7.0])
        assert np.abs(sim.positions() - flown).max() < 1e-5 and report.elastic < 1e-3


def test_what_f32_cannot_hold_is_refused():
    with simulator(driven_scene(), "symplectic_euler", "f32") as sim:
        v = np.zeros((20, 3))
        v[17, 1] = 1e39
        with pytest.raises(ts.SceneError, match="velocities: node 17 is not finite or too large for f32"):
            sim.set_state(velocities=v)


def test_rounding_in_single_precision_ends_a_step():
    """A thin stiff sheet in f32: what rounding leaves of |r| lies above the tolerance and, once it bends, above the floor."""
    scene = ts.Scene()
    stiff = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0)
    sheet = scene.add_body(ts.box_mesh((10, 2, 5), (4, 0.05, 4)), stiff, name="sheet")
    sheet.fix(lambda X: np.abs(X[:, 0]) > 1.9)
    with ts.Simulator(scene, integrator="implicit_euler", dt=0.01, precision="f32") as sim:
        reports = [sim.step() for _ in range(20)]
    assert all(report.converged for report in reports)
    assert max(report.newton_iterations for report in reports) <= 6


def test_steps_end_at_the_rounding_of_a_squeezed_cube():
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
