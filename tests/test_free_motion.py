"""A quadratic body that nothing holds, to rounding (linear ones are among the reference problems):

* one that falls freely does not deform, and falls as the integrator would move a point;
* without a load the momentum stays, and the angular momentum with the integrators that conserve it;
"""

import numpy as np
import pytest
from oracle import Oracle
from scenes import cube, rubber

import taisoft as ts
from taisoft.stepping import SCHEMES

INTEGRATORS = ("symplectic_euler", "velocity_verlet", *SCHEMES)
DT, STEPS = 1e-3, 20
FALL = {  # after n steps from rest, in units of g dt^2; BDF2's first step is one of implicit Euler, whose error goes on
    "symplectic_euler": lambda n: n * (n + 1) / 2,
    "implicit_euler": lambda n: n * (n + 1) / 2,
    "linearly_implicit_euler": lambda n: n * (n + 1) / 2,
    "velocity_verlet": lambda n: n * n / 2,
    "implicit_midpoint": lambda n: n * n / 2,
    "bdf2": lambda n: n * n / 2 + 0.75 * (1 - 3.0**-n),
}
ANGULAR = ("symplectic_euler", "velocity_verlet", "implicit_midpoint")  # conserve the angular momentum
VELOCITY = np.array([0.3, -0.2, 0.5])  # [m/s]


def free_body() -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(cube((2, 0, 0)), rubber(), velocity=VELOCITY, order=2, quadrature_degree=4)
    return scene


@pytest.fixture(scope="module")
def simulators():
    """By name, made when first asked for; one serves all implicit integrators, whose kernels differ in numbers only."""
    made: dict[str, ts.Simulator] = {}
    yield made
    for sim in made.values():
        sim.close()


@pytest.fixture(params=INTEGRATORS)
def moving(request, simulators, monkeypatch):
    """An integrator's name, and the simulator at its start."""
    implicit = request.param in SCHEMES
    name = "bdf2" if implicit else request.param
    if name not in simulators:
        tight = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13} if implicit else {}
        simulators[name] = ts.Simulator(free_body(), DT, name, precision="f64", **tight)
    sim = simulators[name]
    if implicit:
        monkeypatch.setattr(sim._stepper, "scheme", SCHEMES[request.param])
    sim.reset()
    return request.param, sim


def test_free_fall(moving):
    name, sim = moving
    start, gravity = sim.positions(), np.array([0.7, -9.81, -0.4])
    sim.set_gravity(gravity)
    for _ in range(STEPS):
        sim.step()
    exact = start + VELOCITY * sim.time + gravity * DT**2 * FALL[name](STEPS)
    assert np.abs(sim.positions() - exact).max() < 1e-12  # [m]
    assert np.abs(sim.velocities() - VELOCITY - gravity * sim.time).max() < 1e-9  # [m/s]: rounding of x over dt
    assert sim.energies().elastic < 1e-12 * sim.energies().kinetic


def test_momentum(moving):
    """Of a body that tumbles and vibrates; the angular one about the origin."""
    name, sim = moving
    M = Oracle(sim.scene).inertia(sim.settings.explicit)
    sim.set_gravity((0, 0, 0))
    v = np.cross((1.0, -2.0, 3.0), sim.positions()) + np.random.default_rng(0).standard_normal(sim.positions().shape)
    sim.set_state(velocities=v)

    def momenta():
        p = M @ sim.velocities()
        return p.sum(axis=0), np.cross(sim.positions(), p).sum(axis=0)

    linear, angular = momenta()
    for _ in range(STEPS):
        sim.step()
    assert sim.energies().elastic > 10.0  # [J]
    now_linear, now_angular = momenta()
    assert np.abs(now_linear - linear).max() < 1e-9 * np.abs(linear).max()
    change = np.abs(now_angular - angular).max() / np.abs(angular).max()
    assert change < 1e-9 if name in ANGULAR else 1e-9 < change < 1e-2
