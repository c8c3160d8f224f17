"""Cost of explicit steps by law and integrator, and the overhead of sim.run: reports, and launches that end with a frame.

All simulators of a table are open together and are sampled in turn, so that noise affects all. A sample is a fall from rest of at
most half a second, with enough steps to make the launch time negligible; the cost of a step does not depend on dt. Steps in
sim.run at FPS are compared with those of the stepper alone in its largest launches.
"""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent, spread_of

from .beam import LAWS, beam_scene, explicit_steps, n_tets
from .document import Limit, table
from .exact_path import SAMPLE
from .runner import warm_up
from .timed_run import advance

SAMPLE_SECONDS = 0.05  # approximate wall time of a sample
GUESSED_SECONDS_PER_TET = 12e-9  # of a step, to size a sample; measured on the CPU: 5 to 30 ns
GUESSED_LAUNCHES = {"cpu": 0.0, "cuda": 200e-6}  # s per step: on CUDA a step is several launches
LONGEST_FALL = 0.5  # s: the beam is bent, and St. Venant-Kirchhoff does not fold yet
MAX_STEPS = 10_000
# Limit of a step on this machine, f32: 7 us at 540 tets, 11 ns per tet at 34,560.
STEP_LIMIT = {540: 7e-6, 34_560: 34_560 * 11e-9}  # s
RATIO_LIMIT = {"SVK": 1.0, "COR": 3.0}  # cost over that of stable neo-Hookean
FPS = 60
STEPS_IN_FRAME = 84  # explicit steps, stable on all meshes
RUN_SAMPLE_SECONDS = 0.1  # approximate wall time of a sample of a run, at least one frame
GUESSED_IMPLICIT = 250.0  # implicit over explicit step, to size a sample
INTEGRATORS = (*EXPLICIT, "implicit_euler")
RUN_LIMIT = 1.05  # of the explicit integrators


@dataclass
class Cost:
    """Cost of one law, integrator, precision and mesh: seconds per step of each sample."""

    tets: int
    law: str
    integrator: str
    precision: str
    compile_seconds: float
    samples: list[float] = field(default_factory=list)  # s per step

    @property
    def timing(self) -> Timing:
        """Timing of one step [s]."""
        return summarise(self.samples)

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"step_seconds": asdict(self.timing)}


def measure_costs(cells, precision: str, arch: str, repeats: int, laws=tuple(LAWS), integrators=EXPLICIT) -> list[Cost]:
    """Costs on one mesh, from `repeats` samples each."""
    tets = n_tets(cells)
    guess = GUESSED_SECONDS_PER_TET * tets + GUESSED_LAUNCHES[arch]
    steps = min(MAX_STEPS, max(1, round(SAMPLE_SECONDS / guess)))
    dt = min(SAMPLE / explicit_steps(beam_scene(cells)), LONGEST_FALL / steps)
    with contextlib.ExitStack() as stack:
        pairs = []
        for integrator in integrators:
            for law in laws:
                beam = beam_scene(cells, law)
                made = ts.Simulator(beam, dt=dt, integrator=integrator, precision=precision, arch=arch)
                sim = stack.enter_context(made)
                warm_up(sim)
                pairs.append((sim, Cost(tets, law, integrator, precision, sim.compile_seconds)))
        for _ in range(repeats):
            for sim, cost in pairs:
                sim.reset()
                cost.samples.append(advance(sim, steps).seconds / steps)
    return [cost for _, cost in pairs]


def cost_ratio(costs: Sequence[Cost], law: str) -> Timing | None:
    """Cost of `law` over that of SNH per sample; all costs have the same mesh, precision and integrator."""
    by_law = {cost.law: cost.samples for cost in costs}
    if law not in by_law or "SNH" not in by_law:
        return None
    return summarise(a / b for a, b in zip(by_law[law], by_law["SNH"]))


def cost_table(costs: Sequence[Cost]) -> str:
    """A row per cost, with its ratio to stable neo-Hookean."""

    def ratio(cost: Cost) -> str:
        found = cost_ratio(_alike(costs, cost), cost.law)
        return "" if found is None else f"{found.median:.2f}"

    columns = [("tets", "{.tets:,}"), *((f"<{name}", f"{{.{name}}}") for name in ("precision", "integrator", "law"))]
    columns += [
        ("us/step", lambda cost: f"{1e6 * cost.timing.median:.2f}"),
        ("minimum", lambda cost: f"{1e6 * cost.timing.minimum:.2f}"),
        ("spread", lambda cost: percent(spread_of(cost.timing))),
        ("ns/tet", lambda cost: f"{1e9 * cost.timing.median / cost.tets:.2f}"),
        ("/ SNH", ratio),
        ("compile [s]", "{.compile_seconds:.2f}"),
    ]
    return table(costs, columns)


def cost_limits(costs: Sequence[Cost]) -> list[Limit]:
    """The limits on SNH's step and on the ratios of the other laws to it, in f32."""
    limits = []
    for cost in costs:
        if cost.precision != "f32":
            continue
        where = f"{cost.integrator}, {cost.tets:,} tets"
        if cost.law == "SNH" and cost.tets in STEP_LIMIT:
            t = cost.timing
            unit, scale = ("us/step", 1e6) if cost.tets == 540 else ("ns/tet", 1e9 / cost.tets)
            limits.append(Limit(f"SNH step, {where} [{unit}]", scale * t.median, scale * STEP_LIMIT[cost.tets], spread_of(t)))
        ratio = cost_ratio(_alike(costs, cost), cost.law)
        if cost.law in RATIO_LIMIT and ratio is not None:
            limits.append(Limit(f"{cost.law} / SNH, {where}", ratio.median, RATIO_LIMIT[cost.law], spread_of(ratio)))
    return limits


def _alike(costs: Sequence[Cost], one: Cost) -> list[Cost]:
    """The costs that differ from `one` only in the law."""
    key = (one.tets, one.precision, one.integrator)
    return [cost for cost in costs if (cost.tets, cost.precision, cost.integrator) == key]


# --- steps in a run -----------------------------------------------------------------------------------------------------


@dataclass
class Frames:
    """Seconds of a step in a run and alone, a pair of samples per round. steps: per frame."""

    tets: int
    integrator: str
    steps: int
    run: list[float] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)

    @property
    def ratio(self) -> Timing:
        """Time of a step in a run over that of a step alone."""
        return summarise(a / b for a, b in zip(self.run, self.alone))

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"ratio": asdict(self.ratio)}


def measure_frames(meshes, arch: str, rounds: int, integrators=INTEGRATORS) -> Iterator[list[Frames]]:
    """Rows by mesh, in f32 with stable neo-Hookean; the simulators of a mesh are sampled in turn."""
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
    """Take a pair of samples."""
    step = GUESSED_SECONDS_PER_TET * row.tets + GUESSED_LAUNCHES[arch]
    step *= 1.0 if row.integrator in EXPLICIT else GUESSED_IMPLICIT
    frames = max(1, round(RUN_SAMPLE_SECONDS / (row.steps * step)))
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
            done += stepper.advance(steps - done, sim.dt).steps
        else:
            stepper.step(sim.dt)
            done += 1


def frame_table(rows: list[Frames]) -> str:
    """A row per mesh and integrator."""

    def alone(row: Frames) -> float:
        return summarise(row.alone).median

    columns = (
        ("tets", "{.tets:,}"),
        ("<integrator", "{.integrator}"),
        ("steps/frame", "{.steps}"),
        ("alone [us]", lambda row: f"{1e6 * alone(row):.2f}"),
        ("in a run [us]", lambda row: f"{1e6 * summarise(row.run).median:.2f}"),
        ("run / alone", lambda row: f"{row.ratio.median:.3f}"),
        ("spread", lambda row: percent(spread_of(row.ratio))),
        ("added [us/frame]", lambda row: f"{1e6 * row.steps * (row.ratio.median - 1.0) * alone(row):.0f}"),
    )
    return table(rows, columns)


def frame_limits(rows: list[Frames]) -> list[Limit]:
    """Limits on runs with explicit steps."""
    limits = []
    for row in rows:
        if row.integrator in EXPLICIT:
            what = f"step in a run / step alone, {row.integrator}, {row.tets:,} tets"
            limits.append(Limit(what, row.ratio.median, RUN_LIMIT, spread_of(row.ratio)))
    return limits
