"""Launches of kernels that have run before, which go round most of Taichi's launch:

* they do what Taichi's do, with other numbers, arrays and returned values;
* what the code depends on brings other code: templates by value or by which they are, types and dimensions of arrays;
* what Taichi refuses is refused; after Taichi was initialised anew nothing old is launched.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
from lanes import opened

from taisoft import launching, runtime
from taisoft.fields import FieldArena
from taisoft.runtime import kernel


@pytest.fixture
def machine():
    with opened("f32") as made:
        yield made


@kernel
def combine(x: ti.template(), n: ti.template(), a: ti.f64, k: ti.i32, out: ti.types.ndarray()) -> ti.types.vector(2, ti.f64):
    for i in range(out.shape[0]):
        out[i] = a * x[i] + k + n
    return ti.Vector([a, 2.0 * k])


def count_slow(monkeypatch) -> SimpleNamespace:
    """Counts the launches that Taichi makes."""
    seen, before = SimpleNamespace(n=0), launching.prepare

    def prepare(*arguments):
        seen.n += 1
        return before(*arguments)

    monkeypatch.setattr(runtime, "prepare", prepare)
    return seen


def test_other_numbers_and_arrays(machine, monkeypatch):
    arena = FieldArena()
    x = arena.field("x", ti.f64, 5, np.arange(5.0))
    slow = count_slow(monkeypatch)
    for a, k, dtype in ((1.0, 2, "f8"), (np.float32(0.5), np.int64(-7), "f8"), (3, 1, "f8"), (2.5, 0, "f4")):
        out = np.zeros(4, dtype=dtype)
        returned = combine(x, 10, a, k, out)
        assert np.array_equal(out, a * np.arange(4) + k + 10) and list(returned) == [a, 2 * k]
    assert slow.n == 2  # of either type of array
    before = runtime.launches["combine"]
    combine(x, 10, 1.0, 0, out)
    assert slow.n == 2 and runtime.launches["combine"] == before + 1
    arena.release()


def test_other_templates(machine):
    arena = FieldArena()
    fields = [arena.field(f"x{k}", ti.f64, 3, np.full(3, float(k))) for k in range(3)]
    for _ in range(2):
        for k, field in enumerate(fields):
            for n in (1, 2, 1.5):
                out = np.zeros(3)
                combine(field, n, 1.0, 0, out)
                assert np.array_equal(out, np.full(3, k + float(n)))
    arena.release()


def test_what_taichi_refuses(machine):
    arena = FieldArena()
    x, out = arena.field("x", ti.f64, 5), np.zeros(4)
    for _ in range(2):
        combine(x, 0, 1.0, 1, out)
    with pytest.raises(TypeError):
        combine(x, 0, 1.0, 1.5, out)
    with pytest.raises(TypeError):
        combine(x, 0, "3.5", 1, out)
    with pytest.raises(ValueError, match="contiguous"):
        combine(x, 0, 1.0, 1, np.zeros(8)[::2])
    for wrong in ((x, 0, 1.0, 1), (x, 0, 1.0, 1, out, out)):
        with pytest.raises(Exception, match="argument|missing"):
            combine(*wrong)
    arena.release()


def test_a_new_taichi_has_nothing_old(monkeypatch):
    slow = count_slow(monkeypatch)
    for n in (1, 2):
        with opened("f64"):
            arena = FieldArena()
            x, out = arena.field("x", ti.f64, 2), np.zeros(2)
            x.fill(1.0)
            for _ in range(3):
                combine(x, 0, 2.0, 0, out)
            assert np.array_equal(out, [2.0, 2.0]) and slow.n == n
            arena.release()
        runtime._kind = None  # the next one initialises
        assert any(known for known in runtime._known)
    with opened("f64"):
        assert not any(known for known in runtime._known)


def test_fields_of_others_may_go(machine):
    """Taichi then forgets its compiled kernels."""
    arena, other, out = FieldArena(), FieldArena(), np.zeros(2)
    x = arena.field("x", ti.f64, 2, np.array([3.0, 4.0]))
    y = other.field("y", ti.f64, 2)
    for n in range(6):
        if n == 3:
            other.release()
        combine(x, 0, 1.0, n, out)
        assert np.array_equal(out, [3.0 + n, 4.0 + n])
        if n < 3:
            combine(y, 0, 1.0, n, out)
    arena.release()
