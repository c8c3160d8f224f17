"""A child process of `taisoft bench launches`.

python launches_child.py ARCH [quick] prints one line of JSON: microseconds of launches by the number of arrays, and of steps by
scene, each the median of several stretches.
"""

import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel, open_runtime

ARRAYS = 1, 16, 64, 200
STRETCHES = 15
RUBBER = {"law": "stable_neo_hookean", "young": 1e6, "poisson": 0.3, "density": 1000.0}


@dataclass(frozen=True, eq=False)
class Arrays:
    """An argument that holds arrays."""

    every: tuple


@kernel
def add(to: ti.template(), a: ti.f64, n: ti.i32):
    """Add a + n to the first number of each array."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        for x in ti.static(to.every):
            x[0] = x[0] + a + n


def launches(arch: str, repeats: int) -> dict[str, float]:
    """Microseconds of a launch with one number, one integer and these many arrays."""
    runtime, found, arena = open_runtime(arch, "f64"), {}, FieldArena()
    for n in ARRAYS:
        arrays = Arrays(tuple(arena.field(f"{n}, {k}", ti.f64, 4) for k in range(n)))
        found[str(n)] = often(lambda arrays=arrays: add(arrays, 1.0, 2), repeats)
        assert all(x[0] == 3.0 * (STRETCHES * repeats + repeats) for x in arrays.every)
    arena.release()
    runtime.close()
    return found


def often(do: Callable[[], object], repeats: int) -> float:
    """Median of the microseconds of a call over stretches of `repeats`, after one that compiles."""
    seconds = []
    for _ in range(1 + STRETCHES):
        begin = time.perf_counter()
        for _ in range(repeats):
            do()
        ti.sync()
        seconds.append((time.perf_counter() - begin) / repeats)
    return 1e6 * float(np.median(seconds[1:]))


def add_cube(scene: ts.Scene, cells: int) -> ts.Body:
    """Add a cube of 6 cells^3 tets."""
    return scene.add_body(ts.box_mesh((cells,) * 3, (0.1,) * 3, pattern="six"), ts.Material(**RUBBER), name="cube")


def resting(cells: int) -> ts.Scene:
    """A cube that rests on a half-space."""
    scene = ts.Scene()
    add_cube(scene, cells).position = (0.0, 0.0501, 0.0)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    return scene


def free(cells: int) -> ts.Scene:
    """A cube that swings from one side, without contacts."""
    scene = ts.Scene()
    add_cube(scene, cells).fix(lambda X: X[:, 0] < -0.0499)
    return scene


SCENES = {  # name -> scene, its cells and those of --quick, settings, steps before and in each stretch
    "resting, 384 tets": (resting, 4, 2, {"dt": 2e-3, "integrator": "implicit_euler"}, 100, 20),
    "contact, 3,072 tets": (resting, 8, 3, {"dt": 2e-3, "integrator": "implicit_euler"}, 20, 4),
    "free, 10,368 tets": (free, 12, 3, {"dt": 2e-3, "integrator": "implicit_euler"}, 5, 3),
    "explicit, 384 tets": (free, 4, 2, {"dt": 2e-5, "integrator": "symplectic_euler"}, 10, 20),
}


def steps(name: str, arch: str, quick: bool) -> float:
    """Microseconds of a step."""
    build, cells, few, settings, before, stretch = SCENES[name]
    with warnings.catch_warnings(), ts.Simulator(build(few if quick else cells), arch=arch, **settings) as sim:
        warnings.simplefilter("ignore")
        for _ in range(before):
            sim.step()
        return often(sim.step, stretch)


def measure(arch: str, quick: bool) -> dict:
    """Everything."""
    return {"launches": launches(arch, 100 if quick else 2000), "steps": {name: steps(name, arch, quick) for name in SCENES}}


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], "quick" in sys.argv)))
