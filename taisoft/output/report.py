"""`report.json` and `steps.csv`: what a run did, with which settings, on which machine.

report.json holds the RunReport with the extremes over its steps in place of the steps; steps.csv holds one StepReport a
row. JSON has no NaN: a number that is not finite is null there, and counted under the extremes.
"""

import csv
import dataclasses
import io
import json
import math
import os
import platform
import sys
from pathlib import Path

import numpy as np

from taisoft.output.files import write_bytes
from taisoft.records import RunReport, StepReport
from taisoft.timing import processor
from taisoft.timing import versions as installed

PACKAGES = ("taichi", "numpy", "scipy", "usd-core")


def write_report(
    folder: str | Path, result: RunReport, *, arch: str, precision: str, settings: dict, plan: list[dict],
    resumed: dict | None = None, bodies: list[dict] | None = None, buffer_growths: dict[str, int] | None = None,
) -> None:  # fmt: skip
    """Write report.json and steps.csv into folder. Raises OutputError.

    settings: every setting of the run as resolved, by name; plan: the entries of the simulator's plan. Values may be
    plain, NumPy, paths or dataclasses; anything else is written as its text. resumed: where a run went on from, with its
    `time` [s]; the rows up to it in the folder's steps.csv then stay, while the report tells of what was computed since.
    bodies: an entry for each, see `body_records`. buffer_growths: how often each buffer of the search for contacts grew.
    """
    folder = Path(folder)
    earlier = [] if resumed is None else _rows_until(folder / "steps.csv", resumed["time"])
    write_bytes(folder / "steps.csv", steps_csv(result.step_reports, earlier).encode())
    record = run_record(result) | {
        "resumed": resumed,
        "arch": arch,
        "precision": precision,
        "settings": settings,
        "plan": plan,
        "bodies": bodies or [],
        "buffer_growths": buffer_growths or {},
        "versions": versions(),
        "machine": machine(),
        "peak_memory_bytes": peak_memory(),
    }
    write_bytes(folder / "report.json", json_text(record).encode())


def body_records(scene) -> list[dict]:
    """What each body of a scene is made of: its name, law, order, numbers of vertices, tets, nodes and pieces."""
    return [
        {
            "name": b.name, "law": b.material.law, "order": b.order, "vertices": b.mesh.n_verts, "tets": b.mesh.n_tets,
            "nodes": b.n_nodes, "pieces": b.mesh.n_components,
        }
        for b in scene.bodies
    ]  # fmt: skip


def run_record(result: RunReport) -> dict:
    """A RunReport as a dict, with `extremes` over the steps instead of the steps."""
    record = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name != "step_reports"}
    return record | {"extremes": extremes(result.step_reports)}


def extremes(reports: list[StepReport]) -> dict:
    """Per numeric field of StepReport: min and max over the finite values, the times of both [s], the others' number.

    `not_converged` counts reports; without reports the dict is empty.
    """
    if not reports:
        return {}
    times = np.array([r.time for r in reports])
    found: dict = {"reports": len(reports), "not_converged": sum(not r.converged for r in reports)}
    for name in _numeric_fields():
        values = np.array([getattr(r, name) for r in reports], dtype=float)
        finite = np.flatnonzero(np.isfinite(values))
        entry: dict = {"not_finite": len(values) - len(finite)}
        if len(finite):
            low, high = finite[values[finite].argmin()], finite[values[finite].argmax()]
            whole = all(isinstance(getattr(reports[k], name), int) for k in (low, high))
            entry |= {"min": values[low], "max": values[high], "time_of_min": times[low], "time_of_max": times[high]}
            if whole:
                entry |= {"min": int(values[low]), "max": int(values[high])}
        found[name] = entry
    return found


def steps_csv(reports: list[StepReport], earlier: list[list[str]] | None = None) -> str:
    """The reports as CSV text (RFC 4180): a header and a row each, after earlier rows; problems are joined with '; '."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    names = _columns()
    writer.writerow(names)
    writer.writerows(earlier or [])
    for report in reports:
        row = {name: getattr(report, name) for name in names}
        row["problems"] = "; ".join(report.problems)
        writer.writerow(row.values())
    return text.getvalue()


def _columns() -> list[str]:
    return [f.name for f in dataclasses.fields(StepReport)]


def _rows_until(path: Path, time: float) -> list[list[str]]:
    """Rows of an earlier run's steps.csv up to a time [s]; none where there is no such file with these columns."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        return [row for row in rows if float(row[0]) <= time * (1.0 + 1e-12)] if header == _columns() else []
    except (OSError, ValueError, IndexError, csv.Error):
        return []


def json_text(record: dict) -> str:
    """The record as JSON that every reader takes: numbers that are not finite become null."""
    return json.dumps(_plain(record), indent=1, allow_nan=False) + "\n"


def versions() -> dict[str, str | None]:
    """Versions of Python, taisoft and the packages that take part in a run; None where a package cannot tell."""
    import taisoft

    found = installed(*PACKAGES)
    return {"python": found.pop("python"), "taisoft": taisoft.__version__} | found


def machine() -> dict:
    """Name, system, processor and its number of logical cores."""
    return {"name": platform.node(), "system": platform.platform(), "cpu": processor(), "cores": os.cpu_count()}


def peak_memory() -> int | None:
    """Largest resident size of this process so far [bytes]; None where the system cannot tell."""
    try:
        import resource
    except ImportError:  # not a POSIX system
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _numeric_fields() -> list[str]:
    blank = StepReport(time=0.0)
    names = [f.name for f in dataclasses.fields(StepReport) if f.name != "time"]
    return [n for n in names if isinstance(getattr(blank, n), int | float) and not isinstance(getattr(blank, n), bool)]


def _plain(value):
    """value in JSON's own types."""
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
