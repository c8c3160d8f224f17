"""Surface triangles of all colliders in one list on the device: soft bodies first, then obstacles that have faces.

Positions and boxes are f64 in either precision, since a gap is a small difference of large numbers. A triangle's box bounds it
at the start and at the end of the step and is grown by half the margin, so that two triangles whose distance falls below the
margin have overlapping boxes. A triangle with a non-finite coordinate has an empty box, which overlaps nothing. Active triangles
are those that can have a partner.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend import parallel
from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.lists import part_first, spread_on
from taisoft.backend.paths import gpu_threads
from taisoft.backend.runtime import Runtime, kernel
from taisoft.backend.team import Team, make_team
from taisoft.collision.colliders import Topology
from taisoft.fem.state import GO

SERIAL_BELOW = 1500  # triangles below which one thread is faster than starting the others (about 50 us a loop)
# Of one thread per triangle: in the loops over nearby pairs, and in cheap loops (boxes, tree refit, sharp edges, reduction)
TRIANGLE_SECONDS, CHEAP_SECONDS = 1e-7, 5e-9
NOT_FINITE = 0x7FF  # exponent bits of infinite f64 numbers and of those that are no numbers
CPU_CHUNKS, GPU_CHUNKS = 64, 4096  # chunks of a list that are processed in parallel, each with its own part of a buffer
NONFINITE, ACTIVE, PAIRS = 0, 1, 2  # indices into Surface.count
INSIDE_BITS = 31  # of Surface.inside; one vertex is almost never inside two colliders with the same bit

dvec = ti.types.vector(3, ti.f64)
ivec = ti.types.vector(3, ti.i32)


@dataclass(frozen=True, eq=False)
class Surface:
    """Fields of the triangles, for kernels. triangle to around are the tables of `Topology`."""

    n_triangles: Count
    n_verts: Count
    n_bodies: Count  # colliders, including those without faces
    serial: bool  # whether one thread runs all loops
    serial_cheap: bool  # whether one thread runs the cheap loops
    on_cpu: bool
    chunks: int
    spread: int  # loop iterations per chunk, see `backend.lists`
    cheap_spread: int  # the same for cheap loops
    team: Team  # of loops over chunks
    triangle: Any
    body: Any
    node: Any
    neighbour: Any
    owns: Any
    ring_start: Any
    ring: Any
    around_start: Any
    around: Any
    soft: Any  # (n_bodies) i32: 1 for soft bodies
    self_on: Any  # (n_bodies) i32: 1 if a body is tested against itself
    rests: Any  # (n_bodies) i32: 1 for colliders that rest: those are not tested against each other
    attached: Any  # (n_bodies^2) i32: 1 for pairs that are not tested, since they are attached to each other; None: no pair is
    mode: Any  # (n_bodies) i32: contact mode, see `features`
    thickness: Any  # (n_bodies) f64: thickness [m], inf for half-spaces
    edge: Any  # (n_bodies) f64: mean surface edges of the bodies [m], inf for obstacles
    rest: Any  # (n_verts) 3-vectors f64: rest positions [m]
    x: Any  # (n_verts) 3-vectors f64: present positions [m]
    move: Any  # (n_verts) 3-vectors f64: displacements in the step [m]
    lo: Any  # 3-vectors f64: boxes of the triangles [m]
    hi: Any
    normal: Any  # 3-vectors f64: unit normals of the triangles at x, 0 for degenerate ones
    area: Any  # f64: twice their areas [m^2]
    body_lo: Any  # (n_bodies) 3-vectors f64: boxes of the colliders [m]
    body_hi: Any
    active: Any  # i32: triangles whose box meets another collider's, ascending; the first count[ACTIVE] are valid
    active_of_chunk: Any  # i32: the same, those of each chunk from its first triangle on
    count: Any  # (4) i32: numbers of NONFINITE and ACTIVE triangles, and of (query, nearby triangle) PAIRS
    run: Any  # (2) i32: 1, or 0 once a batch of sub-steps has ended early; the event that has ended it, see `explicit_batch`
    part: Any  # (chunks + 1) i32: count of each chunk
    near: Any  # (chunks * n_bodies) i32: colliders near each chunk's current collider
    sharp: Any  # (n_triangles) i32: edge bits, see `mark_sharp_edges`
    inside: Any  # (n_verts) i32: bit k % INSIDE_BITS is set if the vertex is in collider k and has contacts that move it out
    exit_direction: Any  # (n_verts) 3-vectors f64: summed exit displacements of those contacts [m]
    padding: Any  # (1) f64: half of the distance by which boxes are grown together, for queries [m]
    margin: Any  # (1) f64: distance within which contacts are found [m]

    @property
    def has_attached(self) -> bool:
        """Whether colliders are attached to each other."""
        return self.attached is not None


def build_surface(
    topology: Topology,
    rest: np.ndarray,
    properties: dict[str, np.ndarray],
    runtime: Runtime,
    arena: FieldArena,
    serial: bool | None = None,
) -> Surface:
    """Allocate and fill the fields.

    rest: (v,3) [m]; properties: soft, self_on, mode, thickness and edge, (n_bodies,) each; attached, (n_bodies, n_bodies)
    bool, if any are; padding and margin [m]. serial: None decides by size, and by what threads gain.
    """
    t, bodies, attached = topology, len(properties["soft"]), properties.get("attached")
    n, v = len(t.triangle), len(t.node)
    on_cpu = runtime.on_cpu
    if serial is None and on_cpu and n < SERIAL_BELOW:
        serial = True
    chunks, serial_cheap = 1 if serial else CPU_CHUNKS if on_cpu else gpu_threads(GPU_CHUNKS), serial
    if serial is None:
        serial, serial_cheap = (on_cpu and not parallel.pays(n * seconds) for seconds in (TRIANGLE_SECONDS, CHEAP_SECONDS))
    tables = {name: getattr(t, name) for name in ("triangle", "body", "node", "neighbour", "owns")}
    tables |= {name: getattr(t, name) for name in ("ring_start", "ring", "around_start", "around")}
    tables |= {name: properties[name] for name in ("soft", "self_on")}
    vectors = dict.fromkeys(("x", "move"), v) | dict.fromkeys(("lo", "hi", "normal"), n)
    vectors |= dict.fromkeys(("body_lo", "body_hi"), bodies)
    zeros = {"active": n, "active_of_chunk": n, "count": 4, "part": chunks + 1, "near": chunks * bodies, "sharp": n, "inside": v}
    zeros |= {"rests": bodies}
    run = arena.field("surface_run", ti.i32, 2, np.array([1, 0]))
    # triangles are rows, not vectors: the compiler confuses run-time and fixed component indices within one kernel
    fields = {name: integers(arena, f"surface_{name}", data) for name, data in tables.items()}
    fields |= {name: arena.vectors(f"surface_{name}", ti.f64, max(count, 1)) for name, count in vectors.items()}
    fields |= {name: arena.field(f"surface_{name}", ti.i32, max(count, 1)) for name, count in zeros.items()}
    for name in ("thickness", "edge"):
        fields[name] = arena.field(f"surface_{name}", ti.f64, max(bodies, 1), properties[name] if bodies else None)
    return Surface(
        n_triangles=n,
        n_verts=v,
        n_bodies=bodies,
        serial=serial,
        serial_cheap=serial_cheap,
        on_cpu=on_cpu,
        chunks=chunks,
        spread=spread_on(on_cpu, serial),
        cheap_spread=spread_on(on_cpu, serial_cheap),
        team=make_team(arena, "surface"),
        mode=integers(arena, "contact_mode", properties["mode"]),
        attached=integers(arena, "attached", attached.reshape(-1)) if attached is not None and attached.any() else None,
        rest=arena.vectors("surface_rest", ti.f64, max(v, 1), rest if v else None),
        **{name: arena.field(f"surface_{name}", ti.f64, 1, np.array([properties[name]])) for name in ("padding", "margin")},
        area=arena.field("surface_area", ti.f64, max(n, 1)),
        exit_direction=arena.vectors("surface_exit_direction", ti.f64, max(v, 1)),
        **fields,
        run=run,
    )


def integers(arena: FieldArena, name: str, data: np.ndarray):
    """Allocate and fill an i32 field, with one row of zeros for no data, since no field may be empty."""
    data = np.asarray(data)
    data = (data if len(data) else np.zeros((1, *data.shape[1:]))).astype(np.int32)
    return arena.field(name, ti.i32, data.shape, data)


@ti.func
def cell_of(x, inverse, size: ti.template()):
    """Cell (3,) i32 of a point in a periodic grid of `size` cells along each axis; inverse: of a cell's edge [1/m]."""
    cell = ivec(0)
    for q in ti.static(range(3)):
        n = ti.cast(size[q], ti.f64)
        k = ti.floor(x[q] * inverse)
        cell[q] = ti.cast(k - n * ti.floor(k / n), ti.i32)
    return cell


@ti.func
def may_touch(s: ti.template(), t, u):
    """Whether two triangles are a valid pair: of different colliders, one of them soft, that are not attached to each other; or
    of one body that is tested against itself, without a common vertex."""
    a, b = s.body[t], s.body[u]
    result = 0
    if a != b:
        result = s.soft[a] | s.soft[b]
        if ti.static(s.has_attached):
            result &= 1 - s.attached[a * s.n_bodies + b]
    elif s.self_on[a] == 1:
        shared = 0
        for k, m in ti.static(ti.ndrange(3, 3)):  # without branches, which nobody can predict
            shared |= int(s.triangle[t, k] == s.triangle[u, m])
        result = 1 - shared
    return result


# --- positions, boxes and active triangles -------------------------------------------------------------------


@ti.func
def _move_soft(
    s: ti.template(), x: ti.template(), v: ti.template(), has_prescribed: ti.template(), prescribed: ti.template(), dt
):
    """Set positions and displacements of the soft bodies: prescribed ones where given, else v dt. They stay as they are in a
    batch that has ended."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.run[GO] * s.n_verts):
        if s.node[i] >= 0:
            s.x[i] = x[s.node[i]]
            move = dt * ti.cast(v[s.node[i]], ti.f64)
            if ti.static(has_prescribed):
                for q in ti.static(range(3)):
                    if prescribed[i][q] == prescribed[i][q]:
                        move[q] = prescribed[i][q]
            s.move[i] = move


@ti.func
def _exponent(value):
    """Exponent bits of an f64. They tell whether it is finite; 0 times it would not on CUDA, see `backend.runtime`."""
    return ti.cast((ti.bit_cast(value, ti.i64) >> 52) & NOT_FINITE, ti.i32)


@ti.func
def box_triangles(s: ti.template(), margin):
    """Compute boxes, normals and areas of the triangles, and count the non-finite ones. Top-level loops of a kernel."""
    s.count[NONFINITE] = 0
    half = ti.cast(0.5, ti.f64) * margin
    ti.loop_config(serialize=s.serial_cheap)
    for t in range(s.n_triangles):
        i, j, k = s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2]
        a, b, c = s.x[i], s.x[j], s.x[k]
        a1, b1, c1 = a + s.move[i], b + s.move[j], c + s.move[k]
        n = (b - a).cross(c - a)
        length = n.norm()
        s.area[t] = length
        s.normal[t] = ti.select(length > 0.0, n / length, 0.0)
        total = a + b + c + a1 + b1 + c1  # not finite if any is not, or if some are beyond 1e307
        lo, hi = dvec(ti.math.inf), dvec(-ti.math.inf)
        if ti.max(_exponent(total[0]), _exponent(total[1]), _exponent(total[2])) < NOT_FINITE:
            lo = ti.min(a, b, c, a1, b1, c1) - half
            hi = ti.max(a, b, c, a1, b1, c1) + half
        else:
            ti.atomic_add(s.count[NONFINITE], 1)
        s.lo[t], s.hi[t] = lo, hi


@ti.func
def _box_bodies(surface: ti.template()):
    """Compute the boxes of the colliders, from those of each one's triangles in each chunk."""
    ti.loop_config(serialize=surface.serial_cheap)
    for b in range(surface.n_bodies):
        surface.body_lo[b], surface.body_hi[b] = dvec(ti.math.inf), dvec(-ti.math.inf)
    ti.loop_config(serialize=surface.serial_cheap)
    for task in range(surface.chunks * surface.cheap_spread):
        if task % surface.cheap_spread == 0:
            c, lo, hi = task // surface.cheap_spread, dvec(ti.math.inf), dvec(-ti.math.inf)
            last = part_first(c + 1, surface.n_triangles, surface.chunks) - 1
            for t in range(part_first(c, surface.n_triangles, surface.chunks), last + 1):
                b = surface.body[t]
                lo, hi = ti.min(lo, surface.lo[t]), ti.max(hi, surface.hi[t])
                if t == last or surface.body[ti.min(t + 1, last)] != b:
                    for axis in ti.static(range(3)):
                        ti.atomic_min(surface.body_lo[b][axis], lo[axis])
                        ti.atomic_max(surface.body_hi[b][axis], hi[axis])
                    lo, hi = dvec(ti.math.inf), dvec(-ti.math.inf)


@ti.func
def may_meet(s: ti.template(), a, b):
    """1 if colliders a and b may touch and their boxes overlap, or if a is b and is tested against itself; not if both rest."""
    accepted = 0
    if s.rests[a] & s.rests[b]:
        accepted = 0
    elif a == b:
        accepted = s.self_on[a]
    elif s.soft[a] | s.soft[b]:
        accepted = int((s.body_lo[a] <= s.body_hi[b]).all()) & int((s.body_lo[b] <= s.body_hi[a]).all())
    if ti.static(s.has_attached):
        accepted &= 1 - s.attached[a * s.n_bodies + b]
    return accepted


@ti.func
def list_near(s: ti.template(), c, own):
    """List, ascending from s.near[c * n_bodies], the colliders that collider `own` may meet, including itself if it is tested
    against itself. Return their number."""
    n = 0
    for b in range(s.n_bodies):
        if may_meet(s, own, b) == 1:
            s.near[c * s.n_bodies + n] = b
            n += 1
    return n


@ti.func
def sum_pairs(surface: ti.template()):
    """Sum the tested pairs of all parts. A top-level loop of a kernel."""
    (team,) = ti.static((surface.team,))
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        pairs = 0
        for j in range(team.share(t, surface.chunks)):
            pairs += surface.part[team.entry(t, j, surface.chunks)]
        _, total = team.count(t, pairs)
        if t == 0:
            surface.count[PAIRS] = total


@ti.func
def _can_have_partner(s: ti.template(), t, first, last):
    """1 if the box of a triangle overlaps that of a collider in s.near[first:last], its own included."""
    own, lo, hi = s.body[t], s.lo[t], s.hi[t]
    found = 0
    if (lo <= hi).all():
        k = first
        while found == 0 and k < last:
            b = s.near[k]
            if b == own:
                found = 1
            elif lo[0] <= s.body_hi[b][0] and s.body_lo[b][0] <= hi[0]:
                found = int((lo <= s.body_hi[b]).all()) & int((s.body_lo[b] <= hi).all())
            k += 1
    return found


@ti.func
def _list_active(surface: ti.template()):
    """List the triangles that can have a partner, in ascending order: in each chunk, then all together, which takes less time
    than to test them twice."""
    ti.loop_config(serialize=surface.serial_cheap)
    for task in range(surface.chunks * surface.cheap_spread):
        if task % surface.cheap_spread == 0:
            c = task // surface.cheap_spread
            first, n, n_near, own = part_first(c, surface.n_triangles, surface.chunks), 0, 0, -1
            for t in range(first, part_first(c + 1, surface.n_triangles, surface.chunks)):
                if surface.body[t] != own:
                    own = surface.body[t]
                    n_near = list_near(surface, c, own)
                if _can_have_partner(surface, t, c * surface.n_bodies, c * surface.n_bodies + n_near) == 1:
                    surface.active_of_chunk[first + n] = t
                    n += 1
            surface.part[c] = n
    ti.loop_config(serialize=surface.team.alone, block_dim=surface.team.threads)
    for t in range(surface.team.threads):
        total = surface.team.add_up(t, surface.part, surface.chunks)
        if t == 0:
            surface.part[surface.chunks] = surface.count[ACTIVE] = total
    ti.loop_config(serialize=surface.on_cpu)
    for c in range(surface.chunks):
        at, first = surface.part[c], part_first(c, surface.n_triangles, surface.chunks)
        for k in range(surface.part[c + 1] - at):
            surface.active[at + k] = surface.active_of_chunk[first + k]


@ti.func
def move_surface(
    s: ti.template(), x: ti.template(), v: ti.template(), has_prescribed: ti.template(), prescribed: ti.template(), dt, margin
):
    """See `update_surface`. Top-level loops of a kernel."""
    _move_soft(s, x, v, has_prescribed, prescribed, dt)
    box_triangles(s, margin)


@kernel
def update_surface(
    s: ti.template(),
    x: ti.template(),
    v: ti.template(),
    has_prescribed: ti.template(),
    prescribed: ti.template(),
    dt: ti.f64,
    margin: ti.f64,
    active: ti.template(),
):
    """Set the soft bodies' positions x (n_nodes) [m] and displacements in a step of dt [s] from the model, and update the boxes.

    prescribed: (n_verts) 3-vectors, displacements [m], nan where free, read if has_prescribed. active: whether to list the
    active triangles too.
    """
    move_surface(s, x, v, has_prescribed, prescribed, dt, margin)
    if ti.static(active):
        _box_bodies(s)
        _list_active(s)
