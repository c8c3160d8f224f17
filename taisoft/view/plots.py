"""Plots over time of the step reports: energies, residuals, iterations, contacts, wall time of a step, and estimated errors.

This module keeps the history of a run; `taisoft.view.annotations` draws it on pictures. Only simulated quantities are available:
no contacts if nothing can touch, no Newton iterations for explicit steps. Where errors are estimated, energies are drawn as
bands: plus and minus the error in time at the last comparison.

The history takes constant memory: minimum and maximum of every quantity over bins of consecutive steps. A bin holds one step
until CAPACITY bins are full. Then neighbours are merged in pairs, and from there on a bin holds twice as many steps. So no peak
is lost, however long a simulation runs, and early and late steps have the same resolution.

Some plots show a quantity of each pair that presses, or of each body: the few largest.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from taisoft.errors import SceneError
from taisoft.records import ERROR_KINDS, ErrorEstimate, StepReport
from taisoft.scene.checks import choice
from taisoft.view.drawn import ENERGIES

BLUE, ORANGE, GREEN, DARK = (0.16, 0.42, 0.74), (0.87, 0.42, 0.13), (0.20, 0.56, 0.28), (0.30, 0.30, 0.36)  # sRGB
COLOURS = (BLUE, ORANGE, GREEN, DARK)  # of a plot's curves; by pair or body it shows as many
OF_PAIRS = {"forces": "contact_force", "torques": "contact_torque"}  # plot by pair -> query
CAPACITY = 256  # bins, an even number
SOLVERS = ("newton_residual", "contact_residual", "newton_iterations", "linear_iterations", "contact_iterations", "n_contacts")
# energies as changes since the start, wall time in [ms], errors over the largest excursion in percent
QUANTITIES = (*ENERGIES, "total", *SOLVERS, "step_time", *(f"{kind}_error" for kind in ERROR_KINDS))


@dataclass(frozen=True)
class Series:
    """One curve of a plot. needs: "implicit" steps, "contact" forces, "error" estimates or ""; quantity: column of `History`."""

    name: str
    colour: tuple[float, float, float]
    needs: str
    quantity: str


@dataclass(frozen=True)
class Plot:
    """Curves that share an axis. log: whether it is logarithmic; many: whether its series stands for one of each pair or body."""

    title: str
    unit: str
    series: tuple[Series, ...]
    log: bool = False
    many: bool = False


_newton, _linear = partial(Series, "Newton", BLUE, "implicit"), partial(Series, "CG", GREEN, "implicit")
_contacts, _step = partial(Series, "contacts", ORANGE, "contact"), partial(Series, "step", BLUE, "")
_iterations = _newton("newton_iterations"), _linear("linear_iterations"), _contacts("contact_iterations")
_changes = tuple(Series(name, colour, "", name) for name, colour in zip(QUANTITIES, COLOURS))
_errors = tuple(Series(kind, colour, "error", f"{kind}_error") for kind, colour in zip(ERROR_KINDS, (BLUE, ORANGE, GREEN)))
PLOTS = {
    "energies": Plot("energy change", "J", _changes),
    "residuals": Plot("residuals", "", (_newton("newton_residual"), _contacts("contact_residual")), log=True),
    "iterations": Plot("iterations of a step", "", _iterations),
    "contacts": Plot("contacts", "", (_contacts("n_contacts"),)),
    "step_time": Plot("wall time of a step", "ms", (_step("step_time"),), log=True),
    "error": Plot("estimated error so far", "%", _errors, log=True),
    "forces": Plot("force by pair", "N", (_contacts("forces"),), many=True),
    "torques": Plot("torque by pair", "N m", (_contacts("torques"),), many=True),
    "kinetic": Plot("kinetic energy by body", "J", (_step("kinetic"),), many=True),
    "elastic": Plot("elastic energy by body", "J", (_step("elastic"),), many=True),
}


class History:
    """Minima and maxima of quantities over bins of steps.

    times: (n,) ends of the bins [s]; low, high: (n, k) minima and maxima over each, NaN if unknown; columns: (k,) names,
    QUANTITIES, then those by pair or body, such as "forces: a, b"; last: (k,) values of the last step; begin: time of the start
    [s]. sim: energies are recorded relative to its present ones.
    """

    def __init__(self, sim, capacity: int = CAPACITY):
        self.columns, self._capacity = list(QUANTITIES), capacity
        self._steps_per_bin = self._steps_in_last = 1
        self._start_energies, self.begin = _energies(sim.energies()), sim.time
        self.last = np.where(np.arange(len(QUANTITIES)) < 4, 0.0, np.nan)
        self.times, self.low, self.high = np.array([sim.time]), self.last[None], self.last[None]

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
        row = [*energies, energies.sum(), solved * report.residual, touched * report.contact_residual]
        row += [solved * report.newton_iterations, solved * report.linear_iterations]
        row += [touched * report.contact_iterations / report.steps, touched * report.n_contacts, 1e3 * seconds / report.steps]
        row += [*(100.0 * np.array([getattr(errors, kind, None) for kind in ERROR_KINDS], dtype=float))]
        if new := [name for name in more if name not in self.columns]:
            self.columns += new
            self.low, self.high = (np.pad(a, ((0, 0), (0, len(new))), constant_values=np.nan) for a in (self.low, self.high))
        self.last = np.append(row, [more.get(name, 0.0) for name in self.columns[len(QUANTITIES) :]])
        self.last[~np.isfinite(self.last)] = np.nan
        half = np.zeros(len(self.last))
        if errors is not None and errors.energies is not None:
            half[:4] = np.abs([*_energies(errors.energies), errors.energies.total])
        self._append(report.time, self.last - half, self.last + half)

    def _append(self, time: float, low: np.ndarray, high: np.ndarray) -> None:
        if self._steps_in_last < self._steps_per_bin:
            self.times[-1], self._steps_in_last = time, self._steps_in_last + 1
            self.low[-1], self.high[-1] = np.fmin(self.low[-1], low), np.fmax(self.high[-1], high)
            return
        if len(self.times) == self._capacity:  # all full: merge neighbours
            self.times, self._steps_per_bin = self.times[1::2], 2 * self._steps_per_bin
            self.low, self.high = np.fmin(self.low[::2], self.low[1::2]), np.fmax(self.high[::2], self.high[1::2])
        self.times, self._steps_in_last = np.append(self.times, time), 1
        self.low, self.high = np.vstack([self.low, low]), np.vstack([self.high, high])


def _energies(record) -> np.ndarray:
    return np.array([getattr(record, name) for name in ENERGIES])


def plain_history(history: History) -> dict:
    """Return the arrays of a history as plain data, only with the columns that plots can show."""
    columns = [*QUANTITIES, *(s.quantity for plot in PLOTS.values() if plot.many for s in series_of(plot, history))]
    used = [history.columns.index(name) for name in columns]
    low, high, last = history.low[:, used], history.high[:, used], history.last[used]
    return {"times": history.times, "begin": history.begin, "columns": columns, "low": low, "high": high, "last": last}


def series_of(plot: Plot, history) -> tuple[Series, ...]:
    """Return the series of a plot, of one by pair or body the few with the largest values."""
    if not plot.many:
        return plot.series
    kind = f"{plot.series[0].quantity}: "
    own = [k for k, name in enumerate(history.columns) if name.startswith(kind)]
    largest = np.argsort(-np.fmax.reduce(history.high[:, own], axis=0, initial=0.0), kind="stable")[: len(COLOURS)]
    names = [history.columns[own[k]] for k in sorted(largest)]
    return tuple(Series(name.removeprefix(kind), colour, "", name) for name, colour in zip(names, COLOURS))


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

    def visible(self) -> list[Plot]:
        """Return the plots that are requested and available."""
        return [plot for name, plot in self.available().items() if name in self.names]


class Plots(PlotChoice):
    """History of a simulation, and which plots of it are drawn.

    sim: a Simulator; names: of the plots; errors: whether the run estimates errors. Raises SceneError for an unknown name or a
    plot of quantities that sim does not simulate.
    """

    def __init__(self, sim, names: tuple[str, ...] = (), errors: bool = False):
        self._sim, self._errors = sim, errors
        self.history, self.names = History(sim), names
        for name in names:
            if choice(name, "plot", tuple(PLOTS)) not in self.available():
                raise SceneError(f"plot '{name}' is not available: {self._why_unavailable(name)}")

    @property
    def enabled(self) -> dict[str, bool]:
        """Which `needs` of series the simulator meets now."""
        touching = self._sim.plan.on["contact_forces"]
        return {"implicit": not self._sim.settings.explicit, "contact": touching, "error": self._errors}

    def take(self, report: StepReport, seconds: float) -> None:
        """Record a step report; seconds: its wall time [s]. For `on_step` of a run."""
        met, errors = self.enabled, self._sim.error_so_far if self._errors else None
        self.history.take(report, seconds, not met["implicit"], met["contact"], errors, **self._by_name())

    def _by_name(self) -> dict[str, float]:
        """Return the columns of the requested plots by pair or body: forces [N], torques [N m] and energies [J]."""
        sim, found, kinds = self._sim, {}, [kind for kind in ("kinetic", "elastic") if kind in self.names]
        queries = {name: query for name, query in OF_PAIRS.items() if name in self.names}
        for a, b in sim.pairs_in_contact() if queries else ():
            found |= {f"{name}: {a}, {b}": float(np.linalg.norm(getattr(sim, query)(a, b))) for name, query in queries.items()}
        for body, energies in zip(sim.scene.bodies, sim._open().body_energies()) if kinds else ():
            found |= {f"{kind}: {body.name}": getattr(energies, kind) for kind in kinds}
        return found

    def _why_unavailable(self, name: str) -> str:
        """Explain why a plot is not available."""
        reasons = {
            "implicit": f"steps of {self._sim.settings.integrator} are explicit and solve no equations",
            "error": "the run does not estimate errors",
            "contact": f"contact forces are not modelled ({self._sim.plan.why('contact_forces')})",
        }
        needs = {series.needs for series in PLOTS[name].series}
        return f"{', and '.join(text for key, text in reasons.items() if key in needs)}; there are {', '.join(self.available())}"
