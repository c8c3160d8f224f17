"""Contacts of rigid bodies:

* sliding and sticking on an incline (stacks: tests/references);
* the torque of contacts changes the angular momentum; impacts keep momentum and angular momentum and follow Newton's law;
* restitution with every integrator; overlap at the start;
* the motions that impulses cause in explicit steps are orthonormal in the mass, and keep constrained axes.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.rigid_contacts import rigid_motions
from taisoft.fem.reference import lumped_mass
from tests.collision.rotations import rotation
from tests.dynamics.companion import opened
from tests.dynamics.test_rigid import G, box

GROUND = ts.HalfSpace(point=(0, 0, 0), normal=(0, 1, 0))
CUBE = ts.box_mesh(cells=(1, 1, 1), size=(0.5, 0.5, 0.5))
WALLS = ts.box_mesh(cells=(2, 2, 2), size=(1, 1, 1))


@pytest.mark.parametrize("friction", [0.49, 0.51])
def test_a_cube_slides_down_or_sticks_on_an_incline(friction):
    angle = np.arctan(0.5)
    scene = ts.Scene(gravity=(G * np.sin(angle), -G * np.cos(angle), 0))
    scene.add_rigid_body(WALLS, name="cube", position=(0, 0.5, 0), friction=friction)
    scene.add_obstacle(GROUND, friction=friction)
    with opened(scene, "implicit_euler", 1 / 120) as sim:
        assert sim.run(seconds=0.6).status == "ok"
        v, t = sim.twist("cube").velocity[0], sim.time
        expected = G * (np.sin(angle) - friction * np.cos(angle)) * t if friction < 0.5 else 0.0
        assert v == pytest.approx(expected, abs=0.01)


def test_contact_torque_changes_the_angular_momentum():
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="box", position=(0, 0.42, 0))
    scene.add_obstacle(ts.Sphere((0.3, -0.4, 0), 0.5))
    with opened(scene, "implicit_euler", 1e-3) as sim:
        inertia, touched = sim.scene.body("box").inertia[2, 2], False
        for _ in range(90):
            before = sim.twist("box").angular_velocity[2]
            sim.step()
            change, torque = (sim.twist("box").angular_velocity[2] - before) / sim.dt, sim.contact_torque("box")[2]
            assert inertia * change == pytest.approx(torque, abs=0.02 * inertia * 50.0)
            touched |= abs(torque) > 0.1 * inertia
        assert touched


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_an_impact_keeps_momentum_and_follows_newtons_law(restitution):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(WALLS, name="a", velocity=(2, 0, 0), restitution=restitution, friction=0.0)
    scene.add_rigid_body(WALLS, name="b", position=(1.1, 0.3 * (restitution == 0), 0), density=3000.0, friction=0.0)
    a, b = scene.bodies
    with opened(scene, "bdf2" if restitution == 0 else "implicit_euler", 1 / 240) as sim:
        assert sim.run(seconds=0.15).status == "ok"
        v, w = sim.twist("a").velocity, sim.twist("b").velocity
        assert np.allclose(a.mass * v + b.mass * w, a.mass * np.array([2.0, 0, 0]), atol=1e-5 * a.mass)
        change = (1 + restitution) * 0.75 * 2.0  # of the velocity of a
        if restitution:
            assert v[0] == pytest.approx(2.0 - change, abs=0.02) and w[0] == pytest.approx(change / 3.0, abs=0.02)
        assert w[0] > 0.3


SYMPLECTIC = pytest.param("symplectic_euler", marks=pytest.mark.long)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize("integrator", [SYMPLECTIC, "velocity_verlet", "linearly_implicit_euler", "implicit_euler", "bdf2"])
def test_a_body_rises_to_the_square_of_the_restitution(integrator, restitution):
    """A turned plank: without restitution it does not rebound."""
    plank = box((1.0, 0.1, 0.3)) if restitution == 0 else CUBE
    mesh = ts.TetMesh(plank.vertices @ rotation((0, 0, 1), 0.3 * (restitution == 0)).T, plank.tets)
    scene, height, dt = ts.Scene(), 0.1, 1 / 480
    scene.add_rigid_body(mesh, name="body", position=(0, height - mesh.vertices[:, 1].min(), 0), restitution=restitution)
    scene.add_obstacle(GROUND, restitution=restitution)
    fallen, speed = np.sqrt(2.0 * height / G), np.sqrt(2.0 * height * G)
    with opened(scene, integrator, dt) as sim:
        heights, speeds = [], []
        for _ in range(round(fallen * (1.1 + restitution) / dt)):
            sim.step()
            heights.append(sim.pose("body").translation[1])
            speeds.append(sim.twist("body").velocity[1])
        assert sim.rigid_strain("body") < 1e-4
    lowest = int(np.argmin(speeds))
    assert min(speeds) < -0.9 * speed  # it hit the ground
    rise = np.max(heights[lowest + 2 :]) - np.min(heights[lowest:])
    if restitution:
        assert np.sqrt(max(rise, 0.0) / height) == pytest.approx(restitution, abs=0.03)
    else:
        assert max(speeds[lowest:]) < 0.01 * speed


def test_explicit_impacts_keep_momentum_and_angular_momentum():
    """Also between rigid and soft bodies."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(CUBE, name="a", velocity=(4, 0, 0), restitution=0.5)
    scene.add_rigid_body(CUBE, density=300.0, name="b", position=(0.55, 0.2, 0.1))
    scene.add_body(CUBE, ts.Material(young=1e5), name="soft", position=(1.1, 0, 0))
    masses = np.concatenate(
        [
            np.pad(np.full(4, 0.25 * body.mass), (0, body.n_nodes - 4)) if body in scene.rigid_bodies else lumped_mass(body)
            for body in scene.bodies
        ]
    )
    momentum, n = 4.0 * scene.bodies[0].mass, len(masses)
    with opened(scene, "velocity_verlet", 5e-4, contact_tolerance=1e-4) as sim:

        def total():
            x, v = sim.positions()[:n], sim.velocities()[:n]
            return masses @ v, masses @ np.cross(x, v)

        start = total()
        assert sim.run(seconds=0.1).status == "ok"
        for before, after in zip(start, total()):
            assert np.allclose(before, after, atol=5e-4 * momentum)  # friction acts across the gap
        assert np.linalg.norm(sim.twist("b").angular_velocity) > 0.1 and np.abs(sim.velocities("soft")).max() > 0.1


def test_overlap_at_the_start():
    """Surfaces that cross without a vertex inside overlap; the nodes of the inertia tet, here in the hole of a frame, do not."""
    plate = box((2.0, 2.0, 0.2), (12, 12, 1))
    tets = plate.tets[np.abs(plate.vertices[plate.tets].mean(axis=1)[:, :2]).max(axis=1) > 10 / 12]
    used, tets = np.unique(tets, return_inverse=True)
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    frame = scene.add_rigid_body(ts.TetMesh(plate.vertices[used], tets.reshape(-1, 4)), name="frame")
    node = frame.mesh.vertices[0]
    assert np.abs(node[:2]).max() < 0.8
    scene.add_rigid_body(box((0.02, 0.02, 0.02)), name="inside", position=node)
    scene.add_rigid_body(box((2.0, 0.3, 0.3)), name="a", position=(0, 0, 3))
    scene.add_rigid_body(box((0.2, 0.2, 2.0)), name="b", position=(0, 0, 3))
    with opened(scene, "implicit_euler", 1 / 100) as sim:
        assert [(one.name_a, one.name_b) for one in sim.overlaps()] == [("a", "b")]


def test_motions_are_orthonormal_and_keep_constrained_axes():
    rng, mass = np.random.default_rng(1), np.full((3, 4), 2.5)
    x, free = rng.standard_normal((3, 4, 3)), np.ones((3, 3))
    free[1, 1], free[2] = 0.0, (1.0, 0.0, 0.0)  # in a plane, along a line
    B, weights = rigid_motions(mass, free, x), np.repeat(mass, 3, axis=1)
    for motions, own, n in zip(B, weights, (6, 3, 1)):
        values = np.linalg.eigvalsh(motions.T @ (own[:, None] * motions))
        assert np.allclose(values, [0.0] * (6 - n) + [1.0] * n, atol=1e-9)
    arms = x[0] - x[0].mean(axis=0)
    wanted = (np.cross((1.0, -2.0, 0.5), arms) + (0.3, 0.0, 1.0)).reshape(-1)  # a rigid motion is a sum of them
    assert np.allclose(B[0] @ (B[0].T @ (weights[0] * wanted)), wanted, atol=1e-12)
    assert np.abs(B[1].reshape(4, 3, 6)[:, 1]).max() < 1e-12 and np.abs(B[2].reshape(4, 3, 6)[:, 1:]).max() < 1e-12
