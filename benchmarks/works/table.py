"""Tables of the works: all runs of one, and the programs beside each other at equal error."""

from collections.abc import Iterable

from taisoft.output.tables import markdown, percent, spread_of

from ..document import Limit
from ..elasticity_runs import time_ratio
from ..programs import own
from ..programs.tried import Tried
from .runs import Row, fastest_standing, fastest_within
from .scenes import Work

LEVELS = (1e-2, 1e-3, 1e-4, 1e-5)  # errors at which W1 is compared
FASTER = 4.0  # times the best peer, on W1 at equal error
W2_ERROR, W2_SECONDS = 0.005, 0.4


def run_table(rows: list[Row]) -> str:
    """A row a setting, with the failures below."""
    work = rows[0].work
    path = ("error", "good to") if work.kind == "path" else ("stands", "fell at [s]", "free fall")
    contact = ("penetration [mm]", "over an edge") if work.touches else ()
    headings = (
        "program",
        "law",
        "setting",
        "dt [ms]",
        "s/sim. s",
        "spread",
        *path,
        *contact,
        "inverted tets",
        "unconverged",
        "build [s]",
    )
    lines = [_line(row) for row in rows if row.timing is not None]
    told = markdown(headings, lines, left=(0, 1, 2)) if lines else "Nothing ran to its end."
    failed = [(row.setting, row.failure) for row in rows if row.failure]
    failures = [f"* {setting.program} {setting}, dt = {1e3 * setting.dt:.3g} ms: {why}" for setting, why in failed]
    return told + ("\n\n" + "\n".join(failures) if failures else "")


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


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def own_and_peers(rows: list[Row]) -> tuple[list[Row], list[Row]]:
    """taisoft's rows and the others'."""
    ours = [row for row in rows if row.setting.program == own.NAME]
    return ours, [row for row in rows if row.setting.program != own.NAME]


def pairs_of(rows: list[Row]) -> list[tuple[str, Row | None, Row | None]]:
    """At what, the fastest of taisoft and the fastest of the others; a path's at LEVELS, and of the law of
    that one where taisoft has run it."""
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
    """For each work and level the fastest of taisoft and of the others, as plain data."""
    found = []
    for rows in works:
        for at, ours, theirs in pairs_of(rows):
            ratio = time_ratio(theirs, ours) if ours and theirs else None
            found.append(
                {
                    "work": rows[0].work.key,
                    "tets": rows[0].work.tets,
                    "stiff": rows[0].work.stiff,
                    "at": at,
                    "taisoft": _named(ours),
                    "others": _named(theirs),
                    "ratio": ratio and ratio.median,
                    "spread": ratio and spread_of(ratio),
                }
            )
    return found


def compare_table(found: list[dict]) -> str:
    """A row a work and level, of `comparisons`."""
    lines = [
        (
            one["work"],
            f"{one['tets']:,}",
            one["at"],
            *one["taisoft"],
            *one["others"],
            f"{one['ratio']:.3g}" if one["ratio"] else "-",
            percent(one["spread"]),
        )
        for one in found
    ]
    headings = ("work", "tets", "at", "taisoft", "s/sim. s", "best of the others", "s/sim. s", "its time / taisoft's", "spread")
    return markdown(headings, lines, left=(0, 2, 3, 5))


def _named(row: Row | None) -> tuple[str, str]:
    if row is None:
        return "none", "-"
    name = row.setting.method if row.setting.program == own.NAME else f"{row.setting.program} {row.setting.method}"
    return f"{name}, {row.setting.model.law}, {1e3 * row.setting.dt:.3g} ms", f"{row.timing.median:.3g}"


def limits_of(rows: list[Row]) -> list[Limit]:
    """What was aimed at, of a work; nothing of the stiff ones."""
    work = rows[0].work
    ours, _ = own_and_peers(rows)
    if work.stiff:
        return []
    if work.cells is None and work.kind == "path":
        return _limits_of_drop(work, ours)
    found = []
    for at, a, b in pairs_of(rows):
        found.append(Limit(f"{work.key}, {at}: settings of taisoft that do", float(a is not None), 1.0, at_least=True))
        if a and b:
            ratio, wanted = time_ratio(b, a), FASTER if work.kind == "path" else 1.0
            what = f"{work.key}, {at}: time of {b.setting.program} / taisoft"
            found.append(Limit(what, ratio.median, wanted, spread_of(ratio), at_least=True))
    return found


def implicit_table(works: list[list[Row]]) -> str:
    """Of stiff works every program's steps of 10 ms."""
    lines = [
        (
            row.work.key,
            row.setting.program,
            str(row.setting),
            str(row.setting.model),
            *(("-", "-") if row.timing is None else (_percent(row.verdict.error), f"{row.timing.median:.3g}")),
            row.failure,
        )
        for rows in works
        for row in rows
        if row.work.stiff and row.setting.steps == 1
    ]
    return markdown(("work", "program", "setting", "law", "error", "s/sim. s", ""), lines, left=(0, 1, 2, 3, 6))


def tried_table(tried: Iterable[Tried]) -> str:
    """What is not among the settings, and why."""
    lines = [(one.program, one.work, one.what, one.came_out) for one in tried]
    return markdown(("program", "work", "tried", "came out"), lines, left=(0, 1, 2, 3))


def _limits_of_drop(work: Work, ours: list[Row]) -> list[Limit]:
    best = fastest_within(ours, W2_ERROR)
    if best is None:
        return [Limit(f"{work.key}: taisoft's settings with an error of at most {W2_ERROR:g}", 0, 1, at_least=True)]
    t = best.timing
    return [Limit(f"{work.key}: s/sim. s of taisoft with an error of {best.claimed:.2g}", t.median, W2_SECONDS, spread_of(t))]
