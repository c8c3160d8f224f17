"""Nothing crosses: passages on the paths of a part of a step, contacts that hold them apart, what is held back if they fail.

A part is accepted only if no pair of surfaces passes through each other on its straight paths (`collision.passages`), or on a
bent path (`collision.bent_path`). Else pairs that pass become contacts, with which it is solved on. They stay in the next parts
while they carry an impulse. If passages are left where it cannot be halved, whole bodies are held back: their paths are shortened
until nothing passes, and the step counts as not converged.
"""

import numpy as np
import taichi as ti
from scipy.sparse.csgraph import connected_components

from taisoft.backend.arrays import FieldArena, download
from taisoft.collision.contacts import FACE_FACE
from taisoft.collision.near_list import SEARCHED, TO_STATE
from taisoft.collision.passages import FLAT, N_FEATURES, N_KINDS
from taisoft.collision.path_check import NO_PASSAGES, HeldPassages
from taisoft.dynamics.contact_measures import find_displacement
from taisoft.dynamics.contact_record import ContactRecord
from taisoft.dynamics.contact_search import ContactSearch
from taisoft.dynamics.state import StepState
from taisoft.errors import SimulationError
from taisoft.fem.state import DEVIATION
from taisoft.scene.connections import attached_pairs


class ContactPaths:
    """Check the paths of parts of steps and hold the passages found."""

    MAX_UNCHANGED = 3  # checks in a row that find the same pairs, after which solving on does not help
    SHORTENED = 0.9  # of the part of a path that is certainly free: how far bodies that are held back move
    MAX_SHORTENINGS, LEAST = 30, 1e-6  # rounds, and part of a path: beyond these, they do not move at all

    def __init__(self, record: ContactRecord, search: ContactSearch, arena: FieldArena):
        simulation, detection = record.simulation, search.detection
        self._record, self._search, self._simulation, self._detection = record, search, simulation, detection
        self.uncovered = False  # whether the paths of the last check left what was searched
        self.held_back = ""  # a sentence about the last step, if bodies were held back,
        self._names: set[str] = set()  # and their names
        self._n_unchanged = 0  # checks in a row that found no pairs but those held already
        self.has_found = False  # whether any passage was found in this part of a step
        self._held = NO_PASSAGES  # in this part so far
        n_bodies = len(detection.scene.bodies)
        n, group = connected_components(attached_pairs(detection.scene)[:n_bodies, :n_bodies])
        self._attached = [np.flatnonzero(group == k) for k in range(n) if (group == k).sum() > 1]  # move as one if held back
        detection.prepare_paths()
        self.displacement = arena.vectors("path", ti.f64, simulation.model.n_nodes)  # of `keep_path` [m]

    def forget(self) -> None:
        """Discard all lists, after a state was set."""
        self._detection.paths.forget()
        self.start_step()

    @property
    def is_stuck(self) -> bool:
        """Whether solving on does not help any more: the same pairs pass, although they are contacts."""
        return self._n_unchanged >= self.MAX_UNCHANGED

    def start_step(self) -> None:
        """Begin a step, in which no bodies have been held back yet."""
        self.held_back = ""
        self._names.clear()

    @property
    def none_cross(self) -> bool:
        """Whether no colliders crossed at the start of the part, so that all paths are checked."""
        return self._simulation.now.none_cross

    def begin(self) -> None:
        """Begin a part of a step."""
        self._held, self._n_unchanged, self.has_found = self._simulation.now.held, 0, False

    def leaves(self, deviation: float) -> bool:
        """Return whether a path so far from the searched one [m] leaves it."""
        return deviation > 0.5 * self._detection.margin

    def keep_path(self, x_start) -> None:
        """Keep the displacement since x_start for another search."""
        find_displacement(self._simulation.model, self._detection.surface, x_start, self.displacement)

    def find_unless_left(self, x_start) -> tuple[bool, bool]:
        """Keep the path from x_start, see `keep_path`. Return whether it left what was searched, and else what `find` returns."""
        model, paths = self._simulation.model, self._detection.paths
        self.keep_path(x_start)
        if model.on_cpu:
            has_left = self.leaves(model.state.scalars[DEVIATION])
            return has_left, not has_left and self.find()
        found = self._detection.passages(TO_STATE, [model.state.scalars])  # one reading for both
        has_left = self.leaves(paths.also[0][DEVIATION])
        return has_left, not has_left and self._hold_found(self._unless_bent(found, TO_STATE))

    def find(self, as_searched: bool = False) -> bool:
        """Find the passages on the paths from the last search to the present state, or on the searched paths, and hold them from
        now on. Return whether there are any, or whether the paths leave what was searched."""
        return self._hold_found(self._passages(SEARCHED if as_searched else TO_STATE))

    def _hold_found(self, found: tuple[np.ndarray, np.ndarray] | None) -> bool:
        """See `find`."""
        self.uncovered = found is None
        if found is None:
            return True
        if len(found[0]):
            self._hold(*found)
        return len(found[0]) > 0

    def _passages(self, mode: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the passages on the paths of a mode, none if a bent path is free, see `collision.bent_path`."""
        return self._unless_bent(self._detection.passages(mode), mode)

    def _unless_bent(self, found: tuple[np.ndarray, np.ndarray] | None, mode: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the passages found on the paths of a mode, none if a bent path is free."""
        if found is None or len(found[0]) == 0 or (found[0][:, 0] == FLAT).any():
            return found
        return NO_PASSAGES if self._detection.bends(mode) else found

    def _hold(self, pairs: np.ndarray, times: np.ndarray) -> None:
        """Hold passages and the parts of the step until which they are apart; those of the same features once."""
        held, n_held, self.has_found = self._held, len(self._held.pairs), True
        every, time = np.concatenate([held.pairs, pairs]), np.concatenate([held.times, times])
        _, first, group = np.unique(self._detection.paths.features(every), axis=0, return_index=True, return_inverse=True)
        earliest = np.full(len(first), np.inf)
        np.minimum.at(earliest, group.reshape(-1)[n_held:], times)
        self._n_unchanged = self._n_unchanged + 1 if len(first) == n_held else 0
        again = np.isfinite(earliest)
        self._held = HeldPassages(every[first], np.where(again, earliest, time[first]))

    def search_along(self, time: float, dt: float) -> None:
        """Search along `displacement` from the present state, with all passages held, at their times along the searched paths."""
        self._simulation.now.held = self._held
        self._search.discard()
        self._search.find_anew(time, dt, path=self.displacement)

    def search_way(self, time: float, dt: float, start: StepState) -> None:
        """Search the way from a start to the present state, which stays."""
        self.keep_path(start.x)
        end = self._simulation.state()
        self._simulation.now.copy_nodes_from(start)
        self.search_along(time, dt)
        self._simulation.set_state(*end)

    def use_active(self) -> None:
        """Let the next search add the passages held that carry an impulse, at its positions."""
        if len(self._held.pairs) == 0:
            return
        problem = self._record.problem
        feature, impulse = download([problem.feature, problem.r], problem.count[0])
        active = feature[(feature[:, 0] == FACE_FACE) & (impulse[:, 0] > 0.0)]
        one, other = active[:, 1], active[:, 2]
        keys = set(zip(*(x.tolist() for x in (one % N_KINDS, one // N_KINDS, other // N_FEATURES, other % N_FEATURES))))
        kept = np.array([tuple(pair) in keys for pair in self._held.pairs.tolist()], dtype=bool)
        self._simulation.now.held = HeldPassages.at_start(self._held.pairs[kept])

    def exempt_crossing(self) -> None:
        """Exempt the colliders that cross at the last search, and no others."""
        self._simulation.now.none_cross = not self._detection.exempt_crossing()
        if self.none_cross:
            self._search.discard()  # other contacts are found there

    def hold_back(self, x_start) -> bool:
        """Shorten the paths of bodies from x_start to the present state until nothing passes through anything; return whether any
        had to be. The last search must have started there. Raise SimulationError if nothing passes only where no body can be
        held back."""
        simulation, detection = self._simulation, self._detection
        free = simulation.model.free.to_numpy() > 0
        path = free, x_start.to_numpy(), *simulation.state()
        can_move = np.zeros(len(detection.scene.colliders), dtype=bool)
        for body in range(len(simulation.scene.bodies)):
            can_move[body] = free[simulation.layout.nodes(body)].any()
        for together in self._attached:  # a body all of whose nodes depend on others moves with them
            inert = [k for k in together if not can_move[k] and not simulation.scene.bodies[k].constraints]
            can_move[inert] = can_move[together].any()
        part, n_rounds = can_move.astype(np.float64), 0
        while len((found := self._passages(TO_STATE))[0]):
            colliders, n_rounds = detection.paths.colliders(found[0]), n_rounds + 1
            stuck = ~(part[colliders] > 0.0).any(axis=1)
            if stuck.any():
                self._refuse(*colliders[stuck][0])
            shortened = np.ones(len(part))
            for side in range(2):
                np.minimum.at(shortened, colliders[:, side], self.SHORTENED * found[1])
            part = np.where(shortened < 1.0, part * shortened if n_rounds < self.MAX_SHORTENINGS else 0.0, part)
            part[part < self.LEAST] = 0.0
            for together in self._attached:
                moving = together[can_move[together]]
                part[moving] = part[moving].min(initial=1.0)
            self._move_in_part(part, *path)
        if n_rounds == 0:
            return False
        self._names.update(detection.scene.colliders[k].name for k in np.flatnonzero(can_move & (part < 1.0)))
        listed = ", ".join(f"'{name}'" for name in sorted(self._names))
        self.held_back = f"held back {listed}, which would have passed through another surface or through itself"
        return True

    def _refuse(self, a: int, b: int) -> None:
        """Raise SimulationError about two colliders that pass through each other wherever bodies stay."""
        one, other = (self._detection.scene.colliders[k].name for k in (a, b))
        raise SimulationError(
            f"step {self._simulation.step_count + 1}: no motion was found that keeps '{one}' and '{other}' from passing through "
            "each other, as one of them moves as prescribed: leave more room, or take a smaller dt"
        )

    def _move_in_part(self, part: np.ndarray, free: np.ndarray, start: np.ndarray, end: np.ndarray, velocity: np.ndarray) -> None:
        """Set the state to a part of each body's path, given with its velocities, (n_nodes, 3); what is not free stays at the
        end. part: (n_colliders,)."""
        simulation, x, v = self._simulation, end.copy(), velocity.copy()
        for body in range(len(simulation.scene.bodies)):
            rows = simulation.layout.nodes(body)
            if part[body] < 1.0:
                x[rows] = np.where(free[rows], start[rows] + part[body] * (end[rows] - start[rows]), end[rows])
                v[rows] = np.where(free[rows], part[body] * velocity[rows], velocity[rows])
        simulation.set_state(x, v)
