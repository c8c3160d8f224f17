"""Cost of a step by law and integrator, and of steps in sim.run: a falling beam.

taisoft bench elasticity [--arch cpu|cuda] [--quick] [--out [FILE.json]]

A beam 4 x 1 x 1 m, E = 1 MPa, nu = 0.3, 1000 kg/m^3, clamped at one end, falls under 9.8 m/s^2 from rest, on three meshes of five
tets per cell, in explicit steps, and in implicit ones with stable neo-Hookean. All simulators of a mesh are open together and are
sampled in turn, so that noise affects all. A sample is a fall from rest of at most half a second, with enough steps to make the
launch time negligible; the cost of an explicit step does not depend on dt. Of stable neo-Hookean, sim.run also takes the same
steps, with a frame after 84 explicit steps or one implicit step. Spread is the interquartile range over the median. The exit
status is 0 also if limits are not met. A full run takes about ten minutes on two cores; do not edit the package meanwhile, since
kernels are compiled from it. `taisoft bench peers` has whole runs of the beam, beside other programs and with their errors.
"""

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial

import taisoft as ts
from taisoft.cli.doctor import cuda
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent, spread_of

from .beam import LAWS, beam_scene, explicit_steps, n_tets
from .document import Limit, begin, table
from .exact_path import MESHES, SAMPLE
from .runner import make_parser, parse_options, timed, warm_up
from .timed_run import advance

SAMPLE_SECONDS = 0.05  # approximate wall time of a sample
GUESSED_SECONDS_PER_TET = 12e-9  # of a step, to size a sample; measured on the CPU: 5 to 30 ns
GUESSED_LAUNCHES = {"cpu": 0.0, "cuda": 200e-6}  # s per step: on CUDA a step is several launches
LONGEST_FALL = 0.5  # s: the beam is bent, and St. Venant-Kirchhoff does not fold yet
MAX_STEPS = 10_000
IMPLICIT, GUESSED_IMPLICIT = "implicit_euler", 250  # and its step over an explicit one, to size a sample
FRAME = 84  # explicit steps in a frame
REPEATS, QUICK_REPEATS = 15, 5
# Limit of a step on this machine, f32: 7 us at 540 tets, 11 ns per tet at 34,560.
STEP_LIMIT = {540: 7e-6, 34_560: 34_560 * 11e-9}  # s
RATIO_LIMIT = {"SVK": 1.0, "COR": 3.0}  # cost over that of stable neo-Hookean
RUN_LIMIT = 1.05  # of explicit steps in a run over steps alone


@dataclass
class Cost:
    """Cost of one law, integrator, precision and mesh: seconds per step of each sample, alone and in a run."""

    tets: int
    law: str
    integrator: str
    precision: str
    compile_seconds: float
    samples: list[float] = field(default_factory=list)
    in_run: list[float] = field(default_factory=list)

    @property
    def timing(self) -> Timing:
        """Timing of one step [s]."""
        return summarise(self.samples)

    @property
    def run_ratio(self) -> Timing | None:
        """Time of a step in a run over that of a step alone."""
        return summarise(a / b for a, b in zip(self.in_run, self.samples)) if self.in_run else None

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"step_seconds": asdict(self.timing)}


def measure_costs(cells, precision: str, arch: str, repeats: int) -> list[Cost]:
    """Costs on one mesh, from `repeats` samples each."""
    tets = n_tets(cells)
    guess = GUESSED_SECONDS_PER_TET * tets + GUESSED_LAUNCHES[arch]
    steps = min(MAX_STEPS, max(1, round(SAMPLE_SECONDS / guess)))
    dt = min(SAMPLE / explicit_steps(beam_scene(cells)), LONGEST_FALL / steps)
    kinds = [(law, integrator, dt, steps, min(steps, FRAME)) for integrator in EXPLICIT for law in LAWS]
    kinds.append(("SNH", IMPLICIT, 1 / 60, max(1, steps // GUESSED_IMPLICIT), 1))
    with ExitStack() as stack:
        found = []
        for law, integrator, dt, n, frame in kinds:
            made = ts.Simulator(beam_scene(cells, law), dt=dt, integrator=integrator, precision=precision, arch=arch)
            sim = stack.enter_context(made)
            warm_up(sim)
            found.append((sim, n, frame, Cost(tets, law, integrator, precision, sim.compile_seconds)))
        for _ in range(repeats):
            for sim, n, frame, cost in found:
                sim.reset()
                cost.samples.append(advance(sim, n).seconds / n)
                if cost.law == "SNH":
                    sim.reset()
                    report, seconds = timed(partial(sim.run, n * sim.dt, fps=1.0 / (frame * sim.dt)))
                    cost.in_run.append(seconds / report.steps)
    return [cost for *_, cost in found]


def cost_ratio(costs: Sequence[Cost], one: Cost) -> Timing | None:
    """Cost over that of stable neo-Hookean, sample by sample. costs: among them that with the same mesh and integrator."""
    kind = (one.tets, one.precision, one.integrator, "SNH")
    beside = next((c for c in costs if (c.tets, c.precision, c.integrator, c.law) == kind), None)
    return summarise(a / b for a, b in zip(one.samples, beside.samples)) if beside else None


def cost_table(costs: Sequence[Cost]) -> str:
    """A row per cost, with its ratio to stable neo-Hookean and that of steps in a run."""

    def ratio(found: Timing | None) -> str:
        return "" if found is None else f"{found.median:.2f}"

    columns = [("tets", "{.tets:,}"), *((f"<{name}", f"{{.{name}}}") for name in ("precision", "integrator", "law"))]
    columns += [
        ("us/step", lambda cost: f"{1e6 * cost.timing.median:.2f}"),
        ("minimum", lambda cost: f"{1e6 * cost.timing.minimum:.2f}"),
        ("spread", lambda cost: percent(spread_of(cost.timing))),
        ("ns/tet", lambda cost: f"{1e9 * cost.timing.median / cost.tets:.2f}"),
        ("/ SNH", lambda cost: ratio(cost_ratio(costs, cost))),
        ("in a run / alone", lambda cost: ratio(cost.run_ratio)),
        ("compile [s]", "{.compile_seconds:.2f}"),
    ]
    return table(costs, columns)


def cost_limits(costs: Sequence[Cost]) -> list[Limit]:
    """The limits on SNH's step, alone and in a run, and on the ratios of the other laws to it, in f32 and explicit steps."""
    limits = []
    for cost in costs:
        if cost.precision != "f32" or cost.integrator not in EXPLICIT:
            continue
        where, t, ratio, run = f"{cost.integrator}, {cost.tets:,} tets", cost.timing, cost_ratio(costs, cost), cost.run_ratio
        if cost.law == "SNH" and cost.tets in STEP_LIMIT:
            unit, scale = ("us/step", 1e6) if cost.tets == 540 else ("ns/tet", 1e9 / cost.tets)
            limits.append(Limit(f"SNH step, {where} [{unit}]", scale * t.median, scale * STEP_LIMIT[cost.tets], spread_of(t)))
        if cost.law in RATIO_LIMIT and ratio is not None:
            limits.append(Limit(f"{cost.law} / SNH, {where}", ratio.median, RATIO_LIMIT[cost.law], spread_of(ratio)))
        if run is not None:
            limits.append(Limit(f"step in a run / step alone, {where}", run.median, RUN_LIMIT, spread_of(run)))
    return limits


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("elasticity", __doc__)
    parser.add_argument("--quick", action="store_true", help="two small meshes, f32")
    options = parse_options(parser, argv)
    document, numbers = begin("Elasticity: the falling beam")
    device = cuda().removeprefix("yes: ") if options.arch == "cuda" else None
    document.add(f"taisoft on {device or 'one thread of the processor'}")
    costs = []
    document.add("## Cost of a step")
    for precision in ("f32",) if options.quick else ("f32", "f64"):
        for cells in MESHES[:2] if options.quick else MESHES:
            found = measure_costs(cells, precision, options.arch, QUICK_REPEATS if options.quick else REPEATS)
            document.add(cost_table(found))
            costs += found
    document.finish(options, numbers | {"device": device, "cost": costs}, cost_limits(costs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
