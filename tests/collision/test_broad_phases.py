"""Candidates of both broad phases, on all threads, in random scenes: triangle soups, sheets, a collider without faces.

* trees of boxes, for any size of their chunks, and the spatial hash, for any cell, find the pairs of brute force, and so do the
  queries for what is near a corner, an edge or a triangle;
* trees with more slabs drop only pairs that are apart; the grid of the hash is periodic; loops as on CUDA change nothing;
* buffers grow to what is needed, or raise an error with the need and the limit.
"""

from dataclasses import replace

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.paths import Order
from taisoft.backend.runtime import kernel
from taisoft.backend.team import Team
from taisoft.collision.bvh import DIRECTIONS, Bvh
from taisoft.collision.candidates import EDGES, WHOLE, Buffer, entries, pair_entries
from taisoft.collision.spatial_hash import N_LARGE, SpatialHash
from taisoft.collision.surface import list_near
from taisoft.errors import SimulationError
from tests.collision.surfaces import (
    EMPTY,
    brute_pairs,
    colliders,
    near_pairs,
    place,
    row_pairs,
    scatter,
    soup,
    surface_of,
    update_boxes,
    visited_pairs,
)

CAPACITY = 300  # entries per corner and collider


@pytest.fixture(scope="module")
def rig():
    rng, arenas = np.random.default_rng(1), []
    with surface_of(**colliders(rng), serial=False) as made:

        def arena() -> FieldArena:  # one for each broad phase, since names are unique in an arena
            arenas.append(FieldArena())
            return arenas[-1]

        made.x0, made.new_arena = made.x, arena
        made.new_tree = lambda **options: Bvh(made.surface, made.topology, made.x0, made.margin, made.runtime, arena(), **options)
        made.trees = {k: made.new_tree(k_dop=k, leaves=5) for k in DIRECTIONS}
        made.hash = SpatialHash(made.surface, arena(), 0.1, np.ones(3), capacity=2**17)
        made.one_cell = SpatialHash(made.surface, arena(), 0.1, np.zeros(3), capacity=2**17)
        yield made
        for part in (*made.trees.values(), made.hash, made.one_cell, *arenas):
            part.release()


def found(made, tree: Bvh) -> np.ndarray:
    tree.margin = made.margin
    return visited_pairs(made, tree)


def test_candidates_are_those_of_brute_force(rig):
    rng, total, large = np.random.default_rng(2), 0, 0
    for kind in range(30):
        scatter(rng, rig, kind)
        expected, grid = brute_pairs(rig), (rig.hash, rig.one_cell)[kind // 5 % 2]
        total += len(expected)
        assert np.array_equal(found(rig, rig.trees[6]), expected)
        grid.cell = (10.0 ** rng.uniform(-5, 2), 1e-300, 1e300)[kind % 11 if kind % 11 in (1, 2) else 0]
        assert np.array_equal(row_pairs(grid.near()), expected)
        large += 0 < grid.grid.count[N_LARGE] < rig.surface.n_triangles / 2
    assert total > 10000 and large > 1


@pytest.mark.parametrize("order", [Order(), Order(7), Order(64, True)])
def test_chunks_and_loops_as_on_cuda_change_nothing(rig, order):
    scatter(np.random.default_rng(5), rig, 0)
    expected, s = brute_pairs(rig), rig.surface
    before = [f.to_numpy() for f in (s.body_lo, s.body_hi, s.active, s.count)]
    rig.surface = replace(s, on_cpu=False, team=Team(*order))
    for leaves in (1, 10**6, 2):
        tree = rig.new_tree(leaves=leaves)
        assert np.array_equal(found(rig, tree), expected)
        tree.release()
    grid = SpatialHash(rig.surface, rig.new_arena(), 0.1, np.ones(3), capacity=64)
    assert np.array_equal(row_pairs(grid.near()), expected) and all(buffer.growths for buffer in grid.buffers)
    grid.release()
    update_boxes(rig)
    assert all(np.array_equal(f.to_numpy(), b) for f, b in zip((s.body_lo, s.body_hi, s.active, s.count), before))
    rig.surface = s


@pytest.mark.parametrize("kind", ["pairs", "hash"])
def test_small_buffers_grow_up_to_their_limit(rig, kind):
    scatter(np.random.default_rng(7), rig, 0)
    expected = brute_pairs(rig)

    def find(limit: int | None) -> tuple[np.ndarray, tuple[Buffer, ...]]:
        if kind == "pairs":
            out = Buffer("pairs", pair_entries, 64, limit, rig.surface.chunks, rig.new_arena())
            return visited_pairs(rig, rig.trees[6], out=out), (out,)
        grid = SpatialHash(rig.surface, rig.new_arena(), 0.1, np.ones(3), capacity=64, max_capacity=limit)
        return row_pairs(grid.near()), grid.buffers

    pairs, buffers = find(None)
    assert np.array_equal(pairs, expected) and all(buffer.growths for buffer in buffers)
    with pytest.raises(SimulationError, match=r"\w+: [0-9]+ entries are needed .*, and max_capacity allows 65$"):
        find(65)
    for buffer in buffers:
        buffer.release()


def test_more_slabs_drop_only_separated_pairs(rig):
    rng = np.random.default_rng(3)
    w = np.concatenate([np.eye(3), (np.eye(3) + np.roll(np.eye(3), 1, axis=1)) / 2, rng.dirichlet(np.ones(3), 6)])
    t, counts = rig.topology.triangle, dict.fromkeys((6, 14, 18, "near"), 0)
    for kind in range(5):
        scatter(rng, rig, kind)
        pairs = {k: found(rig, tree) for k, tree in rig.trees.items()}
        near = np.zeros(len(pairs[6]), dtype=bool)
        for x in (rig.x, rig.x + rig.move):
            points = np.einsum("pc,tcd->tpd", w, x[t])  # their distance bounds that of the pair
            with np.errstate(over="ignore"):
                apart = np.linalg.norm(points[pairs[6][:, 0], :, None] - points[pairs[6][:, 1], None], axis=3)
            near |= apart.min(axis=(1, 2)) < rig.margin * (1 - 1e-12)
        code = {k: p @ [rig.surface.n_triangles, 1] for k, p in pairs.items()}
        for k in (14, 18):
            assert np.isin(code[k], code[6]).all() and np.isin(code[6][near], code[k]).all()
        for k in DIRECTIONS:
            counts[k] += len(code[k])
        counts["near"] += near.sum()
    assert max(counts[14], counts[18]) < 0.95 * counts[6] and counts["near"] > 1000


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


def test_queries_list_what_is_near(rig):
    """Entries beyond the capacity are counted and not written."""
    made, rng, s, arena = rig, np.random.default_rng(2), rig.surface, rig.new_arena()
    entry = arena.field("entries", ti.i32, s.n_triangles * s.n_bodies * CAPACITY)
    count = arena.field("counts", ti.i32, (s.n_triangles, s.n_bodies))
    s.sharp.from_numpy(rng.choice([0, 8, 9], s.n_triangles))

    def listed(source, q: int, capacity: int = CAPACITY) -> tuple[np.ndarray, np.ndarray]:
        """(k,2) triangle and a triangle near it, in the order listed; counts."""
        source.margin = made.margin
        entry.fill(-7)
        list_all(s, source.near(), q, 0.5 * made.margin, capacity, entry, count)
        counts, filled = count.to_numpy(), entry.to_numpy().reshape(s.n_triangles, s.n_bodies, CAPACITY)
        inside = np.arange(CAPACITY) < np.minimum(counts, capacity)[:, :, None]
        assert (filled[:, :, capacity:] == -7).all()
        t = np.broadcast_to(np.arange(s.n_triangles)[:, None, None], filled.shape)
        return np.stack([t[inside], filled[inside]], axis=1), counts

    made.hash.cell, total = 0.3, 0
    for kind in range(5):
        scatter(rng, made, kind)
        for q in (0, 1, 2, EDGES, WHOLE):
            pairs = near_pairs(made, q)
            for source in (made.trees[6], made.hash):
                assert np.array_equal(listed(source, q)[0], pairs)
            total += len(pairs)
    assert total > 3000
    place(made, made.x0)
    for source in (made.trees[6], made.hash):
        (whole, counts), (part, again) = listed(source, WHOLE), listed(source, WHOLE, capacity=2)
        assert np.array_equal(counts, again) and len(part) == np.minimum(counts, 2).clip(0).sum() < len(whole)


def test_the_grid_is_periodic(rig):
    """A body and its copy, with box faces on cell borders, whole periods apart in the same cells, and out of the grid's range."""
    x, t = soup(np.random.default_rng(6), 60)
    x = np.round((x - 0.5) * 2**20) / 2**20  # makes shifts exact
    with surface_of([(x, t), (x, t)], self_on=[True, True], margin=2.0**-5, serial=True) as made:
        grid = SpatialHash(made.surface, rig.new_arena(), 0.125, np.ones(3), capacity=2**15)
        period = np.array(grid.grid.size) * grid.cell

        def check(*parts: np.ndarray) -> np.ndarray:
            place(made, np.concatenate(parts))
            expected = brute_pairs(made)
            assert np.array_equal(row_pairs(grid.near()), expected) and len(expected) > 100
            return made.topology.body[expected]

        coincident = check(x, x)
        assert (coincident[:, 0] != coincident[:, 1]).sum() > 100
        for periods in ((2, 0, 0), (0, -3, 0), (-(2**20), 2**20, 1), (2**28, 0, -(2**28))):
            body = check(x, x + period * periods)
            assert np.array_equal(body[:, 0], body[:, 1])
        made.margin = 0.0
        for step in (grid.cell, 0.5 * grid.cell, 3 * grid.cell):
            check(step * np.round(x / step), step * np.round(x / step) - (step, 0, 0))
        for far in (2.0**46, 2.0**49, 1e200):  # [m]; f64 no longer tells cells apart from 2^50 cells on
            check(*[x * max(1.0, far * 2.0**-46) + far] * 2)
        grid.release()
    with surface_of([EMPTY, EMPTY], serial=False) as made:
        grid = SpatialHash(made.surface, rig.new_arena(), 0.1, np.ones(3))
        for broad in (Bvh(made.surface, made.topology, made.x, 0.1, made.runtime, rig.new_arena()), grid):
            assert len(visited_pairs(made, broad)) == 0
            broad.release()


def test_a_buffer_stops_at_its_limit():
    buffer = Buffer("things", entries, 15, 119, 3, FieldArena())
    buffer.count.from_numpy(np.array([40, 41]))
    with pytest.raises(SimulationError, match=r"^things: 120 entries are needed \(3 parts of 40\), and max_capacity allows 119$"):
        buffer.grow_if_full()
    assert (buffer.capacity, buffer.growths) == (15, 0)
    buffer.release()
