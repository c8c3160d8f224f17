"""Springs, tendons and attachments of a scene as lines of elements, in NumPy.

An element stretches the vector e = sum_j c_j x_j + g between two points, where c are the weights of the one minus those of the
other, and g the position of a point of an obstacle. A line is a sequence of elements with one tension,
    T = k (l - L) + T_0,   l = sum |e|,
k the stiffness, L the rest length, T_0 a given tension; plus c_d e.e' / l of its damping c_d. A tendon is a line with an element
for each of its segments: under a given tension k = 0, and an elastic one has T = k max(0, l - L) and a given L. A spring, and
each node of an attachment, is a line of one element. Force of node j: -sum_e c_j T d, d the gradient of |e|.

|e| has a kink at e = 0: a tension that pulls two points together has its minimum there, where the force has no limit and the
stiffness T / |e| no bound. Below a length s, a fraction SMOOTHED of the element's rest length, |e| is therefore replaced by
    s / 3 + |e|^2 / s - |e|^3 / (3 s^2),   d = (2 - |e| / s) e / s,
whose value and first two derivatives are those of |e| at s: nothing changes above s, d vanishes with e, and T adds at most
2 T / s to the stiffness. Source: the mollifier of friction of Li et al. 2020, "Incremental Potential Contact", eq. 17.
Weakness: such an element pulls with less than its tension, and counts as s / 3 long at e = 0.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.ranges import owners
from taisoft.scene.commands import Command
from taisoft.scene.obstacles import Obstacle

# What the amplitude of a line is: there is none; its tension; its tension, which is a Lagrange multiplier; its rest length
PLAIN, TENSION, MULTIPLIER, LENGTH = range(4)
SMOOTHED = 0.01  # of an element's rest length: the length below which it is smoothed
RATE_STEP = 1e-5  # [s] of the difference that is the velocity of an obstacle's point


@dataclass(frozen=True, eq=False)
class MovingEnds:
    """The m elements with an end on an obstacle that moves. Their offsets, and rates if any are damped, are amplitudes."""

    first: int  # the first of these amplitudes
    damped: bool
    element: np.ndarray  # (m,) ascending
    fixed: np.ndarray  # (m,3) part of the offset that does not move [m]
    ends: list[tuple[Obstacle, np.ndarray, np.ndarray, np.ndarray]]  # places (k,) among the m, signs (k,), undisplaced (k,3) [m]

    @property
    def n_amplitudes(self) -> int:
        """Number of amplitudes: three for each offset, then three for each rate."""
        return 3 * len(self.element) * (2 if self.damped else 1)

    def offsets(self, t: float) -> np.ndarray:
        """Offsets (m,3) [m] at t [s]. Raises SceneError if a path fails."""
        total = self.fixed.copy()
        for obstacle, places, signs, points in self.ends:
            np.add.at(total, places, signs[:, None] * obstacle.points_at(t, points))
        return total

    def _rates(self, t: float) -> np.ndarray:
        """Rates (m,3) [m/s] of the offsets at t [s]."""
        total = np.zeros_like(self.fixed)
        for obstacle, places, signs, points in self.ends:
            path, central = obstacle.path, (max(t - RATE_STEP, 0.0), t + RATE_STEP)
            start, end = path.around(t, RATE_STEP) if isinstance(path, Command) else central
            rate = (obstacle.points_at(end, points) - obstacle.points_at(start, points)) / (end - start)
            np.add.at(total, places, signs[:, None] * rate)
        return total

    def amplitudes(self, t: float) -> np.ndarray:
        """Offsets, and rates if they are needed, at t [s]. Raises SimulationError if a path fails."""
        with reworded(SceneError, raised=SimulationError):
            found = [self.offsets(t)]
            if self.damped:
                found.append(self._rates(t))
        return np.concatenate(found).reshape(-1)


@dataclass(frozen=True, eq=False)
class SpringTable:
    """All elements of a scene, e of them with s entries in all; those of a line are consecutive and have its numbers."""

    n_nodes: int
    start: np.ndarray  # (e + 1) first entry of each
    node: np.ndarray  # (s,) of all nodes of the scene, distinct within an element, ascending
    weight: np.ndarray  # (s,) c_j
    offset: np.ndarray  # (e,3) g at the start [m]
    line: np.ndarray  # (e,) ascending from 0
    kind: np.ndarray  # (e,) PLAIN, TENSION, MULTIPLIER or LENGTH
    stiffness: np.ndarray  # (e,) k [N/m]
    rest_length: np.ndarray  # (e,) L [m]; 0 if it is given
    damping: np.ndarray  # (e,) c_d [N s/m]
    smoothing: np.ndarray  # (e,) s [m]
    slot: np.ndarray  # (e,) its amplitude, -1: none
    elements: dict[str, slice]  # of each connection, by name
    moving: MovingEnds | None

    @property
    def element(self) -> np.ndarray:
        """Element (s,) of each entry."""
        return owners(np.diff(self.start))

    @cached_property
    def rows(self) -> sp.csr_matrix:
        """The weights c (e, n_nodes)."""
        return sp.csr_matrix((self.weight, self.node, self.start), shape=(len(self.offset), self.n_nodes))

    @cached_property
    def line_start(self) -> np.ndarray:
        """First element (n_lines + 1) of each line."""
        return np.searchsorted(self.line, np.arange(self.line[-1] + 2))

    @property
    def coupled(self) -> np.ndarray:
        """First and one past the last entry (e,2) that stiffness couples an element's with: its own, or those of its line."""
        whole = self.kind == LENGTH
        first = np.where(whole, self.line_start[self.line], np.arange(len(self.line)))
        last = np.where(whole, self.line_start[self.line + 1], np.arange(len(self.line)) + 1)
        return np.stack([self.start[first], self.start[last]], axis=1)

    def vectors(self, x: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """e (e,3) [m] of node positions (n,3). amplitudes: of all loads, see `fem.loads`."""
        return self.rows @ x + self.offsets(amplitudes)

    def rates(self, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """The rate of e (e,3) [m/s] of velocities (n,3); without those of moving ends if nothing is damped."""
        rates, moving = self.rows @ v, self.moving
        if moving is not None and moving.damped:
            first = moving.first + 3 * len(moving.element)
            rates[moving.element] += amplitudes[first : first + 3 * len(moving.element)].reshape(-1, 3)
        return rates

    def offsets(self, amplitudes: np.ndarray) -> np.ndarray:
        """g (e,3) [m]."""
        if self.moving is None:
            return self.offset
        offset, moving = self.offset.copy(), self.moving
        offset[moving.element] = amplitudes[moving.first : moving.first + 3 * len(moving.element)].reshape(-1, 3)
        return offset

    def given(self, amplitudes: np.ndarray) -> np.ndarray:
        """T_0 (e,) [N]."""
        return np.where(self.kind == LENGTH, 0.0, np.append(amplitudes, 0.0)[self.slot])

    def rest_lengths(self, amplitudes: np.ndarray) -> np.ndarray:
        """L (e,) [m]."""
        return np.where(self.kind == LENGTH, np.append(amplitudes, 0.0)[self.slot], self.rest_length)

    def stretching(self, length: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """k (l - L) (e,) [N] of the elements' lengths (e,)."""
        stretch = np.bincount(self.line, length)[self.line] - self.rest_lengths(amplitudes)
        return self.stiffness * np.where(self.kind == LENGTH, np.maximum(stretch, 0.0), stretch)

    def tensions(self, x: np.ndarray, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Tension (e,) [N] with damping; negative: it pushes."""
        length, d = length_and_gradient(self.vectors(x, amplitudes), self.smoothing)
        elastic = self.stretching(length, amplitudes)
        return elastic + self.given(amplitudes) + self.damping * (self.rates(v, amplitudes) * d).sum(axis=1)

    def pulls(self, x: np.ndarray, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Force (e,3) [N] of each element on its first point."""
        d, rate = length_and_gradient(self.vectors(x, amplitudes), self.smoothing)[1], self.rates(v, amplitudes)
        across = rate - (rate * d).sum(axis=1)[:, None] * d
        damped = np.where(self.is_isotropic, self.damping, 0.0)
        return -(self.tensions(x, v, amplitudes)[:, None] * d + damped[:, None] * across)

    def stiffness_matrix(self, e: np.ndarray, amplitudes: np.ndarray) -> sp.csr_matrix:
        """S (3e,3e) [N/m] of stretched vectors (e,3): the change of the pulls with them."""
        length, d = length_and_gradient(e, self.smoothing)
        elastic = self.stretching(length, amplitudes)
        slack = (self.kind == LENGTH) & (elastic == 0.0)
        along = np.where(slack, 0.0, self.stiffness)
        curvature = _curvature(e, self.smoothing)
        curvature[self.is_isotropic] = np.eye(3) - d[self.is_isotropic, :, None] * d[self.is_isotropic, None, :]
        t = np.where(self.is_isotropic, self.stiffness, elastic + self.given(amplitudes))
        blocks = t[:, None, None] * curvature
        D = sp.csr_matrix((d.reshape(-1), (np.repeat(self.line, 3), np.arange(3 * len(d)))))  # of each line
        return (sp.block_diag(blocks) + D.T @ sp.diags(along[self.line_start[:-1]]) @ D).tocsr()

    def rest_amplitudes(self, n: int, x: np.ndarray) -> np.ndarray:
        """Amplitudes (n,) without load: 0, offsets at the start, and as given lengths those at rest.

        x: rest positions (n_nodes,3) [m].
        """
        amplitudes = np.zeros(n)
        if self.moving is not None:
            start = self.offset[self.moving.element].reshape(-1)
            amplitudes[self.moving.first : self.moving.first + len(start)] = start
        length = np.bincount(self.line, length_and_gradient(self.vectors(x, amplitudes), self.smoothing)[0])
        given = self.kind == LENGTH
        amplitudes[self.slot[given]] = length[self.line[given]]
        return amplitudes

    @property
    def is_isotropic(self) -> np.ndarray:
        """Whether (e,) an element has no rest length and no amplitude: it then pulls by k e, and damps in all directions."""
        return (self.rest_length == 0.0) & (self.kind == PLAIN)


def length_and_gradient(e: np.ndarray, smoothing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed lengths (k,) of vectors (k,3), and their gradients d (k,3), which are 0 where e is. smoothing: s (k,) [m]."""
    length, larger, ratio = _sizes(e, smoothing)
    smoothed = np.where(ratio < 1.0, smoothing * (1.0 / 3.0 + ratio**2 - ratio**3 / 3.0), length)
    return smoothed, ((2.0 - ratio) / larger)[:, None] * e


def _curvature(e: np.ndarray, smoothing: np.ndarray) -> np.ndarray:
    """Second derivatives (k,3,3) [1/m] of the smoothed lengths."""
    length, larger, ratio = _sizes(e, smoothing)
    outer = 1.0 / (np.where(length > 0.0, length, 1.0) * larger**2)
    return ((2.0 - ratio) / larger)[:, None, None] * np.eye(3) - outer[:, None, None] * e[:, :, None] * e[:, None, :]


def _sizes(e: np.ndarray, smoothing: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """|e|, max(|e|, s) and min(|e| / s, 1), each (k,); the second is 1 m where both are 0."""
    length = np.linalg.norm(e, axis=1)
    larger = np.maximum(length, smoothing)
    larger = np.where(larger > 0.0, larger, 1.0)
    return length, larger, np.where(length < smoothing, length / larger, 1.0)


class LengthForm:
    """Minus the length of a tendon as a function of all nodes' positions; the gradient is then that of its tension's forces."""

    def __init__(self, table: SpringTable, name: str):
        rows = table.rows[table.elements[name]]
        self.nodes, self._table, self._elements = np.unique(rows.indices), table, table.elements[name]
        self._rows, self._offset = rows[:, self.nodes], table.offset[self._elements]
        self._smoothing = table.smoothing[self._elements]

    def set_amplitudes(self, amplitudes: np.ndarray) -> None:
        """Move the ends on obstacles to where they are at the time of the amplitudes."""
        self._offset = self._table.offsets(amplitudes)[self._elements]

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """-l [m], and its gradient (k,3) at the nodes. x: (n_nodes,3) [m] of the scene."""
        length, d = length_and_gradient(self._rows @ x[self.nodes] + self._offset, self._smoothing)
        return -float(length.sum()), -(self._rows.T @ d)
