"""Launches: what a kernel call costs the host by the number of its arrays, and small steps, which consist of such calls.

taisoft bench launches [--arch cuda] [--quick] [--out FILE.json]

A launch hands over one number, one integer and 1 to 200 arrays. Steps: a resting cube of 384 tets and one of 3,072 in implicit
steps with contacts, one of 10,368 in implicit steps without, one of 384 in explicit steps of one sub-step each. A new process
a round, with warm kernels; medians over rounds, with their range. Exit status: 0, or 1 if a limit is not met or a process failed.
"""

import json
import sys
from pathlib import Path

import numpy as np

from taisoft.output.tables import markdown

from .document import Limit, begin
from .runner import make_parser, parse_options, progress, run_python

CHILD = Path(__file__).with_name("launches_child.py")
ROUNDS = 5
LAUNCH = 1.5  # largest time of a launch [us]


def measure(arch: str, quick: bool) -> list[dict]:
    """The results of each round."""
    found = []
    for k in range(1 if quick else ROUNDS):
        progress(f"round {k + 1}")
        found.append(json.loads(run_python("launches", CHILD, arch, *(("quick",) if quick else ()))[-1]))
    return found


def table(rounds: list[dict], part: str, label: str, digits: int) -> str:
    """Median times and their ranges over the rounds, of launches or steps."""
    rows = []
    for name in rounds[0][part]:
        times = [one[part][name] for one in rounds]
        middle, low, high = (f"{value:,.{digits}f}" for value in (np.median(times), min(times), max(times)))
        rows.append((name, f"{middle} ({low} to {high})"))
    return markdown((label, "us"), rows, left=(0,))


def find_limits(rounds: list[dict]) -> list[Limit]:
    """Limits on launches."""
    numbers = rounds[0]["launches"]
    return [
        Limit(f"launch with {n} arrays [us]", float(np.median([one["launches"][n] for one in rounds])), LAUNCH) for n in numbers
    ]


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError if a process fails, OutputError if a file cannot be written."""
    parser = make_parser("launches", __doc__)
    parser.add_argument("--quick", action="store_true", help="one round, small scenes, no limit")
    options = parse_options(parser, argv)
    document, numbers = begin("Launches", f"arch {options.arch}")
    rounds = measure(options.arch, options.quick)
    document.add("## A launch\n\n" + table(rounds, "launches", "arrays", 2))
    document.add("## A step\n\n" + table(rounds, "steps", "scene", 0))
    return document.finish(options, numbers | {"rounds": rounds}, [] if options.quick else find_limits(rounds))


if __name__ == "__main__":
    sys.exit(main())
