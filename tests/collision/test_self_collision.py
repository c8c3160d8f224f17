"""Intersecting triangles of one body and of two bodies, and how deeply triangles cross:

* listed are the pairs that no separating axis separates, from trees and from the spatial hash; ipctk finds no other; triangles
  that are not finite are never listed; a small buffer grows, up to its limit;
* the depth of crossings in crumpled bodies is that of NumPy over all pairs, with and without self-collision; surfaces that only
  touch do not cross.
"""

import itertools

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.collision.bvh import Bvh
from taisoft.collision.intersections import INTERSECTING
from taisoft.collision.spatial_hash import SpatialHash
from tests.collision.checked_paths import waves
from tests.collision.surfaces import place, separation, sheet, soup, surface_of, visited_pairs
from tests.dynamics.scenes import dynamics, rubber, set_state


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


def test_intersections_are_those_by_separating_axes():
    """Of a folded sheet with itself and with a soup of triangles, which does not count as its own."""
    ipctk, rng, arena = pytest.importorskip("ipctk"), np.random.default_rng(1), FieldArena()
    (flat, faces), (x, free) = sheet(10), soup(rng, 60, 0.7)
    with surface_of([(flat, faces), (x, free)], self_on=[True, False], margin=0.0) as made:
        tree = Bvh(made.surface, made.topology, made.x, 0.0, made.runtime, arena)
        cells = SpatialHash(made.surface, arena, 0.2, np.ones(3))
        t, own, total = made.topology.triangle, made.topology.body == 0, 0
        for _ in range(8):
            folded = flat + sum(waves(flat, rng, 0.5) for _ in range(4))
            now = np.concatenate([folded, x])
            place(made, now + 0.02 * rng.standard_normal(now.shape))
            pairs = close_pairs(made.x, t)
            pairs = pairs[own[pairs].any(axis=1)]
            expected = pairs[separation(np.concatenate([made.x[t[pairs[:, 0]]], made.x[t[pairs[:, 1]]]], axis=1)) <= 1e-13]
            assert all(np.array_equal(visited_pairs(made, broad, INTERSECTING), expected) for broad in (tree, cells))
            pierced = {pair for pair in judged(ipctk, made.x, t) if own[list(pair)].any()}
            assert pierced <= set(map(tuple, expected.tolist())) and own[expected].all(axis=1).any()
            total += len(pierced)
        assert total > 300 and made.pairs.growths
        x = made.x.copy()
        x[t[expected[0, 0], 0]] = np.nan
        place(made, x)
        kept = np.isfinite(x[t[expected]]).all(axis=(1, 2, 3))
        assert np.array_equal(visited_pairs(made, tree, INTERSECTING), expected[kept]) and not kept.all()
    for part in (tree, cells, arena):
        part.release()


def sat_depth(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Depth (k,) [m] of crossings of triangles a and b (k,3,3) along the best of eleven axes; 0 where they do not cross."""
    ea, eb = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    across = np.cross(ea[:, :, None], eb[:, None]).reshape(-1, 9, 3)
    axes = np.concatenate([np.cross(ea[:, :1], ea[:, 1:2]), np.cross(eb[:, :1], eb[:, 1:2]), across], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    pa, pb = np.einsum("kix,knx->kni", a, axes), np.einsum("kix,knx->kni", b, axes)
    width = np.minimum(pa.max(axis=2) - pb.min(axis=2), pb.max(axis=2) - pa.min(axis=2))
    return np.maximum(width.min(axis=1), 0.0)


def boxes(*cells: tuple[int, int, int]) -> ts.Scene:
    """Boxes above each other."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, n in enumerate(cells):
        scene.add_body(ts.box_mesh(n, (0.4, 0.4, 0.4)), rubber(), name=f"box {k}", position=(0.0, 0.4 * k, 0.0))
    return scene


SETTINGS = {"dt": 0.01, "precision": "f64", "integrator": "symplectic_euler", "allow_unstable": True}


@pytest.mark.parametrize("self_collision", [True, False])
def test_crossings_equal_those_of_all_pairs(self_collision):
    """Boxes folded into themselves by waves: largest depth [m], largest depth over the edge, and number of crossings."""
    rng = np.random.default_rng(0)
    with dynamics(boxes((3, 2, 3), (4, 3, 4), (3, 2, 3)), self_collision=self_collision, **SETTINGS) as made:
        x = made.state.state()[0]
        x = x + 0.2 * np.sin(x @ rng.uniform(-12.0, 12.0, (3, 4))) @ rng.standard_normal((4, 3))
        set_state(made, x + 0.01 * rng.standard_normal(x.shape))
        d = made.find_contacts(0.0)
        x, t, owner = d.surface.x.to_numpy(), d.topology.triangle, d.topology.body
        shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
        a, b = np.nonzero(np.triu(np.where(owner[:, None] == owner, self_collision & ~shared, True), 1))
        depth = np.concatenate([sat_depth(x[t[i]], x[t[j]]) for i, j in zip(np.array_split(a, 64), np.array_split(b, 64))])
        over = depth / np.minimum(d.edges[owner[a]], d.edges[owner[b]])
        assert d.crossings() == pytest.approx((depth.max(), over.max(), (over > 1e-3).sum()), rel=1e-12)
        assert (over > 1e-3).sum() > 20


def test_touching_surfaces_do_not_cross():
    """Flush boxes, aligned and shifted by half a cell, share planes and edges."""
    with dynamics(boxes((4, 4, 4), (4, 4, 4)), **SETTINGS) as made:
        start, upper = made.state.state()[0], np.arange(250)[:, None] >= 125
        for off, shift in itertools.product((0.0, 1e-12), (0.0, 0.05)):
            set_state(made, start + upper * (shift, -off, 0.0))
            depth, over, pairs = made.find_contacts(0.0).crossings()
            assert depth <= 1.01 * off and over <= 1e-10 and pairs == 0
