"""Contacts of a step: detection, contact problem and penetration checks, shared by explicit and implicit steps.

The search at the end of each step also serves the next one, and measures how deep bodies penetrate each other.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.collision.contacts import Contacts
from taisoft.collision.detector import Detection
from taisoft.collision.intersections import CROSSED
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
from taisoft.contact.problem import build_node_problem, index_nodes
from taisoft.contact.targets import SELF_CONTACT, set_targets
from taisoft.dynamics.asleep import AsleepContacts, Rows, Sides, join, select
from taisoft.dynamics.contact_measures import DEEP_PENETRATION, DEPTH, RELATIVE_PENETRATION, ContactMeasures, Crossing
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.dynamics.far_apart import FarApart
from taisoft.dynamics.misplaced import NO_SUMS, Misplacement
from taisoft.dynamics.part_length import PARTS
from taisoft.dynamics.readout import (
    MORE_ROWS,
    ROWS,
    ContactRows,
    Pairs,
    join_contacts,
    join_sides,
    nodal_impulses,
    offsets_of,
    read_contacts,
    read_rows,
    slip_velocities,
    sum_on,
    sum_pairs,
    write_rows,
)
from taisoft.dynamics.rebounds import Rebounds
from taisoft.dynamics.renewal import Renewal
from taisoft.dynamics.search_ahead import MOST, SearchAhead
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.state import StepState
from taisoft.dynamics.surface_loads import ContactPressure, SurfaceLoads
from taisoft.errors import SimulationError
from taisoft.scene.obstacles import HalfSpace
from taisoft.scene.rigid import RigidBody

MAX_PASSAGES = 8  # repetitions of a part with what its way meets
FREE, MET, BLOCKED = range(3)  # ways: nothing passes; contacts were met that are known now; they are known, but do not help
TOLERANCE = {"f32": 1e-4, "f64": 1e-6}  # default for the residual of the contact laws


class ContactStep:
    """Find the contacts of each step and keep their problem. explicit: whether the steps are explicit."""

    idle = False  # see `NoContacts`
    # of the finest body's mean surface edge: gap to keep. On curves and between meshes it is the room for a straight way and for
    # means of faces that are not flat; statics on planes needs neither, and there it is small beside what a load moves
    OFFSET, STATIC_OFFSET = 2e-3, 2e-5
    MOST_OFFSET = 0.1  # of the margin: half of what `mortar` takes for near
    MAX_OPENING_SPEED = 0.01  # of the slowest bar wave speed, sqrt(E / rho): of what is corrected; a strain as large
    MAX_CLOSING_RATIO = 2.0  # along the way of a part, where surfaces cross: its speed was not known when the step was cut
    LEAST_DEEP = 1.0 / 16.0  # of a step: parts up to this long are kept even if they lead deeper
    WORSENING = 1.1  # growth of an existing penetration that counts as a new one

    def __init__(self, simulation: SimulationState, self_collision: bool, explicit: bool, static: bool = False):
        self.simulation = simulation
        model, scene = simulation.model, simulation.scene
        self.detection = Detection(scene, model, simulation.layout, simulation.runtime, self_collision)
        self._lasting = FieldArena()  # of arrays that stay as they are
        self.measures = ContactMeasures(self.detection, self._lasting)
        self.paths = ContactPaths(simulation, self.detection, self._lasting)
        self.misplaced = Misplacement(simulation, self.detection)
        self.ahead = SearchAhead(simulation, self._lasting) if explicit else None
        self.far = FarApart(simulation, self.detection)
        detection = self.detection
        is_flat = detection.overlay is None and all(isinstance(one.shape, HalfSpace) for one in scene.obstacles)
        offset = self.STATIC_OFFSET if static and is_flat else self.OFFSET
        self.contact_offset = (scene.collision.offset or offset) * float(detection.edges[: len(scene.bodies)].min())
        if detection.margin > 0.0:
            most = self.MOST_OFFSET * detection.margin / (SELF_CONTACT if self_collision else 1.0)
            self.contact_offset = min(self.contact_offset, most)
        # parts of a penetration and of a missing contact offset that a step corrects
        self._static = static
        self._corrections = (0.05, 0.005) if explicit else (1.0, 1.0) if static else (0.2, 0.02)
        self._substep_fraction = 1.0  # of the step, that the current substep takes
        self.gap_targets = self._gap_targets()
        self._arena = FieldArena()
        capacity = 2 * detection.surface.n_triangles + 1024  # contacts at first
        self._allocate(capacity, most_entries(model, capacity, 0))
        self._numbers_arena = FieldArena()
        self.numbers = build_pair_numbers(self._numbers_arena, scene)
        self.rebounds = Rebounds(simulation, self._lasting)
        simulation.now.slip = self._lasting.field("accumulated_slip", ti.f64, model.n_nodes)
        self._surface_loads = SurfaceLoads(simulation)
        self._asleep: AsleepContacts | None = None  # those of sleeping bodies, which `problem` lacks
        self._searched: tuple[float, float] | None = None  # time and dt of the valid search
        self._is_near = False  # whether it found anything near
        self._measured_end: tuple[float, float] | None = None  # time and dt of the measured end, until the next substep begins
        self._depth = 0.0  # deepest penetration there [m]
        self.crossing: float | None = None  # depth of crossing triangles over the finer side's edge; None: not measured
        self.last_crossing = Crossing()  # at the end of the last step
        self._explicit = explicit
        self._last_time = 0.0
        self.penetration = 0.0  # at the end of the last step [m],
        self.relative_penetration = 0.0  # and over the finer side's mean surface edge
        self._pairs: Pairs | None = None  # of the last step, once known; while it is cut, of its substeps so far
        self._step_dt = 0.0  # of the last step [s]
        self._impulse_fraction = 1.0
        self._renewal = Renewal(model, detection, self._lasting)
        self._search_counts = 0, 0  # contacts before the reduction and unmapped triangles of the search for the last substep
        rigid = np.array([isinstance(one, RigidBody) for one in scene.colliders], dtype=np.int32)
        self._rigid = self._lasting.field("is_rigid", ti.i32, len(rigid), rigid)
        self.had_impact = False  # whether surfaces met in the last step
        self._is_fast = False  # whether contacts closed too fast on the way that was last certified
        self.dropped = 0  # triangles of the last step under an inverted tet, for which a distance field gives no contacts

    def _allocate(self, capacity: int, entries: int) -> None:
        arena, model, self._n_contacts = FieldArena(), self.simulation.model, None
        self.problem = build_node_problem(arena, capacity, model.n_nodes, model.on_cpu, entries)  # of the last step begun
        self._arena.release()
        self._arena, self._last_time, self._indexed = arena, 0.0, False

    def _room(self, n: int, entries: int) -> tuple[int, int] | None:
        """Return larger capacities if there is no room for n contacts and one more with so many entries in all, else None."""
        capacity, most = self.problem.capacity, self.problem.node.shape[0]
        if n < capacity and entries <= most:
            return None
        return max(capacity, 2 * n), max(most, 2 * entries)

    def _make_room(self, n: int) -> None:
        """Make room for the n contacts of the last search."""
        if room := self._room(n, most_entries(self.simulation.model, n, self.detection.buffer.n_listed)):
            self._allocate(*room)

    @property
    def has_paths(self) -> bool:
        """Whether motion is prescribed: the user may change it between two steps, and a path may end with the last one."""
        simulation = self.simulation
        return simulation.dirichlet.n_prescribed > 0 or not all(o.rests(simulation.time) for o in simulation.scene.obstacles)

    def motion_changed(self) -> None:
        """Discard the search, after an obstacle or nodes were commanded to move."""
        self._searched = None
        self._forget_ahead()

    @property
    def n_contacts(self) -> int:
        """Contacts of the last step, including those without impulse, but not those of sleeping bodies."""
        if self._n_contacts is None:
            self._n_contacts = int(self.problem.count[0])
        return self._n_contacts

    @property
    def n_asleep(self) -> int:
        """Contacts of sleeping bodies."""
        return 0 if self._asleep is None else len(self._asleep)

    def forget(self) -> None:
        """Discard all that is known of a state and its past, after another one was set."""
        now = self.simulation.now
        now.flight[:], now.none_cross, now.misplaced = 0.0, False, NO_SUMS
        self.discard()

    def discard(self) -> None:
        """Discard the search, the impulses, and what was measured, after a return to the start of a step."""
        now = self.simulation.now
        self.discard_search(with_impulses=True)
        self.penetration = self.relative_penetration = self._step_dt = 0.0
        self._pairs, self.last_crossing, self.crossing = None, Crossing(), 0.0 if now.none_cross else None
        now.held, self._asleep = NO_PASSAGES, None
        self.misplaced.start_step()
        self.paths.forget()
        self.far.restore({})
        self._is_fast = self._is_near = False

    def discard_search(self, with_impulses: bool) -> None:
        """Discard the search of a substep that was undone; the impulses that are left warm-start the next attempt."""
        self._searched = self._measured_end = None
        self._forget_ahead()
        if with_impulses:
            self.problem.count[0], self._last_time, self._search_counts, self._renewal.sides = 0, 0.0, (0, 0), None
            self._n_contacts = 0

    def snapshot(self) -> dict:
        """Return the last step's contacts and impulses, and the capacities: a step that exceeds them starts without impulses.

        The search is not included: from the same state the next one finds the same contacts in the same order. Nor is one that
        serves several sub-steps, but for its state.
        """
        ahead = {} if self.ahead is None else self.ahead.snapshot()
        return {
            "capacity": self.problem.capacity,
            "entries": self.problem.node.shape[0],
            "last_time": self._last_time,
            "share": self._impulse_fraction,
            "span": self._step_dt,
            "pairs": self.pairs()[0],
            "pair_sums": self.pairs()[1],
            "penetration": self.penetration,
            "relative_penetration": self.relative_penetration,
            "met": self.had_impact,
            "dropped": self.dropped,
            "found": self._search_counts[0],
            "unmapped": self._search_counts[1],
            "rows": read_rows(self.problem, MORE_ROWS if ahead else ROWS),
            "ahead": ahead,
            "far": self.far.snapshot(),
            "near": self._is_near,
            "sides": list(self._renewal.sides or ()),
            "asleep": {} if self._asleep is None else self._asleep.rows,
            "asleep_sides": [] if self._asleep is None else list(self._asleep.sides or ()),
        }

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        room = int(kept["capacity"]), int(kept["entries"])
        if room != (self.problem.capacity, self.problem.node.shape[0]):
            self._allocate(*room)
        write_rows(self.problem, kept["rows"])
        self._n_contacts = None
        self._last_time, self._impulse_fraction, self._step_dt = (float(kept[name]) for name in ("last_time", "share", "span"))
        self._pairs, self.penetration = (kept["pairs"], kept["pair_sums"]), float(kept["penetration"])
        self.relative_penetration = float(kept["relative_penetration"])
        self.had_impact, self.dropped = bool(kept["met"]), int(kept["dropped"])
        self._search_counts = int(kept["found"]), int(kept["unmapped"])
        self.paths.forget()
        self._renewal.sides = tuple(kept["sides"]) or None
        self._asleep = AsleepContacts(kept["asleep"], tuple(kept["asleep_sides"]) or None) if kept["asleep"] else None
        self.misplaced.start_step()
        self.crossing, self.last_crossing = 0.0 if self.paths.none_cross else None, Crossing()
        self._searched = self._measured_end = None
        self._is_near = bool(kept["near"])
        self.far.restore(kept["far"])
        if self.ahead is not None:
            self.ahead.restore(kept["ahead"])
        self._indexed = True  # so that the next step rebuilds the node index, even without contacts
        if kept["ahead"]:
            index_nodes(self.problem)
            self.problem.sweep.order.from_numpy(np.arange(self.n_contacts), 0)

    def _gap_targets(self) -> tuple[float, float, float, float]:
        """Contact offset [m]; fractions of a penetration and of a missing offset corrected per substep; maximum speed [m/s]."""
        slowest = min(b.composition.lowest_wave_speed for b in self.simulation.scene.bodies)
        fraction = 1.0 if self._static else self._substep_fraction
        return (
            self.contact_offset,
            fraction * self._corrections[0],
            fraction * self._corrections[1],
            self.MAX_OPENING_SPEED * slowest,
        )

    def numbers_changed(self) -> None:
        """Upload changed friction or restitution, which the next sub-step uses."""
        self._forget_ahead()
        self.rebounds.numbers_changed()
        if not upload_pair_numbers(self.numbers, self.simulation.scene):
            arena = FieldArena()
            self.numbers = build_pair_numbers(arena, self.simulation.scene)
            self._numbers_arena.release()
            self._numbers_arena = arena

    def search(self, time: float, dt: float) -> int:
        """Find the contacts of the present state at a time [s], swept by dt, unless known. Return their number."""
        simulation, detection, searched = self.simulation, self.detection, self._searched
        if searched is None or searched[1] != dt or abs(searched[0] - time) > 1e-6 * dt:
            self._searched = None
            self._find(time, dt, prescribed=simulation.prescribed_moves(time + dt))
            self._searched = time, dt
        return detection.counts.contacts

    def look_ahead(self, time: float, dt: float, n: int) -> None:
        """Search for n sub-steps of dt from a time [s], see `search_ahead`."""
        self._searched = None
        self._find(time, n * dt)
        self.ahead.begin(time, dt, n)
        self._searched = self.ahead.searched
        self.detection.paths.forget()  # the list of near triangles holds as long as the search

    def _look_again(self) -> None:
        """Repeat the search that serves several sub-steps, if a question has made another one since."""
        if self._searched != self.ahead.searched:
            is_near, self._searched = self._is_near, None
            self.ahead.call_there(lambda: self._find(*self.ahead.searched))
            self._searched, self._is_near = self.ahead.searched, is_near
            self.detection.paths.forget()

    def _forget_ahead(self) -> None:
        """Discard the search that serves several sub-steps."""
        self.far.forget()
        if self.ahead is not None:
            self.ahead.forget()

    def keep(self, time: float, dt: float, n: int) -> int:
        """Return how many of n sub-steps of dt from a time [s] are served by one search, after it was made."""
        if self.ahead.n != MOST or not self.ahead.left(time, dt):
            self.far.forget()
            self.look_ahead(time, dt, MOST)
        self._look_again()
        self.detection.list_near()
        return min(n, self.ahead.left(time, dt))

    def search_all(self, time: float, dt: float) -> None:
        """Do as `search`, among sleeping bodies, too; then the next step searches again."""
        rests, is_near = self.detection.surface.rests.to_numpy() > 0, self._is_near
        if rests.any():
            self.let_rest(np.zeros_like(rests))
        self.search(time, dt)
        self._is_near = is_near
        if rests.any():
            self.let_rest(rests)

    def is_far(self, time: float, dt: float) -> bool:
        """Return whether nothing can touch in an explicit step of dt from a time, see `far_apart`: it needs no search."""
        far = self.far
        if not far.covers(time + dt):
            far.forget()
            if self.ahead.left(time, dt) or self.n_contacts or self._is_near or not self.paths.none_cross or self.has_paths:
                return False
            if not far.is_due():
                return False
            far.search(time, dt, self._finds_nothing)
        if far.is_known:
            self._look_again()
            self._measured_end, self._last_time, self._search_counts, self.had_impact = None, dt, (0, 0), False
        return far.is_known

    def _finds_nothing(self, time: float, dt: float, n: int) -> bool:
        """Return whether nothing can touch in n sub-steps of dt from a time [s], after a search for them."""
        self.look_ahead(time, dt, n)
        return not self._is_near

    def _find(self, time: float, dt: float, **along) -> None:
        """Call `Detection.find`; where nothing crosses, implicit steps drop what may never touch."""
        self.measures.begin(dt)
        self.detection.find(time, dt, held=self.simulation.now.held, none_cross=self.simulation.now.none_cross, **along)
        self._is_near = self.detection.counts.active + self.detection.counts.found > 0
        if self.paths.none_cross and not self._explicit and self.detection.counts.contacts:
            self.measures.drop_uncertain()

    def begin(self, time: float, dt: float) -> int:
        """Fill the problem for a step of dt [s] from the state at a time, warm-started. Return its number of contacts."""
        self._forget_ahead()
        n, self._measured_end, model = self.search(time, dt), None, self.simulation.model
        (surface, shapes, found, kept), counts = self.detection.found, self.detection.counts
        self.gap_targets = self._gap_targets()
        self.dropped, self._search_counts = max(self.dropped, counts.unmapped), (counts.found, counts.unmapped)
        self._make_room(n)
        problem = self.problem
        if model.has_dependents and n:
            n = drop_vanishing(problem, model, surface, found, kept, n, 0, 0)  # the past's entries are needed no more
        indexes = int(n > 0 or self._indexed)  # an empty index needs no update
        what = model, surface, shapes, self.numbers, found, self.detection.reduction
        fill(problem, *what, n, dt, self.warm_factor(dt), self.contact_offset, indexes)
        self._indexed = n > 0
        if not self._explicit:
            set_targets(problem, dt, *self.gap_targets)
        self._renewal.sides, self._renewal.n_looks = self.detection.sides(kept.to_numpy(n)) if model.has_dependents else None, 0
        self._last_time, self._impulse_fraction, self.had_impact, self._n_contacts = dt, 1.0, False, n
        return n

    def warm_factor(self, dt: float) -> float:
        """Return the factor of the last substep's impulses from which one of dt [s] starts."""
        return dt / self._last_time if self._last_time > 0.0 else 0.0

    def begin_batch(self) -> None:
        """Prepare for sub-steps that the host does not follow, after a search: there must be room for its contacts."""
        self.gap_targets, counts = self._gap_targets(), self.detection.counts
        self.dropped = max(self.dropped, counts.unmapped)
        self._make_room(counts.contacts)

    def end_kept(self, dt: float, n: int | None, done: int, is_outdated: bool) -> None:
        """Take over after so many sub-steps of dt [s] were done in a batch that keeps contacts.

        n: contacts in the last of these, None if the next one has begun. is_outdated: whether that needs another search.
        """
        self._end_batch(dt)
        self._n_contacts, self._search_counts = n, (self.detection.counts.found, self.detection.counts.unmapped)
        self.ahead.done += done
        if is_outdated or self.ahead.done == self.ahead.n:
            self.ahead.forget()

    def end_batch(self, time: float, dt: float, n: int, found_before: int, found: int, kept: int, is_whole: bool) -> None:
        """Take over after sub-steps of dt [s] that the host has not followed; time: after those that were accepted.

        n: contacts in the last of these; found_before, found, kept: those of the search before the last one, and of the last one.
        is_whole: whether the next sub-step has not begun.
        """
        self.detection.adopt(found, kept)
        self.measures.begin(dt)
        self._searched, self._is_near = (time, dt), found > 0
        self._n_contacts, self._search_counts = (n, (found_before, 0)) if is_whole else (kept, (found, 0))
        self._end_batch(dt)

    def _end_batch(self, dt: float) -> None:
        """See `end_batch`."""
        self._last_time, self._impulse_fraction, self.had_impact, self._indexed = dt, 1.0, False, True
        self._renewal.sides, self._renewal.n_looks, self._measured_end = None, 0, None
        self.measure_crossings()

    def renew(self, x_start: Any, displacement: Any) -> bool:
        """Take the contacts' geometry at displacements from x_start, (n_nodes) 3-vectors f64 [m] each; return whether it changed.

        Impulses and targets pass to the new contacts. `problem` is another one if it had to grow.
        """
        (time, dt), renewal = self._searched, self._renewal
        needed = renewal.look(self.problem, time, dt, x_start, displacement, self.contact_offset)
        if not needed:
            return False
        self._n_contacts = renewal.n_contacts
        entries = most_entries(self.simulation.model, needed - self.n_contacts, self.detection.end.buffer.n_listed)
        if room := self._room(needed, renewal.n_entries + entries):
            last_time, rows, mass = self._last_time, read_rows(self.problem, MORE_ROWS), self.problem.inverse_mass.to_numpy()
            factor = self.problem.factor.to_numpy(self.n_contacts)
            self._allocate(*room)
            upload([(self.problem.inverse_mass, mass)])
            self.problem.factor.from_numpy(factor, 0)
            write_rows(self.problem, rows)
            index_nodes(self.problem)
            self._last_time, self._indexed = last_time, True
        adopted = renewal.adopt(self.problem, self.numbers, self._step_dt, x_start, displacement, self.contact_offset)
        if adopted:
            self._n_contacts = None
        return adopted

    def set_impulse_fraction(self, fraction: float) -> None:
        """Set the fraction of the step in which impulses act, beta / dt of an implicit stage."""
        if fraction != 1.0:
            scale_impulses(self.problem, fraction)
        self._last_time, self._impulse_fraction = fraction * self._last_time, fraction

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

    def start_step(self, time: float, dt: float) -> None:
        """Begin a step of dt from a time. Penetration that exists there is not new."""
        self.relative_penetration = 0.0
        if not (self._explicit and self.crossing is not None and self.paths.none_cross):  # where it limits nothing
            self.search(time, dt)
            self.relative_penetration = max(float(self.measures.closing[RELATIVE_PENETRATION]), self.initial_crossing())
        self._deepest, self._most_crossed = DEEP_PENETRATION, CROSSED
        self._raise_limits()
        self._substep_fraction, self._step_dt, self.dropped = 1.0, dt, 0
        self._pairs = None
        self.paths.start_step()
        self.misplaced.start_step()

    def _raise_limits(self) -> None:
        """Raise the limits above which a penetration or crossing is new to WORSENING times the present ones."""
        self._deepest = max(self._deepest, self.WORSENING * self.relative_penetration)
        self._most_crossed = max(self._most_crossed, self.WORSENING * self.crossing)

    def most_units(self, time: float, dt: float, units: int) -> int:
        """Return the length of the next part of a step of dt, in units of dt / PARTS: the given one, or where surfaces cross, one
        in which no contact closes further than its ratio allows. Raise SimulationError if the shortest part is too long."""
        if self.paths.none_cross:
            return units
        self.search(time, units / PARTS * dt)
        most = int(units / max(1.0, self.measures.closing_ratio))
        self._is_fast = most == 0
        self.refuse_fast_closing(dt)
        return most

    def start_substep(self, dt: float) -> None:
        """Begin a substep of dt, or begin it again with another length."""
        self._substep_fraction = dt / self._step_dt
        self.paths.begin()

    def end_part(self, time: float, dt: float, x_start: Any, dissipative: bool) -> None:
        """End a part of a step at a time, from which the next one of dt is searched, see `end` and `end_substep`."""
        self.penetration = self.end(time, dt)
        self._raise_limits()
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
            if self.paths.none_cross:
                self._searched = None  # where none cross, other contacts are found
        if self._substep_fraction < 1.0 and not self._static:
            self._pairs = self._sum_pairs()

    @property
    def duration(self) -> float:
        """Time [s] in which the impulses of the last substep acted."""
        return self._last_time / self._impulse_fraction

    def touching(self, colliders: np.ndarray, pressing: bool = False) -> np.ndarray:
        """Return those of some colliders (n,) bool that have contacts in the last search, or with `pressing` impulses in the last
        substep."""
        if pressing:
            body, r, struck = download([self.problem.body, self.problem.r, self.problem.impact_impulse], self.n_contacts)
            body = body[(r[:, 0] > 0.0) | struck.any(axis=1)]
        else:
            body = self.detection.buffer.data.body[self.detection.kept.to_numpy(self.detection.counts.contacts)]
        return colliders & np.isin(np.arange(len(colliders)), body)

    def let_rest(self, colliders: np.ndarray) -> None:
        """Search no contacts among colliders (n,) bool from now on, but all others."""
        self._searched = self._measured_end = None
        if self.detection.let_rest(colliders):
            self.paths.forget()  # lists of near pairs lack those

    def set_aside(self, bodies: np.ndarray) -> None:
        """Take the contacts of bodies, of colliders (n,) bool, out of the problem: they fall asleep."""
        rows, sides = read_rows(self.problem), self._renewal.sides
        chosen = bodies[rows["body"]].any(axis=1)
        self._asleep = AsleepContacts.taken(rows, sides, chosen, self._last_time).joined(self._asleep)
        self._put(select(rows, ~chosen), sides and tuple(side[~chosen] for side in sides))

    def take_back(self, bodies: np.ndarray) -> None:
        """Put the contacts of bodies, of colliders (n,) bool, into the problem again: they wake."""
        if self._asleep is None:
            return
        taken, left = self._asleep.split(bodies[self._asleep.rows["body"]].any(axis=1))
        self._asleep, sides = left if len(left) else None, self._renewal.sides
        self._put(join(read_rows(self.problem), taken.after(self._last_time)), sides and join_sides(sides, taken.sides))

    def _put(self, rows: Rows, sides: Sides | None) -> None:
        """Replace the contacts of the problem, whose impulses act as long as those of the last substep."""
        if room := self._room(len(rows["gap"]), len(rows["node"])):
            last_time = self._last_time
            self._allocate(*room)
            self._last_time = last_time
        write_rows(self.problem, rows)
        self._n_contacts = None
        self._renewal.sides, self._indexed = sides, True  # so that the next step updates the node index

    def rows(self, own: bool = False) -> ContactRows:
        """Return the contacts of the last substep, with those of sleeping bodies; see `awake`."""
        found = self.awake(own)
        return found if self._asleep is None else join_contacts(found, self._asleep.contacts(self.duration, own))

    def awake(self, own: bool = False) -> ContactRows:
        """Return the contacts of the problem. own: with the nodes before dependent ones were replaced, if they are known."""
        found = read_contacts(self.problem, self._impulse_fraction)
        if not own or self._renewal.sides is None:
            return found
        nodes, weights = (side[: len(found.gap)] for side in self._renewal.sides)
        return replace(found, nodes=nodes, weights=weights)

    def _sum_pairs(self) -> Pairs:
        """Add the last substep's contacts to the sums of earlier substeps."""
        (x, v), before = self.simulation.state(), self._pairs
        if before is None and self._asleep is not None:
            before = self._asleep.pairs(self._step_dt, x)
        return sum_pairs(self.awake(own=True), slip_velocities(self.problem, v, self.duration), x, before)

    def pairs(self) -> Pairs:
        """Return the sums over the contacts of each pair in the last step, see `sum_pairs`."""
        if self._pairs is None:
            self._pairs = self._sum_pairs()
        return self._pairs

    def mean_on(self, collider: int, other: int | None) -> np.ndarray:
        """Return the means of `sum_on` over the last step, in statics over its last part, (10,): force [N], moment [N m], ..."""
        time = self.duration if self._static and self._last_time else self._step_dt
        return sum_on(self.pairs(), collider, other) / (time or 1.0)

    def own_forces(self) -> np.ndarray:
        """Return the contact forces of the last substep on the nodes that touch, dependent ones too, (n_nodes, 3) [N].

        Known only in scenes with dependent nodes, and not after a checkpoint was loaded; else 0.
        """
        sides = self._renewal.sides
        if sides is None or len(sides[0]) != self.n_contacts or self._last_time == 0.0:
            return np.zeros((self.simulation.model.n_nodes, 3))
        return nodal_impulses(self.rows(own=True), self.simulation.model.n_nodes) * self._impulse_fraction / self._last_time

    def certify(self, time: float, dt: float, start: StepState) -> int:
        """Return what the way from a start to the present state is, in a part of dt [s] from a time: FREE, MET or BLOCKED.
        From the start, `search_along` then finds what it met.

        Where it left what was searched, it is searched along. Where surfaces cross already, it is not free either if it led
        deeper, met contacts that were unknown, or if contacts close too fast along it.
        """
        paths, self._is_fast = self.paths, False
        known = set() if paths.none_cross else self.found_features()
        if not self._explicit:
            has_left, passes = paths.find_unless_left(start.x)
        else:  # they seldom leave what was searched, and are many; a search that serves several may have been before the start
            has_left = self.ahead.n > 0
            passes = not has_left and paths.find()
        if has_left or paths.uncovered:
            self.search_way(time, dt, start)
            passes = paths.find(as_searched=True)
        elif passes and self._explicit:
            paths.keep_path(start.x)
        if passes:
            return BLOCKED if paths.is_stuck else MET
        if paths.none_cross or self._explicit:
            return FREE
        if has_left:
            found = self.found_features()
            if not known.issuperset(found):
                return MET
            self._is_fast, known = self.measures.closing_ratio > self.MAX_CLOSING_RATIO, found
        if self._is_fast:
            return BLOCKED
        self.end(time + dt, dt)
        is_deep = self.relative_penetration > self._deepest or self.crossing > self._most_crossed
        if not is_deep or dt <= self.LEAST_DEEP * self._step_dt:
            return FREE
        self.search_way(time, dt, start)
        return BLOCKED if known.issuperset(self.found_features()) else MET

    def refuse_fast_closing(self, dt: float) -> None:
        """Raise SimulationError if contacts closed too fast on the way that was last certified, in a step of dt."""
        if self._is_fast:
            number = self.simulation.step_count + 1
            raise SimulationError(f"step {number}: {self.measures.describe_fast_closing(dt, PARTS)}")

    def search_way(self, time: float, dt: float, start: StepState) -> None:
        """Search the way from a start to the present state, which stays."""
        self.paths.keep_path(start.x)
        end = self.simulation.state()
        self.simulation.now.copy_nodes_from(start)
        self.search_along(time, dt)
        self.simulation.set_state(*end)

    def end(self, time: float, dt: float) -> float:
        """Return the deepest penetration [m] at a time, the end of a step or a part of dt. Set `relative_penetration`.

        The search there is reused until the next part begins.
        """
        if self.far.is_known:
            self.relative_penetration = 0.0
            return 0.0
        ended = self._measured_end
        if ended is not None and ended[1] == dt and abs(ended[0] - time) <= 1e-6 * dt:
            return self._depth
        self._searched = None
        self._forget_ahead()
        self.paths.use_active(self.problem)
        try:
            self.search(time, dt)
        except SimulationError:
            if not self.has_paths:
                raise
            self._find(time, 0.0)  # a path ends here; the next step reports it
        closing = self.measures.closing
        depth, self.relative_penetration = float(closing[DEPTH]), float(closing[RELATIVE_PENETRATION])
        if not self._explicit:
            crossing = self.measure_crossings()
            depth, self.relative_penetration = max(depth, crossing[0]), max(self.relative_penetration, crossing[1])
        if self.has_paths:
            self._searched = None
        self._depth, self._measured_end = depth, (time, dt)
        return depth

    @property
    def is_deep(self) -> bool:
        """Whether the last step ended with a deep penetration."""
        return self.relative_penetration > DEEP_PENETRATION

    def measure_crossings(self) -> tuple[float, float]:
        """Return how deep things cross at the last search [m], and over the finer side's mean surface edge. Set `crossing` and
        `last_crossing`. If none crossed before, none do: their paths were checked."""
        self.last_crossing = found = Crossing() if self.paths.none_cross else self.measures.crossing()
        self.crossing = found.relative
        return found.depth, found.relative

    def search_along(self, time: float, dt: float) -> None:
        """Search along `paths.displacement` from the present state, with all that was met."""
        self._searched = self._measured_end = None
        self._forget_ahead()
        self.paths.use_all()
        self._find(time, dt, path=self.paths.displacement)
        self._searched = time, dt

    def found_features(self) -> set[tuple]:
        """Return the features of the contacts of the last search."""
        detection = self.detection
        found = detection.buffer.data.feature[detection.kept.to_numpy(detection.counts.contacts)]
        return set(map(tuple, found.tolist()))

    def initial_crossing(self) -> float:
        """Return the depth of crossing triangles over the finer side's mean surface edge, at the start of a searched step."""
        if self.crossing is None:
            self.measure_crossings()
            self.paths.exempt_crossing()
            self._searched = None  # where none cross, other contacts are found
        return self.crossing

    def warm_up(self, time: float, dt: float, x_start: Any, displacement: Any) -> None:
        """Launch the kernels that only steps with contacts need, after a search at a time for a step of dt [s]; the state and the
        contacts are then invalid."""
        self.detection.warm_up()
        self._renewal.warm_up(self.problem, self.numbers, (time, dt), x_start, displacement, self.contact_offset)
        scale_impulses(self.problem, 1.0)
        self.measures.drop_uncertain()
        self.misplaced.add(self.problem, dt, self.contact_offset, False)
        end_contacts(self.problem, self.simulation.model, x_start, self.simulation.now.slip, 0.0)

    def contacts(self, areas: bool = False) -> Contacts:
        """Return the contacts of the last substep with their impulses. areas: whether with tributary areas."""
        rows, counts = self.rows(), dict(zip(("found", "unmapped"), self._search_counts))  # others have searched since
        a, b = rows.collider.T
        further = {"offsets": offsets_of(self.contact_offset, a == b, rows.guard == 1)}
        if areas:
            further["tributary_area"] = self._surface_loads.tributary_areas(self.rows(own=True), self.duration)
        return rows.named(self.simulation.scene, **counts, duration=self.duration, **further)

    def pressure(self, body: int, by_triangle: bool) -> ContactPressure:
        """Return the contact loads on a body's surface in the last substep, by node or by triangle."""
        return self._surface_loads.pressure(body, by_triangle, self.rows(own=True), self.duration)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of every allocated field by name."""
        return self.detection.field_bytes | self._arena.bytes | self._numbers_arena.bytes | self._lasting.bytes

    def release(self) -> None:
        """Free all memory."""
        self.detection.release()
        for owner in (self._arena, self._numbers_arena, self._lasting, self.misplaced):
            owner.release()
