"""Scenes of incremental potential contact: nine of Li et al. 2020, judged by ipctk after every step.

taisoft bench ipc [--only NAME ...] [--size small|full] [--seconds SECONDS] [--quick] [--friction] [--precision f32|f64]
                  [--tolerance NUMBER] [--steps N] [--arch cpu|cuda] [--budget SECONDS] [--keep DIR] [--out [FILE.json]]

A mat on knives, a ball on points, a house of cards, a masonry arch, a ball between rollers, a body in a funnel, a trash
compactor, a twisted mat and twisted rods, in steps of implicit Euler of the published length with self-collision
(benchmarks/ipc_cases). Full scenes have about the published number of nodes. Each scene runs in its own process until its
simulated time is reached or its budget, --seconds, is spent; the twisted ones also end when surfaces cross. Seconds a step
exclude compilation and judging. The least distance is measured every tenth step, and only below a twentieth of the mean surface
edge. Published seconds are those of the paper, on another machine with many threads. A run is ok, degraded (surfaces crossed,
steps did not converge, inverted tets, deep penetration) or stopped before its end. --friction measures four scenes at three
tolerances instead: how fast contacts creep that must stick, and the work of friction (benchmarks/ipc_friction.py). Exit status:
0, or 1 if a scene ended with an error or its surfaces crossed.
"""

import argparse
import math
import sys
from dataclasses import asdict

import numpy as np

from taisoft.machine import load_average, require

from .document import begin, load_text, table
from .ipc_cases import NAMES
from .ipc_cases.case import FULL, SIZES, SMALL
from .ipc_friction import STEPS, TOLERANCES
from .ipc_runs import GRACE, SKIPPED, Job, Record, answer, mean, record_of
from .suite import chosen, runs_of, suite_options, suite_parser

BUDGET, QUICK_BUDGET, QUICK_STEPS = 3600.0, 60.0, 3  # [s], [s], steps
TOLERANCE = 1e-4
FRICTION = "ipc_friction"  # name of the results with friction


def jobs(options: argparse.Namespace) -> dict[str, Job]:
    """The runs of the chosen options, by name."""
    size = options.size or (SMALL if options.quick else FULL)
    budget = options.seconds if options.seconds is not None else (QUICK_BUDGET if options.quick else BUDGET)
    steps = options.steps or (QUICK_STEPS if options.quick else None)
    common = {"size": size, "budget": budget, "precision": options.precision, "arch": options.arch}
    if options.results != FRICTION:
        return {name: Job(name, tolerance=options.tolerance, steps=steps, **common) for name in NAMES}
    return {
        f"{name}, tolerance {tolerance:g}": Job(name, tolerance=tolerance, steps=steps or own, friction=True, **common)
        for name, own in STEPS.items()
        for tolerance in TOLERANCES
    }


def number(value: float | None, form: str = ".3g") -> str:
    """A number, "-" for none."""
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def step_seconds(record: Record) -> str:
    """Mean, median and largest seconds of a step."""
    s = record.seconds
    return f"{mean(s):.3g}, {np.median(s):.3g}, {max(s):.3g}" if s else "-"


def reached(record: Record) -> str:
    """Simulated time reached of that wanted [s], and steps."""
    return f"{record.time:.4g} of {record.wanted_steps * record.case.dt:.4g} ({record.steps})"


SCENE, TIME, CROSSED, STATUS = (
    ("<scene", "{.case.title}"),
    ("time [s] (steps)", reached),
    ("crossed", "{.crossed}"),
    ("<status", "{.status}"),
)
NEWTON, CG = ("Newton", lambda r: number(mean(r.newton))), ("CG", lambda r: number(mean(r.cg), ".0f"))
SECONDS = ("s/step: mean, median, largest", step_seconds)
OF_SCENES = (
    SCENE,
    ("nodes", "{.nodes:,}"),
    ("tets", "{.tets:,}"),
    ("dt [s]", "{.case.dt:g}"),
    TIME,
    NEWTON,
    CG,
    ("substeps", lambda r: number(mean(r.substeps))),
    SECONDS,
    ("compiling [s]", "{.compile_seconds:.0f}"),
    ("least distance [m]", lambda r: number(r.least_distance)),
    CROSSED,
    ("not converged", "{.unconverged}"),
    ("inverted", "{.inverted}"),
    ("published s/step (other machine)", lambda r: number(r.case.published_seconds)),
    STATUS,
)
OF_FRICTION = (
    SCENE,
    ("tolerance", "{.job.tolerance:.0e}"),
    TIME,
    NEWTON,
    CG,
    SECONDS,
    ("creep [edges/s]", lambda r: number(r.creep)),
    ("work of friction [J]", lambda r: number(r.friction_work, ".4g")),
    ("steps in substeps", "{.cut}"),
    CROSSED,
    STATUS,
)


def record_table(records: list[Record]) -> str:
    """A row per scene, or per scene and tolerance."""
    columns = OF_FRICTION if records[0].job.friction else OF_SCENES
    notes = [f"{title(record)}: {record.status}, {record.reason}" for record in records if record.reason]
    return table([record for record in records if record.status != SKIPPED], columns, notes)


def title(record: Record) -> str:
    """What tells a run apart."""
    return record.case.title + (f", {record.job.tolerance:.0e}" if record.job.friction else "")


def failed(record: Record) -> bool:
    """Whether surfaces crossed, or the run ended with an error."""
    return bool(record.crossed) or record.failed


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = suite_parser("ipc", __doc__, f"small meshes, {QUICK_STEPS} steps")
    made.add_argument("--size", choices=SIZES, help="of the meshes (default full, with --quick small)")
    made.add_argument("--seconds", type=float, metavar="SECONDS", help=f"wall time of each scene (default {BUDGET:g})")
    made.add_argument("--steps", type=int, metavar="N", help="at most so many steps of each scene")
    text = "the table of friction instead"
    made.add_argument("--friction", dest="results", action="store_const", const=FRICTION, default="ipc", help=text)
    made.add_argument("--precision", choices=("f32", "f64"), default="f64", help="(default %(default)s)")
    text = "newton_tolerance and contact_tolerance (default %(default)g)"
    made.add_argument("--tolerance", type=float, default=TOLERANCE, metavar="NUMBER", help=text)
    return made


def main(argv=None) -> int:
    """Measure and print. Raises OutputError."""
    made = parser()
    options = suite_options(made, argv, answer)
    require("ipctk", "taisoft bench ipc", "dev")
    asked = chosen(made, options.only, jobs(options))
    document, numbers = begin("Scenes of incremental potential contact", options.arch, packages=("taichi", "numpy", "ipctk"))
    document.add(__doc__.partition("\n\n")[2].partition("\n\n")[2].strip())
    with runs_of("ipc", options, "ipc*.py", "ipc_cases/*.py", "judge.py") as runs:
        requests, most = {name: asdict(job) for name, job in asked.items()}, max(job.budget for job in asked.values()) + GRACE
        found = runs.records(requests, lambda one: f"{len(one['seconds'])} steps: {one['status']} {one['reason']}", most)
        records = [record_of(job, one) for job, one in zip(asked.values(), found)]
    for text in (record_table(records), *runs.store.damaged, f"Load at the end: {load_text(load_average())}"):
        document.add(text)
    numbers |= {"friction": options.results == FRICTION, "runs": records}
    return document.finish(options, numbers) or int(any(map(failed, records)))


if __name__ == "__main__":
    sys.exit(main())
