"""Counts of launches and of accesses by the host:

* the counts of a kernel are exact, through both launches, also in nested contexts; a second simulator compiles nothing;
* device_only refuses each kind of access on the CPU too, lets the state be restored, and no error is lost that something catches;
* after a context, with or without an error, nothing is counted or refused.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend import arrays, launching, runtime
from taisoft.backend.arrays import Array, FieldArena
from taisoft.backend.compiled import Compiled
from taisoft.backend.counters import ACCESSES, counting, device_only
from taisoft.backend.runtime import kernel
from tests.backend.lanes import opened
from tests.dynamics.scenes import SNH, cube, rubber


@kernel
def add(pair: ti.template(), scale: ti.f64, out: ti.types.ndarray()) -> ti.f64:
    for i in pair[0]:
        pair[0][i] += scale * pair[1][i]
        out[i] = pair[0][i]
    return 1.0


@kernel
def double(x: ti.template()):
    for i in x:
        x[i] *= 2.0


@pytest.fixture(params=["pack", "flat", "public"])
def arena(request, monkeypatch):
    """An arena with each way to launch."""
    monkeypatch.setattr(launching, "PUBLIC", request.param == "public")
    monkeypatch.setattr(launching, "PACK", str(int(request.param == "pack")))
    runtime.forget()  # kernels compiled for another way
    with opened("f64"):
        arena = FieldArena()
        yield arena
        arena.release()
    runtime.forget()


def watched() -> list:
    """What counters replace."""
    return [vars(owner)[name] for owner, name in ((Compiled, "launch"), (Compiled, "__init__"), *((Array, n) for n in ACCESSES))]


def test_counts_are_exact_and_nest(arena):
    before, data = watched(), np.arange(3, dtype=np.float64)
    with counting() as whole:
        x, y = arena.field("x", ti.f64, 3, data), arena.field("y", ti.f64, 3)
        with counting() as inner:
            for _ in range(2):
                add((x, y), 2.0, data)
            double(x)
        x[0] = 4.0
        assert x[0] == x.host[0] == x.to_numpy(1)[0] == 4.0
        arrays.upload([(y, data), (x, data)])
        arrays.download([y])
        y.fill(0.0)
        with pytest.raises(TypeError, match="takes 1 positional argument but 2"):
            double(x, y)
    assert inner.launches == {"add": 2, "double": 1} and inner.arrays == {"add": 4, "double": 1} and not inner.accesses
    assert inner.host_arrays == inner.returned == {"add": 2, "double": 0} and inner.compiled == {"add": 1, "double": 1}
    accesses = {"reads": 1, "writes": 1, "downloads": 2, "uploads": 3, "direct accesses": 1, "fills": 1}
    assert (whole.launches, whole.arrays, whole.accesses) == (inner.launches, inner.arrays, accesses)
    assert whole.totals(2)["uploads"] == 1.5 and whole.totals()["array arguments"] == 5
    assert "3 uploads" in whole.table() and "2 add: 4 arrays, 2 host arrays, 2 returned" in whole.table(most=1)
    double(x)
    assert watched() == before and x[0] == 0.0 and whole.launches["double"] == 1


REFUSED = {
    "the host accesses the array 'x' .reads": lambda x: x[0],
    "the host accesses the array 'x' .writes": lambda x: x.__setitem__(0, 9.0),
    "the host accesses the array 'x' .downloads": lambda x: arrays.download([x]),
    "the host accesses the array 'x' .uploads": lambda x: arrays.upload([(x, np.full(2, 9.0))]),
    "the host accesses the array 'x' .direct": lambda x: x.host,
    "the kernel 'add' returns a value": lambda x: add((x, x), 9.0, np.zeros(2)),
    "the kernel 'read' takes a NumPy array": lambda x: read(x, np.zeros(2)),
}


@kernel
def read(x: ti.template(), out: ti.types.ndarray()):
    for i in x:
        out[i] = x[i]


def test_what_device_only_refuses_changes_nothing(arena):
    before, x = watched(), arena.field("x", ti.f64, 2, np.ones(2))
    for message, access in REFUSED.items():
        with pytest.raises(ts.SimulationError, match=f"^{message}.*where only the device may work$"), device_only():
            x.fill(1.0)  # by the device
            double(x)
            access(x)
        assert watched() == before and x.to_numpy().tolist() == [2.0, 2.0]
    with pytest.raises(ts.SimulationError, match="reads"), device_only():
        with pytest.raises(ts.SimulationError, match="reads"):
            x[0]
        x[0] = 3.0  # what undoes a step may


def test_a_second_simulator_compiles_nothing_and_a_refused_step_can_be_repeated():
    def take_step(refused: bool) -> np.ndarray:
        scene = ts.Scene()
        scene.add_body(cube(), rubber(SNH), name="box").fix([0])
        with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler", precision="f64") as sim:
            if refused:
                with pytest.raises(ts.SimulationError, match="where only the device may work"), device_only():
                    sim.step()
            sim.step()
            return sim.positions()

    first = take_step(refused=True)
    with counting() as counts:
        assert np.array_equal(take_step(refused=False), first)
    assert not counts.compiled and counts.launches.total() > 0
