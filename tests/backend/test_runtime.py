"""The Taichi runtime of a process:

* it has one arch and precision at a time; others are refused while it is open, with the name of its user;
* after the last close any kind can be opened, and the same kind is not initialised again;
* without CUDA, arch 'cuda' is refused, and the CPU still works;
* functions that the compiler knows as such are compiled anew, too;
* the lock of a killed process does not keep kernels from being stored, and that of a running one stays;
* a first launch counts as compile time; errors of a kernel name file, line and function;
* contact problems have the same solution with any runtime open, which stays open.
"""

import inspect
import os
import time

import numpy as np
import pytest
import taichi as ti
from taichi._lib import core

import taisoft as ts
from taisoft.backend import runtime, tracing
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import compiled_function, kernel, open_runtime
from taisoft.errors import SimulationError
from tests.backend.lanes import opened
from tests.contact import contact_oracle as oracle
from tests.contact.contact_rig import N_NODES


@kernel
def add_one(x: ti.template()):
    for i in x:
        x[i] = x[i] + 1.0


def test_only_one_kind_is_open_at_a_time():
    first = open_runtime("cpu", "f32", "the first one")
    second = open_runtime("cpu", "f32", "the second one")
    message = "is open with arch 'cpu' and precision 'f32', .*close it before requesting 'cpu' and 'f64'"
    for holder, claim in (("the first one", first), ("the second one", second)):
        with pytest.raises(SimulationError, match=f"{holder} {message}"):
            open_runtime("cpu", "f64")
        assert runtime.open_kind() == ("cpu", "f32") and ti.cfg.default_fp == ti.f32
        claim.close()
        claim.close()  # closing twice is allowed
    assert runtime.open_kind() is None
    with opened("f64") as machine:
        assert runtime.open_kind() == ("cpu", "f64") and ti.cfg.default_fp == ti.f64
        assert (machine.np_real, machine.eps) == (np.float64, np.finfo(np.float64).eps)


def test_the_same_kind_is_not_initialised_again(monkeypatch):
    with opened("f64"):
        monkeypatch.setattr(ti, "init", lambda **options: pytest.fail("initialised again"))
    with opened("f64"), opened("f64"):
        pass


@compiled_function(7)
def put(out: ti.types.ndarray(dtype=ti.f32, ndim=1), value: ti.f32):
    out[0] = value


@kernel
def put_twice(x: ti.template(), y: ti.template()):
    ti.loop_config(serialize=True)
    for _ in range(1):
        put(x, 1.0)
        put(y, 2.0)


def test_compiled_functions_are_compiled_for_each_taichi():
    for precision in ("f32", "f64", "f32", "f64"):
        with opened(precision):
            arena = FieldArena()
            x, y = arena.field("x", ti.f32, 2), arena.field("y", ti.f32, 3)
            put_twice(x, y)
            assert (x[0], y[0]) == (1.0, 2.0)
            arena.release()
        runtime.forget()


def test_an_interrupted_compiled_function_is_compiled_by_the_next_launch(monkeypatch):
    original, interrupted = tracing.transform_tree, []

    def interrupt(tree, context):
        if context.is_real_function and not interrupted:
            interrupted.append(context)
            raise KeyboardInterrupt
        return original(tree, context)

    runtime.forget()
    with opened("f64"):
        arena = FieldArena()
        x, y = arena.field("x", ti.f32, 2), arena.field("y", ti.f32, 3)
        monkeypatch.setattr(tracing, "transform_tree", interrupt)
        with pytest.raises(KeyboardInterrupt):
            put_twice(x, y)
        put_twice(x, y)
        assert interrupted and (x[0], y[0]) == (1.0, 2.0)
        arena.release()
    runtime.forget()


def test_only_an_old_lock_is_removed(tmp_path):
    lock = tmp_path / "ticache.lock"
    runtime.remove_stale_lock(tmp_path)
    for age, stays in ((0.0, True), (2.0 * runtime.LOCK_SECONDS, False)):
        lock.touch()
        os.utime(lock, (time.time() - age,) * 2)
        runtime.remove_stale_lock(tmp_path)
        assert lock.exists() == stays


def test_an_initialisation_from_outside_is_replaced():
    """By ti.init, with the optimisation that miscompiles."""
    with opened("f32"):
        pass
    ti.init(arch=ti.cpu, default_fp=ti.f64, log_level=ti.ERROR)
    with opened("f32"):
        assert ti.cfg.default_fp == ti.f32 and not ti.cfg.cfg_optimization and not ti.cfg.fast_math


def test_unknown_and_absent_kinds_are_refused():
    kinds = {("opencl", "f32"): "arch 'opencl' is unknown", ("cpu", "f16"): "precision 'f16' is unknown"}
    if not core.with_cuda():
        kinds["cuda", "f32"] = "^arch 'cuda' is not available on this machine"
    for kind, message in kinds.items():
        with pytest.raises(SimulationError, match=message):
            open_runtime(*kind)
        assert runtime.open_kind() is None
    with opened("f32"):
        assert ti.cfg.arch in (ti.x64, ti.arm64)


def test_compile_time_is_counted():
    with opened("f64"):
        arena = FieldArena()
        x, y = arena.field("x", ti.f64, 2), arena.field("y", ti.f64, 2)
        clock = runtime.compile_clock()
        add_one(x)
        first = runtime.compile_clock()
        assert first > clock
        for _ in range(3):
            add_one(x)
        assert runtime.compile_clock() == first
        compiled = runtime.n_compiled()
        add_one(y)  # a field of the same type
        assert runtime.compile_clock() == first and runtime.n_compiled() == compiled
        assert x.to_numpy().tolist() == [4.0, 4.0] and y.to_numpy().tolist() == [1.0, 1.0]
        arena.release()


@ti.func
def element(x: ti.template(), i: ti.template()):
    return x[i]


@kernel
def faulty(x: ti.template(), fails: ti.template()):
    for i in x:
        x[i] = element(x, i)
        if ti.static(fails):
            x[i] = element(x, "no index")
        x[i] += element(x, i)


def test_errors_of_a_kernel_name_file_line_and_function():
    """Taichi's excerpt of the source is left out. Another kernel can call the function afterwards."""
    with opened("f64"):
        arena = FieldArena()
        x = arena.field("x", ti.f64, 2, np.array([1.0, 2.0]))
        with pytest.raises(ti.TaichiCompilationError) as caught:
            faulty(x, True)
        line = inspect.getsourcelines(element)[1] + 2
        assert f'File "{__file__}", line {line}, in element:' in str(caught.value)
        faulty(x, False)
        assert x.to_numpy().tolist() == [2.0, 4.0]
        arena.release()


def test_contact_problems_are_solved_alike_in_any_open_runtime():
    """In f64, in f32, and without one: the same bits, and an open runtime stays open."""
    made, found = oracle.random_contacts(5, 20, N_NODES), []

    def solve_once(kind) -> None:
        found.append(ts.solve_contact_problem(made.W, made.b, made.friction, tolerance=1e-12))
        assert runtime.open_kind() == kind

    for precision in ("f64", "f32"):
        with opened(precision):
            solve_once(("cpu", precision))
    solve_once(None)
    assert all(f.converged and np.array_equal(f.impulse, found[0].impulse) for f in found)
    assert all(f.residual_history == found[0].residual_history for f in found)
