"""A search that serves several explicit sub-steps, and the state that it was made from.

Its contacts are kept: their features, normals and weights stay, the gaps follow the motion. It is made along x + t v, t up to the
end of the last sub-step that it may serve, so it finds what comes near until then. A new one is needed earlier once the nodes of
contacts have moved by more than a slack, motion in common left out: up to there, a gap changes linearly but for the slack times
the angle by which surfaces turn or bend. That holds between meshes and over half-spaces; beside other obstacles no contacts are
kept, as a body can pass them as a whole. Accuracy alone rests on the slack, since the path of each sub-step is checked, among the
triangles that were near at the search: no others can touch while no vertex leaves its searched path by half the reach. One that
does is an event, as is a path that is not free.

All that the coming sub-steps depend on is kept in checkpoints. A search that a question has made meanwhile is undone by repeating
this one.
"""

from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.state import copy_nodes

MOST = 4  # sub-steps whose contacts are kept
SLACK = 0.05  # of the finest body's mean surface edge: by how much their nodes may move


class SearchAhead:
    """Such a search. time [s]: of its state; dt [s], n: of the sub-steps that it may serve; done: those taken by batches."""

    def __init__(self, simulation: SimulationState, arena: FieldArena):
        self._simulation = simulation
        self.x, self._v = (arena.vectors(f"{array}_searched", ti.f64, simulation.model.n_nodes) for array in "xv")
        self.time, self.dt, self.n, self.done = 0.0, 0.0, 0, 0

    def begin(self, time: float, dt: float, n: int) -> None:
        """Take over a search that was made from the present state."""
        now, self.time, self.dt, self.n, self.done = self._simulation.now, time, dt, n, 0
        copy_nodes(self._simulation.model, self.x, self._v, now.x, now.v)

    def left(self, time: float, dt: float) -> int:
        """Return how many sub-steps of dt from a time it may still serve."""
        fits = dt == self.dt and abs(self.time + self.done * dt - time) <= 1e-6 * dt
        return self.n - self.done if fits else 0

    def forget(self) -> None:
        """Discard it."""
        self.n = self.done = 0

    @property
    def searched(self) -> tuple[float, float]:
        """Time and length [s] of what was searched."""
        return self.time, self.n * self.dt

    def call_there(self, function: Any) -> None:
        """Call a function in the state of the search, which it must not change."""
        simulation, now = self._simulation, self._simulation.now
        end = simulation.state()
        copy_nodes(simulation.model, now.x, now.v, self.x, self._v)
        try:
            function()
        finally:
            upload(list(zip((now.x, now.v), end)))

    def snapshot(self) -> dict:
        """Return it for a checkpoint; empty if there is none."""
        if not self.n:
            return {}
        x, v = download([self.x, self._v])
        return {"x": x, "v": v, "time": self.time, "dt": self.dt, "n": self.n, "done": self.done}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.n = self.done = 0
        if kept:
            upload([(self.x, np.asarray(kept["x"])), (self._v, np.asarray(kept["v"]))])
            self.time, self.dt, self.n, self.done = float(kept["time"]), float(kept["dt"]), int(kept["n"]), int(kept["done"])
