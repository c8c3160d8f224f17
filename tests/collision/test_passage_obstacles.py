"""Passages of surfaces and obstacles without triangles, and the names of passages:

* half-spaces that move and turn, against NumPy; spheres and capsules against sampled distances by ipctk;
* an edge or corner has one name in all its triangles, and passages know their colliders.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.passages import FLAT, NEAR, ROUND
from tests.collision.checked_paths import FLOOR, checked, obstacle, turned, waves
from tests.collision.rotations import rotation
from tests.collision.surfaces import sheet

pytest.importorskip("ipctk")
from benchmarks.judge import axis_distance


def paths(rng: np.random.Generator):
    """A random pose at t = 1, from none at t = 0."""
    shift, axis, angle = rng.uniform(-0.3, 0.3, 3), rng.standard_normal(3), rng.uniform(0.0, 1.0)
    return lambda t: (t * shift, rotation(axis, t * angle))


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_half_spaces(precision):
    """Vertices must stay above, or get no deeper."""
    rng, n_found = np.random.default_rng(4), 0
    planes = [obstacle(ts.HalfSpace(rng.uniform(0, 1, 3), rng.standard_normal(3)), paths(rng)) for _ in range(8)]
    v, t = sheet(4)
    with checked([(v, t)], planes, precision=precision) as one:
        for _ in range(5):
            x, move = turned(v, rng, 3.0), rng.uniform(-0.2, 0.2, v.shape)
            one.search(x, move)
            pairs, times = one.find()
            expected = {}
            for k, o in enumerate(planes):
                ends = [o.points_at(at, np.stack([o.shape.point, o.shape.point + o.shape.normal])) for at in (0.0, 1.0)]
                now, then = (y @ (tip - p) - p @ (tip - p) for y, (p, tip) in zip((x, x + move), ends))
                need = np.minimum(FLOOR, np.where(now > 0.0, 0.5 * now, now))
                expected |= {(i, k): (now - need)[i] / (now - then)[i] for i in np.flatnonzero(then < need)}
            flat = pairs[:, 0] == FLAT
            assert {(a, b) for _, a, b, _ in pairs[flat].tolist()} == set(expected)
            assert times[flat] == pytest.approx([expected[a, b] for _, a, b, _ in pairs[flat].tolist()], abs=1e-9)
            n_found += flat.sum()
    assert 100 < n_found < 5 * 8 * len(v)


def between(ends, s: float) -> np.ndarray:
    """Points on straight paths."""
    return np.asfortranarray(ends[0] + s * (ends[1] - ends[0]))


def axis_of(o) -> np.ndarray:
    """The ends (2,3) of a capsule's axis at first, both the centre of a sphere [m]."""
    shape = o.shape
    return np.stack([shape.center, shape.center] if isinstance(shape, ts.Sphere) else [shape.a, shape.b])


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_spheres_and_capsules(precision):
    """A free triangle keeps off at all times sampled; another one does until the time given, and has come near then."""
    rng = np.random.default_rng(5)
    shapes = [ts.Sphere(c, r) for c, r in zip(rng.uniform(0.0, 1.0, (4, 3)), (0.05, 0.1, 0.15, 0.2))]
    shapes += [ts.Capsule(a, a + 0.4 * d, 0.08) for a, d in zip(rng.uniform(0.0, 1.0, (6, 3)), rng.standard_normal((6, 3)))]
    shapes, v, t = [obstacle(s, paths(rng)) for s in shapes], *sheet(3)
    counts = {True: 0, False: 0}
    with checked([(v, t)], shapes, precision=precision, self_on=False) as one:
        for _ in range(8):
            x = turned(v, rng, 3.0) + (0.0, 0.5, 0.0)
            move = waves(x, rng, 0.1) + rng.uniform(-0.3, 0.3, 3)
            one.search(x, move)
            passages = {(a, b): time for (kind, a, b, _), time in zip(*(p.tolist() for p in one.find())) if kind == ROUND}
            for i, k in np.ndindex(len(t), len(shapes)):
                axes = [shapes[k].points_at(at, axis_of(shapes[k])) for at in (0.0, 1.0)]
                corners = x[t[i]], x[t[i]] + move[t[i]]
                until = passages.get((i, k), 1.0)
                times = np.linspace(0.0, until, 9)
                gaps = [axis_distance(*between(axes, s), between(corners, s)) - shapes[k].shape.radius for s in times]
                if gaps[0] <= 0.0:
                    assert until == 0.0
                    continue
                assert min(gaps) >= min(FLOOR, 0.5 * gaps[0]) * (1.0 - 1e-9) - 1e-12
                if (i, k) in passages:
                    assert gaps[-1] < 3.0 * FLOOR
                counts[(i, k) in passages] += 1
    assert counts[True] > 50 and counts[False] > 100


def sides(row: np.ndarray, f: int) -> frozenset:
    """The vertices of features f of two triangles in rows 0 to 2 and 3 to 5."""
    if f < 3:
        return frozenset((frozenset(row[f : f + 1].tolist()), frozenset(row[3:].tolist())))
    if f < 6:
        return frozenset((frozenset(row[f : f + 1].tolist()), frozenset(row[:3].tolist())))
    i, j = (f - 6) // 3, (f - 6) % 3
    edges = row[[i, (i + 1) % 3]], row[[3 + j, 3 + (j + 1) % 3]]
    return frozenset(frozenset(edge.tolist()) for edge in edges)


def test_an_edge_or_corner_has_one_name_in_all_its_triangles():
    parts = [sheet(2), (sheet(2)[0] + [0.0, 0.5, 0.0], sheet(2)[1])]
    with checked(parts, [obstacle(ts.Sphere((0.0, 0.0, 0.0), 1.0)), obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)))]) as one:
        t, n = one.made.topology.triangle, len(parts[0][1])
        rows = [(NEAR, a, b, f) for a in range(n) for b in range(n, 2 * n) for f in range(15)]
        meant = [sides(np.concatenate([t[a], t[b]]), f) for _, a, b, f in rows]
        rows += [(ROUND, a, 0, f) for a in range(n) for f in (0, 1, 2)]
        meant += [frozenset((frozenset((int(t[a, f]),)), "sphere")) for _, a, _, f in rows[-3 * n :]]
        rows += [(FLAT, i, 1, 0) for i in range(9)]
        meant += [frozenset((frozenset((i,)), "plane")) for i in range(9)]
        names = [tuple(name) for name in one.check.features(np.array(rows)).tolist()]
        assert len(set(names)) == len(set(meant)) == len(set(zip(names, meant))) < 0.5 * len(rows)
        colliders = one.check.colliders(np.array(rows))
        expected = {NEAR: (0, 1), ROUND: (0, 2), FLAT: (0, 3)}
        assert colliders.tolist() == [list(expected[kind]) for kind, *_ in rows]


def test_features_have_one_name_within_a_body():
    """Its passages list triangles a < b, so either of two edges may come first."""
    with checked([sheet(4)]) as one:
        t = one.made.topology.triangle
        pairs = [(a, b) for a in range(len(t)) for b in range(a + 1, len(t)) if not set(t[a].tolist()) & set(t[b].tolist())]
        rows = [(NEAR, a, b, f) for a, b in pairs for f in range(15)]
        meant = [sides(np.concatenate([t[a], t[b]]), f) for _, a, b, f in rows]
        names = [tuple(name) for name in one.check.features(np.array(rows)).tolist()]
        assert len(set(meant)) == len(set(zip(names, meant))) == len(set(names))
