"""Runs of the hard cases: each variant and reference in its own process, stored by a key of its inputs, with verdicts.

A variant is solved if it ended as required and met every limit. It is in one column: ok, degraded, refused, stopped, or wrong,
an ok end that is not allowed or that misses a limit on the answer.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from taisoft.machine import machine, usable_cores
from taisoft.many.places import LocalPlace, carry_out
from taisoft.many.store import Store, code_digest, digest

from .hard_cases import CASES
from .hard_cases.case import DEGRADED, END, FINER, OK, REFUSED, STOPPED, Case, Session, Variant, Verdict, judge
from .runner import files_digest

CHILD = ("-m", "taisoft", "bench", "hard", "--child")
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
    verdicts: list[Verdict] = field(default_factory=list)

    def judge(self) -> None:
        """Set the verdicts."""
        self.verdicts = [] if self.record is None else judge(self.case, self.variant, self.record)

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
    """Rows of all variants from stored results, with new verdicts."""
    known = {(row["case"], row["variant"]): row for row in numbers["rows"]}
    absent = {"run": None, "reference": None, "left_out": "not in the stored results", "reference_left_out": "", "error": None}
    rows = []
    for case in CASES:
        for variant in case.variants:
            one = known.get((case.id, variant.name), absent)
            row = Row(case, variant, one["run"], one["reference"], one["left_out"], one["reference_left_out"], one["error"])
            row.judge()
            rows.append(row)
    return rows


def find(case: str, variant: str) -> tuple[Case, Variant]:
    """A case by id and its variant by name."""
    found = next(one for one in CASES if one.id == case)
    return found, next(one for one in found.variants if one.name == variant)


def run(case: Case, variant: Variant, arch: str, finer: int = 1) -> dict:
    """Run a variant in this process; returns its record."""
    return Session(case, variant, arch, finer).record()


def answer(request: dict) -> dict:
    """In a child: answer a request with its run."""
    return {"answer": run(*find(request["case"], request["variant"]), request["arch"], request["finer"])}


def sources() -> str:
    """A digest of the files that define the cases."""
    here = Path(__file__).parent
    return files_digest([*here.glob("hard_cases/*.py"), *here.glob("reference_cases/*.py")])


@dataclass
class Runner:
    """Runs rows in child processes. seconds_left: of the budget; stop_requested: whether to stop; say: prints progress."""

    arch: str
    store: Store
    seconds_left: Callable[[], float]
    stop_requested: Callable[[], bool]
    say: Callable[[str], None]

    def measure(self, rows: list[Row], references: bool) -> None:
        """Run all rows, then the cheap references or all of them. Raises OutputError."""
        self._carry_out(rows, 1)
        finer = [
            row
            for row in rows
            if row.record
            and row.variant.reference
            and row.record["status"] in ANSWERED
            and (references or 2.0 * FINER * row.record["seconds"] <= CHEAP_SECONDS)
        ]
        self._carry_out(finer, FINER)
        for row in rows:
            row.compare()
            row.judge()

    def _carry_out(self, rows: list[Row], finer: int) -> None:
        record, left_out = ("record", "left_out") if finer == 1 else ("reference", "reference_left_out")
        on = [machine() | {"load": None}, code_digest(), sources(), self.arch]
        requests, waiting = [], {}
        for row in rows:
            request = {"case": row.case.id, "variant": row.variant.name, "arch": self.arch, "finer": finer}
            key = digest([request, on])[:32]
            kept = self.store.read(key)
            if kept is None:
                requests.append((key, request))
                waiting[key] = row
            else:
                setattr(row, record, kept)

        def done(key: str, result: dict) -> None:
            row = waiting[key]
            what = f"{row.case.id}, {row.variant.name}{', reference' if finer > 1 else ''}"
            if "answer" in result:
                setattr(row, record, self.store.write(key, result["answer"]))
                self.say(f"{what}: {result['answer']['status']}, {result['answer']['seconds']:.1f} s")
            else:
                why = result.get("error") or result["crash"]
                setattr(row, left_out, why)
                self.say(f"{what}: {why}")

        places = [LocalPlace(usable_cores(), CHILD)]
        left = carry_out(requests, places, done, seconds_left=self.seconds_left, stop_requested=self.stop_requested)
        for key, why in left.items():
            setattr(waiting[key], left_out, why)
