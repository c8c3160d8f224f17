"""Contact detection: compute the list of contacts of a state, by boxes, candidates, three kinds of geometry and reduction.

Only what a scene needs is allocated and launched: candidates need two surfaces, distance fields a body that uses one, analytic
distances an analytic obstacle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Array, FieldArena, download
from taisoft.backend.reader import Reader
from taisoft.backend.runtime import Runtime
from taisoft.collision.analytic import NO_SHAPES, AnalyticFrames, build_analytic, find_analytic
from taisoft.collision.bvh import Bvh, Trees
from taisoft.collision.candidates import Buffer, Candidates, Parts, entries, fill, pair_entries, pairs_of
from taisoft.collision.colliders import body_grid, collider_surfaces, collider_thickness, prescribed_vertices
from taisoft.collision.contacts import ContactBuffer, ContactFields, Contacts, named_contacts, sides_of
from taisoft.collision.containment import Containment, Inside
from taisoft.collision.distance_field import DistanceFields, build_fields, find_in_fields
from taisoft.collision.edge_edge import PROXIMITY, find_proximity
from taisoft.collision.end_search import EndSearch, place_at_end
from taisoft.collision.features import BY_EDGES, BY_FACES, BY_FIELD
from taisoft.collision.intersections import CROSSINGS_OF, INTERSECTING, find_crossings
from taisoft.collision.mortar import find_mortar
from taisoft.collision.near_list import STILL, TO_STATE
from taisoft.collision.overlay import build_overlay, overlay_points
from taisoft.collision.passages import append_passages
from taisoft.collision.path_check import IN_BOXES, NO_PASSAGES, HeldPassages, PathCheck
from taisoft.collision.reduction import Reduction, ReductionFields
from taisoft.collision.shape_search import search_shapes
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.collision.surface import ACTIVE, NONFINITE, PAIRS, build_surface, update_surface
from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.fem.model import Layout, Model
from taisoft.mesh.quality import mean_surface_edge
from taisoft.scene.connections import attached_pairs
from taisoft.scene.obstacles import MeshObstacle
from taisoft.scene.plan import make_plan
from taisoft.scene.scene import Scene

MARGIN = 0.1  # of the mean surface edge: default distance within which contacts are found
DEPTH = 0.1  # of the mean surface edge: depth to which flat faces that have passed each other are still found
MERGED = 1e-3  # of the mean surface edge: distance below which contacts are merged
FLOOR = 1e-5  # of the finest body's mean surface edge: distance that paths must keep, far above the rounding of f64
REDUCTION_CELL = 0.25  # of the mean surface edge: cell size of the reduction
MANY_COLLIDERS = 200  # colliders above which the spatial hash is used
CONTACTS_PER_TRIANGLE, POINTS = 1, 8  # initial capacity; integration points of overlays over contacts
MOVING = object()  # in place of the path of an obstacle that does not rest
MAX_INITIAL_ROW = 4096  # largest initial capacity for the triangles near one vertex or triangle


@dataclass
class Counts:
    """Counts of the last search."""

    triangles: int = 0
    active: int = 0  # triangles whose box meets another collider's
    pairs: int = 0  # (query, nearby triangle); query: a vertex, an edge's triangle, or a triangle for a distance field
    found: int = 0  # contacts before the reduction
    contacts: int = 0  # after it
    unmapped: int = 0  # (triangle, body) pairs for which the body's field was unusable because the tet is inverted
    growths: dict[str, int] = field(default_factory=dict)  # how often each buffer has grown since the start


class Detection:
    """Find the contacts of a scene. edge: mean surface edge of the soft bodies at rest; margin, reach: as in `find` [m]."""

    def __init__(
        self,
        scene: Scene,
        model: Model,
        layout: Layout,
        runtime: Runtime,
        self_collision: bool = False,
        serial: bool | None = None,
    ):
        """Allocate what the scene needs. serial: None decides by size. Raise MeshError if a distance field cannot be made."""
        self.scene, self.model, self.layout = scene, model, layout
        settings, bodies, obstacles = scene.collision, scene.bodies, scene.obstacles
        rest_surfaces = [(b.nodes.positions, b.nodes.surface) for b in bodies]
        self.edge = mean_surface_edge(rest_surfaces)
        self.edges = np.array([mean_surface_edge([x]) for x in rest_surfaces] + [np.inf] * len(obstacles))
        self.margin = self._checked_margin()
        self.reach = self.margin + DEPTH * self.edge  # boxes grow by half of it
        self.topology, self._rest = collider_surfaces(scene, layout)
        self.has_pairs = self_collision or int((np.diff(self.topology.first) > 0).sum()) > 1
        self._plan = make_plan(scene, False, False, self_collision).on
        on_field = [b if self.has_pairs and b.contact_mode == "distance_field" else None for b in bodies]
        # before any allocation, since this may fail
        grids = [b and body_grid(b, settings.field_cells, 2.0 * self.margin) for b in on_field] + [None] * len(obstacles)
        self._arena = arena = FieldArena()
        soft = np.arange(len(scene.colliders)) < len(bodies)
        self.thickness = np.array([collider_thickness(c, self.edge) for c in scene.colliders])
        self._analytic = [(len(bodies) + k, o) for k, o in enumerate(obstacles) if not isinstance(o.shape, MeshObstacle)]
        modes = [BY_FACES if b.contact_mode == "proximity" else BY_FIELD for b in bodies]
        modes += [BY_FACES if isinstance(o.shape, MeshObstacle) else BY_EDGES for o in obstacles]
        properties = {"soft": soft, "self_on": soft & self_collision, "mode": np.array(modes)}
        properties |= {"thickness": self.thickness, "edge": self.edges, "attached": attached_pairs(scene)}
        properties |= {"padding": 0.5 * self.reach, "margin": self.margin}
        self.surface = s = build_surface(self.topology, self._rest, properties, runtime, arena, serial)
        self.broad = self._make_broad(runtime) if self.has_pairs else None
        crossed = arena.vectors("crossed", ti.f64, s.chunks), arena.field("crossed_used", ti.i32, s.chunks)
        self._crossed = Parts(*crossed, None, 1, s.chunks)
        self._fields: DistanceFields | None = None
        if any(grids):
            starts = self.topology.first, layout.node_start
            self._fields = build_fields(bodies, grids, model.state.x, *starts, runtime, arena)
        self.shapes = build_analytic(self._analytic, arena) if self._analytic else NO_SHAPES
        self._prescribed_moves = None  # prescribed displacements of vertices, allocated at first use
        initial = min(int(np.diff(self.topology.first).max(initial=1)), MAX_INITIAL_ROW) * s.chunks
        limits = (settings.initial_capacity or initial, settings.max_capacity)
        self._near_buffer = Buffer("near", entries, *limits, s.chunks, arena) if self.has_pairs else None
        capacity = settings.initial_capacity or CONTACTS_PER_TRIANGLE * s.n_triangles + 64
        self.overlay, self._points, self._none_cross = None, None, False
        if self._plan["mortar"]:
            quadratic = np.array([b.order == 2 and b.nodes.embedded is None for b in bodies] + [False] * len(obstacles))
            limit = None if settings.max_capacity is None else POINTS * settings.max_capacity
            self.overlay = build_overlay(arena, s.x, self.edges, self.topology.first, quadratic)
            self._points = Buffer("overlay_points", overlay_points, POINTS * capacity, limit, s.chunks, arena)
        self.buffer = ContactBuffer("contacts", capacity, settings.max_capacity, s.chunks, arena, self.overlay is not None)
        self._lengths = MERGED * self.edge, REDUCTION_CELL * self.edge
        self._reduction = Reduction(s, self.buffer, *self._lengths)
        self.end: EndSearch | None = None  # see `find_at_end`
        self._intersecting: Buffer | None = None  # pairs of triangles, allocated at first use
        self._self_on, self.floor = properties["self_on"], FLOOR * float(self.edges[: len(bodies)].min())
        self.paths: PathCheck | None = None  # see `prepare_paths`
        self._containment = Containment(scene, self.topology, layout, self._rest, self._analytic, self_collision)
        self._placed = [MOVING] * len(obstacles)  # the paths at whose ends obstacles rest, as they were last placed
        self._frames = AnalyticFrames(self.shapes, self._analytic)
        self._broad_result: Trees | Candidates | None = None  # broad-phase result of the last search
        self._read, self._surface_counts = Reader(arena, "search"), [0] * 4  # the latter: those of the surface as they were read
        self.counts = Counts(triangles=s.n_triangles)

    def _checked_margin(self) -> float:
        """The margin [m]. Raise SceneError if it exceeds a body's mean surface edge: all its triangles would be neighbours."""
        margin = self.scene.collision.margin
        for body, mean in zip(self.scene.bodies, self.edges):
            if margin is not None and margin > mean:
                raise SceneError(
                    f"collision settings: margin = {margin:g} m is larger than the mean surface edge of body '{body.name}', "
                    f"{mean:.3g} m"
                )
        return MARGIN * self.edge if margin is None else margin

    def _make_broad(self, runtime: Runtime) -> SpatialHash | Bvh:
        settings, s, topology, kind = self.scene.collision, self.surface, self.topology, self.scene.collision.broad_phase
        limits = settings.initial_capacity, settings.max_capacity
        shift = [b.position for b in self.scene.bodies] + [np.zeros(3)] * len(self.scene.obstacles)
        x = self._rest + np.repeat(shift, np.diff(topology.vertex_first), axis=0)
        if kind == "auto":  # on the CPU trees were faster at every size measured, but their roots are compared pairwise
            few_colliders = len(self.scene.colliders) <= MANY_COLLIDERS
            kind = "bvh" if runtime.on_cpu and few_colliders else "spatial_hash"
        if kind == "bvh":
            return Bvh(s, topology, x, self.reach, runtime, self._arena, settings.k_dop)
        extent = np.ptp(x[topology.triangle].reshape(-1, 3), axis=0)
        return SpatialHash(s, self._arena, settings.cell_ratio * self.edge, extent, *limits)

    # --- a search -------------------------------------------------------------------------------------------------

    def find(
        self,
        time: float,
        dt: float,
        prescribed: tuple[np.ndarray, np.ndarray] | None = None,
        path=None,
        held: HeldPassages = NO_PASSAGES,
        none_cross: bool = False,
    ) -> None:
        """Find the contacts of the model's present state swept by dt [s]: pairs closer than the margin at any time in the step.

        Faces that have passed each other are found to a depth of `reach`, the margin plus a tenth of the mean edge.

        time [s]: of the obstacles. prescribed: (k,) nodes and their (k,3) displacements in the step [m], nan where free.
        path: field of (n_nodes) f64 3-vectors [m], displacements of the nodes to use instead of v dt. held: passages that become
        contacts. none_cross: whether no surfaces are known to cross here.
        Raise SimulationError if positions are not finite, or if a buffer would outgrow its limit.
        """
        if self.only_shapes and not len(held.pairs):
            motion = self.motion(time, dt, prescribed, path)

            def search() -> None:
                self.search_shapes(motion, none_cross)
        else:
            self._move(time, dt, prescribed, path)
            if self.overlay is not None and none_cross != self._none_cross:
                self._none_cross, self.overlay.behind[0] = none_cross, self.floor if none_cross else np.inf

            def search() -> None:
                self._broad_result = self._near()
                append = self._fill_with(self._broad_result, self)
                if len(held.pairs):
                    append_passages(self.surface, self.shapes, self.paths.fields, *held, self.buffer.parts, append)
                self._reduction.launch(self._lowest_gap(none_cross))

        unmapped = [] if self._fields is None else [self._fields.unmapped]
        found = self._fill(search, self.buffer, lambda: [self._reduction.work.count, *unmapped])
        self._refuse_nonfinite(self._surface_counts)
        self._reduction.read(found[0])
        self._count(found[1:])

    def _fill(self, search: Callable[[], None], out: ContactBuffer, also: Callable[[], list]) -> list[list]:
        """Run a search until it fits, and read the surface's counts, too; see `candidates.fill`."""
        broad = self.broad.buffers if self.has_pairs else ()
        given = {"read": self._read, "also": lambda: [self.surface.count, *also()]}
        self._surface_counts, *found = fill(search, *broad, *self._scratch(), out, **given)
        return found

    def _lowest_gap(self, none_cross: bool) -> float:
        """Gap [m] below which contacts are dropped: if none cross, a vertex behind a face is not inside."""
        return -self.floor if none_cross else -np.inf

    @property
    def only_shapes(self) -> bool:
        """Whether only analytic obstacles can be touched."""
        return not self.has_pairs and self.shapes.any

    def search_shapes(self, motion: tuple, none_cross: bool, room: int = 0, event: int = 0) -> None:
        """Launch `search_shapes`, in scenes with `only_shapes`. motion: of `motion`; room, event: as there."""
        reduction = self._reduction
        x, *others = motion
        search = self.margin, self.buffer.parts, reduction.prepare(), *reduction.scales, self._lowest_gap(none_cross)
        search_shapes(self.surface, self.shapes, x, *others, self.reach, *search, room, event)

    def motion(self, time: float, dt: float, prescribed=None, path=None, x=None) -> tuple:
        """Place the obstacles; return what else moves the surface, see `update_surface`: x, v, whether vertices are prescribed,
        these, and dt. x: the nodes' positions if not the present ones."""
        m = self.model
        with reworded(SceneError, raised=SimulationError):
            self._place_obstacles(time, dt)
        has_prescribed = prescribed is not None and len(prescribed[0]) > 0
        if has_prescribed:
            if self._prescribed_moves is None:
                self._prescribed_moves = self._arena.vectors("surface_prescribed", ti.f64, self.surface.n_verts)
            self._prescribed_moves.from_numpy(prescribed_vertices(self.topology, *prescribed))
        moves = self._prescribed_moves if has_prescribed else self.surface.move
        v, span = (m.state.v, dt) if path is None else (path, 1.0)
        return m.state.x if x is None else x, v, has_prescribed, moves, span

    def _move(self, time: float, dt: float, prescribed=None, path=None, x=None) -> None:
        """Update positions and displacements of the surface, and the boxes; the arguments are those of `motion`."""
        update_surface(self.surface, *self.motion(time, dt, prescribed, path, x), self.reach, self.has_pairs)
        if self.model.on_cpu:  # else it is seen after the search
            self._refuse_nonfinite(self.surface.count.to_numpy())

    def _place_obstacles(self, time: float, dt: float) -> None:
        """Place the obstacles at a time [s] and at the end of the step; those that rest are placed once."""
        starts, moved = self.topology.vertex_first[len(self.scene.bodies) :], set()
        for k, (o, begin, end) in enumerate(zip(self.scene.obstacles, starts[:-1], starts[1:])):
            rests = o.rests(time)
            if rests and self._placed[k] is o.path:
                continue
            self._placed[k] = o.path if rests else MOVING
            moved.add(len(self.scene.bodies) + k)
            if end > begin:
                now, then = (o.points_at(t, self._rest[begin:end]) for t in (time, time + dt))
                self.surface.x.from_numpy(now, begin)
                self.surface.move.from_numpy(then - now, begin)
        self._frames.place((row for row, (k, _) in enumerate(self._analytic) if k in moved), time, dt)

    def _refuse_nonfinite(self, count: list[int]) -> None:
        """Raise SimulationError if positions are not finite, by the counts of the surface."""
        if not count[NONFINITE]:
            return
        x, move = download([self.surface.x, self.surface.move])
        bad = int(np.argmin((np.isfinite(x) & np.isfinite(x + move)).all(axis=1)))
        k = int(np.searchsorted(self.topology.vertex_first, bad, side="right")) - 1
        node = self.topology.node[bad] - self.layout.node_start[k] if k < len(self.scene.bodies) else bad
        name = self.scene.colliders[k].name
        raise SimulationError(f"body '{name}', node {node}: position or velocity is not finite, so no contact can be found")

    def _near(self) -> Trees | Candidates | None:
        """Run the broad phase, whose buffers may be full; None if no two surfaces can touch."""
        return self.broad.search() if self.has_pairs else None

    def _scratch(self) -> list[Buffer]:
        """Buffers that every search fills."""
        return [buffer for buffer in (self._near_buffer, self._points) if buffer is not None]

    def _fill_with(self, near: Trees | Candidates | None, place: "Detection | EndSearch") -> int:
        """Write the contacts of the surface and shapes at a place, before reduction, as many as fit; return 1 if anything was
        searched, else 0."""
        s, shapes, out, append = place.surface, place.shapes, place.buffer.parts, 0
        if near is not None:
            row = self._near_buffer.parts
            if self._plan["proximity"]:
                find_proximity(s, near, row, PROXIMITY, out)
                append = 1
            if self.overlay is not None:
                find_mortar(s, near, row, self.overlay, self._points.parts, self.surface.move, place.buffer.lists.parts, out)
            if self._fields is not None:
                find_in_fields(s, near, row, self._fields, out, append)
                append = 1
        if shapes.count:
            find_analytic(s, shapes, self.margin, out, append)
            append = 1
        return append

    def warm_up(self) -> None:
        """Launch the kernels that only passages need, on none."""
        append_passages(self.surface, self.shapes, self.paths.fields, *NO_PASSAGES, self.buffer.parts, 1)
        self.bends(TO_STATE)
        self.paths.find_inwards(self.model.state.x, TO_STATE)

    def adopt(self, found: int, kept: int) -> None:
        """Take over the numbers of contacts of a search that was not read, in a scene with `only_shapes`."""
        self._reduction.n_found, self._reduction.n_kept = self.counts.found, self.counts.contacts = found, kept

    def _count(self, unmapped: list[list[int]]) -> None:
        """Update the counts. unmapped: of distance fields, if there are any."""
        count = self.counts
        if self.has_pairs:
            count.active, count.pairs = self._surface_counts[ACTIVE], self._surface_counts[PAIRS]
        if unmapped:
            count.unmapped = unmapped[0][0]
        count.found, count.contacts = self._reduction.n_found, self._reduction.n_kept
        count.growths = {b.name: b.growths for b in self._buffers()}

    def find_at_end(
        self, time: float, dt: float, x_start, displacement, farthest: float, also: Sequence[Array] = ()
    ) -> EndSearch | None:
        """Find the contacts at displacements from x_start, (n_nodes) [m] each, with obstacles as at the end of a step of dt.

        time: of the step's start. The last search must have been that of the step; it is repeated along these displacements if
        they leave its paths, and None returned if that is by more than `farthest` [m]. Surfaces may cross there.
        also: small arrays that are read as well, for `EndSearch.also`.
        """
        if self.end is None:
            self.end = EndSearch(self.surface, self.shapes, self.buffer, self._lengths)
        end, limit, moves = self.end, IN_BOXES * self.reach, False

        def search() -> None:
            if moves:
                self._broad_result = self._near()
            self._fill_with(self._broad_result, end)
            end.reduction.launch(-np.inf)

        while True:
            place_at_end(self.surface, end.surface, displacement, self.reach, end.left)
            left = end.left[0] if self.model.on_cpu and not moves else 0.0  # a GPU had better search than be asked before
            if moves or left <= limit:
                (left,), count, *end.also = self._fill(search, end.buffer, lambda: [end.left, end.reduction.work.count, *also])
            if not moves and not left <= farthest:
                return None
            if moves:
                self._refuse_nonfinite(self._surface_counts)
            if moves or left <= limit:
                end.reduction.read(count)
                return end
            self._move(time, dt, None, displacement, x_start)
            moves = True

    def let_rest(self, colliders: np.ndarray) -> bool:
        """Let colliders (n,) bool rest from now on, and no others: they are not tested against each other. Return whether some
        have rested that do not any more."""
        rested = self.surface.rests.to_numpy(len(colliders)) > 0
        self.surface.rests.from_numpy(colliders.astype(np.int32), 0)
        return bool((rested & ~colliders).any())

    # --- results --------------------------------------------------------------------------------------------------

    def contacts(self) -> Contacts:
        """Return the contacts of the last search, with impulses 0, in order of colliders and feature: one that does not depend on
        threads or chunks."""
        data, at, counts = self.buffer.data, self.kept.to_numpy(self.counts.contacts), self.counts
        geometry = {name: getattr(data, name)[at] for name in ("point", "normal", "gap", "feature", "guard", "area")}
        geometry |= dict(zip(("collider", "nodes", "weights"), (data.body[at], *self.sides(at))))
        return named_contacts(self.scene, **geometry, found=counts.found, unmapped=counts.unmapped)

    def sides(self, at: np.ndarray, data: ContactFields | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Nodes and weights (k, 2 w) of the contacts at places (k,) of a buffer, before dependent nodes are replaced.

        There are w of each side, at least three, -1 where there is none. data: of the buffer, None for that of the last search.
        """
        data = self.buffer.data if data is None else data
        vertices, weights = sides_of(data, at)
        nodes = np.where(vertices >= 0, np.append(self.topology.node, -1)[vertices], -1)
        return nodes, np.where(nodes >= 0, weights, 0.0)

    @property
    def found(self) -> tuple:
        """The contacts of the last search, for kernels: surface, shapes, buffer, and the indices there of those that are kept."""
        return self.surface, self.shapes, self.buffer.data, self.kept

    @property
    def reduction(self) -> ReductionFields:
        """The workspace of the last search's reduction."""
        return self._reduction.work

    @property
    def kept(self):
        """Field of the kept contacts' indices in the buffer; the first counts.contacts are valid."""
        return self._reduction.work.kept

    def intersections(self) -> np.ndarray:
        """Return the pairs (k,2) of triangles without a common vertex that intersect, at the positions of the last search."""
        if self._broad_result is None:
            return np.zeros((0, 2), dtype=np.int64)
        s, settings = self.surface, self.scene.collision
        if self._intersecting is None:
            capacity = settings.initial_capacity or s.n_triangles + 64
            self._intersecting = Buffer("intersections", pair_entries, capacity, settings.max_capacity, s.chunks, self._arena)
        return pairs_of(s, self._broad_result, self._near_buffer, INTERSECTING, self._intersecting)

    def crossings(self) -> np.ndarray:
        """Return (3,) f64: how deeply surfaces cross at the positions of the last search, see `find_crossings`."""
        near, row, crossed = self._broad_result, self._near_buffer, self._crossed
        if near is None or not self.counts.active:
            return np.zeros(3)
        fill(lambda: find_crossings(self.surface, near, row.parts, CROSSINGS_OF, crossed), row)
        return crossed.data.to_numpy(1)[0]

    def prepare_paths(self) -> None:
        """Allocate what the check of paths needs."""
        settings = self.scene.collision
        limits = settings.initial_capacity, settings.max_capacity
        options = self._self_on, self.has_pairs, self.reach, self.floor, self._arena, *limits
        self.paths = PathCheck(self.surface, self.topology, self.shapes, *options)

    def passages(self, mode: int, also: Sequence[Array] = ()) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the passages (k,4) on the paths from the positions of the last search, and the parts (k,) of the step until
        which they are apart, or None, see `PathCheck.find`."""
        return self.paths.find(self.model.state.x, self._broad_result, self._near_buffer, mode, also)

    def list_near(self) -> None:
        """List the near pairs of the last search for checks of paths in a batch."""
        self.paths.prepare_batch(self.model.state.x, self._broad_result, self._near_buffer)

    def bends(self, mode: int) -> bool:
        """Return whether a bent path is free instead of a straight one of that mode."""
        return self.paths.bends(self.model.state.x, self._broad_result, self._near_buffer, mode, self.margin)

    def exempt_crossing(self) -> bool:
        """Exempt the pairs of colliders that cross or touch at the positions of the last search from further checks of paths, and
        no others. Return whether there are any."""
        n = len(self.scene.colliders)
        pairs = np.zeros((n, n), dtype=bool)
        self.paths.exempt(pairs)
        found = self.paths.colliders(self.passages(STILL)[0])
        pairs[found[:, 0], found[:, 1]] = True
        for one in self.contained():
            pairs[one.a, one.b] = True
        if pairs.any():
            self.paths.exempt(pairs)
        return bool(pairs.any())

    def contained(self) -> list[Inside]:
        """Return the parts of colliders that lie inside others at the positions of the last search, see `Containment`."""
        return self._containment.find(self.surface, self.model.state.x, self.shapes)

    def _buffers(self) -> list[Buffer]:
        paths, end = () if self.paths is None else self.paths.buffers, () if self.end is None else (self.end.buffer,)
        broad = self.broad.buffers if self.has_pairs else ()
        return [self.buffer, *end, *self._scratch(), *broad, *paths]

    @property
    def field_bytes(self) -> dict[str, int]:
        """Size of every allocated field [bytes], by name."""
        end = {} if self.end is None else self.end.bytes
        return self._arena.bytes | self._reduction.bytes | end | {b.name: b.bytes for b in self._buffers()}

    def release(self) -> None:
        """Free all memory."""
        for part in (self.broad, self._intersecting, self._near_buffer, self._points, self.paths, self.end):
            if part is not None:
                part.release()
        self.buffer.release()
        self._reduction.release()
        self._arena.release()
