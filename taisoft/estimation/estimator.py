"""Estimates the error of a run while it runs, from companions that keep step with it (`companions`, `order`).

In time: two companions with twice and four times the step show the observed order, and cost three quarters of the run. Where
explicit steps would be unstable, or the run has few steps, one companion has half the step; the order is then assumed to be the
nominal one, on which the estimate depends little. Of the solvers: a companion with tighter tolerances. In space: a companion on
another mesh.

Companions and run are compared at the last step of every frame at which all of them meet. Differences are reduced to their
maximum over the nodes of each body, and to sums of squares. The order is that of the root mean square over nodes and times, which
chance affects less than maxima. If the paths of different steps part, so do those of all companions: the errors are known only up
to then.

Weak: twice the step may miss what happens within it; an error that all companions share, such as contacts that none of them
finds, is not seen. Rounding is not estimated.
"""

import dataclasses
import time
from typing import TYPE_CHECKING

import numpy as np

from taisoft.dynamics.schemes import SECOND_ORDER
from taisoft.errors import collected_warnings
from taisoft.estimation import quantities
from taisoft.estimation.companions import TIGHTER, Companion, on_mesh, other_steps, tighter
from taisoft.estimation.comparison import Differences
from taisoft.estimation.order import MESH_ORDER, MIN_ORDER, agreement, error_over_difference, nominal_order, observed_order
from taisoft.ranges import owners
from taisoft.records import BodyError, Energies, ErrorEstimate, Quantity
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

SOLVER_ORDER = 1  # errors are about proportional to the tolerances
SOLVER_FACTOR = error_over_difference(TIGHTER, SOLVER_ORDER)
PARTED = 0.1  # with one companion: difference, over the excursion, above which paths may have parted for good
NEGLIGIBLE = {"f32": 1e-6, "f64": 1e-9}  # differences, over the excursion, that are rounding
SOLVED = 0.01  # differences, over the excursion and Newton's tolerance, that come from this


class ErrorEstimator:
    """Companions of a run of `steps` steps. Call `compare` at steps for `next_comparison`; `estimate` gives the errors so far.

    mesh: see `companions.on_mesh`; measured: the quantities of `set_errors`. Raises SceneError or SimulationError if a companion
    cannot be made.
    """

    def __init__(self, sim: "Simulator", steps: int, mesh: str | Scene | None, measured: dict[str, quantities.Definition]):
        begin, compiled = time.perf_counter(), sim.compile_seconds
        self._sim, self._first, self._given = sim, sim.step_count, (sim._host().changes, sim.dt)
        self._changed = ""
        self._companions: list[Companion] = []
        self._others: dict[str, tuple[Companion, np.ndarray]] = {}  # of solver and mesh, and errors over differences (n_bodies,)
        self._differences: dict[Companion, Differences] = {}
        self.times: list[float] = []
        self._made: ErrorEstimate | None = None  # since the last comparison
        self._samples = quantities.Samples(measured)
        bodies = sim.scene.bodies
        self._sizes = np.array([b.n_nodes for b in bodies])
        self._bodies = owners(self._sizes)
        self._start = sim.positions()
        self._excursion = 0.0
        self._energies = np.zeros(4)  # differences to the first companion at the last comparison [J]
        # per comparison: mean positions of the bodies, of the run and its first companion
        self._means: list[list[np.ndarray]] = []
        try:
            with collected_warnings():  # the run has given them
                self._make_companions(steps, mesh)
        except BaseException:
            self.close()
            raise
        self.wall_seconds = time.perf_counter() - begin - (sim.compile_seconds - compiled)

    def _make_companions(self, steps: int, mesh: str | Scene | None) -> None:
        """Make the companions: first that on another mesh, since it may be refused, then those of other steps and tolerances."""
        sim = self._sim
        of_mesh = {}
        if mesh is not None:
            one, ratios = on_mesh(sim, mesh)
            soft = [ratio for body, ratio in zip(sim.scene.bodies, ratios) if not isinstance(body, RigidBody)]
            nearest = min((abs(np.log(ratio or 1.0)), ratio) for ratio in soft)[1] if soft else None  # to 1: the largest error
            self._width = nearest and [nearest]
            factors = [error_over_difference(r, MESH_ORDER) if r else 1.0 for r in ratios]  # 1: the order differs, not the width
            of_mesh = {"space": (self._add(one), np.array(factors))}
        self._in_time = [self._add(one) for one in other_steps(sim, steps)]
        tight = tighter(sim)
        of_solver = {} if tight is None else {"solver": (self._add(tight), np.full(len(self._sizes), SOLVER_FACTOR))}
        self._others = of_solver | of_mesh
        self._stride = max(one.per for one in self._in_time)
        if len(self._in_time) > 1:
            self._between = Differences(self._bodies)  # of the two companions

    def _add(self, one: Companion) -> Companion:
        """Add a companion, and return it."""
        self._companions.append(one)
        self._differences[one] = Differences(self._bodies[one.own])
        return one

    def next_comparison(self, end: int) -> int:
        """The step count at which to call `compare` before `end`, or else `end` itself."""
        latest = end - (end - self._first) % self._stride
        return latest if latest > self._sim.step_count else end

    def compare(self) -> None:
        """Let the companions follow, and compare, if the run is at a whole step of all."""
        steps = self._sim.step_count - self._first
        if self._changed or not steps or steps % self._stride:
            return
        self._changed = self._change()
        if self._changed:
            self._made = None  # an estimate read before the change
            return
        begin, compiled = time.perf_counter(), self._sim.compile_seconds
        with collected_warnings():  # of companions, not of the run
            for one in self._companions:
                one.follow(steps)
        self._compare()
        self._samples.add(self._sim, self._companions)
        self.wall_seconds += time.perf_counter() - begin - (self._sim.compile_seconds - compiled)

    def _change(self) -> str:
        """Why companions cannot follow any more; "" if they can."""
        if self._sim.dragged is not None:
            return "the run was dragged"
        now = self._sim._host().changes, self._sim.dt
        return "" if now == self._given else "its state or numbers were changed meanwhile"

    def _compare(self) -> None:
        x = self._sim.positions()
        self._excursion = max(self._excursion, float(np.sqrt(((x - self._start) ** 2).sum(axis=1).max())))
        self.times.append(self._sim.time)
        found = {one: one.positions() for one in self._companions if not one.failed}
        for one, other in found.items():
            self._differences[one].add(x[one.own], other)
        self._made = None
        if any(one.failed for one in self._in_time):
            return
        first = found[self._in_time[0]]
        if len(self._in_time) > 1:
            self._between.add(first, found[self._in_time[1]])
        pair = [dataclasses.astuple(sim.energies()) for sim in (self._sim, self._in_time[0].sim)]
        self._energies = np.subtract(*pair)
        self._means.append([self._body_means(path) for path in (x, first)])

    def _body_means(self, x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x, np.cumsum(self._sizes) - self._sizes) / self._sizes[:, None]

    def nodal_errors(self) -> np.ndarray:
        """Estimated errors of all nodes at the last comparison (n_nodes,) [m], of all kinds added; NaN if one is unknown."""
        found = np.zeros(len(self._bodies))
        count = 0 if self._changed or self._change() else self._agreeing()
        factor = self._time_factor(count)[0] if 0 < count == len(self.times) else None
        if factor is None:
            return np.full(len(found), np.nan)
        for one, scales in ((self._in_time[0], np.full(len(self._sizes), factor)), *self._others.values()):
            errors = np.full(len(found), np.nan)
            if not one.failed:
                errors[one.own] = scales[self._bodies[one.own]] * self._differences[one].map
            found += errors
        return found

    def _time_factor(self, k: int) -> tuple[float | None, float | None]:
        """Error in time over the difference to the first companion, and order, from the first k comparisons; None if unknown."""
        if any(one.failed for one in self._in_time):
            return None, None
        fine = self._differences[self._in_time[0]]
        if len(self._in_time) == 1:
            order = float(nominal_order(self._sim.settings.integrator, self._sim.scene, self._sim.touches))
            return error_over_difference(self._in_time[0].ratio, order), order
        near, far = (float(np.sqrt(np.mean(d.squares[:k]))) for d in (fine, self._between))
        if near <= self._negligible:
            return error_over_difference(2.0, MIN_ORDER), None
        order = observed_order(near, far, 2.0 if self._sim.settings.integrator in SECOND_ORDER else 1.0)
        return (None, None) if order is None else (error_over_difference(2.0, order), order)

    @property
    def _negligible(self) -> float:
        """Difference that shows no order [m]."""
        return self._rounding * self._excursion

    @property
    def _rounding(self) -> float:
        settings = self._sim.settings
        solved = 0.0 if settings.explicit else settings.newton_tolerance or 0.0
        return max(NEGLIGIBLE[settings.precision], SOLVED * solved)

    def estimate(self) -> ErrorEstimate:
        """The estimate of the run so far."""
        changed = self._changed or self._change()
        if self._made is None or changed != self._changed:
            self._changed, self._made = changed, self._estimate_all(changed)
        return self._made

    def set_errors(self, found: dict[str, Quantity]) -> None:
        """Set the errors of quantities, which were measured at the end of the run."""
        if self._changed or self._change() or not self.times:
            for quantity in found.values():
                quantity.notes += self.estimate().notes
            return
        settings, levels = self._sim.settings, {}
        nominal = nominal_order(settings.integrator, self._sim.scene, self._sim.touches)
        most = 2.0 if settings.integrator in SECOND_ORDER else 1.0
        if "solver" in self._others:
            levels["solver"] = [self._others["solver"][0]], [TIGHTER], SOLVER_ORDER, SOLVER_ORDER
        levels["time"] = self._in_time, [one.ratio for one in self._in_time], nominal, most
        if "space" in self._others:
            levels["space"] = [self._others["space"][0]], self._width, quantities.MESH_ORDER, quantities.MESH_ORDER
        self._samples.set_errors(found, levels, self._sim.time, self._rounding)

    def _estimate_all(self, changed: str) -> ErrorEstimate:
        made = ErrorEstimate(excursion=self._excursion, wall_seconds=self.wall_seconds)
        made.bodies = {body.name: BodyError() for body in self._sim.scene.bodies}
        if changed:
            made.notes.append(f"the errors are unknown: {changed}")
        elif not self.times or self._excursion == 0.0:
            why = "nothing moves" if self.times else f"the run has fewer than {self._stride} steps"
            made.notes.append(f"the errors are unknown: {why}")
        else:
            self._estimate_time(made)
            for kind, (one, factors) in self._others.items():
                self._estimate(made, kind, one, factors)
            if "solver" not in self._others:
                made.solver = 0.0  # nothing is solved
        made.companions = [one.what for one in self._companions]
        return made

    def _estimate(self, made: ErrorEstimate, kind: str, one: Companion, factors: np.ndarray) -> None:
        """Set one kind of error from the differences to a companion, or note the reason that it is unknown."""
        if one.failed:
            made.notes.append(f"the error of {kind} is unknown: its companion ({one.what}) failed: {one.failed}")
            return
        if one.unconverged:
            made.notes.append(f"of the companion with {one.what}, {one.unconverged} of {one.reports} steps did not converge")
        count = self._agreeing()
        if 0 < len(self.times) != count:  # then these differences come from parted paths too
            made.notes.append(f"the error of {kind} is unknown, since the paths part")
            return
        errors = factors * self._differences[one].largest() / self._excursion
        for body, value in zip(made.bodies.values(), errors):
            setattr(body, kind, float(value))
        setattr(made, kind, float(errors.max()))

    def _estimate_time(self, made: ErrorEstimate) -> None:
        """Set the error in time; where the paths part, only that until then."""
        failed = [one for one in self._in_time if one.failed]
        if failed:
            made.notes.append(f"the error in time is unknown: the companion with {failed[0].what} failed: {failed[0].failed}")
            return
        count = self._agreeing()
        factor, made.order = self._time_factor(count) if count else (None, None)
        one = self._in_time[0]
        if count == len(self.times) and factor is not None:
            self._estimate(made, "time", one, np.full(len(self._sizes), factor))
            sign = 1.0 if one.ratio < 1.0 else -1.0  # the exact path lies beyond the finer one
            made.energies = Energies(*(sign * factor * self._energies).tolist())
            return
        if factor is not None:
            made.agree_until = self.times[count - 1]
            made.time_until_then = float(factor * self._differences[one].largest(count).max() / self._excursion)
            made.spread_after = self._spread(count)
        when = f"after t = {made.agree_until:.4g} s" if made.agree_until is not None else "from the start"
        parted = "the paths of different steps part"
        if len(self._in_time) == 1:
            parted = f"with half the step some node is over {PARTED:.0%} of the largest excursion away"
        made.notes.append(f"the error in time is unknown: {parted} {when}")

    def _agreeing(self) -> int:
        """Number of comparisons over which the paths of different steps agree; all of them if a companion failed."""
        if not self.times or any(one.failed for one in self._in_time):
            return len(self.times)
        fine = self._differences[self._in_time[0]]
        if len(self._in_time) > 1:
            return agreement(np.array(fine.squares), np.array(self._between.squares), self._negligible**2)
        parted = np.flatnonzero(np.max(fine.maxima, axis=1) > PARTED * self._excursion)
        return int(parted[0]) if len(parted) else len(fine.maxima)

    def _spread(self, count: int) -> dict[str, float]:
        """Per body: distance of its mean positions in the two runs after the first `count` comparisons, over the excursion."""
        run, one = (np.mean([means[k] for means in self._means[count:]], axis=0) for k in (0, 1))
        apart = np.linalg.norm(run - one, axis=1) / self._excursion
        return {body.name: float(value) for body, value in zip(self._sim.scene.bodies, apart)}

    def close(self) -> None:
        """Release the companions' memory; a second call does nothing."""
        while self._companions:
            self._companions.pop().sim.close()
