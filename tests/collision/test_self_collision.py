"""Intersecting triangles of one body and of two bodies, from the candidates of a broad phase:

* on 100 randomly folded sheets they are those of ipctk: none is missed, and additional pairs are closer than the touching
  tolerance, both from trees and from the spatial hash;
* flat and coplanar sheets, sheets on each other at gaps about the tolerance, and a fold whose neighbours share vertices;
* of two bodies, the pairs that no separating axis separates; triangles that are not finite are never listed;
* a small buffer grows to the same result; at its maximum capacity the error gives both numbers.
"""

import numpy as np
import pytest

from taisoft.backend.arrays import FieldArena
from taisoft.collision.bvh import Bvh
from taisoft.collision.intersections import TOUCHING, Intersections
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.errors import SimulationError
from tests.collision.surfaces import folded, place, separation, sheet, soup, surface_of


@pytest.fixture
def arena():
    fields = FieldArena()
    yield fields
    fields.release()


def finder(made, arena, **limits):
    """A function that lists the intersecting triangles of the present state, by trees."""
    tree = Bvh(made.surface, made.topology, made.x, made.margin, made.machine, arena)
    intersections = Intersections(made.surface, arena, **limits)
    return lambda: intersections.find(tree.find())


def close_pairs(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(k,2) triangles a < b that share no vertex and whose boxes overlap, up to rounding."""
    lo, hi = x[t].min(axis=1) - 1e-13, x[t].max(axis=1) + 1e-13
    meet = (lo[:, None] <= hi[None]).all(axis=2) & (lo[None] <= hi[:, None]).all(axis=2)
    shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
    return np.argwhere(np.triu(meet & ~shared, 1))


def judged(ipctk, x: np.ndarray, t: np.ndarray) -> set[tuple[int, int]]:
    """Pairs in which an edge of one triangle pierces the other, by ipctk."""
    found = set()
    for a, b in close_pairs(x, t):
        sides = ((x[t[a]], x[t[b]]), (x[t[b]], x[t[a]]))
        if any(ipctk.is_edge_intersecting_triangle(p[k], p[k - 1], *q) for p, q in sides for k in range(3)):
            found.add((int(a), int(b)))
    return found


def distance(ipctk, a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two triangles that do not intersect [m]."""
    corners = [ipctk.point_triangle_distance(p, *q) for ps, q in ((a, b), (b, a)) for p in ps]
    edges = [ipctk.edge_edge_distance(a[i], a[i - 1], b[j], b[j - 1]) for i in range(3) for j in range(3)]
    return float(np.sqrt(min(corners + edges)))


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_folded_sheets_against_ipctk(arena, precision):
    ipctk = pytest.importorskip("ipctk")
    rng = np.random.default_rng(1)
    x, t = folded(rng)
    total = 0
    with surface_of([(x, t)], self_on=[True], margin=0.0, precision=precision) as made:
        find = finder(made, arena)
        cells, other = SpatialHash(made.surface, arena, 0.2, np.ones(3)), Intersections(made.surface, FieldArena())
        for _ in range(100 if precision == "f64" else 5):
            x, _ = folded(rng)
            place(made, x)
            pairs = find()
            assert np.array_equal(pairs, other.find(cells.find()))
            found, expected = {(int(a), int(b)) for a, b in pairs}, judged(ipctk, x, t)
            assert not expected - found
            for a, b in found - expected:
                size = np.linalg.norm(x[t[[a, b]]] - np.roll(x[t[[a, b]]], 1, axis=1), axis=2).max()
                assert distance(ipctk, x[t[a]], x[t[b]]) <= TOUCHING * size
            total += len(expected)
        cells.release()
        other.release()
    assert total > (1000 if precision == "f64" else 50)


def test_a_fold_through_its_own_sheet_is_found(arena):
    """Pairs that share a vertex are left out; a fold through its own sheet is found by the other pairs."""
    x, t = sheet(6)
    with surface_of([(x, t)], self_on=[True], margin=0.05) as made:
        find = finder(made, arena)
        assert len(find()) == 0
        bent = x.copy()
        far = x[:, 0] > 0.5  # this half is bent up, over and through the other
        angle, r = np.radians(200.0), x[far, 0] - 0.5
        bent[far, 0], bent[far, 1] = 0.5 + r * np.cos(angle), 0.1 * np.sin(6.0 * r) + r * np.sin(angle) + 0.1
        place(made, bent)
        pairs = find()
        assert np.array_equal(pairs, overlapping(bent, t)) and len(pairs) > 10
        place(made, x - np.where(far[:, None], [0.5, 0.0, 0.0], 0.0))  # flat on the other half
        pairs = find()
        assert np.array_equal(pairs, overlapping(made.x, t)) and len(pairs) > 50


def overlapping(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(k,2) pairs without a common vertex that no axis separates by more than rounding."""
    pairs = close_pairs(x, t)
    X = np.concatenate([x[t[pairs[:, 0]]], x[t[pairs[:, 1]]]], axis=1)
    return pairs[separation(X) <= 1e-13]


@pytest.mark.parametrize("gap, touches", [(0.0, True), (1e-12, True), (1e-9, False)])
def test_sheets_on_each_other_touch_within_the_tolerance(arena, gap, touches):
    lower, upper = sheet(4), sheet(3, 0.7)
    upper = (upper[0] + [0.11, gap, 0.13], upper[1])
    with surface_of([lower, upper]) as made:
        pairs = finder(made, arena)()
        if not touches:
            assert len(pairs) == 0
            return
        x, t = made.x * [1, 0, 1], made.topology.triangle
        expected = overlapping(x, t)
        different = made.topology.body[expected[:, 0]] != made.topology.body[expected[:, 1]]
        assert np.array_equal(pairs, expected[different]) and len(pairs) > 30


def test_intersections_of_two_bodies_are_those_by_separating_axes(arena):
    rng = np.random.default_rng(2)
    parts = [soup(rng, 60, 0.7), soup(rng, 60, 0.7)]
    with surface_of(parts, precision="f32", serial=False) as made:
        find = finder(made, arena, capacity=64)
        for _ in range(20):
            place(made, made.x + 0.02 * rng.standard_normal(made.x.shape))
            expected = overlapping(made.x, made.topology.triangle)
            expected = expected[made.topology.body[expected[:, 0]] != made.topology.body[expected[:, 1]]]
            assert np.array_equal(find(), expected) and len(expected) > 50
        x = made.x.copy()
        t = made.topology.triangle[expected[0, 0]]
        x[t[0]] = np.nan
        place(made, x)
        nonfinite = (made.topology.triangle == t[0]).any(axis=1)
        kept = ~nonfinite[expected].any(axis=1)
        assert np.array_equal(find(), expected[kept]) and not kept.all()
        with pytest.raises(SimulationError, match="intersections: [0-9]+ entries are needed .* allows 64"):
            finder(made, FieldArena(), capacity=64, max_capacity=64)()
