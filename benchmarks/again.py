"""A second run beside the first: which times have come again within the spreads of both."""

import json
from dataclasses import asdict
from pathlib import Path

from taisoft.output.tables import markdown, percent
from taisoft.timing import Timing

SAME = ("processor", "cores", "arch", "quick")  # what two runs must share to be compared


def earlier_numbers(path: Path | None) -> dict | None:
    """What an earlier run wrote there, None where there is nothing that can be read."""
    try:
        return None if path is None else json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def agrees(one: dict, two: dict) -> bool:
    """Whether two timings, as plain data, lie no farther apart than their spreads together."""
    apart = abs(one["median"] - two["median"])
    return apart <= one["spread"] * one["median"] + two["spread"] * two["median"]


def plain(times: dict[str, Timing]) -> dict[str, dict]:
    """As plain data, for the key "times" of what a run writes."""
    return {name: asdict(t) for name, t in times.items()}


def again_text(earlier: dict | None, times: dict[str, Timing], numbers: dict) -> str:
    """How the times of an earlier run into the same file compare; earlier: its numbers, None where there are none."""
    told = "## Beside an earlier run\n\n"
    if earlier is None:
        return told + "There was no earlier run here."
    differing = [name for name in SAME if earlier.get(name) != numbers.get(name)]
    if differing:
        return told + f"The earlier run here had another {' and '.join(differing)}."
    rows, compared, before = [], 0, earlier.get("times", {})
    for name, now in plain(times).items():
        was = before.get(name)
        compared += was is not None
        if was is not None and not agrees(was, now):
            cells = f"{1e3 * was['median']:.3g}", percent(was["spread"]), f"{1e3 * now['median']:.3g}", percent(now["spread"])
            rows.append((name, *cells, f"{now['median'] / was['median']:.2f}"))
    text = f"{compared - len(rows)} of {compared} times agree with those of {earlier['date']} within the spreads of both."
    headings = ("time", "then [ms]", "spread", "now [ms]", "spread", "now / then")
    return told + text + ("\n\nThe others:\n\n" + markdown(headings, rows, left=(0,)) if rows else "")
