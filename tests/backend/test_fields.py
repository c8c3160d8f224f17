"""Device arrays and their arena:

* names are unique, sizes are counted in bytes, and arrays that are too large are refused before they are allocated;
* uploads and downloads preserve all types and shapes, NaN and infinities too; downloads are copies;
* data of a wrong shape is refused before anything is written;
* released arrays take no memory, even where references remain.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import DTYPES, FieldArena, download, upload
from taisoft.errors import SimulationError
from tests.backend.lanes import opened


def test_an_arena_counts_bytes_and_refuses_what_is_too_large(monkeypatch):
    """Released arrays are empty even while they are referenced."""
    with opened("f64"):
        arena = FieldArena()
        x, v = arena.field("x", ti.f64, (3, 2), np.arange(6.0).reshape(3, 2)), arena.vectors("v", ti.f32, 5)
        assert arena.bytes == {"x": 48, "v": 60}
        assert np.array_equal(x.to_numpy(), np.arange(6.0).reshape(3, 2)) and not v.to_numpy().any()
        with pytest.raises(ValueError, match="'x' is allocated twice"):
            arena.field("x", ti.f64, 1)
        with pytest.raises(SimulationError, match="array 'huge' needs 3000000000 numbers, more than the 1610612733 that fit"):
            arena.vectors("huge", ti.f32, 10**9)
        monkeypatch.setattr("taisoft.backend.arrays.available_memory", lambda: 2**21)
        with pytest.raises(SimulationError, match="not enough memory for the array 'y': .* are needed, available: "):
            arena.field("y", ti.f64, 2**19)
        assert set(arena.bytes) == {"x", "v"}
        arena.release()
        assert [array.to_numpy().shape for array in (x, v)] == [(0, 2), (0, 3)] and arena.bytes == {}
        arena.field("x", ti.f64, 2)  # the name is free again
        arena.release()


def test_part_of_an_array_is_filled():
    with opened("f64"):
        arena = FieldArena()
        x, n = arena.vectors("x", ti.f64, 4), arena.field("n", ti.i32, 3)
        x.from_numpy(np.ones((2, 3)), 1)
        n.from_numpy(np.array([7, 8]), 0)
        assert x.to_numpy()[:, 2].tolist() == [0.0, 1.0, 1.0, 0.0] and n.to_numpy().tolist() == [7, 8, 0]
        for data, first in ((np.ones((2, 3)), 3), (np.ones((1, 2)), 0), (np.ones((1, 3)), -1)):
            with pytest.raises(ValueError, match=r"the entries from -?\d on of an array of shape \(4, 3\) cannot take"):
                x.from_numpy(data, first)
        assert x.to_numpy().sum() == 6.0
        arena.release()


@pytest.fixture
def arrays():
    """Scalar and vector fields of each type and shape."""
    with opened("f64"):
        arena = FieldArena()
        made = [arena.field(f"{t} {s}", t, s) for t in DTYPES for s in ((7,), (5, 3), (4, 3, 2))]
        made += [arena.vectors(f"{t} of {n}", t, 9, n=n) for t in (ti.f32, ti.f64, ti.i32) for n in (2, 3, 12)]
        yield made
        arena.release()


def random_data(arrays) -> list[np.ndarray]:
    rng, values = np.random.default_rng(0), []
    for array in arrays:
        shape, kind = (*array.shape, array.n) if array.n else array.shape, np.dtype(DTYPES[array.dtype])
        low, high = (0, 256) if kind == np.uint8 else (-(2**31), 2**31)
        data = rng.integers(low, high, shape) if kind.kind in "iu" else rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30)
        values.append(data.astype(kind))
        if kind.kind == "f":
            values[-1].flat[:3] = np.nan, np.inf, -0.0
    return values


def same(found: list[np.ndarray], expected: list[np.ndarray]) -> bool:
    return all(a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in zip(found, expected))


def test_upload_and_download_preserve_data(arrays):
    """Data of a wrong shape changes nothing; double precision is rounded to the type of the array."""
    data = random_data(arrays)
    upload(list(zip(arrays, data)))
    assert same(download(arrays), data) and same(download(arrays[:5], 3), [values[:3] for values in data[:5]])
    arrays[0].to_numpy()[:] = 0  # a copy
    wrong = [np.zeros_like(values) for values in data]
    wrong[-1] = wrong[-1][:, :-1]
    with pytest.raises(ValueError, match=r"an array of shape \(9, 12\) cannot take one of shape \(9, 11\)"):
        upload(list(zip(arrays, wrong)))
    assert same(download(arrays), data)
    singles = [array for array in arrays if array.dtype == ti.f32 and array.shape == (9,)]
    doubles = [np.random.default_rng(1).normal(size=(9, array.n)) for array in singles]
    upload(list(zip(singles, doubles)))
    assert same(download(singles), [values.astype(np.float32) for values in doubles])


def test_single_entries_are_read_and_written_from_the_host(arrays):
    vector = next(array for array in arrays if array.dtype == ti.f64 and array.n == 3)
    vector[2] = 1.0, 2.0, 3.0
    assert vector[2].tolist() == [1.0, 2.0, 3.0] and vector.to_numpy()[2].tolist() == [1.0, 2.0, 3.0]
    scalar = next(array for array in arrays if array.dtype == ti.i32 and array.shape == (7,))
    scalar.fill(4)
    scalar[1] = 5
    assert type(scalar[1]) is int and scalar.to_numpy().tolist() == [4, 5, 4, 4, 4, 4, 4]
