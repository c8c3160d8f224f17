"""Scaling: time, memory and bytes per second of each kind of step from 1,000 to a million tets.

taisoft bench scaling [--quick] [--sizes LIST] [--kind NAME] [--arch cpu|cuda] [--out FILE.json] [--plot FILE.png]

Explicit and implicit steps of a beam, searches for contacts in a pile of cubes, explicit and implicit steps of two cubes in
contact; those of the beam with a million tets, too. Where several threads are used, the same on one. Each kind and size runs in
its own process, which makes its peak memory measurable. A time is the median over samples without compilation; spread is the
interquartile range over the median. Exponents of time, set-up and memory over the tets are fitted in the logarithms; 1 is
proportional, searches and sweeps over contacts grow with the surface, the power 2/3 of the tets. Bytes moved are a lower bound:
each array that a loop uses counts once if read and once if written (benchmarks/scaling_bytes.py). They are compared with the
best copy of 256 MB on as many threads. Exit status: 0, or 1 if something could not be measured. A full run takes about fifteen
minutes on two cores.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from taisoft.errors import OutputError, SimulationError
from taisoft.output.tables import percent, spread_of

from .charts import Panel, write_plot
from .children import in_child
from .document import begin, exponent, table
from .runner import make_parser, parse_options, progress
from .scaling_bytes import GROUPS, Copy, copy_rate, measure_copy
from .scaling_runs import KINDS, ON_ONE, PRECISION, Row, measure

SIZES, QUICK_SIZES, LARGEST = (1_000, 4_000, 16_000, 64_000, 276_000), (500, 2_000), 1_000_000
LARGEST_OF = ("explicit", "implicit", "stiff implicit")  # kinds measured with it


# --- measured -----------------------------------------------------------------------------------------------------------


def measure_all(kinds: list[str], sizes: list[int], arch: str, chosen: bool = True) -> Iterator[Row]:
    """A row per kind and size, also for failures; on one thread only where several were used before.

    chosen: whether the user named the sizes; else only some kinds are measured with LARGEST.
    """
    several: dict[str, list[int]] = {}
    for kind in kinds:
        one = kind.endswith(ON_ONE)
        for size in several.get(kind.removesuffix(ON_ONE), []) if one else sizes:
            if size == LARGEST and not chosen and kind.removesuffix(ON_ONE) not in LARGEST_OF:
                continue
            progress(f"{kind}, {size:,} tets")
            try:
                row = Row(**in_child(f"{kind}:{size}", measure, kind, size, arch))
            except SimulationError as error:
                row = Row(kind, arch, tets=size, failure=str(error))
            if row.threads > 1 and arch == "cpu":
                several.setdefault(kind, []).append(size)
            yield row


def gain_table(rows: Sequence[Row]) -> str:
    """Speed of all threads over one; empty if no work was measured on both."""
    on_one = {(row.kind, row.tets): row for row in measured(rows)}
    both = [(row, on_one[place]) for row in measured(rows) if (place := (row.kind + ON_ONE, row.tets)) in on_one]
    columns = (
        ("<work", "{[0].kind}"),
        ("tets", "{[0].tets:,}"),
        ("threads", "{[0].threads}"),
        ("ms", lambda pair: f"{1e3 * pair[0].timing.median:.4g}"),
        ("on one [ms]", lambda pair: f"{1e3 * pair[1].timing.median:.4g}"),
        ("gain", lambda pair: f"{pair[1].timing.median / pair[0].timing.median:.2f}"),
    )
    return table(both, columns)


# --- tables -------------------------------------------------------------------------------------------------------------


def measured(rows: Sequence[Row]) -> list[Row]:
    """The rows with times."""
    return [row for row in rows if row.samples]


def growths(rows: Sequence[Row]) -> list[dict]:
    """Per kind of work: exponents over the tets of the time of a step, of setting up and of the bytes of the fields."""
    found = []
    for kind in dict.fromkeys(row.kind for row in measured(rows)):
        own = sorted((row for row in measured(rows) if row.kind == kind), key=lambda row: row.tets)
        numbers = {
            "step": [row.timing.median for row in own],
            "setup": [row.setup_seconds for row in own],
            "memory": [sum(row.field_bytes.values()) for row in own],
        }
        exponents = {name: exponent([row.tets for row in own], values)[0] for name, values in numbers.items()}
        found.append({"kind": kind, "meshes": len(own)} | exponents)
    return found


WORK = (("<work", "{.kind}"), ("tets", "{.tets:,}"))


def time_table(rows: Sequence[Row]) -> str:
    """Times of steps and searches; failures below."""
    columns = (
        *WORK,
        ("threads", "{.threads}"),
        ("ms", lambda row: f"{1e3 * row.timing.median:.4g}"),
        ("spread", lambda row: percent(spread_of(row.timing))),
        ("ns/tet", lambda row: f"{1e9 * row.timing.median / row.tets:.4g}"),
        ("<average counts", lambda row: ", ".join(f"{value:,.4g} {name}" for name, value in row.counts.items() if value)),
        ("set up [s]", "{.setup_seconds:.2f}"),
        ("compile [s]", "{.compile_seconds:.1f}"),
    )
    return table(measured(rows), columns, [f"{row.kind}, {row.tets:,} tets: {row.failure}" for row in rows if row.failure])


def phase_table(rows: Sequence[Row]) -> str:
    """Fraction of time by kind, without those below 0.5 %."""

    def fractions(row: Row) -> str:
        parts = {kind: seconds / sum(row.phases.values()) for kind, seconds in row.phases.items()}
        return ", ".join(f"{kind} {part:.0%}" for kind, part in parts.items() if part >= 0.005)

    return table(measured(rows), (*WORK, ("<fraction of each kind", fractions)))


def call_table(rows: Sequence[Row]) -> str:
    """Launches, what they are handed, and accesses by the host, of a step or a search."""
    names = {name: None for row in measured(rows) for name in row.calls}
    return table(measured(rows), (*WORK, *((name, f"{{.calls[{name}]:,.4g}}") for name in names)))


def memory_table(rows: Sequence[Row]) -> str:
    """Bytes of the fields per tet by group, and the peak memory of the process."""

    def group(name: str):
        return lambda row: f"{row.field_bytes[name] / row.tets:,.0f}" if row.field_bytes.get(name) else ""

    columns = (
        *WORK,
        *((name, group(name)) for name in GROUPS),
        ("fields [B/tet]", lambda row: f"{sum(row.field_bytes.values()) / row.tets:,.0f}"),
        ("peak [MB]", lambda row: "-" if row.peak is None else f"{row.peak / 1e6:,.0f}"),
        ("above the start [B/tet]", lambda row: "-" if row.peak is None else f"{(row.peak - row.base) / row.tets:,.0f}"),
    )
    return table(measured(rows), columns)


def rate_table(rows: Sequence[Row], copies: Sequence[Copy]) -> str:
    """Lower bound of the bytes moved per second, compared with a copy on as many threads."""

    def rate(row: Row) -> float:
        return row.moved / row.timing.median

    columns = (
        *WORK,
        ("moved [MB]", lambda row: f"{row.moved / 1e6:,.3g}"),
        ("B/tet", lambda row: f"{row.moved / row.tets:,.4g}"),
        ("GB/s", lambda row: f"{rate(row) / 1e9:.3g}"),
        ("copy [GB/s]", lambda row: f"{copy_rate(copies, row.threads) / 1e9:.3g}"),
        ("of the copy", lambda row: f"{rate(row) / copy_rate(copies, row.threads):.0%}"),
    )
    return table(measured(rows), columns)


def copy_table(copies: Sequence[Copy]) -> str:
    """A row per copy."""
    return table(copies, (("<copy by", "{.by}"), ("threads", "{.threads}"), ("GB/s", lambda c: f"{c.rate / 1e9:.3g}")))


def growth_table(found: Sequence[dict]) -> str:
    """A row per kind of work."""
    columns = [("<work", "{[kind]}"), ("meshes", "{[meshes]}")]
    for heading, name in (("time", "step"), ("set up", "setup"), ("fields", "memory")):
        columns.append((heading, lambda g, name=name: "-" if math.isnan(g[name]) else f"{g[name]:.2f}"))
    return table(found, columns)


# --- the picture --------------------------------------------------------------------------------------------------------


def draw(rows: Sequence[Row], copies: Sequence[Copy], path: Path) -> None:
    """Write a PNG. Raises OutputError."""
    rows = sorted(measured(rows), key=lambda row: row.tets)
    if not rows:
        raise OutputError(f"{path}: there is nothing to draw, since nothing could be measured")
    panels: dict[str, Callable[[Row], float]] = {
        "time of a step or a search [ns/tet]": lambda row: 1e9 * row.timing.median / row.tets,
        "moved at least [GB/s]": lambda row: 1e-9 * row.moved / row.timing.median,
        "fields [B/tet]": lambda row: sum(row.field_bytes.values()) / row.tets,
    }
    drawn = [Panel(title, "tets", log="xy") for title in panels]
    for panel, value in zip(drawn, panels.values()):
        for k, kind in enumerate(kind for kind in KINDS if not kind.endswith(ON_ONE)):
            if own := [row for row in rows if row.kind == kind]:
                panel.curve([row.tets for row in own], [value(row) for row in own], kind, k)
    for n in sorted({copy.threads for copy in copies}):
        drawn[1].level("y", 1e-9 * copy_rate(copies, n), f"a copy, {n} thread{'s' * (n > 1)}", ls="--" if n == 1 else ":")
    write_plot(path, drawn)


# --- the whole ----------------------------------------------------------------------------------------------------------


def size_list(text: str) -> list[int]:
    """Numbers of tets from a comma-separated list."""
    try:
        sizes = sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a comma-separated list of numbers of tets") from None
    if sizes[0] < 1:
        raise argparse.ArgumentTypeError("there must be at least one tet")
    return sizes


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("scaling", __doc__)
    parser.add_argument("--quick", action="store_true", help="two small meshes of each kind")
    parser.add_argument("--sizes", type=size_list, metavar="LIST", help="numbers of tets; the nearest meshes are taken")
    parser.add_argument("--kind", choices=KINDS, metavar="NAME", help=f"only this one of {', '.join(KINDS)}")
    options = parse_options(parser, argv, "time, bytes per second and memory over the tets")
    sizes = options.sizes or list(QUICK_SIZES if options.quick else (*SIZES, LARGEST))
    document, numbers = begin("Scaling", options.arch, PRECISION)
    copies = [Copy(**copy) for copy in in_child("copies of memory", measure_copy, options.arch)]
    kinds = [kind for kind in KINDS if options.kind in (None, kind, kind.removesuffix(ON_ONE))]
    rows = list(measure_all(kinds, sizes, options.arch, options.sizes is not None))
    found = growths(rows)
    document.add("## Time\n\n" + time_table(rows))
    document.add("## Threads\n\n" + gain_table(rows))
    document.add("## Phases\n\n" + phase_table(rows))
    document.add("## Launches and accesses by the host\n\n" + call_table(rows))
    document.add("## Memory\n\n" + memory_table(rows))
    document.add("## Bytes moved\n\n" + copy_table(copies) + "\n\n" + rate_table(rows, copies))
    document.add("## Exponents over the tets\n\n" + growth_table(found))
    numbers |= {"arch": options.arch, "precision": PRECISION, "quick": options.quick}
    times = {f"{row.kind}, {row.tets:,} tets": row.timing for row in measured(rows)}
    numbers |= {"rows": rows, "copies": copies, "exponents": found, "times": times}
    document.finish(options, numbers, (), lambda path: draw(rows, copies, path))
    return 1 if any(row.failure for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
