"""Searches for contacts, and for which step the last one holds: that at the end of a step also serves the next one."""

import numpy as np

from taisoft.backend.arrays import FieldArena
from taisoft.collision.detector import Detection
from taisoft.dynamics.contact_measures import ContactMeasures
from taisoft.dynamics.far_apart import FarApart
from taisoft.dynamics.simulation_state import SimulationState


class ContactSearch:
    """Searches of implicit steps; `SearchAhead` makes those of explicit ones."""

    drops_uncertain = True  # whether what may never touch is dropped where nothing crosses

    def __init__(self, simulation: SimulationState, self_collision: bool, arena: FieldArena):
        self._simulation = simulation
        self.detection = Detection(simulation.scene, simulation.model, simulation.layout, simulation.runtime, self_collision)
        self.measures = ContactMeasures(self.detection, arena)
        self.far = FarApart(simulation, self.detection)
        self.n_searches = 0  # so far
        self.searched: tuple[float, float] | None = None  # time and dt of the last one, if it is valid
        self._is_near = False  # whether it found anything near

    def discard(self) -> None:
        """Let no search serve a step any more, after a change of the state, of numbers or of motion."""
        self.searched = None

    def snapshot(self) -> dict:
        """Return what later searches depend on, not what was found: from the same state the next one finds the same contacts in
        the same order."""
        return {"far": self.far.snapshot(), "near": self._is_near, "ahead": {}}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`; an empty one, that of a start."""
        self.discard()
        self.far.restore(kept.get("far", {}))
        self._is_near = bool(kept.get("near"))

    def find(self, time: float, dt: float) -> int:
        """Find the contacts of the present state at a time [s], swept by dt, unless known. Return their number."""
        searched = self.searched
        if searched is None or searched[1] != dt or abs(searched[0] - time) > 1e-6 * dt:
            self.find_anew(time, dt, prescribed=self._simulation.prescribed_moves(time + dt))
        return self.detection.counts.contacts

    def find_anew(self, time: float, dt: float, **along) -> None:
        """Call `Detection.find`."""
        now, counts = self._simulation.now, self.detection.counts
        self.n_searches, self.searched = self.n_searches + 1, None
        self.measures.begin(dt)
        self.detection.find(time, dt, held=now.held, none_cross=now.none_cross, **along)
        self.searched, self._is_near = (time, dt), counts.active + counts.found > 0
        if self.drops_uncertain and now.none_cross and counts.contacts:
            self.measures.drop_uncertain()

    def find_all(self, time: float, dt: float) -> None:
        """Do as `find`, among sleeping bodies, too; then the next step searches again."""
        rests, is_near = self.detection.surface.rests.to_numpy() > 0, self._is_near
        if rests.any():
            self.let_rest(np.zeros_like(rests))
        self.find(time, dt)
        self._is_near = is_near
        if rests.any():
            self.let_rest(rests)

    def let_rest(self, colliders: np.ndarray) -> None:
        """Search no contacts among colliders (n,) bool from now on, but all others."""
        self.discard()
        if self.detection.let_rest(colliders):
            self.detection.paths.forget()  # lists of near pairs lack those

    def touching(self, colliders: np.ndarray) -> np.ndarray:
        """Return those of some colliders (n,) bool that have contacts in the last search."""
        body = self.detection.buffer.data.body[self.detection.kept.to_numpy(self.detection.counts.contacts)]
        return colliders & np.isin(np.arange(len(colliders)), body)

    def found_features(self) -> set[tuple]:
        """Return the features of the contacts of the last search."""
        detection = self.detection
        found = detection.buffer.data.feature[detection.kept.to_numpy(detection.counts.contacts)]
        return set(map(tuple, found.tolist()))
