"""What a step without a window spends, by kind: one more run, in which each launch is timed.

A kernel has the kind of its module, and so have the functions of the host in DENSE, which do dense algebra; all else is "host".
"launches" is their number times the duration of an empty one, which is taken off the kinds of the kernels; what watching adds to
an empty one is taken off "host". So the kinds add up to a step that is not watched, but for noise.
Weakness: a module has one kind. Searches for the paths of a step are "search", the host's part in paths and friction is "host".
"""

from collections.abc import Callable
from functools import cache
from statistics import median
from time import perf_counter

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.counters import intercepted
from taisoft.backend.launching import Kernels
from taisoft.backend.runtime import kernel
from taisoft.contact.matrix_contacts import MatrixContacts
from taisoft.dynamics import linear_solver, stage_system
from taisoft.dynamics.direct import DirectSolver
from taisoft.simulator import Simulator

from . import runner
from .runner import REST, Stopwatch, patched

SOLVE, FRICTION, FORCES, SEARCH, PATHS = "CG and factors", "friction", "assembly and forces", "search", "paths"
KINDS = (SOLVE, FRICTION, FORCES, SEARCH, PATHS, "launches", "host")
OF = {  # of packages, modules and functions of taisoft; the longest name that fits counts
    "linear": SOLVE,
    "linear.block_csr.assemble": FORCES,
    "linear.block_csr.to_system": FORCES,
    "contact": FRICTION,
    "contact.build": SEARCH,
    "fem": FORCES,
    "collision": SEARCH,
    "collision.bent_path": PATHS,
    "collision.passages": PATHS,
    **dict.fromkeys(("dynamics.direct", "dynamics.frame_factors", "dynamics.rigid_balance"), SOLVE),
    **{f"dynamics.{name}": FRICTION for name in ("contact_terms", "friction", "impact", "linearised")},
    "dynamics.contact_terms.save_diagonal": FORCES,
    **{f"dynamics.{name}": FORCES for name in ("explicit", "explicit_contact", "implicit_stages", "joints", "stage", "state")},
    **{f"dynamics.{name}": SEARCH for name in ("contact_geometry", "contact_measures", "far_apart", "misplaced")},
    "dynamics.contact_measures.find_displacement": PATHS,
}
DENSE = (
    *((DirectSolver, name) for name in ("_analyse", "_factorise", "_find_delassus", "solve", "_imbalance")),
    *((MatrixContacts, "solve"), (linear_solver, "build_hierarchy"), (stage_system, "set_frame_factors")),
)
PREPARING = "preparing"  # launches that are watched, once for each kernel: no part of a step
STRETCHES, REPEATS = 9, 300


@cache
def kind_of(path: str) -> str:
    """The kind of a function of taisoft, by module and name. Raises KeyError if OF lacks it."""
    name = path.removeprefix("taisoft.")
    while name not in OF and "." in name:
        name = name.rpartition(".")[0]
    return OF[name]


@kernel
def launch_nothing(x: ti.template(), a: ti.f64):
    """Do next to nothing."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        x[0] = a


def launch_seconds() -> tuple[float, float, float]:
    """Seconds of an empty launch, of one that is watched, and what a stopwatch measures of that."""
    arena = FieldArena()
    x, watch = arena.field("x", ti.f64, 1), Stopwatch()

    def stretch() -> dict[str, float]:
        return watch.parts_of(lambda: [launch_nothing(x, 1.0) for _ in range(REPEATS)])

    stretch()
    plain = median(sum(stretch().values()) for _ in range(STRETCHES)) / REPEATS
    with intercepted(lambda path, launch: watch.timed(launch, "inside")()):
        stretch()
        parts = [stretch() for _ in range(STRETCHES)]
    arena.release()
    return plain, median(sum(one.values()) for one in parts) / REPEATS, median(one["inside"] for one in parts) / REPEATS


def spend(sim: Simulator, seconds: float, fps: float) -> dict:
    """What a mean step of a run from the start spends, whose kernels have been compiled: seconds [s] and launches by kind; the
    seconds of a watched step, of an empty launch, and of a watched one."""
    watch, reports, launches = Stopwatch(), [], dict.fromkeys(KINDS, 0)

    def launched(path: str, launch: Callable[[], object]) -> object:
        launches[kind := kind_of(path)] += 1
        return watch.timed(launch, kind)()

    places = [(kind_of(f"{getattr(owner, name).__module__}.{name}"), owner, name) for owner, name in DENSE]
    sim.reset()
    with patched(runner, "clock", perf_counter):  # on the CPU, launches end before they return
        plain, watched, inside = launch_seconds()
        with watch.on([*places, (PREPARING, Kernels, "prepare")]), intercepted(launched):
            parts = watch.parts_of(lambda: reports.append(sim.run(seconds, fps=fps)))
    n, steps = sum(launches.values()), reports[0].steps
    found = {kind: parts.get(kind, 0.0) - launches[kind] * inside for kind in KINDS}
    found |= {"launches": n * plain, "host": parts[REST] - n * (watched - inside)}
    return {
        "seconds": {kind: own / steps for kind, own in found.items()},
        "launches": {kind: number / steps for kind, number in launches.items() if number},
        "watched": (sum(parts.values()) - parts[PREPARING]) / steps,
        "launch": plain,
        "watched_launch": watched,
    }
