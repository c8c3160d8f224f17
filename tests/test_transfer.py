"""Arrays into many fields and back, through their memory and by one kernel:

* every type and number of dimensions that taisoft's fields have comes back as it was, NaN and infinities too;
* the first rows alone;
* what would not fit a field is refused before anything is written; one field, and too much for one launch, go Taichi's way.
"""

import numpy as np
import pytest
import taichi as ti
from lanes import opened

from taisoft import transfer
from taisoft.errors import SimulationError
from taisoft.fields import FieldArena
from taisoft.runtime import open_runtime
from taisoft.transfer import DTYPES, array_of, download, upload

SHAPES = [(7,), (5, 3), (4, 3, 2)]  # of scalar fields


@pytest.mark.parametrize("first", [(), 3, (2, 5)])
def test_memory_is_found_from_any_field(first):
    """Which lies first in a tree, and of which shape, does not matter; what kernels and Taichi write is seen, and the reverse."""
    runtime, arena = open_runtime("cpu", "f32"), FieldArena()
    with arena.group():
        one = arena.field("first", ti.f32, first)
        x = arena.vectors("x", ti.f64, 4, np.arange(12.0).reshape(4, 3))
    assert np.array_equal(x.to_numpy(), array_of(x))
    x[2] = -1.0, -2.0, -3.0
    assert np.array_equal(array_of(x)[2], (-1, -2, -3)) and not np.any(one.to_numpy())
    before = array_of(x)
    upload([(x, before + 1.0)])
    assert x[3][2] == 12.0 and before[3, 2] == 11.0  # what was read is a copy
    arena.release()
    assert not [field for field in (one, x) if field in transfer._places]
    runtime.close()


def test_memory_of_another_taichi_is_not_touched():
    with opened("f64"):
        arena = FieldArena()
        x = arena.field("x", ti.f64, 3, np.arange(3.0))
        ti.init(ti.cpu, log_level=ti.ERROR)  # by a user, say
        for call in (lambda: array_of(x), lambda: upload([(x, np.zeros(3))])):
            with pytest.raises(SimulationError, match="Taichi was initialised anew in this process"):
                call()


@pytest.fixture(scope="module", params=[("f32", "memory"), ("f64", "memory"), ("f64", "kernel")], ids="-".join)
def fields(request):
    """Fields of each type and shape, and of vectors; `kernel` is the way of devices whose memory the host does not see."""
    (precision, way), arena = request.param, FieldArena()
    runtime = open_runtime("cpu", precision)
    with arena.group():
        made = [arena.field(f"{t} {s}", t, s) for t in DTYPES for s in SHAPES]
        made += [arena.vectors(f"{t} of {n}", t, 9, n=n) for t in (ti.f32, ti.f64, ti.i32) for n in (2, 3, 12)]
        scalar = arena.field("one", ti.i32, ())
    if way == "kernel":
        transfer.removed([*made, scalar])
    yield made
    arena.release()
    runtime.close()


def random_data(fields, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    arrays = []
    for field in fields:
        shape = (*field.shape, field.n) if hasattr(field, "n") else field.shape
        kind = np.dtype(DTYPES[field.dtype])
        low, high = (0, 256) if kind == np.uint8 else (-(2**31), 2**31)
        data = rng.integers(low, high, shape) if kind.kind in "iu" else rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30)
        arrays.append(data.astype(kind))
    return arrays


def same(found: list[np.ndarray], wanted: list[np.ndarray]) -> bool:
    return all(a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in zip(found, wanted))


@pytest.mark.parametrize("seed", range(3))
def test_everything_comes_back(fields, seed):
    data = random_data(fields, seed)
    for array in data:
        if array.dtype.kind == "f":
            array.flat[:3] = np.nan, np.inf, -0.0
    upload(list(zip(fields, data)))
    assert same([field.to_numpy() for field in fields], data)
    assert same(download(fields), data)
    assert same(download(fields[:5], 3), [array[:3] for array in data[:5]])
    assert same(download(fields[2:4], 0), [array[:0] for array in data[2:4]])


def test_numbers_are_rounded_to_the_field(fields):
    own = [field for field in fields if field.dtype == ti.f32 and field.shape == (9,)]
    data = [np.random.default_rng(1).normal(size=(9, field.n)) for field in own]
    upload(list(zip(own, data)))
    assert same(download(own), [array.astype(np.float32) for array in data])


def test_what_does_not_fit_is_refused(fields, monkeypatch):
    data = random_data(fields, 3)
    upload(list(zip(fields, data)))
    wrong = [np.zeros_like(array) for array in data]
    wrong[-1] = wrong[-1][:, :-1]
    with pytest.raises(ValueError, match=r"a field of shape \(9, 12\) cannot take an array of shape \(9, 11\)"):
        upload(list(zip(fields, wrong)))
    with pytest.raises(ValueError, match="cannot take an array"):
        upload([(fields[-1], wrong[-1])])
    monkeypatch.setattr(transfer, "MOST", 10)
    with pytest.raises(ValueError, match="cannot take an array"):
        upload(list(zip(fields, wrong)))
    assert same(download(fields), data)


def test_one_field_and_too_much_at_once(fields, monkeypatch):
    data = random_data(fields, 4)
    for field, array in zip(fields, data):
        upload([(field, array)])
    monkeypatch.setattr(transfer, "_launch", None)
    assert all(np.array_equal(array_of(field), array) for field, array in zip(fields, data))
    assert all(same(download([field]), [array]) for field, array in zip(fields, data))
    monkeypatch.setattr(transfer, "MOST", 10)
    upload(list(zip(fields, random_data(fields, 5))))
    assert same(download(fields, 2), [array[:2] for array in random_data(fields, 5)])
