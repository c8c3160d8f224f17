"""Measurements of `collision.py`: searches for contacts by phase and by frame, broad phases, reductions.

Phases are timed between synchronisations. The first search of a configuration compiles kernels and grows buffers and is timed
separately.
"""

from dataclasses import asdict, dataclass, field
from functools import partial

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import Runtime, compile_clock, kernel
from taisoft.collision.bvh import Bvh
from taisoft.collision.candidates import Buffer, Pairs, entries, fill, list_pairs, pair_entries
from taisoft.collision.detector import MERGED, Detection
from taisoft.collision.path_check import NO_PASSAGES
from taisoft.collision.reduction import FOUND, KEPT, LEFT, UNKNOWN, is_same
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.fem.build import build_model
from taisoft.machine import Timing, summarise
from taisoft.scene.plan import make_plan

from .collision_cases import FPS, FRAMES, Setup, start
from .runner import clock, repeated

PHASES = ("boxes", "candidates", "contacts", "reduction")
GEOMETRIES = ("proximity", "distance_field")
HASH, TREES = "spatial_hash", ("bvh 6", "bvh 14", "bvh 18")
DT = 1 / FPS
ROUNDS, QUICK_ROUNDS = 15, 2
FRAME_ROUNDS = 3
TURNS = 3  # the rounds of compared broad phases are divided into this many turns


NEAR = Pairs()  # a visitor of all near pairs


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


# --- the quadratic reduction ---------------------------------------------------------------------------------------------


@kernel
def reduce_by_pairs(
    r: ti.template(), out: ti.template(), order: ti.types.ndarray(), state: ti.template(), kept: ti.template(), tolerance: ti.f64
):
    """Two nested loops over the contacts of a search: a contact is kept unless an earlier kept one is the same."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        n = 0
        for i in range(r.count[FOUND]):
            at = order[i]
            state[i] = KEPT
            j = 0
            while j < n and state[i] == KEPT:
                if is_same(out, at, kept[j], tolerance):
                    state[i] = UNKNOWN
                j += 1
            if state[i] == KEPT:
                kept[n] = at
                n += 1
        state[r.count[FOUND]] = n


class Quadratic:
    """Reduction of a detection's last search by two nested loops."""

    def __init__(self, detection: Detection):
        self._detection, self._arena = detection, FieldArena()
        self._capacity = n = detection.buffer.capacity
        self._known: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._state, self._kept = (self._arena.field(name, ti.i32, n + 1) for name in ("state", "kept"))

    def fits(self) -> bool:
        """Whether the buffers have the detection's capacity."""
        return self._capacity == self._detection.buffer.capacity

    def reduce(self) -> None:
        """Reduce the contacts."""
        d = self._detection
        reduce_by_pairs(d._reduction.work, d.buffer.data, self._order(), self._state, self._kept, MERGED * d.edge)

    def _order(self) -> np.ndarray:
        """Indices of the contacts ordered by kind and feature, then by index; computed once per search."""
        d = self._detection
        work = d._reduction.work
        place = work.place.to_numpy()[: work.count[FOUND]]
        feature = d.buffer.data.feature.to_numpy()[place]
        known = self._known
        if known is None or not (np.array_equal(known[0], place) and np.array_equal(known[1], feature)):
            order = place[np.lexsort((place, feature[:, 2], feature[:, 1], feature[:, 0]))]
            self._known = known = (place, feature, order.astype(np.int32))
        return known[2]

    def same(self) -> bool:
        """Whether it kept the same contacts as the detection's reduction."""
        r = self._detection._reduction.work
        found, left = r.count[FOUND], r.count[LEFT]
        if self._state.to_numpy()[found] != left:
            return False
        return np.array_equal(np.sort(self._kept.to_numpy()[:left]), np.sort(r.kept.to_numpy()[:left]))

    def release(self) -> None:
        """Free the memory."""
        self._arena.release()


# --- searches -----------------------------------------------------------------------------------------------------------


class Rig:
    """Model and detection of a configuration; a context manager."""

    def __init__(self, setup: Setup, geometry: str, runtime: Runtime):
        self.setup, self.runtime = setup, runtime
        self.scene = setup.build(geometry)
        self._arena, self._others, self._quadratic = FieldArena(), [], None
        self.model, layout = build_model(
            self.scene, runtime, self._arena, make_plan(self.scene, explicit=True, multistep=False).on
        )
        self.detection = Detection(self.scene, self.model, layout, runtime)
        surface, makers = self.detection.surface, {"row": entries, "pairs": pair_entries}
        self._lists = [Buffer(name, make, 2**12, None, surface.chunks, self._arena) for name, make in makers.items()]
        self.tets = sum(body.mesh.n_tets for body in self.scene.bodies)

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *error) -> None:
        for part in (*self._lists, *self._others):
            part.release()
        self.detection.release()
        self._arena.release()

    def place(self, fraction: float) -> None:
        """Move the nodes to their positions at a fraction of the film."""
        x = start(self.scene) if self.setup.motion is None else self.setup.motion(self.scene, fraction)
        self.model.state.x.from_numpy(x)

    def search(self) -> None:
        """Run a whole search."""
        self.detection.find(0.0, DT)

    def phases(self) -> dict[str, float]:
        """Run the phases of a search; returns the wall seconds of each."""
        d, times = self.detection, [clock()]
        d._move(0.0, DT)
        times.append(clock())
        near = d._near()
        times.append(clock())
        fill(lambda: d._fill_buffer(near, NO_PASSAGES), *d._scratch(), d.buffer)
        times.append(clock())
        d._reduction.reduce(-np.inf)
        times.append(clock())
        return dict(zip(PHASES, np.diff(times).tolist()))

    def list_pairs(self, broad=None) -> None:
        """Run a broad phase, by default the detection's, and list the pairs of triangles that are near each other."""
        d = self.detection
        near, (row, out) = (broad or d.broad).near(), self._lists
        fill(lambda: list_pairs(d.surface, near, row.parts, NEAR, out.parts), row, out)

    def pairs(self, broad=None) -> np.ndarray:
        """These pairs (k,2)."""
        self.list_pairs(broad)
        out = self._lists[1]
        return out.data.to_numpy()[out.filled(out.used.to_numpy()), :2]

    def n_pairs(self, broad=None) -> int:
        """Number of these pairs."""
        return len(self.pairs(broad))

    def broad_phase(self, name: str, ratio: float | None = None) -> SpatialHash | Bvh:
        """A broad phase of this surface: HASH with a ratio of cell to mean edge, or one of TREES."""
        d, arena = self.detection, FieldArena()
        x = start(self.scene)[d.topology.node]
        if name == HASH:
            ratio = self.scene.collision.cell_ratio if ratio is None else ratio
            made = SpatialHash(d.surface, arena, ratio * d.edge, np.ptp(x, axis=0))
        else:
            made = Bvh(d.surface, d.topology, x, d.reach, self.runtime, arena, int(name.split()[1]))
        self._others += [made, arena]
        return made

    def quadratic(self) -> Quadratic:
        """The quadratic reduction of the last search, rebuilt if the contact buffer has grown."""
        if self._quadratic is None or not self._quadratic.fits():
            self._quadratic = Quadratic(self.detection)
            self._others.append(self._quadratic)
        return self._quadratic


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
            taken = [rig.phases() for _ in range(len(row.whole))]
            row.phases = {name: [t[name] for t in taken] for name in PHASES}
            quadratic = rig.quadratic()
            quadratic.reduce()
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
            quadratic = rig.quadratic()
            quadratic.reduce()
            film.same &= quadratic.same()
            rounds = [rig.phases() for _ in range(FRAME_ROUNDS)]
            numbers = {name: float(np.median([r[name] for r in rounds])) for name in PHASES}
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
