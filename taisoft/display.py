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
    """Return status, problems and numbers of a run as HTML."""
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
    table = f"<table>{''.join(rows)}</table>" if rows else ""
    head = f'<div style="font-family: monospace; font-size: 12px"><b>{html.escape(first)}</b>'
    return "".join([head, *lines, table, "</div>"])


def _extreme(report: "RunReport", name: str, which) -> float | None:
    """Return the smallest or largest value of a field over the steps."""
    return which((getattr(step, name) for step in report.step_reports), default=None)
