"""The picture of a study: error against time, both logarithmic, with the front, the tolerance and what references are good to."""

from pathlib import Path

import numpy as np

from taisoft.output.plot import require_matplotlib, save, ticks
from taisoft.study.accuracy import Row
from taisoft.study.results import Study

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#555555")
MARKERS = {
    "symplectic_euler": "v", "velocity_verlet": "^", "linearly_implicit_euler": "D", "implicit_euler": "o", "bdf2": "s",
    "implicit_midpoint": "P",
}  # fmt: skip
SURE = "#222222"  # colour of what references are good to
SIZE = (7.4, 5.4)  # [inch]
KINDS = ("refine", "order", "precision", "contact_solver", "arch")  # axes that colours tell apart, where they vary
LABELS = 8  # points of the front that are named at most
NEAR = 100.0  # least error over a reference's own one that is still shown
FAR = 1e9  # beyond every axis


def draw(study: Study, path: Path) -> bool:
    """Write study.png; False where there is no point to draw. Raises OutputError."""
    rows = study.judged()
    if not rows:
        return False
    require_matplotlib("a study's picture")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=SIZE, layout="constrained")
    _lines(panel, study, rows)
    _points(panel, study, rows)
    _label_front(panel, study)
    times = [x for row in rows for x in np.percentile(row.seconds, (25, 75))]
    errors = [row.claimed(study.request.by) for row in rows] + [study.request.tolerance] + _shown_sure(study, rows)
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.6, max(times) * 1.9), ylim=(min(errors) / 2.0, max(errors) * 2.0))
    for axis, values in ((panel.xaxis, times), (panel.yaxis, errors)):
        ticks(axis, max(values) / min(values))
    space = "to the finest mesh, " if study.space is not None else ""
    panel.set_xlabel("wall time of a simulated second [s], median; bars: quartiles")
    panel.set_ylabel(f"error in position ({space}{study.request.by}, over the largest excursion)")
    panel.set_title(Path(study.request.scene).stem)
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    panel.legend(fontsize="small", frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)
    return True


def _points(panel, study: Study, rows: list[Row]) -> None:
    """A series an integrator and kind: marker by integrator, colour by kind, or by integrator where there is one kind."""
    varying = [key for key in KINDS if len({row.setting[key] for row in rows}) > 1]
    integrators = list(dict.fromkeys(row.setting["integrator"] for row in rows))
    kinds = list(dict.fromkeys(_kind(row, varying) for row in rows))
    for row_kind in kinds:
        for integrator in integrators:
            own = [row for row in rows if row.setting["integrator"] == integrator and _kind(row, varying) == row_kind]
            colour = COLOURS[(kinds.index(row_kind) if len(kinds) > 1 else integrators.index(integrator)) % len(COLOURS)]
            label = ", ".join(filter(None, (integrator, row_kind)))
            chain = sorted(own, key=lambda row: row.setting["dt"])
            places = [row.timing.median for row in chain], [row.claimed(study.request.by) for row in chain]
            panel.plot(*places, color=colour, lw=0.8, alpha=0.4, zorder=1)
            for status, fill in (("ok", colour), ("degraded", "white")):
                some = [row for row in own if row.status == status]
                if some:
                    suffix = "" if status == "ok" else " (degraded)"
                    _series(panel, study, some, color=colour, mfc=fill, marker=MARKERS[integrator], label=label + suffix)


def _series(panel, study: Study, rows: list[Row], **style) -> None:
    middle = [row.timing.median for row in rows]
    bars = np.transpose([np.abs(np.percentile(row.seconds, (25, 75)) - row.timing.median) for row in rows])
    errors = [row.claimed(study.request.by) for row in rows]
    panel.errorbar(middle, errors, xerr=bars, ls="none", ms=6, elinewidth=1.0, capsize=2, **style)


def _kind(row: Row, varying: list[str]) -> str:
    names = {"precision": "{}", "arch": "{}", "contact_solver": "{}"}
    return ", ".join(names.get(key, key + " {}").format(row.setting[key]) for key in varying)


def _lines(panel, study: Study, rows: list[Row]) -> None:
    """The front as stairs, the tolerance, and the references' own errors."""
    front = study.front()
    times, errors = [row.timing.median for row in front], [row.claimed(study.request.by) for row in front]
    # nothing is faster than its first point, and beyond its last one the front stays where it is
    corners = [times[0], *times, FAR], [FAR, *errors, errors[-1]]
    panel.step(*corners, where="post", color="#999999", lw=1.2, zorder=1, label="Pareto front")
    tolerance = study.request.tolerance
    panel.axhline(tolerance, color="#555555", lw=0.9, ls="--", zorder=1, label=f"tolerance {tolerance:g}")
    shown = _shown_sure(study, rows)
    for k, sure in enumerate(shown):
        panel.axhline(sure, color=SURE, lw=1.4, ls=":", zorder=1, label="reference's own error" if k == 0 else None)
    if not shown:
        label = f"reference's own error:\n{_sure(study, rows)[-1]:.1g}, far below"
        panel.plot([], [], color=SURE, lw=1.4, ls=":", label=label)


def _sure(study: Study, rows: list[Row]) -> list[float]:
    """What the references of the rows are good to."""
    return sorted({row.error(study.request.by)[1] for row in rows})


def _shown_sure(study: Study, rows: list[Row]) -> list[float]:
    """Those that lie near enough to the points to be in the picture."""
    least = min(row.claimed(study.request.by) for row in rows)
    return [sure for sure in _sure(study, rows) if sure > least / NEAR]


def _label_front(panel, study: Study) -> None:
    """Steps at the points of the front, as far as there is room."""
    front = study.front()
    for row in front[:: -(-len(front) // LABELS)]:
        place = (row.timing.median, row.claimed(study.request.by))
        text = f"{1e3 * row.setting['dt']:.3g} ms"
        box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 0.5}
        panel.annotate(text, place, (5, 7), textcoords="offset points", fontsize=7, color="#333333", bbox=box)
