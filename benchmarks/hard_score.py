"""The scoreboard of the hard cases: which variants are solved, how each ended, and why the others are not solved.

A variant is solved when it ended as it must and every limit is kept. Columns say how it ended: ok, degraded, refused, stopped;
wrong is an ok end that must not be one, or that misses a limit on the answer; each variant is in one column.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from .hard_cases.record import DEGRADED, END, OK, REFUSED, STOPPED

if TYPE_CHECKING:
    from .hard_runs import Row

WRONG, NOT_RUN = "wrong", "not run"
COLUMNS = (OK, DEGRADED, REFUSED, STOPPED, WRONG, NOT_RUN)
ASKED, SOLVED = "asked", "solved"
ALL = "in all"  # the last line of a scoreboard
RULE = (
    "Solved is what ended as it must and kept all its limits. How each variant must end, and why, comes from the catalogue of "
    "the cases and from physics. A refusal or a stop where there is an answer is not solved, nor is a degraded end, unless the "
    "setting itself brings about what degraded it. Wrong: the run says ok, but must not, or misses a limit on its answer."
)


def column(row: "Row") -> str:
    """How a variant ended."""
    if row.record is None:
        return NOT_RUN
    status = row.record["status"]
    missed = any(verdict.passed is False and not verdict.cost for verdict in row.verdicts)
    return WRONG if status == OK and missed else status


def faults(row: "Row") -> list[str]:
    """Why a variant is not solved, in a few words each; empty where it is."""
    if row.record is None:
        return [NOT_RUN]
    missed = [verdict.quantity for verdict in row.verdicts if verdict.passed is False]
    return [_wrong_end(row) if quantity == END else quantity for quantity in missed]


def _wrong_end(row: "Row") -> str:
    """What is wrong with the end of a run."""
    must, record = row.variant.must, row.record
    unexcused = [cause for cause in record["causes"] if cause not in must.causes]
    if record["status"] in (must.end, DEGRADED) and unexcused:
        return ", ".join(unexcused)
    return f"{record['status']}, must be {must.text}"


def tally(rows: Iterable["Row"]) -> dict[str, int]:
    """How many are asked, solved, and in each column."""
    counts = dict.fromkeys((ASKED, SOLVED, *COLUMNS), 0)
    for row in rows:
        counts[ASKED] += 1
        counts[SOLVED] += not faults(row)
        counts[column(row)] += 1
    return counts


def cells(counts: dict[str, int], shown: Iterable[str]) -> list[str]:
    """Numbers of a line of the scoreboard; a zero is left empty but of what is asked and solved."""
    return [str(counts[name]) if counts[name] or name in (ASKED, SOLVED) else "" for name in shown]


def shown_columns(rows: Iterable["Row"]) -> list[str]:
    """Headings of the scoreboard: all but "not run" where everything was."""
    return [name for name in tally(rows) if name != NOT_RUN or tally(rows)[NOT_RUN]]


def headline(rows: list["Row"]) -> str:
    """The number solved of the number asked."""
    counts = tally(rows)
    return f"**{counts[SOLVED]} of {counts[ASKED]} variants are solved.**"


def how_solved(rows: Iterable["Row"]) -> str:
    """How the solved ones ended, in a sentence."""
    counts = tally(row for row in rows if not faults(row))
    ended = [f"{counts[name]} {name}" for name in COLUMNS if counts[name]]
    return f"How the solved ones ended: {', '.join(ended)}." if ended else ""
