"""What steps and searches spend, by kind: each launch is timed, and the time of watching is taken off again.

A kernel has the kind of its module, and so have the functions of the host in PLACES; all else is "host". "launches" is their
number times the duration of an empty one, which is taken off the kinds of the kernels; what watching adds to an empty one is
taken off "host". So the kinds add up to what is not watched, but for noise.
Weakness: a module has one kind. Searches for the paths of a step are "other search", the host's part in friction is "host".
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from statistics import median
from time import perf_counter

import taichi as ti

from taisoft.backend.arrays import FieldArena, on_cuda
from taisoft.backend.counters import intercepted
from taisoft.backend.launching import Kernels
from taisoft.backend.runtime import kernel
from taisoft.collision.detector import Detection
from taisoft.contact.matrix_contacts import MatrixContacts
from taisoft.dynamics import linear_solver, stage_system
from taisoft.dynamics.direct import DirectSolver

from . import runner
from .runner import REST, Stopwatch, patched

SOLVE, FRICTION, FORCES, SEARCH, PATHS = "CG and factors", "friction", "assembly and forces", "search", "paths"
BOXES, CANDIDATES, POINTS, REDUCTION, OTHER = "boxes", "candidates", "contacts", "reduction", "other search"
LAUNCHES, HOST = "launches", "host"
IN_SEARCH = (BOXES, CANDIDATES, POINTS, REDUCTION, OTHER)
KINDS = (SOLVE, FRICTION, FORCES, *IN_SEARCH, PATHS, LAUNCHES, HOST)
JOINED = (SOLVE, FRICTION, FORCES, SEARCH, PATHS, LAUNCHES, HOST)
OF = {  # of packages, modules and functions of taisoft; the longest name that fits counts
    "linear": SOLVE,
    "linear.block_csr.assemble": FORCES,
    "linear.block_csr.to_system": FORCES,
    "contact": FRICTION,
    "contact.build": OTHER,
    "fem": FORCES,
    "collision": POINTS,
    "collision.surface": BOXES,
    **dict.fromkeys(("collision.bvh", "collision.candidates", "collision.spatial_hash"), CANDIDATES),
    "collision.reduction": REDUCTION,
    **dict.fromkeys(("collision.detector", "collision.end_search", "collision.intersections"), OTHER),
    "collision.bent_path": PATHS,
    "collision.passages": PATHS,
    **{f"dynamics.{name}": SOLVE for name in ("delassus", "direct", "frame_factors", "rigid_balance")},
    **{f"dynamics.{name}": FRICTION for name in ("contact_terms", "friction", "impact", "linearised")},
    "dynamics.contact_terms.save_diagonal": FORCES,
    **{f"dynamics.{name}": FORCES for name in ("explicit", "explicit_contact", "implicit_stages", "joints", "stage", "state")},
    "dynamics.explicit_contact.begin_solve": FRICTION,
    **{f"dynamics.{name}": OTHER for name in ("contact_geometry", "contact_measures", "far_apart", "misplaced")},
    "dynamics.explicit_batch": OTHER,
    "backend.reader": OTHER,
    "dynamics.contact_measures.find_displacement": PATHS,
}
PLACES = (  # the search's own part, and what does dense algebra
    (Detection, "find"),
    *((DirectSolver, name) for name in ("_analyse", "_factorise", "solve", "_imbalance")),
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


@dataclass(frozen=True)
class Launch:
    """Seconds of an empty launch, of one that is watched, and what a stopwatch measures of that."""

    plain: float
    watched: float
    inside: float


def time_launches() -> Launch:
    """Measure empty launches."""
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
    return Launch(plain, median(sum(one.values()) for one in parts) / REPEATS, median(one["inside"] for one in parts) / REPEATS)


@dataclass
class Spent:
    """Seconds [s] and launches by kind, those that are not 0. watched: seconds with watching; launch: durations of empty ones."""

    seconds: dict[str, float]
    launches: dict[str, float]
    watched: float
    launch: Launch

    def joined(self) -> dict[str, float]:
        """Seconds of JOINED, in which the parts of a search are one."""
        search = sum(self.seconds.get(kind, 0.0) for kind in IN_SEARCH)
        return {kind: search if kind == SEARCH else self.seconds.get(kind, 0.0) for kind in JOINED}


@contextmanager
def watching() -> Iterator[Callable[..., Spent]]:
    """Context with a function that calls something and returns what that spent, divided by `times`."""
    watch, launches = Stopwatch(), dict.fromkeys(KINDS, 0)

    def launched(path: str, launch: Callable[[], object]) -> object:
        launches[kind := kind_of(path)] += 1
        return watch.timed(launch, kind)()

    def spend(call: Callable[[], object], times: int = 1) -> Spent:
        launches.update(dict.fromkeys(KINDS, 0))
        parts = watch.parts_of(call)
        n = sum(launches.values())
        found = {kind: parts.get(kind, 0.0) - launches[kind] * empty.inside for kind in KINDS if kind in parts}
        found |= {LAUNCHES: n * empty.plain, HOST: parts[REST] - n * (empty.watched - empty.inside)}
        whole = sum(parts.values()) - parts.get(PREPARING, 0.0)
        used = {kind: number / times for kind, number in launches.items() if number}
        return Spent({kind: own / times for kind, own in found.items()}, used, whole / times, empty)

    places = [(kind_of(f"{getattr(owner, name).__module__}.{name}"), owner, name) for owner, name in PLACES]
    # on the CPU, launches end before they return
    with nullcontext() if on_cuda() else patched(runner, "clock", perf_counter):
        empty = time_launches()
        with watch.on([*places, (PREPARING, Kernels, "prepare")]), intercepted(launched):
            yield spend
