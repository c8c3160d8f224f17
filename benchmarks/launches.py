"""Launches: what a kernel call costs the host by the number of its arrays, and small steps, which consist of such calls.

taisoft bench launches [--arch cuda] [--quick] [--baseline FOLDER] [--out FILE.json]

A launch hands over one number, one integer and 1 to 200 arrays. Steps: a resting cube of 384 tets and one of 3,072 in implicit
steps with contacts, one of 10,368 in implicit steps without, one of 384 in explicit steps of one sub-step each. A new process
a round, with warm kernels; medians over rounds, with their range. --baseline: folder of another version, measured in turn; the
limits compare with it, and its states must have the same bits. Exit status: 0, or 1 if a limit is not met or a process failed.
"""

import json
import sys
from pathlib import Path

import numpy as np

from taisoft.output.tables import markdown

from .document import Limit, begin
from .runner import make_parser, parse_options, progress, versions_beside

CHILD = Path(__file__).with_name("launches_child.py")
ROUNDS = 5
LAUNCH = 1.5  # largest time of a launch [us]
RATIOS = {"resting, 384 tets": 0.45, "contact, 3,072 tets": 0.65, "free, 10,368 tets": 0.8}  # largest time over the baseline's


def measure(baseline: Path | None, arch: str, quick: bool) -> dict[str, list[dict]]:
    """The results of each version by round, the versions in turn."""
    versions = versions_beside(baseline)
    found: dict[str, list[dict]] = {name: [] for name in versions}
    for k in range(1 if quick else ROUNDS):
        for name, version in versions.items():
            progress(f"round {k + 1}: {name} version")
            found[name].append(json.loads(version.run(CHILD, arch, *(("quick",) if quick else ()))[-1]))
    return found


def times(rounds: list[dict], part: str, name: str) -> np.ndarray:
    """Microseconds of a launch or a step by round."""
    return np.array([one[part][name] for one in rounds])


def ratios(found: dict[str, list[dict]], part: str, name: str) -> np.ndarray:
    """This version's time over the baseline's by round."""
    return times(found["this"], part, name) / times(found["older"], part, name)


def text_of(values: np.ndarray, digits: int) -> str:
    """Median and range."""
    middle, low, high = (f"{value:,.{digits}f}" for value in (np.median(values), values.min(), values.max()))
    return f"{middle} ({low} to {high})"


def table(found: dict[str, list[dict]], part: str, label: str) -> str:
    """Times of each version, and their ratio."""
    rows = []
    for name in found["this"][0][part]:
        row = [name, *(text_of(times(rounds, part, name), 2 if part == "launches" else 0) for rounds in found.values())]
        rows.append((*row, text_of(ratios(found, part, name), 2)) if "older" in found else tuple(row))
    return markdown((label, *(f"{name} [us]" for name in found), *(("this/older",) if "older" in found else ())), rows, left=(0,))


def find_limits(found: dict[str, list[dict]]) -> list[Limit]:
    """Limits on launches, and on steps relative to the baseline's."""
    limits = [
        Limit(f"launch with {n} arrays [us]", float(np.median(times(found["this"], "launches", n))), LAUNCH)
        for n in found["this"][0]["launches"]
    ]
    if "older" in found:
        limits += [
            Limit(f"step, {name}, over the baseline's", float(np.median(ratios(found, "steps", name))), limit)
            for name, limit in RATIOS.items()
        ]
        different = sum(one["digests"] != found["older"][0]["digests"] for rounds in found.values() for one in rounds)
        limits.append(Limit("rounds with other bits than the baseline's first", different, 0))
    return limits


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError if a process fails, OutputError if a file cannot be written."""
    parser = make_parser("launches", __doc__)
    parser.add_argument("--quick", action="store_true", help="one round, small scenes, no limit")
    parser.add_argument("--baseline", type=Path, metavar="FOLDER", help="another version of taisoft to compare with")
    options = parse_options(parser, argv)
    document, numbers = begin("Launches", f"arch {options.arch}")
    found = measure(options.baseline, options.arch, options.quick)
    document.add("## A launch\n\n" + table(found, "launches", "arrays"))
    document.add("## A step\n\n" + table(found, "steps", "scene"))
    return document.finish(options, numbers | {"rounds": found}, [] if options.quick else find_limits(found))


if __name__ == "__main__":
    sys.exit(main())
