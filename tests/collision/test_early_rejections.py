"""What the search rejects early never has a contact, and most other pairs are rejected:

* a triangle for a vertex, on two wavy sheets that cross here and there and on one that is rolled up;
* an edge for an edge, there too;
* what must not pass each other around a vertex, on random fans of triangles and on a rolled-up sheet.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.contacts import contact_fields
from taisoft.collision.edge_edge import edge_contact, possible_crossings
from taisoft.collision.features import mark_sharp_edges, moved
from taisoft.collision.near_list import is_unfolded
from taisoft.collision.passages import corners
from taisoft.collision.separation import free_until
from taisoft.collision.vertex_face import BESIDE, INSIDE, OUTSIDE, classify, may_have_contact
from tests.collision.checked_paths import FLOOR, checked, turned, waves
from tests.collision.surfaces import place, sheet, surface_of

MARGIN = 0.03


@kernel(cse=False)
def judge_vertices(s: ti.template(), pairs: ti.types.ndarray(), margin: ti.f64, out: ti.types.ndarray()):
    """out (k,2): whether vertex and triangle of each pair (k,2) may have a contact; whether they count as candidates."""
    for k in range(pairs.shape[0]):
        i, u = pairs[k, 0], pairs[k, 1]
        state, n, _, distance, w, own = classify(s, i, u)
        near = distance - ti.max(-(s.move[i] - moved(s, u, w)).dot(n), 0.0) <= margin
        out[k, 0] = int(may_have_contact(s, i, u, margin))
        out[k, 1] = int((state == OUTSIDE and near) or state == INSIDE or (state == BESIDE and own == 0))


@kernel(cse=False)
def judge_edges(s: ti.template(), pairs: ti.types.ndarray(), margin: ti.f64, found: ti.template(), out: ti.types.ndarray()):
    """out (k,2): when the edges of each row (t, k, u, m) may cross, see `possible_crossings`; when they have a contact."""
    mark_sharp_edges(s)
    for k in range(pairs.shape[0]):
        t, k1, u, k2 = pairs[k, 0], pairs[k, 1], pairs[k, 2], pairs[k, 3]
        out[k, 0], out[k, 1] = possible_crossings(s, t, k1, u, k2, margin), 0
        for at_end in range(2):
            out[k, 1] |= edge_contact(s, t, k1, u, k2, 1 << at_end, margin, found, 0, 0) << at_end


@kernel(cse=False)
def judge_rows(s: ti.template(), g: ti.template(), floor: ti.f64, are_apart: ti.i32, out: ti.types.ndarray()):
    """out (k,2): whether the triangles around the common vertex of each row of `adjacent` count as unfolded; the part of the
    motion until which that row is free."""
    for r in range(g.n_adjacent):
        x, p = corners(0.0), corners(0.0)
        for k, q in ti.static(ti.ndrange(6, 3)):
            x[k, q], p[k, q] = s.x[g.adjacent[r, k]][q], g.path[g.adjacent[r, k]][q]
        time, _ = free_until(x, p, 0.0, floor, are_apart)
        out[r, 0], out[r, 1] = is_unfolded(s, g, g.adjacent[r, 6], floor), time


def two_sheets(rng) -> np.ndarray:
    flat = sheet(5)[0]
    above = flat + waves(flat, rng, 0.1) + rng.uniform(-0.05, 0.05, 3)
    return np.concatenate([flat + waves(flat, rng, 0.1), above])


def roll(rng) -> np.ndarray:
    flat = sheet(8)[0]
    angle, radius = 1.3 * np.pi * (1.0 + flat[:, 0]), 0.12 + 0.05 * flat[:, 0]
    x = np.stack([radius * np.cos(angle), radius * np.sin(angle), flat[:, 2]], axis=1)
    return x + waves(x, rng, 0.03)


FACING = [sheet(5), (sheet(5)[0], sheet(5)[1][:, ::-1])]


@pytest.mark.parametrize(("make", "parts"), [(two_sheets, FACING), (roll, [sheet(8)])])
def test_what_is_rejected_has_no_contact(make, parts):
    rng, n_found, n_accepted, n_all = np.random.default_rng(3), np.zeros(2, int), np.zeros(2, int), 0
    with surface_of(parts, self_on=np.ones(len(parts)), margin=MARGIN, serial=True) as made:
        s, t = made.surface, made.topology.triangle
        s.edge.from_numpy(np.full(len(parts), 0.2))
        u = np.tile(np.arange(len(t)), 3 * len(t))
        first = np.repeat(np.arange(3 * len(t)), len(t))
        apart = (t[u] != t[first // 3][:, [0]]).all(axis=1) & (t[u][:, :, None] != t[first // 3][:, None]).all(axis=(1, 2))
        u, first = u[apart], first[apart]
        vertices = np.stack([t[first // 3, first % 3], u], axis=1).astype(np.int32)
        edges = np.stack([first // 3, first % 3, u, first % 3], axis=1).astype(np.int32)
        found = contact_fields(made.arena, 1)
        for size in (0.0, 0.01, 0.1, 0.3):
            for _ in range(5):
                x = make(rng)
                place(made, x, waves(x, rng, size) + size * rng.standard_normal(x.shape))
                for k, (judge, pairs, more) in enumerate(((judge_vertices, vertices, ()), (judge_edges, edges, (found,)))):
                    edges[:, 3] = rng.integers(0, 3, len(edges))
                    out = np.zeros((len(pairs), 2), dtype=np.int32)
                    judge(s, pairs, MARGIN, *more, out)
                    assert not (~out[:, 0] & out[:, 1]).any()
                    n_found[k] += (out[:, 1] > 0).sum()
                    n_accepted[k] += (out[:, 0] > 0).sum()
                n_all += len(vertices)
    assert n_found.min() > 50 and (n_accepted < np.array([0.5, 0.05]) * n_all).all()


def fan(n: int) -> np.ndarray:
    """Triangles of vertex 0 with n others around it."""
    around = 1 + np.arange(n)
    return np.stack([np.zeros(n, dtype=int), around, np.roll(around, -1)], axis=1)


def spread(n: int, rng) -> np.ndarray:
    """Places of its vertices: once or twice around the first one, flat, as a cone, or in a zigzag."""
    turn = 2.0 * np.pi * rng.choice([1, 1, 1, 2]) * np.cumsum(rng.dirichlet(np.full(n, rng.choice([2.0, 20.0]))))
    height = rng.choice([0.0, 0.1, 0.5, 2.0]) * (rng.standard_normal(n) + rng.choice([0.0, 2.0]))
    around = np.stack([np.cos(turn), height, -np.sin(turn)], axis=1) * rng.uniform(0.3, 1.0, (n, 1))
    return turned(np.concatenate([np.zeros((1, 3)), around]), rng, 3.0) + rng.uniform(-3.0, 3.0, 3)


@pytest.mark.parametrize("name", ["fans", "roll"])
def test_nothing_passes_around_an_unfolded_vertex(name):
    sizes, rng, n_unfolded, n_passing, n_all = [3, 4, 5, 6, 7, 8] * 5, np.random.default_rng(6), 0, 0, 0
    parts = [sheet(8)] if name == "roll" else [(spread(n, rng), fan(n)[k % 3 // 2 :]) for k, n in enumerate(sizes)]  # some open
    with checked(parts) as one:
        s, g = one.made.surface, one.check.fields
        out = np.zeros((g.n_adjacent, 2))
        for size in (0.0, 1e-3, 0.01, 0.03, 0.1, 0.3, 1.0):
            for _ in range(6):
                x = roll(rng) if name == "roll" else np.concatenate([spread(n, rng) for n in sizes])
                move = waves(x, rng, size) + (0.1 if name == "roll" else 0.5) * size * rng.standard_normal(x.shape)
                one.search(x, move)
                g.path.from_numpy(move)
                judge_rows(s, g, FLOOR, int(size > 0.0), out)
                assert not ((out[:, 0] == 1.0) & (out[:, 1] < 1.0)).any()
                n_unfolded, n_passing, n_all = n_unfolded + out[:, 0].sum(), n_passing + (out[:, 1] < 1.0).sum(), n_all + len(out)
    assert n_unfolded > 0.1 * n_all and n_passing > 0.01 * n_all
