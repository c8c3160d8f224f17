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

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.dynamics.contact_search import ContactSearch
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.state import copy_nodes

MOST = 4  # sub-steps whose contacts are kept
SLACK = 0.05  # of the finest body's mean surface edge: by how much their nodes may move


class SearchAhead(ContactSearch):
    """Searches of explicit steps. time [s]: of the state of the last one ahead; dt [s], n: of the sub-steps that it may serve;
    done: those taken by batches."""

    drops_uncertain = False

    def __init__(self, simulation: SimulationState, self_collision: bool, arena: FieldArena):
        super().__init__(simulation, self_collision, arena)
        self.x, self._v = (arena.vectors(f"{array}_searched", ti.f64, simulation.model.n_nodes) for array in "xv")
        self.time, self.dt, self.n, self.done = 0.0, 0.0, 0, 0

    def discard(self) -> None:
        """Let no search serve a step any more."""
        super().discard()
        self.discard_ahead()

    def discard_ahead(self) -> None:
        """Let no search serve several sub-steps any more."""
        self.far.forget()
        self.n = self.done = 0

    def snapshot(self) -> dict:
        """Return what later searches depend on, with the state of one that serves several sub-steps."""
        ahead = {}
        if self.n:
            x, v = download([self.x, self._v])
            ahead = {"x": x, "v": v, "time": self.time, "dt": self.dt, "n": self.n, "done": self.done}
        return super().snapshot() | {"ahead": ahead}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        super().restore(kept)
        if ahead := kept.get("ahead"):
            upload([(self.x, np.asarray(ahead["x"])), (self._v, np.asarray(ahead["v"]))])
            self.time, self.dt = float(ahead["time"]), float(ahead["dt"])
            self.n, self.done = int(ahead["n"]), int(ahead["done"])

    def keep(self, time: float, dt: float, n: int) -> int:
        """Return how many of n sub-steps of dt from a time [s] are served by one search, after it was made."""
        if self.n != MOST or not self._left(time, dt):
            self.far.forget()
            self._look_ahead(time, dt, MOST)
        self._look_again()
        self.detection.list_near()
        return min(n, self._left(time, dt))

    def count_done(self, n: int, is_outdated: bool) -> None:
        """Count n sub-steps that kept the contacts. is_outdated: whether the next one needs another search."""
        self.done += n
        if is_outdated or self.done == self.n:
            self.n = self.done = 0

    def adopt(self, time: float, dt: float, found: int, kept: int) -> None:
        """Take over a search at a time, swept by dt, that a batch has made: its contacts before the reduction and after it."""
        self.detection.adopt(found, kept)
        self.measures.begin(dt)
        self.searched, self._is_near = (time, dt), found > 0

    def is_far(self, time: float, dt: float, n_before: int) -> bool:
        """Return whether nothing can touch in a sub-step of dt from a time, see `far_apart`: it needs no search. n_before:
        contacts in the one before."""
        far, simulation = self.far, self._simulation
        if time + dt > far.until:
            far.forget()
            if self._left(time, dt) or n_before or self._is_near or not simulation.now.none_cross or simulation.has_paths:
                return False
            if not far.is_due():
                return False
            far.search(time, dt, self._look_ahead)
        if far.is_known:
            self._look_again()
        return far.is_known

    def _left(self, time: float, dt: float) -> int:
        """Return how many sub-steps of dt from a time the last search ahead may still serve."""
        fits = dt == self.dt and abs(self.time + self.done * dt - time) <= 1e-6 * dt
        return self.n - self.done if fits else 0

    def _look_ahead(self, time: float, dt: float, n: int) -> bool:
        """Search for n sub-steps of dt from a time [s]; return whether nothing can touch in them."""
        now, self.time, self.dt, self.n, self.done = self._simulation.now, time, dt, n, 0
        copy_nodes(self._simulation.model, self.x, self._v, now.x, now.v)
        self._search_ahead()
        return not self._is_near

    def _look_again(self) -> None:
        """Repeat the search that serves several sub-steps, in its state, if a question has made another one since."""
        if self.searched == (self.time, self.n * self.dt):
            return
        simulation, now, is_near = self._simulation, self._simulation.now, self._is_near
        end = simulation.state()
        copy_nodes(simulation.model, now.x, now.v, self.x, self._v)
        try:
            self._search_ahead()
        finally:
            upload(list(zip((now.x, now.v), end)))
        self._is_near = is_near

    def _search_ahead(self) -> None:
        self.find_anew(self.time, self.n * self.dt)
        self.detection.paths.forget()  # the list of near triangles holds as long as the search
