"""Tables and the picture of the works: all runs of one, programs at equal error, error against time."""

from pathlib import Path

from taisoft.output.tables import markdown, percent, spread_of
from taisoft.study.results import front

from ..charts import Panel, write_plot
from ..document import Limit
from ..programs import own
from .runs import Row, fastest_standing, fastest_within, time_ratio

LEVELS = (1e-2, 1e-3, 1e-4, 1e-5)  # errors at which W1 is compared
FASTER = 4.0  # times the best peer, on W1 at equal error
W2_ERROR, W2_SECONDS = 0.005, 0.4
STYLES = {"taisoft": ("#d55e00", "o"), "MuJoCo": ("#0072b2", "s"), "PyBullet": ("#009e73", "^"), "Newton": ("#cc79a7", "D")}


def run_table(rows: list[Row]) -> str:
    """A row per setting, with failures below."""
    work = rows[0].work
    path = ("error", "good to") if work.kind == "path" else ("stands", "fell at [s]", "free fall")
    contact = ("penetration [mm]", "over an edge") if work.touches else ()
    counts = "inverted tets", "unconverged", "build [s]"
    headings = ("program", "law", "setting", "dt [ms]", "s/sim. s", "spread", *path, *contact, *counts)
    lines = [_line(row) for row in rows if row.timing is not None]
    table = markdown(headings, lines, left=(0, 1, 2)) if lines else "No run ended."
    failed = [(row.setting, row.failure) for row in rows if row.failure]
    failures = [f"* {setting.program} {setting}, dt = {1e3 * setting.dt:.3g} ms: {why}" for setting, why in failed]
    return table + ("\n\n" + "\n".join(failures) if failures else "")


def _line(row: Row) -> tuple[str, ...]:
    setting, verdict, t = row.setting, row.verdict, row.timing
    if row.work.kind == "path":
        found: tuple[str, ...] = _percent(verdict.error), _percent(verdict.good_to)
    else:
        fall = "-" if verdict.free_fall is None else f"{verdict.free_fall:.2f}"
        found = "yes" if row.stood else "no", "-" if verdict.fell is None else f"{verdict.fell:.2f}", fall
    if row.work.touches:
        found += (f"{1e3 * verdict.penetration:.3g}", _percent(verdict.penetration / verdict.edge))
    return (
        setting.program,
        str(setting.model),
        str(setting),
        f"{1e3 * setting.dt:.3g}",
        f"{t.median:.4g}",
        percent(spread_of(t)),
        *found,
        str(verdict.inverted),
        str(row.unconverged) if setting.program == own.NAME else "-",
        f"{row.build_seconds[0]:.2f}",
    )


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2g} %"


def own_and_peers(rows: list[Row]) -> tuple[list[Row], list[Row]]:
    """taisoft's rows and the others'."""
    ours = [row for row in rows if row.setting.program == own.NAME]
    return ours, [row for row in rows if row.setting.program != own.NAME]


def pairs_of(rows: list[Row]) -> list[tuple[str, Row | None, Row | None]]:
    """(level, fastest row of taisoft, fastest of the others); for a path at LEVELS, with the other's law if taisoft ran it."""
    ours, others = own_and_peers(rows)
    if rows[0].work.kind == "stand":
        return [("stands", fastest_standing(ours), fastest_standing(others))]
    found = []
    for level in LEVELS:
        theirs = fastest_within(others, level)
        alike = [row for row in ours if theirs is not None and row.setting.model.law == theirs.setting.model.law]
        found.append((f"error <= {level:g}", fastest_within(alike or ours, level), theirs))
    return found


def comparisons(works: list[list[Row]]) -> list[dict]:
    """The fastest of taisoft and of the others for each work and level, as plain data."""
    found = []
    for rows in works:
        work = {"work": rows[0].work.key, "tets": rows[0].work.tets, "stiff": rows[0].work.stiff}
        for at, ours, theirs in pairs_of(rows):
            ratio = time_ratio(theirs, ours) if ours and theirs else None
            times = {"ratio": ratio and ratio.median, "spread": ratio and spread_of(ratio)}
            found.append(work | {"at": at, "taisoft": _named(ours), "others": _named(theirs)} | times)
    return found


def compare_table(found: list[dict]) -> str:
    """A row per work and level of `comparisons`."""
    lines = []
    for one in found:
        times = f"{one['ratio']:.3g}" if one["ratio"] else "-", percent(one["spread"])
        lines.append((one["work"], f"{one['tets']:,}", one["at"], *one["taisoft"], *one["others"], *times))
    headings = ("work", "tets", "at", "taisoft", "s/sim. s", "best of the others", "s/sim. s", "its time / taisoft's", "spread")
    return markdown(headings, lines, left=(0, 2, 3, 5))


def _named(row: Row | None) -> tuple[str, str]:
    if row is None:
        return "none", "-"
    name = row.setting.method if row.setting.program == own.NAME else f"{row.setting.program} {row.setting.method}"
    return f"{name}, {row.setting.model.law}, {1e3 * row.setting.dt:.3g} ms", f"{row.timing.median:.3g}"


def limits_of(rows: list[Row]) -> list[Limit]:
    """Limits of a work; none for stiff ones."""
    work = rows[0].work
    if work.stiff:
        return []
    if work.cells is None and work.kind == "path":
        best = fastest_within(own_and_peers(rows)[0], W2_ERROR)
        if best is None:
            return [Limit(f"{work.key}: taisoft's settings with an error of at most {W2_ERROR:g}", 0, 1, at_least=True)]
        what, t = f"{work.key}: s/sim. s of taisoft with an error of {best.claimed:.2g}", best.timing
        return [Limit(what, t.median, W2_SECONDS, spread_of(t))]
    found = []
    for at, a, b in pairs_of(rows):
        found.append(Limit(f"{work.key}, {at}: settings of taisoft that do", float(a is not None), 1.0, at_least=True))
        if a and b:
            ratio, required = time_ratio(b, a), FASTER if work.kind == "path" else 1.0
            what = f"{work.key}, {at}: time of {b.setting.program} / taisoft"
            found.append(Limit(what, ratio.median, required, spread_of(ratio), at_least=True))
    return found


def implicit_table(works: list[list[Row]]) -> str:
    """Every program's steps of 10 ms on stiff works."""
    lines = []
    for row in (row for rows in works for row in rows if row.work.stiff and row.setting.steps == 1):
        found = ("-", "-") if row.timing is None else (_percent(row.verdict.error), f"{row.timing.median:.3g}")
        setting = row.setting
        lines.append((row.work.key, setting.program, str(setting), str(setting.model), *found, row.failure))
    return markdown(("work", "program", "setting", "law", "error", "s/sim. s", ""), lines, left=(0, 1, 2, 3, 6))


def draw(works: list[list[Row]], path: Path) -> None:
    """Write a PNG of error against time, a panel per work with an exact path. Raises OutputError."""
    panels = []
    for rows in works:
        timed = [row for row in rows if row.timing is not None]
        if rows[0].work.kind != "path" or not timed:
            continue
        title = f"{rows[0].work.key}, {rows[0].work.tets:,} tets"
        panels.append(Panel(title, "wall time of a simulated second [s], median", "error [%]", "xy"))
        points = [(row.timing.median, 100 * row.claimed) for row in timed]
        for name, (colour, marker) in STYLES.items():
            own = [point for point, row in zip(points, timed) if row.setting.program == name]
            if own:
                panels[-1].curve(*zip(*own), name, colour, "o", marker=marker)
        best = [points[k] for k in front(points)]
        panels[-1].curve(*zip(*best), "front", "#888888", "--", drawstyle="steps-post", lw=1.0)
    if panels:
        write_plot(path, panels)
