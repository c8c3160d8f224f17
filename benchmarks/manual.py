"""Manual: its measured tables, made anew from the files in benchmarks/results.

taisoft bench manual [--check]

The text between `<!-- begin NAME -->` and `<!-- end NAME -->` on a page of docs/ is that of TABLES[NAME], made from the newest
results of a benchmark, so that no measured number is typed by hand. A table is a function of the folder of results. --check
writes nothing. Exit status: 0, or with --check 1 where a page differs from the results.
"""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median

from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.tables import markdown

from .document import RESULTS, table
from .hard_cases import CASES
from .hard_runs import Row, stored
from .hard_table import ALL, cells, headline, how_solved, shown_columns, tally
from .order import DEFAULT_DEGREE, GOAL
from .order_cases import HANGING
from .reference_cases.record import label
from .runner import make_parser
from .works.table import compare_table

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"(<!-- begin (\w+) -->\n).*?(<!-- end \2 -->\n)", re.DOTALL)
MARKER = re.compile(r"<!-- (?:begin|end) (\w+) -->")
ORDERS = {1: "linear", 2: "quadratic"}


def newest(results: Path, benchmark: str) -> dict:
    """The newest whole results of a benchmark, from BENCHMARK-*.json. Raises OutputError where there are none."""
    found = []
    for path in sorted(results.glob(f"{benchmark}-*.json")):
        try:
            found.append(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise OutputError(f"{path} cannot be read: {error}") from error
    found = [numbers for numbers in found if not numbers.get("quick")]
    if not found:
        raise OutputError(f"{results} holds no results of `taisoft bench {benchmark}`")
    return max(found, key=lambda numbers: numbers["date"])


def measured_on(numbers: dict, *more: str) -> str:
    """Where and with what numbers were measured, in a line below a table."""
    known = [numbers[name] for name in ("arch", "precision") if name in numbers]
    where = ", ".join([numbers["processor"], f"{numbers['cores']} cores", *known, numbers["date"][:10]])
    return f"\n\nMeasured on: {'; '.join([where, *more])}."


def order_errors(results: Path) -> str:
    """Errors of the hanging beam by order and mesh, with four and with fourteen quadrature points."""
    numbers = newest(results, "order")
    exact = numbers["references"][HANGING]["values"][0]
    rows = [row for row in numbers["rows"] if row["case"] == HANGING and row["measured"]]

    def error(order: int, degree: int | None, cells: list[int]) -> str:
        own = [row for row in rows if (row["order"], row["degree"], row["cells"]) == (order, degree, cells)]
        return f"{own[0]['measured'][0] / exact - 1:+.3%}" if own else ""

    columns = (
        ("<tets", lambda row: ORDERS[row["order"]]),
        ("<cells", lambda row: label(row["cells"])),
        ("number", "{[tets]:,}"),
        ("nodes", "{[nodes]:,}"),
        ("error", lambda row: error(row["order"], row["degree"], row["cells"])),
        ("with 14 points", lambda row: error(row["order"], 4, row["cells"])),
    )
    return table([row for row in rows if row["degree"] == DEFAULT_DEGREE[row["order"]]], columns)


def order_times(results: Path) -> str:
    """Times to 1 % error of both orders, of the cases in which both reach it."""
    numbers = newest(results, "order")
    titles = {row["case"]: f"{row['case']}, {row['law']}" for row in numbers["rows"]}
    lines = []
    for c in numbers["comparisons"]:
        reached = [c["reach"][str(order)] for order in ORDERS]
        if c["goal"] == GOAL and all(reach is not None and reach["bound"] == "=" for reach in reached):
            times = [f"{reach['seconds']:.3g}" for reach in reached]
            lines.append((titles[c["case"]], *times, f"{c['ratio']['median']:.2g}"))
    return markdown(("case", "linear [s]", "quadratic [s]", "speed-up"), lines, left=(0,)) + measured_on(numbers)


def peers(results: Path) -> str:
    """taisoft beside other programs at equal error, without the stiff beams."""
    numbers = newest(results, "peers")
    used = [numbers["versions"][name] for name in ("mujoco", "pybullet", "newton")]
    programs = "MuJoCo {}, PyBullet {}, Newton {}".format(*used)
    shown = [one for one in numbers["comparisons"] if not one["stiff"]]
    return compare_table(shown) + measured_on(numbers, programs)


def collision(results: Path) -> str:
    """A whole search for contacts by scene, by proximity and by distance fields."""
    numbers = newest(results, "collision")
    rows = {(row["setup"], row["geometry"]): row for row in numbers["scenes"] + numbers["piles"] if not row["failure"]}
    lines = []
    for (setup, geometry), row in rows.items():
        other = rows.get((setup, "distance_field"))
        if geometry == "proximity" and other is not None:
            times = [f"{1e3 * median(one['whole']):.3g}" for one in (row, other)]
            lines.append((setup, *[f"{row[name]:,}" for name in ("tets", "triangles", "pairs", "contacts")], *times))
    headings = ("scene", "tets", "triangles", "pairs of near ones", "contacts", "proximity [ms]", "distance fields [ms]")
    return markdown(headings, lines, left=(0,)) + measured_on(numbers)


def scaling(results: Path) -> str:
    """Time and memory a tet on the smallest and the largest mesh, and how the time grows between them."""
    numbers = newest(results, "scaling")
    lines = []
    for growth in numbers["exponents"]:
        own = sorted((r for r in numbers["rows"] if r["kind"] == growth["kind"] and r["samples"]), key=lambda r: r["tets"])
        if len(own) < 2:
            continue
        each = [f"{1e9 * median(row['samples']) / row['tets']:.3g}" for row in (own[0], own[-1])]
        memory = sum(own[-1]["field_bytes"].values()) / own[-1]["tets"]
        sizes = [f"{row['tets']:,}" for row in (own[0], own[-1])]
        lines.append((growth["kind"], sizes[0], each[0], sizes[1], each[1], f"{growth['step']:.2f}", f"{memory:.0f}"))
    headings = ("step or search", "tets", "ns/tet", "tets", "ns/tet", "exponent of the time", "fields there [B/tet]")
    return markdown(headings, lines, left=(0,)) + measured_on(numbers)


def hard(results: Path) -> str:
    """The hard cases: how many variants are solved, how they ended, and why the others are not solved."""
    numbers = newest(results, "hard")
    rows = stored(numbers)
    shown = shown_columns(rows)

    def line(name: str, title: str, own: list[Row]) -> tuple[str, ...]:
        seconds = sum(row.record["seconds"] for row in own if row.record is not None)
        return name, title, *cells(tally(own), shown), f"{seconds:.3g}"

    lines = []
    for case in CASES:
        own = [row for row in rows if row.case is case]
        why = dict.fromkeys(fault for row in own for fault in row.faults)
        lines.append((*line(case.id, case.name, own), "; ".join(why)))
    headings = ("case", "", *shown, "wall [s]", "not solved because of")
    text = markdown(headings, [*lines, (*line("", ALL, rows), "")], left=(0, 1, len(headings) - 1))
    return f"{headline(rows)} {how_solved(rows)}\n\n{text}" + measured_on(numbers)


TABLES: dict[str, Callable[[Path], str]] = {  # by marker
    "order_errors": order_errors,
    "order_times": order_times,
    "peers": peers,
    "scaling": scaling,
    "collision": collision,
    "hard": hard,
}


def filled(text: str, results: Path = RESULTS) -> str:
    """The text with every marked part made anew. Raises OutputError for a marker that is not known or stands alone."""
    whole = [name for _, name, _ in BLOCK.findall(text)]
    marked = MARKER.findall(text)
    if sorted(marked) != sorted(2 * whole):
        alone = next(name for name in marked if marked.count(name) != 2 or name not in whole)
        raise OutputError(f"the marker '{alone}' needs one begin and one end after it")
    unknown = [name for name in whole if name not in TABLES]
    if unknown:
        raise OutputError(f"the marker '{unknown[0]}' is unknown; there are {', '.join(TABLES)}")
    return BLOCK.sub(lambda m: f"{m[1]}\n{TABLES[m[2]](results)}\n\n{m[3]}", text)


def pages() -> list[Path]:
    """Pages of the manual that hold tables. Raises OutputError where there are none."""
    found = [path for path in sorted(DOCS.glob("*.md")) if MARKER.search(path.read_text(encoding="utf-8"))]
    if not found:
        raise OutputError(f"{DOCS} holds no page with tables: run this in a checkout")
    return found


def main(argv=None) -> int:
    """Write the pages anew, or say which differ from the results. Raises OutputError."""
    parser = make_parser("manual", __doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args(argv)
    differing = 0
    for page in pages():
        text = page.read_text(encoding="utf-8")
        made = filled(text)
        if made == text:
            print(f"{page.name} agrees with the results")
        elif options.check:
            print(f"{page.name} differs from the results: `taisoft bench manual` writes it anew")
            differing += 1
        else:
            write_bytes(page, made.encode())
            print(f"written: {page}")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
