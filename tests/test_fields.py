"""Arrays of a simulator:

* they are counted in bytes, named once, released together, and too large ones refused before they are made;
* every type and number of dimensions comes back as it was, NaN and infinities too; what is read is a copy; the first rows alone;
* what would not fit is refused before anything is written;
* lane buffers are ranges of one field that do not overlap, free again when released; those too large for it share others;
* what is released takes no memory, even where somebody still refers to it.
"""

import gc

import numpy as np
import pytest
import taichi as ti
from lanes import opened

from taisoft.backend import runtime
from taisoft.backend.arrays import DTYPES, ENTRIES, FieldArena, download, size_class, upload
from taisoft.backend.runtime import kernel
from taisoft.errors import SimulationError

SHAPES = [(7,), (5, 3), (4, 3, 2)]  # of scalars


def test_names_and_bytes():
    with opened("f64"):
        arena = FieldArena()
        x = arena.field("x", ti.f64, (3, 2), np.arange(6.0).reshape(3, 2))
        v = arena.vectors("v", ti.f32, 5)
        assert arena.bytes == {"x": 48, "v": 60}
        assert np.array_equal(x.to_numpy(), np.arange(6.0).reshape(3, 2)) and not v.to_numpy().any()
        with pytest.raises(ValueError, match="'x' is allocated twice"):
            arena.field("x", ti.f64, 1)
        with pytest.raises(SimulationError, match="array 'huge' needs 3000000000 numbers, more than the 1610612733 that fit"):
            arena.vectors("huge", ti.f32, 10**9)
        assert set(arena.bytes) == {"x", "v"}
        arena.release()
        assert not arena.bytes
        arena.field("x", ti.f64, 2)  # the name is free again
        arena.release()


def test_memory_that_there_is_not(monkeypatch):
    with opened("f64"):
        arena = FieldArena()
        monkeypatch.setattr("taisoft.backend.arrays.available_memory", lambda: 2**21)
        with pytest.raises(SimulationError, match="not enough memory for the array 'x': .* are needed, available: "):
            arena.field("x", ti.f64, 2**19)
        with pytest.raises(SimulationError, match="not enough memory for the array 'y'"):
            arena.lanes("y", ti.f64, 2**19)
        assert not arena.bytes


@pytest.fixture(params=["f32", "f64"])
def arrays(request):
    """Arrays of each type and shape, and of vectors."""
    with opened(request.param):
        arena = FieldArena()
        made = [arena.field(f"{t} {s}", t, s) for t in DTYPES for s in SHAPES]
        made += [arena.vectors(f"{t} of {n}", t, 9, n=n) for t in (ti.f32, ti.f64, ti.i32) for n in (2, 3, 12)]
        yield made
        arena.release()


def random_data(arrays, seed: int) -> list[np.ndarray]:
    rng, found = np.random.default_rng(seed), []
    for array in arrays:
        shape, kind = (*array.shape, array.n) if array.n else array.shape, np.dtype(DTYPES[array.dtype])
        low, high = (0, 256) if kind == np.uint8 else (-(2**31), 2**31)
        data = rng.integers(low, high, shape) if kind.kind in "iu" else rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30)
        found.append(data.astype(kind))
    return found


def same(found: list[np.ndarray], wanted: list[np.ndarray]) -> bool:
    return all(a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in zip(found, wanted))


def test_everything_comes_back(arrays):
    data = random_data(arrays, 0)
    for one in data:
        if one.dtype.kind == "f":
            one.flat[:3] = np.nan, np.inf, -0.0
    upload(list(zip(arrays, data)))
    assert same(download(arrays), data)
    assert same(download(arrays[:5], 3), [one[:3] for one in data[:5]])
    read = arrays[0].to_numpy()
    read[:] = 0
    assert same([arrays[0].to_numpy()], data[:1])


def test_numbers_are_rounded(arrays):
    own = [array for array in arrays if array.dtype == ti.f32 and array.shape == (9,)]
    data = [np.random.default_rng(1).normal(size=(9, array.n)) for array in own]
    upload(list(zip(own, data)))
    assert same(download(own), [one.astype(np.float32) for one in data])


def test_what_does_not_fit_is_refused(arrays):
    data = random_data(arrays, 3)
    upload(list(zip(arrays, data)))
    wrong = [np.zeros_like(one) for one in data]
    wrong[-1] = wrong[-1][:, :-1]
    with pytest.raises(ValueError, match=r"an array of shape \(9, 12\) cannot take one of shape \(9, 11\)"):
        upload(list(zip(arrays, wrong)))
    assert same(download(arrays), data)


def test_entries_on_the_host(arrays):
    vector = next(array for array in arrays if array.dtype == ti.f64 and array.n == 3)
    vector[2] = 1.0, 2.0, 3.0
    assert vector[2].tolist() == [1.0, 2.0, 3.0] and vector.to_numpy()[2].tolist() == [1.0, 2.0, 3.0]
    scalar = next(array for array in arrays if array.dtype == ti.i32 and array.shape == (7,))
    scalar.fill(4)
    scalar[1] = 5
    assert type(scalar[1]) is int and scalar.to_numpy().tolist() == [4, 5, 4, 4, 4, 4, 4]


@kernel
def write_lanes(out: ti.template(), at: ti.i32, count: ti.i32, value: ti.f64):
    for k in range(at, at + count):
        out[k] = value


@kernel
def sum_lanes(out: ti.template(), at: ti.i32, count: ti.i32) -> ti.f64:
    total = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=True)
    for k in range(at, at + count):
        total += ti.cast(out[k], ti.f64)
    return total


@pytest.mark.parametrize("precision, real", [("f32", ti.f32), ("f64", ti.f64)])
def test_lane_buffers(precision, real):
    with opened(precision):
        arenas = [FieldArena() for _ in range(3)]
        made = [arena.lanes("forces", real, 100) for arena in arenas]
        assert len({lanes.memory for lanes in made}) == 1 and arenas[0].bytes == {"forces": 100 * (4 if real == ti.f32 else 8)}
        for value, lanes in enumerate(made):
            write_lanes(lanes.memory, lanes.at, lanes.count, float(value + 1))
        for value, lanes in enumerate(made):
            assert sum_lanes(lanes.memory, lanes.at, lanes.count) == 100.0 * (value + 1)
        second = made[1].at
        arenas[1].release()
        del made[1], lanes
        gc.collect()
        assert arenas[1].lanes("others", real, 128).at == second  # rounded up to whole cache lines
        for arena in arenas:
            arena.release()


def test_a_lane_buffer_beyond_the_pool():
    with opened("f32"):
        arena = FieldArena()
        large = arena.lanes("large", ti.f32, ENTRIES + 1)
        small = arena.lanes("small", ti.f32, 10)
        assert large.memory is not small.memory and large.at == 0 and large.mask > small.mask
        write_lanes(large.memory, ENTRIES - 3, 4, 2.0)
        assert sum_lanes(large.memory, 0, large.count) == 8.0
        arena.release()


def test_large_lane_buffers_share_fields(monkeypatch):
    """So kernels compiled for one serve the next. Two at a time have two; a larger one takes the place of those that lie idle."""
    runtime._kind = None  # a new Taichi, whose pool has none yet
    with opened("f32"):
        monkeypatch.setattr("taisoft.backend.arrays.ENTRIES", 0)
        arenas = [FieldArena() for _ in range(3)]

        def take(k: int, count: int):
            memory = arenas[k].lanes("large", ti.f32, count).memory
            write_lanes(memory, count - 4, 4, float(k + 1))
            return memory

        def release(k: int) -> None:
            arenas[k].release()
            gc.collect()

        first = take(0, 1000)
        before = runtime.n_compiled()
        second = take(1, 1000)
        assert second is not first and runtime.n_compiled() == before + 1
        release(0)
        assert take(2, 900) is first and runtime.n_compiled() == before + 1
        for k in (1, 2):
            release(k)
        third = take(0, 5000)
        assert third is not first and third is not second
        release(0)
        assert take(1, 1000) is third
        release(1)


def test_a_lane_buffer_has_a_quarter_to_spare_at_most():
    for count in [*range(1, 300), 2**24 + 1, 1_234_567_891]:
        assert count <= size_class(count) <= max(1.25 * count, count + 1)
    assert len({size_class(k) for k in range(1, 2**16)}) <= 4 * 17


def test_released_arrays_give_their_memory_back():
    """Also those that somebody still refers to."""
    with opened("f64"):
        arena = FieldArena()
        held = [arena.field("a", ti.f64, 1000), arena.vectors("b", ti.f32, 1000, n=2)]
        arena.release()
        assert [one.to_numpy().shape for one in held] == [(0,), (0, 2)] and arena.bytes == {}
