"""The momentum of bodies, and the impulse law:

* a body that moves uniformly has mass times velocity, for either order and rigid bodies, in explicit and implicit steps;
* contact forces minus weight, times dt, are the change of momentum of each step.
"""

import numpy as np
import pytest

import taisoft as ts

GROUND = ts.HalfSpace((0, 0, 0), (0, 1, 0))
VELOCITY = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("integrator, dt", [("implicit_euler", 1e-2), ("velocity_verlet", 1e-5)])
def test_uniform_motion(integrator, dt):
    scene = ts.Scene()
    scene.contact_forces = False
    mesh = ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1))
    scene.add_body(mesh, ts.Material(young=1e5), name="linear", velocity=VELOCITY)
    scene.add_body(mesh, ts.Material(young=1e5, density=500.0), name="quadratic", velocity=VELOCITY, order=2)
    scene.add_rigid_body(mesh, density=2000.0, name="rigid", velocity=VELOCITY, young=1e7)
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
        for name, mass in (("linear", 2.0), ("quadratic", 1.0), ("rigid", 4.0)):
            assert np.allclose(sim.momentum(name), mass * VELOCITY, rtol=1e-12)
        assert np.allclose(sim.momentum(), 7.0 * VELOCITY, rtol=1e-12)
        with pytest.raises(ts.SceneError, match="nobody"):
            sim.momentum("nobody")


@pytest.mark.parametrize("integrator, dt", [("implicit_euler", 1 / 100), ("symplectic_euler", 2e-4)])
def test_impulse_law(integrator, dt):
    scene, rows = ts.Scene(), []
    mesh = ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1))
    body = scene.add_body(mesh, ts.Material(young=1e5), name="block", position=(0, 0.08, 0), velocity=(0.5, -3.0, 0.0))
    scene.add_obstacle(GROUND, name="ground")
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
        sim.run(0.05, lambda sim, *_: rows.append((sim.momentum("block"), sim.contact_force("block"))), fps=None)
    momentum, force = np.array(rows).transpose(1, 0, 2)
    change, impulse = np.diff(momentum, axis=0), dt * (force[1:] + body.mass * scene.gravity)
    assert np.abs(change).max() > 0.1 * np.abs(momentum).max()
    assert np.abs(change - impulse).max() < 1e-5 * np.abs(momentum).max()
