"""Triangles near a corner of a triangle, or near all of it, for random triangles, swept, far away and with NaN:

* bounding-box trees and rows of the spatial hash give those found by brute force, ascending, serial and parallel;
* trees of k-DOPs with more slabs give a subset that contains all triangles within the reach;
* entries beyond the capacity are counted and not written.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.bvh import Bvh
from taisoft.collision.candidates import EDGES, WHOLE
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.collision.surface import list_near
from tests.collision.surfaces import place, surface_of
from tests.collision.test_bvh import colliders, scatter

CAPACITY = 300  # entries per corner and collider


@kernel
def list_all(
    s: ti.template(), near: ti.template(), q: ti.i32, half: ti.f64, capacity: ti.i32, entry: ti.template(), count: ti.template()
):
    """count[t, b]: triangles of collider b near corner q of t, -1 if b is not near; entry: these, from (t, b, 0) on."""
    ti.loop_config(serialize=True)
    for t in range(s.n_triangles):
        for b in range(s.n_bodies):
            count[t, b] = -1
        lo, hi = near.bounds(s, t, q, half)
        for k in range(list_near(s, 0, s.body[t])):
            b = s.near[k]
            begin = (t * s.n_bodies + b) * CAPACITY
            count[t, b] = near.list_triangles(s, b, t, q, lo, hi, entry, begin, begin + capacity)


@pytest.fixture(scope="module", params=[("f64", True), ("f32", False)], ids=str)
def rig(request):
    rng = np.random.default_rng(1)
    precision, serial = request.param
    with surface_of(**colliders(rng), precision=precision, serial=serial) as made:
        made.x0, s = made.x, made.surface
        arenas = [FieldArena() for _ in range(3)]
        made.sources = {
            "boxes": Bvh(s, made.topology, made.x, made.margin, made.machine, arenas[0], leaves=5),
            "slabs": Bvh(s, made.topology, made.x, made.margin, made.machine, arenas[1], k_dop=14, leaves=5),
            "rows": SpatialHash(s, arenas[2], 0.3, np.ones(3)),
        }
        s.sharp.from_numpy(rng.choice([0, 8, 9], s.n_triangles))
        made.entry = made.arena.field("entries", ti.i32, s.n_triangles * s.n_bodies * CAPACITY)
        made.count = made.arena.field("counts", ti.i32, (s.n_triangles, s.n_bodies))
        yield made
        for part in (*made.sources.values(), *arenas):
            part.release()


def listed(made, source: str, q: int, capacity: int = CAPACITY) -> tuple[np.ndarray, np.ndarray]:
    """(k,2) triangle and a triangle near it, in the order listed; counts."""
    s, near = made.surface, made.sources[source]
    near.margin = made.margin
    made.entry.fill(-7)
    list_all(s, near.near(), q, 0.5 * made.margin, capacity, made.entry, made.count)
    count = made.count.to_numpy()
    entry = made.entry.to_numpy().reshape(s.n_triangles, s.n_bodies, CAPACITY)
    inside = np.arange(CAPACITY) < np.minimum(count, capacity)[:, :, None]
    assert (entry[~inside] == -7).all()
    t = np.broadcast_to(np.arange(s.n_triangles)[:, None, None], entry.shape)
    return np.stack([t[inside], entry[inside]], axis=1), count


def expected(made, q: int, padding: float) -> np.ndarray:
    """(k,2) by brute force, ascending: corners whose swept box, padded by `padding` [m], overlaps the boxes of the surface."""
    t, body = made.topology.triangle, made.topology.body
    lo, hi = made.surface.lo.to_numpy(), made.surface.hi.to_numpy()
    finite = (lo <= hi).all(axis=1)
    corners = t if q > 2 else t[:, [q]]
    ends = np.concatenate([made.x[corners], (made.x + made.move)[corners]], axis=1)
    with np.errstate(invalid="ignore"):
        swept_lo, swept_hi = ends.min(axis=1) - padding, ends.max(axis=1) + padding
    meet = (swept_lo[:, None] <= hi[None]).all(axis=2) & (lo[None] <= swept_hi[:, None]).all(axis=2) & finite[:, None] & finite
    shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
    same = body[:, None] == body[None]
    meet &= np.where(same, made.self_on[body][:, None] & ~shared, made.soft[body][:, None] | made.soft[body][None])
    if q == EDGES:
        sharp = made.surface.sharp.to_numpy()
        meet &= (sharp != 0) & (np.triu(np.ones_like(meet), 1) | (sharp & 7 == 0))
    return np.argwhere(meet)


@pytest.mark.parametrize("q", [0, 1, 2, EDGES, WHOLE])
def test_near_triangles_are_those_of_brute_force(rig, q):
    rng = np.random.default_rng(2)
    total = 0
    for kind in range(5):
        scatter(rng, rig, kind)
        pairs = expected(rig, q, 0.5 * rig.margin)
        for source in ("boxes", "rows"):
            assert np.array_equal(listed(rig, source, q)[0], pairs)
        total += len(pairs)
    assert total > (200 if q < 4 else 1000)


@pytest.mark.parametrize("q", [1, WHOLE])
def test_more_slabs_drop_only_triangles_beyond_the_reach(rig, q):
    rng = np.random.default_rng(3)
    n_near, n_dropped = 0, 0
    w = np.concatenate([np.eye(3), rng.dirichlet(np.ones(3), 40)])
    for kind in (0, 2, 0):
        scatter(rng, rig, kind)
        rig.margin = 0.2
        place(rig, rig.x, rig.move)
        fewer, _ = listed(rig, "slabs", q)
        pairs = expected(rig, q, 0.5 * rig.margin)
        code, all_codes = (p @ [rig.surface.n_triangles, 1] for p in (fewer, pairs))
        assert np.isin(code, all_codes).all()
        t = rig.topology.triangle
        corners = t[pairs[:, 0]] if q > 2 else t[pairs[:, 0]][:, [q]]
        near = np.zeros(len(pairs), dtype=bool)
        for x in (rig.x, rig.x + rig.move):  # corners that come within the reach of points of it
            points = np.einsum("pc,tcd->tpd", w, x[t[pairs[:, 1]]])
            with np.errstate(over="ignore"):
                distance = np.linalg.norm(x[corners][:, :, None] - points[:, None], axis=3)
            near |= distance.min(axis=(1, 2)) < rig.margin * (1 - 1e-12)
        assert np.isin(all_codes[near], code).all()
        n_near, n_dropped = n_near + near.sum(), n_dropped + len(pairs) - len(fewer)
    assert n_near > 3 and n_dropped > 30


def test_entries_beyond_the_capacity_are_counted_only(rig):
    place(rig, rig.x0, None)
    for source in ("boxes", "rows"):
        whole, counts = listed(rig, source, WHOLE)
        part, again = listed(rig, source, WHOLE, capacity=2)
        assert np.array_equal(counts, again) and counts.max() > 2
        assert len(part) == np.minimum(counts, 2).clip(0).sum() < len(whole)
