"""Renewal of the contacts' geometry at the iterates of an implicit stage, see `contact_geometry`."""

import math
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download
from taisoft.collision.detector import Detection
from taisoft.collision.end_search import EndSearch
from taisoft.contact.build import PairNumbers, drop_vanishing
from taisoft.contact.problem import index_nodes
from taisoft.dynamics.asleep import Sides
from taisoft.dynamics.contact_geometry import IN_PLACE, KEPT, REJECTED, STILL, adopt, judge, largest_motion
from taisoft.dynamics.contact_record import ContactRecord
from taisoft.dynamics.readout import join_sides
from taisoft.dynamics.state import copy_values


class Renewal:
    """Renews the contacts of one step."""

    # in a stage: each leaves about a quarter of the error of the normals, and they must end for Newton to converge
    MAX_LOOKS = 4
    TRUSTED = 1.0  # of the mean edge: iterates farther from the searched paths are not looked at

    def __init__(self, record: ContactRecord, detection: Detection, arena: FieldArena):
        self._record, self._model, self._detection = record, record.simulation.model, detection
        self._seen = arena.vectors("seen_displacement", ti.f64, self._model.n_nodes)  # at the last look [m]
        self.n_looks = 0  # in this stage
        self._found: EndSearch | None = None  # by the last look,
        self.n_contacts = self.n_entries = 0  # and those of the problem then, and their entries

    def look(self, time: float, dt: float, x_start: Any, displacement: Any) -> int:
        """Find the contacts at displacements from x_start, (n_nodes) 3-vectors f64 [m] each, in a substep of dt from a time [s].

        Return the number of contacts that the problem needs room for if these are to be adopted; 0 if nothing changes. Sets
        `n_contacts` and `n_entries`.
        """
        problem = self._record.problem
        if self.n_looks == self.MAX_LOOKS:
            return 0
        moved = largest_motion(problem, self._detection.shapes, displacement, self._seen, self.n_looks)
        if not moved > STILL * self._record.contact_offset:
            return 0
        self.n_looks += 1
        copy_values(self._model, self._seen, displacement)
        farthest = self.TRUSTED * self._detection.edge
        self._found = end = self._detection.find_at_end(time, dt, x_start, displacement, farthest, [problem.count])
        if end is None:
            return 0
        self.n_contacts, _, self.n_entries = end.also[0]
        return end.reduction.n_kept + self.n_contacts

    def adopt(self, numbers: PairNumbers, dt: float, x_start: Any, displacement: Any) -> bool:
        """Replace the contacts by those that `look` has found, for which there must be room; return whether any changed.

        dt [s]: of the whole step; the others are those of `look`.
        """
        problem, model, detection, end = self._record.problem, self._model, self._detection, self._found
        s, shapes, (surface, found, kept, n) = detection.surface, detection.shapes, end.found
        if model.has_dependents and n:
            n = drop_vanishing(problem, model, s, found, kept, n, self.n_contacts, self.n_entries)
        lengths = dt, self._record.contact_offset, detection.margin, detection.floor
        if not judge(problem, s, surface, shapes, x_start, displacement, found, kept, n, *lengths):
            return False
        if self._record.sides is not None:
            self._record.sides = self._renewed_sides(n)
        adopt(problem, model, s, shapes, numbers, x_start, displacement, found, kept, n)
        index_nodes(problem)
        return True

    def warm_up(self, numbers: PairNumbers, times: tuple, x_start: Any, displacement: Any) -> None:
        """Launch all kernels, as if no contacts had been found. times: see `look`, of the last search."""
        problem, model, detection, offset = self._record.problem, self._model, self._detection, self._record.contact_offset
        s, shapes, lengths = detection.surface, detection.shapes, (times[1], offset, detection.margin, detection.floor)
        largest_motion(problem, shapes, displacement, self._seen, 0)
        copy_values(model, self._seen, displacement)
        surface, found, kept, _ = detection.find_at_end(*times, x_start, displacement, math.inf).found
        if model.has_dependents:
            drop_vanishing(problem, model, s, found, kept, 0, 0, 0)
        judge(problem, s, surface, shapes, x_start, displacement, found, kept, 0, *lengths)
        adopt(problem, model, s, shapes, numbers, x_start, displacement, found, kept, 0)
        index_nodes(problem)

    def _renewed_sides(self, n: int) -> Sides:
        """Return `ContactRecord.sides` as `adopt` will update the contacts, n of which were found."""
        problem, end = self._record.problem, self._found
        (fate,) = download([problem.renewal.fate], problem.count[0])
        rows = end.reduction.work.kept.to_numpy(n)[problem.renewal.match.to_numpy(n) != REJECTED]
        stay = np.isin(fate, (KEPT, IN_PLACE))
        kept = tuple(side[: len(stay)][stay] for side in self._record.sides)
        return join_sides(kept, self._detection.sides(rows, end.buffer.data))
