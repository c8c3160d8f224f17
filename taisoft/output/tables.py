"""Tables that read alike on a terminal and in Markdown."""

from collections.abc import Iterable, Sequence

from taisoft.timing import Timing


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[int] = ()) -> str:
    """A Markdown table with its columns lined up; columns are flush right but those in `left`."""
    lines = [tuple(headings), *map(tuple, rows)]
    widths = [max(2, *(len(line[k]) for line in lines)) for k in range(len(headings))]

    def line(cells) -> str:
        filled = (f"{c:<{w}}" if k in left else f"{c:>{w}}" for k, (c, w) in enumerate(zip(cells, widths)))
        return f"| {' | '.join(filled)} |"

    rule = "|".join(f" {'-' * w} " if k in left else f" {'-' * (w - 1)}: " for k, w in enumerate(widths))
    return "\n".join([line(lines[0]), f"|{rule}|", *map(line, lines[1:])])


def percent(share: float | None) -> str:
    """A share in percent; empty for None."""
    return "" if share is None else f"{share:.1%}"


def spread_of(timing: Timing) -> float | None:
    """The timing's spread, None where a single repeat has none."""
    return timing.spread if timing.repeats > 1 else None
