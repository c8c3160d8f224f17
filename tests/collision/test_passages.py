"""Passages of surfaces and obstacles on straight paths, as `PathCheck` finds them:

* what must not pass each other among triangles with a common vertex is all pairs of their features without one;
* no step is called free that ipctk's continuous detection calls colliding, and most that ipctk calls free are;
* an earlier list of near pairs serves while bodies move together, and misses nothing; paths that leave it are not judged;
* half-spaces that move and turn, against NumPy; spheres and capsules against sampled distances by ipctk;
* an edge or corner has one name in all its triangles, and passages know their colliders.
"""

import itertools
from collections import Counter

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.counters import counting
from taisoft.collision.passages import ADJACENT, FLAT, NEAR, ROUND
from taisoft.collision.path_check import adjacent_rows
from tests.collision.checked_paths import FLOOR, REACH, axis_at, checked, obstacle, turned, waves
from tests.collision.rotations import rotation
from tests.collision.surfaces import sheet

ipctk = pytest.importorskip("ipctk")
from benchmarks.judge import axis_distance  # noqa: E402


def test_rows_of_adjacent_triangles():
    """Of two triangles with a common vertex each one's opposite edge and the other one; with a common edge, the opposite corners
    and the sides between them. The last one given has triangles with all others."""
    book, box = np.array([[0, 1, k] for k in range(2, 6)]), ts.box_mesh((2, 1, 1), (1.0, 1.0, 1.0)).surface
    for faces in (sheet(3)[1], book, box, np.arange(9).reshape(3, 3)):
        t, expected = [frozenset(row) for row in faces.tolist()], []
        for a, b in itertools.combinations(t, 2):
            common, (p, q) = a & b, (a - b, b - a)
            if len(common) == 1:
                expected += [{p, b}, {q, a}]
            elif len(common) == 2:
                r, s = (frozenset((v,)) for v in common)
                expected += [{p, q | common}, {q, p | common}, {p | r, q | s}, {p | s, q | r}]
        rows = adjacent_rows(np.sort(faces, axis=1)).tolist()
        found = [frozenset((frozenset(row[:3]), frozenset(row[3:6]))) for row in rows]
        assert Counter(found) == Counter(map(frozenset, expected))
        assert all(set(row) <= frozenset().union(*(f for f in t if row[6] in f)) for row in rows)


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


SURFACES = {"two": (two_sheets, [sheet(5)] * 2), "scroll": (scroll, [sheet(8)])}


def is_free(judge, x: np.ndarray, then: np.ndarray, distance: float = 0.0) -> bool:
    """Whether ipctk finds nothing nearer than a distance [m] on straight paths from x to `then`."""
    return ipctk.is_step_collision_free(judge, np.asfortranarray(x), np.asfortranarray(then), min_distance=distance)


def starts(name: str, n: int, seed: int):
    """n random (x, move) that do not cross at first, and ipctk's mesh."""
    rng, (make, parts), found = np.random.default_rng(seed), SURFACES[name], []
    first = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = np.concatenate([t + start for (_, t), start in zip(parts, first)]).astype(np.int32)
    x = np.concatenate([v for v, _ in parts])
    judge = ipctk.CollisionMesh(np.asfortranarray(x), ipctk.edges(faces), np.asfortranarray(faces))
    while len(found) < n:
        x, move = make(rng)
        if is_free(judge, x, x + 1e-9, 1e-3):
            found.append((x, move))
    return found, judge


@pytest.mark.parametrize("name", SURFACES)
def test_no_step_is_called_free_that_collides(name):
    cases, judge = starts(name, 40, 1)
    truth, called, kinds = [], [], set()
    with checked(SURFACES[name][1], capacity=8) as one:
        for x, move in cases:
            one.search(x, move)
            one.check.forget()
            pairs, times = one.find()
            assert ((times >= 0.0) & (times < 1.0)).all() and (np.lexsort(pairs.T[::-1]) == np.arange(len(pairs))).all()
            truth.append(is_free(judge, x, x + move))
            called.append(len(pairs) == 0)
            kinds |= set(pairs[:, 0].tolist())
            if len(times) and times.min() > 0.0:  # until the first passage, nothing collides
                assert is_free(judge, x, x + times.min() * move)
            to_state = one.find(x + move)
            assert np.array_equal(to_state[0][:, :3], pairs[:, :3]) and np.abs(to_state[1] - times).max(initial=0.0) < 1e-3
    truth, called = np.array(truth), np.array(called)
    assert not (called & ~truth).any()
    assert min(truth.sum(), (~truth).sum()) > 4 and (called & truth).sum() >= 0.85 * truth.sum()
    assert kinds == ({NEAR, ADJACENT} if name == "scroll" else {NEAR})


@pytest.mark.parametrize("name", SURFACES)
def test_an_old_list_misses_nothing_however_bodies_move(name):
    """Steps near a collision follow each other with a random common motion and small to large motions of each vertex; often one
    half of the surface glides along the other."""
    cases, judge = starts(name, 20, 4)
    rng, outcomes, drifts = np.random.default_rng(5), [], []
    with checked(SURFACES[name][1]) as one:
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
                if not is_free(judge, begin, begin + 1e-9, 1e-3):
                    continue
                one.search(begin, path)
                with counting() as counts:
                    found = one.find()
                is_old = step > 0 and counts.launches["list_pairs"] == 0
                pairs, times = one.find(check=one.another())
                assert np.array_equal(found[0][:, :3], pairs[:, :3])  # nearest features may tie
                assert np.abs(found[1] - times).max(initial=0.0) < 1e-9
                free = is_free(judge, begin, begin + path)
                assert free or len(found[0])
                outcomes.append((is_old, free))
                drifts.append(is_old * step * np.linalg.norm(drift))
    count = {pair: outcomes.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False))}
    assert min(count.values()) >= 2 and max(drifts) > 20.0 * REACH


def test_paths_that_leave_what_was_searched_are_not_judged():
    parts = [sheet(2), (sheet(2)[0] + [0.0, 0.5, 0.0], sheet(2)[1])]
    x = np.concatenate([v for v, _ in parts])
    move = np.zeros_like(x)
    move[9:, 0] = 0.3
    aside = np.zeros_like(x)
    aside[12] = (0.0, 0.6, 0.8)
    with checked(parts) as one:
        limit = one.check.limit
        one.search(x, move)
        for along in (0.0, 0.5, 1.0):  # the whole searched path is covered
            assert one.find(x + along * move + 0.999 * limit * aside) is not None
            one.check.forget()
            assert one.find(x + along * move + 1.001 * limit * aside) is None
        for beyond in (-1.01 * limit, 0.3 + 1.01 * limit):
            assert one.find(x + np.array([beyond, 0.0, 0.0]) * (move != 0.0).any(axis=1)[:, None]) is None
        for value in (np.inf, np.nan):
            far = x.copy()
            far[3, 1] = value
            assert one.find(far) is None
        assert len(one.find(x + move)[0]) == 0
        one.search(x + 3.0 * limit * aside, 0.0 * move)  # a new search, from where the old list is useless
        with counting() as counts:
            assert one.find() is not None and counts.launches["list_pairs"] == 1
        assert one.find(x) is None


def paths(rng: np.random.Generator):
    """A random pose at t = 1, from none at t = 0."""
    shift, axis, angle = rng.uniform(-0.3, 0.3, 3), rng.standard_normal(3), rng.uniform(0.0, 1.0)
    return lambda t: (t * shift, rotation(axis, t * angle))


def test_half_spaces_spheres_and_capsules():
    """Vertices stay above half-spaces, or get no deeper. A free triangle keeps off round shapes at all times sampled; another one
    does until the time given, and has come near then."""
    rng, n_flat, counts = np.random.default_rng(4), 0, {True: 0, False: 0}
    shapes = [ts.HalfSpace(rng.uniform(0, 1, 3), rng.standard_normal(3)) for _ in range(8)]
    shapes += [ts.Sphere(c, r) for c, r in zip(rng.uniform(0.0, 1.0, (4, 3)), (0.05, 0.1, 0.15, 0.2))]
    shapes += [ts.Capsule(a, a + 0.4 * d, 0.08) for a, d in zip(rng.uniform(0.0, 1.0, (6, 3)), rng.standard_normal((6, 3)))]
    shapes, v, t = [obstacle(s, paths(rng)) for s in shapes], *sheet(3)
    axes = {k: (axis_at(shapes[k], 0.0), axis_at(shapes[k], 1.0)) for k in range(8, len(shapes))}
    with checked([(v, t)], shapes) as one:
        for _ in range(5):
            x = turned(v, rng, 3.0) + (0.0, 0.5, 0.0)
            move = waves(x, rng, 0.1) + rng.uniform(-0.3, 0.3, 3)
            one.search(x, move)
            passages = {(kind, a, b): time for (kind, a, b, _), time in zip(*(p.tolist() for p in one.find()))}
            expected = {}
            for k, o in enumerate(shapes[:8]):
                ends = [o.points_at(at, np.stack([o.shape.point, o.shape.point + o.shape.normal])) for at in (0.0, 1.0)]
                now, then = (y @ (tip - p) - p @ (tip - p) for y, (p, tip) in zip((x, x + move), ends))
                need = np.minimum(FLOOR, np.where(now > 0.0, 0.5 * now, now))
                expected |= {(FLAT, i, k): (now - need)[i] / (now - then)[i] for i in np.flatnonzero(then < need)}
            assert {key: time for key, time in passages.items() if key[0] == FLAT} == pytest.approx(expected, abs=1e-9)
            n_flat += len(expected)
            for i, k in itertools.product(range(len(t)), axes):
                until = passages.get((ROUND, i, k), 1.0)
                (a, b), at = axes[k], np.linspace(0.0, until, 9)
                corners = [np.asfortranarray(x[t[i]] + s * move[t[i]]) for s in at]
                gaps = [axis_distance(*(a + s * (b - a)), c) - shapes[k].shape.radius for s, c in zip(at, corners)]
                if gaps[0] <= 0.0:
                    assert until == 0.0
                    continue
                assert min(gaps) >= min(FLOOR, 0.5 * gaps[0]) * (1.0 - 1e-9) - 1e-12
                assert (ROUND, i, k) not in passages or gaps[-1] < 3.0 * FLOOR
                counts[(ROUND, i, k) in passages] += 1
    assert 100 < n_flat < 5 * 8 * len(v) and counts[True] > 30 and counts[False] > 60


def sides(row: np.ndarray, f: int) -> frozenset:
    """The vertices of features f of two triangles in rows 0 to 2 and 3 to 5."""
    i, j = (f - 6) // 3, (f - 6) % 3
    one, other = (row[[f]], row[3:] if f < 3 else row[:3]) if f < 6 else (row[[i, (i + 1) % 3]], row[[3 + j, 3 + (j + 1) % 3]])
    return frozenset((frozenset(one.tolist()), frozenset(other.tolist())))


def test_an_edge_or_corner_has_one_name_in_all_its_triangles():
    """Also within a body, whose passages list triangles a < b, so that either of two edges may come first."""
    parts = [sheet(2), (sheet(2)[0] + [0.0, 0.5, 0.0], sheet(2)[1])]
    with checked(parts, [obstacle(ts.Sphere((0.0, 0.0, 0.0), 1.0)), obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)))]) as one:
        t, n = one.made.topology.triangle, len(parts[0][1])
        apart = [(a, b) for a in range(2 * n) for b in range(a + 1, 2 * n) if not set(t[a].tolist()) & set(t[b].tolist())]
        rows = [(NEAR, a, b, f) for a, b in apart for f in range(15)]
        meant = [sides(np.concatenate([t[a], t[b]]), f) for _, a, b, f in rows]
        colliders = [[int(a >= n), int(b >= n)] for _, a, b, _ in rows] + [[0, 2]] * (3 * n) + [[0, 3]] * 9
        rows += [(ROUND, a, 0, f) for a in range(n) for f in (0, 1, 2)]
        meant += [frozenset((frozenset((int(t[a, f]),)), "sphere")) for _, a, _, f in rows[-3 * n :]]
        rows += [(FLAT, i, 1, 0) for i in range(9)]
        meant += [frozenset((frozenset((i,)), "plane")) for i in range(9)]
        names = [tuple(name) for name in one.check.features(np.array(rows)).tolist()]
        assert len(set(names)) == len(set(meant)) == len(set(zip(names, meant))) < 0.5 * len(rows)
        assert one.check.colliders(np.array(rows)).tolist() == colliders
