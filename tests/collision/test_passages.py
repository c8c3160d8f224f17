"""Passages of surfaces on straight paths, as `PathCheck` finds them:

* what must not pass each other among triangles with a common vertex is all pairs of their features without one;
* no step is called free that ipctk's continuous detection calls colliding, of two bodies or a scroll with itself, and most that
  ipctk calls free are;
* the list of near pairs does not matter: all pairs, a fresh list, or an earlier one, which is used while vertices stay in their
  boxes or bodies move together, and however they move misses nothing that ipctk finds; paths that leave what was searched are
  not judged.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.collision.passages import ADJACENT, NEAR
from taisoft.collision.path_check import IN_BOXES, adjacent_rows
from tests.collision.checked_paths import REACH, checked, obstacle, turned, waves
from tests.collision.surfaces import sheet

ipctk = pytest.importorskip("ipctk")


# --- triangles with common vertices ---------------------------------------------------------------------------------


def features(t: np.ndarray) -> list[frozenset]:
    """Corners, edges and face of a triangle."""
    i, j, k = (int(v) for v in t)
    return [frozenset(f) for f in ((i,), (j,), (k,), (i, j), (j, k), (k, i), (i, j, k))]


def fan(n: int) -> np.ndarray:
    """A closed ring of n triangles around vertex 0."""
    return np.array([[0, 1 + k, 1 + (k + 1) % n] for k in range(n)])


def random_triangles(n: int, n_verts: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([rng.choice(n_verts, 3, replace=False) for _ in range(n)])


MESHES = {
    "ring of 3": fan(3),
    "ring of 7": fan(7),
    "open fan": fan(7)[:4],
    "open sheet": sheet(3)[1],
    "box": ts.box_mesh((2, 1, 1), (1.0, 1.0, 1.0)).surface,
    "book": np.array([[0, 1, k] for k in range(2, 6)]),
    "apart": np.arange(9).reshape(3, 3),
    "random": random_triangles(30, 14, 0),
}


@pytest.mark.parametrize("name", MESHES)
def test_rows_of_adjacent_triangles_are_all_pairs_of_their_features(name):
    t = MESHES[name]
    rows = [(frozenset(row[:3].tolist()), frozenset(row[3:].tolist())) for row in adjacent_rows(t)]
    assert not any(one & other for one, other in rows)
    neighbours = [(a, b) for k, a in enumerate(t) for b in t[:k] if set(a.tolist()) & set(b.tolist())]
    unions = [frozenset(a.tolist() + b.tolist()) for a, b in neighbours]
    assert all(any(one | other <= union for union in unions) for one, other in rows)
    whole, count = [frozenset(a.tolist()) for a in t], 0
    for a, b in neighbours:
        for f in features(a):
            for g in features(b):
                if not f & g and not any(f | g <= one for one in whole):  # within one triangle, nothing can pass
                    assert any((f <= p and g <= q) or (f <= q and g <= p) for p, q in rows)
                    count += 1
    assert (count > 0) == (len(rows) > 0) == (name != "apart")


# --- against ipctk --------------------------------------------------------------------------------------------------


def two_sheets(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of two wavy sheets above each other, and displacements."""
    flat = sheet(5)[0]
    x = [flat + waves(flat, rng, 0.03), turned(flat * 0.8, rng, 0.3) + (0.1, 0.25, 0.1)]
    x[1] += waves(x[1], rng, 0.03)
    move = [turned(y, rng, 0.5) - y + waves(y, rng, 0.06) + rng.uniform(-0.2, 0.2, 3) for y in x]
    move = [m + 0.01 * rng.standard_normal(m.shape) for m in move]
    return np.concatenate(x), np.concatenate(move)


def scroll(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a sheet rolled up, and displacements."""
    flat = sheet(8)[0]
    angle, radius = 1.3 * np.pi * (1.0 + flat[:, 0]), 0.12 + 0.16 * flat[:, 0]
    x = np.stack([radius * np.cos(angle), radius * np.sin(angle), flat[:, 2]], axis=1)
    x += waves(x, rng, 0.01)
    move = turned(x, rng, 0.5) - x + waves(x, rng, rng.uniform(0.02, 0.2))
    return x, move + rng.uniform(0.0, 0.03) * rng.standard_normal(x.shape)


SURFACES = {"two": (two_sheets, [(sheet(5)[0], sheet(5)[1])] * 2), "scroll": (scroll, [(sheet(8)[0], sheet(8)[1])])}


def starts(name: str, n: int, seed: int):
    """n random (x, move) that do not cross at first."""
    rng, make, found = np.random.default_rng(seed), SURFACES[name][0], []
    judge = collision_mesh(SURFACES[name][1])
    while len(found) < n:
        x, move = make(rng)
        if ipctk.is_step_collision_free(judge, np.asfortranarray(x), np.asfortranarray(x + 1e-9), min_distance=1e-3):
            found.append((x, move))
    return found, judge


def collision_mesh(parts):
    first = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = np.concatenate([t + start for (_, t), start in zip(parts, first)]).astype(np.int32)
    x = np.concatenate([v for v, _ in parts])
    return ipctk.CollisionMesh(np.asfortranarray(x), ipctk.edges(faces), np.asfortranarray(faces))


@pytest.mark.parametrize("precision, n", [("f64", 150), ("f32", 30)])
@pytest.mark.parametrize("name", SURFACES)
def test_no_step_is_called_free_that_collides(name, precision, n):
    cases, judge = starts(name, n, 1)
    truth, called, kinds = [], [], set()
    with checked(SURFACES[name][1], precision=precision, capacity=8, serial=False if precision == "f32" else None) as one:
        for x, move in cases:
            one.search(x, move)
            one.check.forget()
            pairs, times = one.find()
            assert ((times >= 0.0) & (times < 1.0)).all() and (np.lexsort(pairs.T[::-1]) == np.arange(len(pairs))).all()
            truth.append(ipctk.is_step_collision_free(judge, np.asfortranarray(x), np.asfortranarray(x + move)))
            called.append(len(pairs) == 0)
            kinds |= set(pairs[:, 0].tolist())
            if len(times) and times.min() > 0.0:  # until the first passage, nothing collides
                early = x + times.min() * move
                assert ipctk.is_step_collision_free(judge, np.asfortranarray(x), np.asfortranarray(early))
            to_state = one.find(x + move)
            assert np.array_equal(to_state[0][:, :3], pairs[:, :3]) and np.abs(to_state[1] - times).max(initial=0.0) < 1e-3
    truth, called = np.array(truth), np.array(called)
    assert not (called & ~truth).any()
    assert min(truth.sum(), (~truth).sum()) > 0.2 * n and (called & truth).sum() >= 0.9 * truth.sum()
    assert kinds == ({NEAR, ADJACENT} if name == "scroll" else {NEAR})


# --- the list of near pairs -----------------------------------------------------------------------------------------


def same(one, other) -> bool:
    """Whether two searches found the same passages; nearest features may tie."""
    return np.array_equal(one[0][:, :3], other[0][:, :3]) and np.abs(one[1] - other[1]).max(initial=0.0) < 1e-9


@pytest.mark.parametrize("name", SURFACES)
def test_an_earlier_list_finds_what_a_fresh_one_and_all_pairs_do(name):
    """Searches begin farther along the path, and their ends deviate by less than the boxes allow."""
    cases, rng, found = starts(name, 12, 2)[0], np.random.default_rng(3), []
    with checked(SURFACES[name][1]) as one:
        for x, move in cases:
            one.check.forget()
            one.search(x, move)
            one.find()
            before = runtime.launches["list_near_pairs"]
            for part in (0.0, 0.4):
                noise = rng.standard_normal(x.shape)
                noise *= 0.9 * IN_BOXES * REACH / np.linalg.norm(noise, axis=1).max()
                begin, end = x + part * move, x + move + noise
                one.search(begin, (1.0 - part) * move)
                found.append((begin, end, one.find(end)))
            assert runtime.launches["list_near_pairs"] == before
            one.search(begin, end - begin)
            assert same(one.find(check=one.another()), found[-1][2])
            assert runtime.launches["list_near_pairs"] > before
    with checked(SURFACES[name][1], reach=10.0) as one:
        for begin, end, passages in found:
            one.search(begin, end - begin)
            assert same(one.find(), passages)
    assert sum(len(pairs) > 0 for _, _, (pairs, _) in found) > 5


@pytest.mark.parametrize("k_dop", [6, 18])
@pytest.mark.parametrize("name", SURFACES)
def test_an_old_list_misses_nothing_however_bodies_move(name, k_dop):
    """Steps near a collision follow each other with a random common motion and small to large motions of each vertex; often one
    half of the surface glides along the other."""
    cases, judge = starts(name, 60, 4)
    rng, outcomes, drifts = np.random.default_rng(5), [], []
    with checked(SURFACES[name][1], k_dop=k_dop) as one:
        for x, move in cases:
            one.check.forget()
            one.search(x, move)
            near = x + 0.95 * one.find()[1].min(initial=1.0) * move
            one.check.forget()
            drift, size = rng.standard_normal(3), 10.0 ** rng.uniform(-2.0, 0.0)
            glide = (rng.random() < 0.7) * 10.0 ** rng.uniform(-2.0, 0.0) * rng.standard_normal(3) * (1.0, 0.0, 1.0)
            glides = np.outer(np.arange(len(x)) >= len(x) // 2 if name == "two" else waves(x, rng, 1.0)[:, 0], glide)
            for step in range(6):
                begin = near + step * (drift + glides) + 0.1 * REACH * waves(x, rng, size)
                path = drift + size * move
                if not ipctk.is_step_collision_free(judge, *map(np.asfortranarray, (begin, begin + 1e-9)), min_distance=1e-3):
                    continue
                one.search(begin, path)
                before = runtime.launches["list_near_pairs"]
                found = one.find()
                is_old = step > 0 and runtime.launches["list_near_pairs"] == before
                assert same(found, one.find(check=one.another()))
                free = ipctk.is_step_collision_free(judge, *map(np.asfortranarray, (begin, begin + path)))
                assert free or len(found[0])
                outcomes.append((is_old, free))
                drifts.append(is_old * step * np.linalg.norm(drift))
    count = {pair: outcomes.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False))}
    assert min(count.values()) >= 3 and max(drifts) > 20.0 * REACH


def test_paths_that_leave_what_was_searched_are_not_judged():
    parts = [sheet(2), (sheet(2)[0] + [0.0, 0.5, 0.0], sheet(2)[1])]
    x = np.concatenate([v for v, _ in parts])
    move = np.zeros_like(x)
    move[9:, 0] = 0.3
    limit, aside = IN_BOXES * REACH, np.zeros_like(x)
    aside[12] = (0.0, 0.6, 0.8)
    with checked(parts) as one:
        one.search(x, move)
        for along in (0.0, 0.5, 1.0):  # the whole searched path is covered
            assert one.find(x + along * move + 0.999 * limit * aside) is not None
            one.check.forget()
            assert one.find(x + along * move + 1.001 * limit * aside) is None
        for beyond in (-1.01 * limit, 0.3 + 1.01 * limit):
            assert one.find(x + np.array([beyond, 0.0, 0.0]) * (move != 0.0).any(axis=1)[:, None]) is None
        far = x.copy()
        far[3, 1] = np.inf
        assert one.find(far) is None
        assert len(one.find(x + move)[0]) == 0
        before = runtime.launches["list_near_pairs"]
        one.search(x + 3.0 * limit * aside, 0.0 * move)  # a new search, from where the old list is useless
        assert one.find() is not None and runtime.launches["list_near_pairs"] == before + 1
        assert one.find(x) is None
    with checked([parts[0]], [obstacle(ts.Sphere((0.5, 0.5, 0.5), 0.2))], self_on=False) as one:  # needs no list
        one.search(parts[0][0], np.zeros((9, 3)))
        assert len(one.find(parts[0][0] + [0.0, 5.0, 0.0])[0]) > 0


def test_positions_that_are_not_numbers_are_not_judged():
    x, t = sheet(2)
    with checked([(x, t), (x + [0.0, 0.5, 0.0], t)]) as one:
        one.search(np.concatenate([x, x + [0.0, 0.5, 0.0]]), np.zeros((18, 3)))
        state = one.made.x.copy()
        state[3, 1] = np.nan
        assert one.find(state) is None
