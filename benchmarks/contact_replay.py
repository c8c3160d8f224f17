"""Captured steps with contacts, solved again by this version and an older one: Newton, CG, launches, time, error."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from taisoft.errors import SimulationError
from taisoft.output.files import make_folder
from taisoft.output.tables import markdown

from . import contact_states
from .document import Document
from .elasticity_table import Limit, limit_table
from .versions import HERE, version_in

CHILD = Path(__file__).with_name("contact_states.py")
PRECISIONS, TOLERANCE, EXACT = ("f32", "f64"), 1e-4, 1e-8
# what this version is held to: median and 90th percentile of Newton iterations, share of states that need halving
MEDIAN, HIGH, HALVED = 5.0, 12.0, 0.03
COLUMNS = (
    "scene",
    "states",
    "N median",
    "N 90 %",
    "N most",
    "CG median",
    "launches",
    "halved",
    "unconverged",
    "ms",
    "error median",
    "error most",
)


def run(folder: Path, *task: str | Path) -> list[dict]:
    """What a child of a version found, which keeps a cache of kernels of its own. Raises SimulationError where it failed."""
    return [json.loads(line) for line in version_in(folder).run(CHILD, *task) if line.startswith("{")]


def capture(folder: Path, baseline: Path | None, only: list[str] | None, quick: bool) -> Iterator[str]:
    """Capture each scene's states into the folder, by the older version where one is given; a line of text a scene."""
    make_folder(folder)
    for name in only or contact_states.SCENES:
        if not contact_states.can_build(name):
            yield f"{name}: left out, its mesh is not here"
            continue
        (folder / f"{name}.exact").unlink(missing_ok=True)
        found = run(baseline or HERE, "capture", name, folder / f"{name}.pkl", *(["quick"] if quick else []))[-1]
        yield f"{name}: {found['states']} states; {found['newton']} Newton iterations in its steps"


def replay(folder: Path, baseline: Path | None, only: list[str] | None, document: Document) -> tuple[dict, list[Limit]]:
    """Solve the captured states in both precisions; a table a version and precision, as they come."""
    files = [file for file in sorted(folder.glob("*.pkl")) if only is None or file.stem in only]
    if not files:
        raise SimulationError(f"{folder} holds no captured states: make some by --capture")
    for file in files:  # the same steps to 1e-8, kept beside the states
        if not file.with_suffix(".exact").exists():
            run(HERE, "replay", file, "f64", str(EXACT), file.with_suffix(".exact"))
    found: dict[str, list[dict]] = {}
    for precision in PRECISIONS:
        for version, where in (("this version", HERE), ("the baseline", baseline)):
            if where is None:
                continue
            rows = []
            for file in files:
                rows += run(where, "replay", file, precision, str(TOLERANCE), file.with_suffix(".exact"))
            found[f"{version}, {precision}"] = rows
            document.add(f"## {version[0].upper()}{version[1:]}, {precision}\n\n{table(rows)}")
    if baseline is not None:
        document.add("\n".join(speed_text(found, precision) for precision in PRECISIONS))
    limits = [limit for precision in PRECISIONS for limit in limits_of(found[f"this version, {precision}"], precision)]
    document.add("## Limits\n\n" + limit_table(limits))
    return found, limits


def table(rows: list[dict]) -> str:
    """A row a scene, and one for all."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    lines = [cells(name, [row for row in rows if row["scene"] == name]) for name in names]
    return markdown(COLUMNS, [*lines, cells("all", rows)], left=(0,))


def cells(name: str, rows: list[dict]) -> tuple[str, ...]:
    """Of one scene. Newton and CG: of the first try, whole; launches and time: of all tries."""
    newton, errors = np.array([row["newton"] for row in rows]), np.array([row["error"] for row in rows if "error" in row])
    return (
        name,
        str(len(rows)),
        f"{np.median(newton):.0f}",
        f"{np.percentile(newton, 90):.0f}",
        str(newton.max()),
        f"{np.median([row['linear'] for row in rows]):.0f}",
        f"{np.median([row['launches'] for row in rows]):.0f}",
        str(sum(row["halves"] > 1 for row in rows)),
        str(sum(not row["converged"] for row in rows)),
        f"{1e3 * np.median([row['seconds'] for row in rows]):.1f}",
        *([f"{np.median(errors):.1e}", f"{errors.max():.1e}"] if len(errors) else ["-", "-"]),
    )


def speed_text(found: dict[str, list[dict]], precision: str) -> str:
    """The time of both versions."""
    names = (f"{version}, {precision}" for version in ("this version", "the baseline"))
    new, old = (np.array([row["seconds"] for row in found[name]]) for name in names)
    ratio = old / new
    low, high = np.percentile(ratio, [25, 75])
    return (
        f"* {precision}: the baseline takes {old.sum() / new.sum():.2f} times as long in all; of single states the median is "
        f"{np.median(ratio):.2f} (quartiles {low:.2f} and {high:.2f})"
    )


def limits_of(rows: list[dict], precision: str) -> list[Limit]:
    """What this version is held to."""
    newton = np.array([row["newton"] for row in rows])
    return [
        Limit(f"{precision}: Newton iterations, median", float(np.median(newton)), MEDIAN),
        Limit(f"{precision}: Newton iterations, 90 %", float(np.percentile(newton, 90)), HIGH),
        Limit(f"{precision}: states that need halving, share", sum(row["halves"] > 1 for row in rows) / len(rows), HALVED),
        Limit(f"{precision}: states that stay unconverged", float(sum(not row["converged"] for row in rows)), 0.0),
    ]
