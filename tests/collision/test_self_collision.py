"""Intersecting triangles of one body and of two bodies, and how deeply triangles cross:

* on randomly folded sheets they are those of ipctk: none is missed, and additional pairs touch, both from trees and from the
  spatial hash;
* of two bodies, the pairs that no separating axis separates; triangles that are not finite are never listed;
* a small buffer grows to the same result; at its maximum capacity the error gives both numbers;
* the depth of crossings in crumpled bodies is that of NumPy over all pairs, with and without self-collision; surfaces that only
  touch do not cross.
"""

import itertools

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.collision.bvh import Bvh
from taisoft.collision.detector import Detection
from taisoft.collision.intersections import Intersections
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.dynamics.dynamics import Dynamics
from taisoft.errors import SimulationError
from tests.collision.surfaces import folded, place, separation, soup, surface_of
from tests.dynamics.scenes import dynamics, rubber, set_state


@pytest.fixture
def arena():
    fields = FieldArena()
    yield fields
    fields.release()


def finder(made, arena, **limits):
    """A function that lists the intersecting triangles of the present state, by trees."""
    tree = Bvh(made.surface, made.topology, made.x, made.margin, made.runtime, arena)
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


def test_folded_sheets_against_ipctk(arena):
    ipctk = pytest.importorskip("ipctk")
    rng = np.random.default_rng(1)
    x, t = folded(rng)
    total = 0
    with surface_of([(x, t)], self_on=[True], margin=0.0) as made:
        find = finder(made, arena)
        cells, other = SpatialHash(made.surface, arena, 0.2, np.ones(3)), Intersections(made.surface, FieldArena())
        for _ in range(15):
            x, _ = folded(rng)
            place(made, x)
            pairs = find()
            assert np.array_equal(pairs, other.find(cells.find()))
            found, expected = {(int(a), int(b)) for a, b in pairs}, judged(ipctk, x, t)
            assert not expected - found
            for a, b in found - expected:
                size = np.linalg.norm(x[t[[a, b]]] - np.roll(x[t[[a, b]]], 1, axis=1), axis=2).max()
                assert distance(ipctk, x[t[a]], x[t[b]]) <= 1e-10 * size  # it touches
            total += len(expected)
        cells.release()
        other.release()
    assert total > 150


def overlapping(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(k,2) pairs without a common vertex that no axis separates by more than rounding."""
    pairs = close_pairs(x, t)
    X = np.concatenate([x[t[pairs[:, 0]]], x[t[pairs[:, 1]]]], axis=1)
    return pairs[separation(X) <= 1e-13]


def test_intersections_of_two_bodies_are_those_by_separating_axes(arena):
    rng = np.random.default_rng(2)
    parts = [soup(rng, 60, 0.7), soup(rng, 60, 0.7)]
    with surface_of(parts, serial=True) as made:
        find = finder(made, arena, capacity=64)
        for _ in range(8):
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


# --- depth -----------------------------------------------------------------------------------------------------------


def sat_depth(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Separation (k,) [m] of triangles a and b (k,3,3) along the best of eleven axes; 0 where they do not cross."""
    ea, eb = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    across = np.cross(ea[:, :, None], eb[:, None]).reshape(-1, 9, 3)
    axes = np.concatenate([np.cross(ea[:, :1], ea[:, 1:2]), np.cross(eb[:, :1], eb[:, 1:2]), across], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    pa, pb = np.einsum("kix,knx->kni", a, axes), np.einsum("kix,knx->kni", b, axes)
    width = np.minimum(pa.max(axis=2) - pb.min(axis=2), pb.max(axis=2) - pa.min(axis=2))
    return np.maximum(width.min(axis=1), 0.0)


def brute_force(d: Detection, self_collision: bool) -> tuple[float, float, int]:
    """Largest depth [m], largest depth over the edge, and number of crossings among all pairs without a common vertex."""
    x, t, owner = d.surface.x.to_numpy(), d.topology.triangle, d.topology.body
    shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
    same = owner[:, None] == owner[None]
    a, b = np.nonzero(np.triu(np.where(same, self_collision & ~shared, True), 1))
    depth = np.concatenate([sat_depth(x[t[i]], x[t[j]]) for i, j in zip(np.array_split(a, 64), np.array_split(b, 64))])
    over = depth / np.minimum(d.edges[owner[a]], d.edges[owner[b]])
    return depth.max(), over.max(), int((over > 1e-3).sum())


def boxes() -> ts.Scene:
    """Three boxes above each other, one finer than the others."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, cells in enumerate(((3, 2, 3), (4, 3, 4), (3, 2, 3))):
        scene.add_body(ts.box_mesh(cells, (0.4, 0.3, 0.4)), rubber(), name=f"box {k}", position=(0.0, 0.35 * k, 0.0))
    return scene


def crumpled(scene: ts.Scene, seed: int) -> np.ndarray:
    """Positions of all nodes (n,3) [m], folded into themselves by waves, plus noise."""
    rng, x = np.random.default_rng(seed), np.concatenate([body.mesh.vertices + body.position for body in scene.bodies])
    k, amplitude = rng.uniform(-12.0, 12.0, (3, 4)), rng.standard_normal((4, 3))
    return x + 0.2 * np.sin(x @ k) @ amplitude + 0.01 * rng.standard_normal(x.shape)


def crossings(made: Dynamics, x: np.ndarray) -> np.ndarray:
    """Depth, depth over the edge and number of crossings with the nodes at x."""
    set_state(made, x)
    return made.find_contacts(0.0).crossings()


SETTINGS = {"dt": 0.01, "precision": "f64", "integrator": "symplectic_euler", "allow_unstable": True}


@pytest.mark.parametrize("self_collision", [True, False])
def test_crossings_equal_those_of_all_pairs(self_collision):
    with dynamics(boxes(), self_collision=self_collision, **SETTINGS) as made:
        for seed in range(2):
            found = crossings(made, crumpled(made.scene, seed))
            depth, over, pairs = brute_force(made.find_contacts(0.0), self_collision)
            assert found[:2] == pytest.approx((depth, over), rel=1e-12) and found[2] == pairs > 20


def test_touching_surfaces_do_not_cross():
    """Flush boxes, aligned and shifted by half a cell, share planes and edges."""
    scene, mesh = ts.Scene(), ts.box_mesh((4, 4, 4), (0.4, 0.4, 0.4))
    for k in range(2):
        scene.add_body(mesh, rubber(), name=f"box {k}", position=(0.0, 0.4 * k, 0.0))
    with dynamics(scene, **SETTINGS) as made:
        for off, shift in itertools.product((0.0, 1e-12), (0.0, 0.05)):
            depth, over, pairs = crossings(made, np.concatenate([mesh.vertices, mesh.vertices + (shift, 0.4 - off, 0.0)]))
            assert depth <= 1.01 * off and over <= 1e-10 and pairs == 0
