"""How a run ends with too little memory, NaN or full buffers:

* too little memory: a message with the needed and the available memory, before the first step;
* a number that becomes NaN during a run is found in the same step, and the last good checkpoint stays;
* contact buffers that are too small grow, which is reported, or the run stops.
"""

import re
import sys

import numpy as np
import pytest

import taisoft as ts
from taisoft import simulator
from taisoft.backend import arrays
from taisoft.checkpoint import read_checkpoint
from taisoft.output.files import CheckpointWriter
from tests.cli.command import write
from tests.faults.test_faults import python, small_scene

LIMITED_MEMORY = """
import resource, sys
import taisoft.cli.run
from pathlib import Path
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[1]),) * 2)
sys.exit(taisoft.cli.main(["run", sys.argv[2], "--headless", "--out", sys.argv[3]]))
"""
LARGE_BUFFERS = """
import taisoft as ts


def build():
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((2, 1, 1), (2, 1, 1)), ts.Material(young=1e5), name="part")
    scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    scene.collision = ts.CollisionSettings(initial_capacity=100_000_000)
    return scene
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory in use is read from /proc")
@pytest.mark.parametrize(
    "more, needed",
    [(4 * 10**9, "the array '"), pytest.param(3 * 10**8, "start Taichi: 1073741824 bytes", marks=pytest.mark.long)],
)
def test_too_little_memory(tmp_path, more, needed):
    done = python(LIMITED_MEMORY, more, write(tmp_path / "scene.py", LARGE_BUFFERS), tmp_path / "out")
    assert done.returncode == 2, done.stdout + done.stderr
    found = re.match(
        r"taisoft: .+/scene\.py: not enough memory .*: (\d+) bytes \(.*\) are needed.*, available: (\d+) bytes", done.stderr
    )
    assert found and needed in found[0] and int(found[1]) > int(found[2]) and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "out").exists()


def test_too_little_memory_for_the_fields(monkeypatch):
    monkeypatch.setattr(arrays, "SMALL", 0)
    monkeypatch.setattr(arrays, "available_memory", lambda: 17)
    with pytest.raises(ts.SimulationError, match=r"not enough memory for the array '\w+': .*: 17 bytes"):
        ts.Simulator(small_scene(), 0.01, "symplectic_euler")
    monkeypatch.undo()
    with ts.Simulator(small_scene(), 0.01, "symplectic_euler") as sim:  # the failure leaves nothing allocated
        assert sim.step().converged


@pytest.mark.parametrize(
    "others, integrator",
    [
        ("nothing", "symplectic_euler"),
        ("ground", "symplectic_euler"),
        *(pytest.param(others, "implicit_euler", marks=pytest.mark.long) for others in ("nothing", "ground", "body")),
        pytest.param("body", "symplectic_euler", marks=pytest.mark.long),
    ],
)
def test_nan_during_a_run(tmp_path, monkeypatch, integrator, others):
    """A velocity becomes NaN after step 2; step 3 finds it before contact detection does. `body` is in contact from the start."""
    scene = small_scene()
    if others == "ground":
        scene.add_obstacle(ts.HalfSpace((0, -0.55, 0), (0, 1, 0)))
    if others == "body":
        scene.add_body(scene.bodies[0].mesh, scene.bodies[0].material, name="other", position=(0, 1.0 + 1e-4, 0))
        scene.collision = ts.CollisionSettings("spatial_hash")
    checkpoints, shown = CheckpointWriter(tmp_path, every=0.001), []

    class FaultyDynamics(simulator.Dynamics):
        def advance(self, n):
            if self.state.step_count == 2:
                x, v = self.state.state()
                v[5] = np.nan
                self.state.set_state(x, v)
            return super().advance(n)

    def observe(sim, index, report):
        assert others != "body" or index == 0 or report.n_contacts > 0
        checkpoints.frame(sim, index)
        shown.append(sim.positions())

    monkeypatch.setattr(simulator, "Dynamics", FaultyDynamics)
    with ts.Simulator(scene, 0.001, integrator) as sim:
        result = sim.run(0.01, observe, fps=None)
        assert result.status == "failed" and result.steps == 2 and len(shown) == 3
        assert re.search(r"^step 3: body 'part', node 5: position, velocity or force is no longer finite", result.problems[-1])
        assert np.array_equal(sim.positions(), shown[-1])
        with pytest.raises(ts.SimulationError, match="written of a state that is not finite: body 'part', node 5"):
            checkpoints.write(sim)
    simulation = read_checkpoint(tmp_path / "checkpoint.npz").state["simulation"]
    assert simulation["step_count"] == 2 and np.array_equal(simulation["x"], shown[-1]) and np.isfinite(simulation["v"]).all()


def landed(capacity: int | None, max_capacity: int | None):
    """A plate falls on the ground. Returns the report, the last positions and the buffer growths."""
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((9, 1, 9), (0.9, 0.1, 0.9)), ts.Material(young=1e5), name="plate", position=(0, 0.08, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    scene.collision = ts.CollisionSettings(initial_capacity=capacity, max_capacity=max_capacity)
    with ts.Simulator(scene, 0.002, "symplectic_euler") as sim:
        result = sim.run(0.1, fps=100)
        return result, sim.positions(), sim.buffer_growths


def test_a_full_buffer_that_may_not_grow_stops_the_run():
    """In the last good state."""
    result, x, growths = landed(64, 65)
    assert result.status == "failed" and 1 < result.steps < 50 and np.isfinite(x).all() and growths == {}
    assert re.search(r"^step \d+: contacts: \d+ entries are needed .* max_capacity allows 65$", result.problems[-1])


@pytest.mark.long
def test_growing_buffers_do_not_change_the_result():
    (result, x, growths), (_, enough, none) = landed(64, None), landed(None, None)
    assert result.step_reports[-1].n_contacts > 65 and result.step_reports[0].n_contacts == 0
    assert growths == {"contacts": 1} and none == {} and np.array_equal(x, enough)
