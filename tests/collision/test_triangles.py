"""Closest points and intersections of triangles:

* closest points of triangles satisfy their variational inequality, for needles and points too; weights are convex, and agree with
  the region;
* intersection agrees with exact separating axes on the integer grid, where every kind of touching occurs, also after rotation,
  shift and scaling, in any order of corners and triangles;
* gaps below 1e-10 edge lengths count as touching, larger ones do not.
"""

import itertools

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision import features
from taisoft.collision.intersections import triangles_intersect
from taisoft.collision.surface import dvec
from tests.collision.rotations import rotation
from tests.collision.surfaces import separation

array = ti.types.ndarray(dtype=ti.f64)


@ti.func
def corner(X: ti.template(), i, k):
    return dvec(X[i, k, 0], X[i, k, 1], X[i, k, 2])


@kernel
def closest_points_on_triangles(X: array, out: array):
    for i in range(X.shape[0]):
        w, region = features.closest_on_triangle(corner(X, i, 0), corner(X, i, 1), corner(X, i, 2), corner(X, i, 3))
        for k in ti.static(range(3)):
            out[i, k] = w[k]
        out[i, 3] = region


@kernel
def intersections(X: array, out: array):
    for i in range(X.shape[0]):
        a0, a1, a2 = corner(X, i, 0), corner(X, i, 1), corner(X, i, 2)
        out[i, 0] = triangles_intersect(a0, a1, a2, corner(X, i, 3), corner(X, i, 4), corner(X, i, 5))


def run(function, X: np.ndarray, columns: int) -> np.ndarray:
    out = np.full((len(X), columns), np.nan)
    function(np.ascontiguousarray(X, dtype=np.float64), out)
    assert np.isfinite(out).all()
    return out


def point_sets() -> np.ndarray:
    """(k,4,3): random ones, ones on a small integer grid, needles and collinear ones; sizes from 1e-6 to 1e6."""
    rng = np.random.default_rng(1)
    scattered = rng.standard_normal((10000, 4, 3))
    needle, line = scattered[:5000].copy(), scattered[5000:].copy()
    needle[:, -1] = needle[:, -2] + 10.0 ** rng.uniform(-16, -2, (5000, 1)) * rng.standard_normal((5000, 3))
    line[:, -1] = line[:, -2] + rng.uniform(-2, 2, (5000, 1)) * (line[:, -2] - line[:, -3])
    sets = np.concatenate([scattered, rng.integers(0, 3, (10000, 4, 3)), needle, line])
    return sets * 10.0 ** rng.uniform(-6, 6, (len(sets), 1, 1))


def test_closest_point_of_a_triangle():
    X = point_sets()
    size = np.linalg.norm(X[:, :, None] - X[:, None], axis=3).max(axis=(1, 2))
    size[size == 0] = 1.0
    out = run(closest_points_on_triangles, X, 4)
    w, region = out[:, :3], out[:, 3].astype(int)
    assert w.min() >= 0 and np.abs(w.sum(axis=1) - 1).max() < 1e-15
    p, corners = X[:, 0], X[:, 1:]
    q = np.einsum("ik,ikd->id", w, corners)
    # no corner, hence no point of the triangle, lies beyond the plane through q normal to p - q
    ahead = np.einsum("id,ikd->ik", p - q, corners - q[:, None]) / size[:, None] ** 2
    assert ahead.max() < 3e-8  # needles; regular triangles below
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    regular = area > 1e-3 * size**2
    assert regular.sum() > 15000 and ahead[regular].max() < 1e-12
    assert np.array_equal(region == 0, (w > 0).all(axis=1))
    for k in range(3):
        edge, vertex = region == 1 + k, region == 4 + k
        assert edge.sum() > 1000 and (w[edge, (k + 2) % 3] == 0).all()
        assert (w[edge, k] > 0).all() and (w[edge, (k + 1) % 3] > 0).all()
        assert vertex.sum() > 1000 and (w[vertex, k] == 1).all()


def test_intersection_is_exact_on_the_integer_grid():
    rng = np.random.default_rng(3)
    X = np.concatenate([rng.integers(0, n, (5000, 6, 3)) for n in (2, 3, 5)])
    flat = rng.integers(0, 5, (5000, 6, 3))
    flat[:, :, 2] = 1  # coplanar
    X = np.concatenate([X, flat])
    apart = separation(X)
    expected = ~(apart > 0)  # NaN for two coincident points, which have no axis
    assert 0.2 < expected.mean() < 0.8 and (apart[expected] == 0).sum() > 2500  # many only touch
    assert np.array_equal(run(intersections, X, 1)[:, 0] == 1, expected)
    rng = np.random.default_rng(4)
    for size, shift in ((1.0, 0.0), (1e-5, 1e-2), (1e-5, 0.0), (1e6, 1e6)):
        moved = size * X @ rotation(rng.standard_normal(3), rng.uniform(0, np.pi)).T + shift * rng.standard_normal(3)
        assert np.array_equal(run(intersections, moved, 1)[:, 0] == 1, expected)
    some = slice(None, None, 7)
    for order in itertools.permutations(range(3)):
        for first in (0, 3):
            permuted = np.concatenate([first + np.array(order), 3 - first + np.roll(order, 1)])
            assert np.array_equal(run(intersections, X[some][:, permuted], 1)[:, 0] == 1, expected[some])


def test_touching_tolerance():
    """A corner above a face, a corner beside an edge in its plane, and two parallel edges."""
    a = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    apart = {
        "corner on face": ([[0.2, 0.2, 0], [0.3, 0.2, 0.5], [0.2, 0.4, 0.5]], [0, 0, 1]),
        "in the plane": ([[0.4, 0, 0], [0.3, -0.5, 0], [0.6, -0.5, 0]], [0, -1, 0]),
        "edges": ([[0.1, 0, 0], [0.7, 0, 0], [0.4, -0.3, 0.6]], [0, -1, 0]),
    }
    for b, direction in apart.values():
        for size, (gap, expected) in itertools.product((1e-6, 1.0, 1e6), ((0.0, 1), (0.2e-10, 1), (3e-10, 0))):
            X = size * np.concatenate([a, np.array(b) + gap * np.array(direction)])[None]
            assert run(intersections, X, 1)[0, 0] == expected
