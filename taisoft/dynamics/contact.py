"""Contacts of a step: fills the contact problem of each substep, shared by explicit and implicit steps."""

from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, upload
from taisoft.collision.path_check import NO_PASSAGES
from taisoft.contact.build import (
    build_pair_numbers,
    drop_vanishing,
    end_contacts,
    fill,
    has_impact,
    most_entries,
    scale_impulses,
    upload_pair_numbers,
)
from taisoft.contact.problem import index_nodes
from taisoft.contact.targets import SELF_CONTACT, set_targets
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.dynamics.contact_record import ContactRecord
from taisoft.dynamics.contact_search import ContactSearch
from taisoft.dynamics.misplaced import NO_SUMS, Misplacement
from taisoft.dynamics.part_check import PartCheck
from taisoft.dynamics.readout import MORE_ROWS, ROWS, read_rows
from taisoft.dynamics.rebounds import Rebounds
from taisoft.dynamics.renewal import Renewal
from taisoft.dynamics.search_ahead import SearchAhead
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.scene.obstacles import HalfSpace
from taisoft.scene.rigid import RigidBody

TOLERANCE = {"f32": 1e-4, "f64": 1e-6}  # default for the residual of the contact laws


class ContactStep(ContactRecord):
    """Contacts of the steps of one simulation. explicit: whether the steps are explicit."""

    idle = False  # see `NoContacts`
    # of the finest body's mean surface edge: gap to keep. On curves and between meshes it is the room for a straight way and for
    # means of faces that are not flat; statics on planes needs neither, and there it is small beside what a load moves
    OFFSET, STATIC_OFFSET = 2e-3, 2e-5
    MOST_OFFSET = 0.1  # of the margin: half of what `mortar` takes for near
    MAX_OPENING_SPEED = 0.01  # of the slowest bar wave speed, sqrt(E / rho): of what is corrected; a strain as large

    def __init__(self, simulation: SimulationState, self_collision: bool, explicit: bool, static: bool = False):
        model, scene = simulation.model, simulation.scene
        self._lasting = FieldArena()  # of arrays that stay as they are
        self.search = (SearchAhead if explicit else ContactSearch)(simulation, self_collision, self._lasting)
        self.detection = detection = self.search.detection
        is_flat = detection.overlay is None and all(isinstance(one.shape, HalfSpace) for one in scene.obstacles)
        offset = scene.collision.offset or (self.STATIC_OFFSET if static and is_flat else self.OFFSET)
        offset *= float(detection.edges[: len(scene.bodies)].min())
        if detection.margin > 0.0:
            offset = min(offset, self.MOST_OFFSET * detection.margin / (SELF_CONTACT if self_collision else 1.0))
        super().__init__(simulation, 2 * detection.surface.n_triangles + 1024, offset, static)
        self.paths = ContactPaths(self, self.search, self._lasting)
        self.check = PartCheck(simulation, self.search, self.paths, explicit)
        self.misplaced = Misplacement(simulation, detection)
        self.rebounds = Rebounds(simulation, self._lasting)
        self._renewal = Renewal(self, detection, self._lasting)
        # parts of a penetration and of a missing contact offset that a step corrects
        self._corrections = (0.05, 0.005) if explicit else (1.0, 1.0) if static else (0.2, 0.02)
        self._substep_fraction = 1.0  # of the step, that the current substep takes
        self.gap_targets = self._gap_targets()
        self._numbers_arena = FieldArena()
        self.numbers = build_pair_numbers(self._numbers_arena, scene)
        simulation.now.slip = self._lasting.field("accumulated_slip", ti.f64, model.n_nodes)
        self._explicit = explicit
        rigid = np.array([isinstance(one, RigidBody) for one in scene.colliders], dtype=np.int32)
        self._rigid = self._lasting.field("is_rigid", ti.i32, len(rigid), rigid)

    def forget(self) -> None:
        """Discard all that is known of a state and its past, after another one was set."""
        now = self.simulation.now
        now.flight[:], now.none_cross, now.misplaced = 0.0, False, NO_SUMS
        self.discard()

    def discard(self) -> None:
        """Discard the search, the impulses, and what was measured, after a return to the start of a step."""
        super().discard()
        self.simulation.now.held = NO_PASSAGES
        self._begin_from({})

    def snapshot(self) -> dict:
        """Return what the next step depends on, as in `ContactRecord`, `ContactSearch` and `PartCheck`."""
        search = self.search.snapshot()
        return super().snapshot(MORE_ROWS if search["ahead"] else ROWS) | search | self.check.snapshot()

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        super().restore(kept)
        self._begin_from(kept)

    def _begin_from(self, kept: dict) -> None:
        """Restore searches and what was measured, {}: as at a start; discard what is known of the last step's paths."""
        self.search.restore(kept)
        self.check.restore(kept)
        self.paths.forget()
        self.misplaced.start_step()

    def _gap_targets(self) -> tuple[float, float, float, float]:
        """Contact offset [m]; fractions of a penetration and of a missing offset corrected per substep; maximum speed [m/s]."""
        slowest = min(b.composition.lowest_wave_speed for b in self.simulation.scene.bodies)
        fraction, (penetration, offset) = 1.0 if self._static else self._substep_fraction, self._corrections
        return self.contact_offset, fraction * penetration, fraction * offset, self.MAX_OPENING_SPEED * slowest

    def numbers_changed(self) -> None:
        """Upload changed friction or restitution, which the next sub-step uses."""
        self.search.discard()
        self.rebounds.numbers_changed()
        if not upload_pair_numbers(self.numbers, self.simulation.scene):
            arena = FieldArena()
            self.numbers = build_pair_numbers(arena, self.simulation.scene)
            self._numbers_arena.release()
            self._numbers_arena = arena

    def start_step(self, time: float, dt: float) -> None:
        """Begin a step of dt from a time."""
        self.check.start_step(time, dt)
        self._substep_fraction, self._step_dt, self.dropped, self._pairs = 1.0, dt, 0, None
        self.paths.start_step()
        self.misplaced.start_step()

    def start_substep(self, dt: float) -> None:
        """Begin a substep of dt, or begin it again with another length."""
        self._substep_fraction = dt / self._step_dt
        self.paths.begin()

    def make_room(self) -> None:
        """Prepare the problem for the contacts of the last search. If it grows, their impulses are lost."""
        counts = self.detection.counts
        self.gap_targets, self.dropped = self._gap_targets(), max(self.dropped, counts.unmapped)
        entries = most_entries(self.simulation.model, counts.contacts, self.detection.buffer.n_listed)
        if room := self._room(counts.contacts, entries):
            self._allocate(*room)
            self._last_time = 0.0

    def begin(self, time: float, dt: float) -> int:
        """Fill the problem for a substep of dt [s] from the state at a time, warm-started. Return its number of contacts."""
        if self._explicit:
            self.search.discard_ahead()
        n, model = self.search.find(time, dt), self.simulation.model
        (surface, shapes, found, kept), counts = self.detection.found, self.detection.counts
        self.make_room()
        problem = self.problem
        if model.has_dependents and n:
            n = drop_vanishing(problem, model, surface, found, kept, n, 0, 0)  # the past's entries are needed no more
        indexes = int(n > 0 or self._indexed)  # an empty index needs no update
        what = model, surface, shapes, self.numbers, found, self.detection.reduction
        fill(problem, *what, n, dt, self.warm_factor(dt), self.contact_offset, indexes)
        self.take_over(dt, n, counts.found, counts.unmapped)
        self._indexed = n > 0
        if not self._explicit:
            set_targets(problem, dt, *self.gap_targets)
        self.sides, self._renewal.n_looks = self.detection.sides(kept.to_numpy(n)) if model.has_dependents else None, 0
        return n

    def warm_factor(self, dt: float) -> float:
        """Return the factor of the last substep's impulses from which one of dt [s] starts."""
        return dt / self._last_time if self._last_time > 0.0 else 0.0

    def renew(self, x_start: Any, displacement: Any) -> bool:
        """Take the contacts' geometry at displacements from x_start, (n_nodes) 3-vectors f64 [m] each; return whether it changed.

        Impulses and targets pass to the new contacts. `problem` is another one if it had to grow.
        """
        renewal = self._renewal
        needed = renewal.look(*self.search.searched, x_start, displacement)
        if not needed:
            return False
        self._n_contacts = renewal.n_contacts
        entries = most_entries(self.simulation.model, needed - self.n_contacts, self.detection.end.buffer.n_listed)
        if room := self._room(needed, renewal.n_entries + entries):
            rows, mass = read_rows(self.problem, MORE_ROWS), self.problem.inverse_mass.to_numpy()
            self._allocate(*room)
            self._put(rows, self.sides)
            upload([(self.problem.inverse_mass, mass)])
            index_nodes(self.problem)
        adopted = renewal.adopt(self.numbers, self._step_dt, x_start, displacement)
        if adopted:
            self._n_contacts = None
        return adopted

    def detect_impact(self, dt: float) -> bool:
        """Return, and set `had_impact` to, whether surfaces without impulse so far meet in the step of dt that has begun."""
        self.had_impact = bool(has_impact(self.problem, self._rigid, dt, self.contact_offset))
        return self.had_impact

    def detect_rebounds(self, dt: float) -> bool:
        """Return whether surfaces rebound in the implicit step of dt that has begun; if so, set `had_impact`."""
        if self.n_contacts == 0:
            return False
        found = self.rebounds.detect(self.problem, dt, self.contact_offset)
        self.had_impact = self.had_impact or found
        return found

    def end_part(self, time: float, dt: float, x_start: Any, dissipative: bool) -> None:
        """End a part of a step at a time, from which the next one of dt is searched, see `PartCheck.end` and `end_substep`."""
        self.check.end_part(time, dt)
        self.end_substep(x_start)
        self.rebounds.count_flight(self.problem, self.n_contacts, self._substep_fraction * self._step_dt, dissipative)

    def end_substep(self, x_start: Any) -> None:
        """Add impulses and slips of a substep that began at positions x_start, and what they misplace; set gaps at its end.

        Check the paths of colliders that do not cross any more.
        """
        if self.n_contacts:
            dt, simulation = self._substep_fraction * self._step_dt, self.simulation
            if not self._explicit:
                self.misplaced.add(self.problem, dt, self.contact_offset, self.paths.has_found)
            end_contacts(self.problem, simulation.model, x_start, simulation.now.slip, dt if self._explicit else 0.0)
        if not self.paths.none_cross:
            self.paths.exempt_crossing()
        if self._substep_fraction < 1.0 and not self._static:
            self._pairs = self._sum_pairs()

    def warm_up(self, time: float, dt: float, x_start: Any, displacement: Any) -> None:
        """Launch the kernels that only steps with contacts need, after a search at a time for a step of dt [s]; the state and the
        contacts are then invalid."""
        self.detection.warm_up()
        self._renewal.warm_up(self.numbers, (time, dt), x_start, displacement)
        scale_impulses(self.problem, 1.0)
        self.search.measures.drop_uncertain()
        self.misplaced.add(self.problem, dt, self.contact_offset, False)
        end_contacts(self.problem, self.simulation.model, x_start, self.simulation.now.slip, 0.0)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of every allocated field by name."""
        return self.detection.field_bytes | self._arena.bytes | self._numbers_arena.bytes | self._lasting.bytes

    def release(self) -> None:
        """Free all memory."""
        self.detection.release()
        for owner in (self._arena, self._numbers_arena, self._lasting, self.misplaced):
            owner.release()
