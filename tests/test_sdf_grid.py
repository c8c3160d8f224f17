"""What a distance grid promises:

* at every point the exact signed distance to the triangles, negative inside: a box against its formula, others against all
  triangles one by one and against winding numbers, and never NaN;
* cells follow each axis's extent, at least eight across the thinnest side and two beyond the surface;
* moving, turning and scaling the surface moves, turns and scales the distances;
* a surface that is open, turned round or without area is refused with the edge or triangle, a grid too large with its size;
* a kept grid is the same grid; a damaged file is made again; a folder that cannot be written is no error.
"""

import numpy as np
import pytest

from taisoft.errors import MeshError
from taisoft.mesh import sdf as module
from taisoft.mesh.sdf import cache_folder, cached_sdf_grid, sdf_grid
from taisoft.mesh.shapes import ball_mesh, box_mesh, sheet_mesh
from taisoft.mesh.tet_mesh import TetMesh


def points_of(grid) -> np.ndarray:
    """(nx,ny,nz,3) [m]."""
    axes = [grid.origin[a] + grid.spacing[a] * np.arange(grid.phi.shape[a]) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def box_distance(p, half) -> np.ndarray:
    """Signed distance of a box round the origin."""
    q = np.abs(p) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def brute_distance(vertices, triangles, p) -> np.ndarray:
    """(n,) unsigned distances of points (n,3) from all triangles: by regions of the plane (Ericson 2005, 5.1.5)."""
    best = np.full(len(p), np.inf)
    for a, b, c in vertices[triangles]:
        ab, ac, normal = b - a, c - a, np.cross(b - a, c - a)
        # barycentric coordinates of the foot in the plane, by least squares
        uv = np.linalg.lstsq(np.stack([ab, ac], axis=1), (p - a).T, rcond=None)[0]
        inside = (uv >= 0).all(axis=0) & (uv.sum(axis=0) <= 1)
        d = np.where(inside, np.abs((p - a) @ normal) / np.linalg.norm(normal), np.inf)
        for s, e in ((a, b), (b, c), (c, a)):
            t = np.clip((p - s) @ (e - s) / ((e - s) @ (e - s)), 0, 1)
            d = np.minimum(d, np.linalg.norm(p - s - t[:, None] * (e - s), axis=1))
        best = np.minimum(best, d)
    return best


def assert_distances(grid, vertices, triangles) -> None:
    """Two thousand random points of a grid against all triangles."""
    some = np.random.default_rng(1).choice(grid.phi.size, 2000, replace=False)
    exact = brute_distance(vertices, triangles, points_of(grid).reshape(-1, 3)[some])
    assert np.abs(np.abs(grid.phi.reshape(-1)[some]) - exact).max() < 1e-13


def winding_number(vertices, triangles, p) -> np.ndarray:
    """(n,) solid angle of the surface over 4 pi (van Oosterom & Strackee 1983)."""
    a, b, c = (vertices[triangles[:, k]][None] - p[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    dot = lambda u, v: np.einsum("ptx,ptx->pt", u, v)  # noqa: E731
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.arctan2(dot(a, np.cross(b, c)), below).sum(axis=1) / (2 * np.pi)


def assert_signs(vertices, triangles, cells: int) -> None:
    """All points of a grid that do not lie on the surface against winding numbers."""
    grid = sdf_grid(vertices, triangles, cells)
    phi = grid.phi.reshape(-1)
    away = np.abs(phi) > 1e-9
    inside = winding_number(vertices, triangles, points_of(grid).reshape(-1, 3)[away])
    assert np.array_equal(phi[away] < 0, inside > 0.5) and (phi[away] < 0).any()


def carved() -> TetMesh:
    """A block with a step, a notch and a hole through it: what is left of a grid of cells, all vertices shaken."""
    mesh = box_mesh((5, 4, 4), (1.0, 0.8, 1.2), pattern="six")
    x = mesh.vertices[mesh.tets].mean(axis=1)
    hole = (np.abs(x[:, 0]) < 0.1) & (np.abs(x[:, 2]) < 0.3)
    step = (x[:, 0] > 0.3) & (x[:, 1] > 0.2)
    notch = (x[:, 0] < -0.3) & (np.abs(x[:, 2]) < 0.3) & (x[:, 1] > 0)
    used, tets = np.unique(mesh.tets[~(hole | step | notch)], return_inverse=True)
    shaken = mesh.vertices[used] + np.random.default_rng(3).uniform(-0.03, 0.03, (len(used), 3))
    return TetMesh(shaken, tets.reshape(-1, 4))


@pytest.fixture(scope="module")
def carved_mesh() -> TetMesh:
    return carved()


@pytest.fixture(scope="module")
def carved_grid(carved_mesh):
    return sdf_grid(carved_mesh.vertices, carved_mesh.surface, cells=14)


@pytest.mark.parametrize("size", [(4.0, 1.0, 1.0), (1.0, 2.0, 0.7), (3.0, 0.05, 3.0)])
def test_a_box_has_its_formulas_distance(size):
    mesh = box_mesh((4, 3, 2), size)
    grid = sdf_grid(mesh.vertices, mesh.surface, cells=16)
    assert np.isfinite(grid.phi).all() and grid.phi.dtype == np.float64
    assert np.abs(grid.phi - box_distance(points_of(grid), np.array(size) / 2)).max() < 1e-14 * 10


def test_a_ball_has_its_radius():
    mesh = ball_mesh(0.5, 10)
    grid = sdf_grid(mesh.vertices, mesh.surface, cells=32)
    exact = np.linalg.norm(points_of(grid), axis=-1) - 0.5
    inner = brute_distance(mesh.vertices, mesh.surface, np.zeros((1, 3)))[0]
    error = grid.phi - exact  # the triangles lie between the ball and the one that they hold
    assert error.min() > -1e-15 and 0.9 * (0.5 - inner) < error.max() < (0.5 - inner) + 1e-15


def test_distances_are_those_of_all_triangles(carved_mesh, carved_grid):
    assert_distances(carved_grid, carved_mesh.vertices, carved_mesh.surface)


def test_signs_are_those_of_winding_numbers(carved_mesh, carved_grid):
    some = np.random.default_rng(0).choice(carved_grid.phi.size, 2500, replace=False)
    phi = carved_grid.phi.reshape(-1)[some]
    inside = winding_number(carved_mesh.vertices, carved_mesh.surface, points_of(carved_grid).reshape(-1, 3)[some])
    assert np.abs(inside - np.round(inside)).max() < 1e-9  # no point lies on the surface
    assert np.array_equal(phi < 0, np.round(inside) == 1) and 300 < (phi < 0).sum() < 2200


def test_triangles_of_very_different_size():
    """The nearest centroid is then a poor first guess."""
    fine = ball_mesh(0.1, 6, center=(0.0, 0.35, 0.0))
    coarse = box_mesh((1, 1, 1), (2.0, 0.4, 1.0), pattern="six")
    vertices = np.concatenate([fine.vertices, coarse.vertices])
    triangles = np.concatenate([fine.surface, coarse.surface + len(fine.vertices)])
    grid = sdf_grid(vertices, triangles, cells=16)
    assert_distances(grid, vertices, triangles)


def test_parts_that_touch_at_a_vertex():
    """Two spikes tip to tip, one of them slanted: each has its own pseudonormal there."""
    base = np.array([(1, 1, 1), (-1, 1, 1), (-1, 1, -1), (1, 1, -1)], dtype=float)
    vertices = np.concatenate([[(0, 0, 0)], base, -base + (1.5, 0, 0)])
    tets = np.array([(0, 1, 2, 3), (0, 1, 3, 4), (0, 5, 6, 7), (0, 5, 7, 8)])
    with pytest.warns(UserWarning):
        mesh = TetMesh(vertices, tets, fix_orientation=True)
    assert_signs(mesh.vertices, mesh.surface, cells=15)


def test_a_hollow_that_touches_the_surface_at_a_vertex():
    """Seen from outside, the hollow's own pseudonormal there would say inside; its triangles have the nearest centroids."""
    apex, ring = (0, 1, 0), [(1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, 0, 1)]
    vertices = np.array([apex, *ring, (0, -1, 0), (0.05, 0.8, 0), (-0.05, 0.8, 0.05), (-0.05, 0.8, -0.05)], dtype=float)
    octahedron = [(0, 1 + k, 1 + (k + 1) % 4) for k in range(4)] + [(5, 1 + (k + 1) % 4, 1 + k) for k in range(4)]
    assert_signs(vertices, np.array([*octahedron, (0, 6, 7), (0, 7, 8), (0, 8, 6), (6, 8, 7)]), cells=20)


@pytest.mark.parametrize("cells", [8, 32])
def test_cells_follow_each_axis(cells):
    mesh = sheet_mesh((8, 8), (4.0, 0.05, 3.0))
    grid = sdf_grid(mesh.vertices, mesh.surface, cells)
    inside = np.array([cells, 8, max(8, 3 * cells / 4)])
    assert np.allclose(grid.spacing, [4.0, 0.05, 3.0] / inside) and grid.phi.shape == tuple((inside + 5).astype(int))
    assert np.allclose(grid.origin, [-2.0, -0.025, -1.5] - 2 * grid.spacing)
    # the middle of the sheet is seen
    assert grid.phi.min() == pytest.approx(-0.025)


def test_a_margin_widens_the_grid():
    mesh = sheet_mesh((4, 4), (4.0, 0.05, 4.0))
    grid = sdf_grid(mesh.vertices, mesh.surface, 16, margin=0.1)
    far = grid.origin + grid.spacing * (np.array(grid.phi.shape) - 1)
    assert (grid.origin <= [-2.1, -0.125, -2.1]).all() and (far >= [2.1, 0.125, 2.1]).all()
    assert np.abs(grid.phi - box_distance(points_of(grid), np.array([2.0, 0.025, 2.0]))).max() < 1e-13


def test_unused_vertices_do_not_count():
    mesh = box_mesh((2, 2, 2), (1, 1, 1))
    grid = sdf_grid(np.concatenate([mesh.vertices, [(50.0, 0, 0)]]), mesh.surface, 8)
    assert np.array_equal(grid.phi, sdf_grid(mesh.vertices, mesh.surface, 8).phi)


@pytest.mark.parametrize("scale, shift", [(1.0, (3.0, -2.0, 7.0)), (1e-3, (0, 0, 0)), (1e4, (2e4, 0, 0))])
def test_distances_move_and_scale_with_the_surface(carved_mesh, carved_grid, scale, shift):
    moved = sdf_grid(scale * carved_mesh.vertices + shift, carved_mesh.surface, cells=14)
    assert np.allclose(moved.phi, scale * carved_grid.phi, rtol=0, atol=1e-12 * scale)
    assert np.allclose(moved.origin, scale * carved_grid.origin + shift)
    assert np.allclose(moved.spacing, scale * carved_grid.spacing)


def test_distances_turn_with_the_surface(carved_mesh, carved_grid):
    turned = sdf_grid(carved_mesh.vertices[:, [1, 2, 0]], carved_mesh.surface, cells=14)
    assert np.allclose(turned.phi, carved_grid.phi.transpose(1, 2, 0), rtol=0, atol=1e-13)


def test_what_has_no_inside_is_refused():
    mesh = box_mesh((1, 1, 1), (1, 1, 1), pattern="six")
    vertices, triangles = mesh.vertices, mesh.surface
    a, b, c = sorted(triangles[4].tolist())
    border = rf"\(({a}, {b}|{a}, {c}|{b}, {c})\)"
    with pytest.raises(MeshError, match=rf"closed surface: edge {border} belongs to triangle \d+ alone \(3 such edges"):
        sdf_grid(vertices, np.delete(triangles, 4, axis=0))
    turned = triangles.copy()
    turned[4] = turned[4][::-1]
    with pytest.raises(MeshError, match="triangles .*4.* traverse their edge .* in the same direction"):
        sdf_grid(vertices, turned)
    with pytest.raises(MeshError, match="belongs to 4 triangles"):
        sdf_grid(vertices, np.concatenate([triangles, triangles]))
    squashed = vertices.copy()
    squashed[triangles[3, 0]] = squashed[triangles[3, 1]]
    with pytest.raises(MeshError, match="triangle [0-9]+ has none"):
        sdf_grid(squashed, triangles)
    with pytest.raises(MeshError, match="flat and has no inside"):
        sdf_grid(vertices * (1, 0, 1), triangles)


def test_a_grid_that_is_too_large_is_refused():
    mesh = box_mesh((1, 1, 1), (1, 1, 1))
    with pytest.raises(MeshError, match=r"256 cells .* need 17779581 points \(261 x 261 x 261\); at most 2000000"):
        sdf_grid(mesh.vertices, mesh.surface, 256)
    assert sdf_grid(mesh.vertices, mesh.surface, 16, max_points=21**3).phi.size == 21**3


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """(mesh, a counter of the grids made) with an empty folder of kept grids."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = []

    def counted(*args):
        made.append(args)
        return sdf_grid(*args)

    monkeypatch.setattr(module, "sdf_grid", counted)
    return ball_mesh(1.0, 4), made


def ask(mesh, cells=10, **options):
    return cached_sdf_grid(mesh.vertices, mesh.surface, cells, **options)


def equal(a, b) -> bool:
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in ("origin", "spacing", "phi"))


def test_a_kept_grid_is_the_same(kept):
    mesh, made = kept
    first, second = ask(mesh), ask(mesh)
    assert len(made) == 1 and equal(first, second) and not second.phi.flags.writeable
    assert [path.suffix for path in cache_folder().iterdir()] == [".npz"]


def test_other_content_is_another_grid(kept):
    mesh, made = kept
    ask(mesh)
    ask(mesh, cells=11)
    ask(mesh, margin=0.7)
    cached_sdf_grid(mesh.vertices * 1.0000000001, mesh.surface, 10)
    cached_sdf_grid(mesh.vertices, np.roll(mesh.surface, 1, axis=0), 10)
    assert len(made) == 5 == len(list(cache_folder().iterdir()))
    with pytest.raises(MeshError, match="at most 100"):
        ask(mesh, max_points=100)


@pytest.mark.parametrize("harm", ["cut", "empty", "text", "bit", "other", "folder"])
def test_a_damaged_file_is_made_again(kept, harm):
    mesh, made = kept
    first = ask(mesh)
    (path,) = cache_folder().iterdir()
    whole = path.read_bytes()
    if harm == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif harm == "empty":
        path.write_bytes(b"")
    elif harm == "text":
        path.write_bytes(b"not an archive")
    elif harm == "bit":
        path.write_bytes(whole[: len(whole) // 2] + bytes([whole[len(whole) // 2] ^ 1]) + whole[len(whole) // 2 + 1 :])
    elif harm == "other":
        np.savez(path, origin=first.origin, spacing=first.spacing, phi=first.phi[1:])
    else:
        path.unlink()
        path.mkdir()
    assert equal(ask(mesh), first) and len(made) == 2
    if harm != "folder":
        assert equal(ask(mesh), first) and len(made) == 2
    assert not list(cache_folder().glob("*.tmp"))


def test_a_folder_that_cannot_be_written_is_no_error(kept, tmp_path, monkeypatch):
    mesh, made = kept
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert equal(ask(mesh), ask(mesh)) and len(made) == 2
