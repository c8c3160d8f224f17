"""What an explicit step costs: the three laws under both explicit integrators, timed in turn so that noise hits all.

A sample is a fall from rest of at most half a second, cut into steps enough for the time of a launch to be lost in them;
the cost of a step does not depend on its dt. Steps go through sim.advance, as in sim.run.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.output.tables import markdown, percent, spread_of
from taisoft.study.measure import advance, warm_up
from taisoft.timing import Timing, summarise

from .elasticity_beam import LAWS, beam_scene, n_tets, steps_within_limit
from .elasticity_table import Limit
from .exact_path import SAMPLE

SAMPLE_SECONDS = 0.05  # wall time of a sample, about
GUESSED_SECONDS_PER_TET = 12e-9  # of a step, sizes a sample; 5 to 30 ns were met on the CPU
GUESSED_LAUNCHES = {"cpu": 0.0, "cuda": 200e-6}  # s a step: on CUDA every sub-step is several launches
LONGEST_FALL = 0.5  # s: the beam is bent by then, and St. Venant-Kirchhoff does not fold yet
MOST_STEPS = 10_000
# What a step may cost on this machine, f32: 7 us at 540 tets, 11 ns per tet at 34,560.
STEP_LIMIT = {540: 7e-6, 34_560: 34_560 * 11e-9}  # s
RATIO_LIMIT = {"SVK": 1.0, "COR": 3.0}  # cost over that of stable neo-Hookean


@dataclass
class Cost:
    """Cost of one law, integrator, precision and mesh: seconds per step, a sample each."""

    tets: int
    law: str
    integrator: str
    precision: str
    compile_seconds: float
    samples: list[float] = field(default_factory=list)  # s per step

    @property
    def timing(self) -> Timing:
        """Of one step [s]."""
        return summarise(self.samples)

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"step_seconds": asdict(self.timing)}


def measure_costs(cells, precision: str, arch: str, repeats: int, laws=tuple(LAWS), integrators=EXPLICIT) -> list[Cost]:
    """Costs on one mesh; all simulators are open together and take their samples in turn, `repeats` each."""
    tets = n_tets(cells)
    guess = GUESSED_SECONDS_PER_TET * tets + GUESSED_LAUNCHES[arch]
    steps = min(MOST_STEPS, max(1, round(SAMPLE_SECONDS / guess)))
    dt = min(SAMPLE / steps_within_limit(cells), LONGEST_FALL / steps)
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
    """Cost of `law` over that of SNH, sample by sample; the costs are of one mesh, precision and integrator."""
    by_law = {cost.law: cost.samples for cost in costs}
    if law not in by_law or "SNH" not in by_law:
        return None
    return summarise(a / b for a, b in zip(by_law[law], by_law["SNH"]))


def cost_table(costs: Sequence[Cost]) -> str:
    """A row a cost, with its ratio to stable neo-Hookean."""
    rows = []
    for cost in costs:
        t, ratio = cost.timing, cost_ratio(_alike(costs, cost), cost.law)
        rows.append(
            (
                f"{cost.tets:,}",
                cost.precision,
                cost.integrator,
                cost.law,
                f"{1e6 * t.median:.2f}",
                f"{1e6 * t.minimum:.2f}",
                percent(spread_of(t)),
                f"{1e9 * t.median / cost.tets:.2f}",
                "" if ratio is None else f"{ratio.median:.2f}",
                f"{cost.compile_seconds:.2f}",
            )
        )
    headings = ("tets", "precision", "integrator", "law", "us/step", "least", "spread", "ns/tet", "/ SNH", "compile [s]")
    return markdown(headings, rows, left=(1, 2, 3))


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
    """The costs that differ from `one` in the law alone."""
    key = (one.tets, one.precision, one.integrator)
    return [cost for cost in costs if (cost.tets, cost.precision, cost.integrator) == key]
