"""All reference problems: measured and reference values, a row per check, pass or fail.

taisoft bench references [--only NAME ...] [--arch cpu|cuda] [--out [FILE.json]]

Computed in f64, but for cases whose mesh says f32. The reference values are in shared/references beside the repository, or
formulas in the code. Rows without a limit only show the error of a mesh or a step. Seconds include compilation and are shown in a
case's first row. Exit status: 0 all passed, 1 some failed, 2 without reference values.
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import closing, nullcontext
from dataclasses import asdict
from pathlib import Path

from taisoft.backend.runtime import open_runtime

from .document import begin, table
from .reference_cases import CASES
from .reference_cases.record import Case, computed
from .runner import make_parser, parse_options, progress
from .suite import add_only, chosen

REFERENCES = Path(__file__).resolve().parents[1].parent / "shared" / "references"
COLUMNS = (
    *((f"<{name}", f"{{0[{name}]}}") for name in ("problem", "law", "mesh")),
    ("<quantity", lambda row: row["quantity"].replace("|", r"\|")),
    ("measured", "{0[measured]:.9g}"),
    ("reference", "{0[reference]:.9g}"),
    ("error", "{0[error]:.1e}"),
    ("limit", lambda row: "-" if row["limit"] is None else f"{row['limit']:.1e}"),
    ("<", "{0[verdict]}"),
    ("seconds", lambda row: f"{row['seconds']:.1f}" if row["seconds"] else ""),
)


def run(case: Case, reference: dict, arch: str) -> list[dict]:
    """The rows of a case; a computation that fails is a failed row with the reason. The first has the seconds of all."""
    start = time.perf_counter()
    checks = computed(lambda: case.compute(reference, arch))
    seconds = [time.perf_counter() - start] + [0.0] * (len(checks) - 1)
    what = {"problem": case.problem, "law": case.law, "mesh": case.mesh}
    return [what | asdict(check) | {"verdict": check.verdict, "seconds": s} for check, s in zip(checks, seconds)]


def missing(cases: list[Case]) -> list[str]:
    """The problems without a file of reference values."""
    tabulated = dict.fromkeys(case.problem for case in cases if not case.closed_form)
    return [name for name in tabulated if not (REFERENCES / f"{name}.json").is_file()]


def all_rows(cases: list[Case], arch: str) -> Iterator[dict]:
    """The rows of cases."""
    for precision in ("f64", "f32"):  # a process has one at a time
        own = [case for case in cases if case.precision == precision]
        with closing(open_runtime(arch, precision, "the benchmark of the reference problems")) if own else nullcontext():
            for case in own:
                path = REFERENCES / f"{case.problem}.json"
                rows = run(case, {} if case.closed_form else json.loads(path.read_text(encoding="utf-8")), arch)
                progress(f"{case.name}: {', '.join(row['verdict'] for row in rows)}; {rows[0]['seconds']:.1f} s")
                yield from rows


def main(argv=None) -> int:
    """Run the cases and print their table. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("references", __doc__)
    add_only(parser)
    options = parse_options(parser, argv)
    cases = list(chosen(parser, options.only, {case.name: case for case in CASES}).values())
    if absent := missing(cases):
        what = ", ".join(absent) if REFERENCES.is_dir() else "the folder is missing"
        print(f"taisoft bench references: reference values are absent from {REFERENCES}: {what}", file=sys.stderr)
        return 2
    document, numbers = begin("Reference problems", options.arch)
    rows = list(all_rows(cases, options.arch))
    document.add(table(rows, COLUMNS))
    count = {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in ("pass", "FAIL", "-")}
    document.add(f"{count['pass']} checks passed, {count['FAIL']} failed, {count['-']} without a limit.")
    return document.finish(options, numbers | {"precision": "f64", "rows": rows}) or int(count["FAIL"] > 0)


if __name__ == "__main__":
    sys.exit(main())
