"""The picture of `contact.py`: the report's figure 19, a row a scene, its figure 20 below, and the crossover."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taisoft.contact.graph import groups
from taisoft.output.tables import require_matplotlib, save, ticks
from taisoft.view.offscreen import Offscreen

from .contact_captured import THREADED, contact_jacobian
from .contact_crossover import Point
from .contact_runs import Film

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555")
BANDS = ("#0072b2", "#d55e00")  # of groups in turn
WAYS = ("random", "greedy")  # of the grouped Jacobians
COLUMNS, PANEL, PICTURE = 4, (4.2, 3.4), (640, 520)  # panels in a row, their size in inches, pixels of a scene


@dataclass
class Snapshot:
    """A scene at one moment. image (h,w,3); touched (k, n_nodes) bool: which contact pushes which node; colours: way -> (k,)."""

    scene: str
    image: np.ndarray
    touched: np.ndarray
    colours: dict[str, np.ndarray]


def take_snapshot(scene: str, sim, colours: dict[str, np.ndarray]) -> Snapshot:
    """The present picture of a simulator and its contact Jacobian, of nodes that some contact pushes."""
    J = contact_jacobian(sim._contact.problem).tocoo()
    touched = np.zeros((J.shape[0] // 3, J.shape[1] // 3), dtype=bool)
    touched[J.row // 3, J.col // 3] = True
    image = Offscreen(sim.scene, PICTURE, renderer="software").image(sim)
    return Snapshot(scene, image, touched[:, touched.any(axis=0)], colours)


def draw(found: dict, snapshots: list[Snapshot], path: Path) -> None:
    """Write a PNG. found: "films" and "crossover". Raises OutputError where it cannot be written."""
    require_matplotlib()
    from matplotlib import pyplot

    rows = len(snapshots) + len(found["films"])
    size = PANEL[0] * COLUMNS, PANEL[1] * rows
    figure, grid = pyplot.subplots(rows, COLUMNS, figsize=size, layout="constrained", squeeze=False)
    for panels, snapshot in zip(grid, snapshots):
        figure_19(panels, snapshot)
    for k, (panels, film) in enumerate(zip(grid[len(snapshots) :], found["films"])):
        figure_20(panels, film)
        if k == 0:
            _crossover(panels[3], found["crossover"])
        else:
            panels[3].set_visible(False)
    handles, labels = grid[len(snapshots), 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize="small", frameon=False)
    save(figure, path, dpi=110)


def figure_19(panels, s: Snapshot) -> None:
    """The scene, its Jacobian, and that with its rows grouped by colour; groups have two tints in turn."""
    panels[0].imshow(s.image)
    panels[0].set_axis_off()
    panels[0].set_title(f"{s.scene} (as fig. 19)")
    _spy(panels[1], s.touched, np.zeros(len(s.touched), dtype=int), f"contact Jacobian: {len(s.touched)} contacts")
    for panel, way in zip(panels[2:], WAYS):
        order, start = groups(s.colours[way])
        band = np.repeat(np.arange(len(start) - 1), np.diff(start))
        _spy(panel, s.touched[order], band % len(BANDS), f"grouped, {way}: {len(start) - 1} colours")
        for at in start[1:-1]:
            panel.axhline(at - 0.5, color="#bbbbbb", lw=0.6, zorder=0)


def _spy(panel, touched: np.ndarray, band: np.ndarray, title: str) -> None:
    row, column = np.nonzero(touched)
    size = min(30.0, 4e4 / touched.size + 2.0)
    panel.scatter(column, row, s=size, marker="s", linewidths=0, c=np.array(BANDS)[band[row]])
    panel.set(title=title, xlabel="nodes that are pushed", ylabel="contacts")
    panel.set_xlim(-0.5, touched.shape[1] - 0.5)
    panel.set_ylim(touched.shape[0] - 0.5, -0.5)


def figure_20(panels, film: Film) -> None:
    """Sweeps and time of each solver over frames, and the contacts."""
    for name, colour in zip(film.solvers, COLOURS):
        style = {"color": colour, "label": name, "lw": 1.2, "ls": "--" if name.endswith(THREADED) else "-"}
        if not name.endswith(THREADED):  # threads change no sweeps
            panels[0].plot(film.time, [o.sweeps for o in film.of(name)], **style)
        panels[1].plot(film.time, [1e3 * o.median for o in film.of(name)], **style)
    panels[2].plot(film.time, film.contacts, color=COLOURS[0], label="contacts")
    panels[2].plot(film.time, film.found, ":", color=COLOURS[1], label="before reduction")
    panels[0].set_ylim(bottom=0)
    panels[1].set_yscale("log")
    panels[2].set_ylim(bottom=0)
    panels[2].legend(fontsize="small", frameon=False)
    for panel, what in zip(panels, ("sweeps (fig. 20)", "solve [ms] (fig. 20)", "contacts")):
        panel.set(title=f"{film.scene}: {what}", xlabel="time [s]")
        _lines(panel)


def _lines(panel) -> None:
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)


def _crossover(panel, points: list[Point]) -> None:
    contacts = [p.contacts for p in points]
    of = (("serial", COLOURS[0], lambda p: p.serial), ("coloured, all threads", COLOURS[1], lambda p: p.coloured))
    for name, colour, one in of:
        panel.plot(contacts, [1e3 * one(p).median for p in points], "o-", color=colour, ms=4, label=f"{name}, a solve")
        panel.plot(contacts, [1e3 * one(p).per_sweep for p in points], "s:", color=colour, ms=4, label=f"{name}, a sweep")
    panel.set(xscale="log", yscale="log", xlabel="contacts", title="Gauss-Seidel on two plates [ms]")
    _lines(panel)
    ticks(panel.xaxis, panel.get_xlim()[1] / panel.get_xlim()[0])
    panel.set_ylim(top=100 * panel.get_ylim()[1])  # room for the legend
    panel.legend(fontsize="small", frameon=False, loc="upper left")
