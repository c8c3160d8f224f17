"""Reduction of contacts, serial and parallel with parts of any length:

* the contacts kept are those of two nested loops, wherever they are and for cells of any size: random ones of several pairs and
  normals, chains in either order and shuffled, many at one point, distances of exactly the tolerance;
* the exact kinds come first; passages are never merged; surfaces that do not cross have no deep contacts.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.collision import contacts as kinds
from taisoft.collision.candidates import TOTAL, Parts
from taisoft.collision.contacts import contact_fields
from taisoft.collision.reduction import FOUND, LEFT, UNDECIDED, inverse_cell, reduction_fields, run_reduction

CAPACITY = 2**13
SAME, OTHER = np.radians(4.0), np.radians(7.0)  # two normals at most the first apart are one; from the second on, they are two


class Reducer:
    """Reduces contacts in a buffer of `chunks` parts."""

    def __init__(self, chunks: int, serial: bool):
        self.arena, self.chunks, self.part = FieldArena(), chunks, CAPACITY // chunks
        self.out = contact_fields(self.arena, CAPACITY)
        self.used = self.arena.field("used", ti.i32, chunks)
        self.parts = Parts(self.out, self.used, self.arena.field("count", ti.i32, 2), self.part, chunks)
        self.fields = reduction_fields(self.arena, CAPACITY, serial)

    def __call__(self, contacts, tolerance: float, cell: float, seed=0, feature=None, gap=None, lowest_gap=-np.inf) -> np.ndarray:
        """Indices of the contacts kept. contacts: point (k,3), normal (k,3), body (k,2); seed: of the lengths of the parts."""
        rng, k = np.random.default_rng(seed), len(contacts[0])
        used = np.zeros(self.chunks, dtype=np.int32)
        while used.sum() < k:
            c = rng.choice(np.flatnonzero(used < self.part))
            used[c] += min(rng.integers(1, 2 + k // 3), self.part - used[c], k - used.sum())
        places = np.concatenate([c * self.part + np.arange(n) for c, n in enumerate(used)])
        feature, gap = np.zeros((k, 3), dtype=np.int32) if feature is None else feature, np.zeros(k) if gap is None else gap
        names = ("point", "normal", "body", "feature", "gap")
        for field, values in zip([getattr(self.out, name) for name in names], (*contacts, feature, gap)):
            # entries beyond the ends of the parts are no contacts
            whole = np.full((CAPACITY, *values.shape[1:]), 7, dtype=values.dtype)
            whole[places] = values
            field.from_numpy(whole)
        self.used.from_numpy(used)
        self.parts.count[TOTAL] = k
        r = self.fields
        run_reduction(r, self.parts, inverse_cell(tolerance, cell), tolerance, lowest_gap)
        assert (r.count[FOUND], r.count[UNDECIDED]) == (k, 0)
        return np.searchsorted(places, r.kept.to_numpy()[: r.count[LEFT]])


@pytest.fixture(scope="module")
def reducers():
    made = Reducer(1, True), Reducer(64, False)
    yield made
    for reducer in made:
        reducer.arena.release()


def quadratic(contacts: tuple[np.ndarray, ...], tolerance: float) -> np.ndarray:
    """Indices of the contacts that are not duplicates of an earlier kept one, by two loops."""
    point, normal, body = contacts
    kept = np.zeros(0, dtype=int)
    for i in range(len(point)):
        near = ((point[kept] - point[i]) ** 2).sum(axis=1) <= tolerance**2
        same = (normal[kept] @ normal[i] >= np.cos(0.5 * (SAME + OTHER))) & (body[kept] == body[i]).all(axis=1)
        if not (near & same).any():
            kept = np.append(kept, i)
    return kept


def check(reducers, contacts: tuple[np.ndarray, ...], tolerance: float, cells=(2.0, 3.3, 250.0)) -> np.ndarray:
    """Check both reducers against two loops, with cells in units of the tolerance; return the indices kept."""
    expected = quadratic(contacts, tolerance)
    for cell in cells:
        for reduce in reducers:
            assert np.array_equal(reduce(contacts, tolerance, cell * (tolerance or 0.1), seed=int(10 * cell)), expected)
    return expected


def with_one_normal(point: np.ndarray) -> tuple[np.ndarray, ...]:
    """Contacts of one pair of bodies with one normal."""
    n = len(point)
    return point, np.tile([0.0, 1.0, 0.0], (n, 1)), np.tile(np.int32([0, 1]), (n, 1))


def test_random_contacts_wherever_they_are(reducers):
    """Of three pairs, with normals that count as one or as two. Far away, coordinates are coarser than the tolerance."""
    rng = np.random.default_rng(1)
    point = np.round(rng.uniform(-1, 1, (1000, 3)) * 2**20) / 2**20  # so that shifts are exact
    angle, axis = rng.choice([0.0, SAME, SAME + OTHER], (1000, 1)), rng.integers(0, 3, 1000)
    normal = np.cos(angle) * np.eye(3)[axis] + np.sin(angle) * np.eye(3)[axis - 1]
    body = np.array([[0, 1], [0, 2], [1, 2]], dtype=np.int32)[rng.integers(0, 3, 1000)]
    kept = [len(check(reducers, (point, normal, body), tolerance)) for tolerance in (1e-4, 0.1, 0.3, 3.0)]
    assert kept[0] == 1000 > kept[1] > kept[2] > kept[3] > 8
    expected = quadratic((point, normal, body), 0.25)
    for shift in ([0.5, 0.25, 1.0], [-123.5, 77.0, 1e3], [2.0**31, 0, 2.0**30]):
        assert np.array_equal(check(reducers, (point + shift, normal, body), 0.25, cells=(3.3,)), expected)
    for far in (1e12, 1e300):
        point = far * np.array([1.0, -1.0, 0.5]) + 0.5 * rng.standard_normal((300, 3))
        point[:100] = far * rng.standard_normal((100, 3))
        with np.errstate(over="ignore"):
            assert 100 < len(check(reducers, with_one_normal(point), 1.0)) < 300


def test_chains(reducers):
    """Each contact equals the next but not the one after it: in order, every second one is kept."""
    line = 0.9 * np.arange(1500)[:, None] * np.array([0.6, 0.0, 0.8])
    for points in (line, line[::-1]):
        assert np.array_equal(check(reducers, with_one_normal(points), 1.0), np.arange(0, 1500, 2))
    assert 500 < len(check(reducers, with_one_normal(np.random.default_rng(3).permutation(line)), 1.0)) < 750


def test_contacts_at_one_point(reducers):
    point = np.full((1000, 3), 0.7)
    for n in (0, 1, 1000):
        assert len(check(reducers, with_one_normal(point[:n]), 1e-3)) == min(n, 1)
    for angle, kept in ((0.0, 1), (SAME, 1), (OTHER, 2), (0.5 * np.pi, 2), (np.pi, 2)):
        _, normal, body = with_one_normal(point[:2])
        normal[1] = (np.sin(angle), np.cos(angle), 0)
        assert len(check(reducers, (point[:2], normal, body), 0.1)) == kept


def test_contacts_at_exactly_the_tolerance_are_merged(reducers):
    """On a lattice whose spacing is the tolerance, in all directions and across all cell borders."""
    i = np.stack(np.meshgrid(*[np.arange(-4, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    kept = check(reducers, with_one_normal(0.125 * np.random.default_rng(5).permutation(i)), 0.125, cells=(2.0, 4.0, 3.0))
    assert 100 < len(kept) < 400
    beyond = np.nextafter(0.125, 1)
    assert len(check(reducers, with_one_normal(np.array([[0.0, 0, 0], [0, beyond, 0]])), 0.125)) == 2
    doubled = with_one_normal(np.random.default_rng(6).integers(0, 5, (1000, 3)) / 4.0)
    assert len(check(reducers, doubled, 0.0)) == 125


def test_kinds_of_contacts(reducers):
    """All at one point: the exact kinds come first, and of one kind the lower feature; the last two are passages."""
    feature = np.zeros((6, 3), dtype=np.int32)
    feature[:, 0] = [kinds.FACE_FIELD, kinds.EDGE_EDGE, kinds.VERTEX_FACE, kinds.VERTEX_FACE, kinds.FACE_FACE, kinds.FACE_FACE]
    feature[2:4, 1] = 9, 5
    contacts, gap = with_one_normal(np.zeros((6, 3))), np.array([-1.0, -1.0, -1.0, -0.5, -1.0, 0.0])
    for reduce in reducers:
        for lowest, kept in ((-np.inf, [3, 4, 5]), (-0.4, [0, 4, 5]), (-0.6, [3, 4, 5])):
            assert reduce(contacts, 0.1, 0.3, feature=feature, gap=gap, lowest_gap=lowest).tolist() == kept
