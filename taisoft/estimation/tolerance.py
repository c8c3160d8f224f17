"""Runs to a tolerance: trials (`trials`) choose integrator and dt, and give the error of the run.

Trials go from coarse to fine (`refinement`), until one meets the tolerance or they show how many steps the run needs: at most
three times as many explicit ones, or eight times as many implicit ones. Explicit steps cannot be coarser than stable, with which
they begin. A trial that meets the tolerance is the run, which is repeated only if frames or steps are observed, or an
estimate by companions is asked for.

Which kind of steps a run takes follows from counts (`costs`). Explicit steps are accepted at once where they cost less than
implicit ones could, and an implicit trial ends when its steps cost more than explicit ones would. Among implicit methods BDF2
is used: it is of second order, has contacts, and damps what its steps cannot resolve.

Weak: trials do not show what is faster than all of them (`vibrations`). Where their paths diverge, no step meets the
tolerance.
"""

import math
import time
import warnings
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

from taisoft.errors import SimulationError, collected_warnings
from taisoft.estimation.costs import Spent, budget, explicit_step, implicit_step
from taisoft.estimation.first_choice import EXPLICIT, IMPLICIT, stable_steps
from taisoft.estimation.order import is_smooth, may_jump, nominal_order
from taisoft.estimation.refinement import SMALLER, Refinement, implicit_sizes
from taisoft.estimation.trials import Part, Recorder, Trial, distances, make_frames
from taisoft.estimation.vibrations import ERROR as VIBRATIONS
from taisoft.estimation.vibrations import add_vibrations, are_passed_over
from taisoft.records import BodyError, ErrorEstimate, RunReport
from taisoft.running import RunRequest, run_steps
from taisoft.scene.scene import Scene
from taisoft.stability import stable_dt

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

DEARER = 4.0  # cost of explicit steps, over that of implicit ones that cannot meet the tolerance, at most
TWO_TRIALS = 2.25  # cost of explicit steps with their trials, over that of the first one, at least
LEAST_FRAMES, MOST_FRAMES = 16, 64  # at which trials are compared where a run has few, or every step is one


class Stopped(Exception):
    """`stop` ended a trial."""


def run_to_tolerance(sim: "Simulator", request: RunRequest) -> RunReport:
    """Carry out a run of a simulator with a tolerance.

    Raises SimulationError while a body is dragged, and for a mesh that errors cannot be estimated with.
    """
    _check_run(sim, request.error_mesh)
    report, clock, compiled = RunReport(), time.perf_counter(), sim.compile_seconds
    chooser = Chooser(sim, request)
    try:
        with report.failing("the trials"):
            steps = chooser.choose()
    except Stopped:
        report.interrupted = True
        report.degrade("the run was interrupted during its trials: nothing was simulated")
    trial_seconds = time.perf_counter() - clock - (sim.compile_seconds - compiled)
    if report.problems:
        report.trial_seconds, report.compile_seconds = trial_seconds, sim._take_compile_seconds() + chooser.compile_seconds
        return report
    note = f"note: {chooser.describe(steps)}"
    if chooser.may_adopt(steps):
        report = chooser.adopt()
        trial_seconds -= report.wall_seconds
    else:
        report = chooser.run(steps)
    report.trial_seconds = trial_seconds
    report.compile_seconds += sim._take_compile_seconds() + chooser.compile_seconds
    report.problems.insert(0, note)
    if report.status != "failed" and not report.interrupted:
        _check_error(sim.settings.tolerance, report)
    return report


def _check_run(sim: "Simulator", mesh: str | Scene | None) -> None:
    if sim.dragged is not None:
        raise SimulationError("a body is being dragged: a run to a tolerance needs it released, since its trials are others")
    if mesh is not None:
        from taisoft.estimation.companions import other_mesh  # loads modules that most runs do not need

        other_mesh(sim, mesh)


def _check_error(tolerance: float, report: RunReport) -> None:
    """Degrade a run whose error, in time and of the solvers where it is known, may be above the tolerance."""
    estimate = report.error_estimate
    error = None if estimate.time is None else estimate.time + (estimate.solver or 0.0)
    if error is not None and error <= tolerance:
        return
    found = "unknown" if error is None else f"estimated at {100.0 * error:.2g} %"
    report.degrade(f"the error in time is {found}, and the tolerance is {100.0 * tolerance:.3g} %")


class Chooser:
    """Chooses how a simulator carries out a run.

    A frame of the trials is a whole part of one of the run, so that there are at least LEAST_FRAMES.
    """

    def __init__(self, sim: "Simulator", request: RunRequest):
        self._sim, self._request, seconds, fps = sim, request, request.seconds, request.fps
        self._tolerance = sim.settings.tolerance
        self._parts = 1 if fps is None else max(1, math.ceil(LEAST_FRAMES / (seconds * fps)))  # of a frame of the run
        self._frames = make_frames(sim, seconds, seconds / MOST_FRAMES if fps is None else 1.0 / (fps * self._parts))
        self._sudden = sim.touches or may_jump(sim.scene)
        self._last_failure: tuple[float, str] | None = None  # of the last trial, if it failed: when [s], and why
        self.compile_seconds = 0.0  # of the trials [s]
        self.refinement = self._refinement()

    def _refinement(self) -> Refinement:
        sim = self._sim
        integrator = sim.settings.integrator
        impacts = sim.touches and not may_jump(sim.scene) and is_smooth(sim.scene, touches=False)
        return Refinement(integrator, self._sudden, nominal_order(integrator, sim.scene, sim.touches), self._frames, impacts)

    # --- choosing -----------------------------------------------------------------------------------------------------

    def choose(self) -> int:
        """Run trials, set the simulator's integrator, and return the steps of the run in the time of a frame.

        If they are interrupted or fail, the simulator keeps its own.
        """
        sim, steps, given = self._sim, None, (self._sim.settings.integrator, self._sim.dt)
        limit = sim.stable_dt if sim.settings.integrator == EXPLICIT else stable_dt(sim.scene, verlet=True)
        least = stable_steps(limit, self._frames.seconds)
        explicit = least * explicit_step(sim.scene, sim.touches)
        try:
            if explicit > implicit_step(sim.scene, sim.touches):
                steps = self._by_implicit_trials(explicit)
            return self._by_explicit_trials(least) if steps is None else steps
        except BaseException:
            self._use(*given)
            raise

    def _use(self, integrator: str, dt: float) -> None:
        """Let the simulator have an integrator, and begin its refinement."""
        if self._sim.settings.integrator != integrator:
            with collected_warnings():  # the simulator has given them
                self._sim._replace(integrator=integrator, dt=dt)
        self.refinement = self._refinement()

    def _by_implicit_trials(self, explicit: float) -> int | None:
        """Steps in the time of a frame; None if explicit ones, at a cost of `explicit` [us] a frame, are cheaper."""
        self._use(IMPLICIT, self._frames.seconds)
        sim, refinement = self._sim, self.refinement
        for per_frame in implicit_sizes(self._frames.count):
            steps = float(per_frame) * self._frames.count
            add_cost = budget(sim.scene, sim.touches, explicit / max(1.0, float(per_frame)), steps)
            try:
                refinement.add(self._trial(per_frame, on_step=add_cost))
            except Spent:
                return None
            needed = refinement.steps_needed(self._tolerance)
            last = refinement.trials[-1] if refinement.trials else None
            cost = implicit_step(sim.scene, sim.touches, last and last.counts_per_step())
            if self._passes_over_vibrations() and last.per_frame >= 1 and len(refinement.trials) > 1:
                if self._is_worth(explicit, cost):
                    return None
                needed = needed or self._last_steps()
            likely = max(1, per_frame) if refinement.are_few else refinement.likely_steps(self._tolerance)
            if (needed or likely) * cost > explicit:
                return None
            if needed is not None or refinement.is_over:
                return needed or self._last_steps()

    def _passes_over_vibrations(self) -> bool:
        """Whether steps of the last trial cannot meet the tolerance: they pass over vibrations of bodies that touch in it."""
        last = self.refinement.trials[-1] if self.refinement.trials and self._tolerance < VIBRATIONS else None
        return bool(last and last.touches) and are_passed_over(self._sim.scene, self._dt(max(Fraction(1), last.per_frame)))

    def _is_worth(self, explicit: float, cost: float) -> bool:
        """Whether explicit steps, at a cost of `explicit` [us] a frame, and their trials are worth it where implicit ones cannot
        meet the tolerance: at most DEARER than the cheapest of these, one a frame, and with their trials at most DEARER than
        these, of `cost` [us] each, would be without vibrations."""
        if explicit > DEARER * implicit_step(self._sim.scene, self._sim.touches):
            return False
        steps = max(1.0, float(self.refinement.trials[-1].per_frame) * self.refinement.steps_over_last(self._tolerance))
        return TWO_TRIALS * explicit <= DEARER * steps * cost

    def _dt(self, per_frame: Fraction | int) -> float:
        """Step [s] of so many in the time of a frame."""
        return self._frames.seconds / float(per_frame)

    def _by_explicit_trials(self, least: int) -> int:
        """Explicit steps in the time of a frame."""
        self._use(EXPLICIT, self._dt(least))
        refinement, per_frame = self.refinement, Fraction(least)
        refinement.add(self._trial(per_frame, keeps=refinement.is_damped))
        if refinement.is_damped and refinement.meets(self._tolerance):
            refinement.confirm(self._trial(Fraction(math.ceil(SMALLER * least)), part=refinement.trials[0].fastest))
        while (steps := refinement.steps_needed(self._tolerance)) is None and not refinement.is_over:
            per_frame = refinement.next_steps(self._tolerance, per_frame)
            refinement.add(self._trial(per_frame))
        return steps or self._last_steps()

    def _last_steps(self) -> int:
        """Steps of the last trial that did not fail. Raises SimulationError if all did."""
        if not self.refinement.trials:
            raise SimulationError(f"every trial failed, the last one because of {self._last_failure[1]}")
        return math.ceil(self.refinement.trials[-1].per_frame)

    def _trial(self, per_frame: Fraction, part: Part | None = None, **options) -> Trial:
        """Run a trial, see `Frames.trial`.

        Raises SimulationError if it and the one before fail: smaller steps do not help.
        """
        trial = self._frames.trial(self._sim, per_frame, self._request.stop, part, **options)
        report, before = trial.report, self._last_failure
        self.compile_seconds += report.compile_seconds
        if report.interrupted:
            raise Stopped
        if part is not None:  # whether a part fails does not count
            return trial
        self._last_failure = (report.sim_seconds, report.problems[-1]) if report.status == "failed" else None
        if before and self._last_failure and abs(report.sim_seconds - before[0]) <= self._frames.seconds:
            raise SimulationError(report.problems[-1])
        return trial

    def describe(self, steps: int) -> str:
        """What was chosen, in a sentence."""
        chosen = f"{self._sim.settings.integrator}, dt = {self._dt(steps):.4g} s"
        return f"for a tolerance of {100.0 * self._sim.settings.tolerance:.3g} %: {chosen}, by trials with {self._trial_steps()}"

    def _trial_steps(self) -> str:
        return ", ".join(f"dt = {self._dt(p.per_frame):.4g} s" for p in self.refinement.trials)

    # --- the run --------------------------------------------------------------------------------------------------------

    def may_adopt(self, steps: int) -> bool:
        """Whether the last trial had the steps and the frames of the run, which nothing observes."""
        asked, same = self._request, self.refinement.trials[-1].per_frame == steps and self._parts == 1
        return same and asked.fps is not None and asked == RunRequest(asked.seconds, asked.fps, asked.stop)

    def adopt(self) -> RunReport:
        """Let the last trial be the run: take the state at its end, and its report and warnings."""
        trial, sim = self.refinement.trials[-1], self._sim
        sim._dynamics.restore(trial.end)
        for text in trial.warned:
            warnings.warn(text, UserWarning, stacklevel=5)
        sim._may_soften = sim._may_soften and not trial.warned
        self.compile_seconds -= trial.report.compile_seconds
        trial.report.error_estimate = self.estimate(trial)
        self._add_vibrations(trial.report.error_estimate, trial)
        return trial.report

    def run(self, steps: int) -> RunReport:
        """Run the simulator with steps in the time of a frame."""
        sim, asked = self._sim, self._request
        made = Trial(sim.settings.integrator, Fraction(steps))
        recorder = Recorder(made, self._frames, Fraction(1, steps) if asked.fps is None else Fraction(self._parts))

        def frame(sim: "Simulator", index: int, report) -> None:
            recorder.frame(sim, index, report)
            if asked.on_frame is not None:
                asked.on_frame(sim, index, report)

        sim.dt = self._dt(steps)
        before = sim._host().changes
        report = run_steps(sim, replace(asked, on_frame=frame))
        estimate = self.estimate(made)
        if sim._host().changes != before or sim.dragged is not None:
            estimate = ErrorEstimate(notes=["the errors are unknown: state or numbers were changed during the run"])
        if report.error_estimate is None or (report.error_estimate.time is None and estimate.time is not None):
            estimate.solver = report.error_estimate and report.error_estimate.solver
            report.error_estimate = estimate
        self._add_vibrations(report.error_estimate, made)
        return report

    def estimate(self, run: Trial) -> ErrorEstimate:
        """The error in time of a run, from its distance to the last trial with larger steps; if there is none, as expected."""
        refinement, bodies = self.refinement, self._sim.scene.bodies
        made = ErrorEstimate(
            bodies={body.name: BodyError() for body in bodies}, companions=[f"trials with {self._trial_steps()}"]
        )
        last = refinement.trials[-1]
        made.excursion = refinement.excursion(run if len(run.positions) > 1 else last)
        if made.excursion == 0.0:
            made.time = 0.0
            made.notes.append("nothing moves but by rounding")
        elif refinement.diverges:
            made.notes.append("the error in time is unknown: the paths of different steps diverge")
        elif len(run.positions) < 2 or not (coarser := [one for one in refinement.trials if one.per_frame < run.per_frame]):
            made.time = refinement.error
            if len(refinement.trials) == 1:
                made.notes.append(
                    "the error in time is expected from velocities or nearly equal steps, and may be wrong by a factor of ten"
                )
        else:
            made.order, ratio = refinement.order, float(run.per_frame / coarser[-1].per_frame)
            errors = refinement.error_over_difference(ratio) * distances(run, coarser[-1]).max(axis=0) / made.excursion
            for k, body in enumerate(made.bodies.values()):
                body.time = float(errors[self._frames.bodies == k].max(initial=0.0))
            made.time = float(errors.max())
        return made

    def _add_vibrations(self, estimate: ErrorEstimate, run: Trial) -> None:
        """Add to an estimate, of trials or companions, what implicit steps of bodies that touch do not show."""
        if self.refinement.trials[-1].touches and run.integrator == IMPLICIT:
            add_vibrations(estimate, self._sim.scene, self._dt(run.per_frame))
