"""Tables of runs, studies and benchmarks: Markdown that is readable on a terminal, and CSV; plots as PNG files by matplotlib."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from taisoft.files import write_bytes
from taisoft.machine import Timing, require


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[int] = ()) -> str:
    """Return a Markdown table with aligned columns: left-aligned those in `left`, right-aligned the others."""
    lines = [tuple(headings), *map(tuple, rows)]
    widths = [max(2, *(len(line[k]) for line in lines)) for k in range(len(headings))]

    def line(cells) -> str:
        filled = (f"{c:<{w}}" if k in left else f"{c:>{w}}" for k, (c, w) in enumerate(zip(cells, widths)))
        return f"| {' | '.join(filled)} |"

    rule = "|".join(f" {'-' * w} " if k in left else f" {'-' * (w - 1)}: " for k, w in enumerate(widths))
    return "\n".join([line(lines[0]), f"|{rule}|", *map(line, lines[1:])])


def table(rows: Iterable, columns: Sequence[tuple[str, str | Callable[..., str]]]) -> str:
    """Return a Markdown table of rows.

    columns: (heading, cell); a heading that starts with "<" is left-aligned, a cell is a format string or a function of the row.
    """
    lines = [[cell.format(row) if isinstance(cell, str) else cell(row) for _, cell in columns] for row in rows]
    left = [k for k, (heading, _) in enumerate(columns) if heading.startswith("<")]
    return markdown([heading.removeprefix("<") for heading, _ in columns], lines, left)


def csv_text(rows: Iterable[Iterable]) -> str:
    """Return rows as CSV text (RFC 4180)."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue()


def read_table(path: Path, is_kept: Callable[[list[str]], bool]) -> tuple[list[str], list[list[str]]]:
    """Return the header of an earlier run's CSV file and the rows that are kept; nothing if there is no such file."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        return header, [row for row in rows if is_kept(row)]
    except (OSError, ValueError, IndexError, csv.Error):
        return [], []


def percent(fraction: float | None) -> str:
    """Format a fraction in percent; empty for None."""
    return "" if fraction is None else f"{fraction:.1%}"


def spread_of(timing: Timing) -> float | None:
    """Return a timing's spread; None for a single repeat, which has none."""
    return timing.spread if timing.repeats > 1 else None


def require_matplotlib(what: str = "--plot"):
    """Return the matplotlib module. what: the feature that needs it. Raises OutputError if it is missing."""
    matplotlib = require("matplotlib", what, "plot")
    matplotlib.use("Agg")
    return matplotlib


def save(figure, path: Path, dpi: int = 130) -> None:
    """Write a figure as PNG and close it. Raises OutputError."""
    from matplotlib import pyplot

    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=dpi)
    pyplot.close(figure)
    write_bytes(path, picture.getvalue())


def ticks(axis, ratio: float) -> None:
    """Label a logarithmic axis with plain numbers at powers of ten, and between them if the axis spans few decades.

    ratio: upper over lower limit of the axis.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0,) if ratio > 300.0 else (1.0, 3.0) if ratio > 30.0 else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
