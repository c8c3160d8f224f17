"""Tables of `scaling.py`, a row a kind of work and mesh, and how time and memory grow with the tets."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from taisoft.output.tables import markdown, percent, spread_of

from .fit import exponent
from .scaling_bytes import GROUPS, Copy, copy_rate
from .scaling_runs import Row


@dataclass(frozen=True)
class Growth:
    """Exponents over the tets: of the time of a step by a fit through all meshes and between the last two, of what it takes to
    set up, of the fields' bytes; nan where there are fewer than two meshes."""

    kind: str
    meshes: int
    step: float
    step_at_last: float
    setup: float
    memory: float

    def record(self) -> dict:
        """As plain data."""
        return dict(vars(self))


def measured(rows: Sequence[Row]) -> list[Row]:
    """The rows that have times."""
    return [row for row in rows if row.samples]


def growths(rows: Sequence[Row]) -> list[Growth]:
    """One of each kind of work, in the order of the rows."""
    found = []
    for kind in dict.fromkeys(row.kind for row in measured(rows)):
        own = sorted((row for row in measured(rows) if row.kind == kind), key=lambda row: row.tets)
        tets, step = [row.tets for row in own], [row.timing.median for row in own]
        found.append(
            Growth(
                kind,
                len(own),
                exponent(tets, step)[0],
                exponent(tets[-2:], step[-2:])[0],
                exponent(tets, [r.setup_seconds for r in own])[0],
                exponent(tets, [sum(r.field_bytes.values()) for r in own])[0],
            )
        )
    return found


def time_table(rows: Sequence[Row]) -> str:
    """Time of a step or a search; what failed is told below."""
    lines = []
    for row in measured(rows):
        t = row.timing
        counts = ", ".join(f"{value:,.4g} {name}" for name, value in row.counts.items() if value)
        lines.append(
            (
                row.kind,
                f"{row.tets:,}",
                str(row.threads),
                f"{1e3 * t.median:.4g}",
                percent(spread_of(t)),
                f"{1e9 * t.median / row.tets:.4g}",
                counts,
                f"{row.setup_seconds:.2f}",
                f"{row.compile_seconds:.1f}",
            )
        )
    headings = ("work", "tets", "threads", "ms", "spread", "ns/tet", "of each, on average", "set up [s]", "compile [s]")
    notes = [f"* {row.kind}, {row.tets:,} tets: {row.failure}" for row in rows if row.failure]
    return markdown(headings, lines, left=(0, 6)) + ("\n\n" + "\n".join(notes) if notes else "")


def phase_table(rows: Sequence[Row]) -> str:
    """Share of each phase."""
    lines = []
    for row in measured(rows):
        whole = sum(row.phases.values())
        shares = ", ".join(f"{name} {seconds / whole:.0%}" for name, seconds in row.phases.items())
        lines.append((row.kind, f"{row.tets:,}", shares))
    return markdown(("work", "tets", "share of each phase"), lines, left=(0, 2))


def memory_table(rows: Sequence[Row]) -> str:
    """Bytes of the fields per tet by group, and the most that the process held."""
    lines = []
    for row in measured(rows):
        groups = [row.field_bytes.get(name, 0) / row.tets for name in GROUPS]
        peak = "-" if row.peak is None else f"{row.peak / 1e6:,.0f}"
        above = "-" if row.peak is None else f"{(row.peak - row.base) / row.tets:,.0f}"
        cells = [f"{value:,.0f}" if value else "" for value in groups]
        lines.append((row.kind, f"{row.tets:,}", *cells, f"{sum(groups):,.0f}", peak, above))
    headings = ("work", "tets", *GROUPS, "fields [B/tet]", "peak [MB]", "above the start [B/tet]")
    return markdown(headings, lines, left=(0,))


def rate_table(rows: Sequence[Row], copies: Sequence[Copy]) -> str:
    """Bytes that a step moves at least, per second, against a copy on as many threads."""
    lines = []
    for row in measured(rows):
        rate, copy = row.moved / row.timing.median, copy_rate(copies, row.threads)
        lines.append(
            (
                row.kind,
                f"{row.tets:,}",
                f"{row.moved / 1e6:,.3g}",
                f"{row.moved / row.tets:,.4g}",
                f"{rate / 1e9:.3g}",
                f"{copy / 1e9:.3g}",
                f"{rate / copy:.0%}",
            )
        )
    headings = ("work", "tets", "moved [MB]", "B/tet", "GB/s", "copy [GB/s]", "of the copy")
    return markdown(headings, lines, left=(0,))


def copy_table(copies: Sequence[Copy]) -> str:
    """A row a copy."""
    return markdown(("copy by", "threads", "GB/s"), [(c.by, str(c.threads), f"{c.rate / 1e9:.3g}") for c in copies], left=(0,))


def growth_table(found: Sequence[Growth]) -> str:
    """A row a kind of work."""

    def told(x: float) -> str:
        return "-" if math.isnan(x) else f"{x:.2f}"

    lines = [(g.kind, str(g.meshes), *map(told, (g.step, g.step_at_last, g.setup, g.memory))) for g in found]
    return markdown(("work", "meshes", "time", "of it, last two", "set up", "fields"), lines, left=(0,))
