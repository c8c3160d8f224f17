"""The check of paths: what it costs in a step, and how it compares with a bound on the displacement of each vertex.

taisoft bench paths [--what cost ways] [--scene NAME ...] [--quick] [--arch cpu|cuda] [--out [FILE.json]]

After each step taisoft checks whether surfaces pass through each other on its paths. *Cost* times steps with this check and
without it, in turns and from the same state, in a window of steps with contacts but no passages, so that both do the same: works
W3 and W4 of `taisoft bench peers`, two demos, and a beam that nothing can touch, where the check must not exist. *Two ways*
captures accepted substeps, says in how many of them no attempt had passages, and asks of each whether it would also obey a bound
as in offset-geometric contact (Chen et al. 2025): a vertex moves by at most 0.45 of the least distance of its faces, edges and
itself from anything they could touch, here by ipctk. "Over the bound" are moving vertices nearer than the margin of contacts; a
ratio is displacement over bound, and so how many times a step would have to be cut and searched again. Both costs are divided by
the number of pairs of triangles that taisoft checks. Obstacles are taken to be at rest. Each scene runs in its own process. Exit
status: 0, or 1 if the beam pays for the check.
"""

import argparse
import importlib.util
import json
import sys
from dataclasses import asdict

import numpy as np

from taisoft.errors import OutputError
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent

from .document import Limit, begin, ms, table, timed_cells
from .path_runs import BEAM, CHECK, COST, LIST, WAYS, Cost, Ways, measure_cost, measure_ways
from .runner import add_arch, add_named_out, make_parser, named_out, parse_result, print_result, progress, run_python

TABLES = {"cost": COST, "ways": WAYS}  # --what -> its scenes
ROUNDS, QUICK_ROUNDS, QUICK_STEPS, QUICK_START = 9, 2, 5, 0.2


def cost_table(rows: list[Cost]) -> str:
    """A row per scene."""
    columns = (
        ("<scene", lambda r: r.name),
        ("dt [ms]", lambda r: ms(r.dt)),
        ("from [s]", lambda r: f"{r.start:.3g}"),
        ("contacts", lambda r: f"{r.contacts}"),
        ("with [ms/step]", lambda r: timed_cells(r.with_check)[0]),
        ("spread", lambda r: timed_cells(r.with_check)[1]),
        ("without", lambda r: timed_cells(r.without)[0]),
        ("spread", lambda r: timed_cells(r.without)[1]),
        ("ratio", lambda r: f"{ratio(r).median:.3f}"),
        ("least to most", lambda r: f"{ratio(r).minimum:.2f} to {ratio(r).maximum:.2f}"),
        ("of the fastest", lambda r: f"{min(r.with_check) / min(r.without):.3f}"),
        (f"{CHECK} a step", lambda r: f"{r.launches[CHECK] / r.steps:.2f}"),
        (f"{LIST} a step", lambda r: f"{r.launches[LIST] / r.steps:.2f}"),
        ("near pairs", lambda r: f"{r.near:,.0f}"),
        ("steps with an old list", lambda r: f"{r.steps - r.relisting} of {r.steps}" if r.launches[CHECK] else "-"),
        ("steps with passages", lambda r: f"{r.passages}"),
        ("same end", lambda r: "yes" if r.same else "NO"),
        ("fields [kB]", lambda r: f"{r.field_bytes / 1e3:.3g}"),
        ("compiling [s]", lambda r: f"{r.compile_seconds:.1f}"),
    )
    return table(rows, columns)


def ratio(row: Cost) -> Timing:
    """Timing of the ratio of both within each round."""
    return summarise(np.divide(row.with_check, row.without))


def ways_table(rows: list[Ways]) -> str:
    """A row per scene."""
    columns = (
        ("<scene", lambda r: r.name),
        ("dt [ms]", lambda r: ms(r.dt)),
        ("substeps", lambda r: f"{r.substeps}"),
        ("check: pass", lambda r: share(r.passing, r.substeps)),
        ("passages", lambda r: f"{r.passages}"),
        ("held back", lambda r: f"{r.held_back}"),
        ("bound: pass", lambda r: share(sum(one <= 1.0 for one in r.ratios), len(r.ratios))),
        ("vertices near contacts", lambda r: f"{r.near:,}"),
        ("over the bound", lambda r: share(r.over, r.near)),
        ("largest ratio: median, 90 %, most", lambda r: ", ".join(f"{np.quantile(r.ratios, q):.3g}" for q in (0.5, 0.9, 1.0))),
        ("pairs a check", lambda r: f"{r.pairs / r.checks:,.0f}"),
        ("check [us/pair]", lambda r: f"{1e6 * r.seconds / r.pairs:.3f}"),
        ("bound [us/pair]", lambda r: per_pair(r, r.bound_seconds)),
        ("with its search", lambda r: per_pair(r, r.bound_seconds + r.search_seconds)),
        ("feature pairs of the bound", lambda r: f"{r.bound_pairs / len(r.ratios):,.0f}"),
    )
    return table(rows, columns)


def share(part: int, whole: int) -> str:
    """A part of a whole in percent, "-" of nothing."""
    return percent(part / whole) if whole else "-"


def per_pair(row: Ways, seconds: float) -> str:
    """Seconds of the bound, once for each captured substep, in microseconds per pair of triangles that a check has."""
    return f"{1e6 * seconds / len(row.ratios) / (row.pairs / row.checks):.3f}"


def find_limits(rows: list[Cost]) -> list[Limit]:
    """What nothing can touch must not pay."""
    beams = [row for row in rows if row.name == BEAM]
    limits = [Limit(f"{BEAM}: launches of {kernel}", row.launches[kernel], 0) for row in beams for kernel in row.launches]
    return limits + [Limit(f"{BEAM}: fields of the check [bytes]", row.field_bytes, 0) for row in beams]


def answer(task: dict) -> None:
    """In a child: measure one scene and print its row."""
    name, quick = task["scene"], task["quick"]
    if task["what"] == "cost":
        numbers = (QUICK_ROUNDS, QUICK_STEPS, QUICK_START) if quick else (ROUNDS,)
        row = measure_cost(name, task["arch"], *numbers)
    else:
        row = measure_ways(name, task["arch"], QUICK_STEPS if quick else WAYS[name])
    print_result(asdict(row))


def run_child(what: str, name: str, arch: str, quick: bool) -> Cost | Ways:
    """The row of a scene, measured in a child process. Raises SimulationError if it fails."""
    task = json.dumps({"what": what, "scene": name, "arch": arch, "quick": quick})
    lines = run_python(name, "-m", "taisoft", "bench", "paths", "--child", task)
    (found,) = filter(None, map(parse_result, lines))
    return (Cost if what == "cost" else Ways)(**found)


def main(argv: list[str] | None = None) -> int:
    """Measure and print. Raises SimulationError if a process fails, OutputError if a file cannot be written."""
    parser = make_parser("paths", __doc__)
    parser.add_argument("--what", nargs="+", choices=TABLES, default=tuple(TABLES), help="only these tables")
    names = tuple(dict.fromkeys([*COST, *WAYS]))
    parser.add_argument("--scene", nargs="+", choices=names, metavar="NAME", help=f"only these: {'; '.join(names)}")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_STEPS} steps of each scene, {QUICK_ROUNDS} rounds")
    add_arch(parser)
    add_named_out(parser)
    parser.add_argument("--child", metavar="TASK", help=argparse.SUPPRESS)  # how this command runs one scene
    options = parser.parse_args(argv)
    if options.child is not None:
        answer(json.loads(options.child))
        return 0
    if "ways" in options.what and importlib.util.find_spec("ipctk") is None:
        raise OutputError("the bound needs ipctk (pip install ipctk); without it, take --what cost")
    options.out = named_out(options, "paths")
    document, numbers = begin("The check of paths", f"arch {options.arch}", packages=("taichi", "numpy", "ipctk"))
    found: dict[str, list] = {what: [] for what in options.what}
    for what, rows in found.items():
        for name in TABLES[what]:
            if options.scene is None or name in options.scene:
                progress(f"{what}: {name}")
                rows.append(run_child(what, name, options.arch, options.quick))
        if rows and what == "cost":
            document.add("## Cost\n\n" + cost_table(rows))
        elif rows:
            document.add("## Two ways\n\n" + ways_table(rows))
    return document.finish(options, numbers | found, find_limits(found.get("cost", [])))


if __name__ == "__main__":
    sys.exit(main())
