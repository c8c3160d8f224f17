"""Signed distance grids: exact distances and signs at every point, the size of the cells; surfaces without an inside
are refused; a cached grid is the same grid, and a damaged cache file is replaced.
"""

import numpy as np
import pytest

from taisoft.errors import MeshError
from taisoft.mesh import sdf as module
from taisoft.mesh.distances import distances, winding_numbers
from taisoft.mesh.sdf import cache_folder, cached_sdf_grid, sdf_grid
from taisoft.mesh.shapes import ball_mesh, box_mesh, sheet_mesh
from taisoft.mesh.tet_mesh import TetMesh


def points_of(grid) -> np.ndarray:
    """(nx,ny,nz,3) [m]."""
    axes = [grid.origin[a] + grid.spacing[a] * np.arange(grid.phi.shape[a]) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def box_distance(p, half) -> np.ndarray:
    """Signed distance to a box about the origin."""
    q = np.abs(p) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def assert_distances(grid, vertices, triangles) -> None:
    """Two thousand random points of a grid against brute force."""
    some = np.random.default_rng(1).choice(grid.phi.size, 2000, replace=False)
    exact = distances(vertices[triangles], points_of(grid).reshape(-1, 3)[some])
    assert np.abs(np.abs(grid.phi.reshape(-1)[some]) - exact).max() < 1e-13


def assert_signs(grid, vertices, triangles) -> None:
    """Up to 2500 points of a grid off the surface against winding numbers."""
    away = np.flatnonzero(np.abs(grid.phi.reshape(-1)) > 1e-9)
    some = np.random.default_rng(0).permutation(away)[:2500]
    inside = winding_numbers(vertices[triangles], points_of(grid).reshape(-1, 3)[some]) > 0.5
    assert np.array_equal(grid.phi.reshape(-1)[some] < 0, inside) and 20 < inside.sum() < len(some) - 20


def carved_mesh() -> TetMesh:
    """A block with a step, a notch and a through hole, its vertices randomly displaced."""
    mesh = box_mesh((5, 4, 4), (1.0, 0.8, 1.2), pattern="six")
    x = mesh.vertices[mesh.tets].mean(axis=1)
    hole = (np.abs(x[:, 0]) < 0.1) & (np.abs(x[:, 2]) < 0.3)
    step = (x[:, 0] > 0.3) & (x[:, 1] > 0.2)
    notch = (x[:, 0] < -0.3) & (np.abs(x[:, 2]) < 0.3) & (x[:, 1] > 0)
    used, tets = np.unique(mesh.tets[~(hole | step | notch)], return_inverse=True)
    displaced = mesh.vertices[used] + np.random.default_rng(3).uniform(-0.03, 0.03, (len(used), 3))
    return TetMesh(displaced, tets.reshape(-1, 4))


@pytest.mark.parametrize("size, margin", [((1.0, 2.0, 0.7), 0.0), ((3.0, 0.05, 3.0), 0.103)])
def test_distances_to_a_box_are_those_of_the_formula(size, margin):
    mesh, half = box_mesh((4, 3, 2), size), np.array(size) / 2
    vertices = np.concatenate([mesh.vertices, [(50.0, 0, 0)]])  # unused vertices are ignored
    grid = sdf_grid(vertices, mesh.surface, 16, margin=margin)
    assert grid.phi.dtype == np.float64 and np.abs(grid.phi - box_distance(points_of(grid), half)).max() < 1e-13
    far = grid.origin + grid.spacing * (np.array(grid.phi.shape) - 1)
    assert (grid.origin <= -half - margin).all() and (far >= half + margin).all()
    assert (far - half < margin + 3.001 * grid.spacing).all()


def test_distances_and_signs_are_those_by_brute_force():
    mesh = carved_mesh()
    grid = sdf_grid(mesh.vertices, mesh.surface, cells=12)
    assert_distances(grid, mesh.vertices, mesh.surface)
    assert_signs(grid, mesh.vertices, mesh.surface)
    # triangles of very different size: the one with the nearest centroid is a poor first guess
    fine, coarse = ball_mesh(0.1, 6, center=(0.0, 0.35, 0.0)), box_mesh((1, 1, 1), (2.0, 0.4, 1.0), pattern="six")
    vertices = np.concatenate([fine.vertices, coarse.vertices])
    triangles = np.concatenate([fine.surface, coarse.surface + len(fine.vertices)])
    assert_distances(sdf_grid(vertices, triangles, cells=16), vertices, triangles)


def test_signs_near_a_vertex_of_two_parts():
    """Two pyramids tip to tip, one of them slanted, and a cavity whose triangles have the nearest centroids."""
    base = np.array([(1, 1, 1), (-1, 1, 1), (-1, 1, -1), (1, 1, -1)], dtype=float)
    vertices = np.concatenate([[(0, 0, 0)], base, -base + (1.5, 0, 0)])
    tets = np.array([(0, 1, 2, 3), (0, 1, 3, 4), (0, 5, 6, 7), (0, 5, 7, 8)])
    with pytest.warns(UserWarning):
        mesh = TetMesh(vertices, tets, fix_orientation=True)
    assert_signs(sdf_grid(mesh.vertices, mesh.surface, 15), mesh.vertices, mesh.surface)
    apex, ring = (0, 1, 0), [(1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, 0, 1)]
    vertices = np.array([apex, *ring, (0, -1, 0), (0.05, 0.8, 0), (-0.05, 0.8, 0.05), (-0.05, 0.8, -0.05)], dtype=float)
    octahedron = [(0, 1 + k, 1 + (k + 1) % 4) for k in range(4)] + [(5, 1 + (k + 1) % 4, 1 + k) for k in range(4)]
    triangles = np.array([*octahedron, (0, 6, 7), (0, 7, 8), (0, 8, 6), (6, 8, 7)])
    assert_signs(sdf_grid(vertices, triangles, 20), vertices, triangles)


def test_cells_follow_the_extent_along_each_axis():
    mesh = sheet_mesh((8, 8), (4.0, 0.05, 3.0))
    for cells in (8, 32):
        grid = sdf_grid(mesh.vertices, mesh.surface, cells)
        inside = np.array([cells, 8, max(8, 3 * cells / 4)])
        assert np.allclose(grid.spacing, [4.0, 0.05, 3.0] / inside) and grid.phi.shape == tuple((inside + 5).astype(int))
        assert np.allclose(grid.origin, [-2.0, -0.025, -1.5] - 2 * grid.spacing)
        assert grid.phi.min() == pytest.approx(-0.025)  # there are points on the middle plane of the sheet


def test_surfaces_without_an_inside_are_refused():
    mesh = box_mesh((1, 1, 1), (1, 1, 1), pattern="six")
    vertices, triangles = mesh.vertices, mesh.surface
    a, b, c = sorted(triangles[4].tolist())
    border = rf"\(({a}, {b}|{a}, {c}|{b}, {c})\)"
    with pytest.raises(MeshError, match=rf"closed surface: edge {border} belongs to triangle \d+ alone \(3 such edges"):
        sdf_grid(vertices, np.delete(triangles, 4, axis=0))
    flipped = triangles.copy()
    flipped[4] = flipped[4][::-1]
    with pytest.raises(MeshError, match="triangles .*4.* traverse their edge .* in the same direction"):
        sdf_grid(vertices, flipped)
    with pytest.raises(MeshError, match="belongs to 4 triangles"):
        sdf_grid(vertices, np.concatenate([triangles, triangles]))
    degenerate = np.where(np.arange(len(vertices))[:, None] == triangles[3, 0], vertices[triangles[3, 1]], vertices)
    for bad, message in ((degenerate, "triangle [0-9]+ has none"), (vertices * (1, 0, 1), "flat and has no inside")):
        with pytest.raises(MeshError, match=message):
            sdf_grid(bad, triangles)
    with pytest.raises(MeshError, match=r"256 cells .* need 17779581 points \(261 x 261 x 261\); at most 2000000"):
        sdf_grid(mesh.vertices, mesh.surface, 256)
    assert sdf_grid(mesh.vertices, mesh.surface, 16, max_points=21**3).phi.size == 21**3


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """(mesh, the calls of `sdf_grid`) with an empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    calls = []

    def counted(*args):
        calls.append(args)
        return sdf_grid(*args)

    monkeypatch.setattr(module, "sdf_grid", counted)
    return ball_mesh(1.0, 2), calls


def cached_grid(mesh, cells=10, **options):
    return cached_sdf_grid(mesh.vertices, mesh.surface, cells, **options)


def equal(a, b) -> bool:
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in ("origin", "spacing", "phi"))


def test_a_cached_grid_is_the_same_and_other_arguments_give_another_one(cache):
    mesh, calls = cache
    first, second = cached_grid(mesh), cached_grid(mesh)
    assert len(calls) == 1 and equal(first, second) and not second.phi.flags.writeable
    assert [path.suffix for path in cache_folder().iterdir()] == [".npz"]
    cached_grid(mesh, cells=11)
    cached_grid(mesh, margin=0.7)
    cached_sdf_grid(mesh.vertices * 1.0000000001, mesh.surface, 10)
    cached_sdf_grid(mesh.vertices, np.roll(mesh.surface, 1, axis=0), 10)
    assert len(calls) == 5 == len(list(cache_folder().iterdir()))
    with pytest.raises(MeshError, match="at most 100"):
        cached_grid(mesh, max_points=100)


def test_a_damaged_cache_file_is_replaced(cache):
    mesh, calls = cache
    first = cached_grid(mesh)
    (path,) = cache_folder().iterdir()
    whole, middle = path.read_bytes(), path.stat().st_size // 2
    np.savez(path, origin=first.origin, spacing=first.spacing, phi=first.phi[1:])
    for damaged in (path.read_bytes(), whole[:middle], whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]):
        path.write_bytes(damaged)
        calls.clear()
        for _ in range(2):
            assert equal(cached_grid(mesh), first) and len(calls) == 1
    assert len(list(cache_folder().iterdir())) == 1
