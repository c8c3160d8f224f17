"""The drawn squares of half-spaces, which stay below the bodies.

A half-space is drawn as a square around the place where the bodies start. When their bounding box comes near its border, the
square moves along, and grows if they spread, so that bodies never lie beside the drawn ground. It depends on present positions
alone. A square that is cut off at other half-spaces only moves along them: the bottom of a groove along the groove, that of a bin
not at all.
"""

import numpy as np

from taisoft.scene.obstacles import HalfSpace

MARGIN = 0.15  # least distance of the bodies from the border, in units of the square's side at the start
PARALLEL = 1e-6  # normals whose sine is below this do not cut each other off


def finite_points(x: np.ndarray) -> np.ndarray:
    """Return those of the points (n,3) whose coordinates are all finite."""
    return x[np.isfinite(x).all(axis=1)]


class Square:
    """The square of a half-space that does not move. vertices: (n,3) [m], around the start; others: half-spaces beside it."""

    def __init__(self, shape: HalfSpace, vertices: np.ndarray, others: list[HalfSpace]):
        self._start, self._directions = vertices, _free_directions(shape, others) if len(vertices) else []

    def below(self, x: np.ndarray) -> np.ndarray:
        """Return the vertices (n,3) [m] for bodies at x (m,3) [m], all finite; the start's own while these are well inside."""
        square = self._start
        for direction in self._directions if len(x) else ():
            own, along = self._start @ direction, x @ direction
            low, high = own.min(), own.max()
            margin = MARGIN * (high - low)
            first, last = along.min() - margin, along.max() + margin
            factor = max(1.0, (last - first) / (high - low))
            middle = 0.5 * (low + high)
            low, high = middle + factor * (low - middle), middle + factor * (high - middle)
            shift = max(0.0, last - high) + min(0.0, first - low)
            if factor > 1.0 or shift != 0.0:
                square = square + np.outer((factor - 1.0) * (own - middle) + shift, direction)
        return square


def _free_directions(shape: HalfSpace, others: list[HalfSpace]) -> list[np.ndarray]:
    """Return orthonormal directions in the boundary of a half-space along which the other ones do not cut it off."""
    across, normal, along = shape.frame().T
    free = [along, across]
    for other in others:
        cut = other.normal - (other.normal @ normal) * normal
        if np.linalg.norm(cut) <= PARALLEL:
            continue
        if len(free) == 2:
            free = [np.cross(normal, cut / np.linalg.norm(cut))]
        elif free and abs(free[0] @ cut) > PARALLEL:
            free = []
    return free
