"""Obstacles as triangles:

* surfaces are closed (but a half-space's), their normals point out of the solid, and their vertices lie on its boundary;
* the square of a half-space lies below the bodies, and ends where another half-space begins, also where many meet in a point;
* they follow a path, a square only along its normal; a path that fails is told;
* of what is drawn, triangles that look away from the eye go; both renderers draw the same floor about a body;
* in USD obstacles lie where they are in every frame, those at rest once; no validator objects; chunks join with them;
* there walls that would hide the bodies from the camera are guides, what does not close is double-sided, and all is bound to a
  grey material.
"""

import numpy as np
import pytest
from fake_simulator import RUBBER, FakeSimulator
from pxr import Usd, UsdGeom, UsdShade
from rotations import rotation
from usd_stage import faults

import taisoft as ts
from taisoft.mesh.topology import opposite_half_edges
from taisoft.output.appearance import HALF_SIDE, OBSTACLE_COLOUR, obstacle_surfaces
from taisoft.output.usd import UsdWriter, join_chunks
from taisoft.view.ggui import vulkan_missing
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import Surfaces

BALL = ts.ball_mesh(0.5, 4)
BALL_VOLUME = np.abs(np.linalg.det(np.diff(BALL.vertices[BALL.tets], axis=1))).sum() / 6
SOLIDS = {
    "sphere": (ts.Sphere((1, 2, 3), 0.4), 4 / 3 * np.pi * 0.4**3),
    "capsule": (ts.Capsule((0, 1, 0), (1, 2, -1), 0.3), np.pi * 0.3**2 * (np.sqrt(3) + 4 / 3 * 0.3)),
    "box": (ts.Box((1, 0, 0), (0.1, 0.2, 0.3)), 8 * 0.006),
    "mesh": (ts.MeshObstacle(BALL.vertices, BALL.surface), BALL_VOLUME),
}


def scene(**obstacles) -> ts.Scene:
    made = ts.Scene()
    made.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), RUBBER, name="cube", position=(3, 5, 0))
    for name, (shape, path) in obstacles.items():
        made.add_obstacle(shape, name=name, path=path)
    return made


@pytest.mark.parametrize("name", SOLIDS)
def test_solids(name):
    shape, volume = SOLIDS[name]
    (surface,) = obstacle_surfaces(scene(one=(shape, None)))
    x, t = surface.vertices, surface.triangles
    assert (opposite_half_edges(t) >= 0).all() and len(np.unique(t)) == len(x)
    a, b, c = (x[t[:, k]] - shape.pivot for k in range(3))
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert enclosed == pytest.approx(volume, rel=0.02 if name in ("sphere", "capsule") else 1e-12)
    if name in ("sphere", "capsule"):
        local = (x - shape.pivot) @ shape.frame()
        along = np.clip(local[:, 0], -shape.size()[0], shape.size()[0]) if name == "capsule" else 0.0 * local[:, 0]
        off = np.linalg.norm(local - along[:, None] * (1, 0, 0), axis=1)
        assert np.abs(off - shape.radius).max() < 1e-12


def test_a_half_space():
    (surface,) = obstacle_surfaces(scene(ground=(ts.HalfSpace((0, -1, 0), (0.1, 1, 0)), None)))
    shape, x = surface.obstacle.shape, surface.vertices
    assert np.abs((x - shape.point) @ shape.normal).max() < 1e-12
    a, b, c = (x[surface.triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a) / 2
    assert (area @ shape.normal > 0).all()
    side = 2 * HALF_SIDE * np.sqrt(3)  # of the diagonal of a cube of 1 m
    assert area.sum(axis=0) @ shape.normal == pytest.approx(side**2)
    away = np.array([3, 5, 0]) - x.mean(axis=0)
    assert np.abs(np.cross(away, shape.normal)).max() < 1e-9


def test_walls_of_a_bin_meet():
    walls = {f"wall{k}": (ts.HalfSpace((3, 5, 0) - 0.7 * n, n), None) for k, n in enumerate(np.r_[np.eye(3), -np.eye(3)])}
    surfaces = obstacle_surfaces(scene(**walls))
    for surface in surfaces:
        middle = (surface.vertices - (3, 5, 0)) @ surface.obstacle.shape.frame()
        assert np.allclose(np.abs(middle[:, [0, 2]]).max(axis=0), 0.7) and np.abs(middle[:, 1] + 0.7).max() < 1e-12
        a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(1.4**2)


def test_what_lies_in_another_is_not_shown(tmp_path):
    hidden = scene(ground=(ts.HalfSpace((3, 4, 0), (0, 1, 0)), None), above=(ts.HalfSpace((3, 4.2, 0), (0, 1, 0)), None))
    assert [len(s.triangles) > 0 for s in obstacle_surfaces(hidden)] == [False, True]
    twice = scene(one=(ts.HalfSpace((0, 4, 0), (0, 1, 0)), None), two=(ts.HalfSpace((9, 4, 1), (0, 2, 0)), None))
    assert [len(s.triangles) > 0 for s in obstacle_surfaces(twice)] == [True, False]
    surfaces, sim = Surfaces(hidden), FakeSimulator(hidden)
    x, normals = surfaces.with_obstacles(surfaces.of_bodies(sim), 0.0, np.array([3.0, 9.0, 9.0]))
    assert len(x) == len(normals) == len(surfaces.colours) and np.isfinite(x).all() and np.isfinite(normals).all()
    writer = UsdWriter(tmp_path, hidden)
    writer.frame(sim, 0)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert stage.GetPrimAtPath("/World/above") and not stage.GetPrimAtPath("/World/ground")


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 8])
def test_a_funnel(sides):
    """Walls through one point, where clipping meets corners."""
    angles = 2 * np.pi * np.arange(sides) / sides
    normals = np.stack([np.cos(angles), np.full(sides, 0.5), np.sin(angles)], axis=1)
    made = scene(**{f"wall{k}": (ts.HalfSpace((3, 4, 0), n), None) for k, n in enumerate(normals)})
    others = [s.obstacle.shape.normal for s in obstacle_surfaces(made)]
    for surface in obstacle_surfaces(made):
        n, x = surface.obstacle.shape.normal, surface.vertices - (3, 4, 0)
        a, b, c = (x[surface.triangles[:, k]] for k in range(3))
        area = np.cross(b - a, c - a) / 2
        assert (area @ n > 0).all() and np.linalg.norm(area, axis=1).sum() > 1.0
        assert np.abs(x @ n).max() < 1e-9 and min((x @ other).min() for other in others) > -1e-7


def test_paths():
    def belt(t):
        if t > 1:
            raise ValueError("no more")
        return np.array([t, 0.5 * t, 0.0]), np.eye(3)

    (floor, ball) = obstacle_surfaces(scene(floor=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), belt), ball=(SOLIDS["sphere"][0], belt)))
    assert np.allclose(floor.at(1.0), floor.vertices + (0, 0.5, 0)) and np.allclose(ball.at(1.0), ball.vertices + (1, 0.5, 0))
    with pytest.raises(ts.OutputError, match="an obstacle cannot be shown: obstacle 'ball': the path .* no more"):
        ball.at(1.5)
    spin, tilt = (lambda t: (np.zeros(3), rotation((0, 1, 0), t))), (lambda t: (np.zeros(3), rotation((0, 0, 1), t)))
    (spinning,) = obstacle_surfaces(scene(disc=(ts.HalfSpace((-50, 0, 0), (0, 1, 0)), spin)))
    assert np.allclose(spinning.at(1.0).mean(axis=0), (3, 0, 0))
    (tilting,) = obstacle_surfaces(scene(slope=(ts.HalfSpace((3, 0, 0), (0, 1, 0)), tilt)))
    x, normal = tilting.at(0.3), rotation((0, 0, 1), 0.3) @ (0, 1, 0)
    assert np.abs((x - (3, 0, 0)) @ normal).max() < 1e-12 and np.linalg.norm(x.mean(axis=0) - (3, 0, 0)) < 1e-12


def test_a_path_that_fails_leaves_whole_frames(tmp_path):
    def ending(t):
        if t > 0.15:
            raise ValueError("no more")
        return np.array([t, 0.0, 0.0]), np.eye(3)

    made = scene(box=(SOLIDS["box"][0], ending))
    sim, writer = FakeSimulator(made), UsdWriter(tmp_path, made, fps=10.0, chunk_frames=5)
    for index in range(2):
        sim.time = index / 10
        writer.frame(sim, index)
    sim.time = 0.2
    with pytest.raises(ts.OutputError, match="no more"):
        writer.frame(sim, 2)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert stage.GetAttributeAtPath("/World/cube/surface.points").GetTimeSamples() == [0, 1] and stage.GetEndTimeCode() == 1


def turned(t: float):
    """A path."""
    return np.array([t, 0.0, 0.0]), rotation((0, 0, 1), t)


def test_drawn():
    made = scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), box=(SOLIDS["box"][0], turned))
    surfaces, sim = Surfaces(made), FakeSimulator(made)
    sim.time = 0.5
    bodies = surfaces.of_bodies(sim)
    grey = (surfaces.colours == OBSTACLE_COLOUR).all(axis=1)
    assert not grey[: len(bodies[0])].any() and grey[len(bodies[0]) :].all()
    translation, Q = turned(0.5)
    for eye, above in (((3.0, 9.0, 9.0), True), ((3.0, -9.0, 9.0), False)):
        x, normals = surfaces.with_obstacles(bodies, 0.5, np.array(eye))
        assert len(x) == len(normals) == len(grey) and np.array_equal(x[: len(bodies[0])], bodies[0])
        corners = x[surfaces.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        box, floor = slice(-12, None), slice(-12 - 4 * 4**3, -12)
        assert (area[floor].sum() > 10.0) == above and (area[floor] > 0).all() == above
        seen = 0.0  # of the box's sides, those that are turned to the eye
        for axis, sides in enumerate(((0.4 * 0.6), (0.2 * 0.6), (0.2 * 0.4))):
            off = Q.T @ (np.array(eye) - (1, 0, 0) - translation)
            seen += sides * (abs(off[axis]) > (0.1, 0.2, 0.3)[axis])
        assert area[box].sum() == pytest.approx(seen)
        shown = corners[box][area[box] > 0].reshape(-1, 3)
        assert np.allclose(np.abs((shown - (1, 0, 0) - translation) @ Q), (0.1, 0.2, 0.3))
        assert np.allclose(np.abs(normals[-36:] @ Q).max(axis=1), 1.0)


def test_a_picture():
    """The second from Vulkan, where that is there."""
    made = scene(box=(ts.Box((3, 4.3, 0), (9, 0.2, 9)), None))
    pictures = []
    for renderer in ("software", "software" if vulkan_missing() else "vulkan"):
        drawing = Offscreen(made, (160, 90), renderer=renderer)
        pictures.append(drawing.image(FakeSimulator(made)).astype(int))
        drawing.close()
    lowest = pictures[0][-8:].reshape(-1, 3)  # the box's top, which reaches behind the eye
    assert np.ptp(lowest, axis=1).max() < 30 and np.ptp(lowest, axis=0).max() < 30 and 130 < lowest.mean() < 220
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 12).mean() < 0.02


@pytest.mark.parametrize("killed", [False, True])
def test_in_usd(tmp_path, killed):
    made = scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), **{"a box": (SOLIDS["box"][0], turned)})
    sim, writer = FakeSimulator(made), UsdWriter(tmp_path, made, fps=10.0, chunk_frames=2)
    for index in range(4):
        sim.time = index / 10
        writer.frame(sim, index)
    path = join_chunks(tmp_path) if killed else tmp_path / "scene.usdc"
    if not killed:
        writer.close()
    stage = Usd.Stage.Open(str(path))
    assert faults(stage) == []
    ground, box = obstacle_surfaces(made)
    points = stage.GetAttributeAtPath("/World/ground/surface.points")
    assert points.GetTimeSamples() == [] and np.array_equal(points.Get(), ground.vertices.astype(np.float32))
    points = stage.GetAttributeAtPath("/World/a_box/surface.points")
    assert points.GetTimeSamples() == [0, 1, 2, 3]
    for index in range(4):
        assert np.array_equal(points.Get(index), box.at(index / 10).astype(np.float32))
    used = np.array(stage.GetAttributeAtPath("/World/a_box/surface.faceVertexIndices").Get())
    assert np.array_equal(used.reshape(-1, 3), box.triangles)
    assert stage.GetPrimAtPath("/World/a_box").GetDisplayName() == "a box"


def test_seen_in_usd(tmp_path):
    """A floor, two walls behind and two before the bodies, a bowl that is open and one that is closed."""
    normals = {"left": (1, 0, 0), "right": (-1, 0, 0), "back": (0, 0, 1), "front": (0, 0, -1), "floor": (0, 1, 0)}
    walls = {name: (ts.HalfSpace((3, 4, 0) - 2 * np.array(n), n), None) for name, n in normals.items()}
    closed = SOLIDS["mesh"][0]
    bowl = ts.MeshObstacle(closed.vertices, closed.triangles[closed.vertices[closed.triangles][:, :, 1].mean(axis=1) < 0])
    made = scene(**walls, bowl=(bowl, None), ball=(closed, None))
    writer = UsdWriter(tmp_path, made)
    writer.frame(FakeSimulator(made), 0)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert faults(stage) == []
    shown = {name: UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/surface")) for name in (*walls, "bowl", "ball")}
    hiding = {name for name, mesh in shown.items() if mesh.ComputePurpose() == UsdGeom.Tokens.guide}
    assert hiding == {"right", "front"}  # the camera is at the right, before and above
    assert {name for name, mesh in shown.items() if mesh.GetDoubleSidedAttr().Get()} == {"bowl"}
    for mesh in shown.values():
        material = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
        colour = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").Get()
        assert colour == mesh.GetDisplayColorAttr().Get()[0] and np.ptp(np.array(colour)) < 0.05
