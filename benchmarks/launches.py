"""Launches: what a kernel call costs the host by the number of its arrays, and small steps, which consist of such calls.

taisoft bench launches [--arch cuda] [--quick] [--out FILE.json]

A launch hands over one number, one integer and 1 to 200 arrays. Steps: a resting cube of 384 tets and one of 3,072 in implicit
steps with contacts, one of 10,368 in implicit steps without, one of 384 in explicit steps of one sub-step each. A new process
a round, with warm kernels; medians over rounds, with their range. Exit status: 0, or 1 if a limit is not met or a process failed.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel, open_runtime

from .children import in_child
from .document import Limit, begin, table
from .runner import clock, make_parser, parse_options, progress, without_warnings

ROUNDS, QUICK_ROUNDS = 5, 1
LAUNCH = 1.5  # largest time of a launch [us]
ARRAYS = 1, 16, 64, 200
STRETCHES = 15
EDGE = 0.1  # of the cubes [m]


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


def often(do: Callable[[], object], repeats: int) -> float:
    """Median of the microseconds of a call over stretches of `repeats`, after one that compiles."""
    seconds = []
    for _ in range(1 + STRETCHES):
        start = clock()
        for _ in range(repeats):
            do()
        seconds.append((clock() - start) / repeats)
    return 1e6 * float(np.median(seconds[1:]))


def launch_times(arch: str, repeats: int) -> dict[str, float]:
    """Microseconds of a launch with one number, one integer and these many arrays."""
    runtime, found, arena = open_runtime(arch, "f64"), {}, FieldArena()
    for n in ARRAYS:
        arrays = Arrays(tuple(arena.field(f"{n}, {k}", ti.f64, 4) for k in range(n)))
        found[str(n)] = often(lambda arrays=arrays: add(arrays, 1.0, 2), repeats)
        assert all(x[0] == 3.0 * (STRETCHES * repeats + repeats) for x in arrays.every)
    arena.release()
    runtime.close()
    return found


def cube(cells: int, rests: bool) -> ts.Scene:
    """A cube of 6 cells^3 tets that rests on a half-space, or swings from one side, without contacts."""
    scene, rubber = ts.Scene(), ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0)
    height = 0.501 * EDGE if rests else 0.0
    body = scene.add_body(ts.box_mesh((cells,) * 3, (EDGE,) * 3, pattern="six"), rubber, name="cube", position=(0, height, 0))
    if rests:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    else:
        body.fix(lambda X: X[:, 0] < -0.499 * EDGE)
    return scene


IMPLICIT, EXPLICIT = {"dt": 2e-3, "integrator": "implicit_euler"}, {"dt": 2e-5, "integrator": "symplectic_euler"}
SCENES = {  # name -> cells of the cube and those of --quick, whether it rests, settings, steps before and in each stretch
    "resting, 384 tets": (4, 2, True, IMPLICIT, 100, 20),
    "contact, 3,072 tets": (8, 3, True, IMPLICIT, 20, 4),
    "free, 10,368 tets": (12, 3, False, IMPLICIT, 5, 3),
    "explicit, 384 tets": (4, 2, False, EXPLICIT, 10, 20),
}


def step_time(name: str, arch: str, quick: bool) -> float:
    """Microseconds of a step."""
    cells, few, rests, settings, before, stretch = SCENES[name]
    with without_warnings(), ts.Simulator(cube(few if quick else cells, rests), arch=arch, **settings) as sim:
        for _ in range(before):
            sim.step()
        return often(sim.step, stretch)


def measure(arch: str, quick: bool) -> dict:
    """The times of a round."""
    return {
        "launches": launch_times(arch, 100 if quick else 2000),
        "steps": {name: step_time(name, arch, quick) for name in SCENES},
    }


def range_table(rounds: list[dict], part: str, label: str, digits: int) -> str:
    """Median times and their ranges over the rounds, of launches or steps."""

    def cell(name: str) -> str:
        times = [one[part][name] for one in rounds]
        return "{} ({} to {})".format(*(f"{value:,.{digits}f}" for value in (np.median(times), min(times), max(times))))

    return table(rounds[0][part], ((f"<{label}", "{}"), ("us", cell)))


def find_limits(rounds: list[dict]) -> list[Limit]:
    """Limits on launches."""
    middle = {n: float(np.median([one["launches"][n] for one in rounds])) for n in rounds[0]["launches"]}
    return [Limit(f"launch with {n} arrays [us]", us, LAUNCH) for n, us in middle.items()]


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError if a process fails, OutputError if a file cannot be written."""
    parser = make_parser("launches", __doc__)
    parser.add_argument("--quick", action="store_true", help="one round, small scenes, no limit")
    options = parse_options(parser, argv)
    document, numbers = begin("Launches", f"arch {options.arch}")
    rounds = []
    for k in range(QUICK_ROUNDS if options.quick else ROUNDS):
        progress(f"round {k + 1}")
        rounds.append(in_child("launches", measure, options.arch, options.quick))
    document.add("## A launch\n\n" + range_table(rounds, "launches", "arrays", 2))
    document.add("## A step\n\n" + range_table(rounds, "steps", "scene", 0))
    return document.finish(options, numbers | {"rounds": rounds}, [] if options.quick else find_limits(rounds))


if __name__ == "__main__":
    sys.exit(main())
