"""Contacts of a step: found, turned into a problem, watched. What explicit and implicit steps share.

The search for the next step is made at the end of each one: it tells how deep bodies are in each other then, and whether a
motion was too fast for what the search had seen.
"""

import numpy as np
import taichi as ti

from taisoft.collision.contacts import Contacts
from taisoft.collision.crossings import CROSSED, CROSSING_DEPTH, CROSSINGS, DEPTH_OVER_EDGE
from taisoft.collision.pipeline import Detection
from taisoft.contact.assemble import (
    SELF_CONTACT,
    build_found,
    build_pair_numbers,
    fill,
    find_impact,
    keep_impulses,
    scale_impulses,
    upload_pair_numbers,
)  # fmt: skip
from taisoft.contact.problem import NODES, build_node_problem, index_nodes
from taisoft.contact.restitution import find_rebounds
from taisoft.dynamics.ccd_limits import (
    CLOSING_RATIO,
    DEPTH,
    MAX_CLOSING,
    RELATIVE_PENETRATION,
    SPEED,
    WHICH,
    find_displacement,
    measure_closing,
)
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SimulationError
from taisoft.fields import FieldArena
from taisoft.transfer import download, upload

CONTACT_OFFSET = 2e-3  # of the finest body's mean surface edge: gap that contacts keep: moving in curves, surfaces do not cross
DEEP_PENETRATION = 0.02  # of the finer side's mean surface edge: penetration that is told as a problem
DEEP_CROSSING = CROSSED  # of the same: depth of crossing triangles after which an implicit step is done again in smaller parts
NOTICEABLE_PENETRATION = 1e-3  # of the same: penetration after which the way of an implicit part is searched
FAST = {True: 0.05, False: 0.2}  # share of a penetration that an explicit, an implicit step mends
SLOW = {True: 0.005, False: 0.02}  # share of a missing contact offset
PUSHED = 0.01  # of the slowest wave in a bar, sqrt(E / rho): speed at which these open at most, which strains as much
TOLERANCE = {"f32": 1e-4, "f64": 1e-6}  # of the residual of the contact laws, unless asked for
SPARE = 1024  # contacts beyond two a triangle that there is room for at first


class ContactStep:
    """Finds the contacts of each step and keeps their problem. explicit: the kind of steps."""

    idle = False  # see `NoContacts`

    def __init__(self, simulation: SimulationState, self_collision: bool, explicit: bool):
        self.simulation = simulation
        m, scene = simulation.model, simulation.scene
        self.detection = Detection(scene, m, simulation.layout, simulation.runtime, self_collision)
        d = self.detection
        self.contact_offset = CONTACT_OFFSET * float(d.edges[: len(scene.bodies)].min())
        if d.margin > 0.0:
            self.contact_offset = min(self.contact_offset, 0.5 * d.margin / (SELF_CONTACT if self_collision else 1.0))
        # what follows a path may be changed from outside between two steps, and its path may end with the last one
        self._follows = simulation.dirichlet.n_prescribed > 0 or any(o.path is not None for o in scene.obstacles)
        self._shares = FAST[explicit], SLOW[explicit]
        self._portion = 1.0  # of the step that the present part is
        self.gap_targets = self._gap_targets()
        self._arena = FieldArena()
        self._make_room(2 * d.surface.n_triangles + SPARE)
        self._own_arena = FieldArena()
        self._path = self._own_arena.vectors("path", ti.f64, m.n_nodes)
        self._numbers_arena = FieldArena()
        self.numbers = build_pair_numbers(self._numbers_arena, scene)
        self._bounces = scene.bounces
        self.flight = np.zeros(len(scene.colliders))  # sum of dt^2 over the steps since each last touched anything [s^2]
        self._flight_gravity = scene.gravity.copy()
        self._closing = np.zeros(5)  # what `survey` found,
        self._measured_for: float | None = None  # of the search at hand, for a step of so many seconds
        self._searched: tuple[float, float] | None = None  # time and dt of the search that is at hand
        self._swept = 0.0  # dt of the last search, at hand or not
        self._ended: tuple[float, float] | None = None  # those of the end that was looked at, until the next part begins
        self._depth = 0.0  # the deepest penetration found there [m]
        self.crossing: float | None = None  # how deep triangles cross, over the finer side's edge, where somebody looked
        self.crossings = 0  # pairs of triangles that cross at the end of the last step
        self.inside: list[tuple[str, str, float]] = []  # who lies inside whom then, and how deep [m]
        self._explicit = explicit
        self._last_time = 0.0
        self.penetration = 0.0  # at the end of the last step [m],
        self.relative_penetration = 0.0  # and over the finer side's mean surface edge
        self._sum: np.ndarray | None = None  # (n_colliders, 3) [N s] over the parts of the last step, if it had several
        self._span = 0.0  # of the last step [s]
        self._share = 1.0
        self.met = False  # whether surfaces came together in the last step
        self.dropped = 0  # triangles of the last step under an inverted tet, whose contacts a distance field could not tell

    def _make_room(self, capacity: int) -> None:
        arena, m = FieldArena(), self.simulation.model
        problem = build_node_problem(arena, capacity, m.n_nodes, m.serial)
        self.found = build_found(arena, problem)
        self._arena.release()
        self._arena, self._last_time, self._indexed = arena, 0.0, False

    @property
    def problem(self):
        """The `ContactProblem` of the last step that began."""
        return self.found.problem

    @property
    def n_contacts(self) -> int:
        """Contacts of the last step, those that bear nothing included."""
        return int(self.problem.count[0])

    def forget(self) -> None:
        """The state was set: the search at hand and the impulses of the last step do not belong to it."""
        self._searched = self._ended = None
        self.problem.count[0] = 0
        self._last_time = self.penetration = self.relative_penetration = self._span = 0.0
        self._sum, self.crossing, self.crossings, self.inside = None, None, 0, []
        self.flight[:] = 0.0

    def _rows(self) -> dict:
        """Fields of the last step's contacts: what the next step starts from, and what `contacts` tells."""
        p, f = self.problem, self.found
        return {
            "normal": p.normal, "tangent": p.tangent, "r": p.r, "node": p.node, "weight": p.weight, "arity": p.arity,
            "point": f.point, "gap": f.gap, "body": f.body, "feature": f.feature, "struck": f.impact_impulse,
        }  # fmt: skip

    def snapshot(self) -> dict:
        """The last step's contacts and impulses. The capacity too: where it does not do, a step starts without impulses.

        The search at hand is not kept: from the same state the next one finds the same contacts in the same order.
        """
        rows = self._rows()
        return {
            "capacity": self.problem.capacity, "last_time": self._last_time, "share": self._share, "span": self._span,
            "sum": self._sum, "penetration": self.penetration, "relative_penetration": self.relative_penetration,
            "met": self.met, "dropped": self.dropped,
            "flight": self.flight.copy(), "rows": dict(zip(rows, download(list(rows.values()), self.n_contacts))),
        }  # fmt: skip

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told."""
        if kept["capacity"] != self.problem.capacity:
            self._make_room(int(kept["capacity"]))
        rows, n = kept["rows"], len(kept["rows"]["gap"])
        whole = []
        for name, field in self._rows().items():
            data = np.zeros((self.problem.capacity, *rows[name].shape[1:]), dtype=rows[name].dtype)
            data[:n] = rows[name]
            whole.append((field, data))
        upload(whole)
        self.problem.count[0] = n
        self._last_time, self._share, self._span = (float(kept[name]) for name in ("last_time", "share", "span"))
        self._sum, self.penetration = kept["sum"], float(kept["penetration"])
        self.relative_penetration = float(kept["relative_penetration"])
        self.met, self.dropped = bool(kept["met"]), int(kept["dropped"])
        self.flight = np.array(kept["flight"], dtype=float)
        self.crossing, self.crossings, self.inside = None, 0, []
        self._searched = self._ended = None
        self._indexed = True  # so that the next step lists its contacts by nodes, however few

    def start_again(self, anew: bool) -> None:
        """A part's start was set back; the impulses found so far are where the next try begins, unless it is to begin anew."""
        self._searched = self._ended = None
        if anew:
            self.problem.count[0], self._last_time = 0, 0.0

    def _gap_targets(self) -> tuple[float, float, float, float]:
        """Contact offset [m]; fractions of a penetration and of a missing offset that a substep mends; its top speed [m/s]."""
        materials = [b.material for b in self.simulation.scene.bodies]
        slowest = min(np.sqrt(m.young / m.density) for m in materials)
        return self.contact_offset, self._portion * self._shares[0], self._portion * self._shares[1], PUSHED * float(slowest)

    def numbers_changed(self) -> None:
        """Friction or restitution changed."""
        self._bounces = self.simulation.scene.bounces
        if not upload_pair_numbers(self.numbers, self.simulation.scene):
            arena = FieldArena()
            self.numbers = build_pair_numbers(arena, self.simulation.scene)
            self._numbers_arena.release()
            self._numbers_arena = arena

    def search(self, time: float, dt: float) -> int:
        """Find the contacts of the present state, at a time [s], swept by dt, unless they are at hand. Returns their number."""
        simulation, d, known = self.simulation, self.detection, self._searched
        if known is None or known[1] != dt or abs(known[0] - time) > 1e-6 * dt:
            self._searched = None
            prescribed_nodes = simulation.dirichlet.prescribed_nodes
            prescribed = None
            if len(prescribed_nodes):
                x = simulation.model.state.x.to_numpy()[prescribed_nodes]
                prescribed = prescribed_nodes, simulation.dirichlet.places(time + dt) - x
            self._find(time, dt, prescribed)
            self._searched, self._swept = (time, dt), dt
        return d.counts.contacts

    def _find(self, *arguments, **named) -> None:
        """`Detection.find`."""
        self._measured_for = None
        self.detection.find(*arguments, **named)

    def begin(self, time: float, dt: float) -> int:
        """Fill the problem for a step of dt [s] from the state at a time, impulses those of the last step. Returns its size."""
        n, d, m, self._ended = self.search(time, dt), self.detection, self.simulation.model, None
        self.gap_targets = self._gap_targets()
        self.dropped = max(self.dropped, d.counts.unmapped)
        if n > self.problem.capacity:
            self._make_room(2 * n)
        f = self.found
        keep_impulses(f)
        warm = dt / self._last_time if self._last_time > 0.0 else 0.0
        fill(f, m, d.surface, d.shapes, self.numbers, d.buffer.data, d.kept, n, dt, warm)
        if n or self._indexed:  # an index of none stays what it is
            index_nodes(f.problem)
            self._indexed = n > 0
        self._last_time, self._share, self.met = dt, 1.0, False
        return n

    def acts(self, share: float) -> None:
        """Impulses act in that share of the step, beta / dt of an implicit stage."""
        if share != 1.0:
            scale_impulses(self.problem, share)
        self._last_time, self._share = share * self._last_time, share

    def meets(self, dt: float) -> bool:
        """Whether surfaces that bore nothing so far come together in a step of dt that has begun; `met` keeps it."""
        self.met = bool(find_impact(self.found, dt, self.contact_offset))
        return self.met

    def rebounds(self, dt: float) -> bool:
        """Whether surfaces are thrown back in an implicit step of dt that has begun; `met` keeps it."""
        scene = self.simulation.scene
        if not self._bounces or self.n_contacts == 0:
            return False
        if (self._flight_gravity != scene.gravity).any():  # what another gravity took is not known
            self._flight_gravity = scene.gravity.copy()
            self.flight[:] = 0.0
        found = find_rebounds(self.found, self.simulation.model.gravity, self.flight, dt, self.contact_offset) > 0
        self.met = self.met or found
        return found

    def count_flight(self, dt: float, lossy: bool) -> None:
        """A part of dt has ended. lossy: whether flights lose energy in it, as implicit Euler's do."""
        if not self._bounces:
            return
        scene, first = self.simulation.scene, self.simulation.layout.node_start[:-1]
        added, f, p = dt**2 if lossy else 0.0, self.found, self.problem
        self.flight += np.where(self.flight > 0.0, added, dt**2)
        r, struck, body = download([p.r, f.impact_impulse, f.body], self.n_contacts)
        self.flight[body[(r != 0.0).any(axis=1)]] = 0.0
        self.flight[body[(struck != 0.0).any(axis=1)]] = dt**2
        constrained = np.logical_or.reduceat(self.simulation.dirichlet.constrained().any(axis=1), first)
        self.flight[: len(scene.bodies)][constrained] = 0.0
        self.flight[len(scene.bodies) :] = 0.0

    def start_step(self, dt: float) -> None:
        """A step of dt begins."""
        self._portion, self._span, self.dropped, self._sum = 1.0, dt, 0, None

    def start_substep(self, dt: float) -> None:
        """A part of dt of the step begins, or is begun anew with another length."""
        self._portion = dt / self._span

    def end_substep(self) -> None:
        """Count the impulses of a part."""
        if self._portion < 1.0:
            self._sum = self._impulses() + (0.0 if self._sum is None else self._sum)

    def force(self, collider: int) -> np.ndarray:
        """Mean (3,) of the contact forces on a collider over the last step [N]."""
        total = self._impulses() if self._sum is None else self._sum
        return total[collider] / self._span if self._span > 0.0 else np.zeros(3)

    def _impulses(self) -> np.ndarray:
        """(n_colliders, 3) impulses on each from the contacts at hand [N s]."""
        c, total = self.contacts(), np.zeros((len(self.simulation.scene.colliders), 3))
        place = {one.name: k for k, one in enumerate(self.simulation.scene.colliders)}
        for names, sign in ((c.body_a, 1.0), (c.body_b, -1.0)):
            np.add.at(total, [place[name] for name in names], sign * c.impulse)
        return total

    def penetrates_anew(self, time: float, dt: float, before: float) -> bool:
        """Whether a substep of dt that ends at a time leaves a new or deeper penetration.

        before: `relative_penetration` at its start.
        """
        self._look_at_end(time, dt)
        return self.relative_penetration > max(NOTICEABLE_PENETRATION, 1.1 * before)

    def end(self, time: float, dt: float) -> float:
        """The deepest penetration [m] that is left at the end of a step or part of dt, at a time. Sets `relative_penetration`."""
        return self._look_at_end(time, dt)

    def _look_at_end(self, time: float, dt: float) -> float:
        """Search there, once: until the next part begins the answer is known."""
        ended = self._ended
        if ended is not None and ended[1] == dt and abs(ended[0] - time) <= 1e-6 * dt:
            return self._depth
        self._searched = None
        try:
            self.search(time, dt)
        except SimulationError:
            if not self._follows:
                raise
            self._find(time, 0.0)  # a path that ends here; the next step reports it
        closing = self._measure_closing(dt)
        depth, self.relative_penetration = float(closing[DEPTH]), float(closing[RELATIVE_PENETRATION])
        if not self._explicit:
            crossing = self.cross()
            depth, self.relative_penetration = max(depth, crossing[0]), max(self.relative_penetration, crossing[1])
        if self._follows:
            self._searched = None
        self._depth, self._ended = depth, (time, dt)
        return depth

    @property
    def is_deep(self) -> bool:
        """Whether the last step ended with a deep penetration."""
        return self.relative_penetration > DEEP_PENETRATION

    def deep_from(self, a: int, b: int) -> float:
        """Penetration [m] of two colliders above which a step counts as deep."""
        return DEEP_PENETRATION * float(min(self.detection.edges[a], self.detection.edges[b]))

    def cross(self) -> tuple[float, float]:
        """How deep triangles cross, or colliders lie inside each other, where the last search found them [m], and over the finer
        side's mean surface edge. Counts crossings as `crossings`, lists the others as `inside`."""
        closing, edges = self.detection.crossings(), self.detection.edges
        depth, crossing, inside = float(closing[CROSSING_DEPTH]), float(closing[DEPTH_OVER_EDGE]), {}
        for one in self.detection.contained():
            pair = min(one.a, one.b), max(one.a, one.b)
            inside[pair] = max(inside.get(pair, 0.0), one.depth)
            # a part that is thinner than an edge counts as deep where its middle is half as deep in the other as in itself
            scale = min(edges[one.a], edges[one.b], 0.5 * one.room / DEEP_PENETRATION if one.room > 0.0 else np.inf)
            depth, crossing = max(depth, one.depth), max(crossing, one.depth / scale)
        names = [c.name for c in self.detection.scene.colliders]
        self.inside = [(names[a], names[b], deep) for (a, b), deep in inside.items()]
        self.crossing, self.crossings = crossing, int(closing[CROSSINGS])
        return depth, crossing

    def left_searched_path(self, x_start) -> bool:
        """Whether the surface went where nobody had looked since x_start; keeps its way for `search_along_path`."""
        strayed = np.zeros(1)
        find_displacement(self.simulation.model, self.detection.surface, x_start, self._path, strayed)
        return bool(strayed[0] > 0.5 * self.detection.margin)

    def search_along_path(self, time: float, dt: float) -> bool:
        """Search along the way that was found, from the state at the start; whether that finds contacts not known so far."""
        self._searched = self._ended = None
        self._find(time, dt, path=self._path)
        self._searched, self._swept = (time, dt), dt
        known = set(map(tuple, download([self.found.feature], self.n_contacts)[0].tolist()))
        kept = download([self.detection.kept], self.detection.counts.contacts)[0]
        found = self.detection.buffer.data.feature.to_numpy()[kept]
        return not known.issuperset(map(tuple, found.tolist()))

    def look(self, time: float, dt: float) -> tuple[float, float]:
        """The deepest penetration before a step of dt, over the finer side's mean surface edge, and how far contacts close at
        most in it, over what they may."""
        self.search(time, dt)
        closing = self._measure_closing(dt)
        return float(closing[RELATIVE_PENETRATION]), float(closing[CLOSING_RATIO])

    def closing_ratio_along_path(self) -> float:
        """How far contacts closed at most along the way that `search_along_path` searched, over what they may."""
        return float(self._measure_closing(self._swept)[CLOSING_RATIO])

    def crossing_before(self) -> float:
        """How deep triangles cross where a step begins that has been looked at, over the finer side's mean surface edge."""
        if self.crossing is None or self._follows:
            self.cross()
        return self.crossing

    def _measure_closing(self, dt: float) -> np.ndarray:
        d = self.detection
        if self._measured_for != dt:
            measure_closing(d.surface, d.shapes, d.buffer.data, d.kept, d.counts.contacts, dt, self._closing)
            self._measured_for = dt
        return self._closing

    def too_fast(self, dt: float, substeps: int = 1) -> str:
        """A sentence that names who closes too fast for a step of dt, as the last search found it, how fast, how thick the
        thinner one is, and a dt that would do. parts: that a step is cut into at most."""
        closing, d = self._measure_closing(self._swept), self.detection
        a, b = d.buffer.data.body[d.kept[int(closing[WHICH])]]
        names = [d.scene.colliders[k].name for k in (a, b)]
        thin, speed = float(min(d.thickness[a], d.thickness[b])), float(closing[SPEED])
        cut = f"even in {substeps} substeps " if substeps > 1 else ""
        return (
            f"'{names[0]}' and '{names[1]}' close at {speed:.3g} m/s, {speed * dt:.3g} m in a step of {dt:.3g} s, "
            f"and the thinner of them is {thin:.3g} m thick, so {cut}they could pass each other unseen: take dt <= "
            f"{substeps * MAX_CLOSING * thin / speed:.3g} s"
        )

    def contacts(self) -> Contacts:
        """The contacts of the last step with their impulses."""
        f, p = self.found, self.problem
        n = p.count[0]
        normal, tangent, r, struck, point, gap, body, feature, node, weight, arity = download(
            [p.normal, p.tangent, p.r, f.impact_impulse, f.point, f.gap, f.body, f.feature, p.node, p.weight, p.arity], n
        )
        r = r / self._share + struck
        impulse = r[:, :1] * normal + r[:, 1:2] * tangent + r[:, 2:] * np.cross(normal, tangent)
        return self.detection.record(point, normal, gap, impulse, body, feature, *_sides(node, weight, arity))

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of every allocated field by name."""
        return self.detection.field_bytes | self._arena.bytes | self._numbers_arena.bytes | self._own_arena.bytes

    def release(self) -> None:
        """Give all memory back."""
        self.detection.release()
        for arena in (self._arena, self._numbers_arena, self._own_arena):
            arena.release()


def _sides(node: np.ndarray, weight: np.ndarray, arity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights (n,6) of a problem's contacts, three of each side, as the record has them."""
    n, used = len(node), np.arange(NODES) < arity[:, None]
    side_b = used & (weight < 0.0)
    n_a = (used & ~side_b).sum(axis=1)  # side a comes first
    row, column = np.nonzero(used)
    place = np.where(side_b[row, column], NODES // 2 + column - n_a[row], column)
    nodes, weights = np.full((n, NODES), -1), np.zeros((n, NODES))
    nodes[row, place], weights[row, place] = node[row, column], np.abs(weight[row, column])
    return nodes, weights
