"""On the CPU the same run gives the same bits: in three processes, with the same number of threads.

What is compared after every step is what each layer makes: positions and velocities, every contact found with its gap, the
impulses, the energies; of a scene with elasticity, both kinds of collision geometry, obstacles and friction.
"""

import hashlib
import json
import os
import subprocess
import sys

import pytest
from checkpoint_scenes import cubes
from command import ROOT

import taisoft as ts

STEPS = {"cube_implicit": 4, "cube_explicit": 40, "cubes_implicit": 4, "cubes_explicit": 40}


def scene(name: str) -> ts.Scene:
    """One cube on the floor; or cubes that fall on it and on one another, two hit by distance fields, one by proximity."""
    made = cubes()
    if name == "cube":
        del made.bodies[1:]
        return made
    for body, way in zip(made.bodies, ("proximity", "distance_field", "distance_field")):
        body.collision = way
    return made


def digests(case: str) -> list[str]:
    """After every step, of all that it made."""
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
def test_three_runs(case):
    command = [sys.executable, __file__, case]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    others = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    try:
        own = digests(case)
        told = [other.communicate(timeout=300)[0] for other in others]
    finally:
        for other in others:
            other.kill()
    assert [json.loads(text.splitlines()[-1]) for text in told] == [own, own]
    assert len(set(own)) == STEPS[case] and int(own[-1].split()[0]) >= 9


if __name__ == "__main__":
    print(json.dumps(digests(sys.argv[1])))
