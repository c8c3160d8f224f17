"""Regression: error, iterations, memory and time of short cases against those stored.

taisoft bench regression [--update] [--only NAME ...] [--arch cpu|cuda]

The numbers are in benchmarks/data/regression.json, separately for each arch. They reveal drifts within limits: an error that has
doubled, a solver that needs more iterations. A number counts as the same within

    errors      5 % of the stored one, plus the effect of another order of summation: 1e-5 in f32, 1e-9 in f64, or the case's own
    counts      5 %, at least 2: of Newton and CG iterations, sweeps, contacts, pairs
    memory      0.1 % of the bytes of all fields
    status      the same

since CPU runs are bitwise reproducible on one machine, while another processor or compiler rounds differently and may change
iteration counts by one. A number better than stored counts as changed too: --update prints the
differences and stores the new numbers. It also computes and stores references that are not formulas.

Times are shown but not compared. Their unit is 100 products of a sparse matrix (20,000 rows of 27) with a vector, on one thread
in the same run: these gather and multiply as steps do, so that the ratio varies less between machines than seconds. Exit status:
0, 1 if a number has changed, 2 if none is stored.
"""

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.machine import machine, versions
from taisoft.output.report import json_text
from taisoft.output.tables import markdown

from .regression_cases import CASES, Case, Found
from .runner import add_arch, make_parser, progress
from .suite import add_only, chosen

STORE = Path(__file__).resolve().parent / "data" / "regression.json"
ERROR_MARGIN, COUNT_MARGIN, COUNT_LEAST, MEMORY_MARGIN = 0.05, 0.05, 2, 1e-3
ROWS, BESIDE, PRODUCTS = 20_000, 13, 100  # baseline: rows, entries on each side of the diagonal, products per unit


@dataclass(frozen=True)
class Entry:
    """The numbers of a case. reference: expected numbers; time: over the baseline."""

    reference: list[float]
    error: float
    counts: dict[str, int]
    status: str
    field_bytes: int
    time: float


def baseline() -> float:
    """The unit of times [s]: the best of several runs on one thread."""
    matrix = sp.diags([1.0] * (2 * BESIDE + 1), range(-BESIDE, BESIDE + 1), shape=(ROWS, ROWS), format="csr")
    x = np.ones(ROWS)

    def seconds() -> float:
        start = time.perf_counter()
        for _ in range(PRODUCTS):
            matrix @ x
        return time.perf_counter() - start

    return min(seconds() for _ in range(5))


def make_entry(found: Found, reference: list[float], unit: float) -> Entry:
    """The stored numbers of a computation. unit: seconds of the baseline."""
    exact = np.array(reference)
    error = float(np.abs(np.array(found.measured) - exact).max() / np.abs(exact).max())
    return Entry(list(reference), error, found.counts, found.status, found.field_bytes, found.seconds / unit)


def differences(case: Case, new: Entry, old: Entry) -> list[str]:
    """Changes beyond the margins, in words, without times."""
    found = []
    if new.status != old.status:
        found.append(f"status '{new.status}', stored '{old.status}'")
    if not abs(new.error - old.error) <= ERROR_MARGIN * old.error + case.slack:
        found.append(f"error {new.error:.4g}, stored {old.error:.4g}")
    for name in dict.fromkeys([*old.counts, *new.counts]):
        now, before = new.counts.get(name, 0), old.counts.get(name, 0)
        if abs(now - before) > max(COUNT_LEAST, COUNT_MARGIN * before):
            found.append(f"{name} {now}, stored {before}")
    if abs(new.field_bytes - old.field_bytes) > MEMORY_MARGIN * old.field_bytes:
        found.append(f"field bytes {new.field_bytes}, stored {old.field_bytes}")
    return found


def load(arch: str, path: Path) -> dict[str, Entry]:
    """Stored entries of an arch by case name. Raises OutputError if the file cannot be read."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        return {name: Entry(**entry) for name, entry in stored.get(arch, {}).get("cases", {}).items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from error


def store(entries: dict[str, Entry], arch: str, path: Path) -> None:
    """Replace the stored entries of an arch; other cases and archs stay, removed cases are deleted."""
    whole = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known = load(arch, path) | entries
    kept = {case.name: asdict(known[case.name]) for case in CASES if case.name in known}
    made = {"processor": machine()["processor"], "versions": versions("taichi", "numpy", "scipy")}
    whole[arch] = {"stored_on": made, "cases": kept}
    write_bytes(path, json_text(dict(sorted(whole.items()))).encode())


def row(case: Case, new: Entry, old: Entry | None, seconds: float) -> tuple[str, ...]:
    """A line of the table."""
    counts = ", ".join(f"{n:,} {name}" for name, n in new.counts.items())
    verdict = "new" if old is None else "CHANGED" if differences(case, new, old) else "same"
    error, taken = ("-", "-") if old is None else (f"{old.error:.3e}", f"{old.time:.3g}")
    numbers = f"{new.error:.3e}", error, counts, f"{new.field_bytes:,}", f"{new.time:.3g}", taken
    return case.name, case.precision, *numbers, verdict, f"{seconds:.0f}"


HEADINGS = ("case", "", "error", "stored", "counts", "bytes", "time", "stored", "", "s")


def main(argv=None) -> int:
    """Compute, compare and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("regression", __doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="store the new numbers")
    add_only(parser)
    add_arch(parser)
    options = parser.parse_args(argv)
    cases = chosen(parser, options.only, {case.name: case for case in CASES}).values()
    stored, entries, lines, changes = load(options.arch, STORE), {}, [], []
    missing = [case.name for case in cases if case.name not in stored]
    if missing and not options.update:
        print(f"taisoft bench regression: nothing is stored for {options.arch} of {', '.join(missing)}: --update stores it")
        return 2
    for case in cases:
        progress(case.name)
        begin, old = time.perf_counter(), stored.get(case.name)
        unit = baseline()
        reference = case.reference(options.arch) if options.update or old is None else old.reference
        new = entries[case.name] = make_entry(case.run(options.arch), reference, unit)
        lines.append(row(case, new, old, time.perf_counter() - begin))
        changes += [f"* {case.name}: {change} ({case.what})" for change in (differences(case, new, old) if old else ())]
    print(markdown(HEADINGS, lines, left=(0, 1, 4, 8)))
    print("\n".join(["", *(changes or ["nothing has changed"])]))
    if options.update:
        store(entries, options.arch, STORE)
        print(f"written: {STORE}")
        return 0
    return 1 if changes else 0


if __name__ == "__main__":
    sys.exit(main())
