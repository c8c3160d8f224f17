"""Results of a study: the Pareto front of time against error, and all numbers as Markdown, CSV and plain data."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

from taisoft.estimation.comparison import Error
from taisoft.output.tables import csv_text, percent, spread_of, table
from taisoft.study import AXES, Request, describe, mesh_name
from taisoft.study.accuracy import Reference, Row

ALWAYS_SHOWN = ("integrator", "dt")  # axes that have a column even if they do not vary
HEADINGS = {"dt": "dt [s]", "integrator": "<integrator", "precision": "<precision", "contact_solver": "<contact solver"}
Point = tuple[float, float]  # time, error; smaller is better in both


def front(points: Sequence[Point]) -> list[int]:
    """Return indices of the points that no other dominates, by rising time. Equal points are all included or none; nan never."""
    known = (k for k, p in enumerate(points) if not any(map(math.isnan, p)))
    found: list[int] = []
    for k in sorted(known, key=lambda k: points[k]):
        if not found or points[k][1] < points[found[-1]][1] or points[k] == points[found[-1]]:
            found.append(k)
    return found


@dataclass
class Study:
    """Results of a study.

    rows: one per combination; notes: sentences for the reader; ended: why it is incomplete; cut: runs that were stopped when
    the budget was spent.
    """

    request: Request
    plan: dict
    rows: list[Row] = field(default_factory=list)
    references: list[Reference] = field(default_factory=list)
    space: Reference | None = None
    space_error_source: str = ""  # how the error of `space` was estimated
    notes: list[str] = field(default_factory=list)
    machines: list[dict] = field(default_factory=list)
    workers: int = 1  # runs at a time
    versions: dict = field(default_factory=dict)
    ended: str = ""
    cut: list[str] = field(default_factory=list)
    kept: bool = False  # whether finished runs are kept, so that a study can continue

    def comparable_rows(self) -> list[Row]:
        """Return the rows that have a time and an error."""
        return [row for row in self.rows if row.seconds and row.resolved_error(self.request.by) is not None]

    def point(self, row: Row) -> Point:
        """Return (time, error) of a comparable row."""
        return row.timing.median, row.resolved_error(self.request.by)

    def front(self) -> list[Row]:
        """Return the rows of the Pareto front, by rising time."""
        rows = self.comparable_rows()
        return [rows[k] for k in front(list(map(self.point, rows)))]

    def cheapest(self) -> Row | None:
        """Return the fastest row within the tolerance, the more exact at equal times, or None."""
        return next((row for row in self.front() if self.point(row)[1] <= self.request.tolerance), None)

    def nearest(self) -> Row | None:
        """Return the row of least error, the fastest of equal ones, or None."""
        found = self.front()
        return next((row for row in found if self.point(row)[1] == self.point(found[-1])[1]), None)


def text_of(study: Study) -> str:
    """Return the whole study in Markdown: answer, table, runs not done, references, notes."""
    parts = [f"# {study.request.scene}: speed against error", _answer(study)]
    if study.ended:
        resume = "The same command continues it." if study.kept else "Without --out nothing is kept."
        needed = "if it takes longer than the whole budget, it needs a larger --budget"
        parts.append(" ".join([f"Not complete: {study.ended}. {resume}", *(f"Cut: {run}; {needed}." for run in study.cut)]))
    if ran := [row for row in study.rows if row.status in ("ok", "degraded", "failed")]:
        parts.append(_run_table(study, ran))
    parts += [_reasons(study, status) for status in ("failed", "degraded", "refused", "left out")]
    parts.append(_method(study))
    if study.notes:
        parts.append("Notes:\n\n" + "\n".join(f"* {note}" for note in study.notes))
    return "\n\n".join(part for part in parts if part) + "\n"


def _answer(study: Study) -> str:
    """Return a sentence naming the cheapest setting within the tolerance, or else the one of least error."""
    by, tolerance = study.request.by, study.request.tolerance

    def label(row: Row) -> str:
        error = _format_error(*row.error(by))
        return f"{describe(row.setting)}, {row.timing.median:.3g} s per simulated second, error {error}"

    if (row := study.cheapest()) is not None:
        caveat = "" if row.status == "ok" else f"; its run is {row.status}"
        return f"Cheapest within {tolerance:.3g} ({by} error): {label(row)}{caveat}."
    if (row := study.nearest()) is not None:
        own, option = row.error(by)[1], "--reference-refine" if study.space is not None else "--reference-dt"
        below = f" Errors below {own:.2g} are not resolved; {option} gives a better reference."
        return f"No setting is within {tolerance:.3g} ({by} error); the nearest: {label(row)}.{below if own > tolerance else ''}"
    return "No setting has both a time and an error."


def _run_table(study: Study, rows: list[Row]) -> str:
    """Return a table with one row per run; * marks the front. Axes that do not vary are left out."""
    front = study.front()
    columns = [("<", lambda r: "*" * (r in front))]
    for key in AXES:
        if key in ALWAYS_SHOWN or len({row.setting[key] for row in rows}) > 1:
            columns.append((HEADINGS.get(key, key.replace("_", " ")), lambda r, key=key: _axis(r.setting[key])))
    columns.append(("s/sim. s", lambda r: f"{r.timing.median:.3g}" if r.seconds else ""))
    columns.append(("spread", lambda r: percent(spread_of(r.timing)) if r.seconds else ""))
    in_space = any(row.in_space is not None for row in rows)
    for name, what in (("in_time", " in time"), ("in_space", " in space")) if in_space else (("in_time", ""),):
        for heading, by in ((f"error{what}, max", "max"), (f"rms{what}", "rms")):
            columns.append((heading, lambda r, name=name, by=by: _error(getattr(r, name), getattr(r, f"{name}_sure"), by)))
    shown = {
        "energy": "energy drift" if any(row.numbers["energy_kept"] for row in rows) else "energy error",
        "momentum": "momentum",
    }
    if study.plan["touching"]:
        shown |= {"penetration": "penetration/edge", "contact_residual": "contact residual"}
    for name, heading in (shown | {"unconverged": "unconverged", "inverted": "inverted"}).items():
        columns.append((heading, lambda r, name=name: _number(r.numbers[name])))
    return table(rows, [*columns, ("<status", lambda r: r.status)])


def _method(study: Study) -> str:
    """Return what the errors refer to, the references' own errors, and how times were measured."""
    lines = [
        f"* reference {describe(r.setting)}: largest excursion {r.excursion:.4g} m, own error {r.own_error.max:.2g} (max), "
        f"{r.own_error.rms:.2g} (rms), from dt and 2 dt, assuming order {r.order_in_time}"
        for r in study.references
    ]
    own = next((row.in_space_sure for row in study.rows if row.in_space_sure is not None), None)
    if study.space is not None and own is not None:
        lines.append(
            f"* errors in space are relative to the reference with {mesh_name(study.space.setting)}; its own error is "
            f"{own.max:.2g} (max), {own.rms:.2g} (rms): {study.space_error_source}"
        )
    frame, frames = study.plan["frame"], study.plan["frames"]
    threads = sorted({n for row in study.rows if (n := row.numbers["threads"])})
    cores = f"{' or '.join(map(str, threads)) or 'no'} thread{'s' if threads != [1] else ''}, {study.workers} at a time"
    counts = sorted({len(row.seconds) for row in study.rows if row.seconds}) or [0]
    repeats = str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    summary = (
        f"{frame * frames if frame else 0.0:g} s simulated, compared at {frames} frames. Errors are distances over the "
        "reference's largest excursion; `<` marks one below the reference's own error. Times are medians of "
        f"{repeats} runs on {cores}, without compilation; spread is the interquartile range over the median; * marks the front."
    )
    return summary + ("\n\nReferences:\n\n" + "\n".join(lines) if lines else "")


def _reasons(study: Study, status: str) -> str:
    """Return a list of settings with the reason for their status, grouped by reason."""
    by_reason: dict[str, list[dict]] = {}
    for row in study.rows:
        if row.status == status:
            by_reason.setdefault(row.reason, []).append(row.setting)
    lines = [f"* {_describe_settings(settings)}: {reason}" for reason, settings in by_reason.items()]
    return f"{status.capitalize()}:\n\n" + "\n".join(lines) if lines else ""


def _describe_settings(settings: list[dict]) -> str:
    """Return a short description of settings, as a product of axes if they form one."""
    values = {key: list(dict.fromkeys(s[key] for s in settings)) for key in AXES}
    if len(settings) > 2 and len(settings) == math.prod(map(len, values.values())):
        varying = [f"{key} {' | '.join(map(_axis, options))}" for key, options in values.items() if len(options) > 1]
        return f"{settings[0]['integrator']}, " * (len(values["integrator"]) == 1) + ", ".join(varying)
    return "; ".join(map(describe, settings))


def _format_error(error: float, own: float) -> str:
    return f"< {own:.2g}" if error < own else f"{error:.3g}"


def _error(error: Error | None, own: Error | None, by: str) -> str:
    return "" if error is None else _format_error(getattr(error, by), getattr(own, by))


def _axis(value) -> str:
    return "adaptive" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _number(value: float | int | None) -> str:
    return "" if value is None else str(value) if isinstance(value, int) else f"{value:.2g}"


def csv_of(study: Study) -> str:
    """Return all numbers as CSV (RFC 4180), one row per combination; unknown values are empty."""
    rows = numbers_of(study)
    return csv_text([*rows[:1], *(one.values() for one in rows)])


def numbers_of(study: Study) -> list[dict]:
    """Return the numbers of all rows by name, as study.csv and study.json hold them."""
    front, by, found = study.front(), study.request.by, []
    for row in study.rows:
        timing, errors = row.timing, {}
        for name in ("in_time", "in_space"):
            for norm in ("max", "rms"):
                errors[f"error_{name}_{norm}"] = getattr(getattr(row, name), norm, None)
                errors[f"reference_{name}_{norm}"] = getattr(getattr(row, f"{name}_sure"), norm, None)
        one = row.setting | {"status": row.status, "reason": row.reason, "on_front": row in front}
        one |= {"seconds_per_simulated_second": timing and timing.median, "spread": timing and spread_of(timing)}
        found.append(one | {"repeats": len(row.seconds)} | errors | row.numbers | {"error_by": by})
    return found


def plain_of(study: Study) -> dict:
    """Return a study as plain data for study.json."""
    cheapest, nearest = study.cheapest(), study.nearest()
    reference_keys = ("setting", "steps", "excursion", "own_error", "kind", "order_in_time", "problems")
    return {
        "request": asdict(study.request),
        "frame": study.plan["frame"],
        "frames": study.plan["frames"],
        "rows": [one | {"seconds": row.seconds, "cores": row.cores} for one, row in zip(numbers_of(study), study.rows)],
        "references": [{k: getattr(r, k) for k in reference_keys} | {"in_space": r is study.space} for r in study.references],
        "cheapest": cheapest and cheapest.setting,
        "nearest": nearest and nearest.setting,
        **{key: getattr(study, key) for key in ("notes", "ended", "machines", "workers", "versions")},
        "scene_digest": study.plan["scenes"]["refine 0"],
        "code_digest": study.plan["code"],
    }
