"""Rigid bodies (as parts of a scene: tests/scene; damping: test_rigid_damping; stacks: tests/references):

* explicit and implicit steps follow Euler's equations, fall, turn, and keep momentum and angular momentum;
* fixed axes and paths; forces at the centre or at vertices; springs between them; what is written; checkpoints;
* sliding and sticking on an incline; impacts keep momentum and angular momentum and follow Newton's law, with every integrator;
* the motions that impulses cause in explicit steps are orthonormal in the mass, and keep constrained axes.
"""

import meshio
import numpy as np
import pytest
import scipy.integrate

import taisoft as ts
from taisoft.dynamics.rigid_contacts import rigid_motions
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.fem.reference import lumped_mass
from taisoft.stability import stable_dt
from tests.collision.rotations import rotation
from tests.dynamics.companion import opened

G = 9.81
SIZE = (1.0, 0.6, 0.3)


def box(size=SIZE, cells=(1, 1, 1)) -> ts.TetMesh:
    return ts.box_mesh(cells=cells, size=size)


def euler_top(inertia: np.ndarray, spin: np.ndarray, seconds: float):
    """Rotation and angular velocity in space as functions of time, of a torque-free body with principal moments."""

    def rate(_, y):
        w, R = y[:3], y[3:].reshape(3, 3)
        return np.concatenate([np.cross(inertia * w, w) / inertia, np.cross(R, w).ravel()])

    start = np.concatenate([spin, np.eye(3).ravel()])
    return scipy.integrate.solve_ivp(rate, (0, seconds), start, rtol=1e-11, atol=1e-12, dense_output=True).sol


@pytest.mark.parametrize("integrator, seconds", [("velocity_verlet", 1.7), ("implicit_midpoint", 0.3)])
def test_a_top_spinning_about_its_middle_axis_follows_eulers_equations(integrator, seconds):
    spin = 2 * np.pi * np.array([0.1, 1.0, 0.0])
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    body = scene.add_rigid_body(box(), density=500.0, name="top", angular_velocity=spin)
    exact, flipped = euler_top(np.diag(body.inertia), spin, seconds + 0.1), 0.0
    momentum, energy = body.inertia @ spin, 0.5 * spin @ body.inertia @ spin
    rounding = 1e-9 if integrator in EXPLICIT else 1e-4
    with opened(scene, integrator, 1 / 800) as sim:
        for _ in range(round(seconds / 0.1)):
            sim.run(seconds=0.1)
            y = exact(sim.time)
            R, w = sim.pose("top").rotation, sim.twist("top").angular_velocity
            assert np.abs(R - y[3:].reshape(3, 3)).max() < 0.02
            assert np.linalg.norm(w - y[3:].reshape(3, 3) @ y[:3]) < 0.02 * np.linalg.norm(spin)
            assert np.allclose(R @ body.inertia @ R.T @ w, momentum, atol=rounding * np.linalg.norm(momentum))
            assert 0.5 * w @ R @ body.inertia @ R.T @ w == pytest.approx(energy, rel=1e-3)
            assert sim.rigid_strain("top") < (1e-12 if integrator in EXPLICIT else 1e-4)
            flipped = min(flipped, R[1, 1])
    assert flipped < -0.9 or integrator in IMPLICIT  # the middle axis turns over


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler", "implicit_midpoint", "bdf2"])
def test_a_thrown_body_falls_and_turns(integrator):
    scene, spin = ts.Scene(), np.array([0.0, 2.0, 0.0])
    scene.contact_forces = False
    scene.add_rigid_body(box(), name="box", position=(0, 1, 0), velocity=(1, 2, 0), angular_velocity=spin)
    with opened(scene, integrator, 2e-3) as sim:
        sim.run(seconds=0.1)
        pose, twist, t = sim.pose("box"), sim.twist("box"), sim.time
        assert np.allclose(pose.translation, [t, 2 * t - 0.5 * G * t**2, 0.0], atol=3e-3)
        assert np.allclose(twist.velocity, [1.0, 2 - G * t, 0.0], atol=1e-2)
        assert np.allclose(twist.angular_velocity, spin, atol=1e-2)
        assert np.allclose(pose.rotation, rotation((0, 1, 0), 2.0 * t), atol=3e-3)
        assert sim.rigid_strain("box") < 1e-4
        body = sim.scene.body("box")
        placed = (body.surface.vertices - body.centre) @ pose.rotation.T + body.centre + body.position + pose.translation
        assert np.abs(sim.positions("box")[4:] - placed).max() < 1e-4


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_midpoint"])
def test_fixed_axes(integrator):
    """Fixed, sliding along x, turning about y alone in a plane, and held against all weight."""
    scene = ts.Scene(gravity=(1.0, -2.0, 3.0))
    scene.contact_forces = False
    scene.add_rigid_body(box(), name="fixed").fix()
    scene.add_rigid_body(box(), name="slider", position=(0, 3, 0)).fix(axes="yz", rotations="xyz")
    scene.add_rigid_body(box(), name="disc", position=(0, 6, 0), angular_velocity=(0, 1.0, 0)).fix("y", "xz")
    weight = scene.body("fixed").mass * scene.gravity
    with opened(scene, integrator, 2e-3) as sim:
        sim.run(seconds=0.15)
        way = 0.5 * scene.gravity * sim.time**2
        for name, axes in (("fixed", ""), ("slider", "x"), ("disc", "xz")):
            free = np.array([axis in axes for axis in "xyz"])
            pose, spin = sim.pose(name), sim.twist(name).angular_velocity
            assert np.allclose(pose.translation, free * way, atol=3e-3) and np.abs(pose.translation[~free]).max() < 1e-12
            assert spin == pytest.approx([0, float(name == "disc"), 0], abs=1e-3)
            assert np.allclose(sim.reactions(name).sum(axis=0), -weight * ~free, atol=2e-3 * np.abs(weight).max())
        assert np.allclose(sim.pose("disc").rotation, rotation((0, 1, 0), sim.time), atol=3e-3)


def test_a_moved_body_follows_its_path_and_pushes():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(box(), name="tool").move(ts.KeyFrames([0, 2], [(0, 0, 0), (0.2, 0, 0)], [(0, 0, 0), (0, 2.0, 0)]))
    scene.add_rigid_body(ts.box_mesh(cells=(1, 1, 1), size=(0.2, 0.2, 0.2)), name="small", position=(0.61, 0, 0))
    with opened(scene, "implicit_euler", 1 / 200) as sim:
        assert sim.run(seconds=0.2).status == "ok"
        pose, turn = sim.pose("tool"), rotation((0, 1, 0), sim.time)
        assert np.allclose(pose.translation, (0.1 * sim.time, 0, 0), atol=1e-9) and np.allclose(pose.rotation, turn, atol=1e-9)
        assert np.linalg.norm(sim.twist("small").velocity) > 0.05


def test_forces_springs_and_stable_dt():
    """Forces at the centre or at vertices; a spring between two weightless bodies oscillates with their reduced mass."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    central, pushed = (scene.add_rigid_body(box(), name=name, position=(0, 3 * k, 0)) for k, name in enumerate(("f", "g")))
    assert stable_dt(scene, verlet=True) == np.inf
    central.add_force(None, (10.0, 0, 0))
    pushed.add_force(pushed.surface.vertices[:, 1] > 0, (10.0, 0, 0))
    cube = box((0.2, 0.2, 0.2))
    a = scene.add_rigid_body(cube, name="a", position=(0, -3, 0))
    b = scene.add_rigid_body(cube, name="b", position=(1, -3, 0), density=3000.0)
    scene.add_spring(("a", (0.1, 0, 0)), ("b", (-0.1, 0, 0)), stiffness=1e4, rest_length=0.7)
    frequency = np.sqrt(1e4 * (1 / a.mass + 1 / b.mass))
    assert 0.3 * 2.0 / frequency < stable_dt(scene, verlet=True) < 2.0 / frequency
    with opened(scene, "implicit_midpoint", 1e-3) as sim:
        assert sim.run(seconds=0.03).status == "ok"
        t = sim.time
        closer = sim.pose("a").translation[0] - sim.pose("b").translation[0]
        assert closer == pytest.approx(0.1 * (1 - np.cos(frequency * t)), rel=1e-2)
        for name in "fg":
            assert sim.twist(name).velocity[0] == pytest.approx(10.0 / central.mass * t, rel=1e-3)
        assert np.abs(sim.twist("f").angular_velocity).max() < 1e-9
        arm = 0.5 * SIZE[1]
        assert sim.twist("g").angular_velocity[2] == pytest.approx(-10.0 * arm / central.inertia[2, 2] * t, rel=1e-2)


def a_block_on_a_soft_cube() -> ts.Scene:
    scene = ts.Scene()
    scene.add_rigid_body(box((0.5, 0.2, 0.5)), name="block", position=(0, 1.101, 0))
    soft = scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), name="soft", position=(0, 0.5, 0))
    soft.fix(lambda X: X[:, 1] < -0.4)
    return scene


def test_what_is_written(tmp_path):
    """The surface; what a rigid body and a soft one cannot do is refused."""
    with opened(a_block_on_a_soft_cube(), "implicit_euler", 1 / 100) as sim:
        sim.step()
        sim.write_vtu(tmp_path / "a.vtu")
        mesh = meshio.read(tmp_path / "a.vtu")
        cells = {kind: sum(len(one.data) for one in mesh.cells if one.type == kind) for kind in ("triangle", "tetra")}
        assert cells == {"triangle": 12 + 4, "tetra": sim.scene.body("soft").mesh.n_tets + 2}  # with those of the companions
        for call in (lambda: sim.set_material("block", young=1e5), lambda: sim.pose("soft")):
            with pytest.raises(ts.SceneError, match="rigid body 'block': its numbers cannot change|body 'soft' is not rigid"):
                call()


def test_a_checkpoint_continues_bitwise_with_changed_numbers(tmp_path):
    scene = a_block_on_a_soft_cube()
    with opened(scene, "bdf2", 1 / 200) as sim:
        young = sim.scene.body("block").young
        sim.run(seconds=0.03)
        sim.set_material("soft", young=1e7)
        sim.set_gravity((0, -30.0, 0))
        sim.run(seconds=0.03)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.run(seconds=0.03)
        expected, force = sim.positions(), sim.contact_force("block")
        assert force[1] > 0.0
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene) as sim:
        assert sim.scene.body("block").young == young
        sim.run(seconds=0.03)
        assert np.array_equal(sim.positions(), expected) and np.array_equal(sim.contact_force("block"), force)


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
        assert sim.run(seconds=0.3).status == "ok"
        v, t = sim.twist("cube").velocity[0], sim.time
        expected = G * (np.sin(angle) - friction * np.cos(angle)) * t if friction < 0.5 else 0.0
        assert v == pytest.approx(expected, abs=0.01)


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


SPIN = (0.0, 1.0, 0.3)  # [1/s]


def test_what_flies_is_not_moved_by_what_is_in_contact():
    """Contacts are solved directly here, also in linearised steps, whose rigid motion is balanced afterwards."""
    scene = ts.Scene()
    scene.add_rigid_body(CUBE, name="lying", position=(0, 0.0002 - CUBE.vertices[:, 1].min(), 0))
    scene.add_rigid_body(CUBE, name="flying", position=(0, 5, 0), velocity=(1, 0, 0), angular_velocity=SPIN)
    scene.add_obstacle(GROUND)
    with ts.Simulator(scene, dt=0.01, integrator="linearly_implicit_euler", precision="f64") as sim:  # of rigid bodies alone
        assert sim.step().n_contacts and np.allclose(sim.twist("flying").angular_velocity, SPIN, atol=1e-3)
        assert all(sim.step().n_contacts for _ in range(9))
        assert np.allclose(sim.twist("flying").velocity, (1.0, -0.1 * G, 0.0), atol=1e-6)


def test_contacts_of_what_cannot_move_are_solved():
    """They have no rows in the matrix of the impulses."""
    scene = ts.Scene()
    scene.add_rigid_body(CUBE, name="fixed", position=(0, 0.0002 - CUBE.vertices[:, 1].min(), 0)).fix()
    scene.add_obstacle(GROUND)
    with ts.Simulator(scene, dt=0.01, integrator="implicit_euler", precision="f64") as sim:
        report = sim.step()
        assert report.converged and report.n_contacts > 0 and not sim.twist("fixed").velocity.any()


@pytest.mark.parametrize(
    "integrator, restitution",
    [("velocity_verlet", 0.5), ("implicit_euler", 0.0), ("linearly_implicit_euler", 0.5), ("bdf2", 0.5)],
)
def test_a_body_rises_to_the_square_of_the_restitution(integrator, restitution):
    """A turned plank: without restitution it does not rebound."""
    plank = box((1.0, 0.1, 0.3)) if restitution == 0 else CUBE
    mesh = ts.TetMesh(plank.vertices @ rotation((0, 0, 1), 0.3 * (restitution == 0)).T, plank.tets)
    scene, height, dt = ts.Scene(), 0.1, 1 / 960
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
    rigid = (np.pad(np.full(4, 0.25 * body.mass), (0, body.n_nodes - 4)) for body in scene.rigid_bodies)
    masses = np.concatenate([*rigid, lumped_mass(scene.body("soft"))])
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
