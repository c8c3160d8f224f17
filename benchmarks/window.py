"""Live window: speed over real time, pictures per second, and latency of drags, for demos with contacts.

taisoft bench window [--quick] [--only NAME,...] [--out FILE.json]

Every demo with contacts and up to 5,000 tets runs in a window on a virtual display (Xvfb), drawn by the Vulkan driver of this
machine, which may be one in software. First a run without a window, which also compiles, is timed; then the same time is run in
the window by the clock, and a body is dragged to and fro by the mouse (xdotool); then both once more, with a budget of wall time
for its implicit steps. Speeds are simulated over wall time: the window's is 1 at most. The latency is the wall time from the last
look at the mouse that did not see a movement to a picture of a state whose step has used it. Run nothing else meanwhile.
Last, the run without a window is repeated with all launches timed, for a table of what its steps spend, see `kinds.py`.
Exit status: 0, or 1 if fewer than 20 pictures per second are shown, or the latency is above 100 ms where the simulation keeps up
with the clock, without a budget.
"""

import sys
from pathlib import Path
from statistics import median

import numpy as np

from taisoft.cli.scene_file import load_scene, shipped_files
from taisoft.errors import MissingPackage

from . import window_child
from .children import in_child
from .document import Limit, begin, check_out, table
from .kinds import JOINED
from .runner import make_parser, progress, without_warnings
from .virtual_display import VirtualDisplay

MAX_TETS = 5000
QUICK = ("cube_on_box",)
PICTURES, LATENCY = 20.0, 0.1  # required pictures per second; latency [s]
KEEPS_UP = 0.95  # speed from which on a simulation keeps up with the clock


def demos() -> list[str]:
    """Names of the demos with contacts and at most MAX_TETS tets, but for those whose extra is not installed."""
    found = []
    with without_warnings():
        for name in shipped_files("demos"):
            try:
                scene, solver = load_scene(name)
            except MissingPackage:
                continue
            tets = sum(len(body.mesh.tets) for body in scene.bodies)
            if tets <= MAX_TETS and scene.pushes(bool(solver.get("self_collision"))):
                found.append(name)
    return found


def measure(name: str, display: VirtualDisplay) -> dict:
    """Results of a demo, see `window_child.py`. Raises SimulationError if its process fails."""
    return {"demo": name} | in_child(name, window_child.measure, name, environment=display.environment)


def pictures_per_second(row: dict) -> float:
    """Pictures per second in the window while it runs by the clock, from the median time between two."""
    return 1.0 / median(row["intervals"])


def latency(row: dict, quantile: float) -> float:
    """A quantile of the latencies of a drag [s]; nan without any."""
    return float(np.quantile(row["latencies"], quantile)) if row["latencies"] else float("nan")


def window_table(rows: list[dict]) -> str:
    """A row per demo."""
    columns = (
        ("<demo", "{[demo]}"),
        ("tets", "{[tets]:,}"),
        ("dt [ms]", lambda row: f"{1e3 * row['dt']:.3g}"),
        ("step [ms]", lambda row: f"{1e3 * row['step']:.3g}"),
        ("longest", lambda row: f"{1e3 * row['longest_step']:.3g}"),
        ("speed without window", lambda row: f"{row['alone']:.2f}"),
        ("in it", lambda row: f"{row['speed']:.2f}"),
        ("pictures/s", lambda row: f"{pictures_per_second(row):.0f}"),
        ("longest [ms]", lambda row: f"{1e3 * max(row['intervals']):.0f}"),
        ("drag after [ms]", lambda row: f"{1e3 * latency(row, 0.5):.0f}"),
        ("95 %", lambda row: f"{1e3 * latency(row, 0.95):.0f}"),
    )
    with_budget = (
        ("speed with budget", lambda row: f"{row['budget']['speed']:.2f}"),
        ("longest step with budget over the median", lambda row: f"{row['budget']['longest_step'] / row['budget']['step']:.1f}"),
        ("steps ended on budget [%]", lambda row: f"{100 * row['budget']['ended']:.0f}"),
        ("largest residual", lambda row: f"{row['budget']['residual']:.1g}"),
        ("95 % of drags with budget [ms]", lambda row: f"{1e3 * latency(row['budget'], 0.95):.0f}"),
    )
    return table(rows, columns + with_budget if all("budget" in row for row in rows) else columns)  # older results have none


def kinds_table(rows: list[dict]) -> str:
    """A row per demo: percent of a mean step by kind."""

    def percent_of(kind: str):
        return lambda row: f"{100 * row['kinds']['seconds'][kind] / sum(row['kinds']['seconds'].values()):.0f}"

    columns = (
        ("<demo", "{[demo]}"),
        ("step without window [ms]", lambda row: f"{1e3 * row['alone_step']:.3g}"),
        ("sum of kinds", lambda row: f"{1e3 * sum(row['kinds']['seconds'].values()):.3g}"),
        *((f"{kind} [%]", percent_of(kind)) for kind in JOINED),
        ("launches", lambda row: f"{sum(row['kinds']['launches'].values()):,.0f}"),
    )
    return table(rows, columns)


def limits_of(rows: list[dict]) -> list[Limit]:
    """Required pictures per second of all demos, and latency of those that keep up with the clock."""
    found = [Limit(f"{row['demo']}: pictures/s", pictures_per_second(row), PICTURES, at_least=True) for row in rows]
    fast = [row for row in rows if row["speed"] >= KEEPS_UP]
    return found + [Limit(f"{row['demo']}: median latency [s]", latency(row, 0.5), LATENCY) for row in fast]


def main(argv=None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written or a tool is missing."""
    parser = make_parser("window", __doc__)
    parser.add_argument("--quick", action="store_true", help="one demo, no limits")
    parser.add_argument("--only", metavar="NAME,...", help="some demos")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    display = VirtualDisplay()
    try:
        document, numbers = begin("Live window", "arch cpu", "on a virtual display")
        rows = []
        for name in options.only.split(",") if options.only else QUICK if options.quick else demos():
            progress(name)
            rows.append(measure(name, display))
    finally:
        display.close()
    document.add(window_table(rows))
    document.add("## What a mean step without a window spends\n\n" + kinds_table(rows))
    return document.finish(options, numbers | {"rows": rows}, [] if options.quick else limits_of(rows))


if __name__ == "__main__":
    sys.exit(main())
