"""Obstacles as triangles:

* surfaces are closed (but a half-space's), their normals point out of the solid, and their vertices lie on its boundary;
* the square of a half-space lies below the bodies, and ends where another half-space begins;
* they follow a path; what is drawn of a half-space goes away where the eye looks through it;
* in USD obstacles lie where they are in every frame, and those at rest once; chunks join with them.
"""

import numpy as np
import pytest
from fake_simulator import RUBBER, FakeSimulator
from rotations import rotation

import taisoft as ts
from taisoft.mesh.half_edges import opposite_half_edges
from taisoft.output.appearance import OBSTACLE_COLOUR
from taisoft.output.obstacle_surface import REACH, obstacle_surfaces
from taisoft.output.usd import UsdWriter, join_chunks
from taisoft.view.surfaces import Surfaces

BALL = ts.ball_mesh(0.5, 4)
SOLIDS = {
    "sphere": (ts.Sphere((1, 2, 3), 0.4), 4 / 3 * np.pi * 0.4**3),
    "capsule": (ts.Capsule((0, 1, 0), (1, 2, -1), 0.3), np.pi * 0.3**2 * (np.sqrt(3) + 4 / 3 * 0.3)),
    "box": (ts.Box((1, 0, 0), (0.1, 0.2, 0.3)), 8 * 0.006),
    "mesh": (ts.MeshObstacle(BALL.vertices, BALL.surface), 4 / 3 * np.pi * 0.5**3),
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
    assert (opposite_half_edges(t) >= 0).all() and (name == "mesh" or len(np.unique(t)) == len(x))
    a, b, c = (x[t[:, k]] - shape.pivot for k in range(3))
    enclosed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert enclosed == pytest.approx(volume, rel=0.02 if name != "mesh" else 0.3)
    local = (x - shape.pivot) @ shape.frame()
    if name in ("sphere", "capsule"):
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
    side = 2 * REACH * np.sqrt(3)  # of the diagonal of a cube of 1 m
    assert area.sum(axis=0) @ shape.normal == pytest.approx(side**2)
    away = np.array([3, 5, 0]) - x.mean(axis=0)
    assert np.abs(np.cross(away, shape.normal)).max() < 1e-9


def test_walls_of_a_bin_meet():
    walls = {f"wall{k}": (ts.HalfSpace((3, 5, 0) - 0.7 * n, n), None) for k, n in enumerate(np.r_[np.eye(3), -np.eye(3)])}
    surfaces = obstacle_surfaces(scene(**walls))
    for surface in surfaces:
        middle = (surface.vertices - (3, 5, 0)) @ surface.obstacle.shape.frame()
        assert np.abs(middle).max() == pytest.approx(0.7) and np.abs(middle[:, 1] + 0.7).max() < 1e-12
    hidden = scene(ground=(ts.HalfSpace((3, 4, 0), (0, 1, 0)), None), above=(ts.HalfSpace((3, 4.2, 0), (0, 1, 0)), None))
    assert [len(s.triangles) > 0 for s in obstacle_surfaces(hidden)] == [False, True]


def turned(t: float):
    """A path."""
    return np.array([t, 0.0, 0.0]), rotation((0, 0, 1), t)


def test_drawn():
    made = scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), box=(SOLIDS["box"][0], turned))
    surfaces, sim = Surfaces(made), FakeSimulator(made)
    sim.time = 0.5
    for eye, above in (((3.0, 9.0, 9.0), True), ((3.0, -9.0, 9.0), False)):
        x, normals = surfaces.vertices(sim, np.array(eye))
        grey = (surfaces.colours == OBSTACLE_COLOUR).all(axis=1)
        assert grey.sum() == len(x) - surfaces.n_of_bodies and not grey[: surfaces.n_of_bodies].any()
        ground = grey & (x[:, 1] == 0.0)
        assert (np.ptp(x[ground], axis=0).max() > 2.0) == above
        box = x[-24:]  # corners of each side
        translation, Q = turned(0.5)
        at_rest = (box - (1, 0, 0) - translation) @ Q
        assert np.allclose(np.abs(at_rest), (0.1, 0.2, 0.3)) and np.allclose(np.abs(normals[-24:] @ Q).max(axis=1), 1.0)


@pytest.mark.parametrize("killed", [False, True])
def test_in_usd(tmp_path, killed):
    pxr = pytest.importorskip("pxr.Usd")
    made = scene(ground=(ts.HalfSpace((0, 0, 0), (0, 1, 0)), None), **{"a box": (SOLIDS["box"][0], turned)})
    sim, writer = FakeSimulator(made), UsdWriter(tmp_path, made, fps=10.0, chunk_frames=2)
    for index in range(4):
        sim.time = index / 10
        writer.frame(sim, index)
    path = join_chunks(tmp_path) if killed else tmp_path / "scene.usdc"
    if not killed:
        writer.close()
    stage = pxr.Stage.Open(str(path))
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
