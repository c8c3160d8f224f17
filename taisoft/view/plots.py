"""Plots over time of the step reports: energies, residuals, iterations, contacts, wall time of a step, and estimated errors.

This module keeps the history of a run and computes the curves in a unit square; `taisoft.view.annotations` draws them on
pictures. Only simulated quantities are available: no contacts if nothing can touch, no Newton iterations for explicit
steps. Where errors are estimated, energies are drawn as bands: plus and minus the error in time at the last comparison.

The history takes constant memory: minimum and maximum of every quantity over bins of consecutive steps. A bin holds one step
until CAPACITY bins are full. Then neighbours are merged in pairs, and from there on a bin holds twice as many steps. So no peak
is lost, however long a simulation runs, and early and late steps have the same resolution.

Some plots show a quantity of each pair that presses, or of each body: the few largest.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taisoft.errors import SceneError
from taisoft.records import ERROR_KINDS, ErrorEstimate, StepReport
from taisoft.scene.checks import nearest
from taisoft.view.colouring import round_up
from taisoft.view.drawn import ENERGIES

BLUE, ORANGE, GREEN, DARK = (0.16, 0.42, 0.74), (0.87, 0.42, 0.13), (0.20, 0.56, 0.28), (0.30, 0.30, 0.36)  # sRGB
COLOURS = (BLUE, ORANGE, GREEN, DARK)  # of a plot with curves by pair or body, as many as it shows
GRID_LINES = 4  # at most, between the ends of an axis
MIN_SPAN = 1e-200  # values that span less count as constant
MAX_DECADES = 12  # of a logarithmic axis; smaller values, and zero, lie on its lower end
OF_PAIRS = {"forces": "contact_force", "torques": "contact_torque"}  # plot by pair -> query
CAPACITY = 256  # bins, an even number
SOLVERS = ("newton_residual", "contact_residual", "newton_iterations", "linear_iterations", "contact_iterations", "n_contacts")
ERRORS = tuple(f"{kind}_error" for kind in ERROR_KINDS)  # over the largest excursion, in percent
QUANTITIES = (*ENERGIES, "total", *SOLVERS, "step_time", *ERRORS)  # energies as changes since the start, wall time in [ms]


@dataclass(frozen=True)
class Series:
    """One curve of a plot. quantity: column of `History`; needs: "implicit" steps, "contact" forces, "error" estimates or ""."""

    name: str
    quantity: str
    colour: tuple[float, float, float]
    needs: str = ""


@dataclass(frozen=True)
class Plot:
    """Curves that share an axis. log: whether it is logarithmic; many: whether its series stands for one of each pair or body."""

    title: str
    unit: str
    series: tuple[Series, ...]
    log: bool = False
    many: bool = False


PLOTS = {
    "energies": Plot(
        "energy change", "J", tuple(Series(name, name, colour) for name, colour in zip(QUANTITIES, (BLUE, ORANGE, GREEN, DARK)))
    ),
    "residuals": Plot(
        "residuals",
        "",
        (Series("Newton", "newton_residual", BLUE, "implicit"), Series("contacts", "contact_residual", ORANGE, "contact")),
        log=True,
    ),
    "iterations": Plot(
        "iterations of a step",
        "",
        (
            Series("Newton", "newton_iterations", BLUE, "implicit"),
            Series("CG", "linear_iterations", GREEN, "implicit"),
            Series("contacts", "contact_iterations", ORANGE, "contact"),
        ),
    ),
    "contacts": Plot("contacts", "", (Series("contacts", "n_contacts", ORANGE, "contact"),)),
    "step_time": Plot("wall time of a step", "ms", (Series("step", "step_time", BLUE),), log=True),
    "error": Plot(
        "estimated error so far",
        "%",
        tuple(Series(name, f"{name}_error", colour, "error") for name, colour in zip(ERROR_KINDS, (BLUE, ORANGE, GREEN))),
        log=True,
    ),
    "forces": Plot("force by pair", "N", (Series("", "forces", DARK, "contact"),), many=True),
    "torques": Plot("torque by pair", "N m", (Series("", "torques", DARK, "contact"),), many=True),
    "kinetic": Plot("kinetic energy by body", "J", (Series("", "kinetic", DARK),), many=True),
    "elastic": Plot("elastic energy by body", "J", (Series("", "elastic", DARK),), many=True),
}


class History:
    """Minima and maxima of quantities over bins of steps.

    times: (n,) ends of the bins [s]; low, high: (n, k) minima and maxima over each, NaN if unknown; columns: (k,) names,
    QUANTITIES, then those by pair or body, such as "forces: a, b"; last: (k,) values of the last step; begin: time of the start
    [s]. sim: energies are recorded relative to its present ones.
    """

    def __init__(self, sim, capacity: int = CAPACITY):
        self.columns = list(QUANTITIES)
        self._times, (self._low, self._high) = np.empty(capacity), np.empty((2, capacity, len(QUANTITIES)))
        self._n = self._steps_in_last = 0
        self._steps_per_bin = 1
        self._start_energies, self.begin = _energies(sim.energies()), sim.time
        self._append(sim.time, np.where(np.arange(len(QUANTITIES)) < 4, 0.0, np.nan), np.zeros(len(QUANTITIES)))

    @property
    def times(self) -> np.ndarray:
        """Ends of the bins (n,) [s]."""
        return self._times[: self._n]

    @property
    def low(self) -> np.ndarray:
        """Minima over each bin (n, k)."""
        return self._low[: self._n]

    @property
    def high(self) -> np.ndarray:
        """Maxima over each bin (n, k)."""
        return self._high[: self._n]

    def take(
        self,
        report: StepReport,
        seconds: float,
        explicit: bool,
        touching: bool,
        errors: ErrorEstimate | None = None,
        **more: float,
    ) -> None:
        """Record a step, or a batch of explicit steps.

        seconds: its total wall time [s]; touching: whether contact forces are simulated; errors: so far, if estimated; more:
        columns by pair or body, 0 for those that other steps had. Quantities not simulated are NaN.
        """
        energies = _energies(report) - self._start_energies
        solved, touched = (np.nan if explicit else 1.0), (1.0 if touching else np.nan)
        row = np.array(
            [
                *energies,
                energies.sum(),
                report.residual * solved,
                report.contact_residual * touched,
                report.newton_iterations * solved,
                report.linear_iterations * solved,
                report.contact_iterations * touched / report.steps,
                report.n_contacts * touched,
                1e3 * seconds / report.steps,
                *(
                    100.0 * (np.nan if value is None else value)
                    for value in (getattr(errors, kind, None) for kind in ERROR_KINDS)
                ),
            ]
        )
        new = [name for name in more if name not in self.columns]
        if new:
            self.columns += new
            self._low, self._high = (np.pad(a, ((0, 0), (0, len(new))), constant_values=np.nan) for a in (self._low, self._high))
        row = np.concatenate([row, [more.get(name, 0.0) for name in self.columns[len(QUANTITIES) :]]])
        half = np.zeros(len(row))
        if errors is not None and errors.energies is not None:
            half[:4] = np.abs([*_energies(errors.energies), errors.energies.total])
        self._append(report.time, np.where(np.isfinite(row), row, np.nan), half)

    def _append(self, time: float, row: np.ndarray, half: np.ndarray) -> None:
        """Append a row, with half the width of each band."""
        self.last = row
        if self._n and self._steps_in_last < self._steps_per_bin:
            k = self._n - 1
            self._low[k], self._high[k] = np.fmin(self._low[k], row - half), np.fmax(self._high[k], row + half)
            self._steps_in_last += 1
        else:
            if self._n == len(self._times):
                self._merge_pairs()
            k = self._n
            self._low[k], self._high[k] = row - half, row + half
            self._n, self._steps_in_last = k + 1, 1
        self._times[k] = time

    def _merge_pairs(self) -> None:
        """Merge neighbouring bins in pairs; all bins are full."""
        half = self._n // 2
        self._times[:half] = self._times[1 : self._n : 2]
        self._low[:half] = np.fmin(self._low[0 : self._n : 2], self._low[1 : self._n : 2])
        self._high[:half] = np.fmax(self._high[0 : self._n : 2], self._high[1 : self._n : 2])
        self._n, self._steps_per_bin = half, 2 * self._steps_per_bin


def _energies(record) -> np.ndarray:
    return np.array([getattr(record, name) for name in ENERGIES])


@dataclass(frozen=True)
class Curves:
    """Drawing of a plot, in a unit square with y upwards.

    ends: low and high end of the axis as text; grid: heights of the grid lines; lines: colour and points (k,2) of each curve,
    with rows of NaN at gaps; legend: name, last value and colour of each; times: first and last time [s].
    """

    title: str
    ends: tuple[str, str]
    grid: list[float]
    lines: list[tuple[tuple, np.ndarray]]
    legend: list[tuple[str, str, tuple]]
    times: tuple[float, float]


def plain_history(history: History) -> dict:
    """Return the arrays of a history as plain data, only with the columns that plots can show."""
    columns = [*QUANTITIES, *(s.quantity for plot in PLOTS.values() if plot.many for s in series_of(plot, history))]
    used = [history.columns.index(name) for name in columns]
    parts = {"low": history.low[:, used], "high": history.high[:, used], "last": history.last[used]}
    return {"times": history.times, "begin": history.begin, "columns": columns, **parts}


def series_of(plot: Plot, history) -> tuple[Series, ...]:
    """Return the series of a plot, of one by pair or body the few with the largest values."""
    if not plot.many:
        return plot.series
    kind = f"{plot.series[0].quantity}: "
    own = [k for k, name in enumerate(history.columns) if name.startswith(kind)]
    largest = np.argsort(-np.fmax.reduce(history.high[:, own], axis=0, initial=0.0), kind="stable")[: len(COLOURS)]
    names = [history.columns[own[k]] for k in sorted(largest)]
    return tuple(Series(name.removeprefix(kind), name, colour) for name, colour in zip(names, COLOURS))


class PlotChoice:
    """Which plots of a history are available and drawn.

    history: a `History`, or what has its arrays; enabled: which of the `needs` of series are met; names: of the requested plots.
    """

    def __init__(self, history, enabled: dict[str, bool], names: tuple[str, ...] = ()):
        self.history, self.enabled, self.names = history, enabled, names

    def available(self) -> dict[str, Plot]:
        """Return the plots that have simulated quantities now, each with the curves of these."""
        enabled = {"": True} | self.enabled
        kept = {name: tuple(s for s in plot.series if enabled[s.needs]) for name, plot in PLOTS.items()}
        return {name: replace(PLOTS[name], series=series) for name, series in kept.items() if series}

    def visible(self) -> list[str]:
        """Return the names of the plots that are requested and available."""
        return [name for name in self.available() if name in self.names]

    def curves(self, name: str) -> "Curves":
        """Return the present drawing of a plot."""
        return curves_of(self.available()[name], self.history)


class Plots(PlotChoice):
    """History of a simulation, and which plots of it are drawn.

    sim: a Simulator; names: of the plots; errors: whether the run estimates errors. Raises SceneError for an unknown name or a
    plot of quantities that sim does not simulate.
    """

    def __init__(self, sim, names: tuple[str, ...] = (), errors: bool = False):
        self._sim, self._errors = sim, errors
        self.history, self.names = History(sim), names
        for name in names:
            if name not in PLOTS:
                raise SceneError(f"plot '{name}' is unknown{nearest(name, PLOTS)}; there are {', '.join(PLOTS)}")
            if name not in self.available():
                raise SceneError(f"plot '{name}' is not available: {self._why_unavailable(name)}")

    @property
    def enabled(self) -> dict[str, bool]:
        """Which `needs` of series the simulator meets now."""
        return {"implicit": not self._sim.settings.explicit, "contact": self._touching, "error": self._errors}

    def take(self, report: StepReport, seconds: float) -> None:
        """Record a step report; seconds: its wall time [s]. For `on_step` of a run."""
        errors = self._sim.error_so_far if self._errors else None
        self.history.take(report, seconds, self._sim.settings.explicit, self._touching, errors, **self._by_name())

    def _by_name(self) -> dict[str, float]:
        """Return the columns of the requested plots by pair or body: forces [N], torques [N m] and energies [J]."""
        sim, found, kinds = self._sim, {}, [kind for kind in ("kinetic", "elastic") if kind in self.names]
        queries = {name: query for name, query in OF_PAIRS.items() if name in self.names}
        for a, b in sim.pairs_in_contact() if queries else ():
            found |= {f"{name}: {a}, {b}": float(np.linalg.norm(getattr(sim, query)(a, b))) for name, query in queries.items()}
        for body, energies in zip(sim.scene.bodies, sim._open().body_energies()) if kinds else ():
            found |= {f"{kind}: {body.name}": getattr(energies, kind) for kind in kinds}
        return found

    @property
    def _touching(self) -> bool:
        return self._sim.plan.on["contact_forces"]

    def _why_unavailable(self, name: str) -> str:
        """Explain why a plot is not available."""
        reasons = {
            "implicit": f"steps of {self._sim.settings.integrator} are explicit and solve no equations",
            "error": "the run does not estimate errors",
            "contact": f"contact forces are not modelled ({self._sim.plan.why('contact_forces')})",
        }
        needs = {series.needs for series in PLOTS[name].series}
        return f"{', and '.join(text for key, text in reasons.items() if key in needs)}; there are {', '.join(self.available())}"


def curves_of(plot: Plot, history: History) -> Curves:
    """Return the drawing of a plot of a history."""
    shown = series_of(plot, history)
    columns = [history.columns.index(s.quantity) for s in shown]
    low, high = history.low[:, columns], history.high[:, columns]
    bottom, top, grid = (_log_axis if plot.log else _axis)(low, high)
    first, last = history.begin, history.times[-1]
    across = (history.times - first) / ((last - first) or 1.0)
    lines, legend = [], []
    for k, (column, series) in enumerate(zip(columns, shown)):
        values = np.stack([low[:, k], high[:, k]], axis=1)
        values = _logarithms(values, bottom) if plot.log else values
        y = np.clip((values - bottom) / (top - bottom), 0.0, 1.0)
        points = np.stack([np.repeat(across, 2), y.reshape(-1)], axis=1)
        duplicate = np.repeat(values[:, 0] == values[:, 1], 2) & (np.arange(len(points)) % 2 == 1)
        lines.append((series.colour, np.where(np.isnan(points[:, 1:]), np.nan, points)[~duplicate]))
        value = history.last[column]
        legend.append((series.name, "-" if math.isnan(value) else f"{value:.3g} {plot.unit}".rstrip(), series.colour))
    ends = tuple(f"{10.0**end if plot.log else end:.4g} {plot.unit}".rstrip() for end in (bottom, top))
    return Curves(plot.title, ends, grid, lines, legend, (float(first), float(last)))


def _axis(low: np.ndarray, high: np.ndarray) -> tuple[float, float, list[float]]:
    """Return the ends and grid lines of a linear axis that contains all values and 0, at multiples of a round number."""
    lowest, highest = np.fmin.reduce(low, axis=None, initial=0.0), np.fmax.reduce(high, axis=None, initial=0.0)
    if highest - lowest < MIN_SPAN:
        return 0.0, 1.0, []
    step = round_up((highest - lowest) / (GRID_LINES + 1))
    first, last = math.floor(lowest / step + 1e-9), math.ceil(highest / step - 1e-9)
    return first * step, last * step, [k / (last - first) for k in range(1, last - first)]


def _log_axis(low: np.ndarray, high: np.ndarray) -> tuple[float, float, list[float]]:
    """Do as `_axis`, in powers of ten for all values above 0."""
    positive = np.concatenate([low[low > 0], high[high > 0]])
    if not len(positive):
        return -1.0, 0.0, []
    top = math.ceil(math.log10(positive.max()) - 1e-9)
    bottom = min(max(math.floor(math.log10(positive.min()) + 1e-9), top - MAX_DECADES), top - 1)
    step = -(-(top - bottom) // (GRID_LINES + 1))
    return float(bottom), float(top), [k / (top - bottom) for k in range(step, top - bottom, step)]


def _logarithms(values: np.ndarray, bottom: float) -> np.ndarray:
    """Return log10 of values; zero becomes the axis's lower end, NaN stays."""
    return np.log10(values, out=np.where(np.isnan(values), np.nan, bottom), where=values > 0)
