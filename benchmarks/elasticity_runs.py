"""The falling beam of exact_path.py in taisoft, and whole runs of one second: time and error of taisoft and MuJoCo in turn.

A round opens, runs and closes every integrator of both programs once, so that a slow minute of the machine affects all; ratios
are formed per round. A time is that of a whole run without compilation: MuJoCo in batches of 10 ms, taisoft in the largest
batches of sim.advance. The first round also records the tip. On meshes as small as these taisoft uses one CPU
thread, as MuJoCo does.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from time import perf_counter

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import SimulationError
from taisoft.machine import Timing, summarise
from taisoft.scene.scene import Scene
from taisoft.stability import stable_dt

from .exact_path import DENSITY, FOLDING_STARTS, GRAVITY, POISSON, SAMPLE, SIZE, YOUNG, load_exact
from .programs.mujoco_flex import STABLE_STEPS, run_mujoco
from .reference_cases.record import LAWS
from .runner import progress, warm_up
from .timed_run import TimedRun, advance

MARGIN = 0.9  # step over the largest stable step about the rest shape
IMPLICIT = ("bdf2", "implicit_midpoint", "implicit_euler", "linearly_implicit_euler")
TAISOFT, MUJOCO = "taisoft", "MuJoCo"
ROUND_SECONDS, ROUND_RUNS = 0.3, 10  # a round repeats a run until this wall time or this number is reached


# --- the beam -----------------------------------------------------------------------------------------------------------


def n_tets(cells) -> int:
    """Number of tets, five per cell."""
    return 5 * math.prod(cells)


def beam_scene(cells, law: str = "SVK") -> Scene:
    """The beam at rest, clamped at its left end. law: one of LAWS."""
    scene = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    rubber = ts.Material(law=LAWS[law], young=YOUNG, poisson=POISSON, density=DENSITY)
    beam = scene.add_body(ts.box_mesh(cells, SIZE), rubber, name="beam")
    beam.fix(lambda X: X[:, 0] < -SIZE[0] / 2 + 1e-9)
    return scene


def explicit_steps(scene: Scene) -> int:
    """Smallest number of explicit steps in 10 ms with dt at most MARGIN times the stability limit."""
    return math.ceil(SAMPLE / (MARGIN * stable_dt(scene, verlet=True)))


def steps_within_limit(cells) -> int:
    """`explicit_steps` of the beam, the same for all laws."""
    return explicit_steps(beam_scene(cells))


def follow_tip(sim: ts.Simulator, steps: int, samples: int) -> tuple[np.ndarray, TimedRun]:
    """Path (samples + 1, 3) [m] of the mean of the end face's nodes, every `steps` steps, and the timed run."""
    sim.reset()
    tip = np.flatnonzero(sim.scene.body("beam").rest_positions[:, 0] > SIZE[0] / 2 - 1e-9)
    path, whole = [sim.positions("beam")[tip].mean(axis=0)], TimedRun()
    for _ in range(samples):
        whole += advance(sim, steps)
        path.append(sim.positions("beam")[tip].mean(axis=0))
    return np.array(path), whole


# --- runs ---------------------------------------------------------------------------------------------------------------


@dataclass
class Row:
    """One integrator of a program at one dt on one mesh. rounds: wall seconds per simulated second of every run."""

    tets: int
    program: str
    integrator: str
    steps: int  # within 10 ms
    rounds: list[list[float]] = field(default_factory=list)
    build_seconds: list[float] = field(default_factory=list)  # until the simulator can step, including compilation
    compile_seconds: list[float] = field(default_factory=list)
    error: float | None = None
    error_unfolded: float | None = None
    first_run: TimedRun | None = None  # taisoft: what the steps did
    note: str = ""
    failure: str = ""

    @property
    def dt(self) -> float:
        """Step [s]."""
        return SAMPLE / self.steps

    @property
    def timing(self) -> Timing | None:
        """Timing of a simulated second [s] over all runs; None if no run ended."""
        runs = [seconds for one in self.rounds for seconds in one]
        return summarise(runs) if runs else None

    def set_errors(self, cells, path: np.ndarray) -> None:
        """Set the errors from the path (k,3) [m], sampled every 10 ms."""
        exact, t = load_exact(cells), np.arange(len(path)) * SAMPLE
        self.error, self.error_unfolded = exact.error(t, path), exact.error(t, path, until=FOLDING_STARTS)

    def record(self) -> dict:
        """The row as plain data."""
        return asdict(self) | {"dt": self.dt, "seconds_per_simulated_second": self.timing and asdict(self.timing)}


def lasting_steps(scene: Scene, integrator: str, arch: str, seconds: float) -> tuple[int, str]:
    """Smallest number of explicit steps in 10 ms that is stable for `seconds`, and a note on those that diverged.

    The stability limit is that of small vibrations about the rest shape; laws stiffen under compression.
    """
    least, failures = explicit_steps(scene), []
    samples = round(seconds / SAMPLE)
    with ts.Simulator(scene, dt=SAMPLE / least, integrator=integrator, precision="f32", arch=arch) as sim:
        for steps in range(least, 4 * least):
            sim.dt = SAMPLE / steps
            sim.reset()
            try:
                advance(sim, steps * samples)
            except SimulationError:
                failures.append(f"{1e3 * sim.dt:.3f} ms (at t = {sim.time:.2f} s)")
                continue
            note = f"from {MARGIN} of the limit at rest on, dt = {', '.join(failures)} diverged" if failures else ""
            return steps, note
    raise SimulationError(f"{integrator}: even dt = {1e3 * sim.dt:.3f} ms does not last {seconds} s")


def make_rows(cells, arch: str, peers: bool, seconds: float, implicit=IMPLICIT) -> list[Row]:
    """The rows of a mesh in the order of measurement, alternating between taisoft and MuJoCo."""
    verlet, euler = (lasting_steps(beam_scene(cells), name, arch, seconds) for name in reversed(EXPLICIT))
    stable = STABLE_STEPS[tuple(cells)][0]
    own = [
        ("velocity_verlet", *verlet),
        ("velocity_verlet", 2 * verlet[0], ""),
        ("symplectic_euler", *euler),
        *((name, 1, "") for name in implicit),
    ]
    theirs = [("euler_staggered", stable), ("euler_staggered", 2 * stable), ("euler", stable), ("discrete", 1), ("discrete", 4)]
    rows = []
    for k, (integrator, steps, note) in enumerate(own):
        rows.append(Row(n_tets(cells), TAISOFT, integrator, steps, note=note))
        if peers and k < len(theirs):
            rows.append(Row(n_tets(cells), MUJOCO, *theirs[k]))
    return rows


def measure_rows(rows: list[Row], cells, arch: str, rounds: int, seconds: float) -> None:
    """Measure the rows in `rounds` rounds; a row that diverges records its failure and is skipped from then on."""
    for number in range(rounds):
        for row in rows:
            if row.failure:
                continue
            progress(f"{row.tets:,} tets, round {number + 1} of {rounds}: {row.program} {row.integrator}")
            try:
                (_taisoft_round if row.program == TAISOFT else _mujoco_round)(row, cells, arch, seconds, number == 0)
            except SimulationError as error:
                row.failure = str(error)


def _taisoft_round(row: Row, cells, arch: str, seconds: float, first: bool) -> None:
    scene, samples = beam_scene(cells), round(seconds / SAMPLE)
    start = perf_counter()
    with ts.Simulator(scene, dt=row.dt, integrator=row.integrator, precision="f32", arch=arch) as sim:
        made, compiled = perf_counter() - start, sim.compile_seconds
        warm_up(sim)
        if first:
            path, row.first_run = follow_tip(sim, row.steps, samples)
            row.set_errors(cells, path)

        def run() -> float:
            sim.reset()
            return advance(sim, row.steps * samples).seconds / seconds

        row.rounds.append(list(repeat_short(run)))
        row.build_seconds.append(made + sim.compile_seconds - compiled)
        row.compile_seconds.append(sim.compile_seconds)


def _mujoco_round(row: Row, cells, arch: str, seconds: float, first: bool) -> None:
    def run() -> float:
        result = run_mujoco(cells, row.integrator, row.dt, seconds)
        row.build_seconds.append(result["compile_seconds"])
        row.error, row.error_unfolded = result["error"], result["error_unfolded"]
        return result["seconds_per_simulated_second"]

    row.rounds.append(list(repeat_short(run)))


def repeat_short(run: Callable[[], float]) -> Iterator[float]:
    """Repeat run() until ROUND_SECONDS or ROUND_RUNS is reached; yields its seconds."""
    total, count = 0.0, 0
    while count == 0 or (total < ROUND_SECONDS and count < ROUND_RUNS):
        seconds = run()
        total, count = total + seconds, count + 1
        yield seconds


def time_ratio(slow: Row, fast: Row) -> Timing | None:
    """Ratio of the times of `slow` and `fast` from the medians of each round; None without runs."""
    pairs = list(zip(slow.rounds, fast.rounds))
    return summarise(np.median(a) / np.median(b) for a, b in pairs) if pairs else None
