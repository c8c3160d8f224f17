"""Measurements of `scaling.py`: one kind of work on one mesh.

explicit:   velocity Verlet of a clamped beam that falls, stable neo-Hookean, at most 0.9 of the largest stable step.
implicit:   BDF2 of that beam, steps of 10 ms; stiff implicit: with a hundred times its Young's modulus.
search:     a search for contacts by proximity among 27 cubes at rest that touch, the pile of `collision.py`.
explicit contact, implicit contact: two cubes on the ground, the upper one off centre and slightly penetrating: symplectic
            Euler and Gauss-Seidel at 0.9 of the largest stable step, implicit Euler and the augmented Lagrangian at 10 ms.

Explicit, implicit, search and implicit contact also on one thread, where taisoft uses all. All in f32. Steps are timed first as a
whole, then repeated from the same start with counters, and with their launches timed by kind (kinds.py). The first steps, which
compile and grow buffers, are left out.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from time import perf_counter

import numpy as np

import taisoft as ts
from taisoft.backend.counters import counting
from taisoft.backend.runtime import compile_clock, open_runtime, threads
from taisoft.machine import Timing, summarise
from taisoft.output.report import peak_memory
from taisoft.scene.scene import Scene

from .beam import MARGIN, beam_scene, n_tets
from .collision_cases import pile_setup, two_cubes
from .collision_runs import Rig, on_one_thread
from .elasticity import LONGEST_FALL, MAX_STEPS, SAMPLE_SECONDS
from .kinds import watching
from .runner import clock, repeated, timed, warm_up
from .scaling_bytes import floor_bytes, group_bytes
from .timed_run import advance

DT, TINY_DT = 0.01, 1e-6  # [s] of implicit steps; of explicit ones until their limit is known
MIN_STEPS = 25  # of a sample of explicit steps: frames of large meshes are a hundred steps and more apart
SAMPLES, ROUNDS = 7, 15  # of explicit steps without contacts; of searches
WARM, ENOUGH_SECONDS, MIN_TIMED, MAX_TIMED = 3, 3.0, 3, 20  # steps before, and steps that are timed one by one: time and number
COUNTS = {"newton": "newton_iterations", "linear": "linear_iterations", "sweeps": "contact_iterations", "contacts": "n_contacts"}
PRECISION = "f32"
ON_ONE = ", one thread"  # follows the name of a kind
STIFF = 1e8  # [Pa]


@dataclass
class Row:
    """A kind of work on one mesh. samples: seconds of a step or a search; phases: seconds by kind; counts: means; calls:
    launches, their arguments and accesses by the host, means; moved: lower bound of the bytes moved; field_bytes: by group; base,
    peak: resident bytes before the scene was built, and at most; setup_seconds: of building scene and simulator, without
    compilation."""

    kind: str
    arch: str
    tets: int = 0
    nodes: int = 0
    threads: int = 1
    samples: list[float] = field(default_factory=list)
    phases: dict[str, float] = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)
    calls: dict[str, float] = field(default_factory=dict)
    moved: float = 0.0
    field_bytes: dict[str, int] = field(default_factory=dict)
    setup_seconds: float = 0.0
    compile_seconds: float = 0.0
    base: int | None = None
    peak: int | None = None
    failure: str = ""

    @property
    def timing(self) -> Timing | None:
        """Timing of a step or a search [s], or None."""
        return summarise(self.samples) if self.samples else None

    def record(self) -> dict:
        """The row as plain data; Row(**record) restores it."""
        return asdict(self)


def measure(kind: str, size: int, arch: str) -> Row:
    """Measure a kind of work on a mesh of about `size` tets. Raises TaisoftError."""
    row = Row(kind, arch, base=peak_memory())
    before = compile_clock()
    KINDS[kind](row, size)
    row.compile_seconds, row.peak = compile_clock() - before, peak_memory()
    return row


# --- what is simulated ------------------------------------------------------------------------------------------------


def beam(size: int) -> Scene:
    """A beam of 4 n x n x n cells."""
    n = max(1, round((size / n_tets((4, 1, 1))) ** (1 / 3)))
    return beam_scene((4 * n, n, n), "SNH")


def stiff_beam(size: int) -> Scene:
    """The same, a hundred times as stiff."""
    scene = beam(size)
    scene.bodies[0].material = replace(scene.bodies[0].material, young=STIFF)
    return scene


def cubes_on_ground(size: int) -> Scene:
    """Two cubes on each other on the ground."""
    scene = two_cubes(max(1, round((size / 10) ** (1 / 3))), "proximity")
    scene.gravity, scene.contact_forces = (0.0, -9.81, 0.0), True
    scene.allow_initial_overlap = True  # they are sunk into each other
    scene.add_obstacle(ts.HalfSpace((0, -0.5, 0), (0, 1, 0)), name="ground")
    return scene


def _open(row: Row, build: Callable[[int], Scene], size: int, integrator: str, dt: float | None) -> ts.Simulator:
    """Open a scene's simulator and record its sizes in the row. dt None: MARGIN times the largest stable step."""
    begin = perf_counter()
    sim = ts.Simulator(build(size), dt=dt or TINY_DT, integrator=integrator, precision=PRECISION, arch=row.arch)
    if dt is None:
        sim.dt = MARGIN * sim.stable_dt
    row.setup_seconds = perf_counter() - begin - sim.compile_seconds
    m = sim._dynamics.state.model
    row.tets = sum(body.mesh.n_tets for body in sim.scene.bodies)
    row.nodes, row.threads = m.n_nodes, 1 if m.serial else threads()
    return sim


# --- kinds of work ----------------------------------------------------------------------------------------------------


def alone(run: Callable[[Row, int], None]) -> Callable[[Row, int], None]:
    """A kind of work on one thread for any mesh size."""

    def on_one(row: Row, size: int) -> None:
        with on_one_thread():
            run(row, size)

    return on_one


def _look(row: Row, begin: Callable[[], object], call: Callable[[], object], times: int) -> Counter[str]:
    """Repeat a call with counters and by kind, both from what `begin` does. Returns the launches by kernel, over `times`."""
    begin()
    with counting() as counts:
        call()
    begin()
    with watching() as spend:
        row.phases = spend(call, times).seconds
    row.calls = counts.totals(times)
    return Counter({name: n / times for name, n in counts.launches.items()})


def explicit(row: Row, size: int) -> None:
    """Steps without contacts, many in one launch."""
    with _open(row, beam, size, "velocity_verlet", None) as sim:
        warm_up(sim)
        a_few = advance(sim, 10).seconds / 10
        steps = max(MIN_STEPS, min(MAX_STEPS, round(SAMPLE_SECONDS / a_few)))
        sim.dt = min(sim.dt, LONGEST_FALL / steps)
        for _ in range(SAMPLES):
            sim.reset()
            row.samples.append(advance(sim, steps).seconds / steps)
        _look(row, sim.reset, lambda: advance(sim, steps), steps)
        row.field_bytes = group_bytes(sim)
        row.moved = floor_bytes(("drift", "elements", "nodes"), sim.field_bytes)


def explicit_contact(row: Row, size: int) -> None:
    """Steps with contacts, each with a search and a solve."""
    with _open(row, cubes_on_ground, size, "symplectic_euler", None) as sim:
        _one_by_one(row, sim)
        sweep = floor_bytes(("sweep",), sim.field_bytes) * row.counts["contacts"] / sim._dynamics.contact.problem.capacity
        row.moved = floor_bytes(("elements", "update"), sim.field_bytes) + sweep * row.counts["sweeps"]


def implicit(build: Callable[[int], Scene], integrator: str, row: Row, size: int) -> None:
    """Implicit steps with or without contacts; bytes moved exclude those of contacts."""
    with _open(row, build, size, integrator, DT) as sim:
        launches, fields = _one_by_one(row, sim), sim.field_bytes
        row.counts |= {"residuals": launches["form_residual"], "matrices": launches["assemble"]}
        row.moved = (
            row.counts["residuals"] * floor_bytes(("elements", "residual"), fields)
            + row.counts["matrices"] * floor_bytes(("blocks", "edges", "system"), fields)
            + row.counts["linear"] * floor_bytes(("iteration",), fields)
        )


def _one_by_one(row: Row, sim: ts.Simulator) -> Counter[str]:
    """Time steps one by one, then look at them. Returns the launches of a step by kernel."""
    reports = []
    _warm(sim)
    while len(row.samples) < MIN_TIMED or (sum(row.samples) < ENOUGH_SECONDS and len(row.samples) < MAX_TIMED):
        begin = clock()
        reports.append(sim.step())
        row.samples.append(clock() - begin)
    if not all(report.converged for report in reports):
        row.failure = "not every step converged"
    row.counts = {name: float(np.mean([getattr(report, own) for report in reports])) for name, own in COUNTS.items()}
    row.field_bytes = group_bytes(sim)
    return _look(row, partial(_warm, sim), lambda: [sim.step() for _ in reports], len(reports))


def _warm(sim: ts.Simulator) -> None:
    """The first steps from the start."""
    sim.reset()
    for _ in range(WARM):
        sim.step()


def search(row: Row, size: int) -> None:
    """Whole searches."""
    setup = pile_setup(max(1, round((size / (27 * 6)) ** (1 / 3))))
    with closing(open_runtime(row.arch, PRECISION, "the benchmark of scaling")) as runtime:
        rig, row.setup_seconds = timed(lambda: Rig(setup, "proximity", runtime))
        with rig:
            row.tets, row.nodes = rig.tets, rig.model.n_nodes
            row.threads = 1 if rig.detection.surface.serial else threads()
            for _ in range(2):
                rig.search()
            row.samples = repeated(rig.search, ROUNDS)
            _look(row, lambda: None, lambda: [rig.search() for _ in row.samples], len(row.samples))
            counts, found = rig.detection.counts, rig.detection.field_bytes
            row.counts = {"triangles": counts.triangles, "found": counts.found, "contacts": counts.contacts}
            row.field_bytes = {"search": sum(found.values())}
            broad = "tree" if "bvh_link" in found else "cells"
            row.moved = floor_bytes(("boxes", broad), found) + found["contacts"] * counts.found / rig.detection.buffer.capacity


_implicit_contact = partial(implicit, cubes_on_ground, "implicit_euler")
_THREADED = {"explicit": explicit, "implicit": partial(implicit, beam, "bdf2"), "search": search}
KINDS: dict[str, Callable[[Row, int], None]] = {
    **_THREADED,
    **{name + ON_ONE: alone(run) for name, run in _THREADED.items()},
    "stiff implicit": partial(implicit, stiff_beam, "bdf2"),
    "explicit contact": explicit_contact,
    "implicit contact": _implicit_contact,
    "implicit contact" + ON_ONE: alone(_implicit_contact),
}
