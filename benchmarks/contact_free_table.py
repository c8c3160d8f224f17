"""Steps without contacts, and statics, by this version and an older one: iterations, time, what did not converge."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from taisoft.output.tables import markdown

from . import contact_free
from .document import Document
from .elasticity_table import Limit, limit_table
from .versions import HERE, version_in

CHILD = Path(contact_free.__file__)
NAMES = (*contact_free.CASES, contact_free.STATICS)
REPEATS, QUICK_COUNT = 3, 3
MORE = 1.05  # times the older version's iterations and time
NEWTON = 4.0  # Newton iterations a step of beams with inverted tets
COLUMNS = ("case", "tets", "inverted", "version", "of", "converged", "N each", "CG each", "ms in all", "spread")


def measure(baseline: Path | None, only: list[str] | None, quick: bool, document: Document) -> tuple[dict, list[Limit]]:
    """Run the cases, versions in turns; a table of all, and limits where there is an older version and the runs are whole."""
    versions = {"this": version_in(HERE)} | ({} if baseline is None else {"older": version_in(baseline)})
    found: dict[str, dict[str, list[dict]]] = {}
    for name in only or NAMES:
        found[name] = {label: [] for label in versions}
        for _ in range(1 if quick or name in contact_free.INVERTED else REPEATS):
            for label, version in versions.items():
                found[name][label].append(json.loads(version.run(CHILD, name, *([QUICK_COUNT] if quick else []))[-1]))
        rows = [row(name, label, found[name]) for label in versions]
        document.add("\n".join(f"{name}, {one[3]}: {one[6]} Newton iterations each, {one[8]} ms" for one in rows))
    rows = [row(name, label, own) for name, own in found.items() for label in own]
    document.add("## Steps and solves\n\n" + markdown(COLUMNS, rows, left=(0, 3)))
    limits = [] if quick else list(limits_of(found))
    if limits:
        document.add("## Limits\n\n" + limit_table(limits))
    return found, limits


def counted(own: dict[str, list[dict]]) -> np.ndarray:
    """Which steps or solves are told: those that converge in every version."""
    return np.all([runs[0]["converged"] for runs in own.values()], axis=0)


def total(own: dict[str, list[dict]], label: str, what: str) -> np.ndarray:
    """Sum of a number over what is told, for each run of a version."""
    return np.array([np.array(run[what])[counted(own)].sum() for run in own[label]])


def spread(times: np.ndarray) -> float:
    """Of runs, relative: the distance between the largest and the least over the median."""
    return float(np.ptp(times) / np.median(times))


def row(name: str, label: str, own: dict[str, list[dict]]) -> tuple[str, ...]:
    """Cells of a case and a version."""
    first, n = own[label][0], max(1, counted(own).sum())
    times = total(own, label, "seconds")
    return (
        name,
        f"{first['tets']:,}",
        f"{first['inverted']:,}",
        label,
        str(len(first["converged"])),
        str(sum(first["converged"])),
        f"{total(own, label, 'newton')[0] / n:.2f}",
        f"{total(own, label, 'linear')[0] / n:.0f}",
        f"{1e3 * np.median(times):.1f}",
        f"{100 * spread(times):.0f} %",
    )


def limits_of(found: dict[str, dict[str, list[dict]]]) -> Iterator[Limit]:
    """What this version is held to."""
    for name, own in found.items():
        if name in contact_free.INVERTED:
            newton = total(own, "this", "newton")[0] / max(1, counted(own).sum())
            yield Limit(f"{name}: Newton iterations a step", float(newton), NEWTON)
        if "older" not in own:
            continue
        for what, unit in (("newton", "Newton iterations"), ("seconds", "time")):
            this, older = total(own, "this", what), total(own, "older", what)
            if np.median(older) > 0:
                ratio = float(np.median(this) / np.median(older))
                wide = max(spread(this), spread(older)) if what == "seconds" else None
                yield Limit(f"{name}: {unit} over the older version's", ratio, MORE, wide)
