"""Obstacles as triangles, in images and in USD:

* surfaces of solids are closed, with outward normals and vertices on the boundary;
* a half-space is a square below the bodies, clipped by other half-spaces, also if many meet in a point;
* surfaces follow their paths, the square of a half-space only along its normal; a failing path raises OutputError;
* triangles that face away from the eye are not drawn, and a floor that extends behind the eye is drawn;
* in USD, obstacles have their positions in every frame, or once if they rest; stages are valid, also when joined from chunks;
* in USD, walls between the camera and the bodies are guides, open meshes are double-sided, and all are bound to a grey material.
"""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

import taisoft as ts
from taisoft.mesh.topology import opposite_half_edges
from taisoft.output.appearance import HALF_SIDE, OBSTACLE_COLOUR, obstacle_surfaces
from taisoft.output.usd import UsdWriter, join_chunks
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import Surfaces
from tests.collision.rotations import rotation
from tests.output.usd_stage import faults
from tests.view.fake_simulator import RUBBER, FakeSimulator

BALL = ts.ball_mesh(0.5, 4)
BALL_VOLUME = np.abs(np.linalg.det(np.diff(BALL.vertices[BALL.tets], axis=1))).sum() / 6
SOLIDS = {
    "sphere": (ts.Sphere((1, 2, 3), 0.4), 4 / 3 * np.pi * 0.4**3),
    "capsule": (ts.Capsule((0, 1, 0), (1, 2, -1), 0.3), np.pi * 0.3**2 * (np.sqrt(3) + 4 / 3 * 0.3)),
    "box": (ts.Box((1, 0, 0), (0.1, 0.2, 0.3)), 8 * 0.006),
    "mesh": (ts.MeshObstacle(BALL.vertices, BALL.surface), BALL_VOLUME),
}


def make_scene(**obstacles) -> ts.Scene:
    """A cube and obstacles. obstacles: name -> (shape, path)."""
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), RUBBER, name="cube", position=(3, 5, 0))
    for name, (shape, path) in obstacles.items():
        scene.add_obstacle(shape, name=name, path=path)
    return scene


def area_vectors(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normals (t,3) of triangles, of the length of their area [m^2]."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("name", SOLIDS)
def test_surfaces_of_solids_are_closed_outward_and_on_the_boundary(name):
    shape, volume = SOLIDS[name]
    (surface,) = obstacle_surfaces(make_scene(solid=(shape, None)))
    x, t = surface.vertices, surface.triangles
    assert (opposite_half_edges(t) >= 0).all() and len(np.unique(t)) == len(x)
    a, b, c = (x[t[:, k]] - shape.pivot for k in range(3))
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert enclosed == pytest.approx(volume, rel=0.02 if name in ("sphere", "capsule") else 1e-12)
    if name in ("sphere", "capsule"):
        local = (x - shape.pivot) @ shape.frame()
        along = np.clip(local[:, 0], -shape.size()[0], shape.size()[0]) if name == "capsule" else 0.0 * local[:, 0]
        distance = np.linalg.norm(local - along[:, None] * (1, 0, 0), axis=1)
        assert np.abs(distance - shape.radius).max() < 1e-12


def test_a_half_space_is_a_square_below_the_bodies():
    (surface,) = obstacle_surfaces(make_scene(ground=(ts.HalfSpace((0, -1, 0), (0.1, 1, 0)), None)))
    shape, x = surface.obstacle.shape, surface.vertices
    assert np.abs((x - shape.point) @ shape.normal).max() < 1e-12
    area = area_vectors(x, surface.triangles)
    assert (area @ shape.normal > 0).all()
    side = 2 * HALF_SIDE * np.sqrt(3)  # proportional to the diagonal of a cube of 1 m
    assert area.sum(axis=0) @ shape.normal == pytest.approx(side**2)
    offset = np.array([3, 5, 0]) - x.mean(axis=0)
    assert np.abs(np.cross(offset, shape.normal)).max() < 1e-9


def test_walls_of_a_box_meet_at_its_edges():
    walls = {f"wall{k}": (ts.HalfSpace((3, 5, 0) - 0.7 * n, n), None) for k, n in enumerate(np.r_[np.eye(3), -np.eye(3)])}
    for surface in obstacle_surfaces(make_scene(**walls)):
        local = (surface.vertices - (3, 5, 0)) @ surface.obstacle.shape.frame()
        assert np.allclose(np.abs(local[:, [0, 2]]).max(axis=0), 0.7) and np.abs(local[:, 1] + 0.7).max() < 1e-12
        assert np.linalg.norm(area_vectors(surface.vertices, surface.triangles), axis=1).sum() == pytest.approx(1.4**2)


def test_half_spaces_inside_others_are_not_shown(tmp_path):
    hidden = make_scene(ground=(ts.HalfSpace((3, 4, 0), (0, 1, 0)), None), above=(ts.HalfSpace((3, 4.2, 0), (0, 1, 0)), None))
    assert [len(s.triangles) > 0 for s in obstacle_surfaces(hidden)] == [False, True]
    equal = make_scene(first=(ts.HalfSpace((0, 4, 0), (0, 1, 0)), None), second=(ts.HalfSpace((9, 4, 1), (0, 2, 0)), None))
    assert [len(s.triangles) > 0 for s in obstacle_surfaces(equal)] == [True, False]
    surfaces, sim = Surfaces(hidden), FakeSimulator(hidden)
    x, normals = surfaces.with_obstacles(surfaces.of_bodies(sim), 0.0, np.array([3.0, 9.0, 9.0]))
    assert len(x) == len(normals) == len(surfaces.colours) and np.isfinite(x).all() and np.isfinite(normals).all()
    writer = UsdWriter(tmp_path, hidden)
    writer.frame(sim, 0)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert stage.GetPrimAtPath("/World/above") and not stage.GetPrimAtPath("/World/ground")


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 8])
def test_half_spaces_of_a_funnel_end_at_each_other(sides):
    """All planes pass through one point."""
    angles = 2 * np.pi * np.arange(sides) / sides
    normals = np.stack([np.cos(angles), np.full(sides, 0.5), np.sin(angles)], axis=1)
    surfaces = obstacle_surfaces(make_scene(**{f"wall{k}": (ts.HalfSpace((3, 4, 0), n), None) for k, n in enumerate(normals)}))
    all_normals = [surface.obstacle.shape.normal for surface in surfaces]
    for surface, n in zip(surfaces, all_normals):
        x, area = surface.vertices - (3, 4, 0), area_vectors(surface.vertices, surface.triangles)
        assert (area @ n > 0).all() and np.linalg.norm(area, axis=1).sum() > 1.0
        assert np.abs(x @ n).max() < 1e-9 and min((x @ normal).min() for normal in all_normals) > -1e-7


def ending_path(end: float, velocity):
    """A path of constant velocity (3,) [m/s] that fails after a time [s]."""

    def path(t):
        if t > end:
            raise ValueError("the path has ended")
        return t * np.array(velocity), np.eye(3)

    return path


def test_surfaces_follow_paths():
    path = ending_path(1.0, (1.0, 0.5, 0.0))
    floor, ball = obstacle_surfaces(
        make_scene(floor=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), path), ball=(SOLIDS["sphere"][0], path))
    )
    assert np.allclose(floor.at(1.0), floor.vertices + (0, 0.5, 0)) and np.allclose(ball.at(1.0), ball.vertices + (1, 0.5, 0))
    with pytest.raises(ts.OutputError, match="an obstacle cannot be shown: obstacle 'ball': the path .* the path has ended"):
        ball.at(1.5)
    spin, tilt = (lambda t: (np.zeros(3), rotation((0, 1, 0), t))), (lambda t: (np.zeros(3), rotation((0, 0, 1), t)))
    (spinning,) = obstacle_surfaces(make_scene(disc=(ts.HalfSpace((-50, 0, 0), (0, 1, 0)), spin)))
    assert np.allclose(spinning.at(1.0).mean(axis=0), (3, 0, 0))
    (tilting,) = obstacle_surfaces(make_scene(slope=(ts.HalfSpace((3, 0, 0), (0, 1, 0)), tilt)))
    x, normal = tilting.at(0.3), rotation((0, 0, 1), 0.3) @ (0, 1, 0)
    assert np.abs((x - (3, 0, 0)) @ normal).max() < 1e-12 and np.linalg.norm(x.mean(axis=0) - (3, 0, 0)) < 1e-12


def test_a_failing_path_leaves_complete_frames(tmp_path):
    scene = make_scene(box=(SOLIDS["box"][0], ending_path(0.15, (1.0, 0.0, 0.0))))
    sim, writer = FakeSimulator(scene), UsdWriter(tmp_path, scene, fps=10.0, chunk_frames=5)
    for index in range(2):
        sim.time = index / 10
        writer.frame(sim, index)
    sim.time = 0.2
    with pytest.raises(ts.OutputError, match="the path has ended"):
        writer.frame(sim, 2)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert stage.GetAttributeAtPath("/World/cube/surface.points").GetTimeSamples() == [0, 1] and stage.GetEndTimeCode() == 1


def rolling(t: float):
    """A path that translates along x and rotates about z."""
    return np.array([t, 0.0, 0.0]), rotation((0, 0, 1), t)


def test_triangles_that_face_the_eye_are_drawn():
    scene = make_scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), box=(SOLIDS["box"][0], rolling))
    surfaces, sim = Surfaces(scene), FakeSimulator(scene)
    sim.time = 0.5
    bodies = surfaces.of_bodies(sim)
    grey = (surfaces.colours == OBSTACLE_COLOUR).all(axis=1)
    assert not grey[: len(bodies[0])].any() and grey[len(bodies[0]) :].all()
    translation, Q = rolling(0.5)
    for eye, above in (((3.0, 9.0, 9.0), True), ((3.0, -9.0, 9.0), False)):
        x, normals = surfaces.with_obstacles(bodies, 0.5, np.array(eye))
        assert len(x) == len(normals) == len(grey) and np.array_equal(x[: len(bodies[0])], bodies[0])
        corners = x[surfaces.triangles]
        area = np.linalg.norm(area_vectors(x, surfaces.triangles), axis=1)
        box, floor = slice(-12, None), slice(-12 - 4 * 4**3, -12)
        assert (area[floor].sum() > 10.0) == above and (area[floor] > 0).all() == above
        local_eye = Q.T @ (np.array(eye) - (1, 0, 0) - translation)
        facing = np.abs(local_eye) > (0.1, 0.2, 0.3)  # one side of the box per axis, or none
        assert area[box].sum() == pytest.approx(facing @ [0.4 * 0.6, 0.2 * 0.6, 0.2 * 0.4])
        drawn = corners[box][area[box] > 0].reshape(-1, 3)
        assert np.allclose(np.abs((drawn - (1, 0, 0) - translation) @ Q), (0.1, 0.2, 0.3))
        assert np.allclose(np.abs(normals[-36:] @ Q).max(axis=1), 1.0)


def test_a_floor_that_extends_behind_the_eye_is_drawn():
    scene = make_scene(box=(ts.Box((3, 4.3, 0), (9, 0.2, 9)), None))
    image = Offscreen(scene, (160, 90)).image(FakeSimulator(scene)).astype(int)
    bottom = image[-8:].reshape(-1, 3)  # the top of the box
    assert np.ptp(bottom, axis=1).max() < 30 and np.ptp(bottom, axis=0).max() < 30 and 130 < bottom.mean() < 220


@pytest.mark.parametrize("joined", [False, True])
def test_usd_stages_hold_obstacles_in_every_frame(tmp_path, joined):
    """joined: from the chunks of a run that was killed."""
    scene = make_scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), **{"a box": (SOLIDS["box"][0], rolling)})
    sim, writer = FakeSimulator(scene), UsdWriter(tmp_path, scene, fps=10.0, chunk_frames=2)
    for index in range(4):
        sim.time = index / 10
        writer.frame(sim, index)
    path = join_chunks(tmp_path) if joined else tmp_path / "scene.usdc"
    if not joined:
        writer.close()
    stage = Usd.Stage.Open(str(path))
    assert faults(stage) == []
    ground, box = obstacle_surfaces(scene)
    points = stage.GetAttributeAtPath("/World/ground/surface.points")
    assert points.GetTimeSamples() == [] and np.array_equal(points.Get(), ground.vertices.astype(np.float32))
    points = stage.GetAttributeAtPath("/World/a_box/surface.points")
    assert points.GetTimeSamples() == [0, 1, 2, 3]
    for index in range(4):
        assert np.array_equal(points.Get(index), box.at(index / 10).astype(np.float32))
    triangles = np.array(stage.GetAttributeAtPath("/World/a_box/surface.faceVertexIndices").Get())
    assert np.array_equal(triangles.reshape(-1, 3), box.triangles)
    assert stage.GetPrimAtPath("/World/a_box").GetDisplayName() == "a box"


def test_usd_purposes_sides_and_materials_of_obstacles(tmp_path):
    """A floor, two walls behind and two in front of the bodies, an open and a closed mesh."""
    normals = {"left": (1, 0, 0), "right": (-1, 0, 0), "back": (0, 0, 1), "front": (0, 0, -1), "floor": (0, 1, 0)}
    walls = {name: (ts.HalfSpace((3, 4, 0) - 2 * np.array(n), n), None) for name, n in normals.items()}
    closed = SOLIDS["mesh"][0]
    bowl = ts.MeshObstacle(closed.vertices, closed.triangles[closed.vertices[closed.triangles][:, :, 1].mean(axis=1) < 0])
    scene = make_scene(**walls, bowl=(bowl, None), ball=(closed, None))
    writer = UsdWriter(tmp_path, scene)
    writer.frame(FakeSimulator(scene), 0)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert faults(stage) == []
    meshes = {name: UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/surface")) for name in (*walls, "bowl", "ball")}
    guides = {name for name, mesh in meshes.items() if mesh.ComputePurpose() == UsdGeom.Tokens.guide}
    assert guides == {"right", "front"}  # the camera is on the right, in front and above
    assert {name for name, mesh in meshes.items() if mesh.GetDoubleSidedAttr().Get()} == {"bowl"}
    for mesh in meshes.values():
        material = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
        colour = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").Get()
        assert colour == mesh.GetDisplayColorAttr().Get()[0] and np.ptp(np.array(colour)) < 0.05
