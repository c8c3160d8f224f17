"""What sim.run adds to its steps: reports, energies and volume ratios, and launches that end with a frame.

Time of a step in sim.run at FPS over that of the stepper alone, whose explicit steps go in the largest launches that it takes.
Both begin from rest and take turns, so that noise hits both.
"""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.output.tables import markdown, percent, spread_of
from taisoft.study.measure import warm_up
from taisoft.timing import Timing, summarise

from .elasticity_beam import beam_scene, n_tets
from .elasticity_cost import GUESSED_LAUNCHES, GUESSED_SECONDS_PER_TET
from .elasticity_table import Limit

FPS = 60
STEPS_IN_FRAME = 84  # of explicit steps; within the limit on all meshes
SAMPLE_SECONDS = 0.1  # wall time of a sample, about, but a frame at least
GUESSED_IMPLICIT = 250.0  # times an explicit step, sizes a sample
INTEGRATORS = (*EXPLICIT, "implicit_euler")
RUN_LIMIT = 1.05  # of the explicit integrators


@dataclass
class Frames:
    """Seconds of a step in a run and alone, a pair of samples each round. steps: in a frame."""

    tets: int
    integrator: str
    steps: int
    run: list[float] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)

    @property
    def ratio(self) -> Timing:
        """Of a step in a run to a step alone."""
        return summarise(a / b for a, b in zip(self.run, self.alone))

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"ratio": asdict(self.ratio)}


def measure_frames(meshes, arch: str, rounds: int, integrators=INTEGRATORS) -> Iterator[list[Frames]]:
    """The rows of a mesh, f32 and stable neo-Hookean; all its simulators are open together and take turns."""
    for cells in meshes:
        with contextlib.ExitStack() as stack:
            pairs = []
            for integrator in integrators:
                steps = STEPS_IN_FRAME if integrator in EXPLICIT else 1
                dt = 1.0 / FPS / steps
                made = ts.Simulator(beam_scene(cells, "SNH"), dt=dt, integrator=integrator, precision="f32", arch=arch)
                sim = stack.enter_context(made)
                warm_up(sim)
                pairs.append((sim, Frames(n_tets(cells), integrator, steps)))
            for _ in range(rounds):
                for sim, row in pairs:
                    _take(sim, row, arch)
        yield [row for _, row in pairs]


def _take(sim: ts.Simulator, row: Frames, arch: str) -> None:
    """A pair of samples."""
    step = GUESSED_SECONDS_PER_TET * row.tets + GUESSED_LAUNCHES[arch]
    step *= 1.0 if row.integrator in EXPLICIT else GUESSED_IMPLICIT
    frames = max(1, round(SAMPLE_SECONDS / (row.steps * step)))
    sim.reset()
    start = time.perf_counter()
    steps = sim.run(frames / FPS, fps=FPS).steps
    row.run.append((time.perf_counter() - start) / steps)
    sim.reset()
    start = time.perf_counter()
    _steps_alone(sim, steps)
    row.alone.append((time.perf_counter() - start) / steps)


def _steps_alone(sim: ts.Simulator, steps: int) -> None:
    stepper, done = sim._dynamics.stepper, 0
    while done < steps:
        if sim.settings.explicit:
            done += stepper.advance(steps - done, sim.dt).done
        else:
            stepper.step(sim.dt)
            done += 1


def frame_table(rows: list[Frames]) -> str:
    """A row a mesh and integrator."""
    lines = []
    for row in rows:
        run, alone, ratio = summarise(row.run), summarise(row.alone), row.ratio
        added = 1e6 * row.steps * (ratio.median - 1.0) * alone.median
        lines.append(
            (
                f"{row.tets:,}",
                row.integrator,
                str(row.steps),
                f"{1e6 * alone.median:.2f}",
                f"{1e6 * run.median:.2f}",
                f"{ratio.median:.3f}",
                percent(spread_of(ratio)),
                f"{added:.0f}",
            )
        )
    headings = ("tets", "integrator", "steps/frame", "alone [us]", "in a run [us]", "run / alone", "spread", "added [us/frame]")
    return markdown(headings, lines, left=(1,))


def frame_limits(rows: list[Frames]) -> list[Limit]:
    """The limit on runs of explicit steps."""
    limits = []
    for row in rows:
        if row.integrator in EXPLICIT:
            what = f"step in a run / step alone, {row.integrator}, {row.tets:,} tets"
            limits.append(Limit(what, row.ratio.median, RUN_LIMIT, spread_of(row.ratio)))
    return limits
