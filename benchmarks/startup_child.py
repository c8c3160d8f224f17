"""What a process of `taisoft bench startup` does and measures: it uses public names alone, so that older versions run it too.

python startup_child.py TASK [NUMBER ...]; prints one line of JSON. Times are of this process, in seconds.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import taisoft as ts

RUBBER = {"law": "stable_neo_hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0}


def beam(cells: int) -> ts.Scene:
    """A beam clamped at one end: 4 cells x cells x cells cells."""
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((4 * cells, cells, cells), (1.2, 0.3, 0.3)), ts.Material(**RUBBER), name="beam")
    bar.fix(lambda X: X[:, 0] < -0.599)
    return scene


def cube(cells: int) -> ts.Scene:
    """A cube that falls onto a box."""
    scene = ts.Scene()
    mesh = ts.box_mesh((cells, cells, cells), (0.1, 0.1, 0.1))
    scene.add_body(mesh, ts.Material(**RUBBER), name="cube", position=(0.0, 0.0505, 0.0))
    ground = ts.box_mesh((2, 1, 2), (0.4, 0.05, 0.4))
    scene.add_body(ground, ts.Material(**RUBBER), name="ground", position=(0.0, -0.025, 0.0)).fix(lambda X: X[:, 1] < 0.0)
    return scene


SCENES = {
    "beam": (beam, {"dt": 2e-4, "integrator": "symplectic_euler"}),
    "cube": (cube, {"dt": 2e-3, "integrator": "implicit_euler"}),
}


def timed(what: Callable) -> dict[str, float]:
    """Wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    what()
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def compiled() -> int | None:
    """How many kernels have been compiled so far, None where the version cannot tell."""
    try:
        from taisoft.runtime import n_compiled
    except ImportError:
        return None
    return n_compiled()


def memory() -> float:
    """Resident memory [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def simulate(name: str, cells: int, steps: int = 10) -> None:
    """A simulator, and its first steps."""
    build, settings = SCENES[name]
    with ts.Simulator(build(cells), **settings) as sim:
        sim.advance(steps)


def first(name: str, cells: int) -> dict:
    """From here to the tenth step."""
    return timed(lambda: simulate(name, cells))


def again(name: str, cells: int, larger: int) -> dict:
    """The first simulator, a second one like it, and one with more cells, each to its tenth step."""
    found = {}
    for label, n in (("first", cells), ("second", cells), ("other size", larger)):
        before = compiled()
        found[label] = timed(lambda n=n: simulate(name, n))
        found[label]["compiled"] = None if before is None else compiled() - before
    return found


def grow(name: str, cells: int, times: int) -> dict:
    """Memory after the second of some simulators, and after the last."""
    simulate(name, cells, 3)
    simulate(name, cells, 3)
    start = memory()
    for _ in range(times):
        simulate(name, cells, 3)
    return {"start": start, "end": memory()}


def statics(cells: int) -> dict:
    """Three static solves of a beam."""
    return {str(k): timed(lambda: ts.solve_static(beam(cells))) for k in range(3)}


def identify(cells: int) -> dict:
    """Young's modulus from a sag: nine static solves, by bisection of the logarithm."""
    def sag(young: float) -> float:
        scene = ts.Scene()
        material = ts.Material(**(RUBBER | {"young": young}))
        scene.add_body(ts.box_mesh((4 * cells, cells, cells), (1.2, 0.3, 0.3)), material, name="beam").fix(
            lambda X: X[:, 0] < -0.599
        )
        return ts.solve_static(scene).positions()[:, 1].min()

    def search() -> None:
        wanted, low, high = sag(3e6), 6.0, 7.0
        for _ in range(8):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if sag(10.0**middle) < wanted else (low, middle)
        assert abs(middle - np.log10(3e6)) < 0.01

    return timed(search)


def settings(cells: int) -> dict:
    """What changes of an open simulator cost, medians, and a new simulator beside them."""
    name = "cube"
    build, arguments = SCENES[name]
    simulate(name, cells, 2)
    with ts.Simulator(build(cells), **arguments) as sim:
        sim.advance(2)
        x, v = sim.positions(), sim.velocities()
        changes = {
            "set_gravity": lambda: sim.set_gravity((0.0, -9.8, 0.0)),
            "set_contact": lambda: sim.set_contact("cube", "ground", friction=0.3),
            "set_state": lambda: sim.set_state(x, v),
            "reset": sim.reset,
            "set_material": lambda: sim.set_material("cube", young=2e6),
        }
        found = {what: float(np.median([timed(change)["wall"] for _ in range(9)])) for what, change in changes.items()}
    return found | {"a new Simulator": timed(lambda: ts.Simulator(build(cells), **arguments).close())["wall"]}


def speed(cells: int) -> dict:
    """Seconds of an explicit step, an implicit one, and one measurement of energies of a beam: medians."""
    def median(do: Callable) -> float:
        do()
        return float(np.median([timed(do)["wall"] for _ in range(9)]))

    steps = 20
    with ts.Simulator(beam(cells), dt=2e-5, integrator="symplectic_euler") as sim:
        found = {"symplectic_euler step": median(lambda: sim.advance(steps)) / steps, "energies": median(sim.energies)}
    with ts.Simulator(beam(cells), dt=5e-3, integrator="implicit_euler") as sim:
        return found | {"implicit_euler step": median(lambda: sim.advance(1))}


TASKS = {
    "first": first, "again": again, "grow": grow, "statics": statics, "identify": identify, "settings": settings, "speed": speed,
}  # fmt: skip

if __name__ == "__main__":
    arguments = [int(word) if word.isdigit() else word for word in sys.argv[2:]]
    print(json.dumps(TASKS[sys.argv[1]](*arguments)))
