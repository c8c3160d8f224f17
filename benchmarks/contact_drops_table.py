"""Whole runs of bodies that fall and come to rest, by this version and an older one: iterations, time, what did not converge."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from taisoft.output.tables import markdown

from . import contact_drops
from .document import Document
from .elasticity_table import Limit, limit_table
from .versions import HERE, Version, version_in

CHILD = Path(contact_drops.__file__)
QUICK_STEPS = 5
NEWTON = 8.0  # Newton iterations a step on average, of real meshes
# how many times as long the older version must take: each real mesh, their steps with contacts in all, other scenes
FASTER, FASTER_WITH_CONTACTS, FASTER_OTHERS = 3.0, 5.0, {"cloth": 10.0, "cube on sheet, Euler": 4.0, "cube on sheet, BDF2": 4.0}
COLUMNS = (
    "scene",
    "tets",
    "steps",
    "version",
    "N a step",
    "CG a step",
    "unconverged",
    "s in all",
    "s with contacts",
    "ms a step",
)


def run(version: Version, name: str, quick: bool) -> dict:
    """What a run of a scene by a version took. Raises SimulationError where it fails."""
    return json.loads(version.run(CHILD, name, *([QUICK_STEPS] if quick else []))[-1])


def drops(baseline: Path | None, only: list[str] | None, quick: bool, document: Document) -> tuple[dict, list[Limit]]:
    """Run the scenes, versions in turns; a table of all, and limits where there is an older version and the runs are whole."""
    versions = {"this": Version(HERE)}
    if baseline is not None:
        versions["older"] = version_in(baseline)
    found: dict[str, dict[str, dict]] = {label: {} for label in versions}
    for name in only or contact_drops.DROPS:
        if not contact_drops.can_build(name):
            document.add(f"{name}: left out, its mesh is not here")
            continue
        for label, version in versions.items():
            found[label][name] = run(version, name, quick)
        document.add("\n".join(f"{name}: {line}" for line in lines_of(found, name)))
    rows = [row(label, one) for name in found["this"] for label, own in found.items() for one in (own[name],)]
    document.add("## Runs\n\n" + markdown(COLUMNS, rows, left=(0, 3)))
    limits = [] if quick else list(limits_of(found))
    if limits:
        document.add("## Limits\n\n" + limit_table(limits))
    return found, limits


def with_contacts(one: dict) -> float:
    """Seconds of the steps that had contacts."""
    return float(np.array(one["seconds"])[np.array(one["contacts"]) > 0].sum())


def row(label: str, one: dict) -> tuple[str, ...]:
    """Cells of a run."""
    steps = len(one["seconds"])
    return (
        one["scene"],
        f"{one['tets']:,}",
        str(steps),
        label,
        f"{sum(one['newton']) / steps:.1f}",
        f"{sum(one['linear']) / steps:.0f}",
        str(one["unconverged"]),
        f"{sum(one['seconds']):.2f}",
        f"{with_contacts(one):.2f}",
        f"{1e3 * np.median(one['seconds']):.1f}",
    )


def lines_of(found: dict[str, dict[str, dict]], name: str) -> Iterator[str]:
    """A line a version, as soon as a scene has been run."""
    for label, own in found.items():
        one = own[name]
        yield f"{label} {sum(one['seconds']):.2f} s, {sum(one['newton'])} Newton iterations, {one['unconverged']} unconverged"


def limits_of(found: dict[str, dict[str, dict]]) -> Iterator[Limit]:
    """What this version is held to."""
    this, older = found["this"], found.get("older")
    for name, one in this.items():
        yield Limit(f"{name}: steps that stay unconverged", float(one["unconverged"]), 0.0)
        if name in contact_drops.MESH:
            yield Limit(f"{name}: Newton iterations a step", sum(one["newton"]) / len(one["newton"]), NEWTON)
        if older is not None:
            faster = sum(older[name]["seconds"]) / sum(one["seconds"])
            wanted = FASTER_OTHERS.get(name, FASTER)
            yield Limit(f"{name}: time of the older version over this one's", faster, wanted, at_least=True)
    meshes = [name for name in this if name in contact_drops.MESH]
    if older is not None and meshes:
        faster = sum(with_contacts(older[name]) for name in meshes) / sum(with_contacts(this[name]) for name in meshes)
        yield Limit("steps of real meshes with contacts, in all: the same", faster, FASTER_WITH_CONTACTS, at_least=True)
