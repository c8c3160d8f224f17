"""Dirichlet conditions: constrained axes, target positions of prescribed nodes over time, and their release."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.fem.model import Layout
from taisoft.scene import checks
from taisoft.scene.body import Constraint
from taisoft.scene.scene import Scene

ROUNDING = 1e-9  # of a time: a step that ends this near a release still follows the path


@dataclass
class MovedNodes:
    """Nodes whose motion is prescribed along some axes."""

    name: str  #: of the body
    constraint: Constraint
    of_move: bool  #: whether `Body.move` holds them, not an obstacle
    nodes: np.ndarray  #: (k,) rows of the model
    rows: slice  #: rows among the prescribed nodes
    path: Callable  #: t [s] -> displacement (3,) or (k,3) [m]; the constraint's, or a command

    @property
    def given_path(self) -> Callable:
        """The path of the constraint."""
        return self.constraint.path


class DirichletConditions:
    """Constraints of all bodies.

    groups: nodes moved by `Body.move` or by a moving obstacle; released (n_groups,) bool: those that move freely by now.
    prescribed_nodes (n_prescribed,): model rows, group by group; a node prescribed by two groups on different axes has two rows.
    held (n_held,): model rows with a constrained axis at the start.
    """

    def __init__(self, scene: Scene, layout: Layout):
        self._rest = layout.rest
        self._fixed = np.zeros((len(layout.rest), 3), dtype=bool)
        self.groups: list[MovedNodes] = []
        n_prescribed = 0
        for k, body in enumerate(scene.bodies):
            for c in scene.constraints(body):
                rows = c.nodes + layout.node_start[k]
                if c.path is None:
                    self._fixed[np.ix_(rows, np.flatnonzero(c.axes))] = True
                else:
                    held = slice(n_prescribed, n_prescribed + len(rows))
                    self.groups.append(MovedNodes(body.name, c, c in body.constraints, rows, held, c.path))
                    n_prescribed += len(rows)
        self.prescribed_nodes = np.concatenate([g.nodes for g in self.groups]) if self.groups else np.zeros(0, dtype=np.int64)
        self.released = np.zeros(len(self.groups), dtype=bool)
        self.held = np.flatnonzero(self.constrained().any(axis=1))

    @property
    def _moved(self) -> list[MovedNodes]:
        """The groups that are not released."""
        return [group for group, released in zip(self.groups, self.released.tolist()) if not released]

    @property
    def n_prescribed(self) -> int:
        """Rows of prescribed nodes, including released ones."""
        return len(self.prescribed_nodes)

    def constrained(self) -> np.ndarray:
        """Return the axes that are now fixed or prescribed, (n_nodes, 3) bool."""
        mask = self._fixed.copy()
        for g in self._moved:
            mask[np.ix_(g.nodes, np.flatnonzero(g.constraint.axes))] = True
        return mask

    def prescribed_axes(self) -> np.ndarray:
        """Return 1 for each row's axes that are now prescribed, (n_prescribed, 3) int32."""
        axes = np.zeros((self.n_prescribed, 3), dtype=np.int32)
        for g in self._moved:
            axes[g.rows] = g.constraint.axes
        return axes

    def targets(self, times: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return positions of the prescribed nodes at the times (k,) [s], the ends of steps, up to the first release.

        A step that ends at the moment of a release follows the path to there: it is the next one that is free.
        Returns (r, n_prescribed, 3) [m] with r <= k, and whether a group is released at times[r]. If r = 0, those groups are
        then marked as released, and the call must be repeated.
        """
        rows = np.zeros((len(times), self.n_prescribed, 3))
        for r, t in enumerate(times):
            releasing = np.zeros_like(self.released)
            for k in np.flatnonzero(~self.released):
                g = self.groups[k]
                displacement = self._displacement_by(g, float(t))
                releasing[k] = displacement is None
                if displacement is not None:
                    rows[r, g.rows] = self._rest[g.nodes] + displacement
            if releasing.any():
                if r == 0:
                    self.released |= releasing
                return rows[:r], True
        return rows, False

    def target_positions(self, t: float) -> np.ndarray:
        """Return positions (n_prescribed, 3) of the prescribed nodes at a time [m], nan on axes free or released by then."""
        target_positions = np.full((self.n_prescribed, 3), np.nan)
        for g in self._moved:
            displacement = self._displacement_by(g, t)
            if displacement is not None:
                target_positions[g.rows] = np.where(g.constraint.axes, self._rest[g.nodes] + displacement, np.nan)
        return target_positions

    def accelerations(self, start: float, dt: float, middle: bool) -> np.ndarray:
        """Return accelerations (n_prescribed, 3) [m/s^2] of the prescribed nodes at the middle or end of the step from start [s].

        Second order in dt, by differences within the step alone, so that a velocity jump between two steps gives no force.
        """
        fractions, weights = ((0, 1 / 2, 1), (4, -8, 4)) if middle else ((0, 1 / 3, 2 / 3, 1), (-9, 36, -45, 18))
        total = np.zeros((self.n_prescribed, 3))
        for g in self._moved:
            length = dt
            if self._displacement(g, start + dt) is None:  # released as the step ends
                length = (start + dt) * (1.0 - ROUNDING) - start
            for fraction, weight in zip(fractions, weights):
                displacement = self._displacement(g, start + fraction * length)
                if displacement is None:
                    raise SimulationError(
                        f"body '{g.name}': moved nodes: the path gave None at t = {start + fraction * length:g}, "
                        "but a displacement later: released nodes stay free"
                    )
                total[g.rows] += weight / length**2 * displacement
        return total

    def _displacement_by(self, group: MovedNodes, t: float) -> np.ndarray | None:
        """Return a path's displacement at the end t [s] of a step; at the moment of a release, the last one before."""
        displacement = self._displacement(group, t)
        return self._displacement(group, t * (1.0 - ROUNDING)) if displacement is None else displacement

    @staticmethod
    def _displacement(group: MovedNodes, t: float) -> np.ndarray | None:
        """Return a path's displacement at t, checked; a SimulationError names the body, the time and the rule."""
        what = f"body {group.name!r}: moved nodes"
        with reworded(SceneError, raised=SimulationError):
            return checks.path_value(group.path, t, what, "displacement", ((3,), (len(group.nodes), 3)))
