"""What bodies must do to rounding whatever their elements: a linear one and quadratic ones of either quadrature in a scene.

* an affine motion of the surface is that of the inside, with one deformation gradient and one stress everywhere;
* a body that falls freely does not deform, and falls as the integrator would move a point;
* without a load the momentum stays, and the angular momentum with the integrators that conserve it;
* a body turned and shifted as a whole stores no energy and has no force.
"""

import numpy as np
import pytest
from oracle import Oracle
from scenes import COR, SNH, SVK, cube, element, rubber

import taisoft as ts
from taisoft.stepping import SCHEMES

KINDS = ((1, None), (2, 2), (2, 4))  # order, degree of the quadrature
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


def irregular(center) -> ts.TetMesh:
    """A cube of 40 tets whose inner vertex is none of the grid."""
    regular = cube(center, cells=(2, 2, 2))
    inside = (np.abs(regular.vertices - center) < [0.4, 0.4, 0.4]).all(axis=1)
    return ts.TetMesh(regular.vertices + np.outer(inside, [0.05, -0.08, 0.11]), regular.tets)


def test_patch():
    """Surface nodes on the map x = A X + b, those inside where the static solve puts them."""
    A, b = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [0.15, -0.25, 1.1]]), np.array([0.3, -0.2, 0.1])
    scene, exact, held = ts.Scene(gravity=(0, 0, 0)), [], []
    for k, ((order, degree), law) in enumerate(zip(KINDS, (COR, SNH, SVK))):
        mesh = irregular((2 * k, 0, 0))
        body = scene.add_body(mesh, rubber(law), **element(order, degree))
        X, size = body.rest_positions, np.array([0.5, 0.45, 0.55])
        held.append((np.abs(X - [2 * k, 0, 0]) > size - 1e-9).any(axis=1))
        exact.append(X @ A.T + b)
        body.move(held[-1], lambda t, way=(exact[-1] - X)[held[-1]]: way)
    result, oracle = ts.solve_static(scene, tolerance=1e-14), Oracle(scene)
    x, exact, held = result.positions(), np.concatenate(exact), np.concatenate(held)
    assert (~held).sum() == 1 + 2 * 27 and np.abs(x - exact)[~held].max() < 1e-12  # [m]
    for part in oracle.parts:
        assert np.abs(oracle.gradients(x, part) - A).max() < 1e-11
    assert np.abs(oracle.force(x)[~held]).max() < 1e-12 * 1e5  # [N] of young times m^2
    assert result.elastic == pytest.approx(oracle.energy(exact), rel=1e-12)


def free_bodies() -> ts.Scene:
    scene = ts.Scene()
    for k, (order, degree) in enumerate(KINDS):
        scene.add_body(cube((2 * k, 0, 0)), rubber(density=1000.0 + 200 * k), velocity=VELOCITY, **element(order, degree))
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
        simulators[name] = ts.Simulator(free_bodies(), DT, name, precision="f64", **tight)
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
    """Of bodies that tumble and vibrate; the angular one about the origin."""
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


def test_rigid_motion(simulators):
    if "symplectic_euler" not in simulators:
        simulators["symplectic_euler"] = ts.Simulator(free_bodies(), DT, "symplectic_euler", precision="f64")
    sim = simulators["symplectic_euler"]
    sim.reset()
    Q = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    Q = Q * np.linalg.det(Q)
    sim.set_state(sim.positions() @ Q.T + [10.0, -5.0, 3.0], np.cross((1.0, 2.0, 6.0), sim.positions()))
    assert sim.energies().elastic < 1e-13 * 1e5  # of young [J/m^3] times m^3
    assert np.abs(sim.elastic_forces()).max() < 1e-13 * 1e5  # [N]
    for body in sim.scene.bodies:
        assert np.abs(sim.stress(body.name)).max() < 1e-13 * 1e5  # [Pa]
