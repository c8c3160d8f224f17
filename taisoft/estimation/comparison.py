"""Distances between the paths of two runs, relative to the largest excursion, on one mesh or on two.

The largest excursion is the largest distance of any node from its start at any compared time.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from taisoft.errors import SimulationError

COINCIDENCE = 1e-9  # distance over the body's size below which two nodes coincide


@dataclass(frozen=True)
class Error:
    """Distance between two paths over the largest excursion."""

    rms: float
    max: float


class Differences:
    """Distances between two paths at each comparison. maxima: per body (k, n_bodies); squares: mean squares (k,)."""

    def __init__(self, bodies: np.ndarray):
        self._starts = np.flatnonzero(np.diff(bodies, prepend=-1))  # of the bodies, in the compared nodes
        self.maxima: list[np.ndarray] = []
        self.squares: list[float] = []
        self.map = np.zeros(len(bodies))  # distances at the last comparison

    def add(self, x: np.ndarray, other: np.ndarray) -> None:
        """Compare positions (n,3) [m]."""
        squared = ((x - other) ** 2).sum(axis=1)
        self.squares.append(float(squared.mean()))
        self.map = np.sqrt(squared)
        self.maxima.append(np.maximum.reduceat(self.map, self._starts))

    def largest(self, k: int | None = None) -> np.ndarray:
        """Largest distance of each body over the first k comparisons (n_bodies,) [m]."""
        return np.max(self.maxima[:k], axis=0)


def largest_excursion(path: np.ndarray) -> float:
    """Return the largest excursion of a path (k,n,3) [m]."""
    return float(np.sqrt(((path - path[0]) ** 2).sum(axis=2).max()))


def distance(path: np.ndarray, other: np.ndarray, excursion: float) -> Error:
    """Return the error between two paths (k,n,3) [m], relative to the excursion [m]."""
    squared = ((path - other) ** 2).sum(axis=2)
    return Error(float(np.sqrt(squared.mean())) / excursion, float(np.sqrt(squared.max())) / excursion)


def shared_nodes(start: np.ndarray, bodies: list, other: np.ndarray, others: list) -> tuple[np.ndarray, np.ndarray]:
    """Return ids in both meshes of the nodes that coincide in the same body. start, other: (n,3), (m,3) [m] initial positions."""
    own, theirs, first, second = [], [], 0, 0
    for (name, n), (_, m) in zip(bodies, others):
        size = float(np.ptp(other[second : second + m], axis=0).max())
        distances, nearest = cKDTree(other[second : second + m]).query(start[first : first + n])
        same = np.flatnonzero(distances <= COINCIDENCE * size)
        if not len(same):
            raise SimulationError(f"body {name!r}: no node of one mesh is also in the other, so they cannot be compared")
        own.append(first + same)
        theirs.append(second + nearest[same])
        first, second = first + n, second + m
    return np.concatenate(own), np.concatenate(theirs)
