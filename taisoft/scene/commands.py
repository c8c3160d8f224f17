"""Motions that a running simulation is commanded to make, as paths.

A command leads from where something is to a given place, straight and at constant velocity, and holds there; or on and on at a
given velocity. Until the steps that carry it out begin, its end is not known, and it holds the start.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy


@dataclass(frozen=True, eq=False)
class Command:
    """A path: t [s] -> displacement (3,) or (k,3) [m], or, with rotations, (translation (3,) [m], rotation (3,3))."""

    begin: float  #: [s]
    first: np.ndarray  #: displacement at the beginning [m]
    last: np.ndarray | None = None  #: at the end; None: the rate is given, and there is no end
    rate: np.ndarray | None = None  #: [m/s]
    first_rotation: np.ndarray | None = None  #: (3,3)
    last_rotation: np.ndarray | None = None  #: (3,3)
    spin: np.ndarray | None = None  #: (3,) angular velocity [rad/s]
    end: float = math.inf  #: [s]
    seconds: float | None = None  #: that it takes; None: as long as the next steps

    @property
    def is_pending(self) -> bool:
        """Whether its end is not known yet."""
        return self.rate is None

    def around(self, t: float, step: float) -> tuple[float, float]:
        """Return two times [s], at most a step apart, between which it moves as at t: later ones where it begins."""
        return (t, t + step) if t <= self.begin or t > self.end else (max(t - step, self.begin), t)

    def until(self, end: float) -> "Command":
        """Return the command with its end [s], from which its velocity follows."""
        seconds, spin = end - self.begin, None
        if self.first_rotation is not None:
            turn = scipy.spatial.transform.Rotation.from_matrix(self.last_rotation @ self.first_rotation.T)
            spin = turn.as_rotvec() / seconds
        return replace(self, end=end, rate=(self.last - self.first) / seconds, spin=spin)

    def __call__(self, t: float) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        if t >= self.end:
            return self._value(self.last, self.last_rotation)
        passed = t - self.begin
        if self.is_pending or passed <= 0.0:
            return self._value(self.first, self.first_rotation)
        rotation = self.first_rotation
        if rotation is not None and self.spin.any():
            rotation = scipy.spatial.transform.Rotation.from_rotvec(passed * self.spin).as_matrix() @ rotation
        return self._value(self.first + passed * self.rate, rotation)

    def _value(self, displacement: np.ndarray, rotation: np.ndarray | None) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        return displacement if rotation is None else (displacement, rotation)
