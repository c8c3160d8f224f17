"""The process's Taichi runtime:

* it holds one arch and precision at a time; a second kind is refused while one is open, by the name of who holds it;
* after the last one closed any kind may follow, and the same kind is not initialised again;
* a machine without CUDA refuses it with a sentence and goes on with the CPU;
* fields are counted in bytes, named once, released together, and too large ones refused before they are made;
* kernels are counted by name, and their first launch is compile time; a faulty one is told with its file and line.
"""

import numpy as np
import pytest
import taichi as ti
from lanes import opened

from taisoft import runtime
from taisoft.errors import SimulationError
from taisoft.runtime import FieldArena, kernel, open_runtime


@kernel
def add_one(x: ti.template()):
    for i in x:
        x[i] = x[i] + 1.0


def test_one_kind_at_a_time():
    first = open_runtime("cpu", "f32", "the first one")
    second = open_runtime("cpu", "f32", "the second one")
    words = "is open with arch 'cpu' and precision 'f32', .*close it before asking for 'cpu' and 'f64'"
    for holder, claim in (("the first one", first), ("the second one", second)):
        with pytest.raises(SimulationError, match=f"{holder} {words}"):
            open_runtime("cpu", "f64")
        assert runtime.open_kind() == ("cpu", "f32") and ti.cfg.default_fp == ti.f32
        claim.close()
        claim.close()  # twice does no harm
    assert runtime.open_kind() is None
    with opened("f64") as machine:
        assert runtime.open_kind() == ("cpu", "f64") and ti.cfg.default_fp == ti.f64
        assert (machine.np_real, machine.eps) == (np.float64, np.finfo(np.float64).eps)


def test_the_same_kind_is_not_initialised_again(monkeypatch):
    with opened("f64"):
        pass
    monkeypatch.setattr(runtime, "_initialise", lambda *kind: pytest.fail(f"initialised again as {kind}"))
    with opened("f64"), opened("f64"):
        pass


def test_a_foreign_initialisation_is_replaced():
    """Somebody else's ti.init, with the optimisation that miscompiles, does not stay."""
    with opened("f32"):
        pass
    ti.init(arch=ti.cpu, default_fp=ti.f64, log_level=ti.ERROR)
    with opened("f32"):
        assert ti.cfg.default_fp == ti.f32 and not ti.cfg.cfg_optimization and not ti.cfg.fast_math


def has_cuda() -> bool:
    from taichi._lib import core

    return core.with_cuda()


@pytest.mark.skipif(has_cuda(), reason="this machine has CUDA")
def test_cuda_where_there_is_none(capfd):
    with pytest.raises(SimulationError, match="^arch 'cuda' is not to be had on this machine"):
        open_runtime("cuda", "f32")
    assert runtime.open_kind() is None
    with opened("f32"):
        assert ti.cfg.arch == ti.x64 or ti.cfg.arch == ti.arm64


@pytest.mark.parametrize("kind, words", [(("opencl", "f32"), "arch 'opencl' is unknown"), (("cpu", "f16"), "'f16' is unknown")])
def test_unknown_names(kind, words):
    with pytest.raises(SimulationError, match=words):
        open_runtime(*kind)


def test_fields():
    with opened("f64"):
        arena = FieldArena()
        x = arena.field("x", ti.f64, (3, 2), np.arange(6.0).reshape(3, 2))
        v = arena.vectors("v", ti.f32, 5)
        arena.field("count", ti.i32, ())
        assert arena.bytes == {"x": 48, "v": 60, "count": 4}
        assert np.array_equal(x.to_numpy(), np.arange(6.0).reshape(3, 2)) and not v.to_numpy().any()
        with pytest.raises(ValueError, match="'x' is allocated twice"):
            arena.field("x", ti.f64, 1)
        with pytest.raises(SimulationError, match=r"field 'huge' needs 3000000000 entries, more than 2\^31 - 1"):
            arena.vectors("huge", ti.f32, 10**9)
        assert set(arena.bytes) == {"x", "v", "count"}
        arena.release()
        assert not arena.bytes
        arena.field("x", ti.f64, 2)  # the name is free again
        arena.release()


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_data_of_many_fields(precision):
    rng = np.random.default_rng(0)
    with opened(precision) as machine:
        arena, wanted = FieldArena(), {}
        with arena.group():
            for name, dtype, shape in (
                ("a", ti.f64, (7,)), ("b", ti.i32, (4, 3)), ("c", machine.real, (5, 2)), ("d", ti.f64, (2, 3, 4)),
                ("e", ti.i32, (1,)),
            ):  # fmt: skip
                data = rng.integers(-(2**31), 2**31, shape) if dtype == ti.i32 else rng.standard_normal(shape)
                data = data.astype({ti.i32: np.int32, ti.f32: np.float32, ti.f64: np.float64}[dtype])
                wanted[name] = arena.field(name, dtype, shape, data), data
            for n in (2, 3, 12):
                data = rng.standard_normal((6, n)).astype(machine.np_real)
                wanted[f"v{n}"] = arena.vectors(f"v{n}", machine.real, 6, data, n=n), data
            zero = arena.field("zero", ti.f64, 3)
        for name, (field, data) in wanted.items():
            assert np.array_equal(field.to_numpy(), data), name
        assert not zero.to_numpy().any()
        arena.release()


def test_launches_and_compile_time_are_counted():
    with opened("f64"):
        arena = FieldArena()
        x, y = arena.field("x", ti.f64, 2), arena.field("y", ti.f64, 2)
        before, clock = runtime.launches["add_one"], runtime.compile_clock()
        add_one(x)
        first = runtime.compile_clock()
        assert first > clock
        for _ in range(3):
            add_one(x)
        assert runtime.compile_clock() == first and runtime.launches["add_one"] == before + 4
        add_one(y)  # compiled for another field
        assert runtime.compile_clock() > first
        assert x.to_numpy().tolist() == [4.0, 4.0] and y.to_numpy().tolist() == [1.0, 1.0]
        arena.release()


@kernel
def faulty(x: ti.template()):
    for i in x:
        x[i] = unknown_name  # noqa: F821


def test_a_faulty_kernel_is_told_with_file_and_line():
    """Taichi's excerpt of the source is left out, the place is not."""
    with opened("f64"):
        arena = FieldArena()
        x = arena.field("x", ti.f64, 2)
        with pytest.raises(ti.TaichiNameError, match=r'File ".*test_runtime.py", line \d+, in faulty:(.|\n)*unknown_name'):
            faulty(x)
        arena.release()
