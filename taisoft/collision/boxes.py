"""Bounding boxes of the surface's triangles and colliders, and the list of active triangles, which can have a partner.

A triangle's box bounds it at the start and at the end of the step and is grown by half the margin, so that two triangles whose
distance falls below the margin have overlapping boxes. A triangle with a non-finite coordinate has an empty box, which overlaps
nothing.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.surface import ACTIVE, NONFINITE, PAIRS, dvec, part_first


@kernel
def move_obstacles(s: ti.template(), first: ti.i32, x: ti.types.ndarray(), move: ti.types.ndarray()):
    """Set positions x and displacements move, (n,3) f64 [m], of an obstacle's vertices, from vertex `first` on."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(x.shape[0]):
        for q in ti.static(range(3)):
            s.x[first + i][q] = x[i, q]
            s.move[first + i][q] = move[i, q]


@kernel
def take_prescribed(s: ti.template(), prescribed: ti.template(), move: ti.types.ndarray()):
    """Store the prescribed displacements of vertices in the step: move (n_verts,3) f64 [m], nan where free."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        for q in ti.static(range(3)):
            prescribed[i][q] = move[i, q]


@ti.func
def _move_soft(
    s: ti.template(), x: ti.template(), v: ti.template(), has_prescribed: ti.template(), prescribed: ti.template(), dt
):
    """Set positions and displacements of the soft bodies: prescribed ones where given, else v dt."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        if s.node[i] >= 0:
            s.x[i] = x[s.node[i]]
            move = dt * ti.cast(v[s.node[i]], ti.f64)
            if ti.static(has_prescribed):
                for q in ti.static(range(3)):
                    if prescribed[i][q] == prescribed[i][q]:
                        move[q] = prescribed[i][q]
            s.move[i] = move


@ti.func
def _box_triangles(s: ti.template(), margin):
    """Compute boxes, normals and areas of the triangles, and count the non-finite ones."""
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
        finite = 1
        for q in ti.static(range(3)):  # 0 times a non-finite number is nan
            zero = 0.0 * a[q] + 0.0 * b[q] + 0.0 * c[q] + 0.0 * a1[q] + 0.0 * b1[q] + 0.0 * c1[q]
            if not zero == 0.0:
                finite = 0
        lo, hi = dvec(ti.math.inf), dvec(-ti.math.inf)
        if finite == 1:
            lo = ti.min(a, b, c, a1, b1, c1) - half
            hi = ti.max(a, b, c, a1, b1, c1) + half
        else:
            ti.atomic_add(s.count[NONFINITE], 1)
        s.lo[t], s.hi[t] = lo, hi


@ti.func
def _box_bodies(s: ti.template()):
    """Compute the boxes of the colliders."""
    ti.loop_config(serialize=s.serial_cheap)
    for task in range(s.n_bodies * s.cheap_spread):
        if task % s.cheap_spread == 0:
            b = task // s.cheap_spread
            lo, hi = dvec(ti.math.inf), dvec(-ti.math.inf)
            for t in range(s.first_of[b], s.first_of[b + 1]):
                lo, hi = ti.min(lo, s.lo[t]), ti.max(hi, s.hi[t])
            s.body_lo[b], s.body_hi[b] = lo, hi


@ti.func
def list_near(s: ti.template(), c, own):
    """List, ascending from s.near[c * n_bodies], the colliders that collider `own` may touch and whose boxes overlap its own,
    including itself if it is tested against itself. Return their number."""
    n = 0
    for b in range(s.n_bodies):
        accepted = 0
        if b == own:
            accepted = s.self_on[own]
        elif s.soft[own] | s.soft[b]:
            accepted = int((s.body_lo[own] <= s.body_hi[b]).all()) & int((s.body_lo[b] <= s.body_hi[own]).all())
        if accepted == 1:
            s.near[c * s.n_bodies + n] = b
            n += 1
    return n


@ti.func
def sum_pairs(s: ti.template(), append):
    """Sum the tested pairs of all parts; if `append` is 1, add them to the previous sum."""
    total = append * s.count[PAIRS]
    for c in range(s.chunks):
        total += s.part[c]
    s.count[PAIRS] = total


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
def _list_active(s: ti.template()):
    """List the triangles that can have a partner, in ascending order."""
    ti.loop_config(serialize=s.serial_cheap)
    for task in range(s.chunks * s.cheap_spread):
        if task % s.cheap_spread == 0:
            c = task // s.cheap_spread
            first, near = part_first(c, s.n_triangles, s.chunks), c * s.n_bodies
            n, n_near, own = 0, 0, -1
            for t in range(first, part_first(c + 1, s.n_triangles, s.chunks)):
                if s.body[t] != own:
                    own = s.body[t]
                    n_near = list_near(s, c, own)
                if _can_have_partner(s, t, near, near + n_near) == 1:
                    s.active[first + n] = t
                    n += 1
            s.part[c] = n
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for k in range(s.chunks):
            base = part_first(k, s.n_triangles, s.chunks)
            for j in range(s.part[k]):  # entries move left only, so none is overwritten before it is read
                s.active[total + j] = s.active[base + j]
            total += s.part[k]
        s.count[ACTIVE] = total


@kernel
def update_boxes(s: ti.template(), margin: ti.f64):
    """Update the boxes of triangles and colliders from x and move, the normals, and the active triangles."""
    _box_triangles(s, margin)
    _box_bodies(s)
    _list_active(s)


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
    prescribed: of `take_prescribed`, read if has_prescribed; active: whether to list the active triangles too."""
    _move_soft(s, x, v, has_prescribed, prescribed, dt)
    _box_triangles(s, margin)
    if ti.static(active):
        _box_bodies(s)
        _list_active(s)
