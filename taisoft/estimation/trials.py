"""Trials: runs of a whole simulation with trial steps, whose differences show which steps meet a tolerance.

A trial takes steps of the run's own simulator, which afterwards is in the state that it had before. Trials are compared at
common frames, at some of their nodes, so that their paths take little memory. A trial may keep the state before its fastest
part: other steps are compared with it there for a small part of the cost.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from taisoft.errors import collected_warnings
from taisoft.estimation.comparison import largest_excursion
from taisoft.estimation.costs import COUNTS
from taisoft.ranges import owners
from taisoft.records import RunReport
from taisoft.running import RunRequest, StepCallback, run_steps

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

NEGLIGIBLE = {"f32": 1e-6, "f64": 1e-12}  # excursions, over the size of the scene, that are rounding
ROUNDING = 1e-6  # part of a frame that a run's length may lack of a whole one
MAX_FRAMES = 48  # at which paths are recorded
PARTS = 24  # of a run, about; a trial knows which is the fastest
MAX_NODES = 4096  # whose paths are recorded, evenly spread


@dataclass
class Part:
    """A part of a trial: its first frame, the state there, and the largest sum of a node's velocities in it."""

    first: int
    state: dict
    velocities: float = 0.0


@dataclass
class Trial:
    """A trial, or the run itself. per_frame: its steps in the time of a frame.

    positions: of the recorded nodes (n,3) [m], by the numbers of the recorded frames; variations: (n,) sums of the changes, from
    frame to frame, of what velocities change in a frame; jump: the largest such change of velocity [m/s]; end: the simulation's
    state at the end; fastest: the part of the largest velocities, if it is kept; velocities: those of all parts, added; warned:
    texts of warnings.
    """

    integrator: str
    per_frame: Fraction
    positions: dict[int, np.ndarray] = field(default_factory=dict)
    variations: np.ndarray | float = 0.0
    jump: float = 0.0
    report: RunReport = field(default_factory=RunReport)
    end: dict = field(default_factory=dict)
    fastest: Part | None = None
    velocities: float = 0.0
    warned: list[str] = field(default_factory=list)

    def counts_per_step(self) -> list[float]:
        """Iterations in a step: COUNTS."""
        reports = self.report.step_reports
        return [sum(getattr(one, name) for one in reports) / max(1, self.report.steps) for name in COUNTS]

    @property
    def touches(self) -> bool:
        """Whether anything touches in a step."""
        return any(report.n_contacts for report in self.report.step_reports)

    @property
    def times(self) -> float:
        """Velocities of all parts over those of the fastest one."""
        return self.velocities / self.fastest.velocities if self.velocities else 1.0

    @property
    def excursion(self) -> float:
        """The largest excursion [m]."""
        return largest_excursion(np.array(list(self.positions.values())))


class Recorder:
    """Records a trial at its frames; pass `frame` to a run as on_frame.

    stride: time between these, in frames of `frames`; first: the one at which it begins; keeps: whether to keep the state before
    the fastest part.
    """

    def __init__(self, trial: Trial, frames: "Frames", stride: Fraction, first: int = 0, keeps: bool = False):
        self._trial, self._frames, self._first, self._keeps = trial, frames, first, keeps
        self._stride = stride if stride.denominator > 1 else int(stride)
        self._index: int | None = None  # of the first frame
        self._velocities: np.ndarray | None = None  # (n,3) at the frame before
        self._jump: np.ndarray | None = None  # (n,3) the change of velocities to that one
        self._part: Part | None = None  # the present one
        self._sums: np.ndarray | float = 0.0  # (n,) of velocities in it

    def frame(self, sim: "Simulator", index: int, _report) -> None:
        """Record a frame, unless it lies between those of `frames`, or is the last one and not whole."""
        self._index = index if self._index is None else self._index
        number, trial, frames = self._first + (index - self._index) * self._stride, self._trial, self._frames
        if number.denominator != 1 or number > frames.count:
            return
        number, state = int(number), sim._dynamics.state
        if frames.is_recorded(number):
            x, v = state.state()
            trial.positions[number] = x[frames.nodes].astype(np.float64)
        else:
            v = state.velocities()
        self._add_changes(v[frames.nodes].astype(np.float64))
        if self._keeps and (number % frames.part == 0 or number == frames.count):
            self._end_part(number, sim._dynamics.snapshot() if number < frames.count else {})

    def _add_changes(self, velocities: np.ndarray) -> None:
        """Add the changes to the velocities (n,3) [m/s] of the next frame."""
        trial = self._trial
        if self._velocities is not None:
            jump = velocities - self._velocities
            lengths = _lengths(jump)
            trial.jump = max(trial.jump, float(lengths.max()))
            changes = lengths if self._jump is None else _lengths(jump - self._jump)
            trial.variations = trial.variations + (0.0 if self._jump is None else changes)
            self._sums = self._sums + _lengths(velocities)
            self._jump = jump
        self._velocities = velocities

    def _end_part(self, number: int, state: dict) -> None:
        """End a part of the run, and begin the next one at a frame, with the state there; at the end of the run it is empty."""
        trial, part = self._trial, self._part
        if part is not None:
            part.velocities = float(np.max(self._sums))
            trial.velocities += part.velocities
            if trial.fastest is None or part.velocities > trial.fastest.velocities:
                trial.fastest = part
        self._part, self._sums = Part(number, state), 0.0


@dataclass(frozen=True)
class Frames:
    """The frames of a run at which trials are compared.

    seconds: between two frames [s]; length: of the run [s]; nodes: the recorded ones; bodies: (n,) their bodies; negligible: an
    excursion that is rounding [m].
    """

    seconds: float
    length: float
    nodes: slice
    bodies: np.ndarray
    negligible: float

    @cached_property
    def count(self) -> int:
        """Number of whole frames after the start."""
        return max(1, math.floor(self.length / self.seconds + ROUNDING))

    def is_recorded(self, frame: int) -> bool:
        """Whether trials record a frame, counted from 0 at the start: at most about MAX_FRAMES, and the last one."""
        return frame % self._between == 0 or frame == self.count

    @cached_property
    def _between(self) -> int:
        """Frames from one that is recorded to the next."""
        return -(-self.count // MAX_FRAMES)

    @cached_property
    def part(self) -> int:
        """Frames of a part of the run; the last part may have fewer."""
        return self._between * max(1, round(self.count / (self._between * PARTS)))

    def trial(
        self,
        sim: "Simulator",
        per_frame: Fraction,
        stop: Callable[[], bool] | None,
        part: Part | None = None,
        keeps: bool = False,
        on_step: StepCallback | None = None,
    ) -> Trial:
        """Run a trial of `per_frame` steps a frame; its report has the status "failed" if it fails. Restores sim's state.

        part: of another trial, which alone is to be run; keeps: whether to keep the state before its fastest part; stop,
        on_step: as for `Simulator.run`.
        """
        trial = Trial(sim.settings.integrator, per_frame)
        kept, may_soften = sim._dynamics.snapshot(), sim._may_soften
        stride, first = math.ceil(1 / per_frame), 0
        length = self.length if stride == 1 else self.count // stride * stride * self.seconds
        if part is not None:
            first = part.first
            length = min(self.part, self.count - first) * self.seconds
        try:
            if part is not None:
                sim._dynamics.restore(part.state)
            with collected_warnings() as trial.warned:  # which the run has only if the trial is the run
                sim.dt = self.seconds / float(per_frame)
                recorder = Recorder(trial, self, Fraction(stride), first, keeps)
                request = RunRequest(length, 1.0 / (self.seconds * stride), stop, on_frame=recorder.frame, on_step=on_step)
                trial.report = run_steps(sim, request)
            trial.end = sim._dynamics.snapshot()
        finally:
            sim._dynamics.restore(kept)
            sim._may_soften = may_soften
        return trial


def make_frames(sim: "Simulator", length: float, seconds: float) -> Frames:
    """The frames of a run of `length` [s], one after every `seconds` [s]."""
    sizes = [body.n_nodes for body in sim.scene.bodies]
    bodies = owners(sizes)
    nodes = slice(None, None, -(-len(bodies) // MAX_NODES))
    size = float(np.ptp(sim.positions(), axis=0).max())
    return Frames(seconds, length, nodes, bodies[nodes], NEGLIGIBLE[sim.settings.precision] * size)


def distances(trial: Trial, other: Trial) -> np.ndarray:
    """Distances of two trials' nodes at their common frames (k,n) [m]."""
    common = [frame for frame in trial.positions if frame in other.positions]
    return np.linalg.norm([trial.positions[frame] - other.positions[frame] for frame in common], axis=2)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (n,) of vectors (n,3)."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
