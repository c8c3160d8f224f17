"""Suites: benchmarks of many cases, each run in a new process to a record that can be kept.

A request is plain data that names a case and its settings. `answer` of a benchmark turns it into a record, plain data and arrays,
in a child. Records are kept in --keep DIR under a digest of the request, the machine, the code of taisoft and the benchmark's
files, so that the same command goes on where it ended.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from taisoft.cli import Signals
from taisoft.files import write_bytes
from taisoft.machine import machine, usable_cores
from taisoft.many.places import LocalPlace, carry_out
from taisoft.many.store import Store, code_digest, digest
from taisoft.nested import from_json, to_json
from taisoft.output.folder import FolderLock, make_folder
from taisoft.processes import serve

from .document import Document, Limit
from .runner import files_digest, make_parser, parse_options, progress

Case = TypeVar("Case")
SHOWN = 30  # names of cases in a message
UNFINISHED = "unfinished"  # entry of a request: file in which a child leaves what it has so far; of a record: what it left
LEFT_OUT, CRASHED = "left_out", "crashed"  # entries of a record without an answer: why, and whether the process failed


# --- options ------------------------------------------------------------------------------------------------------------


def add_only(parser: argparse.ArgumentParser) -> None:
    """Add --only NAME ..., which `chosen` applies."""
    text = "only cases whose names contain one of these"
    parser.add_argument("--only", nargs="+", default=[""], metavar="NAME", help=text)


def suite_parser(name: str, doc: str, quick: str) -> argparse.ArgumentParser:
    """Parser with --only, --quick, --budget and --keep. quick: help of --quick."""
    parser = make_parser(name, doc)
    add_only(parser)
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--budget", type=float, default=math.inf, metavar="SECONDS", help="start no run after this time")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="store finished runs there, and reuse those stored")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)  # how `Runs` calls the benchmark again
    return parser


def suite_options(
    parser: argparse.ArgumentParser, argv: list[str] | None, answer: Callable[[dict], dict], arch: bool = True
) -> argparse.Namespace:
    """The options of a suite, see `parse_options`; in a child of `Runs` instead answer its request, and end."""
    options = parse_options(parser, argv, arch=arch)
    if options.child:
        serve(lambda request: {"answer": answer(request)})
    return options


def chosen(parser: argparse.ArgumentParser, only: Sequence[str], cases: dict[str, Case]) -> dict[str, Case]:
    """The cases whose names contain a text of --only; without any it is an error of the command line."""
    found = {name: case for name, case in cases.items() if any(text in name for text in only)}
    if not found:
        known = "; ".join(list(cases)[:SHOWN]) + ("; ..." if len(cases) > SHOWN else "")
        parser.error(f"no case has {' or '.join(map(repr, only))} in its name; there are {known}")
    return found


# --- runs ---------------------------------------------------------------------------------------------------------------


@dataclass
class Runs:
    """What `records` needs. child: arguments of Python; on: what all records depend on; end: when the budget is spent [s]."""

    child: tuple[str, ...]
    on: list
    store: Store
    signals: Signals
    end: float
    missing: list[str] = field(default_factory=list)  # requests without an answer, and why

    def records(self, requests: dict[str, dict], summary: Callable[[dict], str], seconds: float = math.inf) -> Iterator[dict]:
        """The record of each request in order; of one without an answer {LEFT_OUT, CRASHED}, and what it left UNFINISHED.

        requests: by name; summary: of a record, in a line; seconds: that a run may take [s]. Raises OutputError.
        """
        for number, (name, request) in enumerate(requests.items(), 1):
            key = digest([request, self.on])[:32]
            record = self.store.read(key)
            if record is None:
                record = self._run(key, request, seconds)
                outcome = f"{name}: {record[LEFT_OUT] if LEFT_OUT in record else summary(record)}"
                progress(f"{number} of {len(requests)}: {outcome}")
                self.missing += [outcome] * (LEFT_OUT in record)
            yield record

    def finish(self, document: Document, options: argparse.Namespace, numbers: dict, limits: Sequence[Limit] = (), **more) -> int:
        """As `Document.finish`, after a list of what is missing or was damaged; the status is 1 also if something is missing."""
        notes = [*self.missing, *self.store.damaged]
        if notes:
            document.add("\n".join(f"* {note}" for note in notes))
        return document.finish(options, numbers, limits, **more) or int(bool(self.missing))

    def _run(self, key: str, request: dict, seconds: float) -> dict:
        end, answers = min(self.end, time.monotonic() + seconds), {}
        with tempfile.TemporaryDirectory() as folder:
            unfinished = Path(folder) / "record.json"
            left = carry_out(
                [(key, request | {UNFINISHED: str(unfinished)})],
                [LocalPlace(usable_cores(), self.child)],
                answers.__setitem__,
                seconds_left=lambda: end - time.monotonic(),
                stop_requested=self.signals.requested,
            )
            if "answer" in answers.get(key, ()):
                return self.store.write(key, answers[key]["answer"])
            why = left.get(key) or answers[key].get("error") or answers[key]["crash"]
            partial = {UNFINISHED: from_json(unfinished.read_bytes())} if unfinished.exists() else {}
            return {LEFT_OUT: why, CRASHED: key not in left} | partial


@contextmanager
def runs_of(name: str, options: argparse.Namespace, *files: str) -> Iterator[Runs]:
    """Context of the runs of a benchmark, which a signal ends cleanly. Raises OutputError.

    files: patterns of the files that its records depend on, relative to this folder.
    """
    child = ("-m", "taisoft", "bench", name, "--child")
    found = [path for pattern in files for path in Path(__file__).parent.glob(pattern)]
    on = [machine(), code_digest(), files_digest(found)]
    folder = options.keep and make_folder(options.keep)
    lock = closing(FolderLock(folder)) if folder else nullcontext()
    with Signals("ending; runs that are finished are kept") as signals, lock:
        signals.run_began()
        yield Runs(child, on, Store(folder), signals, time.monotonic() + options.budget)


def leave(request: dict, record: dict) -> None:
    """In a child: leave what its record is so far, for the case that it cannot answer."""
    write_bytes(Path(request[UNFINISHED]), to_json(record).encode())
