"""Measurements of `collision.py`: searches for contacts by phase and by frame, broad phases, reductions.

The first search of a configuration compiles kernels and grows buffers and is timed separately.
"""

from dataclasses import asdict, dataclass, field
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.backend.runtime import Runtime, compile_clock
from taisoft.machine import Timing, summarise

from .collision_cases import FRAMES, Setup
from .collision_rig import HASH, PHASES, TREES, Quadratic, Rig, phases_of
from .kinds import watching
from .runner import REST, clock, repeated

GEOMETRIES = ("proximity", "distance_field")
ROUNDS, QUICK_ROUNDS = 15, 2
FRAME_ROUNDS = 3
TURNS = 3  # the rounds of compared broad phases are divided into this many turns


@dataclass
class Row:
    """Search of a configuration. phases, whole, quadratic: wall seconds per round; first: of the first search, with compilation;
    same: whether the quadratic reduction kept the same contacts."""

    setup: str
    geometry: str
    tets: int = 0
    triangles: int = 0
    active: int = 0
    pairs: int = 0
    found: int = 0
    contacts: int = 0
    phases: dict[str, list[float]] = field(default_factory=dict)
    whole: list[float] = field(default_factory=list)
    quadratic: list[float] = field(default_factory=list)
    same: bool | None = None
    first: float = 0.0
    compile_seconds: float = 0.0
    field_bytes: int = 0
    failure: str = ""

    @property
    def timing(self) -> Timing | None:
        """Timing of a whole search [s]; None if it failed."""
        return summarise(self.whole) if self.whole else None

    def phase(self, name: str) -> float:
        """Median time of a phase [s]."""
        return float(np.median(self.phases[name]))

    def record(self) -> dict:
        """The row as plain data."""
        return asdict(self) | {"seconds": self.timing and asdict(self.timing)}


@dataclass
class Film:
    """A configuration in motion. numbers: a list over frames of each; times are medians over FRAME_ROUNDS [s]; same: whether the
    quadratic reduction kept the same contacts in every frame."""

    setup: str
    geometry: str
    tets: int
    same: bool = True
    numbers: dict[str, list] = field(default_factory=dict)

    def add(self, **numbers) -> None:
        """Append a frame."""
        for name, value in numbers.items():
            self.numbers.setdefault(name, []).append(value)


@dataclass
class Sweep:
    """Times [s] of broad phases. at: the parameter, tets or cell size over the mean edge; rounds: times by broad phase."""

    what: str
    setup: str
    at: float
    tets: int
    triangles: int
    pairs: dict[str, int] = field(default_factory=dict)
    rounds: dict[str, list[float]] = field(default_factory=dict)

    def median(self, name: str) -> float:
        """Median time of a broad phase [s]."""
        return float(np.median(self.rounds[name]))


# --- measured ------------------------------------------------------------------------------------------------------------


def measure_row(setup: Setup, geometry: str, runtime: Runtime, rounds: int) -> Row:
    """Counts and times of a configuration's search; the row records a failure."""
    row = Row(setup.name, geometry)
    try:
        with Rig(setup, geometry, runtime) as rig:
            row.tets, row.triangles = rig.tets, rig.detection.surface.n_triangles
            before, begin = compile_clock(), clock()
            rig.search()
            row.first, row.compile_seconds = clock() - begin, compile_clock() - before
            rig.search()
            counts = rig.detection.counts
            row.active, row.found, row.contacts, row.pairs = counts.active, counts.found, counts.contacts, rig.n_pairs()
            row.field_bytes = sum(rig.detection._arena.bytes.values())
            row.whole = repeated(rig.search, rounds)
            with watching() as spend:
                taken = [phases_of(spend(rig.search)) for _ in row.whole]
            row.phases = {name: [one[name] for one in taken] for name in (*PHASES, REST)}
            with Quadratic(rig.detection) as quadratic:
                row.same, row.quadratic = quadratic.same(), repeated(quadratic.reduce, rounds)
    except ts.TaisoftError as error:
        row.failure = str(error)
    return row


def measure_film(setup: Setup, geometry: str, runtime: Runtime, frames: int = FRAMES, broad: bool = False) -> Film:
    """Phases and quadratic reduction of every frame. broad: also all broad phases."""
    with Rig(setup, geometry, runtime) as rig:
        film, others = Film(setup.name, geometry, rig.tets), {}
        if broad:
            others = {name: rig.broad_phase(name) for name in (HASH, *TREES)}
        for k in range(-1, frames):  # the last frame first, to compile and to grow buffers
            rig.place(1.0 if k < 0 else k / max(frames - 1, 1))
            rig.search()
            with watching() as spend:
                taken = [phases_of(spend(rig.search)) for _ in range(FRAME_ROUNDS)]
            numbers = {name: float(np.median([one[name] for one in taken])) for name in PHASES}
            with Quadratic(rig.detection) as quadratic:
                film.same &= quadratic.same()
                numbers["quadratic"] = float(np.median(repeated(quadratic.reduce, FRAME_ROUNDS)))
            for name, other in others.items():
                rig.n_pairs(other)
                numbers[name] = float(np.median(repeated(partial(rig.list_pairs, other), FRAME_ROUNDS)))
            if k >= 0:
                counts = rig.detection.counts
                film.add(active=counts.active, found=counts.found, kept=counts.contacts, **numbers)
    return film


def measure_broad(setup: Setup, runtime: Runtime, rounds: int, ratios=None, turns: int = TURNS) -> list[Sweep]:
    """All broad phases of a configuration in the middle of its motion, or the hash over ratios of cell to edge."""
    with Rig(setup, "proximity", runtime) as rig:
        rig.place(0.5)
        rig.search()
        size = rig.tets, rig.detection.surface.n_triangles
        if ratios is None:
            sweeps = [Sweep("tets", setup.name, rig.tets, *size)]
            jobs = [(sweeps[0], name, rig.broad_phase(name)) for name in (HASH, *TREES)]
        else:
            sweeps = [Sweep("ratio", setup.name, ratio, *size) for ratio in ratios]
            jobs = [(sweep, HASH, rig.broad_phase(HASH, sweep.at)) for sweep in sweeps]
        for sweep, name, broad in jobs:
            sweep.pairs[name] = rig.n_pairs(broad)  # compiles and grows buffers
            rig.n_pairs(broad)
        for _ in range(turns):  # a slow moment of the machine affects all
            for sweep, name, broad in jobs:
                some = repeated(partial(rig.list_pairs, broad), max(rounds // turns, 1))
                sweep.rounds.setdefault(name, []).extend(some)
    return sweeps
