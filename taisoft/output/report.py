"""Reports of a run: its progress on a stream, and its result in `report.json` and `steps.csv`, with settings and machine.

report.json holds the RunReport, with extremes over the steps in place of the steps; steps.csv holds one StepReport per row, and
its details in further columns, where a pair that did not press in a step has zeros.
JSON has no NaN: numbers that are not finite are null there, and counted in the extremes.
"""

import dataclasses
import json
import math
import sys
import time
from pathlib import Path
from typing import TextIO

import numpy as np

from taisoft.errors import OutputError, reason
from taisoft.files import write_bytes
from taisoft.machine import PACKAGES, machine, peak_memory, versions
from taisoft.output.folder import Observer
from taisoft.output.tables import csv_text, read_table
from taisoft.records import RunReport, StepReport, headings

LINE_EVERY = 5.0  # time between lines of progress if the stream is not a terminal [s]
COLUMNS = [f.name for f in dataclasses.fields(StepReport) if f.name != "details"]
NUMERIC = [f.name for f in dataclasses.fields(StepReport) if f.type in (int, float) and f.name != "time"]


def frame_rate(folder: str | Path) -> float:
    """Return the frames per second of simulated time [1/s] of a run in a folder. Raises OutputError."""
    path = Path(folder) / "report.json"
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))["settings"]
        return float(settings["fps"] or 1.0 / settings["dt"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{path}: the frame rate of the run cannot be read: {reason(error)}") from None


def write_report(folder: str | Path, result: RunReport, *, resumed: dict | None = None, **entries) -> None:
    """Write report.json and steps.csv into folder. Raises OutputError.

    resumed: the checkpoint that the run resumed from, with its `time` [s]; rows up to that time in the folder's steps.csv are
    kept, while the report covers only the steps since. entries: what else the report holds, such as every resolved setting of
    the run. Values may be plain, NumPy, paths or dataclasses; anything else is written as its text.
    """
    folder = Path(folder)
    end = -math.inf if resumed is None else resumed["time"] * (1.0 + 1e-12)
    earlier = read_table(folder / "steps.csv", lambda row: float(row[0]) <= end)
    write_bytes(folder / "steps.csv", steps_csv(result.step_reports, earlier).encode())
    record = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name != "step_reports"}
    record |= {"extremes": extremes(result.step_reports), "resumed": resumed, **entries}
    record |= {"versions": versions(*PACKAGES), "machine": machine(named=True), "peak_memory_bytes": peak_memory()}
    write_bytes(folder / "report.json", json_text(record).encode())


def body_records(scene) -> list[dict]:
    """Describe each body of a scene: name, laws, least and largest young [Pa] and poisson at rest, order, numbers of regions
    with own materials, of vertices, tets, nodes and connected pieces."""
    return [
        {
            "name": b.name,
            "law": " and ".join(b.composition.laws),
            **{name: [float(np.min(x := getattr(b, name))), float(np.max(x))] for name in ("young", "poisson")},
            "regions": len(b.composition.materials) if b.composition.has_regions else 0,
            "order": b.order,
            "vertices": b.mesh.n_verts,
            "tets": b.mesh.n_tets,
            "nodes": b.n_nodes,
            "pieces": b.mesh.n_components,
        }
        for b in scene.bodies
    ]


def extremes(reports: list[StepReport]) -> dict:
    """Return, per numeric field of StepReport, min and max of the finite values, their times [s], and the count of other values.

    `not_converged` and `ended_on_budget` count reports; without reports the dict is empty.
    """
    if not reports:
        return {}
    times = np.array([r.time for r in reports])
    found: dict = {"reports": len(reports), "not_converged": sum(not r.converged for r in reports)}
    found["ended_on_budget"] = sum(r.on_budget for r in reports)
    table = {name: [getattr(r, name) for r in reports] for name in NUMERIC}
    table |= {heading: [r.details.get(heading, 0.0) for r in reports] for heading in headings(reports)}
    for name, given in table.items():
        values = np.array(given, dtype=float)
        finite = np.flatnonzero(np.isfinite(values))
        entry: dict = {"not_finite": len(values) - len(finite)}
        if len(finite):
            low, high = finite[values[finite].argmin()], finite[values[finite].argmax()]
            kind = int if all(isinstance(given[k], int) for k in (low, high)) else float
            entry |= {"min": kind(values[low]), "max": kind(values[high])}
            entry |= {"time_of_min": times[low], "time_of_max": times[high]}
        found[name] = entry
    return found


def steps_csv(reports: list[StepReport], earlier: tuple[list[str], list[list[str]]]) -> str:
    """Return the reports as CSV text (RFC 4180): a header, earlier rows, and a row per report; problems are joined with '; '.

    earlier: an earlier header with its rows. Details that these did not have are 0 there if they had others of that kind.
    """
    header, rows = earlier if earlier[0][: len(COLUMNS)] == COLUMNS and earlier[1] else ([], [])
    before, own = header[len(COLUMNS) :], headings(reports)
    new, kinds = [heading for heading in own if heading not in before], {heading.split()[0] for heading in before}
    filled = [0.0 if heading.split()[0] in kinds else "" for heading in new]
    asked, columns = {heading.split()[0] for heading in own}, [*COLUMNS, *before, *new]
    records = (report.to_dict() for report in reports)
    own_rows = ([row.get(name, 0.0 if name.split()[0] in asked else "") for name in columns] for row in records)
    return csv_text([columns, *([*row, *filled] for row in rows), *own_rows])


def json_text(record: dict) -> str:
    """Return the record as standard JSON text: numbers that are not finite become null."""
    return json.dumps(_plain(record), indent=1, allow_nan=False) + "\n"


def _plain(value):
    """Convert a value to JSON types."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple | set):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


class Bar:
    """Progress on a stream: a bar on a terminal, elsewhere a line every few seconds. form: of what is done and the total."""

    def __init__(self, total: float, label: str, stream: TextIO, form: str):
        self._total, self._label, self._stream, self._form = total, label, stream, form
        self._last_line: float | None = None
        self._bar = None
        if stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = TextColumn("{task.description}"), BarColumn(bar_width=30), TextColumn("{task.fields[note]}")
            self._bar = Progress(*columns, console=Console(file=stream), refresh_per_second=5, transient=False)
            self._bar.add_task(label, total=total, note="starting")
            self._bar.start()

    def say(self, text: str) -> None:
        """Print a line."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(f"{self._label}: {text}", file=self._stream, flush=True)

    def show(self, done: float, text: str, now: float) -> None:
        """Show what is done, with a text. now: wall time [s]."""
        text = f"{self._form.format(done, self._total)}, {text}"
        self._last_line = now if self._last_line is None else self._last_line
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=min(done, self._total), note=text)
        elif now - self._last_line >= LINE_EVERY:
            self._last_line = now
            self.say(text)

    def close(self) -> None:
        """Stop the bar; a second call does nothing."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class Progress(Bar, Observer):
    """Observer that shows the progress of a run of `seconds` [s] of simulated time on a stream (stderr by default): a Bar with
    steps/s and the remaining time."""

    def __init__(self, seconds: float, label: str = "run", stream: TextIO | None = None):
        super().__init__(seconds, label, stream or sys.stderr, "{:.3f} of {:g} s")
        self.seconds = seconds
        self._started: float | None = None  # wall time of the first frame; construction and compilation come before
        self._first_time = self._compiled = self._time = 0.0
        self._text = "starting"
        self._first_step = 0

    def frame(self, sim, index: int) -> None:
        """Show sim.time, and the speed since the first frame without compiling, which does not go on."""
        now = time.perf_counter()
        if self._started is None:
            self._started, self._first_time, self._first_step = now, sim.time, sim.step_count
            self._compiled = sim.compile_seconds
        self._time, self._text = sim.time, self._speed(sim, now - self._started - (sim.compile_seconds - self._compiled))
        self.show(self._time, self._text, now)

    def iteration(self, n: int) -> None:
        """Show how many Newton iterations a long step has taken so far, as `Simulator.run` calls it."""
        self.show(self._time, f"{self._text}, a step with {n} Newton iterations so far", time.perf_counter())

    def _speed(self, sim, elapsed: float) -> str:
        done = sim.time - self._first_time
        if elapsed <= 0 or done <= 0:
            return "starting"
        rate = (sim.step_count - self._first_step) / elapsed
        left = max(self.seconds - sim.time, 0.0) * elapsed / done
        return f"{rate:.4g} steps/s, {clock_text(left)} left"


def clock_text(seconds: float) -> str:
    """Format seconds as h:mm:ss or m:ss."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"
