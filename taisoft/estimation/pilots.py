"""Pilots: runs of a whole simulation with trial steps, whose differences show which steps meet a tolerance.

A pilot takes steps of the run's own simulator, which afterwards is in the state that it had before. Pilots are compared at
common frames, at some of their nodes, so that their paths take little memory.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from taisoft.estimation.comparison import largest_excursion
from taisoft.ranges import owners
from taisoft.records import RunReport

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

NEGLIGIBLE = {"f32": 1e-6, "f64": 1e-12}  # excursions, over the size of the scene, that are rounding
ROUNDING = 1e-6  # part of a frame that a run's length may lack of a whole one
MAX_FRAMES = 48  # at which paths are recorded
MAX_NODES = 4096  # whose paths are recorded, evenly spread
COUNTS = ("newton_iterations", "linear_iterations", "contact_iterations")

RunFunction = Callable[..., RunReport]  # as `running.run_steps`


@dataclass
class Pilot:
    """A pilot, or the run itself. per_frame: its steps in the time of a frame.

    frames: numbers (k,) of the recorded ones; positions: of the recorded nodes at these (k,n,3) [m]; variations: (n,) sums of the
    changes, from frame to frame, of what velocities change in a frame; jump: the largest such change of velocity [m/s]; end: the
    simulation's state at the end; warned: texts of its warnings.
    """

    integrator: str
    per_frame: Fraction
    frames: list[int] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)
    variations: np.ndarray | float = 0.0
    jump: float = 0.0
    report: RunReport = field(default_factory=RunReport)
    end: dict = field(default_factory=dict)
    warned: list[str] = field(default_factory=list)

    def counts_per_step(self) -> list[float]:
        """Iterations in a step: COUNTS."""
        reports = self.report.step_reports
        return [sum(getattr(one, name) for one in reports) / max(1, self.report.steps) for name in COUNTS]

    def at(self, frames: list[int]) -> np.ndarray:
        """Positions at some of the frames (k,n,3) [m]."""
        return np.array([self.positions[self.frames.index(k)] for k in frames])

    @property
    def excursion(self) -> float:
        """The largest excursion [m]."""
        return largest_excursion(np.array(self.positions))


class Recorder:
    """Records a pilot at its frames; pass `frame` to a run as on_frame. stride: time between these, in frames of `frames`."""

    def __init__(self, pilot: Pilot, frames: "Frames", stride: Fraction):
        self._pilot, self._frames, self._stride, self._first = pilot, frames, stride, None
        self._velocities = self._jump = None

    def frame(self, sim: "Simulator", index: int, _report) -> None:
        """Record a frame, unless it lies between those of `frames`, or is the last one and not whole."""
        self._first = index if self._first is None else self._first
        number, pilot = (index - self._first) * self._stride, self._pilot
        if number.denominator != 1 or number > self._frames.count:
            return
        x, v = (field[self._frames.nodes].astype(np.float64) for field in sim._dynamics.state.state())
        before, self._velocities = self._velocities, v
        if before is not None:
            previous, self._jump = self._jump, v - before
            pilot.jump = max(pilot.jump, float(np.linalg.norm(self._jump, axis=1).max()))
            if previous is not None:
                pilot.variations = pilot.variations + np.linalg.norm(self._jump - previous, axis=1)
        if self._frames.is_recorded(number):
            pilot.frames.append(int(number))
            pilot.positions.append(x)


@dataclass(frozen=True)
class Frames:
    """The frames of a run at which pilots are compared.

    seconds: between two frames [s]; length: of the run [s]; nodes: the recorded ones; bodies: (n,) their bodies; negligible: an
    excursion that is rounding [m].
    """

    seconds: float
    length: float
    nodes: np.ndarray
    bodies: np.ndarray
    negligible: float

    @property
    def count(self) -> int:
        """Number of whole frames after the start."""
        return max(1, math.floor(self.length / self.seconds + ROUNDING))

    def is_recorded(self, frame: int) -> bool:
        """Whether pilots record a frame, counted from 0 at the start: at most about MAX_FRAMES, and the last one."""
        return frame % -(-self.count // MAX_FRAMES) == 0 or frame == self.count

    def pilot(self, sim: "Simulator", per_frame: Fraction, stop: Callable[[], bool] | None, run: RunFunction) -> Pilot:
        """Run a pilot of `per_frame` steps a frame; its report has the status "failed" if it fails. Restores sim's state."""
        pilot = Pilot(sim.settings.integrator, per_frame)
        kept, may_soften = sim._dynamics.snapshot(), sim._may_soften
        stride = math.ceil(1 / per_frame)
        length = self.length if stride == 1 else self.count // stride * stride * self.seconds
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")  # they are those of the run only if the pilot is
                sim.dt = self.seconds / float(per_frame)
                recorder = Recorder(pilot, self, Fraction(stride))
                pilot.report = run(sim, length, recorder.frame, 1.0 / (self.seconds * stride), stop)
            pilot.end = sim._dynamics.snapshot()
            pilot.warned = list(dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, UserWarning)))
        finally:
            sim._dynamics.restore(kept)
            sim._may_soften = may_soften
        return pilot


def make_frames(sim: "Simulator", length: float, seconds: float) -> Frames:
    """The frames of a run of `length` [s], one after every `seconds` [s]."""
    sizes = [body.n_nodes for body in sim.scene.bodies]
    bodies = owners(sizes)
    nodes = np.arange(0, len(bodies), -(-len(bodies) // MAX_NODES))
    size = float(np.ptp(sim.positions(), axis=0).max())
    return Frames(seconds, length, nodes, bodies[nodes], NEGLIGIBLE[sim.settings.precision] * size)


def distances(pilot: Pilot, other: Pilot) -> np.ndarray:
    """Distances of two pilots' nodes at their common frames (k,n) [m]."""
    common = [frame for frame in pilot.frames if frame in set(other.frames)]
    return np.linalg.norm(pilot.at(common) - other.at(common), axis=2)
