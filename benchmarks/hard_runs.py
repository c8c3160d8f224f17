"""Runs of the hard cases: each variant and reference in its own process, stored by a key of its inputs, with verdicts.

A variant is solved if it ended as required and met every limit. It is in one column: ok, degraded, refused, stopped, or wrong,
an ok end that is not allowed or that misses a limit on the answer.
"""

from dataclasses import asdict, dataclass

import numpy as np

from .hard_cases import VARIANTS
from .hard_cases.case import DEGRADED, END, FINER, OK, REFUSED, STOPPED, Case, Session, Variant, Verdict, judge
from .suite import LEFT_OUT, Runs

ANSWERED = (OK, DEGRADED)  # ends of complete runs
CHEAP_SECONDS = 60.0  # estimated time up to which references run by default
WRONG, NOT_RUN = "wrong", "not run"
COLUMNS = (OK, DEGRADED, REFUSED, STOPPED, WRONG, NOT_RUN)


@dataclass
class Row:
    """A variant of a case with the records of its run and its reference, None if not run.

    left_out, reference_left_out: why there is no record. error: largest distance to the reference run over the case's size, if
    both are complete.
    """

    case: Case
    variant: Variant
    record: dict | None = None
    reference: dict | None = None
    left_out: str = ""
    reference_left_out: str = ""
    error: float | None = None

    @property
    def name(self) -> str:
        """Its name in VARIANTS."""
        return f"{self.case.id}: {self.variant.name}"

    @property
    def verdicts(self) -> list[Verdict]:
        """On its record."""
        return [] if self.record is None else judge(self.case, self.variant, self.record)

    def compare(self) -> None:
        """Set the error from the points of both runs."""
        if self.record is None or self.reference is None or self.reference["status"] not in ANSWERED:
            return
        own, finer = self.record["points"], self.reference["points"]
        if own.shape == finer.shape and len(own):
            self.error = float(np.linalg.norm(own - finer, axis=1).max() / self.case.size)

    @property
    def column(self) -> str:
        """The column of its end."""
        if self.record is None:
            return NOT_RUN
        missed = any(verdict.passed is False and not verdict.cost for verdict in self.verdicts)
        return WRONG if self.record["status"] == OK and missed else self.record["status"]

    @property
    def faults(self) -> list[str]:
        """Why it is not solved, in a few words each; empty if it is."""
        if self.record is None:
            return [NOT_RUN]
        missed = [verdict.quantity for verdict in self.verdicts if verdict.passed is False]
        return [self._wrong_end() if quantity == END else quantity for quantity in missed]

    def _wrong_end(self) -> str:
        must, status = self.variant.must, self.record["status"]
        unexcused = [cause for cause in self.record["causes"] if cause not in must.causes]
        if status in (must.end, DEGRADED) and unexcused:
            return ", ".join(unexcused)
        return f"{status}, must be {must.text}"

    def data(self) -> dict:
        """The row as plain data, without points."""

        run, reference = (r and {key: r[key] for key in r if key != "points"} for r in (self.record, self.reference))
        return {
            "case": self.case.id,
            "variant": self.variant.name,
            "settings": self.variant.settings,
            "must": asdict(self.variant.must),
            "column": self.column,
            "solved": not self.faults,
            "run": run,
            "reference": reference,
            "error": self.error,
            "left_out": self.left_out,
            "reference_left_out": self.reference_left_out,
            "verdicts": [asdict(verdict) for verdict in self.verdicts],
        }


def stored(numbers: dict) -> list[Row]:
    """Rows of all variants from stored results."""
    known = {(row["case"], row["variant"]): row for row in numbers["rows"]}
    absent = {"run": None, "reference": None, "left_out": "not in the stored results", "reference_left_out": "", "error": None}
    return [
        Row(case, variant, *(known.get((case.id, variant.name), absent)[key] for key in absent))
        for case, variant in VARIANTS.values()
    ]


def answer(request: dict) -> dict:
    """In a child: the record of a variant, or of its reference."""
    return Session(*VARIANTS[request["name"]], request["arch"], request["finer"]).record()


def measure(rows: list[Row], runs: Runs, arch: str, references: bool) -> None:
    """Run all rows, then their references, the cheap ones or all. Raises OutputError."""
    _run(rows, runs, arch, 1)
    finer = [
        row
        for row in rows
        if row.record
        and row.variant.reference
        and row.record["status"] in ANSWERED
        and (references or 2.0 * FINER * row.record["seconds"] <= CHEAP_SECONDS)
    ]
    _run(finer, runs, arch, FINER)
    for row in finer:
        row.compare()


def _run(rows: list[Row], runs: Runs, arch: str, finer: int) -> None:
    """Set the records of rows or of their references, or why there are none."""
    record, left_out, what = ("record", "left_out", "") if finer == 1 else ("reference", "reference_left_out", ", reference")
    requests = {row.name + what: {"name": row.name, "arch": arch, "finer": finer} for row in rows}
    for row, found in zip(rows, runs.records(requests, lambda one: f"{one['status']}, {one['seconds']:.1f} s")):
        setattr(row, left_out if LEFT_OUT in found else record, found.get(LEFT_OUT, found))
