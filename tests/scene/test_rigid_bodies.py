"""Rigid bodies as parts of a scene: moments, pose, twist and strain, the stiffness that follows from the scene, refusals
(files: test_toml_*.py).
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.quality import volume_moments
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.plan import make_plan
from taisoft.scene.refine import refined
from taisoft.scene.rigid import RigidBody
from tests.collision.rotations import rotation

G = 9.81
SIZE = (1.0, 0.6, 0.3)
R, SHIFT = rotation((1.0, -2.0, 0.5), 0.9), np.array([3.0, -2.0, 5.0])
BOX = ts.box_mesh(cells=(1, 1, 1), size=SIZE)


def surface_of(mesh: ts.TetMesh) -> ts.SurfaceMesh:
    used, triangles = np.unique(mesh.surface, return_inverse=True)
    return ts.SurfaceMesh(mesh.vertices[used], triangles.reshape(-1, 3))


def with_soft() -> ts.Scene:
    scene = ts.Scene()
    scene.add_rigid_body(BOX, name="r")
    scene.add_body(BOX, ts.Material(), name="soft", position=(0, 2, 0))
    return scene


def test_moments_are_those_of_the_solid():
    ball = ts.TetMesh(ts.ball_mesh(radius=0.7, cells=4).vertices * SIZE @ R.T + SHIFT, ts.ball_mesh(0.7, 4).tets)
    volume, centre, covariance = volume_moments(ball.vertices, ball.surface)
    x = ball.vertices[ball.tets]
    total = x.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", ball.volumes, x, x) + np.einsum("t,ti,tj->ij", ball.volumes, total, total)
    own = ball.volumes @ total / 4.0 / ball.volumes.sum()
    assert volume == pytest.approx(ball.volumes.sum(), rel=1e-12) and np.allclose(centre, own, atol=1e-12)
    assert np.allclose(covariance, second / 20.0 / volume - np.outer(own, own), atol=1e-12)


def test_four_equal_masses_have_the_mass_centre_and_inertia_of_the_body():
    scene = ts.Scene()
    turned = ts.TetMesh(BOX.vertices @ R.T + 1.0, BOX.tets)
    body, same = scene.add_rigid_body(turned, density=700.0), scene.add_rigid_body(surface_of(turned), density=700.0)
    x, m = body.mesh.vertices - body.centre, np.full(4, 0.25 * body.mass)
    assert body.mass == pytest.approx(700.0 * np.prod(SIZE), rel=1e-12) and np.allclose(m @ x, 0.0, atol=1e-12)
    inertia = np.einsum("a,ai,ai->", m, x, x) * np.eye(3) - np.einsum("a,ai,aj->ij", m, x, x)
    exact = R @ (body.mass / 12.0 * (np.sum(np.square(SIZE)) * np.eye(3) - np.diag(np.square(SIZE)))) @ R.T
    assert np.allclose(inertia, exact, rtol=1e-12) and np.allclose(body.inertia, exact, rtol=1e-12)
    assert np.allclose(body.nodes.embedded @ body.mesh.vertices, body.surface.vertices, atol=1e-13)
    assert np.array_equal(body.rest_positions, same.rest_positions) and np.array_equal(body.nodes.surface, same.nodes.surface)


def test_pose_twist_and_strain_of_a_rigid_motion():
    body = ts.Scene().add_rigid_body(BOX, position=(1, 2, 3))
    w, v = np.array([1.0, -2.0, 0.5]), np.array([3.0, 0.0, 1.0])
    arms = (body.rest_positions - body.centre) @ R.T
    x = arms + body.centre + body.position + SHIFT
    pose, twist = body.pose(x), body.twist(x, v + np.cross(w, arms))
    assert np.allclose(pose.translation, SHIFT, atol=1e-12) and np.allclose(pose.rotation, R, atol=1e-12)
    assert np.allclose(twist.velocity, v, atol=1e-12) and np.allclose(twist.angular_velocity, w, atol=1e-12)
    assert body.strain(x) < 1e-12
    assert body.strain(body.centre + 1.01 * (x - body.centre)) == pytest.approx(0.01, rel=1e-9)
    moved = body.move(lambda t: (t * SHIFT, rotation((1.0, -2.0, 0.5), 0.9 * t)))
    assert np.allclose(moved.path(1.0), (x - body.rest_positions - body.position)[moved.nodes], atol=1e-12)


def test_the_velocity_at_the_start():
    body = ts.Scene().add_rigid_body(BOX, name="r", velocity=(0, 1, 0), angular_velocity=(0, 0, 2), density=777.7)
    assert body.density == 777.7 and body.start_twist.angular_velocity.tolist() == [0, 0, 2]
    arms = body.rest_positions - body.centre
    assert np.allclose(body.velocity, np.array([0, 1, 0]) + np.cross((0, 0, 2), arms), atol=1e-14)
    with pytest.raises(ts.SceneError, match="can only be set to"):
        body.velocity = np.zeros((12, 3))
    body.velocity = (3, 0, 0)
    assert body.start_twist.velocity.tolist() == [3, 0, 0] and body.start_twist.angular_velocity.tolist() == [0, 0, 0]


def test_the_stiffness_follows_from_the_scene_unless_it_is_given():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_rigid_body(BOX, name="a")
    scene.add_rigid_body(BOX, name="b", young=3e8)
    own = 1000.0 * G * 1.0 / 1e-5  # its weight strains it by 1e-5, also in a scene without gravity
    assert scene.snapshot().body("a").young == pytest.approx(own, rel=1e-9)
    assert 0.3 < scene.body("b").lowest_frequency / (np.sqrt(3e8 / 1000.0) * np.pi) < 3.0
    scene.gravity = (0, -2 * G, 0)
    assert scene.snapshot().body("a").young == pytest.approx(2 * own, rel=1e-9)
    fast = scene.add_body(BOX, ts.Material(young=1e4), velocity=(0, 200, 0), position=(0, 5, 0))
    assert scene.snapshot().body("a").young == pytest.approx(1000.0 * 200.0**2 / 1e-5, rel=1e-9)
    fast.material = ts.Material(law="corotational", young=1e10)
    copied = scene.snapshot()
    assert copied.body("a").young == pytest.approx(1e3 * 1e10) and copied.body("b").young == pytest.approx(3e8)
    assert copied.body("a").composition.laws == ("corotational",)  # no second law is compiled


def test_the_plan_names_rigid_bodies_and_refined_scenes_keep_them():
    scene = with_soft()
    for explicit in (False, True):
        plan = make_plan(scene, explicit, False)
        assert plan.why("rigid_bodies") == "r" and plan.on["dependent_nodes"] and plan.on["law:stable_neo_hookean"]
        assert plan.on["rigid_motion"] is explicit and plan.on["rigid_damping"] is not explicit
    scene.contact_forces = False
    assert not make_plan(scene, False, False).on["rigid_damping"]
    finer = refined(scene)
    assert isinstance(finer.body("r"), RigidBody) and finer.body("r").n_nodes == scene.body("r").n_nodes
    # ends of connections are vertices counted from 0
    spring = scene.add_spring(("r", 7), ("soft", 0), stiffness=1.0)
    assert np.array_equal(spring.points[0].position, scene.body("r").surface.vertices[7])
    assert scene.body("r").selectable == slice(4, 12)


SURFACE = surface_of(BOX)
FLAT = ts.SurfaceMesh(SURFACE.vertices * (1, 1, 1e-12), SURFACE.triangles)


def add(**arguments):
    return lambda s, b: s.add_rigid_body(**({"mesh": BOX, "name": "q"} | arguments))


REFUSALS = [
    (add(mesh=3), "rigid body 'q': mesh must be a TetMesh or a SurfaceMesh, not int"),
    (add(mesh=ts.SurfaceMesh(np.eye(3), np.array([[0, 1, 2]]))), "rigid body 'q': its surface does not bound a solid: 1 hole"),
    (add(mesh=ts.SurfaceMesh(SURFACE.vertices, SURFACE.triangles[:, ::-1])), "all normals point inward"),
    (add(mesh=FLAT), "encloses no volume in one direction|does not bound a solid"),
    (add(density=0.0), "rigid body 'q': density must be greater than 0 kg/m.3"),
    (add(young=-1.0), "rigid body 'q': young must be greater than 0 Pa"),
    (add(velocity=(1, 2)), "rigid body 'q': velocity must have shape .3,."),
    (add(angular_velocity=(1, 2, np.inf)), "rigid body 'q': angular_velocity: entry .2. is inf"),
    (add(friction=-1.0), "friction must be at least 0"),
    (lambda s, b: b.add_traction([0], (0, 0, 1.0)), "takes forces only"),
    (lambda s, b: b.add_pressure([0], 1.0), "takes forces only"),
    (lambda s, b: b.add_cavity([0], 1.0), "takes forces only"),
    (lambda s, b: b.embed(SURFACE), "takes forces only"),
    (lambda s, b: b.fix("y", "x"), "rotations must be 'xz', not 'x'"),
    (lambda s, b: setattr(b, "collision", "distance_field"), "an embedded surface has no distance field"),
    (lambda s, b: b.move(lambda t: (1.0, np.eye(3))), "^rigid body 'r': the path's translation at t = 0 must have shape"),
    (lambda s, b: b.add_force([8], (1, 0, 0)), "node 8 does not exist"),
    *((lambda s, b, name=name: setattr(b, name, 1.0), name) for name in ("material", "young", "density", "centre")),
    (lambda s, b: s.add_spring(("r", 8), ("soft", 0), stiffness=1.0), "a: the node must be"),
    (lambda s, b: s.attach("r", [0], "soft", stiffness=1.0), "node 0 of body 'r' lies outside of body 'soft'"),
    (lambda s, b: s.attach("r", [0], "soft"), "rigid: attach the other body's nodes to it"),
    (lambda s, b: s.add_spring(("r", (0, 5, 0)), ("soft", 0), 1.0), "lies outside of body 'r', by .* times its size"),
]


@pytest.mark.parametrize("call, message", REFUSALS)
def test_what_is_invalid_or_a_rigid_body_cannot_do_is_refused(call, message):
    scene = with_soft()
    before = scene_digest(scene)
    with pytest.raises(ts.SceneError, match=message):
        call(scene, scene.body("r"))
    assert scene_digest(scene) == before
