"""Restitution of soft bodies, in steps too long to resolve their vibrations:

* a cube that falls on a plane rebounds to restitution^2 times its height, whatever step and height, and comes to rest;
* energy is never created: by falls, spins with friction, vibrations or throws;
* two bodies separate at restitution times their approach speed and keep their momentum; a moving plane imparts twice its speed.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem.reference import lumped_masses
from tests.collision.rotations import rotation
from tests.dynamics.contact_scenes import ground, material
from tests.dynamics.scenes import rows_of

SIDE, HEIGHT, DT, G = 0.1, 0.1, 5e-3, 9.81  # [m], [m], [s], [m/s^2]
PAIRS = ("cube", "ground"), ("cube", "other"), ("other", "ground")


class Rising:
    """A plane's path; tests change its speed [m/s]."""

    speed = 0.0

    def __call__(self, t: float):
        return np.array([0.0, self.speed * t, 0.0]), np.eye(3)


def prepare(sim) -> None:
    """Back to the initial state, undamped, without friction or restitution."""
    sim.scene.obstacle("ground").path.speed = 0.0
    sim.dt = DT
    sim.set_gravity((0, -G, 0))
    for name in ("cube", "other"):
        sim.set_material(name, mass_damping=0.0)
    for pair in PAIRS:
        sim.set_contact(*pair, friction=0.0, restitution=0.0)
    sim.reset()


def simulator(integrator: str) -> ts.Simulator:
    """A cube at HEIGHT above the ground, and a second one at rest far away."""
    scene = ts.Scene(gravity=(0, -G, 0))
    rubber = material(young=1e6)
    scene.add_body(ts.box_mesh((2,) * 3, (SIDE,) * 3), rubber, name="cube", position=(0, SIDE / 2 + HEIGHT, 0))
    scene.add_body(ts.box_mesh((2,) * 3, (SIDE,) * 3), rubber, name="other", position=(50, 0.5 * SIDE, 0))
    scene.add_obstacle(ground(), name="ground", path=Rising())
    sim = ts.Simulator(scene, DT, integrator, precision="f64")
    prepare(sim)
    return sim


@pytest.fixture(scope="module")
def shared_sim(taken_path):
    with simulator("implicit_euler") as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    """Implicit Euler from the initial state."""
    prepare(shared_sim)
    return shared_sim


def place(sim, height: float, v=(0, 0, 0), turn: float = 0.0, spin: tuple = (0, 0, 0)) -> None:
    """Put the cube's lowest point at a height [m], rotated [rad], with a velocity and a spin [rad/s]."""
    x = sim.positions("cube")
    x = (x - x.mean(axis=0)) @ rotation((0.5, 0.2, 0.3), turn).T
    sim.set_state(x + (0, height - x[:, 1].min(), 0), np.asarray(v) + np.cross(spin, x), body="cube")


def run(sim, seconds: float) -> tuple[float, np.ndarray]:
    """Largest gain of energy [J], and heights of the cube's centre above its rest [m] at the start and after each step."""
    mass = lumped_masses(sim.scene)[rows_of(sim, "cube"), None]
    energies, heights = [], []
    end = sim.step_count + round(seconds / sim.dt)
    while True:
        energies.append(sim.energies().total)
        heights.append(float((mass * sim.positions("cube")).sum(axis=0)[1] / mass.sum()) - SIDE / 2)
        if sim.step_count >= end:
            return max(energies) - energies[0], np.array(heights)
        report = sim.step()
        assert report.converged, report


def rebound(h: np.ndarray) -> float:
    """First peak of heights [m]."""
    return h[1:-1][(h[1:-1] >= h[:-2]) & (h[1:-1] > h[2:]) & (h[1:-1] > 0.01 * HEIGHT)][0]


@pytest.mark.parametrize("integrator, friction", [("implicit_euler", 0.0), ("linearly_implicit_euler", 0.5), ("bdf2", 0.5)])
def test_an_elastic_cube_returns_to_its_height(integrator, friction):
    with simulator(integrator) as sim:
        sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
        gain, heights = run(sim, 0.36)
    assert gain < 0.005 * G * HEIGHT and 0.95 * HEIGHT < rebound(heights) < 1.001 * HEIGHT  # of 1 kg


@pytest.mark.parametrize("restitution, dt, height", [(0.5, 5e-3, 0.1), (0.8, 1e-2, 0.2)])
def test_the_rebound_height_is_the_square_of_the_restitution(sim, restitution, dt, height):
    sim.dt = dt
    sim.set_contact("cube", "ground", restitution=restitution)
    place(sim, height)
    gain, heights = run(sim, 2.5 * (2 * height / G) ** 0.5)
    assert gain < 1e-4 * G * height and rebound(heights) / height == pytest.approx(restitution**2, abs=0.05)


def test_an_inelastic_cube_comes_to_rest(sim):
    sim.set_contact("cube", "ground", friction=0.5, restitution=0.5)
    place(sim, 0.02)
    run(sim, 0.45)
    assert np.abs(sim.velocities("cube")).max() < 1e-3
    assert sim.contact_force("cube")[1] == pytest.approx(G * sim.scene.body("cube").mass, rel=1e-2)


def test_spins_throws_and_vibrations_create_no_energy(sim):
    """A cube thrown on an edge, spinning, without and with internal vibration."""
    for friction, amplitude in ((0.0, 0.0), (0.5, 0.7)):
        sim.reset()
        sim.set_contact("cube", "ground", friction=friction, restitution=1.0)
        place(sim, 0.01, (1.0, -2.0, 0.3), 0.6, (3.0, 5.0, -8.0))
        rng, v = np.random.default_rng(1), sim.velocities("cube")
        sim.set_state(velocities=v + amplitude * rng.standard_normal(v.shape), body="cube")
        start = sim.energies()
        assert run(sim, 0.2)[0] < 1e-3 * (start.kinetic + start.elastic)


@pytest.mark.gpu_path
def test_two_colliding_cubes_separate_by_their_restitution(sim):
    sim.set_gravity((0, 0, 0))
    sim.set_contact("cube", "other", friction=0.3, restitution=0.5)
    x = sim.positions("other")
    sim.set_state(positions=x - x.mean(axis=0) + (1.5 * SIDE, 1.02, 0.01), body="other")
    x = sim.positions("cube")
    sim.set_state(positions=x - x.mean(axis=0) + (0, 1.0, 0), velocities=np.tile([1.5, 0.0, 0.0], (len(x), 1)), body="cube")
    gain, _ = run(sim, 0.15)
    mass = lumped_masses(sim.scene)[:, None]
    momentum = (mass * sim.velocities()).sum(axis=0)
    (a, b) = ((mass[s] * sim.velocities()[s]).sum(axis=0) for s in (rows_of(sim, "cube"), rows_of(sim, "other")))
    assert np.abs(momentum - (1.5, 0, 0)).max() < 1e-6 and gain < 1e-6
    assert (b - a)[0] == pytest.approx(1.5 * 0.5, rel=0.1)  # off centre: some energy goes into rotation


@pytest.mark.gpu_path
def test_a_moving_plane_imparts_twice_its_speed(sim):
    sim.set_gravity((0, 0, 0))
    sim.set_contact("cube", "ground", restitution=1.0)
    sim.scene.obstacle("ground").path.speed = 1.0
    place(sim, 0.02)
    sim.set_state(positions=sim.positions("other") + (0, 5.0, 0), body="other")
    _, heights = run(sim, 0.1)
    assert (heights[-1] - heights[-2]) / DT == pytest.approx(2.0, rel=0.02)
