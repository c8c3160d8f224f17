"""On the CPU, three processes with the same number of threads give the same bits after every step.

Compared are positions and velocities, contacts with gaps and impulses, and energies, in scenes with elasticity, both kinds of
collision geometry, obstacles and friction.
"""

import hashlib
import json
import os
import subprocess
import sys

import pytest

import taisoft as ts
from tests.cli.command import ROOT
from tests.simulator.checkpoint_scenes import cubes

STEPS = {"cube_implicit": 4, "cube_explicit": 40, "cubes_implicit": 4, "cubes_explicit": 40}


def scene(name: str) -> ts.Scene:
    """One cube on the floor, or falling cubes, two of them with distance fields."""
    made = cubes()
    if name == "cube":
        del made.bodies[1:]
        return made
    for body, method in zip(made.bodies, ("proximity", "distance_field", "distance_field")):
        body.collision = method
    return made


def digests(case: str) -> list[str]:
    """A hash of all results after every step."""
    (name, kind), found = case.split("_"), []
    dt, integrator = (0.005, "implicit_euler") if kind == "implicit" else (0.0005, "symplectic_euler")
    with ts.Simulator(scene(name), dt, integrator, precision="f32") as sim:
        sim.set_state(velocities=sim.velocities() - [0.0, 1.5, 0.0])
        for _ in range(STEPS[case]):
            report, c = sim.step(), sim.contacts()
            arrays = (sim.positions(), sim.velocities(), c.point, c.normal, c.gap, c.impulse, c.nodes, c.weights)
            total = hashlib.sha256(repr((report.kinetic, report.elastic, report.n_contacts, report.contact_iterations)).encode())
            for array in arrays:
                total.update(array.tobytes())
            found.append(f"{report.n_contacts} {total.hexdigest()}")
    return found


@pytest.mark.parametrize("case", STEPS)
def test_three_processes_agree(case):
    command = [sys.executable, __file__, case]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    others = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    try:
        own = digests(case)
        outputs = [other.communicate(timeout=300)[0] for other in others]
    finally:
        for other in others:
            other.kill()
    assert [json.loads(text.splitlines()[-1]) for text in outputs] == [own, own]
    assert len(set(own)) == STEPS[case] and int(own[-1].split()[0]) >= 9


if __name__ == "__main__":
    print(json.dumps(digests(sys.argv[1])))
