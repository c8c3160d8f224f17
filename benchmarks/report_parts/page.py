"""Result of an experiment of `report.py`: claims with verdicts, tables, pictures, and their Markdown; numbers to judge.

A claim is a statement of the report with our numbers; the experiment computes whether it holds. The verdict of a part is "agree"
if all its claims hold, "disagree" if none does, else "partly".
"""

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..charts import Panel, figure_of
from ..document import default_out, earlier_numbers, plain, table

AGREE, PARTLY, DISAGREE, MISSING = "agree", "partly", "disagree", "not measured"
HOLDS = {"collision": "cells", "contact": "touching"}  # what results that can be judged hold
PALETTE = 128  # colours of a picture, enough to avoid bands in shaded scenes
DPI = 85


@dataclass(frozen=True)
class Extent:
    """Extent of the measurement, and the arch."""

    quick: bool
    arch: str


@dataclass(frozen=True)
class Claim:
    """said: the report's statement in our words; found: our numbers in a sentence; why: explanation if it does not hold."""

    said: str
    holds: bool
    found: str
    why: str = ""

    def __post_init__(self):
        object.__setattr__(self, "holds", bool(self.holds))  # NumPy comparisons give no Python bool


@dataclass
class Part:
    """A measured experiment. where: in the report; method: what was run.

    pictures: file name -> PNG; short: differences from the report and omissions; failure: why it could not be measured, or empty.
    """

    name: str
    title: str
    where: str
    method: str
    claims: list[Claim] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    pictures: dict[str, bytes] = field(default_factory=dict)
    short: list[str] = field(default_factory=list)
    seconds: float = 0.0
    failure: str = ""

    @property
    def verdict(self) -> str:
        """Verdict on all claims."""
        return verdict_of([claim.holds for claim in self.claims]) if not self.failure else MISSING

    def record(self) -> dict:
        """The part as plain data, without pictures."""
        return plain(vars(self) | {"verdict": self.verdict, "pictures": sorted(self.pictures)})


def verdict_of(holds: Sequence[bool]) -> str:
    """Verdict on claims that hold or not; MISSING without claims."""
    if not holds:
        return MISSING
    return AGREE if all(holds) else PARTLY if any(holds) else DISAGREE


# --- numbers ----------------------------------------------------------------------------------------------------------


@cache
def numbers_of(name: str, quick: bool, arch: str) -> dict:
    """Numbers of `taisoft bench NAME`: of a whole run on this machine those in benchmarks/results, else of a run now."""
    stored = default_out(arch, name)
    known = None if quick else earlier_numbers(stored)
    if known is not None and not known.get("quick") and HOLDS[name] in known:
        return known
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.json" if quick else stored
        words = ["--arch", arch, "--out", str(path), *(["--quick"] if quick else [])]
        import_module(f"..{name}", __package__).main(words)
        return json.loads(path.read_text())


def restored(kind: type, record: dict):
    """A dataclass from its record as plain data, which may hold more."""
    return kind(**{field.name: record[field.name] for field in fields(kind) if field.name in record})


def is_near(value: float, expected: float, tolerance: float) -> bool:
    """Whether |value - expected| <= tolerance; False for nan."""
    return math.isfinite(value) and abs(value - expected) <= tolerance


def clearly_less(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether the upper quartile of the times `a` is below the lower quartile of `b`."""
    return float(np.percentile(a, 75)) < float(np.percentile(b, 25))


# --- pictures ---------------------------------------------------------------------------------------------------------


def small_png(image: np.ndarray) -> bytes:
    """A picture uint8 (height, width, 3) as a PNG with a palette."""
    from PIL import Image

    out = io.BytesIO()
    reduced = Image.fromarray(image).quantize(PALETTE, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    reduced.save(out, format="png", optimize=True)
    return out.getvalue()


def plot_png(*panels: Panel) -> bytes:
    """Panels side by side as a small PNG."""
    from matplotlib import pyplot

    figure = figure_of(panels, columns=len(panels), dpi=DPI)
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
    pyplot.close(figure)
    return small_png(image)


# --- the page ---------------------------------------------------------------------------------------------------------


def part_text(part: Part) -> str:
    """Section of a part."""
    lines = [f"## {part.title}", f"The report: {part.where}. Name: `{part.name}`. Took {part.seconds:.0f} s with compilation."]
    if part.failure:
        return "\n\n".join([*lines, f"**{MISSING}**: {part.failure}"])
    lines += [f"**{part.verdict}**", "\n".join(claim_text(claim) for claim in part.claims), f"Run: {part.method}"]
    lines += part.tables
    lines += [f"![{name.removesuffix('.png')}]({name})" for name in part.pictures]
    return "\n\n".join(lines)


def claim_text(claim: Claim) -> str:
    """A bullet with claim, verdict, numbers and explanation."""
    verdict, why = ("Agree", "") if claim.holds else ("Disagree", claim.why)
    return f"* The report: {claim.said} **{verdict}**: {claim.found} {why}".rstrip()


def summary_table(parts: Sequence[Part]) -> str:
    """A row per part: verdict and number of claims that hold."""
    columns = (
        ("<experiment", "{.title}"),
        ("<in the report", "{.where}"),
        ("<verdict", "{.verdict}"),
        ("claims that hold", lambda p: f"{sum(c.holds for c in p.claims)} of {len(p.claims)}"),
    )
    return table(parts, columns)


def short_text(parts: Sequence[Part]) -> str:
    """Differences from the report and omissions, by part."""
    lines = [f"* {part.title}: {text}" for part in parts for text in ([part.failure] if part.failure else part.short)]
    return "## Differences and omissions\n\n" + ("\n".join(lines) if lines else "Nothing known.")
