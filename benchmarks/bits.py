"""Same bits: whether another version computes exactly the same numbers as this one.

taisoft bench bits --write FILE | --against FILE [--quick] [--case PREFIX]

Runs 20 steps of all demos, of twelve hard cases, and of ten scenes with contacts in explicit and implicit steps, in f32 and f64,
on one thread and on two. --write stores digests of positions, velocities, and places and impulses of contacts after each step,
and the last positions. --against compares with such a file: the first step that differs, what differs in it, and the greatest
difference of the last positions, also over the size of the scene. On two threads the loops over small scenes are parallel too.
Two cores are needed. Exit status: 0, 1 if anything differs or a case fails, 2 for a FILE that cannot be compared.
"""

import argparse
import gzip
import hashlib
import math
import sys
import time
import zlib
from contextlib import ExitStack
from functools import partial
from importlib import import_module
from itertools import zip_longest
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.cli import Signals
from taisoft.errors import SceneError, SimulationError
from taisoft.files import write_bytes
from taisoft.machine import machine, usable_cores
from taisoft.many.places import LocalPlace, carry_out
from taisoft.nested import from_json, to_json
from taisoft.output.tables import markdown
from taisoft.processes import serve

from .bits_cases import Case, all_cases
from .document import check_out, header
from .runner import make_parser, patched, progress, without_warnings

STEPS = 20
KIND, FORMAT = "taisoft bits", 2
CHILD = ("-m", "taisoft", "bench", "bits", "--child")
PARTS = ("positions", "velocities", "contacts")
SAME, RECORDED = "same", "recorded"
NOTHING = {"digests": [], "positions": np.zeros((0, 3)), "contacts": 0, "error": "", "seconds": 0.0}
# What makes loops over small scenes parallel: module, name, value
PARALLEL = (
    ("backend.parallel", "pays", lambda seconds: True),
    ("fem.build", "CHUNKED_FROM", 0),
    ("fem.chunks", "MIN_SHIFT", 2),
    ("collision.surface", "SERIAL_BELOW", 0),
    ("dynamics.stage_system", "SHARED_FROM", 0),
)


# --- runs ---------------------------------------------------------------------------------------------------------------


class Finished(Exception):
    """The last step of a case was recorded."""


class RecordedSimulator(ts.Simulator):
    """A simulator that takes one step at a time and enters each into a record; raises Finished after the last of `steps`."""

    def __init__(self, record: dict, steps: int, *arguments, **settings):
        super().__init__(*arguments, **settings)
        self._record, self._steps = record, steps

    def advance(self, n: int):
        """See Simulator; takes one step."""
        report = super().advance(1)
        found, record, positions = self.contacts(), self._record, self.positions()
        record["digests"].append(digests_of(positions, self.velocities(), found.point, found.impulse))
        record["contacts"] = max(record["contacts"], len(found))
        record["positions"] = positions
        if len(record["digests"]) == self._steps:
            raise Finished
        return report


def digests_of(positions: np.ndarray, velocities: np.ndarray, points: np.ndarray, impulses: np.ndarray) -> list[str]:
    """Digests of PARTS; that of contacts does not depend on their order."""
    contacts = sorted(row.tobytes() for row in np.column_stack([points, impulses]))
    return [hashlib.sha256(data).hexdigest() for data in (positions.tobytes(), velocities.tobytes(), b"".join(contacts))]


def run(case: Case, steps: int = STEPS) -> dict:
    """Run a case in this process. Returns its record: the fields of NOTHING, digests for each step, most contacts in a step."""
    record, clock = NOTHING | {"digests": []}, time.perf_counter()
    with without_warnings():
        try:
            case.run(partial(RecordedSimulator, record, steps))
        except Finished:
            pass
        except Exception as error:  # whatever stops a case is a result
            record["error"] = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return record | {"seconds": time.perf_counter() - clock}


def answer(request: dict) -> dict:
    """In a child: run cases of one precision and number of threads. Returns their records by key."""
    threads, keys = request["threads"], request["keys"]
    if len(usable_cores()) != threads:
        raise SimulationError(f"this system does not keep a process on {threads} cores")
    with ExitStack() as stack:
        for module, name, value in PARALLEL if threads > 1 else ():
            stack.enter_context(patched(import_module(f"taisoft.{module}"), name, value))
        records = {case.key: run(case) for case in all_cases() if case.key in keys}
    return {"answer": records}


def run_all(cases: list[Case]) -> dict[str, dict]:
    """The records of cases by key: those on one thread side by side, then those on two. Raises SceneError without two cores."""
    cores = usable_cores()[:2]
    if len(cores) < 2:
        raise SceneError("taisoft bench bits needs two cores, since some of its cases run on two threads")
    groups: dict[tuple, list[str]] = {}
    for case in cases:
        groups.setdefault((case.threads, case.name.split()[0], case.precision), []).append(case.key)
    found: dict[str, dict] = {}

    def done(group: tuple, result: dict) -> None:
        crash = NOTHING | {"error": result.get("error") or result.get("crash")}
        found.update(result.get("answer") or dict.fromkeys(groups[group], crash))
        progress(f"{len(found)} of {len(cases)} runs; {time.perf_counter() - clock:.0f} s")

    clock = time.perf_counter()
    for threads, places in ((1, [LocalPlace([core], CHILD) for core in cores]), (2, [LocalPlace(cores, CHILD)])):
        requests = [(group, {"threads": threads, "keys": keys}) for group, keys in groups.items() if group[0] == threads]
        with Signals():
            carry_out(requests, places, done, seconds_left=lambda: math.inf, stop_requested=lambda: False)
    return {case.key: found[case.key] for case in cases}


# --- the file -----------------------------------------------------------------------------------------------------------


def write(path: Path, settings: dict, records: dict[str, dict]) -> None:
    """Write records atomically. Raises OutputError."""
    whole = {"kind": KIND, "format": FORMAT, "header": header("")[1], "settings": settings, "records": records}
    write_bytes(path, gzip.compress(to_json(whole).encode(), mtime=0))


def read(path: Path, settings: dict) -> dict:
    """The content of a file. Raises SceneError if it is missing, damaged or of a run with other settings."""
    try:
        whole = from_json(gzip.decompress(path.read_bytes()))
        if (whole["kind"], whole["format"]) != (KIND, FORMAT):
            raise ValueError("another kind or format")
        stored = whole["settings"]
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError, AttributeError, EOFError, zlib.error) as error:
        raise SceneError(f"{path} is damaged or not of `taisoft bench bits`: {type(error).__name__}: {error}") from None
    if stored | {"case": ""} != settings | {"case": ""} or not settings["case"].startswith(stored["case"]):
        raise SceneError(f"{path} holds another kind of run: {stored}, this one is {settings}")
    return whole


# --- comparison ---------------------------------------------------------------------------------------------------------


def verdict(new: dict | None, old: dict | None) -> str:
    """Whether two records are the same, or from which step on they differ, and in what."""
    if new is None or old is None:
        return "not in FILE" if old is None else "only in FILE"
    for step, (a, b) in enumerate(zip_longest(new["digests"], old["digests"], fillvalue=[""] * len(PARTS)), 1):
        if a != b:
            return f"differs from step {step} ({', '.join(part for part, p, q in zip(PARTS, a, b) if p != q)})"
    return SAME if new["error"] == old["error"] else "differs in its error"


def difference(new: dict | None, old: dict | None) -> tuple[float, float]:
    """The greatest difference of last positions [m], and over the diagonal of the old ones; nan for other numbers of nodes."""
    x, y = ((one or NOTHING)["positions"] for one in (new, old))
    if x.shape != y.shape or not len(y):
        return math.nan, math.nan
    greatest = float(np.abs(x - y).max())
    size = float(np.linalg.norm(np.ptp(y, axis=0)))
    return greatest, greatest / size if size else math.nan


def report(new: dict[str, dict], old: dict[str, dict] | None) -> int:
    """Print a row for each case, errors and a summary. old: None if nothing is compared. Returns the exit status."""
    rows, errors, n_differ = [], [], 0
    for key in dict.fromkeys([*new, *(old or {})]):
        a, b = new.get(key), (old or {}).get(key)
        how = RECORDED if old is None else verdict(a, b)
        is_same = how in (RECORDED, SAME)
        n_differ += not is_same
        apart = ("-", "-") if is_same else (f"{number:.2g}" for number in difference(a, b))
        shown = a or b
        rows.append((*key.rsplit(", ", 2), str(shown["contacts"]), how, *apart, f"{shown['seconds']:.1f}"))
        errors += [f"* {key}: {shown['error']}"] * bool(shown["error"])
    headings = ("case", "precision", "threads", "contacts", "verdict", "difference [m]", "over size", "s")
    print(markdown(headings, rows, left=(0, 1, 4)), "", *errors, sep="\n")
    print(f"{len(rows)} runs of {STEPS} steps: {f'{n_differ} differ, ' if old is not None else ''}{len(errors)} failed")
    return 1 if n_differ or errors else 0


def main(argv=None) -> int:
    """Run, then write or compare. Raises SceneError or OutputError."""
    parser = make_parser("bits", __doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--write", type=Path, metavar="FILE", help="store what this version computes")
    which.add_argument("--against", type=Path, metavar="FILE", help="compare with what another version stored")
    which.add_argument("--child", action="store_true", help=argparse.SUPPRESS)  # how this command runs a group of cases
    parser.add_argument("--quick", action="store_true", help="eight cheap runs")
    parser.add_argument("--case", default="", metavar="PREFIX", help="only cases with this prefix")
    options = parser.parse_args(argv)
    if options.child:
        serve(answer)
    cases = [case for case in all_cases() if case.name.startswith(options.case) and (case.quick or not options.quick)]
    if not cases:
        parser.error(f"no case begins with {options.case!r}")
    settings = {"steps": STEPS, "quick": options.quick, "case": options.case}
    if options.write:
        check_out(options.write, options.write.suffix)
        records = run_all(cases)
        write(options.write, settings, records)
        return report(records, None)
    stored = read(options.against, settings)
    if stored["header"]["processor"] != machine()["processor"]:
        print(f"{options.against} is of another processor, whose bits may differ: {stored['header']['processor']}")
    return report(run_all(cases), {key: one for key, one in stored["records"].items() if key.startswith(options.case)})


if __name__ == "__main__":
    sys.exit(main())
