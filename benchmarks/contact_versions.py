"""Implicit steps of this version and an older one: captured states, falling bodies, steps without contacts, statics.

A section of `taisoft bench contact`. The versions run in turn in processes that execute `contact_states.py`, `contact_drops.py`
or `contact_free.py`.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from taisoft.errors import SimulationError
from taisoft.output.files import make_folder

from . import contact_drops, contact_free, contact_states
from .document import Document, Limit, table
from .runner import HERE, Version, version_in, versions_beside

STATES, DROPS, FREE = (Path(module.__file__) for module in (contact_states, contact_drops, contact_free))
FREE_NAMES = (*contact_free.CASES, contact_free.STATICS)
PRECISIONS, TOLERANCE, EXACT = ("f32", "f64"), 1e-4, 1e-8
QUICK_STEPS, QUICK_COUNT, REPEATS = 5, 3, 3
# limits for captured states: median and 90th percentile of Newton iterations, fraction of states that need halving
MEDIAN, HIGH, HALVED = 5.0, 12.0, 0.03
DROP_NEWTON = 8.0  # mean Newton iterations per step of real meshes
# minimum time of the older version over this one's: each real mesh, all their steps with contacts, other scenes
FASTER, FASTER_WITH_CONTACTS, FASTER_OTHERS = 3.0, 5.0, {"cloth": 10.0, "cube on sheet, Euler": 4.0, "cube on sheet, BDF2": 4.0}
FREE_MORE, FREE_NEWTON = 1.05, 4.0  # iterations and time over the older version's; Newton iterations per step of inverted beams


def answers(version: Version, program: Path, *task: str | int | Path) -> list[dict]:
    """The results of a process of a version. Raises SimulationError if it fails."""
    return [json.loads(line) for line in version.run(program, *task) if line.startswith("{")]


# --- captured steps -----------------------------------------------------------------------------------------------------


def capture(folder: Path, baseline: Path | None, only: list[str] | None, quick: bool) -> Iterator[str]:
    """Capture each scene's states into the folder, with the older version if given; yields a line of text per scene."""
    make_folder(folder)
    for name in only or contact_states.SCENES:
        if not contact_states.can_build(name):
            yield f"{name}: left out, its mesh is absent"
            continue
        (folder / f"{name}.exact").unlink(missing_ok=True)
        task = ("capture", name, folder / f"{name}.pkl", *(["quick"] if quick else []))
        found = answers(version_in(baseline or HERE), STATES, *task)[-1]
        yield f"{name}: {found['states']} states; {found['newton']} Newton iterations in its steps"


def replay(folder: Path, baseline: Path | None, only: list[str] | None, document: Document) -> tuple[dict, list[Limit]]:
    """Solve the captured states in both precisions; adds a table per version and precision."""
    files = [file for file in sorted(folder.glob("*.pkl")) if only is None or file.stem in only]
    if not files:
        raise SimulationError(f"{folder} has no captured states: create some with --capture")

    def solve(version: Version, file: Path, precision: str, tolerance: float) -> list[dict]:
        return answers(version, STATES, "replay", file, precision, tolerance, file.with_suffix(".exact"))

    for file in files:  # the same steps to 1e-8, saved beside the states
        if not file.with_suffix(".exact").exists():
            solve(version_in(HERE), file, "f64", EXACT)
    found: dict[str, list[dict]] = {}
    for precision in PRECISIONS:
        for label, version in zip(("this version", "the baseline"), versions_beside(baseline).values()):
            rows = found[f"{label}, {precision}"] = [row for file in files for row in solve(version, file, precision, TOLERANCE)]
            document.add(f"## {label[0].upper()}{label[1:]}, {precision}\n\n{state_table(rows)}")
    if baseline is not None:
        document.add("\n".join(speed_text(found, precision) for precision in PRECISIONS))
    return found, [limit for precision in PRECISIONS for limit in state_limits(found[f"this version, {precision}"], precision)]


def values(rows: list[dict], name: str) -> np.ndarray:
    """A number of every row that has it."""
    return np.array([row[name] for row in rows if name in row])


def state_table(rows: list[dict]) -> str:
    """A row per scene and one for all. Newton and CG: of the first attempt; launches and time: of all attempts."""
    scenes = {name: [row for row in rows if row["scene"] == name] for name in dict.fromkeys(row["scene"] for row in rows)}

    def median(name: str, form: str = ".0f", scale: float = 1.0):
        return lambda item: f"{scale * np.median(values(item[1], name)):{form}}"

    columns = (
        ("<scene", "{[0]}"),
        ("states", lambda item: str(len(item[1]))),
        ("N median", median("newton")),
        ("N 90 %", lambda item: f"{np.percentile(values(item[1], 'newton'), 90):.0f}"),
        ("N maximum", lambda item: str(values(item[1], "newton").max())),
        ("CG median", median("linear")),
        ("launches", median("launches")),
        ("halved", lambda item: str((values(item[1], "halves") > 1).sum())),
        ("unconverged", lambda item: str((~values(item[1], "converged")).sum())),
        ("ms", median("seconds", ".1f", 1e3)),
        ("error median", lambda item: f"{np.median(e):.1e}" if len(e := values(item[1], "error")) else "-"),
        ("error maximum", lambda item: f"{e.max():.1e}" if len(e := values(item[1], "error")) else "-"),
    )
    return table([*scenes.items(), ("all", rows)], columns)


def speed_text(found: dict[str, list[dict]], precision: str) -> str:
    """The ratio of both versions' times."""
    new, old = (values(found[f"{label}, {precision}"], "seconds") for label in ("this version", "the baseline"))
    low, middle, high = np.percentile(old / new, [25, 50, 75])
    return (
        f"* {precision}: the baseline takes {old.sum() / new.sum():.2f} times as long in all; of single states the median is "
        f"{middle:.2f} (quartiles {low:.2f} and {high:.2f})"
    )


def state_limits(rows: list[dict], precision: str) -> list[Limit]:
    """What this version is held to."""
    newton = values(rows, "newton")
    return [
        Limit(f"{precision}: Newton iterations, median", float(np.median(newton)), MEDIAN),
        Limit(f"{precision}: Newton iterations, 90 %", float(np.percentile(newton, 90)), HIGH),
        Limit(f"{precision}: states that need halving, fraction", float((values(rows, "halves") > 1).mean()), HALVED),
        Limit(f"{precision}: states that stay unconverged", float((~values(rows, "converged")).sum()), 0.0),
    ]


# --- bodies that fall ---------------------------------------------------------------------------------------------------


def drops(baseline: Path | None, only: list[str] | None, quick: bool, document: Document) -> tuple[dict, list[Limit]]:
    """Run the scenes with the versions in turn. Returns the results and, unless quick, the limits."""
    versions = versions_beside(baseline)
    found: dict[str, dict[str, dict]] = {label: {} for label in versions}
    for name in only or contact_drops.DROPS:
        if not contact_drops.can_build(name):
            document.add(f"{name}: left out, its mesh is absent")
            continue
        lines = []
        for label, version in versions.items():
            one = found[label][name] = answers(version, DROPS, name, *([QUICK_STEPS] if quick else []))[-1]
            counts = f"{sum(one['newton'])} Newton iterations, {one['unconverged']} unconverged"
            lines.append(f"{name}: {label} {sum(one['seconds']):.2f} s, {counts}")
        document.add("\n".join(lines))
    rows = [own[name] | {"version": label} for name in found["this"] for label, own in found.items()]
    columns = (
        ("<scene", "{[scene]}"),
        ("tets", "{[tets]:,}"),
        ("steps", lambda one: str(len(one["seconds"]))),
        ("<version", "{[version]}"),
        ("N per step", lambda one: f"{np.mean(one['newton']):.1f}"),
        ("CG per step", lambda one: f"{np.mean(one['linear']):.0f}"),
        ("unconverged", "{[unconverged]}"),
        ("total s", lambda one: f"{sum(one['seconds']):.2f}"),
        ("s with contacts", lambda one: f"{with_contacts(one):.2f}"),
        ("ms per step", lambda one: f"{1e3 * np.median(one['seconds']):.1f}"),
    )
    document.add("## Runs\n\n" + table(rows, columns))
    return found, [] if quick else list(drop_limits(found))


def with_contacts(one: dict) -> float:
    """Seconds of the steps with contacts."""
    return float(np.array(one["seconds"])[np.array(one["contacts"]) > 0].sum())


def drop_limits(found: dict[str, dict[str, dict]]) -> Iterator[Limit]:
    """What this version is held to."""
    this, older = found["this"], found.get("older")
    for name, one in this.items():
        yield Limit(f"{name}: unconverged steps", float(one["unconverged"]), 0.0)
        if name in contact_drops.MESH:
            yield Limit(f"{name}: Newton iterations per step", sum(one["newton"]) / len(one["newton"]), DROP_NEWTON)
        if older is not None:
            faster = sum(older[name]["seconds"]) / sum(one["seconds"])
            required = FASTER_OTHERS.get(name, FASTER)
            yield Limit(f"{name}: time of the older version over this one's", faster, required, at_least=True)
    meshes = [name for name in this if name in contact_drops.MESH]
    if older is not None and meshes:
        faster = sum(with_contacts(older[name]) for name in meshes) / sum(with_contacts(this[name]) for name in meshes)
        yield Limit("all steps of real meshes with contacts: the same ratio", faster, FASTER_WITH_CONTACTS, at_least=True)


# --- without contacts ---------------------------------------------------------------------------------------------------


def free(baseline: Path | None, only: list[str] | None, quick: bool, document: Document) -> tuple[dict, list[Limit]]:
    """Run the cases with the versions in turn. Returns the results and, unless quick, the limits."""
    versions = versions_beside(baseline)
    found: dict[str, dict[str, list[dict]]] = {}
    for name in only or FREE_NAMES:
        own = found[name] = {label: [] for label in versions}
        for _ in range(1 if quick or name in contact_free.INVERTED else REPEATS):
            for label, version in versions.items():
                own[label].append(answers(version, FREE, name, *([QUICK_COUNT] if quick else []))[-1])
        document.add("\n".join(f"{name}, {label}: {1e3 * np.median(total(own, label, 'seconds')):.1f} ms" for label in versions))

    def each(what: str, form: str):
        return lambda row: f"{total(row[1], row[2], what)[0] / max(1, counted(row[1]).sum()):{form}}"

    columns = (
        ("<case", "{[0]}"),
        ("tets", lambda row: f"{row[1][row[2]][0]['tets']:,}"),
        ("inverted", lambda row: f"{row[1][row[2]][0]['inverted']:,}"),
        ("<version", "{[2]}"),
        ("of", lambda row: str(len(row[1][row[2]][0]["converged"]))),
        ("converged", lambda row: str(sum(row[1][row[2]][0]["converged"]))),
        ("N each", each("newton", ".2f")),
        ("CG each", each("linear", ".0f")),
        ("total ms", lambda row: f"{1e3 * np.median(total(row[1], row[2], 'seconds')):.1f}"),
        ("spread", lambda row: f"{100 * spread(total(row[1], row[2], 'seconds')):.0f} %"),
    )
    rows = [(name, own, label) for name, own in found.items() for label in own]
    document.add("## Steps and solves\n\n" + table(rows, columns))
    return found, [] if quick else list(free_limits(found))


def counted(own: dict[str, list[dict]]) -> np.ndarray:
    """Mask of the steps or solves that converge in every version."""
    return np.all([runs[0]["converged"] for runs in own.values()], axis=0)


def total(own: dict[str, list[dict]], label: str, what: str) -> np.ndarray:
    """Sum of a number over the counted steps, for each run of a version."""
    return np.array([np.array(run[what])[counted(own)].sum() for run in own[label]])


def spread(times: np.ndarray) -> float:
    """Range of the times over their median."""
    return float(np.ptp(times) / np.median(times))


def free_limits(found: dict[str, dict[str, list[dict]]]) -> Iterator[Limit]:
    """What this version is held to."""
    for name, own in found.items():
        if name in contact_free.INVERTED:
            newton = total(own, "this", "newton")[0] / max(1, counted(own).sum())
            yield Limit(f"{name}: Newton iterations per step", float(newton), FREE_NEWTON)
        if "older" not in own:
            continue
        for what, unit in (("newton", "Newton iterations"), ("seconds", "time")):
            this, older = total(own, "this", what), total(own, "older", what)
            if np.median(older) > 0:
                ratio = float(np.median(this) / np.median(older))
                wide = max(spread(this), spread(older)) if what == "seconds" else None
                yield Limit(f"{name}: {unit} over the older version's", ratio, FREE_MORE, wide)
