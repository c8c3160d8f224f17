"""Kernels over records of arrays:

* one compiled kernel serves all records of one structure, whatever their sizes; it is compiled anew for other types, extents but
  the first, flags, optional arrays, constants that are not counts, and modules;
* kernels can use nested records, tuples, properties, methods and arrays of several dimensions;
* neither a record nor its arrays are kept alive by a launch;
* every way to launch gives the same results and errors; after a new ti.init nothing old is launched;
* a pack takes any number of arrays, and works as well where the memory of its numbers is not found.
"""

import gc
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import taichi as ti

from taisoft.backend import launching, runtime
from taisoft.backend.arrays import Count, FieldArena, index_mask
from taisoft.backend.pack import Arguments
from taisoft.backend.runtime import kernel
from taisoft.fem.laws import corotational, stable_neo_hookean
from tests.backend.lanes import opened


@pytest.fixture(params=["pack", "flat", "public"])
def running(request, monkeypatch):
    """A runtime with each way to launch."""
    monkeypatch.setattr(launching, "PUBLIC", request.param == "public")
    monkeypatch.setattr(launching, "PACK", str(int(request.param == "pack")))
    runtime.forget()  # kernels compiled for another way
    with opened("f64"):
        yield
    runtime.forget()


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a record."""

    first: Count
    weight: Any  # f64
    power: int  # a compile-time constant


@dataclass(frozen=True, eq=False)
class Record:
    """An argument of kernels."""

    n: Count
    x: Any  # 3-vectors
    table: Any  # (n, 2, 3)
    extra: Any  # f64, or None
    parts: tuple
    flag: bool
    unused: Any = None

    @property
    def has_extra(self) -> bool:
        """Whether the optional array is there."""
        return self.extra is not None

    @ti.func
    def length(self, i):
        """Length of vector i."""
        return self.x[i].norm()


def make(arena: FieldArena, n: int, flag: bool = True, extra: bool = False, power: int = 2, unused: Any = None) -> Record:
    tag = len(arena.bytes)
    x, table = np.arange(3.0 * n).reshape(n, 3), np.arange(6.0 * n).reshape(n, 2, 3)
    parts = tuple(Part(k, arena.field(f"weight {k} {tag}", ti.f64, n, np.full(n, k + 1.0)), power) for k in range(2))
    optional = arena.field(f"extra {tag}", ti.f64, n, np.full(n, 0.5)) if extra else None
    x, table = arena.vectors(f"x {tag}", ti.f64, n, x), arena.field(f"table {tag}", ti.f64, (n, 2, 3), table)
    return Record(n, x, table, optional, parts, flag, unused)


@ti.func
def weighted(p: ti.template(), i):
    """The value of a part at i."""
    return p.weight[i] ** p.power + p.first


@kernel
def evaluate(r: ti.template(), scale: ti.f64, out: ti.types.ndarray()) -> ti.f64:
    last = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=True)
    for i in range(r.n):
        value = r.length(i) + r.table[i, 1, 2]
        for p in ti.static(r.parts):
            value += weighted(p, i)
        if ti.static(r.flag):
            value *= scale
        if ti.static(r.has_extra):
            value += r.extra[i]
        r.x[i][2] += 1.0
        out[i] = value
        last = value
    return last


def check(r: Record, scale: float = 3.0) -> None:
    """Compare `evaluate` with NumPy."""
    out, x = np.zeros(r.n), r.x.to_numpy()
    value = np.linalg.norm(x, axis=1) + r.table.to_numpy()[:, 1, 2]
    value += sum(p.weight.to_numpy() ** p.power + p.first for p in r.parts)
    value = (scale if r.flag else 1.0) * value + (0.0 if r.extra is None else 0.5)
    last = evaluate(r, scale, out)
    assert out == pytest.approx(value, rel=1e-14) and last == out[-1]
    assert np.array_equal(r.x.to_numpy(), x + (0.0, 0.0, 1.0))


def test_records_of_all_sizes_share_one_kernel(running):
    """And another structure is compiled anew. A launch keeps no reference to a record."""
    arena, before = FieldArena(), runtime.n_compiled()
    for n in (3, 1, 50):
        record = make(arena, n)
        check(record)
        check(record, 0.5)
    check(make(arena, 4, unused=("not used", "in the kernel")))
    for k, changes in enumerate(({}, {"flag": False}, {"extra": True}, {"power": 3})):
        check(make(arena, 5, **changes))
        assert runtime.n_compiled() == before + k + 1
    references = [weakref.ref(thing) for thing in (record, record.x, record.parts[0].weight)]
    arena.release()
    del record
    gc.collect()
    assert not any(reference() for reference in references)


@kernel
def combine(x: ti.template(), law: ti.template(), n: ti.template(), a: ti.f64, k: ti.i32, out: ti.types.ndarray()):
    for i in range(out.shape[0]):
        out[i] = a * x[i] + k + n + ti.static(law.SOFTENS_BELOW)


def test_types_modules_and_constants_are_compiled_anew(running):
    arena, before = FieldArena(), runtime.n_compiled()
    first, longer = (arena.field(f"x{k}", ti.f64, 3 + k, np.arange(3.0 + k)) for k in range(2))
    single = arena.field("y", ti.f32, 4, np.arange(4.0))
    changes = ((first, corotational, 1), (single, corotational, 1), (first, stable_neo_hookean, 1), (first, corotational, 1.0))
    for x, law, n in (*changes, (first, corotational, 2), (longer, corotational, 1)):
        out = np.zeros(3)
        combine(x, law, n, 2.0, np.int64(-7), out)
        assert out.tolist() == [2.0 * k - 7 + n + law.SOFTENS_BELOW for k in range(3)]
    assert runtime.n_compiled() == before + 5  # the longer array needs no other kernel
    combine(single, corotational, 1, 1.0, 0, np.zeros(2, dtype=np.float32))  # another type of array
    assert runtime.n_compiled() == before + 6
    arena.release()


def test_wrong_arguments_are_refused(running):
    arena = FieldArena()
    x, out = arena.field("x", ti.f64, 5), np.zeros(4)
    for _ in range(2):
        combine(x, corotational, 0, 1.0, 1, out)
    for wrong in ((x, corotational, 0, 1.0, 1.5, out), (x, corotational, 0, "3.5", 1, out)):
        with pytest.raises(TypeError):
            combine(*wrong)
    scale(x, 2.0, 1)
    for a, n in ((None, 1), (1.0, 0.5)):
        with pytest.raises(TypeError):
            scale(x, a, n)
    with pytest.raises(ValueError, match="contiguous"):
        combine(x, corotational, 0, 1.0, 1, np.zeros(8)[::2])
    for wrong in ((x, corotational, 0, 1.0, 1), (x, corotational, 0, 1.0, 1, out, out)):
        with pytest.raises(TypeError, match=r"combine\(\) (missing 1 required|takes 6 positional)"):
            combine(*wrong)
    arena.release()


@kernel
def scale(x: ti.template(), a: ti.f64, n: ti.i32):
    for i in x:
        x[i] = a * x[i] + n


@dataclass(frozen=True, eq=False)
class Many:
    """An argument with many arrays."""

    every: tuple


@kernel
def add_all(to: ti.template(), a: ti.f64, n: ti.i32) -> ti.i32:
    ti.loop_config(serialize=True)
    for _ in range(1):
        for x in ti.static(to.every):
            x[1] = x[1] + a * n
    return n - 1


@pytest.mark.parametrize("memory", ["known", "unknown"])
@pytest.mark.filterwarnings("ignore:You are unrolling")
def test_a_pack_takes_any_number_of_arrays(memory, monkeypatch):
    if memory == "unknown":
        monkeypatch.setattr(Arguments, "_memory", lambda self, context: None)
    with opened("f64"):
        arena = FieldArena()
        for size in (0, 1, 70):
            many = Many(tuple(arena.field(f"{size}, {k}", ti.f64, 2) for k in range(size)))
            for a, n in ((0.1, 3), (np.float32(2.5), np.int64(-(2**31) + 1)), (True, False)):
                assert add_all(many, a, n) == n - 1
            total = 0.1 * 3 + 2.5 * (1 - 2**31)
            assert all(x.to_numpy().tolist() == [0.0, total] for x in many.every)
            for name, wrong in {"a": ("x", 1), "n": (1.0, 2**31)}.items():
                with pytest.raises(TypeError, match=f"^add_all: '{name}' must be an? (number|integer of 32 bits), not "):
                    add_all(many, *wrong)
        arena.release()


@kernel
def copy(pair: ti.template()):
    for i in pair[0]:
        pair[1][i] = pair[0][i]


def test_a_launch_keeps_no_tuple(running):
    arena = FieldArena()
    x, y = arena.field("x", ti.f64, 3, np.arange(3.0)), arena.field("y", ti.f64, 3)
    for _ in range(2):
        copy((x, y))
    assert y.to_numpy().tolist() == [0.0, 1.0, 2.0]
    references = [weakref.ref(array) for array in (x, y)]
    arena.release()
    del x, y
    gc.collect()
    assert not any(reference() for reference in references)


def test_a_new_taichi_compiles_anew():
    for _ in range(2):
        with opened("f64"):
            arena, before = FieldArena(), runtime.n_compiled()
            for _ in range(3):
                check(make(arena, 4))
            assert runtime.n_compiled() == before + 1
            arena.release()
        runtime.forget()


def test_index_masks_are_the_largest_that_31_bits_can_address():
    for n, extents in ((0, ()), (2, ()), (3, ()), (12, ()), (0, (9, 4)), (3, (3,))):
        numbers, mask = max(n, 1) * int(np.prod(extents, initial=1)), index_mask(n, extents)
        assert (mask + 1) & mask == 0 and (mask + 1) * numbers <= 2**31 < 2 * (mask + 1) * numbers * 2
