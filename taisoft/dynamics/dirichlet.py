"""Constraints as the steps see them: which axes are free, where moved nodes must be at a time, when they are released."""

from dataclasses import dataclass

import numpy as np

from taisoft.errors import SimulationError
from taisoft.model import Layout
from taisoft.scene.scene import Constraint, Scene


@dataclass
class _Group:
    name: str  # of the body
    constraint: Constraint
    nodes: np.ndarray  # (k,) rows of the model
    rows: slice  # rows among the moved nodes
    released: bool = False


class DirichletConditions:
    """Constraints of all bodies.

    moved (n_prescribed,): model rows of led nodes, group by group; a node led by two groups on different axes has two rows.
    held (n_held,): model rows with a constrained axis at the start.
    """

    def __init__(self, scene: Scene, layout: Layout):
        self._rest = layout.rest
        self._fixed = np.zeros((len(layout.rest), 3), dtype=bool)
        self._groups: list[_Group] = []
        n_prescribed = 0
        for k, body in enumerate(scene.bodies):
            for c in body.constraints:
                rows = c.nodes + layout.node_start[k]
                if c.path is None:
                    self._fixed[np.ix_(rows, np.flatnonzero(c.axes))] = True
                else:
                    self._groups.append(_Group(body.name, c, rows, slice(n_prescribed, n_prescribed + len(rows))))
                    n_prescribed += len(rows)
        self.prescribed_nodes = np.concatenate([g.nodes for g in self._groups]) if self._groups else np.zeros(0, dtype=np.int64)
        self.held = np.flatnonzero(self.constrained().any(axis=1))

    def reset(self) -> None:
        """Take up every path again."""
        for g in self._groups:
            g.released = False

    def released(self) -> list[bool]:
        """Which groups have let go."""
        return [g.released for g in self._groups]

    def set_released(self, released: list[bool]) -> None:
        """Back to what `released` told."""
        for g, gone in zip(self._groups, released, strict=True):
            g.released = gone

    @property
    def n_prescribed(self) -> int:
        """Rows of led nodes, released ones included."""
        return len(self.prescribed_nodes)

    def constrained(self) -> np.ndarray:
        """(n_nodes, 3) bool: axes that are fixed or led now."""
        mask = self._fixed.copy()
        for g in self._groups:
            if not g.released:
                mask[np.ix_(g.nodes, np.flatnonzero(g.constraint.axes))] = True
        return mask

    def prescribed_axes(self) -> np.ndarray:
        """(n_prescribed, 3) int32: 1 where a row's axis is led now."""
        axes = np.zeros((self.n_prescribed, 3), dtype=np.int32)
        for g in self._groups:
            if not g.released:
                axes[g.rows] = g.constraint.axes
        return axes

    def targets(self, times: np.ndarray) -> tuple[np.ndarray, bool]:
        """Positions of the led nodes at the times (k,) [s], up to the first release.

        Returns (r, n_prescribed, 3) [m] with r <= k, and whether a group lets go at times[r]. If that is times[0], the groups
        that let go are released and the call is to be repeated.
        """
        rows = np.zeros((len(times), self.n_prescribed, 3))
        for r, t in enumerate(times):
            releasing = []
            for g in self._groups:
                if g.released:
                    continue
                way = self._ask(g, float(t))
                if way is None:
                    releasing.append(g)
                    continue
                rows[r, g.rows] = self._rest[g.nodes] + way
            if releasing:
                if r == 0:
                    for g in releasing:
                        g.released = True
                return rows[:r], True
        return rows, False

    def places(self, t: float) -> np.ndarray:
        """Positions (n_prescribed, 3) of the led nodes at a time [m], nan on axes that are free or let go by then."""
        places = np.full((self.n_prescribed, 3), np.nan)
        for g in self._groups:
            way = None if g.released else self._ask(g, t)
            if way is not None:
                places[g.rows] = np.where(g.constraint.axes, self._rest[g.nodes] + way, np.nan)
        return places

    def accelerations(self, start: float, dt: float, middle: bool) -> np.ndarray:
        """Accelerations (n_prescribed, 3) [m/s^2] of the led nodes over the step from start [s]: at its middle, or at its end.

        Second order in dt, from places within the step alone: a jump of the velocity between two steps is no force.
        """
        shares, weights = ((0, 1 / 2, 1), (4, -8, 4)) if middle else ((0, 1 / 3, 2 / 3, 1), (-9, 36, -45, 18))
        total = np.zeros((self.n_prescribed, 3))
        for g in self._groups:
            if g.released:
                continue
            for share, weight in zip(shares, weights):
                way = self._ask(g, start + share * dt)
                if way is None:
                    raise SimulationError(
                        f"body '{g.name}': the path of its moved nodes gave None at t = {start + share * dt:g} s, "
                        "but a displacement later: released nodes stay free"
                    )
                total[g.rows] += weight / dt**2 * way
        return total

    @staticmethod
    def _ask(group: _Group, t: float) -> np.ndarray | None:
        """A path's displacement at t, checked; SimulationError names the body, the time and the rule."""
        what = f"body '{group.name}': the path of its moved nodes"
        try:
            way = group.constraint.path(t)
            if way is None:
                return None
            way = np.asarray(way, dtype=np.float64)
        except Exception as error:  # a user's function may raise anything
            raise SimulationError(f"{what} failed at t = {t:g} s: {type(error).__name__}: {error}") from error
        if way.shape not in ((3,), (len(group.nodes), 3)) or not np.isfinite(way).all():
            raise SimulationError(
                f"{what} gave {way.tolist() if way.size < 10 else way.shape} at t = {t:g} s: "
                f"it must be finite, of shape (3,) or ({len(group.nodes)}, 3)"
            )
        return way
