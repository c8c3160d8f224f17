"""Running a simulation for a given time: steps, frames and a status.

A failure ends the run and is reported; the results so far are kept.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from taisoft.commanding import refuse_commands
from taisoft.details import detailed
from taisoft.dynamics.newton_budget import watched
from taisoft.energy_check import EnergyCheck
from taisoft.errors import SimulationError
from taisoft.estimation.quantities import Definition, definitions, measure_at_end
from taisoft.frame_steps import ROUNDING, check_length, fit_dt
from taisoft.records import RunReport, StepReport
from taisoft.scene import checks

if TYPE_CHECKING:
    from taisoft.estimation.estimator import ErrorEstimator
    from taisoft.scene.scene import Scene
    from taisoft.simulator import Simulator

FrameCallback = Callable[["Simulator", int, StepReport | None], None]
StepCallback = Callable[[StepReport, float], None]
IterationCallback = Callable[[int], None]
MAXIMA = ("n_inverted", "contact_residual", "max_penetration", "n_contacts", "dropped_contacts", "crossings", "deep")
LONG_STEP, LOOK_EVERY = 1.0, 0.2  # wall time from which an implicit step is long, and between looks at it [s]


class _StepStopped(Exception):
    """The run was stopped within a step."""


class _LongStep:
    """Looks into a step that takes long, see `run`."""

    def __init__(self, stop: Callable[[], bool] | None, on_iteration: IterationCallback | None):
        self._stop, self._on_iteration, self._next = stop, on_iteration, time.monotonic() + LONG_STEP

    def __call__(self, n: int) -> None:
        """Look at the step after n of its Newton iterations."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + LOOK_EVERY
        if self._stop is not None and self._stop():
            raise _StepStopped
        if self._on_iteration is not None:
            self._on_iteration(n)


@dataclass
class RunRequest:
    """A run as `run` takes it, with checked arguments. measured: its quantities."""

    seconds: float
    fps: float | None
    stop: Callable[[], bool] | None = None
    resumed: bool = False
    on_frame: FrameCallback | None = None
    on_step: StepCallback | None = None
    on_iteration: IterationCallback | None = None
    error: bool = False
    error_mesh: "str | Scene | None" = None
    measured: dict[str, Definition] = field(default_factory=dict)


def run(
    sim: "Simulator",
    seconds: float,
    on_frame: FrameCallback | None = None,
    fps: float | None = 60,
    stop: Callable[[], bool] | None = None,
    resumed: bool = False,
    on_step: StepCallback | None = None,
    error: bool = False,
    error_mesh: "str | Scene | None" = None,
    on_iteration: IterationCallback | None = None,
    details: tuple[str, ...] = (),
    quantities: "dict[str, str | Callable[[Simulator], float]] | None" = None,
    about: tuple[float, float, float] | None = None,
) -> RunReport:
    """Step for `seconds` [s] from now, to the nearest step, with frames at fps, or after every step in statics or if it is None.

    on_frame(sim, index, report): called for frame 0 (the start, report None) and after every frame. stop: called between steps,
    and in long ones; True ends the run. dt is lowered once to the next divisor of 1/fps, or rounded to one within NEAR of it,
    which the report notes. resumed: seconds and frames count from time 0, not from now; the first frame is `first_frame`.
    on_step(report, seconds): called after every implicit step and every batch of explicit steps, with its wall time without
    compilation [s]. error: estimate the error of the positions by companions (`taisoft.estimation`), simulators that follow the
    run with other steps and tighter tolerances; the report holds it. error_mesh: also estimate the error of the mesh, by a
    companion on another one: "refined", "order" (the elements' other order), or the same scene on a mesh that shares nodes.
    on_iteration(n): called a few times a second in implicit steps of more than 1 s of wall time, with their Newton iterations so
    far. details: some of "pairs", "bodies" and "quantities": each report then holds forces, torques and slip velocities of the
    pairs that pressed in its last step, energies of bodies, and the quantities, see `StepReport.details`; about: the point of
    torques, as of `details`. quantities: functions of the simulator that return a number, or texts such as "contact_force.x
    finger fruit" (docs/errors.md), by name; the report holds their values at the end and, with error=True, their errors.
    Functions see the companions too, whose mesh may have other nodes. A run that fails, or that `stop` ends, does not raise: see
    the report's status and problems. Ctrl-C undoes the present step and is raised as KeyboardInterrupt; `stop` alone ends a run
    in another thread than the main one. Raises SimulationError for bad arguments, and for a companion that cannot be made. A
    simulator with a tolerance first chooses integrator and dt by trials, unless the run is resumed; the report then holds the
    error in time.
    """
    fps = None if sim.settings.static else fps
    if error_mesh is not None and not error:
        raise SimulationError("error_mesh needs error=True")
    seconds = checks.number(seconds, "seconds", above=0.0, unit="s", error=SimulationError)
    fps = None if fps is None else checks.number(fps, "fps", above=0.0, unit="1/s", error=SimulationError)
    check_length(seconds, sim.dt, fps)
    measured = definitions(sim, quantities)
    on_step = detailed(sim, details, about, measured, on_step) if details else on_step
    request = RunRequest(seconds, fps, stop, resumed, on_frame, on_step, on_iteration, error, error_mesh, measured)
    if sim.settings.tolerance is None or resumed:
        report = run_steps(sim, request)
        if resumed and sim.settings.tolerance is not None:
            report.problems.append("note: the run keeps the steps that were chosen for the tolerance; its error is not estimated")
        return report
    from taisoft.estimation.tolerance import run_to_tolerance

    refuse_commands(sim, "tolerance")
    return run_to_tolerance(sim, request)


def run_steps(sim: "Simulator", request: RunRequest) -> RunReport:
    """Carry out a run with the simulator's integrator and dt."""
    report, seconds, resumed, on_frame = RunReport(), request.seconds, request.resumed, request.on_frame
    compiled = sim.compile_seconds
    clock = time.perf_counter()
    steps_per_frame = fit_dt(sim, request.fps, report)
    total = max(1, round(seconds / sim.dt))
    if not resumed and seconds < 0.5 * sim.dt:
        report.problems.append(f"note: {seconds:.6g} s are less than half a step: one step of {sim.dt:.6g} s is taken")
    start_count, start_time = sim.step_count, sim.time
    elapsed_steps = round(sim.time / sim.dt) if resumed else 0  # steps of this dt since time 0
    first_step = start_count - elapsed_steps
    energy: EnergyCheck | None = None
    steps_left = total - elapsed_steps
    estimator = sim._begin_estimate(steps_left, request.error_mesh, request.measured) if request.error else None
    try:
        try:
            with report.failing("the next step"):
                energy = EnergyCheck(sim)
                frame, remainder = divmod(elapsed_steps, steps_per_frame)
                if on_frame is not None and not remainder:
                    on_frame(sim, frame, None)
                while sim.step_count - first_step < total and not report.interrupted:
                    frame += 1
                    frame_end = min(total, frame * steps_per_frame)
                    merged = _advance_to(sim, first_step + frame_end, request, report, energy, estimator)
                    if merged is None:
                        break
                    if sim.settings.explicit:
                        report.step_reports.append(merged)
                    if sim.step_count - first_step == frame_end and on_frame is not None:
                        on_frame(sim, frame, merged)
        except _StepStopped:
            _mark_interrupted(report)
        measure_at_end(sim, request.measured, report)
        if estimator is not None:
            report.error_estimate = estimator.estimate()
            estimator.set_errors(report.quantities)
    finally:  # after Ctrl-C, too
        if estimator is not None:
            sim._end_estimate()
    report.steps = sim.step_count - start_count
    report.sim_seconds = sim.time - start_time
    report.wall_seconds = time.perf_counter() - clock - (sim.compile_seconds - compiled)
    report.compile_seconds = sim._take_compile_seconds()
    if estimator is not None:
        report.wall_seconds -= estimator.wall_seconds
    _summarize_steps(report)
    if energy is not None:
        energy.add_problem(report)
    end = seconds if resumed else start_time + seconds
    if report.status != "failed" and not report.interrupted and abs(sim.time - end) > (1.0 + ROUNDING) * max(sim.dt, report.dt):
        report.degrade(
            f"the run ended at t = {sim.time:.6g} s instead of t = {end:.6g} s, since dt or the state changed during it"
        )
    if report.steps and report.status != "failed":
        with report.failing("the final overlap check"):
            _check_final_overlap(sim, report)
    return report


def _mark_interrupted(report: RunReport) -> None:
    report.interrupted = True
    report.degrade("the run was interrupted before its end")


def _advance_to(
    sim: "Simulator", end: int, request: RunRequest, report: RunReport, energy: EnergyCheck, estimator: "ErrorEstimator | None"
) -> StepReport | None:
    """Step up to step count `end`. Merge explicit batches into one report; list implicit steps one by one.

    Returns the merged report, or that of the last implicit step; None if no step was taken.
    """
    merged = None
    while sim.step_count < end:
        if request.stop is not None and request.stop():
            _mark_interrupted(report)
            break
        energy.before_step()
        until = end if estimator is None else estimator.next_comparison(end)
        with watched(_LongStep(request.stop, request.on_iteration)):
            latest = timed_advance(sim, until - sim.step_count, request.on_step)
        energy.after_step(latest)
        if estimator is not None and sim.step_count == until:
            estimator.compare()
        if sim.settings.explicit:
            merged = latest if merged is None else _merge(merged, latest)
        else:
            report.step_reports.append(latest)
            merged = latest
    return merged


def timed_advance(sim: "Simulator", n: int, on_step: StepCallback | None) -> StepReport:
    """Call sim.advance(n), then on_step with its report and wall time without compilation [s]."""
    clock, compiled = time.perf_counter(), sim.compile_seconds
    report = sim.advance(n)
    if on_step is not None:
        on_step(report, time.perf_counter() - clock - (sim.compile_seconds - compiled))
    return report


def _merge(a: StepReport, b: StepReport) -> StepReport:
    """Merge two reports of explicit steps into the later one, b: extremes (MAXIMA) and sums of both, the rest from b."""
    b.steps += a.steps
    b.min_volume_ratio = min(a.min_volume_ratio, b.min_volume_ratio)
    b.contact_iterations += a.contact_iterations
    for name in MAXIMA:
        setattr(b, name, max(getattr(a, name), getattr(b, name)))
    b.contact_error = b.contact_error or a.contact_error
    b.converged = a.converged and b.converged
    b.problems = a.problems + b.problems
    return b


def _check_final_overlap(sim: "Simulator", report: RunReport) -> None:
    """Report the pair that overlaps farthest beyond its limit in the final state, whatever the steps reported."""
    found = sim.overlaps() if sim.touches else []
    beyond, worst = max(((o.depth / sim.contact_limit(o.name_a, o.name_b), k) for k, o in enumerate(found)), default=(0.0, 0))
    if beyond > 1.0:
        found = found[worst]
        report.degrade(f"at the end '{found.name_a}' and '{found.name_b}' overlap by {found.depth:.3g} m")


def _summarize_steps(report: RunReport) -> None:
    """Add problems and the status: any step that dropped contacts, inverted tets or did not converge degrades the run."""
    steps = report.step_reports
    if cut := [s for s in steps if s.on_budget]:
        worst, corrections = max(cut, key=lambda s: s.residual), [s.last_correction for s in cut]
        report.degrade(
            f"{len(cut)} of {len(steps)} steps ended on budget; the worst, at t = {worst.time:.4g} s, at a relative residual of "
            f"{worst.residual:.2e}; the last Newton corrections, about the errors, are up to {max(corrections):.2g} "
            f"m, {sum(corrections):.2g} m together"
        )
    if unconverged := [s for s in steps if not (s.converged or s.on_budget)]:
        worst = max(unconverged, key=lambda s: max(s.residual, s.contact_residual))
        report.degrade(
            f"{len(unconverged)} of {len(steps)} steps did not converge; the worst, at t = {worst.time:.4g} s, "
            f"reached a relative residual of {worst.residual:.2e}"
            + (f" and a contact residual of {worst.contact_residual:.2e}" if worst.n_contacts else "")
        )
    if inverted := [s for s in steps if s.n_inverted > 0]:
        worst = max(inverted, key=lambda s: s.n_inverted)
        report.degrade(
            f"tets were inverted in {len(inverted)} reported steps; at most {worst.n_inverted}, at t = {worst.time:.4g} s"
        )
    if dropped := [s for s in steps if s.dropped_contacts > 0]:
        report.degrade(f"in {len(dropped)} of {len(steps)} reported steps contacts of inverted tets were unknown")
    if deep := [s for s in steps if s.deep]:
        worst, crossings = max(deep, key=lambda s: s.max_penetration), max(s.crossings for s in deep)
        report.degrade(
            f"in {len(deep)} of {len(steps)} reported steps bodies penetrate; the worst, at t = {worst.time:.4g} s, "
            f"by {worst.max_penetration:.3g} m" + (f", with up to {crossings} crossing pairs of triangles" if crossings else "")
        )
    if inexact := [s for s in steps if s.contact_error]:
        worst = max(inexact, key=lambda s: s.misplaced)
        report.degrade(
            f"in {len(inexact)} of {len(steps)} reported steps contacts are inexact; at worst, at t = {worst.time:.4g} s, "
            f"{worst.contact_error}"
        )
