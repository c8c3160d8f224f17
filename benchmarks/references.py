"""All reference problems: measured and reference values, a row per check, pass or fail.

taisoft bench references [--problem NAME] [--arch cpu|cuda] [--out FILE.json]

Computed in f64, but for cases whose mesh says f32. The reference values are in shared/references beside the repository, or
formulas in the code. Rows without a limit only show the error of a mesh or a step. Seconds include compilation and are shown in a
case's first row. Exit status: 0 all passed, 1 some failed, 2 without reference values.
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path

from taisoft.backend.runtime import open_runtime
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.machine import machine, versions

from .document import compact_text
from .reference_cases import CASES, PROBLEMS
from .reference_cases.record import Case, Check, computed
from .runner import add_arch, make_parser

REFERENCES = Path(__file__).resolve().parents[1].parent / "shared" / "references"
HEADINGS = ("problem", "law", "mesh", "quantity", "measured", "reference", "error", "limit", "", "seconds")
FORMAT = "{:24} {:11} {:30} {:64} {:>16} {:>16} {:>8} {:>8} {:4} {:>7}"


@dataclass(frozen=True)
class Row:
    """One line of the table: a check of a case. seconds: of the whole case in its first row, else 0."""

    case: Case
    check: Check
    seconds: float

    @property
    def verdict(self) -> str:
        """pass, FAIL, or - where there is no limit."""
        return self.check.verdict

    def record(self) -> dict:
        """As plain data."""
        case = {"problem": self.case.problem, "law": self.case.law, "mesh": self.case.mesh}
        return case | asdict(self.check) | {"verdict": self.verdict, "seconds": self.seconds}

    def __str__(self) -> str:
        case, check = self.case, self.check
        limit = "-" if check.limit is None else f"{check.limit:.1e}"
        numbers = f"{check.measured:.9g}", f"{check.reference:.9g}", f"{check.error:.1e}", limit
        seconds = f"{self.seconds:.1f}" if self.seconds else ""
        return FORMAT.format(case.problem, case.law, case.mesh, check.quantity, *numbers, self.verdict, seconds)


def run(case: Case, reference: dict, arch: str) -> list[Row]:
    """The rows of a case; a computation that fails is a failed row with the reason."""
    start = time.perf_counter()
    checks = computed(lambda: case.compute(reference, arch))
    seconds = [time.perf_counter() - start] + [0.0] * (len(checks) - 1)
    return [Row(case, check, s) for check, s in zip(checks, seconds)]


def _missing(problems) -> str | None:
    """Why the problems cannot be compared, or None."""
    tabulated = {case.problem for case in CASES if not case.closed_form}
    absent = [name for name in problems if name in tabulated and not (REFERENCES / f"{name}.json").is_file()]
    if not absent:
        return None
    if not REFERENCES.is_dir():
        return f"the folder of reference values is absent: {REFERENCES}"
    return f"reference values are absent from {REFERENCES}: {', '.join(absent)}"


def _rows(problems, arch: str) -> Iterator[Row]:
    for precision in ("f64", "f32"):  # a process has one at a time
        chosen = [case for case in CASES if case.problem in problems and case.precision == precision]
        with closing(open_runtime(arch, precision, "the benchmark of the reference problems")) if chosen else nullcontext():
            for case in chosen:
                path = REFERENCES / f"{case.problem}.json"
                reference = {} if case.closed_form else json.loads(path.read_text(encoding="utf-8"))
                yield from run(case, reference, arch)


def _write(path: Path, arch: str, rows: list[Row]) -> None:
    where = {"machine": machine(), "versions": versions("taisoft", "taichi", "numpy", "scipy")}
    write_bytes(path, compact_text({"arch": arch, "precision": "f64", **where, "rows": [row.record() for row in rows]}).encode())


def main(argv=None) -> int:
    """Run the cases and print their table. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("references", __doc__)
    parser.add_argument("--problem", choices=PROBLEMS, metavar="NAME", help=f"only this one of {', '.join(PROBLEMS)}")
    add_arch(parser)
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write the rows to this file too")
    options = parser.parse_args(argv)
    problems = (options.problem,) if options.problem else PROBLEMS
    missing = _missing(problems)
    if missing:
        print(f"taisoft bench references: {missing}", file=sys.stderr)
        return 2
    if options.out and not options.out.parent.is_dir():
        raise OutputError(f"{options.out} cannot be written: its folder does not exist")
    start, rows = time.perf_counter(), []
    print(FORMAT.format(*HEADINGS))
    for row in _rows(problems, options.arch):
        rows.append(row)
        print(row, flush=True)
    count = {verdict: sum(row.verdict == verdict for row in rows) for verdict in ("pass", "FAIL", "-")}
    print(
        f"{count['pass']} checks passed, {count['FAIL']} failed, {count['-']} without a limit; "
        f"{time.perf_counter() - start:.0f} s on {options.arch}"
    )
    if options.out:
        _write(options.out, options.arch, rows)
    return 1 if count["FAIL"] else 0


if __name__ == "__main__":
    sys.exit(main())
