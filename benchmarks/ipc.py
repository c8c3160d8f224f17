"""Scenes of incremental potential contact: nine of Li et al. 2020, judged by ipctk after every step.

taisoft bench ipc [--scene NAME ...] [--size small|full] [--budget SECONDS] [--quick] [--friction] [--precision f32|f64]
                  [--tolerance NUMBER] [--steps N] [--out [FILE.json]]

A mat on knives, a ball on points, a house of cards, a masonry arch, a ball between rollers, a body in a funnel, a trash
compactor, a twisted mat and twisted rods, in steps of implicit Euler of the published length with self-collision
(benchmarks/ipc_cases). Full scenes have about the published number of nodes. Each scene runs in its own process until its
simulated time or its budget is reached; the twisted ones also end when surfaces cross. Seconds a step exclude compilation and
judging. The least distance is measured every tenth step, and only below a twentieth of the mean surface edge. Published seconds
are those of the paper, on another machine with many threads. A run is ok, degraded (surfaces crossed, steps did not converge,
inverted tets, deep penetration) or stopped before its end. --friction measures four scenes at three tolerances instead: how fast
contacts creep that must stick, and the work of friction (benchmarks/ipc_friction.py). Exit status: 0, or 1 if a scene ended with
an error or its surfaces crossed.
"""

import argparse
import importlib.util
import math
import sys

import numpy as np

from taisoft.errors import OutputError
from taisoft.machine import load_average

from .document import Document, begin, load_text, table
from .ipc_cases import EXTRA, NAMES, find
from .ipc_cases.case import FULL, SIZES, SMALL
from .ipc_friction import STEPS, TOLERANCES
from .ipc_runs import SKIPPED, Job, Record, answer, mean, run_child
from .runner import add_named_out, make_parser, named_out, progress

BUDGET, QUICK_BUDGET, QUICK_STEPS = 3600.0, 60.0, 3  # [s], [s], steps
TOLERANCE = 1e-4


def jobs(options: argparse.Namespace) -> list[Job]:
    """The runs of the chosen options."""
    size = options.size or (SMALL if options.quick else FULL)
    budget = options.budget if options.budget is not None else (QUICK_BUDGET if options.quick else BUDGET)
    steps = options.steps or (QUICK_STEPS if options.quick else None)
    if not options.friction:
        names = options.scene or NAMES
        return [Job(name, size, budget, options.precision, options.tolerance, steps) for name in names]
    names = options.scene or tuple(STEPS)
    return [
        Job(name, size, budget, options.precision, tolerance, steps or STEPS.get(name), friction=True)
        for name in names
        for tolerance in TOLERANCES
    ]


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


def scene_table(records: list[Record]) -> str:
    """A row per scene."""
    columns = (
        ("<scene", lambda r: r.case.title),
        ("nodes", lambda r: f"{r.nodes:,}"),
        ("tets", lambda r: f"{r.tets:,}"),
        ("dt [s]", lambda r: f"{r.case.dt:g}"),
        ("time [s] (steps)", reached),
        ("Newton", lambda r: number(mean(r.newton))),
        ("CG", lambda r: number(mean(r.cg), ".0f")),
        ("substeps", lambda r: number(mean(r.substeps))),
        ("s/step: mean, median, largest", step_seconds),
        ("compiling [s]", lambda r: f"{r.compile_seconds:.0f}"),
        ("least distance [m]", lambda r: number(r.least_distance)),
        ("crossed", lambda r: f"{r.crossed}"),
        ("not converged", lambda r: f"{r.unconverged}"),
        ("inverted", lambda r: f"{r.inverted}"),
        ("published s/step (other machine)", lambda r: number(r.case.published_seconds)),
        ("<status", lambda r: r.status),
    )
    notes = [f"{record.case.title}: {record.status}, {record.reason}" for record in records if record.reason]
    return table([record for record in records if record.status != SKIPPED], columns, notes)


def friction_table(records: list[Record]) -> str:
    """A row per scene and tolerance."""
    columns = (
        ("<scene", lambda r: r.case.title),
        ("tolerance", lambda r: f"{r.job.tolerance:.0e}"),
        ("time [s] (steps)", reached),
        ("Newton", lambda r: number(mean(r.newton))),
        ("CG", lambda r: number(mean(r.cg), ".0f")),
        ("s/step: mean, median, largest", step_seconds),
        ("creep [edges/s]", lambda r: number(r.creep)),
        ("work of friction [J]", lambda r: number(r.friction_work, ".4g")),
        ("steps in substeps", lambda r: f"{r.cut}"),
        ("crossed", lambda r: f"{r.crossed}"),
        ("<status", lambda r: r.status),
    )
    notes = [
        f"{record.case.title}, {record.job.tolerance:.0e}: {record.status}, {record.reason}"
        for record in records
        if record.reason
    ]
    return table([record for record in records if record.status != SKIPPED], columns, notes)


def failed(record: Record) -> bool:
    """Whether surfaces crossed, or the run ended with an error."""
    return bool(record.crossed) or record.failed


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = make_parser("ipc", __doc__)
    known = (*NAMES, *(case.name for case in EXTRA))
    made.add_argument("--scene", nargs="+", choices=known, metavar="NAME", help=f"only these: {', '.join(known)}")
    made.add_argument("--size", choices=SIZES, help="of the meshes (default full, with --quick small)")
    made.add_argument("--budget", type=float, metavar="SECONDS", help=f"wall time of each scene (default {BUDGET:g})")
    made.add_argument("--quick", action="store_true", help=f"small meshes, {QUICK_STEPS} steps")
    made.add_argument("--steps", type=int, metavar="N", help="at most so many steps of each scene")
    made.add_argument("--friction", action="store_true", help="the table of friction instead")
    made.add_argument("--precision", choices=("f32", "f64"), default="f64", help="(default %(default)s)")
    text = "newton_tolerance and contact_tolerance (default %(default)g)"
    made.add_argument("--tolerance", type=float, default=TOLERANCE, metavar="NUMBER", help=text)
    add_named_out(made)
    made.add_argument("--child", metavar="JOB", help=argparse.SUPPRESS)  # how this command runs one scene
    return made


def main(argv=None) -> int:
    """Measure and print. Raises OutputError."""
    options = parser().parse_args(argv)
    if options.child:
        answer(options.child)
        return 0
    options.arch = "cpu"
    if importlib.util.find_spec("ipctk") is None:
        raise OutputError("taisoft bench ipc needs ipctk, which is missing: pip install 'taisoft[dev]'")
    out = named_out(options, "ipc_friction" if options.friction else "ipc")
    document, numbers = begin("Scenes of incremental potential contact", "cpu", packages=("taichi", "numpy", "ipctk"))
    document.add(__doc__.partition("\n\n")[2].partition("\n\n")[2].strip())
    records = measure(jobs(options), document, options.friction)
    if out is not None:
        chosen = {"arch": options.arch, "quick": options.quick, "load_at_the_end": load_average()}
        document.write(out, chosen | numbers | {"friction": options.friction, "runs": [record.data() for record in records]})
    return 1 if any(failed(record) for record in records) else 0


def measure(chosen: list[Job], document: Document, friction: bool = False) -> list[Record]:
    """Run the jobs one after the other and add their table."""
    records = []
    for job in chosen:
        progress(f"{find(job.case).title}, {job.size}, tolerance {job.tolerance:g}")
        records.append(run_child(job))
        progress(f"  {records[-1].steps} steps: {records[-1].status} {records[-1].reason}")
    document.add(friction_table(records) if friction else scene_table(records))
    document.add(f"Load at the end: {load_text(load_average())}")
    return records


if __name__ == "__main__":
    sys.exit(main())
