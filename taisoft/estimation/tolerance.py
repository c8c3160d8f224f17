"""Runs to a tolerance: pilots (`pilots`) choose integrator and dt, and show the error of the run.

Implicit pilots are a ladder, each with half the step of the one before, that ends where the run needs at most REACH times as
many steps as the last pilot. How many follows from the difference of the last two and its observed order. Explicit steps cannot
be coarser than stable. Their first pilot has the largest stable step; from its velocities alone follows an expected error. Where
velocities may jump, a second pilot with a slightly smaller step must agree with it. If the error is not small enough, a ladder
follows. A pilot that meets the tolerance is the run, which is repeated only if frames or
steps are observed, or an estimate by twins is asked for.

Which kind of steps a run takes follows from counts (`costs`). Explicit steps are accepted at once where they cost less than
implicit ones could. Among implicit methods BDF2 is used: it is of second order, has contacts, and damps what its steps cannot
resolve.

Weak: what is faster than all pilots is not seen. Where the paths of the pilots part, no step meets the tolerance. The expected
error of a single explicit pilot may be wrong by a factor of ten.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from taisoft.errors import SimulationError, no_memory
from taisoft.estimation.costs import explicit_step, implicit_step
from taisoft.estimation.first_choice import EXPLICIT, IMPLICIT, stable_steps
from taisoft.estimation.order import MIN_ORDER, error_over_difference, observed_order
from taisoft.estimation.pilots import Pilot, Recorder, RunFunction, distances, make_frames
from taisoft.records import BodyError, ErrorEstimate, RunReport
from taisoft.scene.scene import Scene
from taisoft.stability import stable_dt

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

SAFETY = 0.8  # part of the tolerance that a predicted error may take
REACH = 8  # steps of the run over those of the last pilot, at most
FEWEST = {EXPLICIT: 2, IMPLICIT: 3}  # pilots that show an error: coarse implicit steps may agree and be wrong
LARGEST_STEP = 4  # frames in a step of the first implicit pilot
LEAST_STEPS = 8  # of a pilot
MAX_PILOTS = 8
MAX_PASSED = 2  # pilots that meet the tolerance but are degraded, and are passed over for a finer one
MAX_PARTED = 2  # pilots in succession whose differences have not become smaller: the paths part
COARSE = 2  # implicit pilots with fewer steps a frame do not count as parted
SECOND_PILOT = Fraction(5, 4)  # its steps over those of the first, where velocities may jump
DISPERSION, IMPACT = 3.0, 1.25  # factors on the errors that velocities show: see `Ladder.expected_error`
UNITS = 64  # parts of a run that count as frames where every step is one


def run_to_tolerance(
    sim: "Simulator", run: RunFunction, seconds: float, fps: float | None, stop: Callable[[], bool] | None, **observers
) -> RunReport:
    """Run a simulator with a tolerance by `run` (`running.run_steps`). observers: further arguments of it."""
    report, clock, compiled = RunReport(), time.perf_counter(), sim.compile_seconds
    chooser = Chooser(sim, run, seconds, fps, stop)
    try:
        steps = chooser.choose()
    except KeyboardInterrupt:
        report.interrupted, report.status = True, "degraded"
        report.problems.append("the run was interrupted during its pilots: nothing was simulated")
    except (SimulationError, MemoryError) as failure:
        report.status = "failed"
        report.problems.append(str(no_memory("the pilots", failure) if isinstance(failure, MemoryError) else failure))
    pilot_seconds = time.perf_counter() - clock - (sim.compile_seconds - compiled)
    if report.problems:
        report.pilot_seconds, report.compile_seconds = pilot_seconds, sim._take_compile_seconds() + chooser.compile_seconds
        return report
    note = f"note: {chooser.describe(steps)}"
    if chooser.is_run(steps) and fps is not None and not any(observers.values()):
        report = chooser.take_over()
        pilot_seconds -= report.wall_seconds
        report.error_estimate = chooser.estimate(chooser.ladder.pilots[-1])
    else:
        report = chooser.run(steps, **observers)
    report.pilot_seconds = pilot_seconds
    report.compile_seconds = sim._take_compile_seconds() + chooser.compile_seconds + report.compile_seconds
    report.problems.insert(0, note)
    _check(sim.settings.tolerance, report)
    return report


def _check(tolerance: float, report: RunReport) -> None:
    """Degrade a run whose error in time is not known to meet the tolerance."""
    error = report.error_estimate.time
    if error is not None and error <= tolerance:
        return
    found = "unknown" if error is None else f"estimated at {100.0 * error:.2g} %"
    report.problems.append(f"the error in time is {found}, and the tolerance is {100.0 * tolerance:.3g} %")
    if report.status == "ok":
        report.status = "degraded"


@dataclass
class Ladder:
    """Pilots of one integrator, from coarse to fine.

    error: of the last one, over the excursion, None if unknown; order: observed; parted: see MAX_PARTED; tried: pilots, with
    failed ones.
    """

    integrator: str
    sudden: bool  # whether velocities may jump
    frame: float  # [s]
    pilots: list[Pilot] = field(default_factory=list)
    error: float | None = None
    order: float = 1.0
    parted: int = 0
    passed: int = 0  # see MAX_PASSED
    tried: int = 0
    differences: list[float] = field(default_factory=list)  # root mean squares of the distances between successive pilots [m]

    def add(self, pilot: Pilot) -> None:
        """Add a pilot with half the step of the last one, and estimate its error. Those that fail are left out."""
        self.tried += 1
        if pilot.report.status == "failed":
            return
        self.pilots.append(pilot)
        if len(self.pilots) == 1:
            self.error = self._expected_error(pilot) if self.integrator == EXPLICIT and not self.sudden else None
            return
        apart, excursion = distances(pilot, self.pilots[-2]), pilot.excursion
        self.differences.append(float(np.sqrt(np.mean(apart**2))))
        self.order = self._observed_order()
        self.error = float(apart.max()) * error_over_difference(2.0, self.order) / excursion if excursion else 0.0

    def begin_again(self, pilot: Pilot) -> None:
        """Replace the only pilot by one with a slightly smaller step, and expect its error."""
        self.tried += 1
        if pilot.report.status == "failed":
            return
        before, self.pilots = self.pilots, [pilot]
        excursion = pilot.excursion
        apart = float(distances(pilot, before[0]).max()) / excursion if before and excursion else 0.0
        self.error = max(self._expected_error(pilot), apart)

    def _observed_order(self) -> float:
        """Order of the last three pilots, at least MIN_ORDER; 1 if there are fewer."""
        if len(self.differences) < 2:
            return 1.0
        near, far = self.differences[-1], self.differences[-2]
        stalled = near > 0.0 and near >= max(self.differences[-3:-1]) * 0.5**MIN_ORDER
        counts = self.integrator == EXPLICIT or self.pilots[-1].per_frame >= COARSE
        self.parted = self.parted + 1 if stalled and counts else 0
        return observed_order(near, far, 2.0) or MIN_ORDER

    def _expected_error(self, pilot: Pilot) -> float:
        """Error of an explicit pilot, over the excursion, from its velocities.

        Velocity Verlet solves x'' = a + dt^2/12 x'''' up to dt^4: a motion of frequency w lags by the phase (w dt)^2/24 w t,
        which is dt^2/24 times the total variation of its acceleration. An impact may be late by dt.
        """
        excursion, dt = pilot.excursion, self.frame / float(pilot.per_frame)
        if excursion == 0.0:
            return 0.0
        error = dt * dt / 24.0 * (float(np.max(pilot.variations)) + 2.0 * pilot.jump) / self.frame
        return (max(error, IMPACT * dt * pilot.jump) if self.sudden else DISPERSION * error) / excursion

    @property
    def is_over(self) -> bool:
        """Whether no further pilot makes sense."""
        return self.tried >= MAX_PILOTS or self.parted >= MAX_PARTED

    def enough(self, tolerance: float) -> int | None:
        """Steps of the run in the time of a frame, if the pilots show how many; None if they do not yet."""
        if not self.pilots:
            return None
        last = self.pilots[-1].per_frame
        few = len(self.pilots) < FEWEST[self.integrator]
        if self.error is not None and self.error <= tolerance and (not few or self.integrator == EXPLICIT):
            if self.pilots[-1].report.status == "degraded" and self.passed < MAX_PASSED:
                self.passed += 1
                return None
            return math.ceil(last)
        if few:
            return None
        steps = float(last) * (self.error / tolerance) ** (1.0 / self.order)
        return math.ceil(steps) if steps <= REACH * last else None


class Chooser:
    """Chooses how a simulator runs for `seconds` [s] by `run` (`running.run_steps`). stop, fps: as for `Simulator.run`."""

    def __init__(self, sim: "Simulator", run: RunFunction, seconds: float, fps: float | None, stop: Callable[[], bool] | None):
        self._sim, self._run_steps, self._seconds, self._fps, self._stop = sim, run, seconds, fps, stop
        self._tolerance = SAFETY * sim.settings.tolerance
        self._frames = make_frames(sim, seconds, seconds / UNITS if fps is None else min(1.0 / fps, seconds))
        self._sudden = sim.touches or _releases(sim.scene)
        self.compile_seconds = 0.0  # of the pilots [s]
        self.ladder = self._ladder()

    def _ladder(self) -> Ladder:
        return Ladder(self._sim.settings.integrator, self._sudden, self._frames.seconds)

    # --- choosing -----------------------------------------------------------------------------------------------------

    def choose(self) -> int:
        """Run pilots, set the simulator's integrator, and return the steps of the run in the time of a frame."""
        sim, steps = self._sim, None
        limit = sim.stable_dt if sim.settings.integrator == EXPLICIT else stable_dt(sim.scene, verlet=True)
        least = stable_steps(limit, self._frames.seconds)
        explicit = least * explicit_step(sim.scene, sim.touches)
        if explicit > implicit_step(sim.scene, sim.touches):
            steps = self._by_implicit_pilots(explicit)
        return self._by_explicit_pilots(least) if steps is None else steps

    def _use(self, integrator: str, dt: float) -> None:
        """Let the simulator have an integrator, and begin its ladder."""
        if self._sim.settings.integrator != integrator:
            self._sim.rebuild(integrator=integrator, dt=dt)
        self.ladder = self._ladder()

    def _by_implicit_pilots(self, explicit: float) -> int | None:
        """Steps in the time of a frame; None if explicit ones, at a cost of `explicit` [us] a frame, are cheaper."""
        sim, count = self._sim, self._frames.count
        self._use(IMPLICIT, self._frames.seconds)
        largest = LARGEST_STEP
        while largest > 1 and count < LEAST_STEPS * largest:
            largest //= 2
        per_frame = Fraction(1, largest)
        while per_frame * count < LEAST_STEPS:
            per_frame *= 2
        while True:
            self._add_pilot(per_frame)
            steps, pilots = self.ladder.enough(self._tolerance), self.ladder.pilots
            cost = implicit_step(sim.scene, sim.touches, pilots[-1].counts_per_step() if pilots else None)
            if (steps or 2 * per_frame) * cost > explicit:
                return None
            if steps is not None or self.ladder.is_over:
                return steps or math.ceil(per_frame)
            per_frame *= 2

    def _by_explicit_pilots(self, least: int) -> int:
        """Explicit steps in the time of a frame."""
        self._use(EXPLICIT, self._frames.seconds / least)
        per_frame = Fraction(least)
        if self._sudden:
            self._add_pilot(per_frame)
            per_frame = Fraction(math.ceil(SECOND_PILOT * least))
            self.ladder.begin_again(self._pilot(per_frame))
            steps = self.ladder.enough(self._tolerance)
            if steps is not None:
                return steps
            per_frame *= 2
        while True:
            self._add_pilot(per_frame)
            steps = self.ladder.enough(self._tolerance)
            if steps is not None or self.ladder.is_over:
                return steps or math.ceil(per_frame)
            per_frame *= 2

    def _add_pilot(self, per_frame: Fraction) -> None:
        self.ladder.add(self._pilot(per_frame))

    def _pilot(self, per_frame: Fraction) -> Pilot:
        pilot = self._frames.pilot(self._sim, per_frame, self._stop, self._run_steps)
        self.compile_seconds += pilot.report.compile_seconds
        if pilot.report.interrupted:
            raise KeyboardInterrupt
        return pilot

    def describe(self, steps: int) -> str:
        """What was chosen, in a sentence."""
        chosen = f"{self._sim.settings.integrator}, dt = {self._frames.seconds / steps:.4g} s"
        return f"for a tolerance of {100.0 * self._sim.settings.tolerance:.3g} %: {chosen}, by pilots with {self._pilots()}"

    def _pilots(self) -> str:
        return ", ".join(f"dt = {self._frames.seconds / float(p.per_frame):.4g} s" for p in self.ladder.pilots)

    # --- the run --------------------------------------------------------------------------------------------------------

    def is_run(self, steps: int) -> bool:
        """Whether the last pilot had the steps of the run."""
        return bool(self.ladder.pilots) and self.ladder.pilots[-1].per_frame == steps

    def take_over(self) -> RunReport:
        """Let the simulator have the state at the end of the last pilot; return its report."""
        self._sim._dynamics.restore(self.ladder.pilots[-1].end)
        self.compile_seconds -= self.ladder.pilots[-1].report.compile_seconds
        return self.ladder.pilots[-1].report

    def run(self, steps: int, on_frame=None, **observers) -> RunReport:
        """Run the simulator with steps in the time of a frame. observers: further arguments of `running.run_steps`."""
        sim = self._sim
        made = Pilot(sim.settings.integrator, Fraction(steps))
        recorder = Recorder(made, self._frames, Fraction(1, steps) if self._fps is None else Fraction(1))

        def frame(sim: "Simulator", index: int, report) -> None:
            recorder.frame(sim, index, report)
            if on_frame is not None:
                on_frame(sim, index, report)

        sim.dt = self._frames.seconds / steps
        report = self._run_steps(sim, self._seconds, frame, self._fps, self._stop, **observers)
        if report.error_estimate is None:
            report.error_estimate = self.estimate(made)
        return report

    def estimate(self, run: Pilot) -> ErrorEstimate:
        """The error in time of a run, from its distance to the last pilot with larger steps; if there is none, as expected."""
        ladder, bodies = self.ladder, self._sim.scene.bodies
        made = ErrorEstimate(bodies={body.name: BodyError() for body in bodies}, twins=[f"pilots with {self._pilots()}"])
        made.excursion = run.excursion if run.frames else 0.0
        if made.excursion == 0.0 or not ladder.pilots:
            made.notes.append("the errors are unknown: " + ("nothing moves" if ladder.pilots else "every pilot failed"))
            return made
        if ladder.parted >= MAX_PARTED:
            made.notes.append("the error in time is unknown: the paths of different steps part")
            return made
        coarser = [pilot for pilot in ladder.pilots if pilot.per_frame < run.per_frame]
        if not coarser:
            made.time = ladder.error
            made.notes.append("the error in time is expected from velocities, and may be wrong by a factor of ten")
            return made
        made.order = ladder.order
        factor = error_over_difference(float(run.per_frame / coarser[-1].per_frame), ladder.order)
        errors = factor * distances(run, coarser[-1]).max(axis=0) / made.excursion
        for k, body in enumerate(made.bodies.values()):
            body.time = float(errors[self._frames.bodies == k].max(initial=0.0))
        made.time = float(errors.max())
        return made


def _releases(scene: Scene) -> bool:
    """Whether a path may release its nodes, which changes forces suddenly."""
    paths = [c.path for body in scene.bodies for c in body.constraints if c.path is not None]
    return any(getattr(getattr(path, "frames", path), "release", True) for path in paths)
