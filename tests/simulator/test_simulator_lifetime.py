"""Lifetime of simulators: closing releases runtime and memory, a closed simulator refuses calls, and several run side by side."""

import gc
import tracemalloc
from collections.abc import Iterator
from itertools import zip_longest

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from tests.dynamics.scenes import SNH, block_scene, rubber


def test_a_deleted_simulator_closes_its_runtime():
    made = ts.Simulator(block_scene(), 1e-3, "symplectic_euler", precision="f64")
    assert runtime.open_kind() == ("cpu", "f64")
    del made
    gc.collect()
    assert runtime.open_kind() is None


def test_a_closed_simulator_refuses_calls():
    sim = ts.Simulator(block_scene(), 1e-3, "symplectic_euler", precision="f64")
    sim.close()
    sim.close()
    calls = (
        sim.step,
        sim.reset,
        sim.positions,
        sim.velocities,
        sim.energies,
        sim.reactions,
        lambda: sim.advance(3),
        lambda: sim.run(1.0),
        lambda: sim.stress("block"),
        lambda: sim.set_state(velocities=np.zeros((8, 3))),
        lambda: sim.set_gravity((0, 0, 0)),
        lambda: sim.set_material("block", young=1e4),
        lambda: sim.time,
        lambda: sim.step_count,
        lambda: sim.force_differential(np.zeros((8, 3))),
        lambda: setattr(sim, "dt", 1e-4),
        lambda: sim.field_bytes,
    )
    for call in calls:
        with pytest.raises(ts.SimulationError, match="^the simulator is closed$"):
            call()


def test_a_closed_simulator_has_released_its_memory():
    def cube_on_ground() -> ts.Simulator:
        scene = ts.Scene(gravity=(0, -9.81, 0))
        scene.add_obstacle(ts.HalfSpace((0, -0.501, 0), (0, 1, 0)))
        scene.add_body(mesh, rubber(SNH))
        made = ts.Simulator(scene, 1e-3, "implicit_euler", precision="f64")
        made.step()
        return made

    mesh = ts.box_mesh((8, 8, 8), (1, 1, 1))
    cube_on_ground().close()  # fills the caches, which stay
    tracemalloc.start()
    try:
        kept = cube_on_ground()
        used = tracemalloc.get_traced_memory()[0]
        kept.close()
        gc.collect()
        assert tracemalloc.get_traced_memory()[0] < 0.2 * used and used > 1e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("integrator", ["symplectic_euler", "bdf2"])
def test_simulators_side_by_side_do_not_affect_each_other(integrator):
    """They share compiled kernels and the pool of lane buffers."""

    def beam(cells: int) -> ts.Simulator:
        scene = ts.Scene(gravity=(0, -9.81, 0))
        made = scene.add_body(ts.box_mesh((2 * cells, cells, cells), (1, 0.5, 0.5)), rubber(SNH))
        made.fix(lambda X: X[:, 0] < -0.49)
        return ts.Simulator(scene, 2e-4, integrator, precision="f64")

    def steps(sim: ts.Simulator) -> Iterator[None]:
        with sim:
            for _ in range(6):
                sim.advance(1)
                yield
            ends.append(sim.positions())

    ends: list[np.ndarray] = []
    for cells in (2, 3):
        list(steps(beam(cells)))
    both = [steps(beam(cells)) for cells in (2, 3)]
    list(zip_longest(*both))
    assert all(np.array_equal(alone, together) for alone, together in zip(ends[:2], ends[2:], strict=True))
