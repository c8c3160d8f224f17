"""The table of the hard cases: a row a number, in Markdown."""

from collections.abc import Iterable

from taisoft.output.tables import markdown

from .hard_cases.record import PROPOSED, Case, Verdict
from .hard_runs import Row

HEADINGS = (
    "case", "variant", "run", "quantity", "measured", "limit", "basis", "", "steps", "wall [s]", "step [ms]", "peak [MB]",
    "error",
)  # fmt: skip
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
        str(record["steps"]), f"{record['seconds']:.1f}", NOTHING if each is None else f"{1e3 * each:.3g}",
        NOTHING if peak is None else f"{peak / 1e6:.0f}", NOTHING if error is None else f"{error:.1e}",
    )  # fmt: skip
    lines = []
    for k, verdict in enumerate(row.verdicts):
        first = (row.case.id, row.variant.name, record["status"]) if k == 0 else ("", "", "")
        cells = (verdict.quantity, number(verdict.value), limit(verdict), verdict.basis, verdict_word(verdict))
        lines.append((*first, *cells, *(cost if k == 0 else [""] * len(cost))))
    return lines


def table(rows: Iterable[Row]) -> str:
    """All rows."""
    return markdown(HEADINGS, [line for row in rows for line in row_lines(row)], LEFT)


def notes(rows: list[Row]) -> str:
    """What is to be known of limits that were replaced, of ends that are not ok, and of limits that are not met."""
    cases: dict[str, Case] = {row.case.id: row.case for row in rows}
    parts = []
    for case in cases.values():
        own = [row for row in rows if row.case is case]
        lines = [f"* limit on \"{c.quantity}\" ({c.basis}): {c.note}." for c in case.criteria if c.note]
        if case.shortfall and not all(row.passed for row in own):
            lines.append(f"* Not met: {case.shortfall}")
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


def summary(rows: list[Row]) -> str:
    """How many variants meet their limits, and which do not."""
    failed = [row for row in rows if row.record is not None and not row.passed]
    missing = [row for row in rows if row.record is None]
    proposed = sum(v.basis == PROPOSED for row in rows for v in row.verdicts)
    good = len(rows) - len(failed) - len(missing)
    text = f"{good} of {len(rows)} variants meet all their limits ({proposed} limits are proposed)"
    for what, some in (("not met", failed), ("not run", missing)):
        if some:
            text += f"; {what}: " + ", ".join(f"{row.case.id} {row.variant.name}" for row in some)
    return text + "."
