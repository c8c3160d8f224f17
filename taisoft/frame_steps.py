"""Steps and frames: how dt fits the time of a frame."""

import math
from typing import TYPE_CHECKING

from taisoft.errors import SimulationError
from taisoft.records import RunReport

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

NEAR = 1e-6  # relative to dt: a divisor of the frame time this close is taken as intended, dt being written with 6 or 7 digits
ROUNDING = 1e-9  # relative to the frame time: allowed error of dt times the steps per frame
MAX_STEPS = 2.0**52  # of a run: beyond that, adding dt no longer changes a float64 time


def check_length(seconds: float, dt: float, fps: float | None) -> None:
    """Raise SimulationError if steps of dt [s], fitted to fps, would never reach `seconds` [s]."""
    dt = _fit_to_frames(dt, fps)[1]
    if not seconds <= MAX_STEPS * dt:
        raise SimulationError(
            f"seconds = {seconds:g} s in steps of {dt:g} s are more than {MAX_STEPS:.2g} steps: the run would never end"
        )


def first_frame(sim: "Simulator", fps: float | None) -> int:
    """Return the number of a resumed run's first frame: that of the present state, or the next one if it lies between two."""
    n, dt = _fit_to_frames(sim.dt, fps, sim)
    return -(-round(sim.time / dt) // n)


def _fit_to_frames(dt: float, fps: float | None, sim: "Simulator | None" = None) -> tuple[int, float]:
    """Return the steps per frame and the dt [s] that fits them to a frame.

    That dt is the divisor of 1/fps within NEAR of the given one, unless the simulator refuses it as unstable, else the largest
    divisor below it.
    """
    if fps is None:
        return 1, dt
    frame = 1.0 / fps
    if not frame <= MAX_STEPS * dt:  # such a run is refused by `check_length`
        return 1, dt
    n = max(1, round(frame / dt))
    if abs(n * dt - frame) <= ROUNDING * frame:
        return n, dt
    if abs(n * dt - frame) > NEAR * frame or (frame / n > dt and sim is not None and not _allows_dt(sim, frame / n)):
        n = max(1, math.ceil(frame / dt))
    return n, frame / n


def _allows_dt(sim: "Simulator", dt: float) -> bool:
    """Return whether the simulator accepts a dt [s] as stable."""
    return not sim.settings.explicit or sim.settings.allow_unstable or dt <= sim.stable_dt


def fit_dt(sim: "Simulator", fps: float | None, report: RunReport) -> int:
    """Return the steps per frame. Set dt to a divisor of the frame time if it is none, and note that in the report."""
    n, dt = _fit_to_frames(sim.dt, fps, sim)
    if dt != sim.dt:
        report.dt_requested, sim.dt = sim.dt, dt
    report.dt = sim.dt
    if report.dt_requested is not None:
        report.problems.append(f"note: {dt_sentence(report)}, so that {n} steps make a frame of 1/{fps:g} s")
    return n


def dt_sentence(report: RunReport) -> str:
    """Describe how a run changed the requested dt; "" if it did not."""
    if report.dt_requested is None:
        return ""
    before, after = report.dt_requested, report.dt
    change = "rounded" if abs(after - before) <= 1.01 * NEAR * before else "lowered"
    texts = ((f"{before:.{digits}g}", f"{after:.{digits}g}") for digits in (6, 9, 17))
    old, new = next(pair for pair in texts if pair[0] != pair[1])
    return f"dt {change} from {old} s to {new} s"
