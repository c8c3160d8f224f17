"""Results of a benchmark: a Markdown page of tables and limits, a JSON file, reading the numbers of an earlier run."""

import argparse
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from datetime import datetime
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.machine import Timing, load_average, machine, summarise, versions
from taisoft.output import tables
from taisoft.output.folder import make_folder
from taisoft.output.report import json_text
from taisoft.output.tables import markdown, percent, spread_of

RESULTS = Path(__file__).resolve().parent / "results"
DIGITS = 8  # of stored numbers


# --- the page -----------------------------------------------------------------------------------------------------------


class Document:
    """A page that is printed as it grows."""

    def __init__(self) -> None:
        self.parts: list[str] = []

    def add(self, text: str) -> None:
        """Print a part and append it."""
        self.parts.append(text)
        print(text, end="\n\n", flush=True)

    def text(self) -> str:
        """The whole page."""
        return "\n\n".join(self.parts) + "\n"

    def write(self, out: Path, numbers: dict) -> None:
        """Write the numbers to `out`, a .json file, and the page beside it. Raises OutputError."""
        write_bytes(out, compact_text(plain(numbers)).encode())
        write_bytes(out.with_suffix(".md"), self.text().encode())

    def finish(
        self, options: argparse.Namespace, numbers: dict, limits: Sequence["Limit"] = (), draw: Callable | None = None
    ) -> int:
        """Add the limits, write --out and --plot, and return the exit status: 1 if a limit is not met.

        draw: writes the picture of --plot to a path.
        """
        if limits:
            self.add("## Limits\n\n" + limit_table(limits))
        if options.out:
            chosen = {name: value for name, value in vars(options).items() if name in ("arch", "precision", "quick")}
            numbers = chosen | {"load_at_the_end": load_average()} | numbers
            self.write(options.out, numbers | {"limits": list(limits)})
            print(f"written: {options.out} and {options.out.with_suffix('.md').name}")
        if draw and options.plot:
            draw(options.plot)
            print(f"written: {options.plot}")
        return 0 if all(limit.met for limit in limits) else 1


def begin(title: str, *how: str, packages: tuple[str, ...] = ("taichi", "numpy", "scipy")) -> tuple[Document, dict]:
    """A document with its header, and the header as data."""
    document, (text, numbers) = Document(), header(title, *how, packages=packages)
    document.add(text)
    return document, numbers


def header(title: str, *how: str, packages: tuple[str, ...] = ("taichi", "numpy", "scipy")) -> tuple[str, dict]:
    """Title, machine, date and versions, as text and as data."""
    found = machine() | {"load": load_average(), "date": datetime.now().isoformat(timespec="minutes")}
    numbers = found | {"versions": {"taisoft": ts.__version__, **versions(*packages)}}
    return header_text(title, numbers, *how), numbers


def header_text(title: str, numbers: dict, *how: str) -> str:
    """The header of stored numbers."""
    return (
        f"# {title}\n\n{', '.join([numbers['processor'], str(numbers['cores']) + ' cores', *how])}, "
        f"load {load_text(numbers['load'])} at the start; {numbers['date']}\n"
        + ", ".join(f"{name} {version or 'absent'}" for name, version in numbers["versions"].items())
    )


def load_text(value: float | None) -> str:
    """A load average."""
    return "unknown" if value is None else f"{value:.1f}"


def plain(value):
    """The value as plain data: records and dataclasses become dicts, also inside lists and dicts."""
    if hasattr(value, "record"):
        return plain(value.record())
    if is_dataclass(value):
        return asdict(value)
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value


def compact_text(record: dict) -> str:
    """JSON text of a record, one line for each of its entries, numbers with DIGITS digits: stored results are many."""

    def rounded(value):
        if isinstance(value, dict):
            return {key: rounded(one) for key, one in value.items()}
        if isinstance(value, list):
            return [rounded(one) for one in value]
        return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value

    entries = rounded(json.loads(json_text(record))).items()
    lines = (f"{json.dumps(key)}:{json.dumps(value, separators=(',', ':'))}" for key, value in entries)
    return "{" + ",\n".join(lines) + "}\n"


# --- files --------------------------------------------------------------------------------------------------------------


def check_out(path: Path | None, suffix: str) -> None:
    """Raise OutputError, before minutes of measuring, if a file cannot be written."""
    if path is None:
        return
    if path.suffix != suffix:
        raise OutputError(f"{path}: the name must end in {suffix}")
    if not os.access(make_folder(path.parent), os.W_OK):
        raise OutputError(f"cannot write {path}: its folder is not writable")


def default_out(arch: str, what: str, suffix: str = ".json") -> Path:
    """results/<what>-<machine><suffix>; a folder without a suffix."""
    where = machine()
    return RESULTS / f"{what}-{slug(where['processor'])}-{where['cores']}-cores{'-cuda' if arch == 'cuda' else ''}{suffix}"


def slug(text: str) -> str:
    """The text as part of a file name: lower case, without trade marks, other characters as dashes."""
    text = re.sub(r"\((r|tm|c)\)", "", text.lower())
    return re.sub(r"[^a-z0-9]+", "-", text).strip("-")


# --- tables -------------------------------------------------------------------------------------------------------------

Columns = Sequence[tuple[str, str | Callable[..., str]]]


def table(rows: Iterable, columns: Columns, notes: Iterable[str] = ()) -> str:
    """A Markdown table, as of `taisoft.output.tables`, with the notes as bullets below."""
    text = tables.table(rows, columns)
    bullets = "".join(f"\n* {note}" for note in notes)
    return f"{text}\n{bullets}" if bullets else text


def rows_table(rows: Iterable[dict]) -> str:
    """Tables of rows whose keys are the titles, a new table where these change; texts are on the left."""

    def cell(title: str, row: dict) -> str:
        value = row[title]
        whole = isinstance(value, int) or (isinstance(value, float) and 1e3 <= abs(value) < 1e7)
        return value if isinstance(value, str) else f"{value:,.0f}" if whole else f"{value:.3g}"

    tables_of = (list(alike) for _, alike in groupby(rows, tuple))
    return "\n\n".join(
        table(alike, [("<" * isinstance(value, str) + title, partial(cell, title)) for title, value in alike[0].items()])
        for alike in tables_of
    )


def ms(seconds: float) -> str:
    """Milliseconds with three digits."""
    return f"{1e3 * seconds:.3g}"


def timed_cells(seconds: Iterable[float]) -> tuple[str, str]:
    """Median [ms] and spread of times."""
    t = summarise(seconds)
    return ms(t.median), percent(spread_of(t))


def ranged(values: Sequence[float]) -> str:
    """Median, minimum and maximum."""
    return f"{np.median(values):g} ({min(values):g} to {max(values):g})" if len(values) else "-"


def exponent(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """p of y ~ x^p by least squares in the logarithms, and the largest relative residual.

    nan for fewer than two x or if some y is 0.
    """
    if len(set(x)) < 2 or min(y) <= 0.0:
        return math.nan, math.nan
    a, b = np.log(np.asarray(x, float)), np.log(np.asarray(y, float))
    p, c = np.polyfit(a, b, 1)
    return float(p), float(np.expm1(np.abs(b - (p * a + c)).max()))


def crossovers(at: Sequence[float], a: Sequence[float], b: Sequence[float]) -> list[float]:
    """Where the curves a and b cross, interpolated linearly in the logarithms."""
    found, ratio = [], np.log(np.asarray(a) / np.asarray(b))
    for k in range(len(at) - 1):
        if ratio[k] * ratio[k + 1] < 0:
            t = ratio[k] / (ratio[k] - ratio[k + 1])
            found.append(math.exp((1 - t) * math.log(at[k]) + t * math.log(at[k + 1])))
    return found


# --- limits -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limit:
    """A number and its limit. spread: relative spread of the number, None if it does not vary. at_least: a lower limit."""

    what: str
    value: float
    limit: float
    spread: float | None = None
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether the limit is met; nan never meets it."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit

    @property
    def close(self) -> bool:
        """Whether the distance to the limit is within the spread, so that another run may differ."""
        return self.spread is not None and abs(self.value - self.limit) <= self.spread * abs(self.value)

    def record(self) -> dict:
        """The limit as plain data."""
        return asdict(self) | {"met": self.met, "close": self.close}

    def row(self) -> tuple[str, ...]:
        """Cells of limit_table."""
        verdict = ("met" if self.met else "NOT met") + (", within the spread" if self.close else "")
        return (
            self.what,
            f"{self.value:.4g}",
            percent(self.spread),
            f"{'>=' if self.at_least else '<='} {self.limit:.4g}",
            verdict,
        )


def timed_limit(what: str, t: Timing | None, limit: float, scale: float = 1.0, at_least: bool = False) -> Limit:
    """A limit on the median of a time, multiplied by `scale`; not met without a time."""
    return Limit(what, scale * t.median if t else math.nan, limit, spread_of(t) if t else None, at_least)


def limit_table(limits: Iterable[Limit]) -> str:
    """A row per limit."""
    return markdown(("limit", "measured", "spread", "required", "verdict"), [x.row() for x in limits], left=(0, 3, 4))


# --- an earlier run -----------------------------------------------------------------------------------------------------


def earlier_numbers(path: Path | None) -> dict | None:
    """The numbers that an earlier run wrote, None if they cannot be read."""
    try:
        return None if path is None else json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def newest(results: Path, benchmark: str, arch: str = "") -> dict:
    """The newest results of a full run of a benchmark, on an arch if one is given. Raises OutputError without any."""
    found = []
    for path in sorted(results.glob(f"{benchmark}-*.json")):
        try:
            found.append(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise OutputError(f"{path} cannot be read: {error}") from error
    found = [numbers for numbers in found if not numbers.get("quick") and arch in ("", numbers.get("arch"))]
    if not found:
        raise OutputError(f"{results} holds no results of `taisoft bench {benchmark}`")
    return max(found, key=lambda numbers: numbers["date"])
