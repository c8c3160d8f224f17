"""Texture coordinates and subsets: read from .obj and .ply, kept by welding, cleaning and placing, passed on to the surface of
tets chart by chart, split with second-order faces; what does not fit is refused.
"""

import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.texture import split_uvs, transferred

BALL = ts.ball_mesh(0.5, 4)
USED, CORNERS = np.unique(BALL.surface, return_inverse=True)
X, T = BALL.vertices[USED], CORNERS.reshape(-1, 3)


def linear_uvs(x):
    """UVs of corners that are linear in place (t,3,3): so they tell where a corner was."""
    return x @ np.array([(1.0, 0.3), (-0.2, 2.0), (0.1, -0.4)]) + 0.25


def box_surface(cells=(1, 1, 1)):
    """A unit cube whose sides are charts of their own, 2 apart, and subsets, the last three of them one."""
    box = ts.box_mesh(cells, (1, 1, 1), center=(0.5, 0.5, 0.5))
    used, corner = np.unique(box.surface, return_inverse=True)
    x, triangles = box.vertices[used], corner.reshape(-1, 3)
    normal = np.cross(x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]])
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (normal[np.arange(len(axis)), axis] > 0)
    uvs = np.stack([flat(x[nodes], k) for nodes, k in zip(triangles, side)])
    subsets = {f"side {k}": np.flatnonzero(side == k) for k in range(3)} | {"rest": np.flatnonzero(side > 2)}
    return ts.SurfaceMesh(x, triangles, uvs=uvs, subsets=subsets), side


def flat(x, side):
    """UVs of points (k,3) on a side of the unit cube."""
    return np.delete(x, side // 2, axis=1) + (2.0 * side, 0.0)


def side_of(uvs):
    return np.floor(uvs[..., 0].mean(axis=-1) / 2.0).astype(int)


OBJ = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0 0
o thing
g first
f 1 2 5
usemtl leather
f 1/1 2/2 3/-1 4/-2
vt 0.5
usemtl red paint
f -5/-1/1 3/1/1 5/3/1
"""


def test_obj_texture_and_subsets(tmp_path):
    """Quads, negative indices, a face without UVs; materials come before groups, and groups before objects."""
    path = tmp_path / "a.obj"
    path.write_text(OBJ)
    with pytest.warns(UserWarning, match="1 triangles have no texture coordinates, and get 0, the first is triangle 0"):
        surface = ts.read_surface(path)
    expected = [((0, 0),) * 3, ((0, 0), (1, 0), (1, 0)), ((0, 0), (1, 0), (0, 0)), ((0.5, 0), (0, 0), (0.5, 0))]
    assert surface.uvs.tolist() == np.array(expected, dtype=float).tolist()
    assert {name: ids.tolist() for name, ids in surface.subsets.items()} == {"leather": [1, 2], "red paint": [3]}
    for left, names in (("usemtl.*\n", ["first"]), ("(usemtl|g) .*\n", ["thing"]), ("(usemtl|g|o) .*\n", [])):
        path.write_text(re.sub(left, "", re.sub(r"/[-\d/]*", "", OBJ)))
        plain = ts.read_surface(path)
        assert plain.uvs is None and list(plain.subsets) == names and not plain.warnings


def test_ply_texture(tmp_path):
    path = tmp_path / "a.ply"
    rows = "\n".join(f"{x} {y} {z} {x + 0.5} {z}" for x, y, z in X[T[:2]].reshape(-1, 3).tolist())
    for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        numbers = "\n".join(f"property double {name}" for name in ("x", "y", "z", u, v))
        head = f"ply\nformat ascii 1.0\nelement vertex 6\n{numbers}\nelement face 2\nproperty list uchar int vertex_indices\n"
        path.write_text(f"{head}end_header\n{rows}\n3 0 1 2\n3 3 4 5\n")
        with pytest.warns(UserWarning, match="welded"):
            surface = ts.read_surface(path)
        assert np.array_equal(surface.uvs, surface.vertices[surface.triangles][:, :, [0, 2]] + (0.5, 0.0))


@pytest.mark.parametrize("seed", range(5))
def test_they_survive_welding_cleaning_and_placing(tmp_path, seed):
    """From a file in which every triangle has its own corners, some have no area, and some come twice."""
    rng = np.random.default_rng(seed)
    rows = rng.permutation(np.concatenate([np.arange(len(T)), rng.integers(0, len(T), 9), np.full(5, -1)]))
    corners = np.where((rows < 0)[:, None, None], X[0], X[T[rows]])
    uvs, names = linear_uvs(corners), np.where(corners[:, :, 0].mean(axis=1) > 0, "right", "left")
    lines = [f"v {x} {y} {z}\nvt {u} {v}" for (x, y, z), (u, v) in zip(corners.reshape(-1, 3), uvs.reshape(-1, 2))]
    faces = [f"usemtl {name}\nf {k}/{k} {k + 1}/{k + 1} {k + 2}/{k + 2}" for name, k in zip(names, range(1, 3 * len(rows), 3))]
    path = tmp_path / "a.obj"
    path.write_text("\n".join(lines + faces))
    with pytest.warns(UserWarning):
        surface = ts.read_surface(path, weld=1e-6)
    assert len(surface.vertices) == len(X) and len(surface.triangles) == len(T)
    placed = ts.place(surface, up="z", scale=2.0, rotate=(10, 20, 30), at=(1, 2, 3))
    for one in (surface, placed):
        assert np.allclose(one.uvs, linear_uvs(surface.vertices[surface.triangles]), atol=1e-9)
        right = surface.vertices[surface.triangles][:, :, 0].mean(axis=1) > 0
        assert np.array_equal(one.subsets["right"], np.flatnonzero(right))
        assert np.array_equal(one.subsets["left"], np.flatnonzero(~right))


def tube(around=40, along=8):
    """A tube about y whose u runs once around it, and so meets itself in a seam; v is the height."""
    u, v = np.meshgrid(np.arange(around + 1) / around, np.arange(along + 1) / along, indexing="ij")
    number = (np.arange(around + 1) % around)[:, None] * (along + 1) + np.arange(along + 1)
    quads = [(i, j) for i in range(around) for j in range(along)]
    loops = np.array([[(i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)] for i, j in quads])[:, [[0, 1, 2], [0, 2, 3]]].reshape(
        -1, 3, 2
    )
    corner = tuple(np.moveaxis(loops, -1, 0))
    x = np.stack([np.cos(2 * np.pi * u), v, np.sin(2 * np.pi * u)], axis=-1)[:-1].reshape(-1, 3)
    return ts.SurfaceMesh(x, number[corner], uvs=np.stack([u[corner], v[corner]], axis=-1))


@pytest.mark.parametrize("around, along", [(13, 3), (90, 20)])
def test_no_triangle_shows_both_sides_of_a_seam(around, along):
    """A coarser and a finer tube, turned by half a triangle, whose triangles cross the seam of the first."""
    other = tube(around, along)
    turn = np.pi / around
    x = other.vertices @ np.array([(np.cos(turn), 0, np.sin(turn)), (0, 1, 0), (-np.sin(turn), 0, np.cos(turn))])
    uvs, _ = transferred(tube(), x, other.triangles)
    assert np.ptp(uvs[..., 0], axis=1).max() < 1.01 / around
    expected = np.arctan2(x[:, 2], x[:, 0])[other.triangles] / (2 * np.pi) % 1.0
    inside = np.ptp(expected, axis=1) < 0.5  # those that do not cross
    assert inside.sum() == 2 * along * (around - 1)
    assert np.abs(uvs[inside][..., 0] - expected[inside]).max() < 0.002 and np.allclose(uvs[..., 1], x[other.triangles][..., 1])


def test_another_surface_gets_them_chart_by_chart():
    """No triangle has UVs of two sides, not where it lies over an edge either."""
    surface, _ = box_surface((2, 3, 1))
    finer = ts.box_mesh((5, 4, 7), (1.02, 1.02, 1.02), center=(0.5, 0.5, 0.5))
    uvs, subsets = transferred(surface, finer.vertices, finer.surface)
    x = np.clip(finer.vertices[finer.surface], 0.0, 1.0)
    side = side_of(uvs)
    expected = np.stack([flat(corners, k) for corners, k in zip(x, side)])
    assert np.abs(uvs - expected).max() < 1e-12
    assert np.array_equal(np.sort(np.concatenate(list(subsets.values()))), np.arange(len(uvs)))
    assert all((side[ids] == k).all() for k, ids in zip((0, 1, 2), (subsets[f"side {k}"] for k in range(3))))
    assert transferred(ts.SurfaceMesh(X, T), finer.vertices, finer.surface) == (None, {})


def test_tets_keep_charts():
    pytest.importorskip("wildmeshing")
    surface, _ = box_surface((2, 2, 2))
    mesh = ts.tetrahedralize(surface, edge_length=0.35)
    side, x = side_of(mesh.surface_uvs), mesh.vertices[mesh.surface]
    expected = np.stack([flat(np.clip(corners, 0.0, 1.0), k) for corners, k in zip(x, side)])
    assert np.abs(mesh.surface_uvs - expected).max() < 0.1 and set(side) == set(range(6))
    assert {name: set(side[ids]) for name, ids in mesh.surface_subsets.items()} == {
        "side 0": {0}, "side 1": {1}, "side 2": {2}, "rest": {3, 4, 5},
    }  # fmt: skip
    placed = ts.place(mesh, scale=2.0)
    assert np.array_equal(placed.surface_uvs, mesh.surface_uvs) and list(placed.surface_subsets) == list(mesh.surface_subsets)
    with pytest.raises(MeshError, match="surface_uvs cannot change"):
        mesh.surface_uvs = None


def test_second_order_faces_are_split():
    nodes = make_nodes(BALL, 2)
    straight = linear_uvs(nodes.positions[nodes.surface])
    assert np.allclose(split_uvs(linear_uvs(BALL.vertices[BALL.surface])), straight, atol=1e-12)


@pytest.mark.parametrize(
    "more, message",
    [
        ({"uvs": np.zeros((len(T), 3))}, r"uvs must have shape \(\d+, 3, 2\), not"),
        ({"uvs": np.full((len(T), 3, 2), np.nan)}, r"uvs: entry \[0, 0, 0\] is nan, not finite"),
        ({"subsets": {"a": [0, len(T)]}}, rf"subset 'a': triangle {len(T)} does not exist \({len(T)} triangles\)"),
        ({"subsets": {"a": [-1]}}, "subset 'a': triangle -1 does not exist"),
        ({"subsets": {"a": [0, 1], "b": [1]}}, "subset 'b': triangle 1 is in another subset too"),
        ({"subsets": {"a": [0.5]}}, "subset 'a' must be a name and numbers of triangles"),
        ({"subsets": {1: [0]}}, "subset 1 must be a name and numbers of triangles"),
    ],
)
def test_what_does_not_fit_is_refused(more, message):
    with pytest.raises(MeshError, match=f"^here: {message}"):
        ts.SurfaceMesh(X, T, "here", **more)
    with pytest.raises(MeshError, match=f"^there: {message}"):
        ts.TetMesh(BALL.vertices, BALL.tets, source="there", **{f"surface_{key}": value for key, value in more.items()})
