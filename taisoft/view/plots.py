"""Plots over time of the step reports: energies, residuals, iterations, contacts, wall time of a step, and estimated errors.

This module keeps the history of a run; `taisoft.view.annotations` draws it on pictures. Only simulated quantities are available:
no contacts if nothing can touch, no Newton iterations for explicit steps. Where errors are estimated, energies are drawn as
bands: plus and minus the error in time at the last comparison.

The history takes constant memory: minimum and maximum of every quantity over bins of consecutive steps. A bin holds one step
until CAPACITY bins are full. Then neighbours are merged in pairs, and from there on a bin holds twice as many steps. So no peak
is lost, however long a simulation runs, and early and late steps have the same resolution.

Some plots show a quantity of each pair that presses, or of each body: the few largest.
"""

import numpy as np

from taisoft.errors import SceneError
from taisoft.records import ErrorEstimate, StepReport
from taisoft.scene.checks import choice
from taisoft.view.choices import CURVE_COLOURS, ENERGIES, ERROR_KINDS, PLOTS, Plot, Series

OF_PAIRS = {"forces": "contact_force", "torques": "contact_torque"}  # plot by pair -> query
CAPACITY = 256  # bins, an even number
# columns of every history, energies first; wall time in [ms], errors over the largest excursion in percent
QUANTITIES = tuple(dict.fromkeys(one.quantity for plot in PLOTS.values() if not plot.many for one in plot.series))


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
        self, report: StepReport, seconds: float, met: dict[str, bool], errors: ErrorEstimate | None = None, **more: float
    ) -> None:
        """Record a step, or a batch of explicit steps.

        seconds: its total wall time [s]; met: which `needs` of series the step meets: of others, quantities are NaN; errors: so
        far, if estimated; more: columns by pair or body, 0 for those of other steps.
        """
        changes = _energies(report) - self._start_energies
        found = vars(report) | dict(zip(QUANTITIES, [*changes, changes.sum()]))
        found |= {"newton_residual": report.residual, "contact_iterations": report.contact_iterations / report.steps}
        found |= {"step_time": 1e3 * seconds / report.steps}
        percent = 100.0 * np.array([getattr(errors, kind, None) for kind in ERROR_KINDS], dtype=float)
        found |= dict(zip((f"{kind}_error" for kind in ERROR_KINDS), percent))
        found |= {one.quantity: np.nan for plot in PLOTS.values() for one in plot.series if not met.get(one.needs, True)}
        row = np.array([found[name] for name in QUANTITIES], dtype=float)
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
    largest = np.argsort(-np.fmax.reduce(history.high[:, own], axis=0, initial=0.0), kind="stable")[: len(CURVE_COLOURS)]
    names = [history.columns[own[k]] for k in sorted(largest)]
    return tuple(Series(name.removeprefix(kind), colour, "", name) for name, colour in zip(names, CURVE_COLOURS))


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
        return {name: PLOTS[name]._replace(series=series) for name, series in kept.items() if series}

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
        errors = self._sim.error_so_far if self._errors else None
        self.history.take(report, seconds, self.enabled, errors, **self._by_name())

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
