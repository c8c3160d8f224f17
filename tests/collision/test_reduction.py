"""Reduction of contacts, serial and parallel with parts of any length, in both precisions:

* the contacts kept are those of two nested loops: random contacts, clusters, normals about the limit angle, chains in either
  order and shuffled, many at one point, distances of exactly the tolerance;
* contacts of different pairs, with opposite normals or with normals beyond the limit angle are all kept;
* cell size and position do not matter: shifts, points far from the origin, negative coordinates, much wider cells.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.collision.candidates import Parts
from taisoft.collision.contacts import FOUND, LEFT, SAME_NORMAL, UNDECIDED, contact_fields, reduce_contacts, reduction_fields
from tests.backend.lanes import opened

CAPACITY = 2**13
LIMIT = np.arccos(SAME_NORMAL)  # [rad]


class Reducer:
    """Reduces contacts in a buffer of `chunks` parts."""

    def __init__(self, chunks: int, serial: bool):
        self.arena, self.chunks, self.part = FieldArena(), chunks, CAPACITY // chunks
        self.out = contact_fields(self.arena, CAPACITY)
        self.used = self.arena.field("used", ti.i32, chunks)
        self.parts = Parts(self.out, self.used, None, self.part, chunks)
        self.fields = reduction_fields(self.arena, CAPACITY, chunks, serial)

    def __call__(self, contacts: tuple[np.ndarray, ...], tolerance: float, cell: float, seed: int = 0) -> np.ndarray:
        """Indices of the contacts kept. contacts: point (k,3), normal (k,3), body (k,2); seed: of the lengths of the parts."""
        rng, k = np.random.default_rng(seed), len(contacts[0])
        used = np.zeros(self.chunks, dtype=np.int32)
        while used.sum() < k:
            c = rng.choice(np.flatnonzero(used < self.part))
            used[c] += min(rng.integers(1, 2 + k // 3), self.part - used[c], k - used.sum())
        places = np.concatenate([c * self.part + np.arange(n) for c, n in enumerate(used)])
        for field, values in zip((self.out.point, self.out.normal, self.out.body), contacts):
            # entries beyond the ends of the parts are no contacts
            whole = np.full((CAPACITY, values.shape[1]), 7, dtype=values.dtype)
            whole[places] = values
            field.from_numpy(whole)
        self.used.from_numpy(used)
        r = self.fields
        reduce_contacts(r, self.parts, tolerance, cell)
        assert (r.count[FOUND], r.count[UNDECIDED]) == (k, 0)
        return np.searchsorted(places, r.kept.to_numpy()[: r.count[LEFT]])


@pytest.fixture(scope="module", params=["f64", "f32"])
def reducers(request):
    with opened(request.param):
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
        same = (normal[kept] @ normal[i] >= SAME_NORMAL) & (body[kept] == body[i]).all(axis=1)
        if not (near & same).any():
            kept = np.append(kept, i)
    return kept


def check(reducers, contacts: tuple[np.ndarray, ...], tolerance: float, cells=(2.0, 3.3, 250.0)) -> np.ndarray:
    """Check both reducers against two loops, with cells in units of the tolerance; return the indices kept."""
    expected = quadratic(contacts, tolerance)
    for cell in cells:
        for reduce in reducers:
            assert np.array_equal(reduce(contacts, tolerance, cell * tolerance, seed=int(10 * cell)), expected)
    return expected


def units(rng, n: int) -> np.ndarray:
    v = rng.standard_normal((n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def tilted(n: np.ndarray, angle: np.ndarray, rng) -> np.ndarray:
    """Unit vectors (k,3) rotated by angles (k,) [rad] about random axes."""
    side = np.cross(n, units(rng, len(n)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.cos(angle)[:, None] * n + np.sin(angle)[:, None] * side


def pairs_of_bodies(rng, n: int) -> np.ndarray:
    return np.array([[0, 1], [0, 2], [1, 2]], dtype=np.int32)[rng.integers(0, 3, n)]


def with_one_normal(point: np.ndarray) -> tuple[np.ndarray, ...]:
    """Contacts of one pair of bodies with one normal."""
    n = len(point)
    return point, np.tile([0.0, 1.0, 0.0], (n, 1)), np.tile(np.int32([0, 1]), (n, 1))


def clustered(rng) -> tuple[np.ndarray, ...]:
    """Clusters about as wide as a tolerance of 1, with normals spread to about the limit angle, of three pairs of bodies."""
    centre, normal = 40.0 * rng.standard_normal((60, 3)), units(rng, 60)
    k = rng.integers(0, 60, 3000)
    point = centre[k] + rng.uniform(0.1, 2.0, (60, 1))[k] * rng.standard_normal((3000, 3))
    return point, tilted(normal[k], rng.uniform(0, LIMIT, 3000), rng), pairs_of_bodies(rng, 3000)


@pytest.mark.parametrize("tolerance", [1e-4, 0.05, 0.3, 3.0])
def test_random_contacts(reducers, tolerance):
    rng = np.random.default_rng(1)
    normal = tilted(np.eye(3)[rng.integers(0, 3, 2000)], rng.uniform(0, LIMIT, 2000), rng)
    contacts = rng.uniform(-1, 1, (2000, 3)), normal, pairs_of_bodies(rng, 2000)
    kept = check(reducers, contacts, tolerance)
    assert len(kept) == 2000 if tolerance == 1e-4 else 8 < len(kept) < 1999


def test_clusters(reducers):
    rng = np.random.default_rng(2)
    for _ in range(3):
        contacts = clustered(rng)
        assert 300 < len(check(reducers, contacts, 1.0)) < 2500
        order = rng.permutation(3000)
        check(reducers, tuple(values[order] for values in contacts), 1.0)


def test_chains(reducers):
    """Each contact equals the next but not the one after it: in order, every second one is kept."""
    rng = np.random.default_rng(3)
    line = 0.9 * np.arange(1500)[:, None] * units(rng, 1)
    assert np.array_equal(check(reducers, with_one_normal(line), 1.0), np.arange(0, 1500, 2))
    assert np.array_equal(check(reducers, with_one_normal(line[::-1]), 1.0), np.arange(0, 1500, 2))
    assert 500 < len(check(reducers, with_one_normal(rng.permutation(line)), 1.0)) < 750


def test_contacts_at_one_point(reducers):
    rng = np.random.default_rng(4)
    point = np.tile(rng.standard_normal((1, 3)), (2000, 1))
    assert len(check(reducers, with_one_normal(point), 1e-3)) == 1
    assert len(check(reducers, (point, np.tile(units(rng, 1), (2000, 1)), pairs_of_bodies(rng, 2000)), 1e-3)) == 3
    assert len(check(reducers, (point, units(rng, 2000), pairs_of_bodies(rng, 2000)), 1e-3)) > 300


def test_contacts_at_exactly_the_tolerance_are_merged(reducers):
    """On a lattice whose spacing is the tolerance, in all directions and across all cell borders."""
    i = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(5)
    for _ in range(3):
        kept = check(reducers, with_one_normal(0.125 * rng.permutation(i)), 0.125, cells=(2.0, 4.0, 3.0))
        assert 300 < len(kept) < 1100
    beyond = np.nextafter(0.125, 1)
    assert len(check(reducers, with_one_normal(np.array([[0.0, 0, 0], [0, beyond, 0]])), 0.125)) == 2


@pytest.mark.parametrize("degrees, kept", [(0.0, 1), (5.0, 1), (5.3, 2), (90.0, 2), (180.0, 2)])
def test_normals_beyond_the_limit_angle_are_kept(reducers, degrees, kept):
    point, normal, body = with_one_normal(np.zeros((2, 3)))
    angle = np.radians(degrees)
    normal[1] = (np.sin(angle), np.cos(angle), 0)
    assert len(check(reducers, (point, normal, body), 0.1)) == kept


def test_contacts_of_different_pairs_are_kept(reducers):
    point, normal, body = with_one_normal(np.zeros((5, 3)))
    body = np.int32([[0, 1], [0, 2], [1, 2], [0, 1], [0, 0]])
    assert check(reducers, (point, normal, body), 0.1).tolist() == [0, 1, 2, 4]


def test_no_contact_and_one_contact(reducers):
    for n in (0, 1):
        assert len(check(reducers, with_one_normal(np.zeros((n, 3))), 0.1)) == n


def test_without_tolerance_equal_points_are_merged(reducers):
    rng = np.random.default_rng(6)
    contacts = with_one_normal(rng.integers(0, 5, (1000, 3)) / 4.0)
    expected = quadratic(contacts, 0.0)
    assert len(expected) == 125
    for reduce in reducers:
        assert np.array_equal(reduce(contacts, 0.0, 0.3), expected)


def test_shifts_do_not_matter(reducers):
    rng = np.random.default_rng(7)
    point, normal, body = clustered(rng)
    point = np.round(point * 2**20) / 2**20  # so that shifts are exact
    expected = check(reducers, (point, normal, body), 1.0)
    for shift in ([0.5, 0.25, 1.0], [-123.5, 77.0, 1e3], [2.0**25, -(2.0**24), -(2.0**20)], [2.0**31, 0, 2.0**30]):
        assert np.array_equal(check(reducers, (point + shift, normal, body), 1.0), expected)


@pytest.mark.parametrize("far", [1e12, 1e18, 1e30, 1e150, 1e300])
def test_far_from_the_origin_equal_points_are_merged(reducers, far):
    """Also where coordinates are coarser than the tolerance; different points are kept."""
    rng = np.random.default_rng(8)
    point = far * np.array([1.0, -1.0, 0.5]) + 0.5 * rng.standard_normal((300, 3))
    point[:100] = far * rng.standard_normal((100, 3))
    with np.errstate(over="ignore"):
        assert 100 < len(check(reducers, with_one_normal(point), 1.0)) < 300


def test_a_neighbourhood_rounded_to_three_cells_is_searched(reducers):
    """With cells of twice the tolerance, p - 1/2 is in cell -1, and p + 1/2 rounds into cell 1."""
    p = 0.5 - 2.0**-54
    for order in (1, -1):
        for axis in range(3):
            point = np.full((2, 3), 0.25)
            point[0, axis], point[1, axis] = 0.75, p
            assert len(check(reducers, with_one_normal(point[::order]), 0.5, cells=(2.0,))) == 1
