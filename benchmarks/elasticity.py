"""The falling beam in taisoft and MuJoCo: cost of a step, alone and in sim.run, time and error of whole runs.

taisoft bench elasticity [--arch cpu|cuda] [--quick] [--no-peers] [--out [FILE.json]]

A beam 4 x 1 x 1 m, E = 1 MPa, nu = 0.3, 1000 kg/m^3, clamped at one end, falls under 9.8 m/s^2 from rest. Both programs
use the same tets (five per cell) and lumped masses and, in the runs, St. Venant-Kirchhoff material. The error is that of
time integration alone: the largest distance of the tip (mean of the end face) to the path of the same mesh exact in
time, over its largest excursion, up to 1 s; in brackets up to 0.8 s, since tets invert at the clamp after that. Spread is
the interquartile range over the median. The exit status is 0 also if limits are not met. --out writes the page, FILE.md,
and all numbers, FILE.json. A full run takes about a quarter of an hour on two cores; do not edit the package meanwhile,
since kernels are compiled from it.
"""

import sys
from dataclasses import dataclass

from taisoft.cli.doctor import cuda
from taisoft.errors import SimulationError
from taisoft.machine import Timing, load_average
from taisoft.output.tables import percent, spread_of

from .document import Document, Limit, begin, limit_table, load_text, table
from .elasticity_runs import MUJOCO, TAISOFT, Row, make_rows, measure_rows, n_tets, time_ratio
from .elasticity_steps import cost_limits, cost_table, frame_limits, frame_table, measure_costs, measure_frames
from .exact_path import MESHES, SECONDS
from .programs.mujoco_flex import run_mujoco
from .runner import add_arch, add_named_out, make_parser, named_out

TARGET_MESH = MESHES[-1]  # the mesh with targets for implicit runs
SPEED_TARGET, ERROR_TARGET = 3.0, 0.0015  # minimum of MuJoCo's time over ours; maximum error of a path
# Compared runs: our integrator, MuJoCo's, and its steps per step of the first of its rows. Explicit integrators run at
# their largest steps, implicit ones at 10 ms, and MuJoCo's also at 2.5 ms, where its error is closer to ours.
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
    """Extent of the measurement. rounds: per mesh; repeats: samples of a step's cost; seconds: simulated time of a run."""

    meshes: tuple
    precisions: tuple[str, ...]
    repeats: int
    rounds: tuple[int, ...]
    seconds: float = SECONDS


FULL = Extent(MESHES, ("f32", "f64"), repeats=15, rounds=(3, 3, 3))
QUICK = Extent(MESHES[:2], ("f32",), repeats=5, rounds=(1, 1))


def run_table(rows: list[Row]) -> str:
    """A row per run, with failures and notes below."""

    def timing(cell) -> str:
        return lambda row: cell(row, row.timing) if row.timing else "-"

    columns = (
        ("tets", "{.tets:,}"),
        ("<program", "{.program}"),
        ("<integrator", "{.integrator}"),
        ("dt [ms]", lambda row: f"{1e3 * row.dt:.3f}"),
        ("us/step", timing(lambda row, t: f"{1e6 * row.dt * t.median:.1f}")),
        ("spread", timing(lambda row, t: percent(spread_of(t)))),
        ("s/sim. s", timing(lambda row, t: f"{t.median:.4f}")),
        ("error", lambda row: "-" if row.error is None else f"{row.error:.4%}"),
        ("(0.8 s)", lambda row: "-" if row.error is None else f"({row.error_unfolded:.4%})"),
        ("build [s]", lambda row: f"{row.build_seconds[0]:.2f}" if row.build_seconds else "-"),
        ("of which compiling", lambda row: f"{row.compile_seconds[0]:.2f}" if row.compile_seconds else "-"),
    )

    def troubles(row: Row) -> str:
        run = row.first_run
        return f"{run.unconverged} of {run.steps} steps did not converge" if run and run.unconverged else ""

    notes = [
        f"{row.program} {row.integrator}, dt = {1e3 * row.dt:.3f} ms: {text}"
        for row in rows
        for text in (row.failure, row.note, troubles(row))
        if text
    ]
    return table(rows, columns, notes)


def compare(rows: list[Row]) -> list[tuple[Row, Row, Timing]]:
    """(our row, MuJoCo's row, ratio of the times) of each of PAIRS that ran on this mesh."""
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
    """A row per pair."""

    def name(row: Row) -> str:
        return f"{row.integrator}, {1e3 * row.dt:.3f} ms"

    def error(row: Row) -> str:
        return "-" if row.error is None else f"{row.error:.4%} ({row.error_unfolded:.4%})"

    columns = (
        ("tets", "{[0].tets:,}"),
        ("<taisoft", lambda pair: name(pair[0])),
        ("error (0.8 s)", lambda pair: error(pair[0])),
        ("<MuJoCo", lambda pair: name(pair[1])),
        ("error (0.8 s)", lambda pair: error(pair[1])),
        ("MuJoCo's time / taisoft's", "{[2].median:.2f}"),
        ("spread", lambda pair: percent(spread_of(pair[2]))),
    )
    return table(pairs, columns)


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


def peer_problem() -> str | None:
    """Why MuJoCo is not available, or None."""
    try:
        run_mujoco(MESHES[0], "discrete", 0.01, seconds=0.01)
    except SimulationError as error:
        return str(error)
    return None


def measure(extent: Extent, arch: str, peers: bool) -> tuple[Document, dict]:
    """Measure and print everything; returns the page and the numbers."""
    document, numbers = begin("Elasticity: the falling beam", packages=("taichi", "mujoco-core", "numpy", "scipy"))
    device = cuda().removeprefix("yes: ") if arch == "cuda" else None
    where = f"taisoft on {device}, MuJoCo on the processor" if device else "both programs on the processor"
    document.add(f"{where}, each on one thread of the processor")
    problem = peer_problem() if peers else "left out with --no-peers"
    if problem:
        document.add(f"MuJoCo is not compared with: {problem}.")
    costs, frames, runs = [], [], []
    document.add("## Cost of an explicit step")
    for precision in extent.precisions:
        for cells in extent.meshes:
            found = measure_costs(cells, precision, arch, extent.repeats)
            document.add(cost_table(found))
            costs += found
    document.add("## Steps in a run at 60 frames per second and steps alone, stable neo-Hookean, f32")
    for found in measure_frames(extent.meshes, arch, extent.repeats):
        document.add(frame_table(found))
        frames += found
    document.add(f"## Runs over {extent.seconds:g} s, St. Venant-Kirchhoff, taisoft in f32, MuJoCo in f64")
    for cells, rounds in zip(extent.meshes, extent.rounds):
        rows = make_rows(cells, arch, problem is None, extent.seconds)
        measure_rows(rows, cells, arch, rounds, extent.seconds)
        document.add(run_table(rows))
        if pairs := compare(rows):
            document.add(compare_table(pairs))
        runs += rows
    limits = cost_limits(costs) + frame_limits(frames) + run_limits(runs)
    document.add("## Limits\n\n" + limit_table(limits))
    load = load_average()
    document.add(f"Load at the end: {load_text(load)}")
    numbers |= {"device": device, "arch": arch, "load_at_the_end": load, "mujoco_left_out": problem}
    return document, numbers | {"cost": costs, "frames": frames, "runs": runs, "limits": limits}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("elasticity", __doc__)
    add_arch(parser)
    parser.add_argument("--quick", action="store_true", help="two small meshes, f32, one round")
    parser.add_argument("--no-peers", action="store_true", help="leave MuJoCo out")
    add_named_out(parser)
    options = parser.parse_args(argv)
    out = named_out(options, "elasticity")
    document, numbers = measure(QUICK if options.quick else FULL, options.arch, not options.no_peers)
    if out is not None:
        document.write(out, numbers | {"quick": options.quick})
    return 0


if __name__ == "__main__":
    sys.exit(main())
