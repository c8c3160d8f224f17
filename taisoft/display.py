"""Short texts of records, and what notebooks show of scenes, simulators and runs.

`short_repr` is the repr of records that hold arrays: large ones by type and shape, long lists by their length. `run_html` shows
the report of a run. What needs pictures is drawn by `taisoft/view/notebook.py`, which is loaded by name at the first display, as
public names are: scenes and simulators do not depend on viewers.
"""

import dataclasses
import html
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from taisoft.records import RunReport

MAX_ENTRIES = 9  # of arrays, lists and dicts that a short repr shows in full
CHART = (420, 130)  # width and height of the chart of energies [pixels]
CHART_POINTS = 400  # of a curve
CURVES = (("kinetic", "#2f6fb0"), ("elastic", "#c8662b"), ("gravity", "#3d8b52"), ("loads", "#8465ad"))  # energies and colours
PROBLEMS_SHOWN = 5
LEAST = 1e-6  # smaller fractions are shown as "below" it


def short_repr(self) -> str:
    """Return a record's type and public fields on one line; the `__repr__` of records that hold arrays."""
    names = self._fields if hasattr(self, "_fields") else [field.name for field in dataclasses.fields(self)]
    shown = [f"{name}={_short(getattr(self, name))}" for name in names if not name.startswith("_")]
    return f"{type(self).__name__}({', '.join(shown)})"


def _short(value) -> str:
    if isinstance(value, np.ndarray):
        return str(value.tolist()) if value.size <= MAX_ENTRIES else f"{value.dtype} {value.shape}"
    if isinstance(value, (list, dict)) and len(value) > MAX_ENTRIES:
        return f"{type(value).__name__} of {len(value)}"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def percent(value: float) -> str:
    """Return a fraction in percent, with two digits and without the sign."""
    if value >= 1.0:
        return f"{100.0 * value:.0f}"
    return f"{100.0 * value:.2g}" if value >= LEAST else f"< {100.0 * LEAST:.2g}" if value > 0.0 else "0"


def simulator_text(self) -> str:
    """Return size, method and state of a simulator on one line; its `__repr__`."""
    n, tets, s = len(self.scene.bodies), sum(body.mesh.n_tets for body in self.scene.bodies), self.settings
    state = f"t = {self.time:.6g} s after {self.step_count} steps of {self.dt:.6g} s" if self.is_open else "closed"
    return f"Simulator({n} {'body' if n == 1 else 'bodies'}, {tets} tets; {s.integrator}, {s.precision} on {s.arch}; {state})"


def drawn(function: str, thing) -> str | None:
    """Return the HTML that a function of `taisoft.view.notebook` makes of a scene or a simulator; None to show its repr."""
    return getattr(import_module("taisoft.view.notebook"), function)(thing)


def caption(text: str) -> str:
    """Return a line of text as HTML."""
    return f'<div style="font-family: monospace; font-size: 12px">{html.escape(text)}</div>'


def run_html(report: "RunReport") -> str:
    """Return status, problems, numbers and a chart of the energies of a run as HTML."""
    first, *problems = repr(report).splitlines()
    numbers = {
        "smallest J": _extreme(report, "min_volume_ratio", min),
        "inverted tets": _extreme(report, "n_inverted", max),
        "contacts, at most": _extreme(report, "n_contacts", max),
        "penetration, at most [m]": _extreme(report, "max_penetration", max),
        "Newton iterations": sum(step.newton_iterations for step in report.step_reports) or None,
        "worst residual": _extreme(report, "residual", max),
    }
    rows = [f"<tr><td>{html.escape(name)}</td><td>{value:.4g}</td></tr>" for name, value in numbers.items() if value is not None]
    lines = [f"<div>{html.escape(line.strip())}</div>" for line in problems]
    return "".join(
        [
            f'<div style="font-family: monospace; font-size: 12px"><b>{html.escape(first)}</b>',
            *lines,
            f'<table style="display: inline-table; vertical-align: top">{"".join(rows)}</table>' if rows else "",
            _chart(report),
            "</div>",
        ]
    )


def _extreme(report: "RunReport", name: str, which) -> float | None:
    """Return the smallest or largest value of a field over the steps."""
    return which((getattr(step, name) for step in report.step_reports), default=None)


def _chart(report: "RunReport") -> str:
    """Return curves of the energies over time, as changes since the first step, as SVG; "" if there are fewer than two steps."""
    steps = report.step_reports[:: -(-len(report.step_reports) // CHART_POINTS) or 1]
    time = np.array([step.time for step in steps])
    curves = {name: np.array([getattr(step, name) for step in steps]) for name, _ in CURVES}
    curves = {name: values - values[0] for name, values in curves.items() if len(steps) > 1 and np.ptp(values) > 0.0}
    if not curves or not all(np.isfinite(values).all() for values in curves.values()):
        return ""
    low, high = min(values.min() for values in curves.values()), max(values.max() for values in curves.values())
    (width, height), left, bottom = CHART, 82, 18
    across = left + (time - time[0]) / (time[-1] - time[0]) * (width - left - 70)
    parts, line, colours = [], 12, dict(CURVES)
    for name, values in curves.items():
        down = 8 + (high - values) / (high - low) * (height - bottom - 16)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colours[name]}" stroke-width="1.5"/>')
        parts.append(f'<text x="{width - 62}" y="{line}" fill="{colours[name]}">{name}</text>')
        line += 13
    labels = [
        f'<text x="{left - 4}" y="12" text-anchor="end">{high:.3g} J</text>',
        f'<text x="{left - 4}" y="{height - bottom - 4}" text-anchor="end">{low:.3g} J</text>',
        f'<text x="{left}" y="{height - 4}">{time[0]:.3g} s</text>',
        f'<text x="{across[-1]:.0f}" y="{height - 4}" text-anchor="end">{time[-1]:.3g} s, change of energies</text>',
    ]
    head = f'<svg width="{width}" height="{height}" style="background: white; vertical-align: top" font-size="11" fill="#333">'
    return "".join([head, *parts, *labels, "</svg>"])
