"""Scaling: time, memory and bytes per second of each kind of step from 1,000 to 200,000 tets.

taisoft bench scaling [--quick] [--sizes LIST] [--kind NAME] [--arch cpu|cuda] [--out FILE.json] [--plot FILE.png]

Explicit and implicit steps of a beam, searches for contacts in a pile of cubes, explicit and implicit steps of two cubes in
contact; on CUDA also with a million tets. Each kind and size is measured in a process of its own, whose peak of memory is
then that work's alone. A time is the median over samples, without compiling; spread is the distance between the quartiles over
the median. Exponents: of time, set-up and memory over the tets, fitted in the logarithms; 1 is in proportion. Searches and sweeps
over contacts grow with the surface, with the power 2/3 of the tets. Bytes moved are a floor: each array that a loop over the
mesh uses counts once where it is read and once where it is written (benchmarks/scaling_bytes.py); they stand against the
best copy of 256 MB on as many threads, measured first. Exit status: 0, or 1 where something could not be measured.
The whole took ten minutes on two cores that others used, too.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import taisoft
from taisoft.errors import SimulationError
from taisoft.timing import load_average

from .again import again_text, earlier_numbers, plain
from .document import Document, header
from .order import parse_options
from .scaling_bytes import Copy, measure_copy
from .scaling_plot import draw
from .scaling_runs import EXPLICIT, KINDS, ON_ONE, PRECISION, Row, measure
from .scaling_table import copy_table, growth_table, growths, memory_table, phase_table, rate_table, time_table

SIZES, QUICK_SIZES, CUDA_SIZE = (1_000, 4_000, 16_000, 64_000, 200_000), (500, 2_000), 1_000_000
COPY = "copy"
RESULT = "result: "  # before what a child found, among what Taichi prints


def answer(job: str, arch: str) -> None:
    """A child's part: measure "copy", or "kind:size", and print what was found."""
    kind, _, size = job.rpartition(":")
    found = [asdict(copy) for copy in measure_copy(arch)] if job == COPY else measure(kind, int(size), arch).record()
    print(RESULT + json.dumps(found), flush=True)


def ask(job: str, arch: str) -> list | dict | str:
    """What a child finds, or a sentence about why it found nothing."""
    print(job, file=sys.stderr, flush=True)
    path = os.pathsep.join([str(Path(taisoft.__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "taisoft", "bench", "scaling", "--child", job, "--arch", arch]
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}, check=False
    )
    found = [line for line in done.stdout.splitlines() if line.startswith(RESULT)]
    if done.returncode == 0 and found:
        return json.loads(found[-1].removeprefix(RESULT))
    return (done.stderr.strip().splitlines() or [f"its process ended with status {done.returncode}"])[-1]


def measure_all(kinds: list[str], sizes: list[int], arch: str) -> Iterator[Row]:
    """A row for each kind and size; one that failed says why. ON_ONE: only where the same work took several threads."""
    several: set[int] = set()
    for kind in kinds:
        for size in sizes if kind != ON_ONE else sorted(several):
            found = ask(f"{kind}:{size}", arch)
            row = Row(kind, arch, tets=size, failure=found) if isinstance(found, str) else Row(**found)
            if kind == EXPLICIT and row.threads > 1 and arch == "cpu":
                several.add(size)
            yield row


def report(rows: list[Row], copies: list[Copy], document: Document) -> dict:
    """The tables, printed, and the numbers."""
    found = growths(rows)
    document.add("## Phases\n\n" + phase_table(rows))
    document.add("## Memory\n\n" + memory_table(rows))
    document.add("## Bytes moved\n\n" + copy_table(copies) + "\n\n" + rate_table(rows, copies))
    document.add("## Exponents over the tets\n\n" + growth_table(found))
    return {
        "rows": [row.record() for row in rows],
        "copies": [asdict(copy) for copy in copies],
        "exponents": [growth.record() for growth in found],
    }


def size_list(text: str) -> list[int]:
    """Numbers of tets from a comma list."""
    try:
        sizes = sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a comma list of numbers of tets") from None
    if sizes[0] < 1:
        raise argparse.ArgumentTypeError("there must be at least one tet")
    return sizes


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch cannot be had."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench scaling", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--quick", action="store_true", help="two small meshes of each kind")
    parser.add_argument("--sizes", type=size_list, metavar="LIST", help="numbers of tets; the nearest meshes are taken")
    parser.add_argument("--kind", choices=KINDS, metavar="NAME", help=f"only this one of {', '.join(KINDS)}")
    parser.add_argument("--child", metavar="JOB", help=argparse.SUPPRESS)
    options = parse_options(parser, argv, "time, bytes per second and memory over the tets")
    if options.child:
        answer(options.child, options.arch)
        return 0
    sizes = options.sizes or list(QUICK_SIZES if options.quick else (*SIZES, *((CUDA_SIZE,) if options.arch == "cuda" else ())))
    document, (text, numbers) = Document(), header("Scaling", options.arch, PRECISION)
    document.add(text)
    copies = ask(COPY, options.arch)
    if isinstance(copies, str):
        raise SimulationError(copies)
    copies = [Copy(**copy) for copy in copies]
    rows = list(measure_all([options.kind] if options.kind else list(KINDS), sizes, options.arch))
    document.add("## Time\n\n" + time_table(rows))
    numbers |= {"arch": options.arch, "precision": PRECISION, "quick": options.quick} | report(rows, copies, document)
    times = {f"{row.kind}, {row.tets:,} tets": row.timing for row in rows if row.samples}
    document.add(again_text(earlier_numbers(options.out), times, numbers))
    numbers |= {"load_at_the_end": load_average(), "times": plain(times)}
    if options.out:
        document.write(options.out, numbers)
    if options.plot:
        draw(rows, copies, options.plot)
        print(f"written: {options.plot}")
    return 1 if any(row.failure for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
