"""Write `report.json` and `steps.csv`: the result of a run, its settings and its machine.

report.json holds the RunReport, with extremes over the steps in place of the steps; steps.csv holds one StepReport per row.
JSON has no NaN: numbers that are not finite are null there, and counted in the extremes.
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
    folder: str | Path,
    result: RunReport,
    *,
    arch: str,
    precision: str,
    settings: dict,
    plan: list[dict],
    resumed: dict | None = None,
    bodies: list[dict] | None = None,
    buffer_growths: dict[str, int] | None = None,
) -> None:
    """Write report.json and steps.csv into folder. Raises OutputError.

    settings: every resolved setting of the run, by name; plan: the entries of the simulator's plan. Values may be
    plain, NumPy, paths or dataclasses; anything else is written as its text. resumed: the checkpoint that the run resumed from,
    with its `time` [s]; rows up to that time in the folder's steps.csv are kept, while the report covers only the steps since.
    bodies: see `body_records`. buffer_growths: how often each buffer of contact detection grew.
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
    """Describe each body of a scene: its name, law, order, and numbers of vertices, tets, nodes and connected pieces."""
    return [
        {
            "name": b.name,
            "law": b.material.law,
            "order": b.order,
            "vertices": b.mesh.n_verts,
            "tets": b.mesh.n_tets,
            "nodes": b.n_nodes,
            "pieces": b.mesh.n_components,
        }
        for b in scene.bodies
    ]


def run_record(result: RunReport) -> dict:
    """Return a RunReport as a dict, with `extremes` over the steps instead of the steps."""
    record = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name != "step_reports"}
    return record | {"extremes": extremes(result.step_reports)}


def extremes(reports: list[StepReport]) -> dict:
    """Return, per numeric field of StepReport, min and max of the finite values, their times [s], and the count of other values.

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
            integral = all(isinstance(getattr(reports[k], name), int) for k in (low, high))
            entry |= {"min": values[low], "max": values[high], "time_of_min": times[low], "time_of_max": times[high]}
            if integral:
                entry |= {"min": int(values[low]), "max": int(values[high])}
        found[name] = entry
    return found


def steps_csv(reports: list[StepReport], earlier: list[list[str]] | None = None) -> str:
    """Return the reports as CSV text (RFC 4180): a header, earlier rows, and a row per report; problems are joined with '; '."""
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
    """Return the rows of an earlier run's steps.csv up to a time [s]; none if there is no such file with these columns."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        return [row for row in rows if float(row[0]) <= time * (1.0 + 1e-12)] if header == _columns() else []
    except (OSError, ValueError, IndexError, csv.Error):
        return []


def json_text(record: dict) -> str:
    """Return the record as standard JSON text: numbers that are not finite become null."""
    return json.dumps(_plain(record), indent=1, allow_nan=False) + "\n"


def versions() -> dict[str, str | None]:
    """Return the versions of Python, taisoft and the packages used by a run; None if unknown."""
    import taisoft

    found = installed(*PACKAGES)
    return {"python": found.pop("python"), "taisoft": taisoft.__version__} | found


def machine() -> dict:
    """Return the machine's name, system, processor and number of logical cores."""
    return {"name": platform.node(), "system": platform.platform(), "cpu": processor(), "cores": os.cpu_count()}


def peak_memory() -> int | None:
    """Return the largest resident size of this process so far [bytes]; None if the system does not report it."""
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
