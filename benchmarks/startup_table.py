"""Tables and limits of `taisoft bench startup`. found: a column for each version, of what `startup.measure` gives."""

import numpy as np

from taisoft.output.tables import markdown

from .elasticity_table import Limit

OTHER = "warm, other size"
SLOWER = {  # than the baseline, at most
    "symplectic_euler step": 1.2,
    "implicit_euler step": 1.25,
    "energies": 1.15,
    "force differential": 1.15,
    "search, 704 triangles": 1.15,
    "search, 2,528 triangles": 1.15,
    "contact step, 704 triangles": 1.15,
    "contact step, 2,528 triangles": 1.15,
}
CROSSING = "1,964 triangles"  # the first sheet that is searched by all threads
SCENES = ("beam", "cube")


def table(found: dict[str, dict]) -> str:
    """A row for each thing a user waits for, two columns for each version."""
    rows = []
    for name in SCENES:
        for what in ("cold", "warm", OTHER):
            rows.append((f"{name}, {what}", *[cell(one[name][what]) for one in found.values()]))
        for what in ("first", "second", "other size"):
            rows.append((f"{name}, {what} in one process", *[cell(one[name]["one process"][what]) for one in found.values()]))
    for k, what in enumerate(("first", "second", "third")):
        rows.append((f"static solve, {what}", *[cell(one["statics"][str(k)]) for one in found.values()]))
    rows.append(("nine static solves", *[cell(one["identify"]) for one in found.values()]))
    return markdown(("wall (CPU) [s]", *found), rows, left=(0,))


def cell(times: dict) -> str:
    """Wall and CPU seconds."""
    return f"{times['wall']:.3g} ({times['cpu']:.3g})"


def settings_table(found: dict[str, dict]) -> str:
    """What changes of an open simulator cost."""
    versions = list(found.values())
    rows = [(what, *[f"{1e3 * one['settings'][what]:.2f}" for one in versions]) for what in versions[0]["settings"]]
    return markdown(("cube with contacts, wall [ms]", *found), rows, left=(0,))


def speed_table(found: dict[str, dict]) -> str:
    """How fast kernels are, with the range over rounds."""
    rows = []
    for what in SLOWER:
        cells = []
        for one in found.values():
            times = 1e3 * np.array(one["speed"][what])
            cells.append(f"{np.median(times):.3g} ({times.min():.3g} to {times.max():.3g})")
        rows.append((what, *cells))
    return markdown(("wall [ms], median (range over rounds)", *found), rows, left=(0,))


def count_table(found: dict[str, dict]) -> str:
    """Kernels compiled, files in the cache, memory."""
    versions, rows = list(found.values()), []
    for name in SCENES:
        for what in ("first", "second", "other size"):
            counts = [one[name]["one process"][what]["compiled"] for one in versions]
            rows.append((f"{name}: kernels compiled, {what}", *[count(n) for n in counts]))
        new = [", ".join(map(str, one[name]["new files"])) for one in versions]
        rows.append((f"{name}: new files, {OTHER}, by round", *new))
        rows.append((growth_of(versions[0], name), *[f"{growth(one[name]['memory']):.1f}" for one in versions]))
    for size in versions[0]["surfaces"]:
        rows.append((f"sheet: kernels compiled, {size}", *[count(one["surfaces"][size]) for one in versions]))
    shares = [growth(one["keep"]) / one["keep"]["times"] for one in versions]
    rows.append(("closed simulator that is kept: resident memory [MB]", *[f"{share:.1f}" for share in shares]))
    return markdown(("count", *found), rows, left=(0,))


def count(n: int | None) -> str:
    """A number of kernels, which old versions cannot tell."""
    return "unknown" if n is None else str(n)


def growth(memory: dict) -> float:
    """Of resident memory [MB]."""
    return memory["end"] - memory["start"]


def growth_of(one: dict, name: str) -> str:
    """What `growth` of a scene is over."""
    return f"{name}: growth of resident memory over {one[name]['memory']['times']} simulators [MB]"


def find_limits(now: dict, old: dict | None) -> list[Limit]:
    """What start-up must keep."""
    limits = [Limit("cube: cold, from process start to the tenth step [s]", now["cube"]["cold"]["wall"], 15.0)]
    for name in SCENES:
        one = now[name]["one process"]
        for what in ("second", "other size"):
            limits.append(Limit(f"{name}: kernels compiled, {what}", one[what]["compiled"], 0))
        limits.append(Limit(f"{name}: new files in the cache, other size", max(now[name]["new files"]), 0))
        limits.append(Limit(growth_of(now, name), growth(now[name]["memory"]), 10.0))
    _, *later = now["surfaces"]
    for size in later:
        if size != CROSSING:  # there the search takes other kernels
            limits.append(Limit(f"sheet: kernels compiled, {size}", now["surfaces"][size], 0))
    kept = now["keep"]
    limits.append(Limit(f"growth of resident memory over {kept['times']} kept closed simulators [MB]", growth(kept), 10.0))
    return limits + (compare(now, old) if old else [])


def compare(now: dict, old: dict) -> list[Limit]:
    """The limits that are shares of the baseline's times."""
    limits = []
    for name in SCENES:
        second = [one[name]["one process"]["second"]["wall"] for one in (now, old)]
        limits.append(Limit(f"{name}: second simulator over the baseline's", second[0] / second[1], 0.1))
        walls = [one[name][OTHER]["walls"] for one in (now, old)]
        limits.append(Limit(f"{name}: {OTHER}, over the baseline's", ratio(*walls), 0.5))
    static = now["statics"]["1"]["wall"] / old["statics"]["1"]["wall"]
    limits.append(Limit("second static solve over the baseline's", static, 0.15))
    limits.append(Limit("nine static solves over the baseline's", now["identify"]["wall"] / old["identify"]["wall"], 0.1))
    for what, most in SLOWER.items():
        limits.append(Limit(f"{what} over the baseline's", ratio(now["speed"][what], old["speed"][what]), most))
    return limits


def ratio(now: list[float], old: list[float]) -> float:
    """Median over rounds of the ratio within a round."""
    return float(np.median(np.array(now) / np.array(old)))
