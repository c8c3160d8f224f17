"""Runs of the hard cases: each variant, and its reference, in a process of its own, and kept by what it depends on."""

import hashlib
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from taisoft.study.accuracy import pack, unpack
from taisoft.study.output import NoStore, Store, code_digest, digest
from taisoft.study.workers import LocalPlace, carry_out
from taisoft.timing import machine, usable_cores

from .hard_cases import CASES
from .hard_cases.record import DEGRADED, OK, Case, Variant, Verdict, judge
from .hard_cases.session import FINER, Session
from .hard_score import column, faults

CHILD = (sys.executable, "-m", "taisoft", "bench", "hard", "--child")
ANSWERED = (OK, DEGRADED)  # ends of runs that came to their ends
CHEAP_SECONDS = 60.0  # of a reference, guessed: a longer one is run only when asked for


@dataclass
class Row:
    """A variant of a case, what came of it, and what came of its reference, each None where it was not run.

    left_out, reference_left_out: why there is no record of it. error: largest distance to the reference run over the case's
    size, where both came to their ends.
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
        """Fill the verdicts."""
        self.verdicts = [] if self.record is None else judge(self.case, self.variant, self.record)

    def compare(self) -> None:
        """Fill the error, from the points of both runs."""
        if self.record is None or self.reference is None or self.reference["status"] not in ANSWERED:
            return
        own, finer = unpack(self.record["points"]), unpack(self.reference["points"])
        if own.shape == finer.shape and len(own):
            self.error = float(np.linalg.norm(own - finer, axis=1).max() / self.case.size)

    def data(self) -> dict:
        """As plain data, without points."""

        def bare(record: dict | None) -> dict | None:
            return record and {key: value for key, value in record.items() if key != "points"}

        return {
            "case": self.case.id,
            "variant": self.variant.name,
            "settings": self.variant.settings,
            "must": asdict(self.variant.must),
            "column": column(self),
            "solved": not faults(self),
            "run": bare(self.record),
            "reference": bare(self.reference),
            "error": self.error,
            "left_out": self.left_out,
            "reference_left_out": self.reference_left_out,
            "verdicts": [verdict.record() for verdict in self.verdicts],
        }


def stored(numbers: dict) -> list[Row]:
    """All variants, with what stored results tell of them, judged anew."""
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
    """The case of that id and its variant of that name."""
    found = next(one for one in CASES if one.id == case)
    return found, next(one for one in found.variants if one.name == variant)


def run(case: Case, variant: Variant, arch: str, finer: int = 1) -> dict:
    """The record of one run, as plain data, made in this process."""
    record = Session(case, variant, arch, finer).record()
    return record | {"points": pack(record["points"])}


def answer(request: dict) -> dict:
    """For a child: the request's run."""
    return {"answer": run(*find(request["case"], request["variant"]), request["arch"], request["finer"])}


def sources() -> str:
    """A digest of the files that say what the cases are and how they are run."""
    total = hashlib.sha256()
    here = Path(__file__).parent
    for path in sorted([*here.glob("hard_cases/*.py"), *here.glob("reference_cases/*.py")]):
        total.update(path.name.encode() + path.read_bytes())
    return total.hexdigest()


def measure(
    rows: list[Row],
    arch: str,
    references: bool,
    store: Store | NoStore,
    seconds_left: Callable[[], float],
    asked: Callable[[], bool],
    tell: Callable[[str], None],
) -> None:
    """Fill the rows: all runs first, then the references that are cheap, or all of them. Raises OutputError."""
    _carry_out(rows, arch, 1, store, seconds_left, asked, tell)
    finer = [
        row
        for row in rows
        if row.record
        and row.variant.reference
        and row.record["status"] in ANSWERED
        and (references or 2.0 * FINER * row.record["seconds"] <= CHEAP_SECONDS)
    ]
    _carry_out(finer, arch, FINER, store, seconds_left, asked, tell)
    for row in rows:
        row.compare()
        row.judge()


def _carry_out(rows: Iterable[Row], arch, finer, store, seconds_left, asked, tell) -> None:
    on = [machine() | {"load": None}, code_digest(), sources(), arch]
    requests, waiting = [], {}
    for row in rows:
        request = {"case": row.case.id, "variant": row.variant.name, "arch": arch, "finer": finer}
        key = digest([request, on])[:32]
        kept = store.read(key)
        if kept is None:
            requests.append((key, request))
            waiting[key] = row
        else:
            _take(row, kept, finer)

    def done(key: str, told: dict) -> None:
        row = waiting[key]
        what = f"{row.case.id}, {row.variant.name}{', reference' if finer > 1 else ''}"
        if "answer" in told:
            _take(row, store.write(key, told["answer"]), finer)
            tell(f"{what}: {told['answer']['status']}, {told['answer']['seconds']:.1f} s")
        else:
            why = told.get("error") or told["crash"]
            _leave_out(row, why, finer)
            tell(f"{what}: {why}")

    left = carry_out(requests, [LocalPlace(usable_cores(), CHILD)], done, seconds_left=seconds_left, stop_requested=asked)
    for key, why in left.items():
        _leave_out(waiting[key], why, finer)


def _leave_out(row: Row, why: str, finer: int) -> None:
    if finer == 1:
        row.left_out = why
    else:
        row.reference_left_out = why


def _take(row: Row, record: dict, finer: int) -> None:
    if finer == 1:
        row.record = record
    else:
        row.reference = record
