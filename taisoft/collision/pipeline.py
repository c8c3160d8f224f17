"""Detection: from a state to a list of contacts. Boxes, candidates, the three kinds of geometry, reduction.

What a scene does not need is neither allocated nor launched: without two surfaces there are no candidates, where they are not
asked for no distance fields, without an analytic obstacle no analytic distances.
"""

from dataclasses import dataclass, field

import numpy as np
import taichi as ti

from taisoft.collision.analytic import NO_SHAPES, AnalyticObstacles, find_analytic
from taisoft.collision.boxes import move_obstacles, take_prescribed, update_surface
from taisoft.collision.bvh import Bvh, Trees
from taisoft.collision.candidates import Buffer, Candidates, entries
from taisoft.collision.colliders import (
    body_grid,
    collider_edge,
    collider_surfaces,
    collider_thickness,
    obstacle_frame,
    prescribed_vertices,
)
from taisoft.collision.contacts import KINDS, Contacts, contact_fields, gather
from taisoft.collision.containment import Containment, Inside
from taisoft.collision.crossings import find_crossings
from taisoft.collision.features import BY_EDGES, BY_FACES, BY_FIELD
from taisoft.collision.proximity import find_proximity
from taisoft.collision.reduction import FOUND, LEFT, ReductionFields, reduce_contacts, reduction_fields
from taisoft.collision.sdf import DistanceFields, build_fields, find_in_fields
from taisoft.collision.self_collision import Intersections
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.collision.surface import ACTIVE, NONFINITE, PAIRS, Surface, build_surface
from taisoft.errors import SceneError, SimulationError
from taisoft.fields import FieldArena
from taisoft.mesh.quality import mean_surface_edge
from taisoft.mesh.sdf_grid import SdfGrid
from taisoft.model import Layout, Model
from taisoft.runtime import Runtime
from taisoft.scene.body import Body
from taisoft.scene.obstacles import MeshObstacle
from taisoft.scene.plan import make_plan
from taisoft.scene.scene import Scene
from taisoft.transfer import download, upload

MARGIN = 0.1  # of the mean surface edge: distance within which contacts are found, where the scene names none
DEPTH = 0.1  # of the mean surface edge: flat faces that have passed each other by less are still found
MERGED = 1e-3  # of the mean surface edge: contacts nearer than this are one
REDUCTION_CELL = 0.25  # of the mean surface edge: cells of the reduction
MANY = 200  # colliders above which the spatial hash finds candidates
CONTACTS_PER_TRIANGLE = 1  # room at first
LONGEST_ROW = 4096  # triangles near one vertex or triangle that there is room for at first


@dataclass
class Counts:
    """What the last search went through."""

    triangles: int = 0
    active: int = 0  # triangles whose box meets another collider's
    pairs: int = 0  # of a vertex, an edge's triangle or a triangle before a distance field, and a triangle near it
    found: int = 0  # contacts before the reduction
    contacts: int = 0  # after it
    unmapped: int = 0  # (triangle, body) whose tet is inverted, so that the body's field could not be used
    growths: dict[str, int] = field(default_factory=dict)  # times that each buffer grew since the start


def _fitting_margin(margin: float, bodies: list[Body], edges: np.ndarray) -> float:
    """The margin [m], which must not exceed any body's mean surface edge: all of its triangles would be near one another."""
    for body, mean in zip(bodies, edges):
        if margin > mean:
            raise SceneError(
                f"collision settings: margin = {margin:g} m is larger than the mean surface edge of body '{body.name}', "
                f"{mean:.3g} m"
            )
    return margin


class Detection:
    """Finds the contacts of a scene. edge: mean surface edge of the soft bodies at rest; margin, reach: as in `find` [m]."""

    def __init__(
        self, scene: Scene, model: Model, layout: Layout, runtime: Runtime, self_collision: bool = False,
        serial: bool | None = None,
    ):  # fmt: skip
        """Allocate what the scene needs. serial: None decides by size. Raises MeshError where a field cannot be made."""
        self.scene, self.model, self.layout = scene, model, layout
        settings, bodies, obstacles = scene.collision, scene.bodies, scene.obstacles
        self.edge = mean_surface_edge([(b.nodes.positions, b.nodes.surface) for b in bodies])
        self.edges = np.array([collider_edge(c) for c in scene.colliders])
        self.margin = MARGIN * self.edge if settings.margin is None else _fitting_margin(settings.margin, bodies, self.edges)
        self.reach = self.margin + DEPTH * self.edge  # by half of it boxes grow
        self.topology, self._rest = collider_surfaces(scene, layout)
        self._rows = self_collision or int((np.diff(self.topology.first) > 0).sum()) > 1
        self._proximity = self._rows and make_plan(scene, False, False, self_collision).on["proximity"]
        grids = self._grids() if self._rows else []  # before anything is allocated: they may be impossible
        self._arena = arena = FieldArena()
        soft = np.arange(len(scene.colliders)) < len(bodies)
        self.thickness = np.array([collider_thickness(c, self.edge) for c in scene.colliders])
        self._analytic = [(len(bodies) + k, o) for k, o in enumerate(obstacles) if not isinstance(o.shape, MeshObstacle)]
        ways = [BY_FACES if b.contact_mode == "proximity" else BY_FIELD for b in bodies]
        ways += [BY_FACES if isinstance(o.shape, MeshObstacle) else BY_EDGES for o in obstacles]
        self.surface: Surface = build_surface(
            self.topology, self._rest, soft, soft & self_collision, self.thickness, self.edges, runtime, arena, serial
        )
        s = self.surface
        self.broad = self._make_broad(runtime) if self._rows else None
        self._path = arena.field("contact_way", ti.i32, len(ways), np.array(ways, dtype=np.int32))
        self._sharp = arena.field("surface_sharp", ti.i32, max(s.n_triangles, 1))
        self._unmapped = arena.field("unmapped", ti.i32, 1)
        self._crossed = arena.vectors("crossed", ti.f64, s.chunks)
        self._fields = self._make_fields(grids, runtime) if any(grids) else None
        self.shapes = self._make_shapes() if self._analytic else NO_SHAPES
        self._prescribed = None  # how far vertices are led, where they ever are
        row = min(int(np.diff(self.topology.first).max(initial=1)), LONGEST_ROW) * s.chunks
        limits = (settings.initial_capacity or row, settings.max_capacity)
        self._row = Buffer("near", entries, *limits, s.chunks, arena) if self._rows else None
        capacity = settings.initial_capacity or CONTACTS_PER_TRIANGLE * s.n_triangles + 64
        self.buffer = Buffer("contacts", contact_fields, capacity, settings.max_capacity, s.chunks, arena)
        self._reduction_arena = FieldArena()
        self._reduction: ReductionFields | None = None
        self._intersections: Intersections | None = None
        self._containment = Containment(scene, self.topology, layout, self._rest, self._analytic, self_collision)
        self._placed = False  # whether obstacles have been placed
        self._looked: Trees | Candidates | None = None  # where the last search looked
        self.counts = Counts(triangles=s.n_triangles)

    def _make_broad(self, runtime: Runtime) -> SpatialHash | Bvh:
        settings, s = self.scene.collision, self.surface
        limits = (settings.initial_capacity, settings.max_capacity)
        wanted = settings.broad_phase
        if wanted == "auto":  # on the CPU trees were faster at every size measured; their roots are compared one by one
            few = len(self.scene.colliders) <= MANY
            wanted = "bvh" if runtime.arch == "cpu" and few else "spatial_hash"
        if wanted == "bvh":
            x = self._rest + self._start_shift()
            return Bvh(s, self.topology, x, self.reach, runtime, self._arena, settings.k_dop, capacity=limits[0], most=limits[1])
        extent = np.ptp((self._rest + self._start_shift())[self.topology.triangle].reshape(-1, 3), axis=0)
        return SpatialHash(s, self._arena, settings.cell_ratio * self.edge, extent, *limits)

    def _start_shift(self) -> np.ndarray:
        """(v,3) [m]: from rest to where the bodies start."""
        shift = [b.position for b in self.scene.bodies] + [np.zeros(3)] * len(self.scene.obstacles)
        return np.repeat(shift, np.diff(self.topology.vertex_first), axis=0)

    def _grids(self) -> list[SdfGrid | None]:
        """Of each collider, None where it has none."""
        cells, margin = self.scene.collision.field_cells, 2.0 * self.margin
        grids = [body_grid(b, cells, margin) if b.contact_mode == "distance_field" else None for b in self.scene.bodies]
        return grids + [None] * len(self.scene.obstacles)

    def _make_fields(self, grids: list[SdfGrid | None], runtime: Runtime) -> DistanceFields:
        return build_fields(
            self.scene.bodies, grids, self.model.state.x, self.topology.first, self.layout.node_start, runtime.real,
            runtime.np_real, self._arena,
        )  # fmt: skip

    def _make_shapes(self) -> AnalyticObstacles:
        arena, n = self._arena, len(self._analytic)

        def vectors(name: str, count: int, data: np.ndarray | None = None):
            return arena.vectors(f"obstacle_{name}", ti.f64, count, data)

        shapes = [o.shape for _, o in self._analytic]
        return AnalyticObstacles(
            n, arena.field("obstacle_body", ti.i32, n, np.array([k for k, _ in self._analytic], dtype=np.int32)),
            arena.field("obstacle_kind", ti.i32, n, np.array([x.kind for x in shapes], dtype=np.int32)),
            vectors("size", n, np.array([x.size() for x in shapes])), vectors("origin", n), vectors("rotation", 3 * n),
            vectors("next_origin", n), vectors("next_rotation", 3 * n),
        )  # fmt: skip

    # --- a search -------------------------------------------------------------------------------------------------

    def find(self, time: float, dt: float, prescribed: tuple[np.ndarray, np.ndarray] | None = None, path=None) -> None:
        """Find the contacts of the model's present state swept by dt [s]: those nearer than the margin at some moment.

        Faces that have passed each other are found to a depth of `reach`, the margin and a tenth of the mean edge.

        time [s]: of the obstacles. led: (k,) nodes and (k,3) how far they are led during the step [m], nan where they are not.
        way: a field of (n_nodes) f64 3-vectors [m], how far the nodes go, where that is known better than v dt.
        Raises SimulationError where positions are not finite, or a buffer may not grow as far as it must.
        """
        self._move(time, dt, prescribed, path)
        self._looked = self._near()
        self._search(self._looked)
        self._reduce()

    def _move(self, time: float, dt: float, prescribed: tuple[np.ndarray, np.ndarray] | None = None, path=None) -> None:
        """The surface where it is and how far it goes, and the boxes."""
        s, m = self.surface, self.model
        self._place_obstacles(time, dt)
        has_prescribed = prescribed is not None and len(prescribed[0]) > 0
        v, span = (m.state.v, dt) if path is None else (path, 1.0)
        ways = self._upload_prescribed(*prescribed) if has_prescribed else s.move
        update_surface(s, m.state.x, v, has_prescribed, ways, span, self.reach, self._rows)
        if s.count[NONFINITE]:
            raise SimulationError(self._nonfinite())

    def _near(self) -> Trees | Candidates | None:
        """Where to look for near triangles; None where no two surfaces can touch."""
        return self.broad.near() if self._rows else None

    def _search(self, near: Trees | Candidates | None) -> None:
        """Fill the buffer of contacts; what is too small for them grows."""
        while True:
            self._fill_buffer(near)
            grown = near is not None and self._row.grow_if_full()
            if not self.buffer.grow_if_full() and not grown:
                break

    def _fill_buffer(self, near: Trees | Candidates | None) -> None:
        """Contacts before the reduction, as far as they fit."""
        s, b, row = self.surface, self.buffer, self._row
        out, append, half = (b.data, b.used, b.count, b.part), 0, 0.5 * self.reach
        if near is not None:
            rows = (row.data, row.used, row.count, row.part)
            if self._proximity:
                find_proximity(s, near, self._path, self._sharp, *rows, self.margin, half, *out)
                append = 1
            if self._fields is not None:
                find_in_fields(s, near, self._fields, self._sharp, *rows, self.margin, half, *out, append, self._unmapped)
                append = 1
        if self.shapes.count:
            find_analytic(s, self.shapes, self.margin, *out, append)

    def _reduce(self) -> None:
        """List the contacts that are kept, and count."""
        b = self.buffer
        if self._reduction is None or self._reduction.place.shape[0] != b.capacity:
            arena = FieldArena()
            self._reduction = reduction_fields(arena, b.capacity, b.chunks, self.surface.serial_cheap, self.surface.cheap_spread)
            self._reduction_arena.release()
            self._reduction_arena = arena
        reduce_contacts(self._reduction, b.data, b.used, b.part, MERGED * self.edge, REDUCTION_CELL * self.edge)
        count, surface = self.counts, self.surface.count
        if self._rows:
            count.active, count.pairs = surface[ACTIVE], surface[PAIRS]
        if self._fields is not None:
            count.unmapped = self._unmapped[0]
        count.found, count.contacts = self._reduction.count[FOUND], self._reduction.count[LEFT]
        count.growths = {b.name: b.growths for b in self._buffers()}

    def _place_obstacles(self, time: float, dt: float) -> None:
        """Obstacles where they are at a time and at the end of the step; those that stand still are placed once."""
        try:
            self._ask_paths(time, dt)
        except SceneError as error:
            raise SimulationError(str(error)) from None

    def _ask_paths(self, time: float, dt: float) -> None:
        first = not self._placed
        start = len(self.scene.bodies)
        for k, o in enumerate(self.scene.obstacles):
            vertices = slice(self.topology.vertex_first[start + k], self.topology.vertex_first[start + k + 1])
            if vertices.stop > vertices.start and (first or o.path is not None):
                now, then = o.points_at(time, self._rest[vertices]), o.points_at(time + dt, self._rest[vertices])
                move_obstacles(self.surface, vertices.start, now, then - now)
        if self._analytic and (first or any(o.path is not None for _, o in self._analytic)):
            s, now, then = self.shapes, *([obstacle_frame(o, t) for _, o in self._analytic] for t in (time, time + dt))
            upload([
                (s.origin, np.array([x for x, _ in now])), (s.rotation, np.concatenate([r for _, r in now])),
                (s.next_origin, np.array([x for x, _ in then])), (s.next_rotation, np.concatenate([r for _, r in then])),
            ])  # fmt: skip
        self._placed = True

    def _upload_prescribed(self, nodes: np.ndarray, moves: np.ndarray):
        """The field of how far vertices are led."""
        if self._prescribed is None:
            self._prescribed = self._arena.vectors("surface_led", ti.f64, self.surface.n_verts)
        take_prescribed(self.surface, self._prescribed, prescribed_vertices(self.topology, nodes, moves))
        return self._prescribed

    def _nonfinite(self) -> str:
        x, move = download([self.surface.x, self.surface.move])
        bad = int(np.argmin((np.isfinite(x) & np.isfinite(x + move)).all(axis=1)))
        k = int(np.searchsorted(self.topology.vertex_first, bad, side="right")) - 1
        node = self.topology.node[bad] - self.layout.node_start[k] if k < len(self.scene.bodies) else bad
        name = self.scene.colliders[k].name
        return f"body '{name}', node {node}: position or velocity is not finite, so no contact can be found"

    # --- what was found -------------------------------------------------------------------------------------------

    def contacts(self) -> Contacts:
        """The last search's contacts, impulses 0."""
        found = gather(self.buffer.data, self._reduction.kept, self._reduction.count[LEFT])
        body, feature = found["body"], found["feature"]
        # an order that neither threads nor parts of the work change, so that a solver sees it again in the next step
        order = np.lexsort((feature[:, 2], feature[:, 1], feature[:, 0], body[:, 1], body[:, 0]))
        names = ("point", "normal", "gap", "body", "feature", "nodes", "weights")
        point, normal, gap, body, feature, nodes, weights = (found[name][order] for name in names)
        nodes = np.where(nodes >= 0, np.append(self.topology.node, -1)[nodes], -1)
        weights = np.where(nodes >= 0, weights, 0.0)
        return self.record(point, normal, gap, np.zeros((len(gap), 3)), body, feature, nodes, weights)

    def record(self, point, normal, gap, impulse, body, feature, nodes, weights) -> Contacts:
        """Arrays of contacts (k, ...) with the names of the colliders and the numbers of their pairs. body: (k,2) colliders."""
        names = np.array([c.name for c in self.scene.colliders], dtype=object)
        pairs, pair = np.unique(body, axis=0, return_inverse=True)
        numbers = np.array([self.scene.contact_numbers(names[a], names[b]) for a, b in pairs]).reshape(-1, 2)[pair.reshape(-1)]
        return Contacts(
            point, normal, gap, impulse, names[body[:, 0]], names[body[:, 1]], nodes, weights,
            np.array(KINDS, dtype=object)[feature[:, 0]], feature[:, 1:], numbers[:, 0], numbers[:, 1], self.counts.found,
            self.counts.unmapped,
        )  # fmt: skip

    @property
    def kept(self):
        """The field of the kept contacts' places in the buffer, the first counts.contacts of it."""
        return self._reduction.kept

    def intersections(self) -> np.ndarray:
        """(k,2) pairs of the surface's triangles that intersect where the last search found them, without a common vertex."""
        if not self._rows:
            return np.zeros((0, 2), dtype=np.int64)
        if self._intersections is None:
            limits = (self.scene.collision.initial_capacity, self.scene.collision.max_capacity)
            self._intersections = Intersections(self.surface, self._arena, *limits)
        return self._intersections.find(self.broad.find())

    def crossings(self) -> np.ndarray:
        """(3,) f64: how deep surfaces have passed through each other where the last search found them, see `find_crossings`."""
        told, row = np.zeros(3), self._row
        while self._looked is not None and self.counts.active:
            rows = (row.data, row.used, row.count, row.part)
            find_crossings(self.surface, self._looked, self._sharp, *rows, 0.5 * self.reach, self._crossed, told)
            if not row.grow_if_full():
                break
        return told

    def contained(self) -> list[Inside]:
        """Parts of colliders that lie inside others where the last search found them, see `Containment`."""
        return self._containment.find(self.surface, self.model.state.x, self.shapes)

    def _buffers(self) -> list[Buffer]:
        return [self.buffer, *((self._row, *self.broad.buffers) if self._rows else ())]

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of every allocated field by name."""
        return self._arena.bytes | self._reduction_arena.bytes | {b.name: b.bytes for b in self._buffers()}

    def release(self) -> None:
        """Give all memory back."""
        for part in (self.broad, self._intersections, self._row):
            if part is not None:
                part.release()
        self.buffer.release()
        self._reduction_arena.release()
        self._arena.release()
