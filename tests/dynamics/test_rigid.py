"""Rigid bodies in motion (contacts: test_rigid_contacts; as parts of a scene: tests/scene):

* explicit and implicit steps follow Euler's equations, fall, turn, and keep momentum and angular momentum;
* fixed axes and paths; forces at the centre or at vertices; springs and attachments between rigid and soft bodies;
* vibrations; what is written and drawn; estimates of errors; checkpoints; what cannot change at run time.
"""

import meshio
import numpy as np
import pytest
import scipy.integrate

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.output.nodal_fields import NodalMean
from taisoft.output.usd import UsdWriter
from taisoft.output.usd_scene import IMPULSE
from taisoft.stability import stable_dt
from taisoft.view.colouring import NodalValues
from tests.collision.rotations import rotation
from tests.dynamics.companion import LOOSE, opened, simulator

G = 9.81
SIZE = (1.0, 0.6, 0.3)


def box(size=SIZE, cells=(1, 1, 1)) -> ts.TetMesh:
    return ts.box_mesh(cells=cells, size=size)


# --- free motion -------------------------------------------------------------------------------------------------------


def euler_top(inertia: np.ndarray, spin: np.ndarray, seconds: float):
    """Rotation and angular velocity in space as functions of time, of a torque-free body with principal moments."""
    I = inertia

    def rate(_, y):
        w, R = y[:3], y[3:].reshape(3, 3)
        turn = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([np.cross(I * w, w) / I, (R @ turn).ravel()])

    start = np.concatenate([spin, np.eye(3).ravel()])
    return scipy.integrate.solve_ivp(rate, (0, seconds), start, rtol=1e-11, atol=1e-12, dense_output=True).sol


@pytest.mark.parametrize("integrator, seconds", [("velocity_verlet", 3.0), ("implicit_midpoint", 0.6)])
def test_a_top_spinning_about_its_middle_axis_follows_eulers_equations(integrator, seconds):
    spin = 2 * np.pi * np.array([0.05, 1.0, 0.0])
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
        sim.run(seconds=0.2)
        pose, twist, t = sim.pose("box"), sim.twist("box"), sim.time
        assert np.allclose(pose.translation, [t, 2 * t - 0.5 * G * t**2, 0.0], atol=3e-3)
        assert np.allclose(twist.velocity, [1.0, 2 - G * t, 0.0], atol=1e-2)
        assert np.allclose(twist.angular_velocity, spin, atol=1e-2)
        assert np.allclose(pose.rotation, rotation((0, 1, 0), 2.0 * t), atol=3e-3)
        assert sim.rigid_strain("box") < 1e-4
        body = sim.scene.body("box")
        placed = (body.surface.vertices - body.centre) @ pose.rotation.T + body.centre + body.position + pose.translation
        assert np.abs(sim.positions("box")[4:] - placed).max() < 1e-4


# --- constraints, loads, connections -------------------------------------------------------------------------------------


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
        sim.run(seconds=0.3)
        way = 0.5 * scene.gravity * sim.time**2
        for name, axes in (("fixed", ""), ("slider", "x"), ("disc", "xz")):
            free = np.array([axis in axes for axis in "xyz"])
            pose, spin = sim.pose(name), sim.twist(name).angular_velocity
            assert np.allclose(pose.translation, free * way, atol=3e-3) and np.abs(pose.translation[~free]).max() < 1e-12
            assert spin == pytest.approx([0, float(name == "disc"), 0], abs=1e-3)
            assert np.allclose(sim.reactions(name).sum(axis=0), -weight * ~free, atol=2e-3 * np.abs(weight).max())
        assert np.allclose(sim.pose("disc").rotation, rotation((0, 1, 0), sim.time), atol=3e-3)


def spin_path(t: float):
    return np.array([0.1 * t, 0, 0]), rotation((0, 1, 0), t) if t else np.eye(3)


@pytest.mark.parametrize("path", [spin_path, ts.KeyFrames([0, 2], [(0, 0, 0), (0.2, 0, 0)], [(0, 0, 0), (0, 2.0, 0)])])
def test_a_moved_body_follows_its_path_and_pushes(path):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(box(), name="tool").move(path)
    scene.add_rigid_body(ts.box_mesh(cells=(1, 1, 1), size=(0.2, 0.2, 0.2)), name="small", position=(0.61, 0, 0))
    with opened(scene, "implicit_euler", 1 / 200) as sim:
        assert sim.run(seconds=0.2).status == "ok"
        translation, turn = spin_path(sim.time)
        pose = sim.pose("tool")
        assert np.allclose(pose.translation, translation, atol=1e-9) and np.allclose(pose.rotation, turn, atol=1e-9)
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
        sim.run(seconds=0.03)
        t = sim.time
        closer = sim.pose("a").translation[0] - sim.pose("b").translation[0]
        assert closer == pytest.approx(0.1 * (1 - np.cos(frequency * t)), rel=1e-2)
        for name in "fg":
            assert sim.twist(name).velocity[0] == pytest.approx(10.0 / central.mass * t, rel=1e-3)
        assert np.abs(sim.twist("f").angular_velocity).max() < 1e-9
        arm = 0.5 * SIZE[1]
        assert sim.twist("g").angular_velocity[2] == pytest.approx(-10.0 * arm / central.inertia[2, 2] * t, rel=1e-2)


# --- with the rest of the program --------------------------------------------------------------------------------------------


def a_block_on_a_soft_cube() -> ts.Scene:
    scene = ts.Scene()
    scene.add_rigid_body(box((0.5, 0.2, 0.5)), name="block", position=(0, 1.101, 0))
    soft = scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), name="soft", position=(0, 0.5, 0))
    soft.fix(lambda X: X[:, 1] < -0.4)
    return scene


def test_what_is_written_and_drawn(tmp_path):
    """The surface; no stress, and in USD no impulses; a mean over tets reaches the surface."""
    from pxr import Usd, UsdGeom

    with opened(a_block_on_a_soft_cube(), "implicit_euler", 1 / 100) as sim:
        sim.run(seconds=0.03)
        block, soft = sim.scene.bodies[:2]
        unknown = np.isnan(NodalValues(sim.scene.bodies)("stress", sim))
        assert unknown[: block.n_nodes].all() and not unknown[block.n_nodes : block.n_nodes + soft.n_nodes].any()
        assert np.allclose(NodalMean([block])(np.array([3.0])), 3.0)
        sim.write_vtu(tmp_path / "a.vtu")
        mesh = meshio.read(tmp_path / "a.vtu")
        cells = {kind: sum(len(one.data) for one in mesh.cells if one.type == kind) for kind in ("triangle", "tetra")}
        assert cells == {"triangle": 12 + 4, "tetra": soft.mesh.n_tets + 2}  # with those of the companions
        assert sim.picture((64, 48)).shape == (48, 64, 3)
        writer = UsdWriter(tmp_path, sim.scene, 60.0)
        writer.frame(sim, 0)
        writer.close()
        for call in (lambda: sim.set_material("block", young=1e5), lambda: sim.pose("soft")):
            with pytest.raises(ts.SceneError, match="rigid body 'block': its numbers cannot change|body 'soft' is not rigid"):
                call()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    for name, expected in (("soft", True), ("block", False)):
        assert UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/World/{name}/surface")).HasPrimvar(IMPULSE) is expected


@pytest.mark.long
def test_errors_of_another_mesh_are_estimated_beside_rigid_bodies():
    with simulator(a_block_on_a_soft_cube(), "implicit_euler", 1 / 100, **LOOSE) as sim:
        estimate = sim.run(seconds=0.05, error=True, error_mesh="refined").error_estimate
        assert 0.0 < estimate.space < 1.0 and set(estimate.bodies) == {"block", "soft"}


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
    for given in (scene, scene.snapshot()):
        with ts.Simulator.load_checkpoint(tmp_path / "c.npz", given) as sim:
            assert sim.scene.body("block").young == young
            sim.run(seconds=0.03)
            assert np.array_equal(sim.positions(), expected) and np.array_equal(sim.contact_force("block"), force)
