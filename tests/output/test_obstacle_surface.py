"""Obstacles as triangles, in pictures and in USD: closed solids, squares of half-spaces, paths, sides, guides."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import taisoft as ts
from taisoft.mesh.topology import opposite_half_edges
from taisoft.output.appearance import obstacle_surfaces
from taisoft.output.usd import UsdWriter
from taisoft.view.scene_view import Surfaces
from tests.collision.rotations import rotation
from tests.output.usd_stage import faults
from tests.view.drawing import sampled
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
    return np.cross(*np.moveaxis(np.diff(vertices[triangles], axis=1), 1, 0)) / 2


def test_surfaces_of_solids_are_closed_outward_and_on_the_boundary():
    for name, (shape, volume) in SOLIDS.items():
        (surface,) = obstacle_surfaces(make_scene(solid=(shape, None)))
        x, t, is_round = surface.vertices, surface.triangles, name in ("sphere", "capsule")
        assert (opposite_half_edges(t) >= 0).all() and len(np.unique(t)) == len(x)
        enclosed = np.linalg.det((x - shape.pivot)[t]).sum() / 6
        assert enclosed == pytest.approx(volume, rel=0.02 if is_round else 1e-12)
        if is_round:
            local = (x - shape.pivot) @ shape.frame()
            half = shape.size()[0] if name == "capsule" else 0.0
            local[:, 0] -= np.clip(local[:, 0], -half, half)
            assert np.abs(np.linalg.norm(local, axis=1) - shape.radius).max() < 1e-12


def test_half_spaces_are_squares_that_end_at_each_other():
    (surface,) = obstacle_surfaces(make_scene(ground=(ts.HalfSpace((0, -1, 0), (0.1, 1, 0)), None)))
    shape, x = surface.obstacle.shape, surface.vertices
    assert np.abs((x - shape.point) @ shape.normal).max() < 1e-12
    assert np.abs(np.cross((3, 5, 0) - x.mean(axis=0), shape.normal)).max() < 1e-9  # below the body
    walls = {f"wall{k}": (ts.HalfSpace((3, 5, 0) - 0.7 * n, n), None) for k, n in enumerate(np.r_[np.eye(3), -np.eye(3)])}
    for surface in obstacle_surfaces(make_scene(**walls)):
        assert np.linalg.norm(area_vectors(surface.vertices, surface.triangles), axis=1).sum() == pytest.approx(1.4**2)
    angles = 2 * np.pi * np.arange(5) / 5  # of a funnel, whose planes pass through one point
    normals = np.stack([np.cos(angles), np.full(5, 0.5), np.sin(angles)], axis=1)
    funnel = {f"wall{k}": (ts.HalfSpace((3, 4, 0), n), None) for k, n in enumerate(normals)}
    for surface, n in zip(obstacle_surfaces(make_scene(**funnel)), normals):
        x, area = surface.vertices - (3, 4, 0), area_vectors(surface.vertices, surface.triangles)
        assert (area @ n > 0).all() and np.linalg.norm(area, axis=1).sum() > 1.0
        assert np.abs(x @ n).max() < 1e-9 and (x @ normals.T).min() > -1e-7
    hidden = make_scene(ground=(ts.HalfSpace((3, 4, 0), (0, 1, 0)), None), above=(ts.HalfSpace((3, 4.2, 0), (0, 1, 0)), None))
    assert [len(s.triangles) > 0 for s in obstacle_surfaces(hidden)] == [False, True]


def rolling(t: float):
    """A path that translates along x and rotates about z, until 0.55 s."""
    if t > 0.55:
        raise ValueError("the path has ended")
    return np.array([t, 0.0, 0.0]), rotation((0, 0, 1), t)


def test_surfaces_follow_paths():
    spin = {"disc": (ts.HalfSpace((-50, 0, 0), (0, 1, 0)), lambda t: ((0, t, 0), rotation((0, 1, 0), t)))}
    spinning, box = obstacle_surfaces(make_scene(**spin, box=(SOLIDS["box"][0], rolling)))
    assert np.allclose(spinning.at(1.0).mean(axis=0), (3, 1, 0))
    assert np.allclose(box.at(0.5), (box.vertices - (1, 0, 0)) @ rolling(0.5)[1].T + (1.5, 0, 0))
    with pytest.raises(ts.OutputError, match="an obstacle cannot be shown: obstacle 'box': the path .* the path has ended"):
        box.at(1.5)


def test_triangles_that_face_the_eye_are_drawn():
    scene = make_scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), box=(SOLIDS["box"][0], rolling))
    surfaces, sim = Surfaces(scene), FakeSimulator(scene)
    sim.time, (translation, Q) = 0.5, rolling(0.5)
    state = sampled(sim)
    bodies = surfaces.of_bodies(state)
    for eye, above in (((3.0, 9.0, 9.0), True), ((3.0, -9.0, 9.0), False)):
        x, normals = surfaces.with_obstacles(bodies, state, np.array(eye))
        assert len(x) == len(normals) == len(surfaces.colours) and np.array_equal(x[: len(bodies[0])], bodies[0])
        area = np.linalg.norm(area_vectors(x, surfaces.triangles), axis=1)
        assert (area[len(bodies[0]) // 3 : -12].sum() > 10.0) == above
        facing = np.abs(Q.T @ (np.array(eye) - (1, 0, 0) - translation)) > (0.1, 0.2, 0.3)  # one side per axis, or none
        assert area[-12:].sum() == pytest.approx(facing @ [0.4 * 0.6, 0.2 * 0.6, 0.2 * 0.4])


def test_usd_stages_hold_obstacles_in_every_frame(tmp_path):
    """From the chunks of a run whose path ended. A floor, two walls behind and two in front of the bodies, an open mesh."""
    normals = {"left": (1, 0, 0), "right": (-1, 0, 0), "back": (0, 0, 1), "front": (0, 0, -1), "floor": (0, 1, 0)}
    walls = {name: (ts.HalfSpace((3, 4, 0) - 2 * np.array(n), n), None) for name, n in normals.items()}
    bowl = ts.MeshObstacle(BALL.vertices, BALL.surface[BALL.vertices[BALL.surface][:, :, 1].mean(axis=1) < 0])
    scene = make_scene(**walls, bowl=(bowl, None), **{"a box": (SOLIDS["box"][0], rolling)})
    sim, writer = FakeSimulator(scene), UsdWriter(tmp_path, scene, fps=10.0, chunk_frames=2)
    for index in range(4):
        sim.time = index / 10
        writer.frame(sim, index)
    sim.time = 0.6
    with pytest.raises(ts.OutputError, match="the path has ended"):
        writer.frame(sim, 4)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert faults(stage) == []
    floor, box = obstacle_surfaces(scene)[4], obstacle_surfaces(scene)[6]
    points = stage.GetAttributeAtPath("/World/floor/surface.points")
    assert points.GetTimeSamples() == [] and np.array_equal(points.Get(), floor.vertices.astype(np.float32))
    points = stage.GetAttributeAtPath("/World/a_box/surface.points")
    assert points.GetTimeSamples() == [0, 1, 2, 3]
    assert all(np.array_equal(points.Get(index), box.at(index / 10).astype(np.float32)) for index in range(4))
    assert stage.GetPrimAtPath("/World/a_box").GetDisplayName() == "a box"
    meshes = {name: UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/surface")) for name in (*walls, "bowl", "a_box")}
    guides = {name for name, mesh in meshes.items() if mesh.ComputePurpose() == UsdGeom.Tokens.guide}
    assert guides == {"right", "front"}  # the camera is on the right, in front and above
    assert {name for name, mesh in meshes.items() if mesh.GetDoubleSidedAttr().Get()} == {"bowl"}
