"""The page of the hard cases, in Markdown: the scoreboard, what is not solved, how each must end, and every number."""

from collections.abc import Iterable

from taisoft.output.tables import markdown

from .hard_cases import GROUPS
from .hard_cases.record import PROPOSED, Case, Must, Verdict
from .hard_runs import Row
from .hard_score import ALL, RULE, cells, faults, headline, how_solved, shown_columns, tally

HEADINGS = (
    "case",
    "variant",
    "run",
    "quantity",
    "measured",
    "limit",
    "basis",
    "",
    "steps",
    "wall [s]",
    "step [ms]",
    "peak [MB]",
    "error",
)
LEFT = (0, 1, 2, 3, 5, 6, 7)
NOTHING = "-"


def number(value: float | str | None) -> str:
    """A value of a verdict; what is not finite is told as nan."""
    return "nan" if value is None else value if isinstance(value, str) else f"{value:.4g}"


def limit(verdict: Verdict) -> str:
    """What is asked."""
    if verdict.limit is None:
        return NOTHING
    if isinstance(verdict.limit, str):
        return verdict.limit
    sign = ">=" if verdict.at_least else "<="
    replaced = "" if verdict.asked is None else f" (asked: {verdict.asked:g})"
    return f"{sign} {verdict.limit:.4g}{replaced}"


def verdict_word(verdict: Verdict) -> str:
    """pass, FAIL, or - where there is no limit."""
    return NOTHING if verdict.passed is None else "pass" if verdict.passed else "FAIL"


def row_lines(row: Row) -> list[tuple[str, ...]]:
    """The cells of a row: the first line tells the run and its cost too."""
    if row.record is None:
        return [(row.case.id, row.variant.name, "not run", row.left_out or NOTHING, *[NOTHING] * (len(HEADINGS) - 4))]
    record, error = row.record, row.error
    each, peak = record["step_seconds"], record["peak_memory_bytes"]
    cost = (
        str(record["steps"]),
        f"{record['seconds']:.1f}",
        NOTHING if each is None else f"{1e3 * each:.3g}",
        NOTHING if peak is None else f"{peak / 1e6:.0f}",
        NOTHING if error is None else f"{error:.1e}",
    )
    lines = []
    for k, verdict in enumerate(row.verdicts):
        first = (row.case.id, row.variant.name, record["status"]) if k == 0 else ("", "", "")
        cells = (verdict.quantity, number(verdict.value), limit(verdict), verdict.basis, verdict_word(verdict))
        lines.append((*first, *cells, *(cost if k == 0 else [""] * len(cost))))
    return lines


def page(rows: list[Row]) -> list[str]:
    """All parts in their order."""
    parts = [scoreboard(rows)]
    sections = {"Not solved": unsolved, "How each must end": ends, "Every number": details, "Notes": notes}
    for title, made in sections.items():
        text = made(rows)
        if text:
            parts.append(f"## {title}\n\n{text}")
    return parts


def scoreboard(rows: list[Row]) -> str:
    """The headline, and the counts of each group of cases and of all."""
    shown = shown_columns(rows)
    groups = {name: [row for row in rows if row.case in cases] for name, cases in GROUPS.items()}
    lines = [(name, *cells(tally(own), shown)) for name, own in groups.items() if own]
    table = markdown(("cases", *shown), [*lines, (ALL, *cells(tally(rows), shown))], left=(0,))
    proposed = sum(verdict.basis == PROPOSED for row in rows for verdict in row.verdicts)
    told = f"{RULE} {how_solved(rows)} Of the limits {proposed} are proposed, not measured elsewhere or analytic."
    return f"{headline(rows)}\n\n{told}\n\n{table}"


def unsolved(rows: Iterable[Row]) -> str:
    """Each variant that is not solved, with its cause and the next idea."""
    groups: dict[str, dict[str, list[str]]] = {}  # names of variants, by case and by why they are not solved
    for row in rows:
        if faults(row):
            shortfalls = row.case.shortfalls_of(row.variant) if row.record is not None else []
            why = [f"{'; '.join(faults(row))}.", *(f"Cause: {s.cause}. Next: {s.next_idea}." for s in shortfalls)]
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
    """All rows."""
    return markdown(HEADINGS, [line for row in rows for line in row_lines(row)], LEFT)


def notes(rows: list[Row]) -> str:
    """What is to be known of limits that were replaced, and what runs tell of their ends."""
    cases: dict[str, Case] = {row.case.id: row.case for row in rows}
    parts = []
    for case in cases.values():
        own = [row for row in rows if row.case is case]
        lines = [f'* limit on "{c.quantity}" ({c.basis}): {c.note}.' for c in case.criteria if c.note]
        for row in own:
            told = row.record["problems"] if row.record else []
            lines += [f"* {row.variant.name}: {text}" for text in told[:3]]
            lines += [f"* {row.variant.name}: {len(told) - 3} more sentences" for _ in told[3:4]]
            lines += [f"* {row.variant.name}, reference: {why}" for why in [reference_trouble(row)] if why]
        if lines:
            parts.append(f"{case.id}, {case.name}\n\n" + "\n".join(lines))
    return "\n\n".join(parts)


def reference_trouble(row: Row) -> str:
    """Why a reference that was begun tells no error."""
    if row.reference is not None and row.error is None:
        return f"{row.reference['status']}, " + ("; ".join(row.reference["problems"][:1]) or "at other times")
    return row.reference_left_out
