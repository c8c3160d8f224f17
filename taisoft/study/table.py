"""A study as text: study.md and study.csv."""

import csv
import io
import math
from dataclasses import asdict

from taisoft.output.tables import markdown, percent, spread_of
from taisoft.study.accuracy import Error, Row
from taisoft.study.grid import AXES, mesh_name
from taisoft.study.results import Study, describe

ALWAYS_SHOWN = ("integrator", "dt")  # axes that have a column even if they do not vary
FINISHED = ("ok", "degraded")


def text_of(study: Study) -> str:
    """Return the whole study in Markdown: answer, table, runs not done, references, notes."""
    parts = [f"# {study.request.scene}: speed against error", answer(study)]
    if study.ended:
        resume = "The same command continues it." if study.kept else "Without --out nothing is kept."
        needed = "if it takes longer than the whole budget, it needs a larger --budget"
        parts.append(" ".join([f"Not complete: {study.ended}. {resume}", *(f"Cut: {run}; {needed}." for run in study.cut)]))
    ran = [row for row in study.rows if row.status in (*FINISHED, "failed")]
    if ran:
        parts.append(run_table(study, ran))
    parts += [_reasons(title, study.rows, status) for title, status in (("Failed", "failed"), ("Degraded", "degraded"))]
    parts += [_reasons(title, study.rows, status) for title, status in (("Refused", "refused"), ("Left out", "left out"))]
    parts.append(_method(study))
    if study.notes:
        parts.append("Notes:\n\n" + "\n".join(f"* {note}" for note in study.notes))
    return "\n\n".join(part for part in parts if part) + "\n"


def answer(study: Study) -> str:
    """Return a sentence naming the cheapest setting within the tolerance, or else the one of least error."""
    goal = f"{study.request.tolerance:.3g}"
    if (row := study.cheapest()) is not None:
        caveat = "" if row.status == "ok" else f"; its run is {row.status}"
        return f"Cheapest within {goal} ({study.request.by} error): {_label(row, study.request.by)}{caveat}."
    if (row := study.nearest()) is not None:
        own, option = row.error(study.request.by)[1], "--reference-refine" if study.space is not None else "--reference-dt"
        below = f" Errors below {own:.2g} are not resolved; {option} gives a better reference."
        limit = "" if own <= study.request.tolerance else below
        return f"No setting is within {goal} ({study.request.by} error); the nearest: {_label(row, study.request.by)}.{limit}"
    return "No setting has both a time and an error."


def _label(row: Row, by: str) -> str:
    return f"{describe({'setting': row.setting})}, {_seconds(row)} s per simulated second, error {format_error(*row.error(by))}"


def run_table(study: Study, rows: list[Row]) -> str:
    """Return a table with one row per run; * marks the front. Axes that do not vary are left out."""
    front = study.front()
    axes = [key for key in AXES if key in ALWAYS_SHOWN or len({row.setting[key] for row in rows}) > 1]
    in_space = any(row.in_space is not None for row in rows)
    columns: dict[str, list[str]] = {"": ["*" if row in front else "" for row in rows]}
    columns |= {_heading(key): [_axis(row.setting[key]) for row in rows] for key in axes}
    columns["s/sim. s"] = [_seconds(row) for row in rows]
    columns["spread"] = [percent(spread_of(row.timing)) if row.seconds else "" for row in rows]
    for name, get in (("time", lambda r: (r.in_time, r.in_time_sure)), ("space", lambda r: (r.in_space, r.in_space_sure))):
        if name == "time" or in_space:
            title = f"error in {name}" if in_space else "error"
            columns[f"{title}, max"] = [_error(*get(row), "max") for row in rows]
            columns["rms" if not in_space else f"rms in {name}"] = [_error(*get(row), "rms") for row in rows]
    kept = any(row.energy_kept for row in rows)
    columns["energy drift" if kept else "energy error"] = [_number(row.energy) for row in rows]
    columns["momentum"] = [_number(row.momentum) for row in rows]
    if study.plan["touching"]:
        columns["penetration/edge"] = [_number(row.penetration) for row in rows]
        columns["contact residual"] = [_number(row.contact_residual) for row in rows]
    columns["unconverged"] = [_count(row.unconverged) for row in rows]
    columns["inverted"] = [_count(row.inverted) for row in rows]
    columns["status"] = [row.status for row in rows]
    left = [k for k, name in enumerate(columns) if name in ("", "integrator", "status", "precision", "contact solver")]
    return markdown(list(columns), list(zip(*columns.values())), left=left)


def _method(study: Study) -> str:
    """Return what the errors refer to, the references' own errors, and how times were measured."""
    lines = []
    for reference in study.references:
        own, setting = reference.own_error, reference.setting
        lines.append(
            f"* {describe({'setting': setting, 'timed': False})}: largest excursion {reference.excursion:.4g} m, own error "
            f"{own.max:.2g} (max), {own.rms:.2g} (rms), from dt and 2 dt, assuming order {reference.order_in_time}"
        )
    if study.space is not None:
        space_error = next((row.in_space_sure for row in study.rows if row.in_space_sure is not None), None)
        if space_error is not None:
            lines.append(
                f"* errors in space are relative to the reference with {mesh_name(study.space.setting)}; its own error is "
                f"{space_error.max:.2g} (max), {space_error.rms:.2g} (rms): {study.space_error_source}"
            )
    seconds = study.plan["frame"] * study.plan["frames"] if study.plan["frame"] else 0.0
    threads = sorted({row.threads for row in study.rows if row.threads})
    cores = f"{' or '.join(map(str, threads)) or 'no'} thread{'s' if threads != [1] else ''}, {study.workers} at a time"
    summary = (
        f"{seconds:g} s simulated, compared at {study.plan['frames']} frames. Errors are distances over the reference's largest "
        f"excursion; `<` marks one below the reference's own error. Times are medians of {_repeats(study)} runs on {cores}, "
        "without compilation; spread is the interquartile range over the median; * marks the front."
    )
    return summary + ("\n\nReferences:\n\n" + "\n".join(lines) if lines else "")


def _repeats(study: Study) -> str:
    counts = sorted({len(row.seconds) for row in study.rows if row.seconds}) or [0]
    return str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"


def _reasons(title: str, rows: list[Row], status: str) -> str:
    """Return a list of settings with the reason for their status, grouped by reason."""
    by_reason: dict[str, list[dict]] = {}
    for row in rows:
        if row.status == status:
            by_reason.setdefault(row.reason, []).append(row.setting)
    if not by_reason:
        return ""
    return f"{title}:\n\n" + "\n".join(f"* {_describe_settings(settings)}: {reason}" for reason, settings in by_reason.items())


def _describe_settings(settings: list[dict]) -> str:
    """Return a short description of settings, as a product of axes if they form one."""
    values = {key: list(dict.fromkeys(s[key] for s in settings)) for key in AXES}
    if len(settings) > 2 and len(settings) == math.prod(map(len, values.values())):
        varying = [f"{key} {' | '.join(map(_axis, options))}" for key, options in values.items() if len(options) > 1]
        return f"{settings[0]['integrator']}, " * (len(values["integrator"]) == 1) + ", ".join(varying)
    return "; ".join(describe({"setting": setting}) for setting in settings)


def format_error(error: float, own: float) -> str:
    """Return an error as text, or "< own" if it is below its reference's own error."""
    return f"< {own:.2g}" if error < own else f"{error:.3g}"


def _error(error: Error | None, own: Error | None, by: str) -> str:
    return "" if error is None else format_error(getattr(error, by), getattr(own, by))


def _heading(key: str) -> str:
    return "dt [s]" if key == "dt" else key.replace("_", " ")


def _axis(value) -> str:
    return "adaptive" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _seconds(row: Row) -> str:
    return f"{row.timing.median:.3g}" if row.seconds else ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _count(value: int | None) -> str:
    return "" if value is None else str(value)


def csv_of(study: Study) -> str:
    """Return all numbers as CSV (RFC 4180), one row per combination; unknown values are empty."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    front = study.front()
    for number, row in enumerate(study.rows):
        values = _cells(row, study, row in front)
        if number == 0:
            writer.writerow(values)
        writer.writerow(values.values())
    return text.getvalue()


def _cells(row: Row, study: Study, on_front: bool) -> dict:
    timing = row.timing
    cells = dict(row.setting) | {"status": row.status, "reason": row.reason, "on_front": on_front}
    cells |= {"seconds_per_simulated_second": timing and timing.median, "spread": timing and spread_of(timing)}
    cells |= {"repeats": len(row.seconds)}
    for name in ("in_time", "in_space"):
        error, own = getattr(row, name), getattr(row, f"{name}_sure")
        for by in ("max", "rms"):
            cells[f"error_{name}_{by}"] = error and getattr(error, by)
            cells[f"reference_{name}_{by}"] = own and getattr(own, by)
    numbers = ("energy", "energy_kept", "momentum", "penetration", "contact_residual", "unconverged", "inverted")
    rest = asdict(row)
    cells |= {key: rest[key] for key in (*numbers, "compile_seconds", "steps", "nodes", "tets", "threads", "machine")}
    return {key: "" if value is None else value for key, value in cells.items()} | {"error_by": study.request.by}
