"""The page of the hard cases, in Markdown: the scoreboard, what is not solved, how each must end, and every number.

The scoreboard counts the solved variants and those in each column of `hard_runs.Row`.
"""

from collections.abc import Iterable

from taisoft.output.tables import markdown

from .hard_cases import GROUPS
from .hard_cases.case import PROPOSED, Case, Must, Verdict
from .hard_runs import COLUMNS, NOT_RUN, Row

ASKED, SOLVED = "asked", "solved"
ALL = "in all"  # the last line of a scoreboard
RULE = (
    "Solved is what ended as it must and kept all its limits. How each variant must end, and why, comes from the catalogue of "
    "the cases and from physics. A refusal or a stop where there is an answer is not solved, nor is a degraded end, unless the "
    "setting itself brings about what degraded it. Wrong: the run says ok, but must not, or misses a limit on its answer."
)
HEADINGS = (
    *("case", "variant", "run", "quantity", "measured", "limit", "basis", ""),
    *("steps", "substeps", "Newton", "CG", "wall [s]", "step [ms]", "peak [MB]", "error"),
)
LEFT = (0, 1, 2, 3, 5, 6, 7)
NOTHING = "-"


def page(rows: list[Row]) -> list[str]:
    """The parts of the page in order."""
    parts = [scoreboard(rows)]
    sections = {"Not solved": unsolved, "How each must end": ends, "Every number": details, "Notes": notes}
    for title, made in sections.items():
        text = made(rows)
        if text:
            parts.append(f"## {title}\n\n{text}")
    return parts


def tally(rows: Iterable[Row]) -> dict[str, int]:
    """Number of variants, of solved ones, and of those in each column."""
    counts = dict.fromkeys((ASKED, SOLVED, *COLUMNS), 0)
    for row in rows:
        counts[ASKED] += 1
        counts[SOLVED] += not row.faults
        counts[row.column] += 1
    return counts


def cells(counts: dict[str, int], shown: Iterable[str]) -> list[str]:
    """Cells of a line of the scoreboard; zeros of columns are left empty."""
    return [str(counts[name]) if counts[name] or name in (ASKED, SOLVED) else "" for name in shown]


def shown_columns(rows: Iterable[Row]) -> list[str]:
    """Headings of the scoreboard, without "not run" if everything was run."""
    return [name for name in tally(rows) if name != NOT_RUN or tally(rows)[NOT_RUN]]


def headline(rows: list[Row]) -> str:
    """The number of solved variants and of all."""
    counts = tally(rows)
    return f"**{counts[SOLVED]} of {counts[ASKED]} variants are solved.**"


def how_solved(rows: Iterable[Row]) -> str:
    """How the solved variants ended, in a sentence."""
    counts = tally(row for row in rows if not row.faults)
    ended = [f"{counts[name]} {name}" for name in COLUMNS if counts[name]]
    return f"How the solved ones ended: {', '.join(ended)}." if ended else ""


def scoreboard(rows: list[Row]) -> str:
    """The headline, and the counts per group of cases."""
    shown = shown_columns(rows)
    groups = {name: [row for row in rows if row.case in cases] for name, cases in GROUPS.items()}
    lines = [(name, *cells(tally(own), shown)) for name, own in groups.items() if own]
    table = markdown(("cases", *shown), [*lines, (ALL, *cells(tally(rows), shown))], left=(0,))
    proposed = sum(verdict.basis == PROPOSED for row in rows for verdict in row.verdicts)
    text = f"{RULE} {how_solved(rows)} Of the limits {proposed} are proposed, not measured elsewhere or analytic."
    return f"{headline(rows)}\n\n{text}\n\n{table}"


def unsolved(rows: Iterable[Row]) -> str:
    """Unsolved variants with cause and next idea."""
    groups: dict[str, dict[str, list[str]]] = {}  # names of variants, by case and by why they are not solved
    for row in rows:
        if row.faults:
            shortfalls = row.case.shortfalls_of(row.variant) if row.record is not None else []
            why = [f"{'; '.join(row.faults)}.", *(f"Cause: {s.cause}. Next: {s.next_idea}." for s in shortfalls)]
            case = groups.setdefault(f"{row.case.id}, {row.case.name}", {})
            case.setdefault(" ".join(why), []).append(row.variant.name)
    return "\n\n".join(
        f"{case}\n\n" + "\n".join(f"* {'; '.join(names)}: {why}" for why, names in own.items()) for case, own in groups.items()
    )


def ends(rows: Iterable[Row]) -> str:
    """How the variants of each case must end, and why."""
    groups: dict[tuple[str, Must], list[str]] = {}
    for row in rows:
        groups.setdefault((row.case.id, row.variant.must), []).append(row.variant.name)
    several = {case for case, _ in groups if sum(case == other for other, _ in groups) > 1}
    return "\n".join(
        f"* {case}: {must.text}: {must.reason}.{' Asked of: ' + '; '.join(names) + '.' if case in several else ''}"
        for (case, must), names in groups.items()
    )


def details(rows: Iterable[Row]) -> str:
    """Every quantity of every row."""
    return markdown(HEADINGS, [line for row in rows for line in row_lines(row)], LEFT)


def row_lines(row: Row) -> list[tuple[str, ...]]:
    """Lines of a row; the first also shows the run and its cost."""
    if row.record is None:
        return [(row.case.id, row.variant.name, "not run", row.left_out or NOTHING, *[NOTHING] * (len(HEADINGS) - 4))]
    record = row.record
    first = (row.case.id, row.variant.name, record["status"])
    cost = (
        str(record["steps"]),
        *(str(record.get(key, NOTHING)) for key in ("substeps", "newton_iterations", "linear_iterations")),
        f"{record['seconds']:.1f}",
        _or_nothing(record["step_seconds"], 1e3, ".3g"),
        _or_nothing(record["peak_memory_bytes"], 1e-6, ".0f"),
        _or_nothing(row.error, 1.0, ".1e"),
    )
    empty = ("",) * len(first), ("",) * len(cost)
    lines = []
    for verdict in row.verdicts:
        value = verdict.value  # null for what is not finite
        shown = "nan" if value is None else value if isinstance(value, str) else f"{value:.4g}"
        passed = {None: NOTHING, True: "pass", False: "FAIL"}[verdict.passed]
        lines.append((*first, verdict.quantity, shown, limit(verdict), verdict.basis, passed, *cost))
        first, cost = empty
    return lines


def limit(verdict: Verdict) -> str:
    """The limit as text."""
    if verdict.limit is None:
        return NOTHING
    if isinstance(verdict.limit, str):
        return verdict.limit
    return f"{'>=' if verdict.at_least else '<='} {verdict.limit:.4g}"


def _or_nothing(value: float | None, unit: float, form: str) -> str:
    return NOTHING if value is None else f"{unit * value:{form}}"


def notes(rows: list[Row]) -> str:
    """Notes on replaced limits, and problems of runs."""
    cases: dict[str, Case] = {row.case.id: row.case for row in rows}
    parts = []
    for case in cases.values():
        own = [row for row in rows if row.case is case]
        lines = [f'* limit on "{c.quantity}" ({c.basis}): {c.note}.' for c in case.criteria if c.note]
        for row in own:
            problems = row.record["problems"] if row.record else []
            lines += [f"* {row.variant.name}: {text}" for text in problems[:3]]
            lines += [f"* {row.variant.name}: {len(problems) - 3} more sentences" for _ in problems[3:4]]
            lines += [f"* {row.variant.name}, reference: {why}" for why in [reference_trouble(row)] if why]
        if lines:
            parts.append(f"{case.id}, {case.name}\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def reference_trouble(row: Row) -> str:
    """Why there is no error although a reference was started."""
    if row.reference is not None and row.error is None:
        return f"{row.reference['status']}, " + ("; ".join(row.reference["problems"][:1]) or "at other times")
    return row.reference_left_out
