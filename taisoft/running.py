"""A run: steps, frames, a status. Failures end it and are told; what was computed stays."""

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from taisoft.energy_check import EnergyCheck
from taisoft.errors import SimulationError, no_memory
from taisoft.records import RunReport, StepReport
from taisoft.settings import check_positive

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

FrameCallback = Callable[["Simulator", int, StepReport | None], None]
StepCallback = Callable[[StepReport, float], None]
NEAR = 1e-6  # of dt: a divisor of the frame time this near is what was meant, written with six or seven digits
ROUNDING = 1e-9  # of the frame time, by which dt times the steps may miss it
MOST_STEPS = 2.0**52  # of a run: beyond, the time of a float64 stands still


def run(
    sim: "Simulator", seconds: float, on_frame: FrameCallback | None = None, fps: float | None = 60,
    stop: Callable[[], bool] | None = None, resumed: bool = False, on_step: StepCallback | None = None,
) -> RunReport:  # fmt: skip
    """Step until `seconds` [s] from now, to the nearest step; frames at fps, or after every step when fps is None.

    on_frame(sim, index, report): called for frame 0 (the start, report None) and after every frame. stop: asked between
    steps; True ends the run. dt is lowered once to the next divisor of 1/fps, or rounded to one that is within NEAR of it, and
    the report tells. resumed: seconds and frames count from time 0, not from now; the first frame is `first_frame`.
    on_step(report, seconds): called after every implicit step and every batch of explicit ones with its wall time, less that of
    compiling. Never raises for a failed or interrupted run: status and problems say it. Raises SimulationError for bad arguments.
    """
    seconds = check_positive("seconds", seconds, "s")
    fps = None if fps is None else check_positive("fps", fps, "1/s")
    check_length(seconds, sim.dt, fps)
    report = RunReport()
    compiled = sim.compile_seconds
    clock = time.perf_counter()
    steps_per_frame = _fit_dt(sim, fps, report)
    total = max(1, round(seconds / sim.dt))
    if not resumed and seconds < 0.5 * sim.dt:
        report.problems.append(f"note: {seconds:.6g} s are less than half a step: one of {sim.dt:.6g} s is taken")
    start_count, start_time = sim.step_count, sim.time
    behind = round(sim.time / sim.dt) if resumed else 0  # steps of this dt
    zero = start_count - behind
    energy: EnergyCheck | None = None
    try:
        energy = EnergyCheck(sim)
        frame, over = divmod(behind, steps_per_frame)
        if on_frame is not None and not over:
            on_frame(sim, frame, None)
        while sim.step_count - zero < total and not report.interrupted:
            frame += 1
            goal = min(total, frame * steps_per_frame)
            merged = _advance_to(sim, zero + goal, stop, report, on_step, energy)
            if merged is None:
                break
            if sim.settings.explicit:
                report.step_reports.append(merged)
            if on_frame is not None and sim.step_count - zero == goal:
                on_frame(sim, frame, merged)
    except (SimulationError, MemoryError) as error:
        report.status = "failed"
        report.problems.append(str(no_memory("the next step", error) if isinstance(error, MemoryError) else error))
    except KeyboardInterrupt:
        _interrupt(report)
    report.steps = sim.step_count - start_count
    report.sim_seconds = sim.time - start_time
    report.wall_seconds = time.perf_counter() - clock - (sim.compile_seconds - compiled)
    report.compile_seconds = sim._take_compile_seconds()
    _judge(report)
    if energy is not None:
        energy.add_problem(report)
    end = seconds if resumed else start_time + seconds
    if report.status != "failed" and not report.interrupted and abs(sim.time - end) > (1.0 + ROUNDING) * max(sim.dt, report.dt):
        report.problems.append(
            f"the run was to end at t = {end:.6g} s and ended at t = {sim.time:.6g} s, since dt or the state changed meanwhile"
        )
        report.status = "degraded"
    if report.steps and report.status != "failed":
        try:
            _judge_end(sim, report)
        except (SimulationError, MemoryError) as error:
            report.status = "failed"
            report.problems.append(str(no_memory("a look at the end", error) if isinstance(error, MemoryError) else error))
        except KeyboardInterrupt:
            report.status = "degraded"
            _interrupt(report)
    return report


def check_length(seconds: float, dt: float, fps: float | None) -> None:
    """Raises SimulationError where steps of dt [s], fitted to fps, would never reach `seconds` [s]."""
    dt = _fitting(dt, fps)[1]
    if not seconds <= MOST_STEPS * dt:
        raise SimulationError(
            f"seconds = {seconds:g} s in steps of {dt:g} s are more than {MOST_STEPS:.2g} steps: the run would never end"
        )


def first_frame(sim: "Simulator", fps: float | None) -> int:
    """Number of the first frame of a resumed run: that of the present state, or where it lies between two the next."""
    n, dt = _fitting(sim.dt, fps, sim)
    return -(-round(sim.time / dt) // n)


def _fitting(dt: float, fps: float | None, sim: "Simulator | None" = None) -> tuple[int, float]:
    """Steps per frame, and the dt that makes them a frame: the divisor of 1/fps within NEAR of this dt, unless that is not stable
    in this simulator, else the largest one below it."""
    if fps is None:
        return 1, dt
    frame = 1.0 / fps
    if not frame <= MOST_STEPS * dt:  # a run that long is refused, see `check_length`
        return 1, dt
    n = max(1, round(frame / dt))
    if abs(n * dt - frame) <= ROUNDING * frame:
        return n, dt
    if abs(n * dt - frame) > NEAR * frame or (frame / n > dt and sim is not None and not _may_take(sim, frame / n)):
        n = max(1, math.ceil(frame / dt))
    return n, frame / n


def _may_take(sim: "Simulator", dt: float) -> bool:
    """Whether a simulator does not refuse a dt [s] for its stability."""
    return not sim.settings.explicit or sim.settings.allow_unstable or dt <= sim.stable_dt


def _fit_dt(sim: "Simulator", fps: float | None, report: RunReport) -> int:
    """Steps per frame; sets dt to a divisor of the frame time where it is none, and tells."""
    n, dt = _fitting(sim.dt, fps, sim)
    if dt != sim.dt:
        report.dt_requested, sim.dt = sim.dt, dt
    report.dt = sim.dt
    if report.dt_requested is not None:
        report.problems.append(f"note: {dt_sentence(report)}, so that {n} steps make a frame of 1/{fps:g} s")
    return n


def dt_sentence(report: RunReport) -> str:
    """How a run changed the dt that it was given, in a few words; "" where it did not."""
    if report.dt_requested is None:
        return ""
    before, after = report.dt_requested, report.dt
    done = "rounded" if abs(after - before) <= 1.01 * NEAR * before else "lowered"
    texts = ((f"{before:.{digits}g}", f"{after:.{digits}g}") for digits in (6, 9, 17))
    old, new = next(pair for pair in texts if pair[0] != pair[1])
    return f"dt {done} from {old} s to {new} s"


def _advance_to(
    sim: "Simulator", goal: int, stop, report: RunReport, on_step: StepCallback | None, energy: EnergyCheck
) -> StepReport | None:
    """Step up to a step count. Explicit batches are merged into one report; implicit steps are listed one by one.

    Returns the merged report, or that of the last implicit step; None when nothing was done.
    """
    merged = None
    while sim.step_count < goal:
        if stop is not None and stop():
            _interrupt(report)
            break
        energy.before_step()
        one = timed_advance(sim, goal - sim.step_count, on_step)
        energy.after_step(one)
        if sim.settings.explicit:
            merged = one if merged is None else _merge(merged, one)
        else:
            report.step_reports.append(one)
            merged = one
    return merged


def timed_advance(sim: "Simulator", n: int, on_step: StepCallback | None) -> StepReport:
    """sim.advance(n), with on_step told of it."""
    clock, compiled = time.perf_counter(), sim.compile_seconds
    report = sim.advance(n)
    if on_step is not None:
        on_step(report, time.perf_counter() - clock - (sim.compile_seconds - compiled))
    return report


def _merge(a: StepReport, b: StepReport) -> StepReport:
    """Later report b of an explicit batch with the extremes of a."""
    b.steps += a.steps
    b.min_volume_ratio = min(a.min_volume_ratio, b.min_volume_ratio)
    b.n_inverted = max(a.n_inverted, b.n_inverted)
    b.contact_iterations += a.contact_iterations
    b.contact_residual = max(a.contact_residual, b.contact_residual)
    b.max_penetration = max(a.max_penetration, b.max_penetration)
    b.n_contacts = max(a.n_contacts, b.n_contacts)
    b.dropped_contacts = max(a.dropped_contacts, b.dropped_contacts)
    b.crossings, b.deep = max(a.crossings, b.crossings), max(a.deep, b.deep)
    b.converged = a.converged and b.converged
    b.problems = a.problems + b.problems
    return b


def _interrupt(report: RunReport) -> None:
    report.interrupted = True
    report.problems.append("the run was interrupted before its end")


def _judge_end(sim: "Simulator", report: RunReport) -> None:
    """Bodies that overlap at the end, however they got there: the pair that is farthest beyond its limit."""
    found = sim.overlaps() if sim.touches else []
    beyond, worst = max(((o.depth / sim.contact_limit(o.name_a, o.name_b), k) for k, o in enumerate(found)), default=(0.0, 0))
    if beyond > 1.0:
        found = found[worst]
        report.problems.append(f"at the end '{found.name_a}' and '{found.name_b}' overlap by {found.depth:.3g} m")
        report.status = "degraded"


def _judge(report: RunReport) -> None:
    """Status from what happened: anything dropped, inverted or not converged keeps a run from ok."""
    steps = report.step_reports
    unconverged = [s for s in steps if not s.converged]
    inverted = [s for s in steps if s.n_inverted > 0]
    if unconverged:
        worst = max(unconverged, key=lambda s: max(s.residual, s.contact_residual))
        report.problems.append(
            f"{len(unconverged)} of {len(steps)} steps did not converge; the worst, at t = {worst.time:.4g} s, "
            f"to a relative residual of {worst.residual:.2e}"
            + (f", its contacts to {worst.contact_residual:.2e}" if worst.n_contacts else "")
        )
    if inverted:
        worst = max(inverted, key=lambda s: s.n_inverted)
        report.problems.append(
            f"tets were inverted in {len(inverted)} reported steps; at most {worst.n_inverted}, at t = {worst.time:.4g} s"
        )
    dropped = [s for s in steps if s.dropped_contacts > 0]
    if dropped:
        report.problems.append(f"in {len(dropped)} of {len(steps)} reported steps contacts under inverted tets were not known")
    sunk = [s for s in steps if s.deep]
    if sunk:
        worst, most = max(sunk, key=lambda s: s.max_penetration), max(s.crossings for s in sunk)
        report.problems.append(
            f"in {len(sunk)} of {len(steps)} reported steps bodies penetrate; the worst, at t = {worst.time:.4g} s, "
            f"by {worst.max_penetration:.3g} m" + (f", with {most} pairs of triangles that cross" if most else "")
        )
    if report.status == "ok" and (unconverged or inverted or dropped or sunk or report.interrupted):
        report.status = "degraded"
