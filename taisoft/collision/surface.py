"""Surface triangles of all colliders in one list: soft bodies first, then obstacles that have faces.

Positions and boxes are f64 in either precision, since a gap is a small difference of large numbers. `boxes.py` fills them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import Runtime

SERIAL_BELOW = 1500  # triangles below which one thread is faster than starting the others (about 50 us a loop)
# The same for loops with little work per iteration: boxes, tree refit, sharp edges, reduction. Measured with two cores: equal at
# 21,000 triangles; at 105,000 the search is 1.3 times as fast on both cores.
SERIAL_CHEAP_BELOW = 30000
# Taichi gives each CPU thread at least 512 iterations of a loop: each chunk takes that many, and only the first does the work
SPREAD = {"cpu": 512, "cuda": 1}
CHUNKS = {"cpu": 64, "cuda": 4096}  # chunks of a list that are processed in parallel, each with its own part of a buffer
NONFINITE, ACTIVE, PAIRS = 0, 1, 2  # indices into Surface.count
INSIDE_BITS = 31  # of Surface.inside; one vertex is almost never inside two colliders with the same bit

dvec = ti.types.vector(3, ti.f64)
ivec = ti.types.vector(3, ti.i32)


@dataclass(frozen=True)
class Topology:
    """Triangles on the host. Vertices are numbered over all colliders, surface vertices only.

    triangle: (t,3) vertices; body: (t,) collider, ascending; first: (n_bodies + 1,) first triangle of each collider;
    vertex_first: (n_bodies + 1,) first vertex; node: (v,) the model's node, -1 for obstacles; neighbour: (t,3) triangle across
    the edge from corner k to k + 1, -1 if there is none; owns: (t,) bits 0-2 corners, 3-5 edges that this triangle handles on
    behalf of all that share them; ring_start, ring: triangles around each vertex; around_start, around: adjacent vertices.
    """

    triangle: np.ndarray
    body: np.ndarray
    first: np.ndarray
    vertex_first: np.ndarray
    node: np.ndarray
    neighbour: np.ndarray
    owns: np.ndarray
    ring_start: np.ndarray
    ring: np.ndarray
    around_start: np.ndarray
    around: np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """Fields of the triangles, for kernels; the tables are described in `Topology`."""

    n_triangles: Count
    n_verts: Count
    n_bodies: Count  # colliders, including those without faces
    serial: bool  # whether one thread runs all loops
    serial_cheap: bool  # whether one thread runs the cheap loops
    chunks: int
    spread: int  # loop iterations per chunk, see SPREAD
    cheap_spread: int  # the same for cheap loops
    triangle: Any  # (n_triangles, 3) i32
    body: Any  # i32
    node: Any  # i32
    neighbour: Any  # (n_triangles, 3) i32
    owns: Any  # i32
    ring_start: Any  # i32
    ring: Any  # i32
    around_start: Any  # i32
    around: Any  # i32
    soft: Any  # (n_bodies) i32: 1 for soft bodies
    self_on: Any  # (n_bodies) i32: 1 if a body is tested against itself
    first_of: Any  # (n_bodies + 1) i32
    thickness: Any  # (n_bodies) f64: thickness [m], inf for half-spaces
    edge: Any  # (n_bodies) f64: mean surface edges of the bodies [m], inf for obstacles
    rest: Any  # (n_verts) 3-vectors f64: rest positions [m]
    x: Any  # (n_verts) 3-vectors f64: present positions [m]
    move: Any  # (n_verts) 3-vectors f64: displacements in the step [m]
    lo: Any  # 3-vectors f64: boxes of the triangles [m]
    hi: Any
    normal: Any  # 3-vectors f64: unit normals of the triangles at x, 0 for degenerate ones
    area: Any  # f64: twice their areas [m^2]
    body_lo: Any  # (n_bodies) 3-vectors f64
    body_hi: Any
    active: Any  # i32: triangles whose box meets another collider's, ascending; the first count[ACTIVE] are valid
    count: Any  # (4) i32: numbers of NONFINITE and ACTIVE triangles, and of (query, nearby triangle) PAIRS
    part: Any  # (chunks) i32: count of each chunk
    near: Any  # (chunks * n_bodies) i32: colliders near each chunk's current collider
    inside: Any  # (n_verts) i32: bit k % INSIDE_BITS is set if the vertex is in collider k and has contacts that move it out
    exit_direction: Any  # (n_verts) 3-vectors f64: summed exit displacements of those contacts [m]


def make_topology(parts: list[tuple[np.ndarray, np.ndarray]]) -> Topology:
    """Combine the surfaces of all colliders. parts: for each, (t,3) triangles and the (v,) nodes of their vertices."""
    triangle, body, node, first, vertex_first = [], [], [], [0], [0]
    for k, (triangles, nodes) in enumerate(parts):
        triangle.append(triangles + vertex_first[-1])
        body.append(np.full(len(triangles), k))
        node.append(nodes)
        first.append(first[-1] + len(triangles))
        vertex_first.append(vertex_first[-1] + len(nodes))
    t = np.concatenate(triangle).reshape(-1, 3)
    neighbour, edge_owned = _edge_neighbours(t)
    corners = t.reshape(-1)
    order = np.argsort(corners, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=vertex_first[-1]))])
    ring = order // 3
    owner = np.full(vertex_first[-1], -1)
    used = start[1:] > start[:-1]
    owner[used] = ring[start[:-1][used]]  # the first triangle around a vertex
    corner_owned = owner[t] == np.arange(len(t))[:, None]
    bits = np.concatenate([corner_owned, edge_owned], axis=1) @ (1 << np.arange(6))
    return Topology(
        t,
        np.concatenate(body),
        np.array(first),
        np.array(vertex_first),
        np.concatenate(node),
        neighbour,
        bits,
        start,
        ring,
        *_adjacent_vertices(t, vertex_first[-1]),
    )


def _adjacent_vertices(t: np.ndarray, n_verts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the start of each vertex's list (n_verts + 1,), and the adjacent vertices, ascending."""
    ends = t[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    code = np.unique(np.concatenate([ends, ends[:, ::-1]]) @ [n_verts, 1])
    return np.searchsorted(code, np.arange(n_verts + 1) * n_verts), code % max(n_verts, 1)


def _edge_neighbours(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return neighbours (t,3) across the edges, -1 at open and non-manifold edges; (t,3) bool: the triangle owns the edge."""
    ends = np.sort(np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (ends[order[1:]] != ends[order[:-1]]).any(axis=1)
    starts = np.flatnonzero(new)
    counts = np.diff(np.append(starts, len(order)))
    neighbour = np.full(len(order), -1)
    a, b = order[starts[counts == 2]], order[starts[counts == 2] + 1]
    neighbour[a], neighbour[b] = b // 3, a // 3
    owned = np.zeros(len(order), dtype=bool)
    owned[order[starts]] = True  # the lowest triangle, since the sort is stable
    return neighbour.reshape(-1, 3), owned.reshape(-1, 3)


def build_surface(
    topology: Topology,
    rest: np.ndarray,
    soft: np.ndarray,
    self_on: np.ndarray,
    thickness: np.ndarray,
    edge: np.ndarray,
    runtime: Runtime,
    arena: FieldArena,
    serial: bool | None = None,
) -> Surface:
    """Allocate and fill the fields. rest: (v,3) [m]; soft, self_on: (n_bodies,) bool; thickness, edge: (n_bodies,) [m].
    serial: None decides by size."""
    t, i = topology, ti.i32
    n, v, bodies = len(t.triangle), len(t.node), len(soft)
    serial_cheap = serial
    if serial is None:
        serial, serial_cheap = (runtime.arch == "cpu" and n < limit for limit in (SERIAL_BELOW, SERIAL_CHEAP_BELOW))
    chunks = 1 if serial else CHUNKS[runtime.arch]

    def ints(name: str, data: np.ndarray):
        return arena.field(f"surface_{name}", i, max(len(data), 1), _non_empty(data))

    def rows(name: str, data: np.ndarray):
        # not a vector field: the compiler confuses run-time and fixed component indices within one kernel
        return arena.field(f"surface_{name}", i, (max(len(data), 1), 3), _non_empty(data))

    def vectors(name: str, count: int):
        return arena.vectors(f"surface_{name}", ti.f64, max(count, 1))

    return Surface(
        n,
        v,
        bodies,
        serial,
        serial_cheap,
        chunks,
        *(1 if one else SPREAD[runtime.arch] for one in (serial, serial_cheap)),
        rows("triangle", t.triangle),
        ints("body", t.body),
        ints("node", t.node),
        rows("neighbour", t.neighbour),
        ints("owns", t.owns),
        ints("ring_start", t.ring_start),
        ints("ring", t.ring),
        ints("around_start", t.around_start),
        ints("around", t.around),
        ints("soft", soft),
        ints("self_on", self_on),
        ints("first_of", t.first),
        arena.field("surface_thickness", ti.f64, max(bodies, 1), thickness if bodies else None),
        arena.field("surface_edge", ti.f64, max(bodies, 1), edge if bodies else None),
        arena.vectors("surface_rest", ti.f64, max(v, 1), rest if v else None),
        vectors("x", v),
        vectors("move", v),
        vectors("lo", n),
        vectors("hi", n),
        vectors("normal", n),
        arena.field("surface_area", ti.f64, max(n, 1)),
        vectors("body_lo", bodies),
        vectors("body_hi", bodies),
        arena.field("surface_active", i, max(n, 1)),
        arena.field("surface_count", i, 4),
        arena.field("surface_part", i, chunks),
        arena.field("surface_near", i, chunks * max(bodies, 1)),
        arena.field("surface_inside", i, max(v, 1)),
        vectors("exit_direction", v),
    )


def _non_empty(data: np.ndarray) -> np.ndarray:
    """Convert to i32 with at least one row, since no field may be empty."""
    data = np.asarray(data)
    return (data if len(data) else np.zeros((1, *data.shape[1:]))).astype(np.int32)


@ti.func
def part_first(c, n, parts: ti.template()):
    """Return the start of part c of a list of n entries divided into equal parts."""
    return c * (n // parts) + ti.min(c, n % parts)


@ti.func
def boxes_overlap(s: ti.template(), t, u):
    """Whether the boxes of two triangles share a point."""
    found = False  # axis by axis: the first one separates most boxes
    if s.lo[t][0] <= s.hi[u][0] and s.lo[u][0] <= s.hi[t][0]:
        if s.lo[t][1] <= s.hi[u][1] and s.lo[u][1] <= s.hi[t][1]:
            found = s.lo[t][2] <= s.hi[u][2] and s.lo[u][2] <= s.hi[t][2]
    return found


@ti.func
def share_vertex(s: ti.template(), t, u):
    """Whether two triangles have a vertex in common."""
    found = 0
    for k in range(3):
        i = s.triangle[t, k]
        if i == s.triangle[u, 0] or i == s.triangle[u, 1] or i == s.triangle[u, 2]:
            found = 1
    return found


@ti.func
def may_touch(s: ti.template(), t, u):
    """Whether two triangles are a valid pair: of different colliders, one of them soft; or of one body that is tested against
    itself, without a common vertex."""
    a, b = s.body[t], s.body[u]
    result = 0
    if a != b:
        result = s.soft[a] | s.soft[b]
    elif s.self_on[a] == 1:
        result = 1 - share_vertex(s, t, u)
    return result
