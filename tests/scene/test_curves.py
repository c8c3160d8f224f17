"""Edges of second-order bodies follow a sphere, a cylinder, a fine surface, or a smooth surface through the vertices: volumes and
areas converge with the fourth order, flat faces and sharp edges stay, folded elements are refused; points in curved elements are
found, refined scenes have the same shape, and scene files keep the curve.
"""

import warnings

import numpy as np
import pytest

import taisoft as ts
from taisoft.scene.locate import locate
from taisoft.scene.refine import refined, with_order

STEEL = ts.Material(density=7800.0)
SPHERE, CYLINDER = ts.Sphere((0, 0, 0), 1.0), ts.Capsule((0, -1, 0), (0, 1, 0), 1.0)


def body_of(mesh: ts.TetMesh, curve=None, order: int = 2, **arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of coarse meshes
        return ts.Scene().add_body(mesh, STEEL, order=order, curve=curve, **arguments)


def half_ball(cells: int) -> ts.TetMesh:
    """y >= 0 of a ball, whose grid has the equator as a plane."""
    ball = ts.ball_mesh(1.0, cells)
    tets = ball.tets[ball.vertices[ball.tets].mean(axis=1)[:, 1] > 0.0]
    used, tets = np.unique(tets, return_inverse=True)
    return ts.TetMesh(ball.vertices[used], tets.reshape(-1, 4))


def cylinder(cells: int) -> ts.TetMesh:
    return ts.cylinder_mesh(1.0, 2.0, (cells, cells))


SHAPES = {
    "ball": (lambda c: ts.ball_mesh(1.0, c), 4 / 3, 4.0),
    "half ball": (half_ball, 2 / 3, 3.0),
    "cylinder": (cylinder, 2.0, 6.0),
}


@pytest.mark.parametrize(
    "shape, curve", [("ball", SPHERE), ("ball", "smooth"), ("half ball", SPHERE), ("cylinder", CYLINDER), ("cylinder", "smooth")]
)
def test_volume_and_area_converge_with_the_fourth_order(shape, curve):
    make, volume, area = SHAPES[shape]
    errors = {}
    for given in (curve, "straight"):
        bodies = [body_of(make(cells), given) for cells in (4, 8)]
        errors[given] = [[b.volumes.sum() / np.pi / volume - 1.0, b.areas.sum() / np.pi / area - 1.0] for b in bodies]
        assert bodies[1].is_curved == (given != "straight")
        assert bodies[1].mass == pytest.approx(7800.0 * bodies[1].volumes.sum())
    orders = {given: np.log2(np.divide(*found)) for given, found in errors.items()}
    assert (orders[curve] > 3.7).all() and (np.abs(orders["straight"] - 2.0) < 0.15).all()
    assert (np.abs(errors[curve][1]) < 0.01 * np.abs(errors["straight"][1])).all()


def test_flat_faces_and_inner_edges_stay_straight():
    mesh = half_ball(4)
    body, straight = body_of(mesh, SPHERE), body_of(mesh)
    x, X = body.rest_positions, straight.rest_positions
    moved = np.abs(x - X).max(axis=1) > 0.0
    surface = np.isin(np.arange(len(x)), body.nodes.boundary)
    assert not moved[: mesh.n_verts].any() and not moved[~surface].any() and moved.any()
    assert np.abs(np.linalg.norm(x[moved], axis=1) - 1.0).max() < 1e-15
    flat = np.abs(X[:, 1]) < 1e-12
    assert (np.abs(x[flat, 1]) < 1e-12).all() and moved[flat].sum() == 16  # the edges of the rim
    assert np.array_equal(body.nodes.curved, moved[body.nodes.elements].any(axis=1)) and not body.nodes.curved.all()


def test_fine_surface_and_given_nodes():
    fine = ts.ball_mesh(1.0, 24)
    surface, mesh = ts.SurfaceMesh(fine.vertices, fine.surface), ts.ball_mesh(1.0, 4)
    near, exact = (body_of(mesh, curve).rest_positions for curve in (surface, SPHERE))
    assert 0.0 < np.abs(near - exact).max() < 2e-3
    given = ts.TetMesh(mesh.vertices, mesh.tets, mid_edge=exact[mesh.n_verts :])
    assert np.array_equal(body_of(given).rest_positions, exact)
    assert not body_of(given, "straight").is_curved and not body_of(given, order=1).is_curved
    turned = ts.place(given, scale=2.0, rotate=(0, 0, 90))
    assert np.allclose(body_of(turned).rest_positions, 2.0 * exact @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), atol=1e-14)


def test_smooth_edges_of_a_half_ball_are_arcs():
    """Its normals and tangents are exact, and edges from the sharp rim are the arcs of their other ends."""
    mesh = half_ball(4)
    assert np.abs(body_of(mesh, "smooth").rest_positions - body_of(mesh, SPHERE).rest_positions).max() < 1e-14


def test_refusals():
    ball, folded = ts.ball_mesh(1.0, 4), ts.box_mesh((1, 1, 1), (1, 1, 1))
    middles = body_of(folded).rest_positions[folded.n_verts :].copy()
    middles[0] += 0.6
    cases = [
        (ball, SPHERE, 1, "curve needs order=2"),
        (ball, "round", 2, "curve must be a Sphere, a Capsule, a SurfaceMesh"),
        (ball, ts.Sphere((0, 0, 0), 1.2), 2, r"no face of the mesh lies on the sphere; the nearest vertex is 0\.2 m from it"),
        (ts.TetMesh(folded.vertices, folded.tets, mid_edge=middles), None, 2, r"tet \d is folded by its curved edges \(\d such"),
    ]
    for mesh, curve, order, text in cases:
        with pytest.raises(ts.SceneError, match=text):
            body_of(mesh, curve, order)
    for bad, text in (
        (middles[1:], r"mid_edge has 17 rows for 18 edges"),
        (np.full_like(middles, np.nan), "mid_edge 0 coordinate 0 is not finite"),
    ):
        with pytest.raises(ts.MeshError, match=text):
            ts.TetMesh(folded.vertices, folded.tets, mid_edge=bad)


def test_points_in_curved_elements_are_found():
    body, rng = body_of(ts.ball_mesh(1.0, 4), SPHERE), np.random.default_rng(0)
    points = rng.standard_normal((200, 3))
    points *= rng.uniform(0.0, 1.0, (200, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    points[:50] *= 0.999 / np.linalg.norm(points[:50], axis=1, keepdims=True)  # between the flat faces and the sphere
    nodes, weights, outside = locate(body, points)
    assert np.abs(np.einsum("pa,pax->px", weights, body.rest_positions[nodes]) - points).max() < 1e-12
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-12 and outside.max() < 0.025


def test_refined_scenes_have_the_same_shape():
    scene = ts.Scene()
    old = scene.add_body(ts.ball_mesh(1.0, 2), STEEL, order=2, curve=SPHERE)
    new = refined(scene).bodies[0]
    assert new.volumes.sum() == pytest.approx(old.volumes.sum(), rel=1e-13) and new.mesh.n_tets == 8 * old.mesh.n_tets
    assert np.array_equal(new.rest_positions[: old.n_nodes], old.rest_positions)
    linear = ts.Scene()
    linear.add_body(ts.TetMesh(old.mesh.vertices, old.mesh.tets, mid_edge=old.rest_positions[old.mesh.n_verts :]), STEEL)
    assert with_order(linear, 2).bodies[0].volumes.sum() == pytest.approx(old.mesh.volumes.sum())


@pytest.mark.parametrize("curve", [SPHERE, ts.Capsule((0, 0, 0), (0, 1e-3, 0), 1.0), "smooth", "straight", "surface"])
def test_scene_files_keep_the_curve(curve, tmp_path):
    scene, mesh = ts.Scene(), ts.ball_mesh(1.0, 4)
    given = ts.SurfaceMesh(mesh.vertices, mesh.surface) if curve == "surface" else curve
    body = scene.add_body(mesh, STEEL, order=2, curve=given)
    ts.write_scene(tmp_path / "a.toml", scene)
    again = ts.read_scene(tmp_path / "a.toml")[0].bodies[0]
    assert type(again.curve) is type(given) and np.array_equal(again.rest_positions, body.rest_positions)


def test_scene_files_refuse_unknown_curves(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(
        '[bodies.a]\nmaterial = {}\nmesh = { shape = "ball", radius = 1, cells = 2 }\norder = 2\ncurve = { shape = "box" }'
    )
    with pytest.raises(ts.SceneError, match=r"bodies\.a\.curve.*shape must be one of sphere, capsule"):
        ts.read_scene(path)
