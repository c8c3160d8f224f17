"""Tables that are readable both on a terminal and as Markdown."""

from collections.abc import Iterable, Sequence

from taisoft.timing import Timing


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[int] = ()) -> str:
    """Return a Markdown table with aligned columns: left-aligned those in `left`, right-aligned the others."""
    lines = [tuple(headings), *map(tuple, rows)]
    widths = [max(2, *(len(line[k]) for line in lines)) for k in range(len(headings))]

    def line(cells) -> str:
        filled = (f"{c:<{w}}" if k in left else f"{c:>{w}}" for k, (c, w) in enumerate(zip(cells, widths)))
        return f"| {' | '.join(filled)} |"

    rule = "|".join(f" {'-' * w} " if k in left else f" {'-' * (w - 1)}: " for k, w in enumerate(widths))
    return "\n".join([line(lines[0]), f"|{rule}|", *map(line, lines[1:])])


def percent(fraction: float | None) -> str:
    """Format a fraction in percent; empty for None."""
    return "" if fraction is None else f"{fraction:.1%}"


def spread_of(timing: Timing) -> float | None:
    """Return a timing's spread; None for a single repeat, which has none."""
    return timing.spread if timing.repeats > 1 else None
