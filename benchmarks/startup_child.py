"""A child process of `taisoft bench startup`; it uses public names only, so that older versions can run it.

python startup_child.py TASK [NUMBER ...] prints one line of JSON: section of the page -> row -> value. Waiting is wall and CPU
seconds.
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
Rows = dict[str, dict]  # section -> row -> value
WAITING, COUNTS, CALLS, CHANGES, SPEED = "Waiting", "Counts", "Launches and accesses by the host", "Changes", "Speed"


# --- scenes -------------------------------------------------------------------------------------------------------------


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


IMPLICIT = {"dt": 2e-3, "integrator": "implicit_euler"}
SCENES = {
    "beam": (beam, {"dt": 2e-4, "integrator": "symplectic_euler"}),
    "cube": (cube, IMPLICIT),
    "plane": (plane, IMPLICIT),
    "sheet": (sheet, IMPLICIT),
}


def simulator(name: str, cells: int) -> ts.Simulator:
    """A new simulator of a scene."""
    build, settings = SCENES[name]
    return ts.Simulator(build(cells), **settings)


def simulate(name: str, cells: int, steps: int = 10, hard: bool = False) -> None:
    """Build a simulator and run its first steps. hard: also compile the kernels of all others."""
    with simulator(name, cells) as sim:
        walk(sim, steps)
        if hard:
            sim.warm_up()


def walk(sim: ts.Simulator, steps: int) -> None:
    """Take `steps` steps; one `advance` may take fewer."""
    last = sim.step_count + steps
    while sim.step_count < last:
        sim.advance(last - sim.step_count)


# --- what is measured of a process ----------------------------------------------------------------------------------------


def timed(what: Callable) -> tuple[float, float]:
    """Wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    what()
    return time.perf_counter() - wall, time.process_time() - cpu


def often(do: Callable, before: Callable = lambda: None) -> float:
    """Median of the milliseconds of nine calls, after one that compiles. before: done each time, not timed."""
    found = []
    for _ in range(10):
        before()
        found.append(1e3 * timed(do)[0])
    return float(np.median(found[1:]))


def compiled() -> float:
    """Number of kernels compiled so far, nan if the version does not count them."""
    try:
        from taisoft.backend.runtime import n_compiled
    except ImportError:
        return float("nan")
    return n_compiled()


def growth(do: Callable, times: int) -> float:
    """Growth of the resident memory of this process [MB], with pages kept for reuse, over `times` calls after two."""

    def resident() -> float:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    for _ in range(2):
        do()
    before = resident()
    for _ in range(times):
        do()
    return resident() - before


# --- tasks --------------------------------------------------------------------------------------------------------------


def first(name: str, cells: int) -> Rows:
    """The tenth step; its caller measures the whole process."""
    simulate(name, cells)
    return {}


def again(name: str, cells: int, larger: int) -> Rows:
    """Times to the tenth step of a first simulator, a second one like it, and one with more cells."""
    waiting, counts = {}, {}
    for label, n in (("first", cells), ("second", cells), ("other size", larger)):
        before = compiled()
        waiting[f"{name}, {label} in one process"] = timed(lambda n=n: simulate(name, n))
        counts[f"{name}: kernels compiled, {label}"] = compiled() - before
    return {WAITING: waiting, COUNTS: counts}


def surfaces(*sizes: int) -> Rows:
    """Kernels that sheets of ascending sizes compile, one after the other in one process."""
    counts = {}
    for cells in sizes:
        before = compiled()
        simulate("sheet", cells, 3, hard=True)
        counts[f"sheet: kernels compiled, {triangles(cells)}"] = compiled() - before
    return {COUNTS: counts}


def grow(name: str, cells: int, times: int) -> Rows:
    """Memory that simulators leave behind."""
    grown = growth(lambda: simulate(name, cells, 3), times)
    return {COUNTS: {f"{name}: growth of resident memory over {times} simulators [MB]": grown}}


def keep(cells: int, times: int) -> Rows:
    """The same of closed simulators of one cube that are still referenced."""
    scene, kept = cube(cells), []

    def closed() -> None:
        with ts.Simulator(scene, **IMPLICIT) as sim:
            sim.advance(1)
        kept.append(sim)

    return {COUNTS: {f"growth of resident memory over {times} kept closed simulators [MB]": growth(closed, times)}}


def statics(cells: int) -> Rows:
    """Three static solves of a beam, and nine for Young's modulus from a sag, by bisection of the logarithm."""

    def sag(young: float) -> float:
        return ts.solve_static(beam(cells, young)).positions()[:, 1].min()

    def search() -> None:
        target, low, high = sag(3e6), 6.0, 7.0
        for _ in range(8):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if sag(10.0**middle) < target else (low, middle)
        assert abs(middle - np.log10(3e6)) < 0.01

    waiting = {f"static solve, {k}": timed(lambda: sag(RUBBER["young"])) for k in ("first", "second", "third")}
    return {WAITING: waiting | {"nine static solves": timed(search)}}


def changes(cells: int) -> Rows:
    """Times of changes to an open simulator, and of a new one."""
    simulate("cube", cells, 2)
    with simulator("cube", cells) as sim:
        walk(sim, 2)
        x, v = sim.positions(), sim.velocities()
        found = {
            "set_gravity": lambda: sim.set_gravity((0.0, -9.8, 0.0)),
            "set_contact": lambda: sim.set_contact("cube", "ground", friction=0.3),
            "set_state": lambda: sim.set_state(x, v),
            "reset": sim.reset,
            "set_material": lambda: sim.set_material("cube", young=2e6),
        }
        found = {what: often(change) for what, change in found.items()}
    return {CHANGES: found | {"a new Simulator": often(lambda: simulator("cube", cells).close())}}


def calls(*cells: int) -> Rows:
    """Means of what the tenth to twentieth step of each scene launches and accesses; empty if the version does not count."""
    try:
        from taisoft.backend.counters import counting
    except ImportError:
        return {}
    found = {}
    for name, n in zip(("beam", "cube", "plane"), cells):
        with simulator(name, n) as sim:
            walk(sim, 10)
            with counting() as counts:
                for _ in range(10):
                    sim.step()
            found |= {f"{name}: {what}": number for what, number in counts.totals(10).items()}
    return {CALLS: found}


def speed(cells: int, *sheets: int) -> Rows:
    """Steps, energies and a force differential of a beam, and searches and contact steps while sheets land.

    A sheet takes only seven steps, the last three with impacts: impacts amplify rounding, and later steps of two versions would
    need different numbers of iterations.
    """
    with ts.Simulator(beam(cells), dt=2e-5, integrator="symplectic_euler") as sim:
        dx = 1e-3 * np.sin(sim.positions())
        found = {
            "symplectic_euler step": often(lambda: walk(sim, 20)) / 20,
            "energies": often(sim.energies),
            "force differential": often(lambda: sim.force_differential(dx)),
        }
    with ts.Simulator(beam(cells), dt=5e-3, integrator="implicit_euler") as sim:
        found["implicit_euler step"] = often(lambda: sim.advance(1))
    for n in sheets:
        with simulator("sheet", n) as sim:
            found[f"contact step, {triangles(n)}"] = often(lambda sim=sim: walk(sim, 7), before=sim.reset) / 7
            assert len(sim.detect_contacts()) >= (n + 1) ** 2
            found[f"search, {triangles(n)}"] = often(sim.detect_contacts)
    return {SPEED: found}


if __name__ == "__main__":
    task = globals()[sys.argv[1]]
    print(json.dumps(task(*(int(word) if word.isdigit() else word for word in sys.argv[2:]))))
