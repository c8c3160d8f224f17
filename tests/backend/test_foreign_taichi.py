"""Other uses of Taichi in the process of a simulator. In a child, since an undetected re-initialisation would crash it.

* After a foreign ti.init or ti.reset, each call of an open simulator that needs the device is refused, a run fails with the
  same message, and the simulator can be closed or dropped.
* A new simulator can then be made, of another precision too, whether the old one is open or closed.
* Foreign fields and kernels that share the simulator's Taichi keep working.
"""

import os
import subprocess
import sys

from tests.cli.command import ROOT

SCRIPT = """
import gc
import numpy as np
import pytest
import taichi as ti
import taisoft as ts


@ti.kernel
def double(x: ti.template()):
    for i in x:
        x[i] = 2.0 * x[i]


def simulator(precision, path=None):
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), name="block")
    body.move([0], path or (lambda t: (0, 0, 0)))
    return ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision=precision)


def refused(*calls):
    for call in calls:
        with pytest.raises(ts.SimulationError, match="^Taichi was re-initialised in this process by ti.init or ti.reset, which"):
            call()


def calls(sim):
    return (
        sim.energies, sim.step, sim.positions, sim.velocities, sim.reactions, sim.stress, sim.reset, sim.detect_contacts,
        sim.contacts, sim.elastic_forces, lambda: sim.set_gravity((0, 0, 0)),
        lambda: sim.set_material("block", young=2e5), lambda: sim.set_state(velocities=np.zeros((8, 3))),
        lambda: sim.rebuild(dt=5e-5), lambda: sim.save_checkpoint("never.npz"), sim.deepest_overlap,
    )


first = simulator("f32")
first.step()
ti.init(arch=ti.cpu, log_level=ti.ERROR)
refused(*calls(first))
result = first.run(0.001, fps=None)
assert result.status == "failed" and result.problems[0].startswith("Taichi was re-initialised") and first.step_count == 1
second = simulator("f64")  # another precision, while the first one is open
second.step()
refused(*calls(first))
first.close()
assert second.step().time == 2e-4

x = ti.field(ti.f64, 3)  # a foreign field in the same Taichi
x.fill(1.0)
for k in range(3):
    double(x)
    second.step()
assert x.to_numpy().tolist() == [8.0] * 3 and np.isfinite(second.positions()).all()


def reinitialise(sim, index, report):
    if index == 3:
        ti.init(arch=ti.cpu, log_level=ti.ERROR)


result = second.run(5e-4, on_frame=reinitialise, fps=None)
assert result.status == "failed" and result.steps == 3 and result.problems[-1].startswith("Taichi was re-initialised")
refused(second.step)
del second
gc.collect()

third = simulator("f64", lambda t: ti.reset() or (0, 0, 0) if t > 1.5e-4 else (0, 0, 0))  # in the middle of a step
third.step()
refused(third.step, third.positions, third.step)
with simulator("f64") as fourth:
    third.close()
    result = fourth.run(1e-4, on_frame=lambda sim, index, report: index == 1 and ti.reset(), fps=None)  # after the last step
    assert result.status == "ok" and result.steps == 1
    refused(fourth.step)
print("passed")
"""


def test_a_foreign_taichi_init_is_detected(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.endswith("passed\n"), done.stderr[-3000:]
