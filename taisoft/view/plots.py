"""Plots over time of what steps tell: energies, residuals, iterations, contacts, and the wall time of a step.

What they hold is worked out here, in a unit square, and drawn by the window (`taisoft.view.window`) and in pictures
(`taisoft.view.annotations`). Only what the simulation models is offered: no contacts where nothing can touch, no Newton
iterations where steps are explicit.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taisoft.errors import SceneError
from taisoft.output.history import QUANTITIES, History
from taisoft.records import StepReport
from taisoft.scene.checks import nearest
from taisoft.view.colouring import round_up

BLUE, ORANGE, GREEN, DARK = (0.16, 0.42, 0.74), (0.87, 0.42, 0.13), (0.20, 0.56, 0.28), (0.30, 0.30, 0.36)  # sRGB
GRID_LINES = 4  # at most, between the ends of an axis
SMALLEST = 1e-200  # what spans less counts as constant
DECADES = 12  # at most on a logarithmic axis; what is smaller, and zero, lies on its lower end


@dataclass(frozen=True)
class Series:
    """One line of a plot. quantity: of QUANTITIES; needs: "implicit" steps, "contact" forces, or "" for nothing."""

    name: str
    quantity: str
    colour: tuple[float, float, float]
    needs: str = ""


@dataclass(frozen=True)
class Plot:
    """Lines that share an axis. log: whether it is logarithmic."""

    title: str
    unit: str
    series: tuple[Series, ...]
    log: bool = False


PLOTS = {
    "energies": Plot("energy change", "J", (
        Series("kinetic", "kinetic", BLUE), Series("elastic", "elastic", ORANGE),
        Series("gravity", "gravity", GREEN), Series("total", "total", DARK),
    )),
    "residuals": Plot("residuals", "", (
        Series("Newton", "newton_residual", BLUE, "implicit"), Series("contacts", "contact_residual", ORANGE, "contact"),
    ), log=True),
    "iterations": Plot("iterations of a step", "", (
        Series("Newton", "newton_iterations", BLUE, "implicit"), Series("CG", "linear_iterations", GREEN, "implicit"),
        Series("contacts", "contact_iterations", ORANGE, "contact"),
    )),
    "contacts": Plot("contacts", "", (Series("contacts", "n_contacts", ORANGE, "contact"),)),
    "step_time": Plot("wall time of a step", "ms", (Series("step", "step_time", BLUE),), log=True),
}  # fmt: skip


@dataclass(frozen=True)
class Curves:
    """A plot as it is drawn, in a unit square with y upwards.

    ends: low and high end of the axis as text; grid: heights of its lines; lines: colour and points (k,2) of each, a row of NaN
    where there is a gap; legend: name, last value and colour of each; times: first and last time [s].
    """

    title: str
    ends: tuple[str, str]
    grid: list[float]
    lines: list[tuple[tuple, np.ndarray]]
    legend: list[tuple[str, str, tuple]]
    times: tuple[float, float]


class Plots:
    """The history of a simulation, and which plots of it are shown: name -> whether it is.

    sim: a Simulator; names: of the plots that are shown to begin with. Raises SceneError for a name that is unknown or a plot of
    what sim does not model.
    """

    def __init__(self, sim, names: tuple[str, ...] = ()):
        self._sim, self.history = sim, History()
        for name in names:
            if name not in PLOTS:
                raise SceneError(f"no plot is called '{name}'{nearest(name, PLOTS)}; there are {', '.join(PLOTS)}")
            if name not in self.offered():
                raise SceneError(f"there is no plot '{name}': {self._why_not(name)}")
        self.shown = {name: name in names for name in PLOTS}
        self._last_shown = tuple(names)
        self.history.start(sim)

    def offered(self) -> dict[str, Plot]:
        """The plots of what is modelled now, with the lines of what is."""
        modelled = {"": True, "implicit": not self._sim.settings.explicit, "contact": self._touching}
        kept = {name: tuple(s for s in plot.series if modelled[s.needs]) for name, plot in PLOTS.items()}
        return {name: replace(PLOTS[name], series=series) for name, series in kept.items() if series}

    def visible(self) -> list[str]:
        """Names of the plots that are shown and offered."""
        return [name for name in self.offered() if self.shown[name]]

    def toggle(self) -> None:
        """Hide all, or show again those that were shown last; all that are offered where there were none."""
        visible = self.visible()
        offered = self.offered()
        chosen = () if visible else [name for name in self._last_shown if name in offered] or offered
        self._last_shown = tuple(visible) or self._last_shown
        self.shown = {name: name in chosen for name in PLOTS}

    def take(self, report: StepReport, seconds: float) -> None:
        """Keep what a step told; seconds: its wall time [s]. For `on_step` of a run."""
        if report.time < self.history.times[-1]:  # it was set back
            self.history.start(self._sim)
        else:
            self.history.take(report, seconds, self._sim.settings.explicit, self._touching)

    def restart(self) -> None:
        """Forget what steps told so far."""
        self.history.start(self._sim)

    def curves(self, name: str) -> Curves:
        """A plot as it is drawn now."""
        return curves_of(self.offered()[name], self.history)

    @property
    def _touching(self) -> bool:
        return self._sim.plan.on["contact_forces"]

    def _why_not(self, name: str) -> str:
        """Why a plot is not offered, in words."""
        reasons = {
            "implicit": f"steps of {self._sim.settings.integrator} are explicit and solve no equations",
            "contact": f"contact forces are not modelled ({self._sim.plan.why('contact_forces')})",
        }
        needs = {series.needs for series in PLOTS[name].series}
        return f"{', and '.join(text for need, text in reasons.items() if need in needs)}; there are {', '.join(self.offered())}"


def curves_of(plot: Plot, history: History) -> Curves:
    """What a plot of a history shows."""
    columns = [QUANTITIES.index(s.quantity) for s in plot.series]
    low, high = history.low[:, columns], history.high[:, columns]
    bottom, top, grid = (_log_axis if plot.log else _axis)(low, high)
    first, last = history.begin, history.times[-1]
    across = (history.times - first) / ((last - first) or 1.0)
    lines, legend = [], []
    for k, (column, series) in enumerate(zip(columns, plot.series)):
        values = np.stack([low[:, k], high[:, k]], axis=1)
        values = _logarithms(values, bottom) if plot.log else values
        y = np.clip((values - bottom) / (top - bottom), 0.0, 1.0)
        points = np.stack([np.repeat(across, 2), y.reshape(-1)], axis=1)
        twice = np.repeat(values[:, 0] == values[:, 1], 2) & (np.arange(len(points)) % 2 == 1)
        lines.append((series.colour, np.where(np.isnan(points[:, 1:]), np.nan, points)[~twice]))
        value = history.last[column]
        legend.append((series.name, "-" if math.isnan(value) else f"{value:.3g} {plot.unit}".rstrip(), series.colour))
    ends = tuple(f"{10.0**end if plot.log else end:.4g} {plot.unit}".rstrip() for end in (bottom, top))
    return Curves(plot.title, ends, grid, lines, legend, (float(first), float(last)))


def _axis(low: np.ndarray, high: np.ndarray) -> tuple[float, float, list[float]]:
    """Ends of a linear axis that holds all values and 0, at multiples of a round number; its lines lie at the others."""
    least, most = np.fmin.reduce(low, axis=None, initial=0.0), np.fmax.reduce(high, axis=None, initial=0.0)
    if most - least < SMALLEST:
        return 0.0, 1.0, []
    step = round_up((most - least) / (GRID_LINES + 1))
    first, last = math.floor(least / step + 1e-9), math.ceil(most / step - 1e-9)
    return first * step, last * step, [k / (last - first) for k in range(1, last - first)]


def _log_axis(low: np.ndarray, high: np.ndarray) -> tuple[float, float, list[float]]:
    """As `_axis`, in powers of ten about all values above 0."""
    known = np.concatenate([low[low > 0], high[high > 0]])
    if not len(known):
        return -1.0, 0.0, []
    top = math.ceil(math.log10(known.max()) - 1e-9)
    bottom = min(max(math.floor(math.log10(known.min()) + 1e-9), top - DECADES), top - 1)
    step = -(-(top - bottom) // (GRID_LINES + 1))
    return float(bottom), float(top), [k / (top - bottom) for k in range(step, top - bottom, step)]


def _logarithms(values: np.ndarray, bottom: float) -> np.ndarray:
    """Powers of ten; zero is the axis's lower end, NaN stays."""
    return np.log10(values, out=np.where(np.isnan(values), np.nan, bottom), where=values > 0)
