"""The folder of a study: its finished runs in runs/ (`taisoft.many.store`), study.md, study.csv, study.json and study.png.

The picture, for which matplotlib is needed, shows error against time on log axes, with the Pareto front, the tolerance and the
references' own errors.
"""

import itertools
import json
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.folder import output_errors
from taisoft.output.report import json_text
from taisoft.output.tables import require_matplotlib, save, ticks
from taisoft.study.accuracy import Row
from taisoft.study.results import Study, csv_of, plain_of, text_of

FILES = ("study.md", "study.csv", "study.json", "study.png")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#555555")
MARKERS = {
    "symplectic_euler": "v",
    "velocity_verlet": "^",
    "linearly_implicit_euler": "D",
    "implicit_euler": "o",
    "bdf2": "s",
    "implicit_midpoint": "P",
}
REFERENCE = {"color": "#222222", "lw": 1.4, "ls": ":"}  # lines of the references' own errors
SIZE = (7.4, 5.4)  # [inch]
# Axes shown by colour if they vary, and their labels
COLOUR_AXES = {"refine": "refine {}", "order": "order {}", "precision": "{}", "contact_solver": "{}", "arch": "{}"}
MAX_LABELS = 8  # labelled points of the front
MAX_ERROR_RATIO = 100.0  # of the smallest error to a reference's own, above which the latter is not shown
OUTSIDE = 1e9  # beyond every axis


def check_scene(folder: Path, scene: str) -> None:
    """Raise OutputError if the folder holds a study of a scene with another digest."""
    try:
        found = json.loads((folder / "study.json").read_bytes())
        name, same = found["request"]["scene"], found["scene_digest"] == scene
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise OutputError(f"the folder {folder} holds a study.json not written by this version: name another folder") from error
    if not same:
        raise OutputError(f"the folder {folder} holds a study of another scene ({name}, with other content): name another folder")


def write(study: Study, folder: Path) -> str:
    """Write all files. Return a sentence if there is no picture, else an empty text. Raises OutputError."""
    write_bytes(folder / "study.md", text_of(study).encode())
    write_bytes(folder / "study.csv", csv_of(study).encode())
    write_bytes(folder / "study.json", json_text(plain_of(study)).encode())
    picture = folder / "study.png"
    try:
        require_matplotlib("study.png")
    except OutputError as error:
        reason = str(error)
    else:
        if rows := study.comparable_rows():
            _draw(study, rows, picture)
            return ""
        reason = "study.png is not drawn, because no setting has both a time and an error"
    with output_errors(f"cannot remove the earlier {picture}"):
        picture.unlink(missing_ok=True)  # from an earlier study: the folder holds only one
    return reason


def _draw(study: Study, rows: list[Row], path: Path) -> None:
    """Write study.png. rows: the comparable ones, at least one."""
    from matplotlib import pyplot

    by, tolerance = study.request.by, study.request.tolerance
    figure, panel = pyplot.subplots(figsize=SIZE, layout="constrained")
    smallest, largest = (limit(row.resolved_error(by) for row in rows) for limit in (min, max))
    own_errors = sorted({row.error(by)[1] for row in rows})
    shown = [error for error in own_errors if error > smallest / MAX_ERROR_RATIO]
    _draw_front(panel, study)
    panel.axhline(tolerance, color="#555555", lw=0.9, ls="--", zorder=1, label=f"tolerance {tolerance:g}")
    for k, error in enumerate(shown):
        panel.axhline(error, **REFERENCE, zorder=1, label="reference's own error" if k == 0 else None)
    if not shown:
        panel.plot([], [], **REFERENCE, label=f"reference's own error:\n{own_errors[-1]:.1g}, far below")
    _draw_points(panel, study, rows)
    times = [x for row in rows for x in np.percentile(row.seconds, (25, 75))]
    low, high = min(smallest, tolerance, *shown), max(largest, tolerance, *shown)
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.6, max(times) * 1.9), ylim=(low / 2.0, high * 2.0))
    ticks(panel.xaxis, max(times) / min(times))
    ticks(panel.yaxis, high / low)
    space = "relative to the finest mesh, " if study.space is not None else ""
    panel.set_xlabel("wall time per simulated second [s], median; bars: quartiles")
    panel.set_ylabel(f"error in position ({space}{by}, over the largest excursion)")
    panel.set_title(Path(study.request.scene).stem)
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    panel.legend(fontsize="small", frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def _draw_front(panel, study: Study) -> None:
    """Plot the front as steps: vertical before the first point, horizontal after the last; label at most MAX_LABELS points."""
    front = study.front()
    times, errors = zip(*map(study.point, front))
    corners = [times[0], *times, OUTSIDE], [OUTSIDE, *errors, errors[-1]]
    panel.step(*corners, where="post", color="#999999", lw=1.2, zorder=1, label="Pareto front")
    box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 0.5}
    for row in front[:: -(-len(front) // MAX_LABELS)]:
        text = f"{1e3 * row.setting['dt']:.3g} ms"
        panel.annotate(text, study.point(row), (5, 7), textcoords="offset points", fontsize=7, color="#333333", bbox=box)


def _draw_points(panel, study: Study, rows: list[Row]) -> None:
    """Plot one series per integrator and kind: marker by integrator, colour by kind, or by integrator if there is one kind."""
    varying = {key: label for key, label in COLOUR_AXES.items() if len({row.setting[key] for row in rows}) > 1}

    def kind_of(row: Row) -> str:
        return ", ".join(label.format(row.setting[key]) for key, label in varying.items())

    integrators = list(dict.fromkeys(row.setting["integrator"] for row in rows))
    kinds = list(dict.fromkeys(map(kind_of, rows)))
    for kind, integrator in itertools.product(kinds, integrators):
        series = [row for row in rows if row.setting["integrator"] == integrator and kind_of(row) == kind]
        series.sort(key=lambda row: row.setting["dt"])
        colour = COLOURS[(kinds.index(kind) if len(kinds) > 1 else integrators.index(integrator)) % len(COLOURS)]
        panel.plot(*_points(study, series), color=colour, lw=0.8, alpha=0.4, zorder=1)
        style = {"color": colour, "marker": MARKERS.get(integrator, "X"), "ls": "none", "ms": 6, "elinewidth": 1.0, "capsize": 2}
        for status, fill, suffix in (("ok", colour, ""), ("degraded", "white", " (degraded)")):
            if selected := [row for row in series if row.status == status]:
                label = ", ".join(filter(None, (integrator, kind))) + suffix
                times, errors = _points(study, selected)
                bars = np.abs(np.transpose([np.percentile(row.seconds, (25, 75)) for row in selected]) - times)
                panel.errorbar(times, errors, xerr=bars, mfc=fill, label=label, **style)


def _points(study: Study, rows: list[Row]) -> np.ndarray:
    """Return times and errors (2,k) of rows."""
    return np.reshape([study.point(row) for row in rows], (-1, 2)).T
