"""Candidate pairs by bounding volume hierarchies, over 200 random scenes.

Colliders are random triangles (large, needles, points, shared vertices), sheets, and a collider without faces; they are moved at
random, swept, sent far away and made not finite.

* each triangle is in one leaf, children lie within their parent, trees are balanced, and chunks cover each triangle once;
* with k = 6 the candidates are those by brute force and by spatial hash, serial in f64 and parallel in f32;
* with k = 14 and 18 they are a proper subset that contains every pair within the margin;
* the chunk size does not change them;
* boxes and active triangles found by many threads, as on CUDA, are those of one;
* small buffers grow to the same result, or raise an error with the size needed and the limit.
"""

from dataclasses import replace

import numpy as np
import pytest

from taisoft.collision.bvh import DIRECTIONS, Bvh, build_trees
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.collision.surface import ACTIVE, NONFINITE, update_boxes
from taisoft.errors import SimulationError
from tests.collision.surfaces import brute_pairs, pairs_of, place, sheet, soup, surface_of

EMPTY = (np.zeros((3, 3)), np.zeros((0, 3), dtype=int))
SINGLE = (np.array([[0.4, 0.5, 0.5], [0.6, 0.5, 0.5], [0.5, 0.6, 0.7]]), np.array([[0, 1, 2]]))


def colliders(rng) -> dict:
    """Soft bodies: two triangle soups, a sheet, an empty mesh, one triangle. Obstacles: two sheets, an empty mesh."""
    parts = [soup(rng, 110), soup(rng, 70, 0.1), sheet(4), EMPTY, SINGLE, sheet(3), sheet(2), EMPTY]
    soft = np.arange(8) < 5
    return {"parts": parts, "soft": soft, "self_on": [True, False, True, True, False, False, False, False]}


def scatter(rng, made, kind: int) -> None:
    """Move the vertices: at random, permuted, swept, far away, or not finite."""
    x = made.x0 + 0.1 * rng.standard_normal(made.x0.shape)
    if kind % 5 == 1:
        x = rng.permutation(x)
    move = rng.choice([0.0, 0.1, 0.5]) * rng.standard_normal(x.shape)
    if kind % 5 == 2:
        some = rng.random(len(x)) < 0.1
        x[some] += 10.0 ** rng.uniform(2, 300, (some.sum(), 1)) * rng.standard_normal((some.sum(), 3))
    if kind % 5 == 3:
        bad = rng.integers(0, len(x), 9)
        x[bad[:3]], x[bad[3:5]], move[bad[5:7]], move[bad[7:]] = np.nan, np.inf, np.nan, -np.inf
    made.margin = float(rng.choice([0.0, 0.02, 0.2]))
    place(made, x, move)


@pytest.fixture(scope="module", params=[("f64", True), ("f32", False)], ids=str)
def rig(request):
    rng = np.random.default_rng(1)
    precision, serial = request.param
    with surface_of(**colliders(rng), precision=precision, serial=serial) as made:
        made.x0 = made.x
        made.trees = {
            k: Bvh(made.surface, made.topology, made.x, made.margin, made.machine, _arena(made), k_dop=k, leaves=5)
            for k in DIRECTIONS
        }
        made.hash = SpatialHash(made.surface, _arena(made), 0.3, np.ones(3))
        yield made
        for tree in (*made.trees.values(), made.hash):
            tree.release()
        for arena in made.others:
            arena.release()


def _arena(made):
    """Fields of another broad phase, since names are unique in an arena."""
    made.others = [*getattr(made, "others", []), type(made.arena)()]
    return made.others[-1]


def found(made, k: int) -> np.ndarray:
    made.trees[k].margin = made.margin
    return pairs_of(made.trees[k].find())


def test_candidates_agree_with_brute_force(rig):
    rng = np.random.default_rng(2)
    total = 0
    scenes = 200 if rig.surface.serial else 30
    for kind in range(scenes):
        scatter(rng, rig, kind)
        expected = brute_pairs(rig)
        total += len(expected)
        assert np.array_equal(found(rig, 6), expected)
        if kind % 20 < 5:
            assert np.array_equal(pairs_of(rig.hash.find()), expected)
    assert total > scenes * 500


def test_more_slabs_drop_only_separated_pairs(rig):
    rng = np.random.default_rng(3)
    w = np.concatenate([np.eye(3), (np.eye(3) + np.roll(np.eye(3), 1, axis=1)) / 2, rng.dirichlet(np.ones(3), 6)])
    t, counts = rig.topology.triangle, dict.fromkeys((6, 14, 18, "near"), 0)
    for kind in range(5):
        scatter(rng, rig, kind)
        pairs = {k: found(rig, k) for k in DIRECTIONS}
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


def test_refitted_boxes_enclose_their_children(rig):
    rng = np.random.default_rng(4)
    for kind in (0, 2):
        scatter(rng, rig, kind)
        for k, tree in rig.trees.items():
            found(rig, k)
            lo, hi, link = (f.to_numpy() for f in (tree.trees.lo, tree.trees.hi, tree.trees.link))
            for node in np.flatnonzero(link > 0):
                children = [node + 1, node + 2 * ((link[node] + 3) // 4)]
                assert np.array_equal(lo[node], lo[children].min(axis=0)) and np.array_equal(hi[node], hi[children].max(axis=0))
            leaf, t = np.flatnonzero(link < 0), -1 - link[link < 0]
            assert np.array_equal(lo[leaf, :3], rig.surface.lo.to_numpy()[t])
            assert np.array_equal(hi[leaf, :3], rig.surface.hi.to_numpy()[t])


def test_chunk_size_does_not_change_the_candidates(rig):
    scatter(np.random.default_rng(5), rig, 0)
    expected = brute_pairs(rig)
    for leaves in (1, 10**6):
        arena = _arena(rig)
        tree = Bvh(rig.surface, rig.topology, rig.x0, rig.margin, rig.machine, arena, leaves=leaves)
        assert np.array_equal(pairs_of(tree.find()), expected)
        tree.release()


def test_boxes_and_active_triangles_by_many_threads(rig):
    rng, s = np.random.default_rng(10), rig.surface
    n_active = set()
    for kind in range(10):
        scatter(rng, rig, kind)
        made = []
        for surface in (s, replace(s, on_cpu=False)):
            update_boxes(surface, rig.margin)
            boxes = [f.to_numpy() for f in (s.lo, s.hi, s.body_lo, s.body_hi)]
            made.append((*boxes, s.active.to_numpy()[: s.count[ACTIVE]], s.count[NONFINITE]))
        assert all(np.array_equal(a, b) for a, b in zip(*made))
        assert (made[0][-1] > 0) == (kind % 5 == 3)
        n_active.add(len(made[0][-2]))
    assert len(n_active) > 2


def test_refit_by_levels(rig):
    """As on CUDA, where a serial loop over the nodes above the chunks would be slow."""
    scatter(np.random.default_rng(6), rig, 0)
    tree = Bvh(rig.surface, rig.topology, rig.x0, rig.margin, rig.machine, _arena(rig), leaves=2)
    first = tree.tables.top_first
    assert len(first) > 4
    expected = brute_pairs(rig)
    for tree.by_levels in (False, True):
        tree.trees.hi.fill(np.nan)
        assert np.array_equal(pairs_of(tree.find()), expected)
    tree.release()


def test_buffers_grow_up_to_the_limit(rig):
    scatter(np.random.default_rng(7), rig, 0)
    expected = brute_pairs(rig)
    tree = Bvh(rig.surface, rig.topology, rig.x0, rig.margin, rig.machine, _arena(rig), capacity=64)
    assert np.array_equal(pairs_of(tree.find()), expected) and tree.rows.growths
    tree.release()
    tree = Bvh(rig.surface, rig.topology, rig.x0, rig.margin, rig.machine, _arena(rig), capacity=64, max_capacity=65)
    with pytest.raises(SimulationError, match="bvh_rows: [0-9]+ entries are needed .* allows 65"):
        tree.find()
    tree.release()


@pytest.mark.parametrize("leaves", [1, 4, 64])
def test_trees_hold_every_triangle_once(leaves):
    rng = np.random.default_rng(8)
    counts = np.array([0, 1, 2, 3, 100, 0, 257, 64, 5])
    first = np.concatenate([[0], np.cumsum(counts)])
    centroid = rng.standard_normal((first[-1], 3))
    centroid[10:40] = centroid[10]
    centroid[50] = np.nan
    t = build_trees(centroid, first, leaves)
    assert len(t.link) == sum(2 * n - 1 for n in counts if n)

    def triangles(node: int, level: int = 0) -> tuple[list[int], int]:
        if t.link[node] < 0:
            return [-1 - t.link[node]], level
        n = (t.link[node] + 1) // 2
        left, right = triangles(node + 1, level + 1), triangles(node + 2 * ((n + 1) // 2), level + 1)
        assert len(left[0]) == (n + 1) // 2 and len(right[0]) == n // 2
        return left[0] + right[0], max(left[1], right[1])

    for k, n in enumerate(counts):
        assert (t.root[k] < 0) == (n == 0)
        if n:
            found, depth = triangles(t.root[k])
            assert sorted(found) == list(range(first[k], first[k + 1])) and depth == np.ceil(np.log2(n))
    covered = []
    for node in t.chunk:
        found, _ = triangles(node)
        body = np.searchsorted(first, min(found), side="right") - 1
        assert len(found) <= leaves and max(found) < first[body + 1]
        covered += found
    assert sorted(covered) == list(range(first[-1]))
    above = {i for i in np.flatnonzero(t.link > 0) if (t.link[i] + 1) // 2 > leaves}
    assert set(t.top) == above and len(t.top) == len(above) == t.top_first[-1]
    place_of = {node: i for i, node in enumerate(t.top)}
    for node in t.top:  # a parent is in a later level than its children
        for child in (node + 1, node + 2 * ((t.link[node] + 3) // 4)):
            if child in place_of:
                level = np.searchsorted(t.top_first, [place_of[child], place_of[node]], side="right")
                assert level[0] < level[1]


def test_splits_along_the_longest_extent():
    x = np.zeros((64, 3))
    x[:, 1] = np.random.default_rng(9).permutation(64)
    t = build_trees(x, np.array([0, 64]), 8)
    for node, n in zip(t.chunk, np.full(8, 8)):
        leaves = -1 - t.link[node : node + 2 * n - 1]
        height = x[leaves[t.link[node : node + 2 * n - 1] < 0], 1]
        assert np.ptp(height) == 7


def test_a_scene_without_triangles(rig):
    with surface_of([EMPTY, EMPTY], precision=rig.machine.precision) as made:
        arena = _arena(made)
        tree = Bvh(made.surface, made.topology, made.x, 0.1, made.machine, arena)
        assert len(pairs_of(tree.find())) == 0
        tree.release()
        arena.release()
