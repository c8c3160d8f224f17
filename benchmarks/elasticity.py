"""The falling beam, taisoft beside MuJoCo: cost of a step, alone and in sim.run, time and error of whole runs, memory.

taisoft bench elasticity [--arch cpu|cuda] [--quick] [--no-peers] [--out [FILE.json]]

A beam 4 x 1 x 1 m, E = 1 MPa, nu = 0.3, 1000 kg/m^3, clamped at one end, falls under 9.8 m/s^2 from rest. Both programs
have the same tets (five a cell) and lumped masses and, in the runs, St. Venant-Kirchhoff material. The error is that of
time integration alone: the largest distance of the tip, the mean of the end face, to the path of the same mesh exact in
time, over its largest excursion, up to 1 s; in brackets up to 0.8 s, since from then on this law folds at the clamp and
tets turn inside out. Spread is the distance between the quartiles over the median. Nothing here passes or fails: limits
are marked as met or not. --out writes what is printed, as FILE.md, and all numbers, as FILE.json. The whole takes about
a quarter of an hour on two cores; leave the package's files alone meanwhile, since kernels are compiled from them.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from taisoft.errors import SimulationError
from taisoft.output.tables import markdown, percent, spread_of
from taisoft.timing import Timing, load_average

from .document import RESULTS, Document, check_out, default_out, header, load_text
from .elasticity_beam import measure_memory, n_tets
from .elasticity_cost import Cost, cost_limits, cost_table, measure_costs
from .elasticity_frames import frame_limits, frame_table, measure_frames
from .elasticity_runs import MUJOCO, TAISOFT, Row, make_rows, measure_rows, time_ratio
from .elasticity_table import Limit, limit_table
from .exact_path import MESHES, SECONDS
from .programs.mujoco_flex import run_mujoco

TARGET_MESH = MESHES[-1]  # whose implicit runs have targets
SPEED_TARGET, ERROR_TARGET = 3.0, 0.0015  # MuJoCo's time over ours, at least; error of a path, at most
MEMORY_LIMIT = 1000.0  # bytes of fields per tet, f32
# What is set beside each other: our integrator, theirs, and the steps theirs takes for one of the first in its rows:
# explicit ones at their largest steps, implicit ones at 10 ms, and theirs at a quarter of that, nearer to our error.
PAIRS = (
    ("velocity_verlet", "euler_staggered", 1),
    ("symplectic_euler", "euler", 1),
    ("bdf2", "discrete", 1),
    ("implicit_midpoint", "discrete", 1),
    ("bdf2", "discrete", 4),
    ("implicit_midpoint", "discrete", 4),
)


@dataclass(frozen=True)
class Extent:
    """How much is measured. rounds: for each mesh; repeats: samples of a step's cost; seconds: simulated in a run."""

    meshes: tuple
    precisions: tuple[str, ...]
    repeats: int
    rounds: tuple[int, ...]
    seconds: float = SECONDS


FULL = Extent(MESHES, ("f32", "f64"), repeats=15, rounds=(3, 3, 3))
QUICK = Extent(MESHES[:2], ("f32",), repeats=5, rounds=(1, 1))


def run_table(rows: list[Row]) -> str:
    """A row a run, with the failures and notes below."""
    lines = []
    for row in rows:
        t, scale = row.timing, 1e6 * row.dt
        step = ("-", "-", "-") if t is None else (f"{scale * t.median:.1f}", percent(spread_of(t)), f"{t.median:.4f}")
        build, compiled = (f"{x[0]:.2f}" if x else "-" for x in (row.build_seconds, row.compile_seconds))
        error = (f"{row.error:.4%}", f"({row.error_unfolded:.4%})") if row.error is not None else ("-", "-")
        lines.append((f"{row.tets:,}", row.program, row.integrator, f"{1e3 * row.dt:.3f}", *step, *error, build, compiled))
    headings = (
        "tets",
        "program",
        "integrator",
        "dt [ms]",
        "us/step",
        "spread",
        "s/sim. s",
        "error",
        "(0.8 s)",
        "build [s]",
        "of it compiling",
    )
    notes = [
        f"* {row.program} {row.integrator}, dt = {1e3 * row.dt:.3f} ms: {text}"
        for row in rows
        for text in (row.failure, row.note, _troubles(row))
        if text
    ]
    return markdown(headings, lines, left=(1, 2)) + ("\n\n" + "\n".join(notes) if notes else "")


def _troubles(row: Row) -> str:
    """What the first run's reports tell that a reader must know."""
    run = row.first_run
    return f"{run.unconverged} of {run.steps} steps did not converge" if run and run.unconverged else ""


def compare(rows: list[Row]) -> list[tuple[Row, Row, Timing]]:
    """Our row, MuJoCo's, and its time over ours, for each of PAIRS that has run on this mesh."""
    found = []
    for own, other, finer in PAIRS:
        ours = next((row for row in rows if (row.program, row.integrator) == (TAISOFT, own)), None)
        others = [row for row in rows if (row.program, row.integrator) == (MUJOCO, other)]
        theirs = next((row for row in others if row.steps == finer * others[0].steps), None)
        ratio = time_ratio(theirs, ours) if ours and theirs else None
        if ratio is not None:
            found.append((ours, theirs, ratio))
    return found


def compare_table(pairs: list[tuple[Row, Row, Timing]]) -> str:
    """A row a pair."""
    lines = [
        (f"{a.tets:,}", *(text for row in (a, b) for text in _named(row)), f"{ratio.median:.2f}", percent(spread_of(ratio)))
        for a, b, ratio in pairs
    ]
    headings = ("tets", "taisoft", "error (0.8 s)", "MuJoCo", "error (0.8 s)", "MuJoCo's time / taisoft's", "spread")
    return markdown(headings, lines, left=(1, 3))


def _named(row: Row) -> tuple[str, str]:
    error = "-" if row.error is None else f"{row.error:.4%} ({row.error_unfolded:.4%})"
    return f"{row.integrator}, {1e3 * row.dt:.3f} ms", error


def run_limits(rows: list[Row]) -> list[Limit]:
    """The targets of the implicit runs on TARGET_MESH at dt = 10 ms."""
    limits = []
    targets = [row for row in rows if row.tets == n_tets(TARGET_MESH)]
    for ours, theirs, ratio in compare(targets):
        if ours.integrator in ("bdf2", "implicit_midpoint") and theirs.dt == ours.dt:
            what = f"MuJoCo discrete / taisoft {ours.integrator}, {ours.tets:,} tets, time at 10 ms"
            limits.append(Limit(what, ratio.median, SPEED_TARGET, spread_of(ratio), at_least=True))
    for row in targets:
        if row.integrator in ("bdf2", "implicit_midpoint") and row.error is not None:
            for until, error in (("1 s", row.error), ("0.8 s", row.error_unfolded)):
                what = f"error of {row.integrator}, {row.tets:,} tets, dt = 10 ms, up to {until} [%]"
                limits.append(Limit(what, 100 * error, 100 * ERROR_TARGET))
    return limits


def memory_table(rows: list[dict]) -> str:
    """A row a simulator."""

    def mega(value) -> str:
        return "-" if value is None else f"{value / 1e6:.1f}"

    lines = [
        (
            f"{row['tets']:,}",
            row["integrator"],
            mega(row["field_bytes"]),
            "-" if row["bytes_per_tet"] is None else f"{row['bytes_per_tet']:.0f}",
            mega(row["peak_bytes"]),
        )
        for row in rows
    ]
    return markdown(("tets", "integrator", "fields [MB]", "bytes/tet", "peak of the process [MB]"), lines, left=(1,))


def memory_limits(rows: list[dict]) -> list[Limit]:
    """The limit on the bytes of the fields."""
    return [
        Limit(f"bytes of fields per tet, {row['integrator']}, {row['tets']:,} tets, f32", row["bytes_per_tet"], MEMORY_LIMIT)
        for row in rows
        if row["bytes_per_tet"] is not None
    ]


def peer_problem() -> str | None:
    """Why MuJoCo cannot be compared with, in a sentence, or None."""
    try:
        run_mujoco(MESHES[0], "discrete", 0.01, seconds=0.01)
    except SimulationError as error:
        return str(error)
    return None


def opening(arch: str) -> tuple[str, dict]:
    """What is measured where, as text and as data."""
    text, found = header("Elasticity: the falling beam", packages=("taichi", "mujoco", "numpy", "scipy"))
    found |= {"device": None, "arch": arch}
    if arch == "cuda":
        from taisoft.cli.doctor import cuda

        found["device"] = cuda().removeprefix("yes: ")
    where = f"taisoft on {found['device']}, MuJoCo on the processor" if arch == "cuda" else "both programs on the processor"
    return f"{text}\n{where}, and there on one thread each", found


def measure(extent: Extent, arch: str, peers: bool, document: Document) -> dict:
    """Everything, printed as it comes. Returns the numbers."""
    text, numbers = opening(arch)
    document.add(text)
    memory = measure_memory(extent.meshes, arch)  # first: the process's peak is then taisoft's own
    problem = peer_problem() if peers else "left out with --no-peers"
    if problem:
        document.add(f"MuJoCo is not compared with: {problem}.")
    document.add("## Cost of an explicit step")
    costs: list[Cost] = []
    for precision in extent.precisions:
        for cells in extent.meshes:
            found = measure_costs(cells, precision, arch, extent.repeats)
            document.add(cost_table(found))
            costs += found
    document.add("## Steps in a run, 60 frames a second, beside the steps alone, stable neo-Hookean, f32")
    frames = []
    for found in measure_frames(extent.meshes, arch, extent.repeats):
        document.add(frame_table(found))
        frames += found
    document.add(f"## Runs over {extent.seconds:g} s, St. Venant-Kirchhoff, taisoft in f32, MuJoCo in f64")
    runs: list[Row] = []
    for cells, rounds in zip(extent.meshes, extent.rounds):
        rows = make_rows(cells, arch, problem is None, extent.seconds)
        measure_rows(rows, cells, arch, rounds, extent.seconds)
        document.add(run_table(rows))
        if pairs := compare(rows):
            document.add(compare_table(pairs))
        runs += rows
    document.add("## Memory, f32")
    document.add(memory_table(memory))
    limits = cost_limits(costs) + frame_limits(frames) + run_limits(runs) + memory_limits(memory)
    document.add("## Limits")
    document.add(limit_table(limits))
    load = load_average()
    document.add(f"Load at the end: {load_text(load)}")
    return numbers | {
        "load_at_the_end": load,
        "mujoco_left_out": problem,
        "cost": [x.record() for x in costs],
        "frames": [x.record() for x in frames],
        "runs": [x.record() for x in runs],
        "memory": memory,
        "limits": [x.record() for x in limits],
    }


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch cannot be had."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench elasticity", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where taisoft computes (default cpu)")
    parser.add_argument("--quick", action="store_true", help="two small meshes, f32, one round")
    parser.add_argument("--no-peers", action="store_true", help="leave MuJoCo out")
    parser.add_argument(
        "--out",
        type=Path,
        nargs="?",
        const=RESULTS,
        metavar="FILE.json",
        help="write FILE.json and FILE.md too; without a name into benchmarks/results, named after the machine",
    )
    options = parser.parse_args(argv)
    out = options.out
    if out is not None:
        out = default_out(options.arch, "elasticity") if out == RESULTS else out
        check_out(out, ".json")
    document = Document()
    numbers = measure(QUICK if options.quick else FULL, options.arch, not options.no_peers, document)
    if out is not None:
        document.write(out, numbers | {"quick": options.quick})
    return 0


if __name__ == "__main__":
    sys.exit(main())
