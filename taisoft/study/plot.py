"""The plot of a study: error against time on log axes, with the front, the tolerance and the references' own errors."""

from pathlib import Path

import numpy as np

from taisoft.output.tables import require_matplotlib, save, ticks
from taisoft.study.accuracy import Row
from taisoft.study.results import Study

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#555555")
MARKERS = {
    "symplectic_euler": "v",
    "velocity_verlet": "^",
    "linearly_implicit_euler": "D",
    "implicit_euler": "o",
    "bdf2": "s",
    "implicit_midpoint": "P",
}
REFERENCE_COLOUR = "#222222"  # of the references' own errors
SIZE = (7.4, 5.4)  # [inch]
COLOUR_AXES = ("refine", "order", "precision", "contact_solver", "arch")  # axes shown by colour if they vary
MAX_LABELS = 8  # labelled points of the front
MAX_ERROR_RATIO = 100.0  # of the smallest error to a reference's own, above which the latter is not shown
OUTSIDE = 1e9  # beyond every axis


def draw(study: Study, path: Path) -> bool:
    """Write study.png; return False if there is no point to draw. Raises OutputError."""
    rows = study.comparable_rows()
    if not rows:
        return False
    require_matplotlib("a study's picture")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=SIZE, layout="constrained")
    _lines(panel, study, rows)
    _points(panel, study, rows)
    _label_front(panel, study)
    times = [x for row in rows for x in np.percentile(row.seconds, (25, 75))]
    errors = [row.resolved_error(study.request.by) for row in rows] + [study.request.tolerance] + _visible_errors(study, rows)
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.6, max(times) * 1.9), ylim=(min(errors) / 2.0, max(errors) * 2.0))
    for axis, values in ((panel.xaxis, times), (panel.yaxis, errors)):
        ticks(axis, max(values) / min(values))
    space = "relative to the finest mesh, " if study.space is not None else ""
    panel.set_xlabel("wall time per simulated second [s], median; bars: quartiles")
    panel.set_ylabel(f"error in position ({space}{study.request.by}, over the largest excursion)")
    panel.set_title(Path(study.request.scene).stem)
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    panel.legend(fontsize="small", frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)
    return True


def _points(panel, study: Study, rows: list[Row]) -> None:
    """Plot one series per integrator and kind: marker by integrator, colour by kind, or by integrator if there is one kind."""
    varying = [key for key in COLOUR_AXES if len({row.setting[key] for row in rows}) > 1]
    integrators = list(dict.fromkeys(row.setting["integrator"] for row in rows))
    kinds = list(dict.fromkeys(_kind(row, varying) for row in rows))
    for row_kind in kinds:
        for integrator in integrators:
            series = [row for row in rows if row.setting["integrator"] == integrator and _kind(row, varying) == row_kind]
            colour = COLOURS[(kinds.index(row_kind) if len(kinds) > 1 else integrators.index(integrator)) % len(COLOURS)]
            label = ", ".join(filter(None, (integrator, row_kind)))
            chain = sorted(series, key=lambda row: row.setting["dt"])
            places = [row.timing.median for row in chain], [row.resolved_error(study.request.by) for row in chain]
            panel.plot(*places, color=colour, lw=0.8, alpha=0.4, zorder=1)
            for status, fill in (("ok", colour), ("degraded", "white")):
                selected = [row for row in series if row.status == status]
                if selected:
                    suffix = "" if status == "ok" else " (degraded)"
                    _series(panel, study, selected, color=colour, mfc=fill, marker=MARKERS[integrator], label=label + suffix)


def _series(panel, study: Study, rows: list[Row], **style) -> None:
    middle = [row.timing.median for row in rows]
    bars = np.transpose([np.abs(np.percentile(row.seconds, (25, 75)) - row.timing.median) for row in rows])
    errors = [row.resolved_error(study.request.by) for row in rows]
    panel.errorbar(middle, errors, xerr=bars, ls="none", ms=6, elinewidth=1.0, capsize=2, **style)


def _kind(row: Row, varying: list[str]) -> str:
    names = {"precision": "{}", "arch": "{}", "contact_solver": "{}"}
    return ", ".join(names.get(key, key + " {}").format(row.setting[key]) for key in varying)


def _lines(panel, study: Study, rows: list[Row]) -> None:
    """Plot the front as steps, the tolerance, and the references' own errors."""
    front = study.front()
    times, errors = [row.timing.median for row in front], [row.resolved_error(study.request.by) for row in front]
    # vertical before the first point, horizontal after the last
    corners = [times[0], *times, OUTSIDE], [OUTSIDE, *errors, errors[-1]]
    panel.step(*corners, where="post", color="#999999", lw=1.2, zorder=1, label="Pareto front")
    tolerance = study.request.tolerance
    panel.axhline(tolerance, color="#555555", lw=0.9, ls="--", zorder=1, label=f"tolerance {tolerance:g}")
    shown = _visible_errors(study, rows)
    for k, error in enumerate(shown):
        panel.axhline(error, color=REFERENCE_COLOUR, lw=1.4, ls=":", zorder=1, label="reference's own error" if k == 0 else None)
    if not shown:
        label = f"reference's own error:\n{_reference_errors(study, rows)[-1]:.1g}, far below"
        panel.plot([], [], color=REFERENCE_COLOUR, lw=1.4, ls=":", label=label)


def _reference_errors(study: Study, rows: list[Row]) -> list[float]:
    """Return the own errors of the rows' references, ascending."""
    return sorted({row.error(study.request.by)[1] for row in rows})


def _visible_errors(study: Study, rows: list[Row]) -> list[float]:
    """Return the reference errors close enough to the points to be shown."""
    smallest = min(row.resolved_error(study.request.by) for row in rows)
    return [error for error in _reference_errors(study, rows) if error > smallest / MAX_ERROR_RATIO]


def _label_front(panel, study: Study) -> None:
    """Label points of the front with their time step, at most MAX_LABELS of them."""
    front = study.front()
    for row in front[:: -(-len(front) // MAX_LABELS)]:
        place = (row.timing.median, row.resolved_error(study.request.by))
        text = f"{1e3 * row.setting['dt']:.3g} ms"
        box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 0.5}
        panel.annotate(text, place, (5, 7), textcoords="offset points", fontsize=7, color="#333333", bbox=box)
