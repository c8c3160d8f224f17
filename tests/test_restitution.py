"""Restitution of bodies that are soft, in steps that do not resolve their vibrations; one simulator serves all implicit schemes:

* a cube that falls on a plane returns to the height that its restitution promises, again and again, and comes to rest where that
  is below 1; a step's length, the height of the fall and a slope do not change that;
* energy is never created: not by falls, nor by spins with friction, nor by vibrations, nor by a throw, nor in explicit steps;
* two that meet part with the restitution's share of their speed, and keep their momentum; a plane that moves gives twice its
  speed.
Energies are told over that at the start, of which the ground is the zero.
"""

import numpy as np
import pytest
from rotations import rotation
from scenes import rows_of

import taisoft as ts
from taisoft.dynamics.schemes import SCHEMES

SIDE, HEIGHT, DT, G = 0.1, 0.1, 5e-3, 9.81  # [m], [m], [s], [m/s^2]
CREATED = 0.005  # of the energy at the start, at most


class Lift:
    """A plane's path that tests may change."""

    speed = 0.0

    def __call__(self, t: float):
        return np.array([0.0, self.speed * t, 0.0]), np.eye(3)


def rubber(law: str = "corotational") -> ts.Material:
    return ts.Material(law=law, young=1e6, poisson=0.3, density=1000.0)


def opened(integrator: str = "bdf2", cells: int = 4, precision: str = "f64", law: str = "corotational", dt: float = DT):
    scene = ts.Scene(gravity=(0, -G, 0))
    scene.add_body(ts.box_mesh((cells,) * 3, (SIDE,) * 3), rubber(law), name="cube", position=(0, SIDE / 2 + HEIGHT, 0))
    scene.add_body(ts.box_mesh((2,) * 3, (SIDE,) * 3), rubber(law), name="other", position=(50, 0.5 * SIDE, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", path=Lift())
    return ts.Simulator(scene, dt=dt, integrator=integrator, precision=precision)


@pytest.fixture(scope="module")
def shared_sim():
    with opened() as sim:
        yield sim


@pytest.fixture
def sim(shared_sim, monkeypatch):
    """The simulator at its start, its steps those of implicit Euler; nothing holds on or bounces."""
    monkeypatch.setattr(shared_sim._dynamics.stepper, "scheme", SCHEMES["implicit_euler"])
    restart(shared_sim)
    return shared_sim


def restart(sim) -> None:
    sim.scene.obstacle("ground").path.speed = 0.0
    sim.dt = DT
    sim.set_gravity((0, -G, 0))
    for other in ("ground", "other"):
        sim.set_contact("cube", other, friction=0.0, restitution=0.0)
    sim.set_contact("other", "ground", friction=0.0, restitution=0.0)
    sim.reset()


def place(sim, height: float, v=(0, 0, 0), turned: tuple = (0, 0, 0), spin: tuple = (0, 0, 0)) -> None:
    """The cube's lowest point at a height [m], turned by a vector [rad], with a velocity and a spin [rad/s]."""
    x = sim.positions("cube")
    x = (x - x.mean(axis=0)) @ rotation(turned, np.linalg.norm(turned)).T if any(turned) else x - x.mean(axis=0)
    v = np.asarray(v, dtype=float) + np.cross(spin, x)
    sim.set_state(positions=x + (0, height - x[:, 1].min(), 0), velocities=v, body="cube")


def go(sim, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Energies [J] of the cube and its neighbour, and the height of the cube's centre [m], at the start and after each step."""
    mass = sim._dynamics.state.model.mass.to_numpy()[rows_of(sim, "cube"), None]
    energies, heights = [], []
    end = sim.step_count + round(seconds / sim.dt)
    while True:
        now = sim.energies()
        energies.append(now.kinetic + now.elastic + now.gravity)
        heights.append(float((mass * sim.positions("cube")).sum(axis=0)[1] / mass.sum()))
        if sim.step_count >= end:
            return np.array(energies), np.array(heights)
        report = sim.step()
        assert report.converged, report


def tops(heights: np.ndarray) -> np.ndarray:
    """Heights of the rebounds [m]: the peaks of the centre above its place at rest."""
    h = heights - SIDE / 2
    return h[1:-1][(h[1:-1] >= h[:-2]) & (h[1:-1] > h[2:]) & (h[1:-1] > 0.01 * HEIGHT)]


def created(energies: np.ndarray, start: float) -> float:
    """The most energy that ever was above that at the start, over `start` [J]."""
    return float((energies - energies[0]).max() / start)


def test_single_precision():
    """First in this file, before the simulator in double precision opens; of the other law."""
    with opened("implicit_euler", precision="f32", law="stable_neo_hookean") as sim:
        sim.set_contact("cube", "ground", friction=0.5, restitution=1.0)
        energies, heights = go(sim, 0.7)
    assert created(energies, G * HEIGHT) < CREATED and tops(heights).min() > 0.95 * HEIGHT


@pytest.mark.parametrize(
    "scheme, friction", [("implicit_euler", 0.0), ("implicit_euler", 0.5), ("linearly_implicit_euler", 0.5), ("bdf2", 0.5)]
)
def test_returns_to_its_height(sim, monkeypatch, scheme, friction):
    monkeypatch.setattr(sim._dynamics.stepper, "scheme", SCHEMES[scheme])
    sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
    energies, heights = go(sim, 0.7)
    assert created(energies, G * HEIGHT) < CREATED
    assert len(tops(heights)) == 2 and tops(heights).min() > 0.95 * HEIGHT and tops(heights).max() < 1.001 * HEIGHT


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_ten_seconds(sim, friction):
    sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
    energies, heights = go(sim, 10.0)
    found = tops(heights)
    assert created(energies, G * HEIGHT) < CREATED and len(found) > 30
    assert found[0] > 0.95 * HEIGHT and (found[1:] / found[:-1]).min() > 0.99


@pytest.mark.parametrize(
    "restitution, dt, height", [(0.5, 5e-3, 0.1), (0.8, 5e-3, 0.1), (0.8, 5e-3, 0.3), (0.8, 1e-2, 0.1), (0.8, 2e-3, 0.1)]
)
def test_height_is_the_square_of_restitution(sim, restitution, dt, height):
    sim.dt = dt
    sim.set_contact("cube", "ground", restitution=restitution)
    place(sim, height)
    energies, heights = go(sim, 2.5 * (2 * height / G) ** 0.5)
    top = tops(heights)[0] / height
    assert created(energies, G * height) < 1e-4 and top == pytest.approx(restitution**2, abs=0.05)


def test_comes_to_rest(sim):
    sim.set_contact("cube", "ground", friction=0.5, restitution=0.5)
    go(sim, 1.0)
    assert np.abs(sim.velocities("cube")).max() < 1e-4 and not sim._dynamics.contact.problem.impact_impulse.to_numpy().any()
    assert sim.contact_force("cube")[1] == pytest.approx(G, rel=1e-3)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_spins_throws_and_vibrations_create_no_energy(sim, friction):
    """A cube thrown at the plane, on an edge, spinning; then the same, and shaken within."""
    sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
    for shaken in (0.0, 0.7):
        sim.reset()
        place(sim, 0.01, (1.0, -2.0, 0.3), (0.5, 0.2, 0.3), (3.0, 5.0, -8.0))
        rng, v = np.random.default_rng(1), sim.velocities("cube")
        sim.set_state(velocities=v + shaken * rng.standard_normal(v.shape), body="cube")
        energies, _ = go(sim, 0.6)
        assert created(energies, energies[0] - G * SIDE / 2) < 1e-3  # less what its neighbour has


def test_slope(sim):
    """A plane that slopes by 20 degrees is gravity that does; the cube leaves as light from a mirror."""
    slope = np.radians(20.0)
    sim.set_gravity((G * np.sin(slope), -G * np.cos(slope), 0.0))
    sim.set_contact("cube", "ground", restitution=1.0)
    sim.set_contact("other", "ground", friction=1.0)
    energies, heights = go(sim, 0.45)
    assert created(energies, G * HEIGHT) < CREATED and tops(heights)[0] > 0.95 * HEIGHT


@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_two_that_meet(sim, restitution):
    sim.set_gravity((0, 0, 0))
    sim.set_contact("cube", "other", friction=0.3, restitution=restitution)
    x = sim.positions("other")
    sim.set_state(positions=x - x.mean(axis=0) + (1.5 * SIDE, 1.02, 0.01), body="other")
    x = sim.positions("cube")
    sim.set_state(positions=x - x.mean(axis=0) + (0, 1.0, 0), velocities=np.tile([1.5, 0.0, 0.0], (len(x), 1)), body="cube")
    energies, _ = go(sim, 0.15)
    mass = sim._dynamics.state.model.mass.to_numpy()[:, None]
    momentum = (mass * sim.velocities()).sum(axis=0)
    (a, b) = ((mass[s] * sim.velocities()[s]).sum(axis=0) for s in (rows_of(sim, "cube"), rows_of(sim, "other")))
    assert np.abs(momentum - (1.5, 0, 0)).max() < 1e-6 and created(energies, energies[0]) < 1e-6
    assert (b - a)[0] == pytest.approx(1.5 * restitution, rel=0.1)  # off centre: some of it turns them


def test_a_plane_that_moves(sim):
    sim.set_gravity((0, 0, 0))
    sim.set_contact("cube", "ground", restitution=1.0)
    sim.scene.obstacle("ground").path.speed = 1.0
    place(sim, 0.02)
    sim.set_state(positions=sim.positions("other") + (0, 5.0, 0), body="other")
    _, heights = go(sim, 0.1)
    assert (heights[-1] - heights[-2]) / DT == pytest.approx(2.0, rel=0.02)


def test_explicit_steps():
    """What is left is the error of the scheme, which falls with the square of the step."""
    with opened("velocity_verlet", 2, dt=1e-4) as sim:
        sim.set_contact("cube", "ground", restitution=1.0)
        place(sim, 0.002, (0, -1.4, 0))
        energies, _ = go(sim, 0.012)
    assert created(energies, 0.98) < CREATED
