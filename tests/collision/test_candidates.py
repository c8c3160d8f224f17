"""The common parts of the broad phases, serial and parallel, in f32 and f64:

* active triangles, in order, are those whose box overlaps the box of another collider that they may touch;
* a buffer counts the entries needed by its largest part and by all parts, grows to hold them, and never exceeds its limit;
* beyond the limit, the error gives the entries needed, the number of parts and the limit.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.collision.candidates import NEEDED, SLACK, TOTAL, Buffer, entries
from taisoft.collision.intersections import pairs
from taisoft.collision.surface import ACTIVE
from taisoft.errors import SimulationError
from tests.collision.surfaces import brute_pairs, place, surface_of
from tests.collision.test_bvh import colliders, scatter


@pytest.fixture(scope="module", params=[("f64", True), ("f32", False)], ids=str)
def rig(request):
    precision, serial = request.param
    with surface_of(**colliders(np.random.default_rng(1)), precision=precision, serial=serial) as made:
        made.x0 = made.x
        yield made


@pytest.fixture
def arena(rig):
    fields = FieldArena()
    yield fields
    fields.release()


def used_buffer(arena, needs: list[int], capacity: int, limit: int | None) -> Buffer:
    """A buffer with one part per need."""
    buffer = Buffer("things", entries, capacity, limit, len(needs), arena)
    buffer.used.from_numpy(np.array(needs, dtype=np.int32))
    buffer.count.from_numpy(np.array([max(needs), sum(needs)]))
    return buffer


def test_active_triangles_are_those_whose_boxes_overlap(rig):
    rng = np.random.default_rng(2)
    partly_active = 0
    for kind in range(20):
        scatter(rng, rig, kind)
        apart = np.repeat(0.6 * rng.standard_normal((rig.surface.n_bodies, 3)), np.diff(rig.topology.vertex_first), axis=0)
        place(rig, rig.x + apart, rig.move)
        lo, hi = rig.surface.lo.to_numpy(), rig.surface.hi.to_numpy()
        body, soft, n = rig.topology.body, rig.soft, rig.surface.n_bodies
        own = body[:, None] == np.arange(n)
        body_lo = np.array([lo[rows].min(axis=0, initial=np.inf) for rows in own.T])
        body_hi = np.array([hi[rows].max(axis=0, initial=-np.inf) for rows in own.T])
        overlaps = (lo[:, None] <= body_hi).all(axis=2) & (body_lo <= hi[:, None]).all(axis=2) & (lo <= hi).all(axis=1)[:, None]
        may_touch = ~own & (soft[body][:, None] | soft)
        expected = np.flatnonzero((overlaps & may_touch).any(axis=1) | (overlaps & own & rig.self_on[body][:, None]).any(axis=1))
        active = rig.surface.active.to_numpy()[: rig.surface.count[ACTIVE]]
        assert np.array_equal(active, expected)
        assert np.isin(brute_pairs(rig), active).all()
        partly_active += 0 < len(active) < rig.surface.n_triangles
    assert partly_active > 10


def test_a_buffer_that_is_large_enough_stays(rig, arena):
    buffer = used_buffer(arena, [3, 0, 5], 15, None)
    data = buffer.data
    assert (buffer.count[NEEDED], buffer.count[TOTAL]) == (5, 8)
    assert not buffer.grow_if_full() and buffer.data is data and buffer.growths == 0
    assert buffer.capacity == 15 and buffer.bytes == 60
    buffer.release()


def test_a_buffer_grows_to_the_need(rig, arena):
    buffer = used_buffer(arena, [6, 0, 40], 15, None)
    assert buffer.grow_if_full()
    assert (buffer.part, buffer.capacity, buffer.growths) == (60, 180, 1) and SLACK == 1.5
    assert buffer.data.shape == (180,) and buffer.bytes == 720
    assert not buffer.grow_if_full() and buffer.growths == 1
    buffer.release()


def test_a_buffer_stops_at_its_limit(rig, arena):
    buffer = used_buffer(arena, [1, 0, 40], 15, 119)
    with pytest.raises(SimulationError, match=r"^things: 120 entries are needed \(3 parts of 40\), and max_capacity allows 119$"):
        buffer.grow_if_full()
    assert (buffer.capacity, buffer.growths) == (15, 0)
    buffer.max_capacity = 120
    assert buffer.grow_if_full() and buffer.capacity == 120
    assert not buffer.grow_if_full()
    buffer.release()


@pytest.mark.parametrize("capacity, need, limit", [(15, 40, 130), (16, 5, 16), (100, 1, 100)])
def test_a_buffer_never_exceeds_its_limit(rig, arena, capacity, need, limit):
    """Parts have equal length; the remainder is not used."""
    buffer = used_buffer(arena, [need, 0, 1], capacity, limit)
    buffer.grow_if_full()
    assert buffer.part >= need and buffer.capacity <= limit
    buffer.release()


def test_the_initial_capacity_is_at_least_the_requested_one(rig, arena):
    for capacity, chunks in ((0, 1), (64, 64), (64, 4096), (100, 64)):
        buffer = Buffer(f"things_{capacity}_{chunks}", pairs, capacity, None, chunks, arena)
        assert buffer.capacity >= max(capacity, chunks) and buffer.data.dtype == ti.i32 and buffer.data.n == 2
        assert buffer.capacity < capacity + chunks or capacity < chunks == buffer.capacity
        buffer.release()
