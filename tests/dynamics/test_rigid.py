"""Rigid bodies: moments, motion against Euler's equations, contacts, constraints, attachments, refusals, files, checkpoints."""

import meshio
import numpy as np
import pytest
import scipy.integrate

import taisoft as ts
from taisoft.fem.reference import lumped_mass
from taisoft.mesh.solids import shell_tets
from taisoft.output.frame_files import body_arrays
from taisoft.output.nodal_fields import NodalMean
from taisoft.output.usd import UsdWriter
from taisoft.output.usd_scene import IMPULSE
from taisoft.scene import rigid
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.plan import make_plan
from taisoft.scene.refine import refined, with_order
from taisoft.settings import plan_of
from taisoft.stability import modes
from taisoft.view.colouring import NodalValues
from tests.cli.command import write

G = 9.81
SIZE = (1.0, 0.6, 0.3)
GROUND = ts.HalfSpace(point=(0, 0, 0), normal=(0, 1, 0))
CLOSED_WALLS = ts.box_mesh(cells=(2, 2, 2), size=(1, 1, 1))


def surface_of(mesh: ts.TetMesh) -> ts.SurfaceMesh:
    used, triangles = np.unique(mesh.surface, return_inverse=True)
    return ts.SurfaceMesh(mesh.vertices[used], triangles.reshape(-1, 3))


def box(size=SIZE, cells=(1, 1, 1)) -> ts.TetMesh:
    return ts.box_mesh(cells=cells, size=size)


def a_rotation(seed: int = 0) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


# --- moments -----------------------------------------------------------------------------------------------------------


def test_moments_of_a_turned_box_are_those_of_the_closed_form():
    R, shift = a_rotation(), np.array([3.0, -2.0, 5.0])
    mesh = box()
    turned = ts.TetMesh(mesh.vertices @ R.T + shift, mesh.tets)
    volume, centre, covariance = rigid.volume_moments(turned.vertices, turned.surface)
    assert volume == pytest.approx(np.prod(SIZE), rel=1e-13)
    assert np.allclose(centre, shift, atol=1e-13)
    assert np.allclose(covariance, R @ np.diag(np.square(SIZE)) @ R.T / 12.0, atol=1e-14)


def test_moments_of_a_hollow_surface_agree_with_a_sum_over_tets():
    mesh = ts.ball_mesh(radius=0.7, cells=4)
    volume, centre, covariance = rigid.volume_moments(mesh.vertices, mesh.surface)
    x = mesh.vertices[mesh.tets]
    total = x.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", mesh.volumes, x, x) + np.einsum("t,ti,tj->ij", mesh.volumes, total, total)
    own = mesh.volumes @ total / 4.0 / mesh.volumes.sum()
    assert volume == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    assert np.allclose(centre, own, atol=1e-14)
    assert np.allclose(covariance, second / 20.0 / volume - np.outer(own, own), atol=1e-14)


def test_four_equal_masses_have_the_mass_centre_and_inertia_of_the_body():
    R = a_rotation(1)
    mesh = box()
    body = ts.Scene().add_rigid_body(ts.TetMesh(mesh.vertices @ R.T + 1.0, mesh.tets), density=700.0)
    x, m = body.mesh.vertices - body.centre, np.full(4, 0.25 * body.mass)
    assert body.mass == pytest.approx(700.0 * np.prod(SIZE), rel=1e-12)
    assert np.allclose(m @ x, 0.0, atol=1e-12)
    inertia = np.einsum("a,ai,ai->", m, x, x) * np.eye(3) - np.einsum("a,ai,aj->ij", m, x, x)
    exact = body.mass / 12.0 * (np.sum(np.square(SIZE)) * np.eye(3) - np.diag(np.square(SIZE)))
    assert np.allclose(inertia, R @ exact @ R.T, rtol=1e-12)
    assert np.allclose(body.inertia, R @ exact @ R.T, rtol=1e-12)
    embedded = body.nodes.embedded @ body.mesh.vertices
    assert np.allclose(embedded, body.surface.vertices, atol=1e-13)


def test_tets_and_their_surface_give_the_same_body():
    scene = ts.Scene()
    mesh = box(cells=(2, 1, 3))
    a, b = scene.add_rigid_body(mesh), scene.add_rigid_body(surface_of(mesh))
    assert np.array_equal(a.rest_positions, b.rest_positions) and np.array_equal(a.nodes.surface, b.nodes.surface)


# --- motion ------------------------------------------------------------------------------------------------------------


def euler_top(inertia: np.ndarray, spin: np.ndarray, seconds: float):
    """Rotation and angular velocity in space as functions of time, of a torque-free body with principal moments."""
    I = inertia

    def rate(_, y):
        w, R = y[:3], y[3:].reshape(3, 3)
        turn = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([np.cross(I * w, w) / I, (R @ turn).ravel()])

    start = np.concatenate([spin, np.eye(3).ravel()])
    return scipy.integrate.solve_ivp(rate, (0, seconds), start, rtol=1e-11, atol=1e-12, dense_output=True).sol


def test_a_top_spinning_about_its_middle_axis_follows_eulers_equations_over_ten_turns():
    spin = 2 * np.pi * np.array([0.01, 1.0, 0.0])
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_rigid_body(box(), density=500.0, name="top", angular_velocity=spin)
    exact = euler_top(np.diag(body.inertia), spin, 10.0)
    flipped = 0.0
    with ts.Simulator(scene, dt=1 / 800, integrator="implicit_midpoint", precision="f64") as sim:
        for _ in range(100):
            sim.run(seconds=0.1)
            y = exact(sim.time)
            R, w = y[3:].reshape(3, 3), y[3:].reshape(3, 3) @ y[:3]
            assert np.abs(sim.pose("top").rotation - R).max() < 0.005
            assert np.linalg.norm(sim.twist("top").angular_velocity - w) < 0.005 * np.linalg.norm(spin)
            assert sim.rigid_strain("top") < 1e-4
            flipped = min(flipped, y[3:].reshape(3, 3)[1, 1])
    assert flipped < -0.9  # the middle axis turns over


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "implicit_euler", "implicit_midpoint", "bdf2"])
def test_a_thrown_body_falls_and_turns(integrator):
    scene, spin = ts.Scene(), np.array([0.0, 2.0, 0.0])
    scene.add_rigid_body(box(), name="box", position=(0, 1, 0), velocity=(1, 2, 0), angular_velocity=spin)
    explicit = integrator in ("symplectic_euler", "velocity_verlet")
    with ts.Simulator(scene, dt=1e-4 if explicit else 1e-3, integrator=integrator, precision="f64") as sim:
        sim.run(seconds=0.5)
        pose, twist = sim.pose("box"), sim.twist("box")
        t = sim.time
        assert np.allclose(pose.translation, [t, 2 * t - 0.5 * G * t**2, 0.0], atol=3e-3)
        assert np.allclose(twist.velocity, [1.0, 2 - G * t, 0.0], atol=1e-2)
        assert np.allclose(twist.angular_velocity, spin, atol=5e-3)
        angle = 2.0 * t
        turned = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        assert np.allclose(pose.rotation, turned, atol=3e-3)
        assert sim.rigid_strain("box") < 1e-4
        x = sim.positions("box")[4:]
        body = sim.scene.body("box")
        placed = (body.surface.vertices - body.centre) @ pose.rotation.T + body.centre + body.position + pose.translation
        assert np.abs(x - placed).max() < 1e-4


def test_pose_and_twist_are_exact_for_a_rigid_motion():
    body = ts.Scene().add_rigid_body(box(), position=(1, 2, 3))
    R, shift, w, v = a_rotation(2), np.array([0.3, -1.0, 2.0]), np.array([1.0, -2.0, 0.5]), np.array([3.0, 0.0, 1.0])
    arms = (body.rest_positions - body.centre) @ R.T
    x = arms + body.centre + body.position + shift
    pose = body.pose(x)
    assert np.allclose(pose.translation, shift, atol=1e-12) and np.allclose(pose.rotation, R, atol=1e-12)
    twist = body.twist(x, v + np.cross(w, arms))
    assert np.allclose(twist.velocity, v, atol=1e-12) and np.allclose(twist.angular_velocity, w, atol=1e-12)
    assert body.strain(x) < 1e-12
    assert body.strain(body.centre + 1.01 * (x - body.centre)) == pytest.approx(0.01, rel=1e-9)


# --- contacts ----------------------------------------------------------------------------------------------------------

ANGLE = np.arctan(0.5)  # 26.565 degrees


@pytest.mark.parametrize("friction", [0.49, 0.51])
def test_a_cube_slides_down_or_sticks_on_an_incline(friction):
    scene = ts.Scene(gravity=(G * np.sin(ANGLE), -G * np.cos(ANGLE), 0))
    scene.add_rigid_body(CLOSED_WALLS, name="cube", position=(0, 0.5, 0), friction=friction)
    scene.add_obstacle(GROUND, friction=friction)
    with ts.Simulator(scene, dt=1 / 120, integrator="implicit_euler", precision="f64") as sim:
        result = sim.run(seconds=1.0)
        assert result.status == "ok"
        v, t = sim.twist("cube").velocity[0], sim.time
        expected = G * (np.sin(ANGLE) - friction * np.cos(ANGLE)) * t if friction < 0.5 else 0.0
        assert v == pytest.approx(expected, abs=0.002 * G * np.sin(ANGLE) * t + 1e-3)


def test_forces_on_a_mat_and_torque_of_an_eccentric_support():
    scene = ts.Scene()
    scene.add_body(ts.box_mesh(cells=(6, 2, 6), size=(2, 0.4, 2)), ts.Material(young=1e5, mass_damping=5.0), position=(0, 0.2, 0))
    scene.add_rigid_body(ts.box_mesh(cells=(2, 2, 2), size=(0.7, 0.7, 0.7)), density=500, name="cube", position=(0, 0.75, 0))
    scene.add_obstacle(GROUND)
    with ts.Simulator(scene, dt=1 / 60, integrator="implicit_euler", precision="f64") as sim:
        assert sim.run(seconds=2.0).status == "ok"
        weight = sim.scene.body("cube").mass * G
        assert sim.contact_force("cube")[1] == pytest.approx(weight, rel=0.01)
        assert np.abs(sim.contact_torque("cube")).max() < 1e-3 * weight
        assert sim.contact_torque("obstacle0")[1] == pytest.approx(0.0, abs=1e-3 * weight)
        assert sim.rigid_strain("cube") < 1e-4


def test_contact_torque_changes_the_angular_momentum():
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="box", position=(0, 0.45, 0))
    scene.add_obstacle(ts.Box(center=(0.3, -0.2, 0), half_extents=(0.2, 0.2, 1.0)))
    with ts.Simulator(scene, dt=1e-3, integrator="implicit_euler", precision="f64") as sim:
        touched = False
        for _ in range(250):
            before = sim.twist("box").angular_velocity[2]
            sim.step()
            change = (sim.twist("box").angular_velocity[2] - before) / sim.dt
            torque = sim.contact_torque("box")[2]
            inertia = sim.scene.body("box").inertia[2, 2]
            assert inertia * change == pytest.approx(torque, abs=0.02 * inertia * 50.0)
            touched |= abs(torque) > 0.1 * inertia
        assert touched


def test_ten_stacked_cubes_stand():
    scene = ts.Scene()
    for k in range(10):
        scene.add_rigid_body(CLOSED_WALLS, name=f"cube{k}", position=(0, 0.5 + k, 0))
    scene.add_obstacle(GROUND)
    with ts.Simulator(scene, dt=1 / 120, integrator="implicit_euler") as sim:
        assert sim.run(seconds=1.0).status == "ok"
        assert max(float(np.linalg.norm(sim.pose(f"cube{k}").translation)) for k in range(10)) < 0.02
        assert max(sim.rigid_strain(f"cube{k}") for k in range(10)) < 1e-4


def test_two_thrown_bodies_keep_their_momentum_in_an_impact():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(CLOSED_WALLS, name="a", velocity=(1, 0, 0))
    scene.add_rigid_body(CLOSED_WALLS, density=300.0, name="b", position=(1.1, 0.3, 0.2))
    bodies = scene.bodies
    with ts.Simulator(scene, dt=1 / 200, integrator="bdf2", precision="f64") as sim:
        before = bodies[0].mass * np.array([1.0, 0, 0])
        result = sim.run(seconds=0.5)
        after = sum(b.mass * sim.twist(b.name).velocity for b in bodies)
        assert result.status == "ok"
        assert np.allclose(after, before, atol=1e-6 * np.linalg.norm(before))
        assert sim.twist("b").velocity[0] > 0.3


@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_a_body_at_rest_is_stiff_enough_for_what_hits_it(restitution):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(CLOSED_WALLS, name="a", velocity=(2, 0, 0), restitution=restitution, friction=0.0)
    scene.add_rigid_body(CLOSED_WALLS, name="b", position=(1.1, 0, 0), density=3000.0, friction=0.0)
    with ts.Simulator(scene, dt=1 / 240, integrator="implicit_euler", precision="f64") as sim:
        assert sim.run(seconds=0.2).status == "ok"
        change = (1 + restitution) * 0.75 * 2.0  # of the velocity of a, by Newton's law
        assert sim.twist("a").velocity[0] == pytest.approx(2.0 - change, abs=0.02)
        assert sim.twist("b").velocity[0] == pytest.approx(change / 3.0, abs=0.02)


def test_a_spring_joins_two_weightless_bodies():
    scene = ts.Scene(gravity=(0, 0, 0))
    cube = box((0.2, 0.2, 0.2))
    a = scene.add_rigid_body(cube, name="a")
    b = scene.add_rigid_body(cube, name="b", position=(1, 0, 0), density=3000.0)
    scene.add_spring(("a", (0.1, 0, 0)), ("b", (-0.1, 0, 0)), stiffness=1e4, rest_length=0.7)
    scene.contact_forces = False
    frequency = np.sqrt(1e4 * (1 / a.mass + 1 / b.mass))
    with ts.Simulator(scene, dt=1 / 2000, integrator="implicit_midpoint", precision="f64") as sim:
        sim.run(seconds=0.05)
        closer = sim.pose("a").translation[0] - sim.pose("b").translation[0]
        assert closer == pytest.approx(0.1 * (1 - np.cos(frequency * sim.time)), rel=2e-3)


def drop(integrator: str, dt: float, mesh: ts.TetMesh, restitution: float = 0.0, height: float = 0.2):
    """Largest upward speed after the impact, over that of the impact, and the root of the rise over the fall."""
    scene = ts.Scene()
    scene.add_rigid_body(mesh, name="body", position=(0, height - mesh.vertices[:, 1].min(), 0), restitution=restitution)
    scene.add_obstacle(GROUND, restitution=restitution)
    fallen, speed = np.sqrt(2.0 * height / G), np.sqrt(2.0 * height * G)
    seconds = fallen * (1.1 + restitution)
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
        heights, speeds = [], []
        for _ in range(round(seconds / dt)):
            sim.step()
            heights.append(sim.pose("body").translation[1])
            speeds.append(sim.twist("body").velocity[1])
        assert sim.rigid_strain("body") < 1e-4
    lowest = int(np.argmin(speeds))
    assert min(speeds) < -0.9 * speed  # it hit the ground
    rise = np.max(heights[lowest + 2 :]) - np.min(heights[lowest:])
    return max(speeds[lowest:]) / speed, np.sqrt(max(rise, 0.0) / height)


CUBE = ts.box_mesh(cells=(1, 1, 1), size=(0.5, 0.5, 0.5))
INTEGRATORS_WITH_CONTACTS = ("symplectic_euler", "velocity_verlet", "linearly_implicit_euler", "implicit_euler", "bdf2")


@pytest.mark.parametrize("dt", [1 / 120, 1 / 480, 1 / 2000])
@pytest.mark.parametrize("integrator", INTEGRATORS_WITH_CONTACTS)
def test_without_restitution_a_body_does_not_rebound(integrator, dt):
    assert drop(integrator, dt, CUBE)[0] < 0.01


def turned_box(size: tuple, angle: float) -> ts.TetMesh:
    mesh, c, s = box(size), np.cos(angle), np.sin(angle)
    return ts.TetMesh(mesh.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), mesh.tets)


@pytest.mark.parametrize("integrator", INTEGRATORS_WITH_CONTACTS)
@pytest.mark.parametrize("mesh", [ts.ball_mesh(radius=0.25, cells=2), turned_box((1.0, 0.1, 0.3), 0.3), box((0.05, 1.0, 0.05))])
def test_other_shapes_do_not_rebound_either(integrator, mesh):
    assert drop(integrator, 1 / 480, mesh)[0] < 0.01


@pytest.mark.parametrize("integrator", INTEGRATORS_WITH_CONTACTS)
@pytest.mark.parametrize("restitution", [0.5, 0.8])
def test_a_body_rises_to_the_square_of_the_restitution(integrator, restitution):
    assert drop(integrator, 1 / 480, CUBE, restitution)[1] == pytest.approx(restitution, abs=0.02)


def test_explicit_steps_carry_a_rigid_body_on_the_ground():
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="box", position=(0, 0.301, 0))
    scene.add_obstacle(GROUND)
    with ts.Simulator(scene, dt=1 / 240, integrator="symplectic_euler", precision="f64") as sim:
        assert sim.stable_dt == np.inf
        result = sim.run(seconds=0.3)
        assert result.status == "ok"
        assert abs(sim.pose("box").translation[1]) < 5e-3 and sim.rigid_strain("box") < 1e-12


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
def test_explicit_steps_keep_the_angular_momentum_and_the_spin_of_a_top(integrator):
    spin = 2 * np.pi * np.array([0.01, 1.0, 0.0])
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_rigid_body(box(), density=500.0, name="top", angular_velocity=spin)
    exact = euler_top(np.diag(body.inertia), spin, 5.0)
    momentum, energy, flipped = body.inertia @ spin, 0.5 * spin @ body.inertia @ spin, 0.0
    with ts.Simulator(scene, dt=1 / 800, integrator=integrator, precision="f64") as sim:
        for _ in range(50):
            sim.run(seconds=0.1)
            y = exact(sim.time)
            R, w = sim.pose("top").rotation, sim.twist("top").angular_velocity
            assert np.abs(R - y[3:].reshape(3, 3)).max() < 0.02
            assert np.allclose(R @ body.inertia @ R.T @ w, momentum, atol=1e-9 * np.linalg.norm(momentum))
            assert 0.5 * w @ R @ body.inertia @ R.T @ w == pytest.approx(energy, rel=1e-4)
            assert sim.rigid_strain("top") < 1e-12
            flipped = min(flipped, R[1, 1])
    assert flipped < -0.9


def test_springs_between_rigid_bodies_limit_explicit_steps():
    scene = ts.Scene(gravity=(0, 0, 0))
    a, b = (scene.add_rigid_body(CUBE, name=name, position=(k, 0, 0)) for k, name in enumerate("ab"))
    scene.add_spring(("a", (0.25, 0, 0)), ("b", (-0.25, 0, 0)), stiffness=1e5, rest_length=0.5)
    scene.contact_forces = False
    reduced = a.mass * b.mass / (a.mass + b.mass)
    with ts.Simulator(scene, dt=1e-4, integrator="velocity_verlet", precision="f64") as sim:
        assert 0.3 * 2.0 / np.sqrt(1e5 / reduced) < sim.stable_dt < 2.0 / np.sqrt(1e5 / reduced)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
@pytest.mark.parametrize("axes", ["y", "xy", "xz"])
def test_explicit_steps_keep_fixed_axes(integrator, axes):
    scene = ts.Scene(gravity=(1.0, -2.0, 3.0))
    scene.add_rigid_body(box(), name="body", angular_velocity=(0, 1.0, 0) if axes == "y" else (0, 0, 0)).fix(axes)
    scene.contact_forces = False
    with ts.Simulator(scene, dt=1e-3, integrator=integrator, precision="f64") as sim:
        sim.run(seconds=0.5)
        pose, twist, t = sim.pose("body"), sim.twist("body"), sim.time
        free = np.array([axis not in axes for axis in "xyz"])
        assert np.allclose(pose.translation, free * 0.5 * np.array([1.0, -2.0, 3.0]) * t**2, atol=3e-3)
        assert np.abs(pose.translation[~free]).max() < 1e-12
        assert twist.angular_velocity == pytest.approx([0, 1.0 if axes == "y" else 0.0, 0], abs=1e-9)
        assert sim.rigid_strain("body") < 1e-12
        weight = sim.scene.body("body").mass * np.array([1.0, -2.0, 3.0])
        assert np.allclose(sim.reactions("body").sum(axis=0), -weight * ~free, atol=1e-6 * np.abs(weight).max())


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
def test_explicit_impacts_keep_momentum_and_angular_momentum(integrator):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(CUBE, name="a", velocity=(2, 0, 0), restitution=0.5)
    scene.add_rigid_body(CUBE, density=300.0, name="b", position=(0.6, 0.2, 0.1))
    scene.add_body(CUBE, ts.Material(young=1e5), name="soft", position=(1.2, 0, 0))
    momentum = scene.bodies[0].mass * np.array([2.0, 0, 0])
    with ts.Simulator(scene, dt=5e-4, integrator=integrator, precision="f64", contact_tolerance=1e-4) as sim:
        masses = np.concatenate([np.full(body.n_nodes, 0.0) for body in sim.scene.bodies])
        for body, first in zip(sim.scene.bodies, np.cumsum([0] + [body.n_nodes for body in sim.scene.bodies])):
            own = np.full(4, 0.25 * body.mass) if body in sim.scene.rigid_bodies else lumped_mass(body)
            masses[first : first + len(own)] = own

        def total():
            x, v = sim.positions(), sim.velocities()
            return masses @ v, masses @ np.cross(x, v)

        start = total()
        assert sim.run(seconds=0.4).status == "ok"
        end = total()
        assert np.allclose(start[0], momentum, rtol=1e-9)
        for before, after in zip(start, end):
            assert np.allclose(before, after, atol=5e-4 * np.linalg.norm(momentum))  # friction acts across the gap
        assert np.linalg.norm(sim.twist("b").angular_velocity) > 0.1 and np.abs(sim.velocities("soft")).max() > 0.1


def test_a_hollow_body_is_not_overlapped_by_what_its_frame_alone_meets():
    """The nodes of the inertia tet lie outside of a ring's material; only the surface counts."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    profile = [(0.8, -0.1), (1.0, -0.1), (1.0, 0.1), (0.8, 0.1)]
    vertices = np.concatenate([ring * r + np.array([0, y, 0]) for r, y in profile])
    quads = [
        (16 * p + k, 16 * p + (k + 1) % 16, 16 * ((p + 1) % 4) + (k + 1) % 16, 16 * ((p + 1) % 4) + k)
        for p in range(4)
        for k in range(16)
    ]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    ring_mesh = ts.SurfaceMesh(vertices, triangles)
    ring_mesh = ring_mesh if ring_mesh.volume > 0 else ts.SurfaceMesh(vertices, triangles[:, ::-1])
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(ring_mesh, name="ring")
    scene.add_body(ts.ball_mesh(radius=0.3, cells=2), ts.Material(), name="ball")
    with ts.Simulator(scene, dt=1 / 100, integrator="implicit_euler") as sim:
        assert sim.overlaps() == []
        assert sim.run(seconds=0.05).status == "ok"


def test_crossing_surfaces_without_a_vertex_inside_are_an_overlap():
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    scene.add_rigid_body(box((2.0, 0.3, 0.3)), name="a")
    scene.add_rigid_body(box((0.2, 0.2, 2.0)), name="b")
    with ts.Simulator(scene, dt=1 / 100, integrator="implicit_euler") as sim:
        assert [(one.name_a, one.name_b) for one in sim.overlaps()] == [("a", "b")]


def test_shell_tets_are_positive_and_thin():
    mesh = surface_of(CLOSED_WALLS)
    points, tets = shell_tets(mesh.vertices, mesh.triangles, 1.0)
    x = points[tets]
    volumes = np.linalg.det(x[:, 1:] - x[:, :1])
    assert (volumes > 0.0).all() and np.abs(points).max() <= 0.5


# --- constraints, loads, attachments -----------------------------------------------------------------------------------


def test_a_fixed_body_stays_and_a_sliding_one_moves_along_one_axis_only():
    scene = ts.Scene(gravity=(1.0, -G, 2.0))
    scene.add_rigid_body(box(), name="fixed").fix()
    scene.add_rigid_body(box(), name="slider", position=(0, 3, 0)).fix(axes="yz", rotations="xyz")
    scene.contact_forces = False
    with ts.Simulator(scene, dt=1 / 200, integrator="implicit_midpoint", precision="f64") as sim:
        sim.run(seconds=1.0)
        assert np.abs(sim.pose("fixed").translation).max() < 1e-15
        pose = sim.pose("slider")
        assert np.allclose(pose.translation, [0.5 * sim.time**2, 0, 0], atol=1e-6)
        assert np.allclose(pose.rotation, np.eye(3), atol=1e-6)
        weight = sim.scene.body("fixed").mass * np.array([1.0, -G, 2.0])
        assert np.allclose(sim.reactions("fixed").sum(axis=0), -weight, rtol=1e-9)


def test_planar_motion_turns_about_one_axis():
    scene = ts.Scene(gravity=(0, 0, -1.0))
    scene.add_rigid_body(box(), name="disc", angular_velocity=(0, 0, 1.0)).fix("z", "xy")
    with ts.Simulator(scene, dt=1 / 200, integrator="implicit_midpoint", precision="f64") as sim:
        sim.run(seconds=1.0)
        assert sim.pose("disc").translation[2] == 0.0
        assert sim.twist("disc").angular_velocity == pytest.approx([0, 0, 1.0], abs=1e-4)


def spin_path(t: float):
    return np.array([0.1 * t, 0, 0]), np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])


@pytest.mark.parametrize("path", [spin_path, ts.KeyFrames([0, 2], [(0, 0, 0), (0.2, 0, 0)], [(0, 0, 0), (0, 2.0, 0)])])
def test_a_moved_body_follows_its_path_and_pushes(path):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(box(), name="tool").move(path)
    scene.add_rigid_body(ts.box_mesh(cells=(1, 1, 1), size=(0.2, 0.2, 0.2)), name="small", position=(0.61, 0, 0))
    with ts.Simulator(scene, dt=1 / 200, integrator="implicit_euler", precision="f64") as sim:
        result = sim.run(seconds=0.5)
        assert result.status == "ok"
        translation, rotation = spin_path(sim.time)
        pose = sim.pose("tool")
        assert np.allclose(pose.translation, translation, atol=1e-9) and np.allclose(pose.rotation, rotation, atol=1e-9)
        assert np.linalg.norm(sim.twist("small").velocity) > 0.1


def test_forces_act_at_the_centre_or_at_vertices():
    scene = ts.Scene(gravity=(0, 0, 0))
    central, pushed = (scene.add_rigid_body(box(), name=name, position=(0, 3 * k, 0)) for k, name in enumerate(("a", "b")))
    central.add_force(None, (10.0, 0, 0))
    top = pushed.surface.vertices[:, 1] > 0
    pushed.add_force(top, (10.0, 0, 0))
    scene.contact_forces = False
    with ts.Simulator(scene, dt=1e-3, integrator="implicit_midpoint", precision="f64") as sim:
        sim.run(seconds=0.02)
        t = sim.time
        for name in "ab":
            assert sim.twist(name).velocity[0] == pytest.approx(10.0 / central.mass * t, rel=1e-3)
        assert np.abs(sim.twist("a").angular_velocity).max() < 1e-9
        arm = 0.5 * SIZE[1]
        assert sim.twist("b").angular_velocity[2] == pytest.approx(-10.0 * arm / central.inertia[2, 2] * t, rel=1e-2)


def test_a_soft_bar_hangs_from_a_rigid_block():
    scene = ts.Scene()
    scene.add_rigid_body(box((0.4, 0.2, 0.4)), name="block", position=(0, 1.1, 0)).fix()
    rubber = ts.Material(young=1e6, mass_damping=20.0, stiffness_damping=1e-3)
    bar = scene.add_body(ts.box_mesh(cells=(2, 6, 2), size=(0.2, 1.0, 0.2)), rubber, name="bar", position=(0, 0.5, 0))
    scene.attach("bar", lambda X: X[:, 1] > 0.499, "block", name="joint")
    with ts.Simulator(scene, dt=1 / 100, integrator="implicit_euler", precision="f64") as sim:
        assert sim.run(seconds=2.0).status == "ok"
        block = sim.reactions("block").sum(axis=0)[1]
        total = (bar.mass + sim.scene.body("block").mass) * G
        assert block == pytest.approx(total, rel=1e-4)


def test_a_pendulum_of_two_bodies_joined_by_a_spring_attachment_turns():
    scene = ts.Scene()
    scene.add_rigid_body(box((0.2, 0.2, 0.2)), name="anchor", position=(0, 1.0, 0)).fix()
    scene.add_rigid_body(box((0.8, 0.1, 0.1)), name="rod", position=(0.5, 1.0, 0))
    ends = scene.body("rod").surface.vertices[:, 0] < -0.39
    scene.attach("rod", ends, "anchor", stiffness=1e6, damping=1e2)
    scene.contact_forces = False
    with ts.Simulator(scene, dt=1 / 1000, integrator="implicit_midpoint", precision="f64") as sim:
        start = sim.energies().total
        sim.run(seconds=0.2)
        assert np.isfinite(start) and sim.rigid_strain("rod") < 1e-4
        assert sim.joint_force("attachment0").shape == (4, 3)
    loose = scene.snapshot()
    assert loose.body("rod").selectable == slice(4, 12)


# --- scene, plan, refusals ---------------------------------------------------------------------------------------------


def test_the_stiffness_follows_the_scene_unless_it_is_given():
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="a")
    scene.add_rigid_body(box(), name="b", young=3e8)
    scene.add_body(ts.box_mesh(cells=(1, 1, 1), size=(1, 1, 1)), ts.Material(law="corotational", young=1e8), name="soft")
    copied = scene.snapshot()
    assert copied.body("a").young == pytest.approx(1e3 * 1e8) and copied.body("b").young == pytest.approx(3e8)
    assert copied.body("a").composition.laws == ("corotational",)
    light = ts.Scene()
    light.add_rigid_body(box(), name="a")
    assert light.snapshot().body("a").young == pytest.approx(1000.0 * G * 1.0 / 1e-5, rel=1e-9)


def test_the_fastest_body_counts_for_all_and_weightless_bodies_are_as_stiff_as_heavy_ones():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(box(), name="a")
    assert scene.snapshot().body("a").young == pytest.approx(1000.0 * G * 1.0 / 1e-5, rel=1e-9)
    scene.add_body(box(), ts.Material(young=1e4), velocity=(0, 20, 0), position=(0, 5, 0))
    assert scene.snapshot().body("a").young == pytest.approx(1000.0 * 20.0**2 / 1e-5, rel=1e-9)


def test_a_velocity_is_set_without_spin():
    body = ts.Scene().add_rigid_body(box(), name="r", velocity=(0, 1, 0), angular_velocity=(0, 0, 2), density=777.7)
    assert body.density == 777.7 and body.start_twist.angular_velocity.tolist() == [0, 0, 2]
    with pytest.raises(ts.SceneError, match="can only be set to"):
        body.velocity = np.zeros((12, 3))
    body.velocity = (3, 0, 0)
    assert body.start_twist.velocity.tolist() == [3, 0, 0] and body.start_twist.angular_velocity.tolist() == [0, 0, 0]


def test_a_scene_without_rigid_bodies_plans_none():
    scene = ts.Scene()
    scene.add_body(box(), ts.Material())
    plan = make_plan(scene, False, False)
    assert not plan.on["rigid_bodies"] and not plan.on["dependent_nodes"]
    scene.add_rigid_body(box(), name="tool", position=(0, 2, 0))
    plan = make_plan(scene, False, False)
    assert plan.on["rigid_bodies"] and plan.why("rigid_bodies") == "tool" and plan.on["dependent_nodes"]


def test_the_frame_vibrates_as_stiffly_as_the_material():
    scene = ts.Scene()
    scene.add_rigid_body(box(), young=1e7, density=1000.0)
    frequencies = modes(scene, 12).frequencies
    assert (frequencies[:6] == 0.0).all()
    wave = np.sqrt(1e7 / 1000.0)
    assert 0.1 * wave < frequencies[6] < 2.0 * wave / SIZE[2]


def a_plate_on_a_shaft() -> ts.Scene:
    """A rigid plate below a soft shaft of hardly any mass, clamped at its upper end."""
    scene = ts.Scene()
    shaft = ts.Material(young=1e7, density=1e-3, poisson=0.0)
    scene.add_rigid_body(box((1.0, 0.1, 1.0)), name="plate", position=(0, -0.05, 0))
    bar = scene.add_body(box((0.1, 1.0, 0.1), (1, 6, 1)), shaft, name="shaft", position=(0, 0.5, 0), order=2)
    bar.fix(lambda X: X[:, 1] > 0.499)
    scene.attach("shaft", lambda X: X[:, 1] < -0.499, "plate")
    return scene


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_modes_of_a_plate_on_a_shaft(mass):
    scene = a_plate_on_a_shaft()
    plate = scene.body("plate")
    frequencies = modes(scene, 6, mass).frequencies
    bending = np.sqrt(3 * 1e7 * 0.1**4 / 12 / plate.mass) / (2 * np.pi)  # of a tip mass, above that of one with rotary inertia
    axial = np.sqrt(1e7 * 0.01 / plate.mass) / (2 * np.pi)
    torsion = np.sqrt(0.5e7 * 0.1406 * 0.1**4 / plate.inertia[1, 1]) / (2 * np.pi)
    assert 0.5 * bending < frequencies[0] < bending
    assert frequencies[2] == pytest.approx(torsion, rel=0.1) and frequencies[5] == pytest.approx(axial, rel=0.02)


def test_a_rigid_plate_in_statics_is_as_stiff_as_in_steps():
    scene = a_plate_on_a_shaft()
    scene.body("plate").add_force(None, (0, -1e4, 0))
    result = ts.solve_static(scene)
    plate = scene.body("plate")
    assert result.converged and plate.strain(result.positions("plate")) < 1e-5
    load = plate.mass * G + 1e4
    assert plate.pose(result.positions("plate")).translation[1] == pytest.approx(-load / (1e7 * 0.01), rel=0.05)


def test_nodal_means_reach_the_surface():
    scene = ts.Scene()
    body = scene.add_rigid_body(box())
    mean = NodalMean([body])(np.array([3.0]))
    assert np.allclose(mean, 3.0)


def test_refinement_and_order_leave_rigid_bodies_alone():
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="tool")
    scene.add_body(box(), ts.Material(), name="soft", position=(0, 2, 0))
    for changed in (refined(scene), with_order(scene, 2)):
        assert isinstance(changed.body("tool"), rigid.RigidBody) and changed.body("tool").n_nodes == scene.body("tool").n_nodes
        assert changed.body("soft").n_nodes > scene.body("soft").n_nodes


def a_block_on_a_soft_cube() -> ts.Scene:
    scene = ts.Scene()
    scene.add_rigid_body(box((0.5, 0.2, 0.5)), name="block", position=(0, 1.101, 0))
    soft = ts.box_mesh(cells=(2, 2, 2), size=(1, 1, 1))
    scene.add_body(soft, ts.Material(young=1e5), name="soft", position=(0, 0.5, 0)).fix(lambda X: X[:, 1] < -0.4)
    return scene


def test_errors_of_another_mesh_are_estimated_beside_rigid_bodies():
    with ts.Simulator(a_block_on_a_soft_cube(), dt=1 / 100, integrator="implicit_euler", precision="f64") as sim:
        estimate = sim.run(seconds=0.1, error=True, error_mesh="refined").error_estimate
        assert 0.0 < estimate.space < 1.0 and set(estimate.bodies) == {"block", "soft"}


def test_stress_is_unknown_in_rigid_bodies_and_impulses_are_left_out_of_their_usd(tmp_path):
    from pxr import Usd, UsdGeom

    with ts.Simulator(a_block_on_a_soft_cube(), dt=1 / 100, integrator="implicit_euler") as sim:
        sim.run(seconds=0.05)
        unknown = np.isnan(NodalValues(sim.scene.bodies)("stress", sim))
        n = sim.scene.body("block").n_nodes
        assert unknown[:n].all() and not unknown[n:].any()
        writer = UsdWriter(tmp_path, sim.scene, 60.0)
        writer.frame(sim, 0)
        writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    for name, expected in (("soft", True), ("block", False)):
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/World/{name}/surface"))
        assert primvars.HasPrimvar(IMPULSE) is expected


OPEN = ts.SurfaceMesh(np.eye(3), np.array([[0, 1, 2]]))
INWARD = ts.SurfaceMesh(surface_of(box()).vertices, surface_of(box()).triangles[:, ::-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mesh": 3}, "rigid body 'r': mesh must be a TetMesh or a SurfaceMesh, not int"),
        ({"mesh": OPEN}, "rigid body 'r': its surface does not bound a solid: 1 hole"),
        ({"mesh": INWARD}, "rigid body 'r': its surface does not bound a solid: all normals point inward"),
        ({"density": 0.0}, "rigid body 'r': density must be greater than 0 kg/m^3"),
        ({"young": -1.0}, "rigid body 'r': young must be greater than 0 Pa"),
        ({"velocity": (1, 2)}, "rigid body 'r': velocity must have shape (3,)"),
        ({"angular_velocity": (1, 2, np.inf)}, "rigid body 'r': angular_velocity: entry [2] is inf"),
        ({"friction": -1.0}, "friction must be at least 0"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    scene = ts.Scene()
    with pytest.raises(ts.SceneError, match=".*") as caught:
        scene.add_rigid_body(**({"mesh": box(), "name": "r"} | arguments))
    assert message in str(caught.value) and scene.bodies == []


def test_ends_of_connections_are_vertices_counted_from_0():
    scene = ts.Scene()
    body = scene.add_rigid_body(box(), name="r")
    scene.add_body(box(), ts.Material(), name="soft", position=(0, 2, 0))
    spring = scene.add_spring(("r", 7), ("soft", 0), stiffness=1.0)
    assert np.array_equal(spring.points[0].position, body.surface.vertices[7])
    with pytest.raises(ts.SceneError, match="a: the node must be"):
        scene.add_spring(("r", 8), ("soft", 0), stiffness=1.0)
    with pytest.raises(ts.SceneError, match="node 0 of body 'r' lies outside of body 'soft'"):
        scene.attach("r", [0], "soft", stiffness=1.0)


def test_what_a_rigid_body_cannot_do_is_refused():
    scene = ts.Scene()
    body = scene.add_rigid_body(box(), name="r")
    scene.add_body(box(), ts.Material(), name="soft", position=(0, 2, 0))
    for call in (body.add_traction, body.add_pressure, body.add_cavity, body.embed, body.enclosed_volume):
        with pytest.raises(ts.SceneError, match="takes forces only"):
            call([0], 1.0)
    for rotations in ("x", "xxz", 3):
        with pytest.raises(ts.SceneError, match=f"rotations must be 'xz', not {rotations!r}"):
            body.fix("y", rotations)
    with pytest.raises(ts.SceneError, match="an embedded surface has no distance field"):
        body.collision = "distance_field"
    with pytest.raises(ts.SceneError, match=r"^rigid body 'r': the path's translation at t = 0 must have shape"):
        body.move(lambda t: (1.0, np.eye(3)))
    with pytest.raises(ts.SceneError, match="rigid: attach the other body's nodes to it"):
        scene.attach("r", [0], "soft")
    with pytest.raises(ts.SceneError, match="vertex|node 8 does not exist"):
        body.add_force([8], (1, 0, 0))
    for name in ("material", "young", "density", "centre"):
        with pytest.raises(ts.SceneError, match=name):
            setattr(body, name, 1.0)
    with pytest.raises(ts.SceneError, match="lies outside of body 'r', by .* times its size"):
        scene.add_spring(("r", (0, 5, 0)), ("soft", (0, 0, 0)), stiffness=1.0)
    with ts.Simulator(scene, dt=1 / 100, integrator="implicit_euler") as sim:
        with pytest.raises(ts.SceneError, match="rigid body 'r': its numbers cannot change"):
            sim.set_material("r", young=1e5)
        with pytest.raises(ts.SceneError, match="body 'soft' is not rigid"):
            sim.pose("soft")


# --- files -------------------------------------------------------------------------------------------------------------


def test_a_checkpoint_continues_bitwise(tmp_path):
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="tool", position=(0, 0.6, 0), angular_velocity=(0, 1, 2))
    scene.add_obstacle(GROUND)
    with ts.Simulator(scene, dt=1 / 200, integrator="bdf2") as sim:
        sim.run(seconds=0.4)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.run(seconds=0.1)
        expected, force = sim.positions(), sim.contact_force("tool")
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene.snapshot()) as sim:
        sim.run(seconds=0.1)
        assert np.array_equal(sim.positions(), expected) and np.array_equal(sim.contact_force("tool"), force)


@pytest.mark.parametrize("given", ["the scene", "a copy of the scene"])
def test_a_checkpoint_beside_soft_bodies_continues_bitwise_with_changed_numbers(tmp_path, given):
    scene = a_block_on_a_soft_cube()
    with ts.Simulator(scene, dt=1 / 200, integrator="bdf2") as sim:
        young = sim.scene.body("block").young
        sim.run(seconds=0.05)
        sim.set_material("soft", young=1e7)
        sim.set_gravity((0, -30.0, 0))
        sim.run(seconds=0.05)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.run(seconds=0.05)
        expected = sim.positions()
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene if given == "the scene" else scene.snapshot()) as sim:
        assert sim.scene.body("block").young == young
        sim.run(seconds=0.05)
        assert np.array_equal(sim.positions(), expected)


def test_the_plan_names_the_laws_that_are_used():
    plan = plan_of(a_block_on_a_soft_cube(), "bdf2", False, False)
    assert plan.on["law:stable_neo_hookean"] and not plan.on["law:st_venant_kirchhoff"]


def test_files_of_frames_hold_the_surface(tmp_path):
    scene = ts.Scene()
    scene.add_rigid_body(box(), name="tool")
    scene.add_body(box(cells=(2, 2, 2)), ts.Material(), name="soft", position=(0, 3, 0))
    with ts.Simulator(scene, dt=1 / 100) as sim:
        sim.step()
        sim.write_vtu(tmp_path / "a.vtu")
        mesh = meshio.read(tmp_path / "a.vtu")
        assert np.array_equal(mesh.points, sim.positions())
        n_tets = scene.bodies[1].mesh.n_tets
        assert [(block.type, len(block.data)) for block in mesh.cells] == [("triangle", 12), ("tetra", n_tets)]
        arrays = body_arrays(scene)
        assert arrays["first_tet"].tolist() == [0, 0, n_tets] and arrays["first_triangle"][1] == 12
        assert sim.picture((64, 48)).shape == (48, 64, 3)


SCENE = """
[rigid_bodies.palm]
mesh = { shape = "box", cells = [1, 1, 1], size = [1, 0.6, 0.3] }
density = 700
angular_velocity = [0, 1, 0]

[[rigid_bodies.palm.fix]]
axes = "y"

[[rigid_bodies.palm.force]]
force = { times = [0, 1], translations = [[0, 0, 0], [1, 0, 0]] }

[[rigid_bodies.palm.force]]
nodes = [0, 3]
force = [0, 0, 1]

[rigid_bodies.tetrahedron]
mesh = { vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] }
position = [0, 3, 0]
young = 1e8
"""


def test_scene_files_hold_rigid_bodies(tmp_path):
    scene, _ = ts.read_scene(write(tmp_path / "a.toml", SCENE))
    palm, other = scene.bodies
    assert palm.mass == pytest.approx(700 * np.prod(SIZE)) and len(palm.forces) == 2 and other.given_young == 1e8
    assert (palm.forces[0].nodes == np.arange(4)).all() and palm.forces[1].nodes.tolist() == [4, 7]


def test_written_scenes_read_back_the_same(tmp_path):
    scene = ts.Scene()
    spinning = scene.add_rigid_body(box(), name="b", density=0.7, velocity=(0.1, 0, 0), angular_velocity=(0.1, 0.2, 0.3))
    spinning.add_force([1, 2], np.ones((2, 3)))
    soft = scene.add_body(box(), ts.Material(), name="soft", position=(0, 2, 0))
    soft.embed(surface_of(box((0.5, 0.3, 0.2))), contact=True)
    moved = scene.add_rigid_body(surface_of(box()), name="a", position=(0, 4, 0), young=0.7e8)
    moved.fix("y")
    moved.move(ts.KeyFrames([0, 1], [(0, 0, 0), (0.2, 0, 0)]), "xz")
    slow = scene.add_rigid_body(box(), name="slow", position=(0, 6, 0), angular_velocity=(1, 0, 0))
    slow.velocity = (0, 1, 0)
    ts.write_scene(tmp_path / "a.toml", scene)
    again, _ = ts.read_scene(tmp_path / "a.toml")
    assert [body.name for body in again.bodies] == ["b", "soft", "a", "slow"]
    assert scene_digest(again) == scene_digest(scene)
    turned = ts.Scene()
    late = turned.add_rigid_body(box(), name="late")
    late.move(ts.KeyFrames([0, 1], rotations=[(0, 0, 0), (0, 1, 0)]))
    late.position = (1, 0, 0)
    with pytest.raises(ts.SceneError, match="rigid body 'late': its position was set after its path"):
        ts.write_scene(tmp_path / "b.toml", turned)


def test_a_body_order_must_name_each_body(tmp_path):
    for names in ('["palm"]', '["palm", "palm"]', "3"):
        with pytest.raises(ts.SceneError, match="body_order must list each name"):
            ts.read_scene(write(tmp_path / "a.toml", f"body_order = {names}\n{SCENE}"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("density = 700", "density = -1", "rigid_bodies.palm.density must be greater than 0"),
        ('axes = "y"', 'axes = "q"', "axes"),
        ("[0, 3]\nforce", "[0, 9]\nforce", "does not exist"),
        ("[1, 2, 3]] }", "[1, 2, 4]] }", "triangle 3: vertex 4 does not exist"),
    ],
)
def test_faults_in_scene_files_are_located(tmp_path, old, new, message):
    with pytest.raises((ts.SceneError, ts.MeshError), match="rigid_bodies") as caught:
        ts.read_scene(write(tmp_path / "a.toml", SCENE.replace(old, new)))
    assert message in str(caught.value)
