"""Restitution of soft bodies, in steps too long to resolve their vibrations:

* a cube that falls on a plane rebounds to restitution^2 times its height, again and again, and comes to rest if restitution < 1;
  step length and drop height do not matter;
* energy is never created: by falls, spins with friction, vibrations or throws;
* two bodies separate at restitution times their approach speed and keep their momentum; a moving plane imparts twice its speed.

Energies are relative to the initial one; the potential is zero at the ground.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem.reference import lumped_masses
from tests.collision.rotations import rotation
from tests.dynamics.contact_scenes import ground, material
from tests.dynamics.scenes import rows_of

SIDE, HEIGHT, DT, G = 0.1, 0.1, 5e-3, 9.81  # [m], [m], [s], [m/s^2]
MAX_GAIN = 0.005  # of the initial energy
PAIRS = ("cube", "ground"), ("cube", "other"), ("other", "ground")


class Rising:
    """A plane's path; tests change its speed [m/s]."""

    speed = 0.0

    def __call__(self, t: float):
        return np.array([0.0, self.speed * t, 0.0]), np.eye(3)


def simulator(integrator: str) -> ts.Simulator:
    """A cube at HEIGHT above the ground, and a second one at rest far away; undamped, without friction or restitution."""
    scene = ts.Scene(gravity=(0, -G, 0))
    rubber = material(young=1e6)
    scene.add_body(ts.box_mesh((3,) * 3, (SIDE,) * 3), rubber, name="cube", position=(0, SIDE / 2 + HEIGHT, 0))
    scene.add_body(ts.box_mesh((2,) * 3, (SIDE,) * 3), rubber, name="other", position=(50, 0.5 * SIDE, 0))
    scene.add_obstacle(ground(), name="ground", path=Rising())
    for pair in PAIRS:
        scene.set_contact(*pair, friction=0.0, restitution=0.0)
    sim = ts.Simulator(scene, DT, integrator, precision="f64")
    for name in ("cube", "other"):
        sim.set_material(name, mass_damping=0.0)
    return sim


@pytest.fixture(scope="module")
def shared_sim():
    with simulator("implicit_euler") as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    """Implicit Euler from the initial state, without friction or restitution."""
    sim = shared_sim
    sim.scene.obstacle("ground").path.speed = 0.0
    sim.dt = DT
    sim.set_gravity((0, -G, 0))
    for pair in PAIRS:
        sim.set_contact(*pair, friction=0.0, restitution=0.0)
    sim.reset()
    return sim


def place(sim, height: float, v=(0, 0, 0), rotation_vector: tuple = (0, 0, 0), spin: tuple = (0, 0, 0)) -> None:
    """Put the cube's lowest point at a height [m], rotated by a vector [rad], with a velocity and a spin [rad/s]."""
    x = sim.positions("cube")
    x = x - x.mean(axis=0)
    if any(rotation_vector):
        x = x @ rotation(rotation_vector, np.linalg.norm(rotation_vector)).T
    v = np.asarray(v, dtype=float) + np.cross(spin, x)
    sim.set_state(positions=x + (0, height - x[:, 1].min(), 0), velocities=v, body="cube")


def run(sim, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Total energies [J] and heights of the cube's centre of mass [m], at the start and after each step."""
    mass = lumped_masses(sim.scene)[rows_of(sim, "cube"), None]
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


def rebound_heights(heights: np.ndarray) -> np.ndarray:
    """Peaks of the centre above its height at rest [m]."""
    h = heights - SIDE / 2
    return h[1:-1][(h[1:-1] >= h[:-2]) & (h[1:-1] > h[2:]) & (h[1:-1] > 0.01 * HEIGHT)]


def energy_gain(energies: np.ndarray, initial: float) -> float:
    """Largest rise above the initial energy, relative to `initial` [J]."""
    return float((energies - energies[0]).max() / initial)


@pytest.mark.parametrize("integrator, friction", [("implicit_euler", 0.0), ("linearly_implicit_euler", 0.5), ("bdf2", 0.5)])
def test_an_elastic_cube_returns_to_its_height(integrator, friction):
    with simulator(integrator) as sim:
        sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
        energies, heights = run(sim, 0.7)
    rebounds = rebound_heights(heights)
    assert energy_gain(energies, G * HEIGHT) < MAX_GAIN
    assert len(rebounds) == 2 and rebounds.min() > 0.95 * HEIGHT and rebounds.max() < 1.001 * HEIGHT


@pytest.mark.parametrize("restitution, dt, height", [(0.5, 5e-3, 0.1), (0.8, 5e-3, 0.3), (0.8, 1e-2, 0.1)])
def test_the_rebound_height_is_the_square_of_the_restitution(sim, restitution, dt, height):
    sim.dt = dt
    sim.set_contact("cube", "ground", restitution=restitution)
    place(sim, height)
    energies, heights = run(sim, 2.5 * (2 * height / G) ** 0.5)
    assert energy_gain(energies, G * height) < 1e-4
    assert rebound_heights(heights)[0] / height == pytest.approx(restitution**2, abs=0.05)


def test_an_inelastic_cube_comes_to_rest(sim):
    sim.set_contact("cube", "ground", friction=0.5, restitution=0.5)
    place(sim, 0.02)
    run(sim, 0.6)
    assert np.abs(sim.velocities("cube")).max() < 1e-3
    assert sim.contact_force("cube")[1] == pytest.approx(G * sim.scene.body("cube").mass, rel=1e-2)


def test_spins_throws_and_vibrations_create_no_energy(sim):
    """A cube thrown on an edge, spinning, without and with internal vibration."""
    for friction, amplitude in ((0.0, 0.0), (0.5, 0.7)):
        sim.reset()
        sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
        place(sim, 0.01, (1.0, -2.0, 0.3), (0.5, 0.2, 0.3), (3.0, 5.0, -8.0))
        rng, v = np.random.default_rng(1), sim.velocities("cube")
        sim.set_state(velocities=v + amplitude * rng.standard_normal(v.shape), body="cube")
        energies, _ = run(sim, 0.3)
        assert energy_gain(energies, energies[0] - G * SIDE / 2) < 1e-3  # without the potential of the other cube


@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_two_colliding_cubes_separate_by_their_restitution(sim, restitution):
    sim.set_gravity((0, 0, 0))
    sim.set_contact("cube", "other", friction=0.3, restitution=restitution)
    x = sim.positions("other")
    sim.set_state(positions=x - x.mean(axis=0) + (1.5 * SIDE, 1.02, 0.01), body="other")
    x = sim.positions("cube")
    sim.set_state(positions=x - x.mean(axis=0) + (0, 1.0, 0), velocities=np.tile([1.5, 0.0, 0.0], (len(x), 1)), body="cube")
    energies, _ = run(sim, 0.15)
    mass = lumped_masses(sim.scene)[:, None]
    momentum = (mass * sim.velocities()).sum(axis=0)
    (a, b) = ((mass[s] * sim.velocities()[s]).sum(axis=0) for s in (rows_of(sim, "cube"), rows_of(sim, "other")))
    assert np.abs(momentum - (1.5, 0, 0)).max() < 1e-6 and energy_gain(energies, energies[0]) < 1e-6
    assert (b - a)[0] == pytest.approx(1.5 * restitution, rel=0.1)  # off centre: some energy goes into rotation


def test_a_moving_plane_imparts_twice_its_speed(sim):
    sim.set_gravity((0, 0, 0))
    sim.set_contact("cube", "ground", restitution=1.0)
    sim.scene.obstacle("ground").path.speed = 1.0
    place(sim, 0.02)
    sim.set_state(positions=sim.positions("other") + (0, 5.0, 0), body="other")
    _, heights = run(sim, 0.1)
    assert (heights[-1] - heights[-2]) / DT == pytest.approx(2.0, rel=0.02)
