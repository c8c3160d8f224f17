"""Contacts of the last substep with their impulses, and what they did in the last step: storage, queries, checkpoints."""

import numpy as np

from taisoft.backend.arrays import FieldArena, download
from taisoft.collision.contacts import Contacts
from taisoft.contact.build import most_entries, scale_impulses
from taisoft.contact.problem import build_node_problem, index_nodes
from taisoft.dynamics.asleep import NONE_ASLEEP, AsleepContacts, Rows, Sides, join, select
from taisoft.dynamics.readout import (
    ROWS,
    ContactRows,
    Pairs,
    join_contacts,
    join_sides,
    nodal_impulses,
    offsets_of,
    read_rows,
    rows_of,
    slip_velocities,
    sum_on,
    sum_pairs,
    write_rows,
)
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.surface_loads import ContactPressure, SurfaceLoads


class ContactRecord:
    """Contacts of one simulation. contact_offset: between different bodies [m]; static: whether its steps are."""

    def __init__(self, simulation: SimulationState, capacity: int, contact_offset: float, static: bool):
        self.simulation, self.contact_offset, self._static = simulation, contact_offset, static
        self._arena = FieldArena()
        self._allocate(capacity, most_entries(simulation.model, capacity, 0))
        self.sides: Sides | None = None  # nodes and weights of contacts before dependent nodes were replaced
        self.asleep = NONE_ASLEEP  # those of sleeping bodies, which `problem` lacks
        self._last_time = 0.0  # [s] in which the impulses of `problem` act,
        self._impulse_fraction = 1.0  # and its part of the substep
        self._search_counts = 0, 0  # contacts before the reduction and unmapped triangles of the search for the last substep
        self._pairs: Pairs | None = None  # of the last step, once known; while it is cut, of its substeps so far
        self._step_dt = 0.0  # of the last step [s]
        self.had_impact = False  # whether surfaces met in the last step
        self.dropped = 0  # triangles of the last step under an inverted tet, for which a distance field gives no contacts
        self._surface_loads = SurfaceLoads(simulation)

    def _allocate(self, capacity: int, entries: int) -> None:
        arena, model, self._n_contacts = FieldArena(), self.simulation.model, None
        self.problem = build_node_problem(arena, capacity, model.n_nodes, model.on_cpu, entries)  # of the last step begun
        self._arena.release()
        self._arena, self._indexed = arena, False

    def _room(self, n: int, entries: int) -> tuple[int, int] | None:
        """Return larger capacities if there is no room for n contacts and one more with so many entries in all, else None."""
        capacity, most = self.problem.capacity, self.problem.node.shape[0]
        if n < capacity and entries <= most:
            return None
        return max(capacity, 2 * n), max(most, 2 * entries)

    @property
    def n_contacts(self) -> int:
        """Contacts of the last step, including those without impulse, but not those of sleeping bodies."""
        if self._n_contacts is None:
            self._n_contacts = int(self.problem.count[0])
        return self._n_contacts

    def take_over(self, dt: float, n: int | None, found: int, unmapped: int = 0) -> None:
        """Take over the n contacts of a substep of dt [s], None: those that `problem` counts. found, unmapped: of its search."""
        self._last_time, self._impulse_fraction, self.had_impact = dt, 1.0, False
        self._n_contacts, self._search_counts, self._indexed = n, (found, unmapped), self._indexed or n != 0

    def discard_impulses(self) -> None:
        """Discard the contacts, whose impulses warm-start the next substep."""
        self.problem.count[0], self._last_time, self._search_counts, self.sides = 0, 0.0, (0, 0), None
        self._n_contacts = 0

    def discard(self) -> None:
        """Discard all contacts, and what they did in the last step."""
        self.discard_impulses()
        self._step_dt, self._pairs, self.asleep = 0.0, None, NONE_ASLEEP

    def snapshot(self, names: list[str] = ROWS) -> dict:
        """Return these fields of the contacts, and the capacities: a step that exceeds them starts without impulses."""
        return {
            "capacity": self.problem.capacity,
            "entries": self.problem.node.shape[0],
            "last_time": self._last_time,
            "share": self._impulse_fraction,
            "span": self._step_dt,
            "pairs": self.pairs()[0],
            "pair_sums": self.pairs()[1],
            "met": self.had_impact,
            "dropped": self.dropped,
            "found": self._search_counts[0],
            "unmapped": self._search_counts[1],
            "rows": read_rows(self.problem, names),
            "sides": list(self.sides or ()),
            "asleep": self.asleep.rows,
            "asleep_sides": list(self.asleep.sides or ()),
        }

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        room = int(kept["capacity"]), int(kept["entries"])
        if room != (self.problem.capacity, self.problem.node.shape[0]):
            self._allocate(*room)
        self._put(kept["rows"], tuple(kept["sides"]) or None)
        self.asleep = AsleepContacts(kept["asleep"], tuple(kept["asleep_sides"]) or None)
        self._last_time, self._impulse_fraction, self._step_dt = (float(kept[name]) for name in ("last_time", "share", "span"))
        self._pairs, self._search_counts = (kept["pairs"], kept["pair_sums"]), (int(kept["found"]), int(kept["unmapped"]))
        self.had_impact, self.dropped = bool(kept["met"]), int(kept["dropped"])
        if kept["ahead"]:  # the next substep keeps these contacts
            index_nodes(self.problem)
            self.problem.sweep.order.from_numpy(np.arange(self.n_contacts), 0)

    def set_impulse_fraction(self, fraction: float) -> None:
        """Set the fraction of the step in which impulses act, beta / dt of an implicit stage."""
        if fraction != 1.0:
            scale_impulses(self.problem, fraction)
        self._last_time, self._impulse_fraction = fraction * self._last_time, fraction

    @property
    def duration(self) -> float:
        """Time [s] in which the impulses of the last substep acted."""
        return self._last_time / self._impulse_fraction

    def pressing(self, colliders: np.ndarray) -> np.ndarray:
        """Return those of some colliders (n,) bool that had impulses in the last substep."""
        body, r, struck = download([self.problem.body, self.problem.r, self.problem.impact_impulse], self.n_contacts)
        body = body[(r[:, 0] > 0.0) | struck.any(axis=1)]
        return colliders & np.isin(np.arange(len(colliders)), body)

    def set_aside(self, bodies: np.ndarray) -> None:
        """Take the contacts of bodies, of colliders (n,) bool, out of the problem: they fall asleep."""
        rows, sides = read_rows(self.problem), self.sides
        chosen = bodies[rows["body"]].any(axis=1)
        self.asleep = AsleepContacts.taken(rows, sides, chosen, self._last_time).joined(self.asleep)
        self._put(select(rows, ~chosen), sides and tuple(side[~chosen] for side in sides))

    def take_back(self, bodies: np.ndarray) -> None:
        """Put the contacts of bodies, of colliders (n,) bool, into the problem again: they wake."""
        if not self.asleep:
            return
        taken, left = self.asleep.split(bodies[self.asleep.rows["body"]].any(axis=1))
        self.asleep, sides = left or NONE_ASLEEP, self.sides
        self._put(join(read_rows(self.problem), taken.after(self._last_time)), sides and join_sides(sides, taken.sides))

    def _put(self, rows: Rows, sides: Sides | None) -> None:
        """Replace the contacts of the problem, whose impulses act as long as those of the last substep."""
        if room := self._room(len(rows["gap"]), len(rows["node"])):
            self._allocate(*room)
        write_rows(self.problem, rows)
        self._n_contacts = None
        self.sides, self._indexed = sides, True  # so that the next step updates the node index

    def rows(self, own: bool = False) -> ContactRows:
        """Return the contacts of the last substep, with those of sleeping bodies; see `awake`."""
        found = self.awake(own)
        return join_contacts(found, self.asleep.contacts(self.duration, own)) if self.asleep else found

    def awake(self, own: bool = False) -> ContactRows:
        """Return the contacts of the problem. own: with the nodes before dependent ones were replaced, if they are known."""
        sides = tuple(side[: self.n_contacts] for side in self.sides) if own and self.sides else None
        return rows_of(read_rows(self.problem), self._impulse_fraction, sides)

    def _sum_pairs(self) -> Pairs:
        """Add the last substep's contacts to the sums of earlier substeps."""
        (x, v), before = self.simulation.state(), self._pairs
        if before is None and self.asleep:
            before = self.asleep.pairs(self._step_dt, x)
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
        sides = self.sides
        if sides is None or len(sides[0]) != self.n_contacts or self._last_time == 0.0:
            return np.zeros((self.simulation.model.n_nodes, 3))
        return nodal_impulses(self.rows(own=True), self.simulation.model.n_nodes) * self._impulse_fraction / self._last_time

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
