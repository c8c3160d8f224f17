"""Taichi used by others in the process of a simulator, which ends the process where it is not seen, so in a process of its own:

* after another ti.init or ti.reset, wherever it comes, each call of an open simulator that needs the device is refused with a
  sentence, a run tells it as its failure, and the simulator can be closed or dropped;
* a new simulator can be made then, of another kind too, with the old one open or closed, and does not mind the old one;
* fields and kernels of others that share the simulator's Taichi go on beside it.
"""

import os
import subprocess
import sys

from command import ROOT

SCRIPT = """
import gc
import numpy as np
import taichi as ti
import taisoft as ts


@ti.kernel
def double(x: ti.template()):
    for i in x:
        x[i] = 2.0 * x[i]


def made(precision, path=None):
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), name="block")
    body.move([0], path or (lambda t: (0, 0, 0)))
    body.add_force([6], (1, 0, 0))
    return ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision=precision)


def refused(*calls):
    for call in calls:
        try:
            call()
        except ts.SimulationError as error:
            assert str(error).startswith("Taichi was re-initialised in this process by ti.init or ti.reset, which"), error
        else:
            raise AssertionError("not refused")


def calls(sim):
    return (
        sim.energies, sim.step, sim.positions, sim.velocities, sim.reactions, sim.stress, sim.reset, sim.detect_contacts,
        sim.contacts, sim.elastic_forces, lambda: sim.set_gravity((0, 0, 0)), lambda: sim.set_force("block", 0, (0, 0, 0)),
        lambda: sim.set_material("block", young=2e5), lambda: sim.set_state(velocities=np.zeros((8, 3))),
        lambda: sim.rebuild(dt=5e-5), lambda: sim.save_checkpoint("never.npz"), sim.deepest_overlap,
    )


first = made("f32")
first.step()
ti.init(arch=ti.cpu, log_level=ti.ERROR)
refused(*calls(first))
result = first.run(0.001, fps=None)
assert result.status == "failed" and result.problems[0].startswith("Taichi was re-initialised") and first.step_count == 1
second = made("f64")  # of another kind, while the first one is open
second.step()
refused(*calls(first))
first.close()
first.close()
assert second.step().time == 2e-4

x = ti.field(ti.f64, 3)  # another's, in the same Taichi
x.fill(1.0)
for k in range(3):
    double(x)
    second.step()
assert x.to_numpy().tolist() == [8.0] * 3 and np.isfinite(second.positions()).all()


def greedy(sim, index, report):
    if index == 3:
        ti.init(arch=ti.cpu, log_level=ti.ERROR)


result = second.run(5e-4, on_frame=greedy, fps=None)
assert result.status == "failed" and result.steps == 3 and result.problems[-1].startswith("Taichi was re-initialised")
refused(second.step)
del second
gc.collect()

third = made("f64", lambda t: ti.reset() or (0, 0, 0) if t > 1.5e-4 else (0, 0, 0))  # in the middle of a step
third.step()
refused(third.step, third.positions, third.step)
with made("f64") as fourth:
    fourth.step()
    third.close()
    assert fourth.step().time == 2e-4
    result = fourth.run(1e-4, on_frame=lambda sim, index, report: index == 1 and ti.reset(), fps=None)  # after the last step
    assert result.status == "ok" and result.steps == 1
    refused(fourth.step)
print("through")
"""


def test_taichi_of_others(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.endswith("through\n"), done.stderr[-3000:]
