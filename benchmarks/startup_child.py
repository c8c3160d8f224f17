"""A child process of `taisoft bench startup`; it uses public names only, so that older versions can run it.

python startup_child.py TASK [NUMBER ...] prints one line of JSON. Times are seconds of this process.
"""

import gc
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import taisoft as ts

RUBBER = {"law": "stable_neo_hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0}


def beam(cells: int, young: float = RUBBER["young"]) -> ts.Scene:
    """A beam clamped at one end: 4 cells x cells x cells cells."""
    scene = ts.Scene()
    material = ts.Material(**(RUBBER | {"young": young}))
    bar = scene.add_body(ts.box_mesh((4 * cells, cells, cells), (1.2, 0.3, 0.3)), material, name="beam")
    bar.fix(lambda X: X[:, 0] < -0.599)
    return scene


def cube(cells: int) -> ts.Scene:
    """A cube that falls onto a block."""
    return on_block("cube", (cells, cells, cells), (0.1, 0.1, 0.1))


def plane(cells: int) -> ts.Scene:
    """A cube that falls onto a half-space."""
    scene = ts.Scene()
    mesh = ts.box_mesh((cells, cells, cells), (0.1, 0.1, 0.1))
    scene.add_body(mesh, ts.Material(**RUBBER), name="cube", position=(0.0, 0.0502, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    return scene


def sheet(cells: int) -> ts.Scene:
    """A thick sheet that falls onto a block: cells x 1 x cells cells."""
    return on_block("sheet", (cells, 1, cells), (0.3, 0.02, 0.3))


def on_block(name: str, cells: tuple[int, int, int], size: tuple[float, float, float]) -> ts.Scene:
    """A box 0.5 mm above a block that is held."""
    scene = ts.Scene()
    scene.add_body(ts.box_mesh(cells, size), ts.Material(**RUBBER), name=name, position=(0.0, 0.5 * size[1] + 5e-4, 0.0))
    ground = ts.box_mesh((2, 1, 2), (0.4, 0.05, 0.4))
    scene.add_body(ground, ts.Material(**RUBBER), name="ground", position=(0.0, -0.025, 0.0)).fix(lambda X: X[:, 1] < 0.0)
    return scene


def triangles(cells: int) -> str:
    """The size of both surfaces of `sheet`."""
    return f"{4 * cells * (cells + 2) + 32:,} triangles"


SCENES = {
    "beam": (beam, {"dt": 2e-4, "integrator": "symplectic_euler"}),
    "cube": (cube, {"dt": 2e-3, "integrator": "implicit_euler"}),
    "plane": (plane, {"dt": 2e-3, "integrator": "implicit_euler"}),
    "sheet": (sheet, {"dt": 2e-3, "integrator": "implicit_euler"}),
}


def timed(what: Callable) -> dict[str, float]:
    """Wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    what()
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def compiled() -> int | None:
    """Number of kernels compiled so far, None if the version does not count them."""
    try:
        from taisoft.backend.runtime import n_compiled
    except ImportError:
        return None
    return n_compiled()


def memory() -> float:
    """Resident memory of this process [MB] after garbage collection, including pages kept for reuse."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def simulate(name: str, cells: int, steps: int = 10, hard: bool = False) -> None:
    """Build a simulator and run its first steps. hard: also compile the kernels of steps that are hard to solve."""
    build, settings = SCENES[name]
    with ts.Simulator(build(cells), **settings) as sim:
        walk(sim, steps)
        if hard and hasattr(sim._dynamics.stepper, "compile_hard_steps"):
            sim._dynamics.stepper.compile_hard_steps()


def walk(sim: ts.Simulator, steps: int) -> None:
    """Take `steps` steps; one `advance` may take fewer."""
    last = sim.step_count + steps
    while sim.step_count < last:
        sim.advance(last - sim.step_count)


def first(name: str, cells: int) -> dict:
    """Time to the tenth step."""
    return timed(lambda: simulate(name, cells))


def again(name: str, cells: int, larger: int) -> dict:
    """Times to the tenth step of a first simulator, a second one like it, and one with more cells."""
    found = {}
    for label, n in (("first", cells), ("second", cells), ("other size", larger)):
        before = compiled()
        found[label] = timed(lambda n=n: simulate(name, n))
        found[label]["compiled"] = since(before)
    return found


def since(before: int | None) -> int | None:
    """Kernels compiled since `compiled` returned `before`."""
    return None if before is None else compiled() - before


def surfaces(*sizes: int) -> dict:
    """Kernels that sheets of ascending sizes compile, one after the other in one process."""
    found = {}
    for cells in sizes:
        before = compiled()
        if before is not None:
            simulate("sheet", cells, 3, hard=True)
        found[triangles(cells)] = since(before)
    return found


def grow(name: str, cells: int, times: int) -> dict:
    """Memory after the second of some simulators, and after the last. times: simulators between."""
    simulate(name, cells, 3)
    simulate(name, cells, 3)
    start = memory()
    for _ in range(times):
        simulate(name, cells, 3)
    return {"start": start, "end": memory(), "times": times}


def keep(cells: int, times: int) -> dict:
    """The same for closed simulators of one cube that are still referenced."""
    build, arguments = SCENES["cube"]
    scene, kept, start = build(cells), [], 0.0
    for _ in range(2 + times):
        if len(kept) == 2:
            start = memory()
        with ts.Simulator(scene, **arguments) as sim:
            sim.advance(1)
        kept.append(sim)
    return {"start": start, "end": memory(), "times": times}


def statics(cells: int) -> dict:
    """Three static solves of a beam."""
    return {str(k): timed(lambda: ts.solve_static(beam(cells))) for k in range(3)}


def identify(cells: int) -> dict:
    """Young's modulus from a sag: nine static solves, by bisection of the logarithm."""

    def sag(young: float) -> float:
        return ts.solve_static(beam(cells, young)).positions()[:, 1].min()

    def search() -> None:
        target, low, high = sag(3e6), 6.0, 7.0
        for _ in range(8):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if sag(10.0**middle) < target else (low, middle)
        assert abs(middle - np.log10(3e6)) < 0.01

    return timed(search)


def settings(cells: int) -> dict:
    """Median times of changes to an open simulator, and the time of a new simulator."""
    name = "cube"
    build, arguments = SCENES[name]
    simulate(name, cells, 2)
    with ts.Simulator(build(cells), **arguments) as sim:
        walk(sim, 2)
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


def calls(*cells: int) -> dict:
    """Means of what the tenth to twentieth step of each scene launches and accesses; empty if the version does not count."""
    try:
        from taisoft.backend.counters import counting
    except ImportError:
        return {}
    found = {}
    for name, n in zip(("beam", "cube", "plane"), cells):
        build, arguments = SCENES[name]
        with ts.Simulator(build(n), **arguments) as sim:
            walk(sim, 10)
            with counting() as counts:
                for _ in range(10):
                    sim.step()
            found[name] = counts.totals(10)
    return found


def speed(cells: int, small: int, large: int) -> dict:
    """Median seconds of steps, energies and a force differential of a beam, and of searches and contact steps of two sheets."""
    steps = 20
    with ts.Simulator(beam(cells), dt=2e-5, integrator="symplectic_euler") as sim:
        dx = 1e-3 * np.sin(sim.positions())
        found = {
            "symplectic_euler step": often(lambda: walk(sim, steps)) / steps,
            "energies": often(sim.energies),
            "force differential": often(lambda: sim.force_differential(dx)),
        }
    with ts.Simulator(beam(cells), dt=5e-3, integrator="implicit_euler") as sim:
        found["implicit_euler step"] = often(lambda: sim.advance(1))
    return found | landing(small) | landing(large)


def landing(cells: int) -> dict[str, float]:
    """Seconds of a search for contacts, and of a step while a sheet lands.

    Only seven steps, the last three with impacts: impacts amplify rounding, and later steps of two versions would need different
    numbers of iterations.
    """
    steps = 7
    build, arguments = SCENES["sheet"]
    with ts.Simulator(build(cells), **arguments) as sim:
        seconds = often(lambda: walk(sim, steps), before=sim.reset) / steps
        assert len(sim.detect_contacts()) >= (cells + 1) ** 2
        return {f"search, {triangles(cells)}": often(sim.detect_contacts), f"contact step, {triangles(cells)}": seconds}


def often(do: Callable, before: Callable = lambda: None) -> float:
    """Median of the seconds of nine calls, after one that compiles. before: done each time, not timed."""
    seconds = []
    for _ in range(10):
        before()
        seconds.append(timed(do)["wall"])
    return float(np.median(seconds[1:]))


TASKS = {
    "first": first,
    "again": again,
    "surfaces": surfaces,
    "grow": grow,
    "keep": keep,
    "statics": statics,
    "identify": identify,
    "settings": settings,
    "calls": calls,
    "speed": speed,
}

if __name__ == "__main__":
    arguments = [int(word) if word.isdigit() else word for word in sys.argv[2:]]
    print(json.dumps(TASKS[sys.argv[1]](*arguments)))
