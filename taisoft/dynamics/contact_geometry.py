"""Geometry of the contacts at Newton's iterate: the laws of an implicit step hold at its end, so their normals are those there.

At an iterate x_k the contacts there, found by a search with the obstacles at the end of the step, replace those known so far
(*renewal*). With the gap g_k and normal n_k found, the constraint is
    g_k + n_k.J (x - x_k) >= target.
As for contacts of the step's start, `gap` is what this says about the start, the *height* g_k - n_k.(J (x_k - x_start) - motion
of the obstacle). Slip is still measured from x_start, on the plane of n_k.

A contact is the one known so far if its features are the same; it inherits target and impulse. A new one that touches takes the
target of the nearest of its pair. Contacts that are found no more go if they push; their impulse goes to the nearest new one of
the pair with nearly the same normal. Those that do not push stay, as guards. These stay as they are:

* passages, and where a distance field is deepest in a triangle;
* all contacts of a pair that is deeper than half the margin at x_k, or of two bodies that close by more than half an edge in the
  step: such an iterate is not trusted.

The deepest point of a triangle in an analytic shape stays the same material point, with new gap and normal: a deepest point that
follows the iterate would cycle. A new one counts only if it violates the offset. A contact is not accepted if its sides were
behind each other at the start, along its new normal.

Nothing is replaced where nothing would change: no normal of a contact that pushes turns by more than TURNED, no gap changes by
more than MISSED of the contact offset, and no new contact violates its target.
"""

import taichi as ti

from taisoft.backend.lists import add_up_counts, clear_counts, count_entries
from taisoft.backend.runtime import kernel
from taisoft.collision.analytic import HALF_SPACE, rotation_rows
from taisoft.collision.contacts import EDGE_EDGE, FACE_FACE, FACE_FIELD, MORTAR, VERTEX_FACE
from taisoft.collision.features import closest_lines
from taisoft.collision.overlay import BEHIND
from taisoft.collision.surface import dvec
from taisoft.contact.build import fill_row, room_of
from taisoft.contact.past import enter_past, pair_slot, past_of
from taisoft.contact.problem import to_frame
from taisoft.contact.prox import prox, tangent
from taisoft.contact.targets import contact_offset_of, offset_between

TURNED, MISSED = 1e-3, 0.02  # [rad]; of the contact offset: smaller changes of a contact do not count
SHIFTED = 0.05  # of the finer side's edge: a smaller slip does not change where a contact acts on another body
STILL = 0.2  # of the contact offset: where all contacts have moved less, normals turn by less than TURNED on the way over an edge
TRUSTED_DEPTH, TRUSTED_CLOSING = 0.5, 0.5  # of the margin; of the finer side's edge
DEEPEST = 0.1  # of the contact offset: gap below which a new deepest point counts
SAME_NORMAL = 0.9  # cosine between normals of a contact and its heir
REPLACED, GONE, OPEN, KEPT, IN_PLACE = range(5)  # fates of present contacts; those from KEPT on stay
REJECTED, NEW = -2, -1  # of contacts found that replace none; those from NEW on become present ones


@ti.func
def _slip(v, n):
    """Length of the part of v across n."""
    return (v - v.dot(n) * n).norm()


@ti.func
def _finer_edge(s: ti.template(), body):
    return ti.min(s.edge[body[0]], s.edge[body[1]])


@ti.func
def _motion(p: ti.template(), c, displacement: ti.template()):
    """Displacement (3,) of side a of present contact c relative to side b, since the step's start [m]."""
    d = -p.obstacle_displacement[c]
    for e in range(p.first[c], p.first[c] + p.arity[c]):
        d += p.weight[e] * displacement[p.node[e]]
    return d


@ti.func
def _shape(o: ti.template(), body):
    """Row of the analytic obstacle that is collider `body`, -1 if it is none."""
    row = -1
    for k in range(o.count):
        if o.body[k] == body:
            row = k
    return row


@ti.func
def _shape_motion(o: ti.template(), k, x):
    """Displacement (3,) in the step of the point of analytic obstacle k that is at x (3,) at the step's end [m]."""
    local = rotation_rows(o.next_rotation, k).transpose() @ (x - o.next_origin[k])
    return x - rotation_rows(o.rotation, k) @ local - o.origin[k]


@ti.func
def _gap_to_shape(p: ti.template(), o: ti.template(), c, k, x_start: ti.template(), displacement: ti.template()):
    """Gap [m] and normal (3,) at the step's end of the material point of contact c to analytic obstacle k; that point (3,)."""
    x = dvec(0.0)
    for e in range(p.first[c], p.first[c] + p.arity[c]):
        i = p.node[e]
        x += p.weight[e] * (x_start[i] + displacement[i])
    R = rotation_rows(o.next_rotation, k)
    gap, g = o.sample(k, R.transpose() @ (x - o.next_origin[k]))
    return gap, R @ g, x


@ti.func
def _found_motion(s: ti.template(), end: ti.template(), o: ti.template(), found: ti.template(), row):
    """Displacement (3,) of side a of a contact found at the end relative to side b, since the step's start [m]."""
    d = dvec(0.0)
    for j in ti.static(range(3)):
        a, b = found.nodes_a[row][j], found.nodes_b[row][j]
        if a >= 0:
            d += found.weights_a[row][j] * (end.x[a] - s.x[a])
        if b >= 0:
            d -= found.weights_b[row][j] * (end.x[b] - s.x[b])
    if ti.static(o.any):
        if found.nodes_b[row][0] < 0:
            k = _shape(o, found.body[row][1])
            d -= _shape_motion(o, k, found.point[row] - 0.5 * found.gap[row] * found.normal[row])
    if found.is_mortar(row):
        d += found.moved(row, end.x) - found.moved(row, s.x) - found.carried[row]
    return d


@ti.func
def _still_cross(p: ti.template(), s: ti.template(), end: ti.template(), c):
    """Whether the two edges of contact c still cross at the end, with nearly its normal."""
    e, f = p.feature[c][1], p.feature[c][2]
    a0, a1 = end.x[s.triangle[e // 3, e % 3]], end.x[s.triangle[e // 3, (e % 3 + 1) % 3]]
    b0, b1 = end.x[s.triangle[f // 3, f % 3]], end.x[s.triangle[f // 3, (f % 3 + 1) % 3]]
    q, r, _ = closest_lines(a0, a1, b0, b1)
    n = (a1 - a0).cross(b1 - b0)
    cosine = n.dot(p.normal[c]) / ti.max(n.norm(), 1e-300)
    is_inner = ti.min(q, r) > 0.0 and ti.max(q, r) < 1.0
    return is_inner and ti.abs(cosine) > ti.cast(SAME_NORMAL, ti.f64)


@ti.func
def _differs(n, gap, new_n, new_gap, offset):
    """1 if a contact's normal or gap has changed."""
    turned = (new_n - n).norm() > ti.cast(TURNED, ti.f64)
    return int(turned or ti.abs(new_gap - gap) > ti.cast(MISSED, ti.f64) * offset)


@ti.func
def _is_alike(kind, other):
    """Whether both of two kinds of contacts are means over areas, or neither."""
    return (kind == MORTAR) == (other == MORTAR)


@ti.func
def _nearest_present(p: ti.template(), kind, body, point):
    """The present contact of a pair of colliders, of a like kind, that is nearest to a point (3,), -1 if there is none."""
    best, smallest = -1, ti.cast(ti.math.inf, ti.f64)
    for c in range(p.count[0]):
        if _is_alike(kind, p.feature[c][0]) and (p.body[c] == body).all():
            d = p.point[c] - point
            if d.dot(d) < smallest:
                best, smallest = c, d.dot(d)
    return best


@ti.func
def _heir(p: ti.template(), found: ti.template(), kept: ti.template(), n, c):
    """The accepted contact found of the pair of present contact c that is nearest to it, of a like kind and with nearly its
    normal, -1 for none; and whether one is of the same vertex."""
    best, smallest, same = -1, ti.cast(ti.math.inf, ti.f64), False
    for b in range(n):
        row = kept[b]
        if p.renewal.match[b] != REJECTED and (found.body[row] == p.body[c]).all():
            if found.feature[row][0] == VERTEX_FACE and p.feature[c][0] == VERTEX_FACE:
                same = same or found.feature[row][1] == p.feature[c][1]
            is_alike = _is_alike(found.feature[row][0], p.feature[c][0])
            if is_alike and found.normal[row].dot(p.normal[c]) > ti.cast(SAME_NORMAL, ti.f64):
                d = found.point[row] - p.point[c]
                if d.dot(d) < smallest:
                    best, smallest = b, d.dot(d)
    return best, same


@ti.func
def _keep_untrusted(
    p: ti.template(), s: ti.template(), displacement: ti.template(), found: ti.template(), kept: ti.template(), n, dt, margin
):
    """Mark the pairs whose contacts stay as they are. Top-level loops of a kernel."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.renewal.is_kept[c], p.renewal.heir[c] = 0, -1
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        if p.body[c][0] != p.body[c][1]:  # all contacts of a body with itself are one pair
            closing = -ti.min(p.normal[c].dot(_motion(p, c, displacement)), dt * p.approach[c])
            if closing > ti.cast(TRUSTED_CLOSING, ti.f64) * _finer_edge(s, p.body[c]):
                p.renewal.is_kept[p.past.pair[c]] = 1
    ti.loop_config(serialize=p.serial)
    for b in range(n):
        if found.gap[kept[b]] < -ti.cast(TRUSTED_DEPTH, ti.f64) * margin:
            first = p.past.pair_slot[pair_slot(p, found.body[kept[b]])]
            if first >= 0:
                p.renewal.is_kept[first] = 1


@ti.func
def _judge_present(
    p: ti.template(), o: ti.template(), c, x_start: ti.template(), displacement: ti.template(), common_offset, margin
):
    """Set the fate of present contact c, as far as that does not depend on those found. Return 1 if its geometry changes."""
    fate, changed, kind = OPEN, 0, p.feature[c][0]
    if kind == FACE_FACE or p.renewal.is_kept[p.past.pair[c]] == 1:
        fate = KEPT
    elif kind == FACE_FIELD:
        fate = KEPT
        if ti.static(o.any):
            k = _shape(o, p.body[c][1])
            if k >= 0:
                gap, n, _ = _gap_to_shape(p, o, c, k, x_start, displacement)
                if gap > -ti.cast(TRUSTED_DEPTH, ti.f64) * margin:
                    fate = IN_PLACE
                    motion, offset = _motion(p, c, displacement), contact_offset_of(p, c, common_offset)
                    if p.r[c][0] > 0.0 or gap < p.target[c]:
                        changed = _differs(p.normal[c], p.gap[c] + p.normal[c].dot(motion), n, gap, offset)
    p.renewal.fate[c] = fate
    return changed


@ti.func
def _match_found(p: ti.template(), found: ti.template(), row, b, n, margin):
    """Set `match` of contact b of n found, in a row of the buffer, to the present one with its features, unless it is not
    trusted; claim that one, which the first claim gets: `fate` becomes b - n."""
    j, first = past_of(p, found.feature[row], found.point[row]), p.past.pair_slot[pair_slot(p, found.body[row])]
    is_kept = found.gap[row] < -ti.cast(TRUSTED_DEPTH, ti.f64) * margin
    if first >= 0:
        is_kept = is_kept or p.renewal.is_kept[first] == 1
    if j >= 0 and not is_kept and found.feature[row][0] != FACE_FIELD:
        ti.atomic_min(p.renewal.fate[j], b - n)
    p.renewal.match[b] = ti.select(is_kept, REJECTED, j)


@ti.func
def _judge_found(
    p: ti.template(),
    s: ti.template(),
    end: ti.template(),
    o: ti.template(),
    displacement: ti.template(),
    found: ti.template(),
    row,
    b,
    n_found,
    common_offset,
    floor,
):
    """Judge contact b of n_found, in a row of the buffer, after `_match_found`; set its height and target. Return 1 if it changes
    the geometry."""
    n, gap, body, changed = found.normal[row], found.gap[row], found.body[row], 0
    motion = _found_motion(s, end, o, found, row)
    height, offset = gap - n.dot(motion), offset_between(body, found.guard[row], common_offset)
    j = p.renewal.match[b]
    match = j
    lowest = -ti.cast(BEHIND, ti.f64) * _slip(motion, n) - floor
    nearest = j
    if j == NEW and (height < lowest or gap < offset):
        nearest = _nearest_present(p, found.feature[row][0], body, found.point[row])
        if nearest >= 0:  # what is behind each other there may be so here
            lowest += ti.min(p.gap[nearest], 0.0)
    if j == REJECTED or (j < 0 and height < lowest):
        match = REJECTED
    elif found.feature[row][0] == FACE_FIELD:
        match = ti.select(gap < ti.cast(DEEPEST, ti.f64) * offset, NEW, REJECTED)
    elif j >= 0:
        if p.renewal.fate[j] != b - n_found:
            match = NEW
        else:
            p.renewal.target[b] = ti.min(p.target[j], offset)
            old = _motion(p, j, displacement)
            known = p.gap[j] + p.normal[j].dot(old)
            counts = p.r[j][0] > 0.0 or gap < p.target[j]
            if ti.static(found.has_mortar):  # a guard's target is so low that the gap found seldom violates it
                counts = counts or known < p.target[j]
            if counts:
                changed = _differs(p.normal[j], known, n, gap, offset)
                wall = found.nodes_b[row][0]
                if wall >= 0 and s.node[ti.max(wall, 0)] >= 0:
                    changed |= int(_slip(old, n) > ti.cast(SHIFTED, ti.f64) * _finer_edge(s, body))
    if match == NEW:
        target = offset
        if gap < offset and nearest >= 0:
            target = ti.min(p.target[nearest], offset)
        p.renewal.target[b] = target
        changed = int(gap < target - ti.cast(MISSED, ti.f64) * offset)
    p.renewal.match[b], p.renewal.height[b], p.renewal.inherited[b] = match, height, dvec(0.0)
    return changed


@kernel(cse=False)
def judge(
    p: ti.template(),
    s: ti.template(),
    end: ti.template(),
    o: ti.template(),
    x_start: ti.template(),
    displacement: ti.template(),
    found: ti.template(),
    kept: ti.template(),
    n: ti.i32,
    dt: ti.f64,
    common_offset: ti.f64,
    margin: ti.f64,
    floor: ti.f64,
) -> ti.i32:
    """Compare the present contacts with the n found at the iterate; return 1 if `adopt` would change the geometry.

    s, end: surfaces at the step's start and at its end; o: analytic obstacles; x_start, displacement: (n_nodes) 3-vectors [m];
    found, kept: buffer and the n rows in it; common_offset, margin, floor [m].
    """
    enter_past(p, 1)
    changed = 0
    _keep_untrusted(p, s, displacement, found, kept, n, dt, margin)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        changed |= _judge_present(p, o, c, x_start, displacement, common_offset, margin)
    ti.loop_config(serialize=p.serial)
    for b in range(n):
        _match_found(p, found, kept[b], b, n, margin)
    ti.loop_config(serialize=p.serial)
    for b in range(n):
        changed |= _judge_found(p, s, end, o, displacement, found, kept[b], b, n, common_offset, floor)
        p.renewal.giver[b] = p.count[0]
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        if p.renewal.fate[c] < 0:
            p.renewal.fate[c] = REPLACED
        elif p.renewal.fate[c] == OPEN:
            b, same = _heir(p, found, kept, n, c)
            pushes = p.r[c][0] > 0.0
            is_gone = same or pushes
            if pushes and p.feature[c][0] == EDGE_EDGE:
                is_gone = not _still_cross(p, s, end, c)
            p.renewal.fate[c] = ti.select(is_gone, GONE, KEPT)
            if is_gone and pushes:
                changed |= 1
                if b >= 0:
                    if ti.static(p.on_cpu):
                        p.renewal.inherited[b] = p.renewal.inherited[b] + p.past.impulse[c]
                    else:
                        p.renewal.heir[c] = b
                        ti.atomic_min(p.renewal.giver[b], c)
    if ti.static(not p.on_cpu):  # in the same order
        for b in range(n):
            for c in range(p.renewal.giver[b], p.count[0]):
                if p.renewal.heir[c] == b:
                    p.renewal.inherited[b] = p.renewal.inherited[b] + p.past.impulse[c]
    return changed


@ti.func
def _move(p: ti.template(), t, field: ti.template(), left):
    """Move the values of a field of the contacts that stay to the first `left` places. For thread t of a team."""
    for j in range(p.team.rounds(left)):
        to = ti.min(t + j * p.team.threads, left - 1)
        value = field[p.renewal.source[to]]
        p.team.sync()
        field[to] = value


@ti.func
def _renew_in_place(p: ti.template(), o: ti.template(), c, x_start: ti.template(), displacement: ti.template(), impulse):
    """Set gap and normal of contact c with an analytic obstacle to those of its material point at the end."""
    k = _shape(o, p.body[c][1])
    gap, n, x = _gap_to_shape(p, o, c, k, x_start, displacement)
    moved, own = _shape_motion(o, k, x - gap * n), dvec(0.0)
    for e in range(p.first[c], p.first[c] + p.arity[c]):
        own += p.weight[e] * displacement[p.node[e]]
    p.normal[c], p.tangent[c], p.gap[c] = n, tangent(n), gap - n.dot(own - moved)
    p.obstacle_displacement[c], p.point[c] = moved, x - 0.5 * gap * n
    p.r[c] = prox(to_frame(p, c, impulse), p.friction[c])


@kernel(cse=False)
def adopt(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    q: ti.template(),
    x_start: ti.template(),
    displacement: ti.template(),
    found: ti.template(),
    kept: ti.template(),
    n: ti.i32,
):
    """Replace the contacts as `judge` has decided, with its arguments; m: Model; q: PairNumbers. They must fit."""
    vectors = ti.static((p.normal, p.tangent, p.point, p.obstacle_displacement, p.impact_impulse, p.r, p.body, p.feature))
    numbers = ti.static(
        (p.gap, p.target, p.approach, p.load, p.area, p.guard, p.status, p.friction, p.restitution, p.min_opening)
    )
    n_left = 0
    clear_counts(p.room, n)
    ti.loop_config(serialize=p.serial)
    for b in range(n):
        count_entries(p.room, b, room_of(m, found, kept[b]))
    add_up_counts(p.room, n)
    ti.loop_config(serialize=p.team.alone, block_dim=p.team.threads)
    for t in range(p.team.threads):
        left = p.team.list_from(t, p.renewal.fate, KEPT, p.count[0], p.renewal.source, 0)
        if left < p.count[0]:
            for fields in ti.static((vectors, numbers, (p.first, p.arity, p.arity_a))):
                for field in ti.static(fields):
                    _move(p, t, field, left)
        end = p.team.list_from(t, p.renewal.match, NEW, n, p.renewal.source, left)
        if t == 0:
            p.count[0] = end
            n_left += left
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        if c < n_left:
            p.sweep.order[c] = c
            for e in range(p.first[c], p.first[c] + p.arity[c]):
                p.contact[e] = c
            if ti.static(o.any):
                if p.renewal.fate[p.renewal.source[c]] == IN_PLACE:
                    _renew_in_place(p, o, c, x_start, displacement, p.past.impulse[p.renewal.source[c]])
        else:
            b = p.renewal.source[c]
            fill_row(p, m, s, q, c, p.count[2] + p.room.start[b + 1], found, kept[b])
            if ti.static(o.any):
                if found.nodes_b[kept[b]][0] < 0:
                    x = p.point[c] - 0.5 * p.gap[c] * p.normal[c]
                    p.obstacle_displacement[c] = _shape_motion(o, _shape(o, p.body[c][1]), x)
            p.gap[c], p.target[c], p.approach[c], p.load[c] = p.renewal.height[b], p.renewal.target[b], 0.0, 0.0
            impulse = p.renewal.inherited[b]
            if p.renewal.match[b] >= 0:
                impulse += p.past.impulse[p.renewal.match[b]]
            p.r[c] = prox(to_frame(p, c, impulse), p.friction[c])
    p.count[2] += p.room.start[n + 1]


@ti.func
def _is_flat(o: ti.template(), body):
    """Whether a collider is a half-space that does not turn in the step: the geometry of its contacts never changes."""
    result = False
    if ti.static(HALF_SPACE in o.kinds):
        k = _shape(o, body)
        if k >= 0:
            turns = (rotation_rows(o.next_rotation, k) - rotation_rows(o.rotation, k)).norm()
            result = o.kind[k] == HALF_SPACE and turns == 0.0
    return result


@kernel
def largest_motion(
    p: ti.template(), o: ti.template(), displacement: ti.template(), seen: ti.template(), n_looks: ti.i32
) -> ti.f64:
    """Return the largest displacement of two sides of a contact relative to each other [m], since the step's start or, after
    n_looks, since the displacements (n_nodes) `seen`; contacts whose geometry never changes left out."""
    result = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=p.team.alone, block_dim=p.team.threads)
    for t in range(p.team.threads):
        largest = ti.cast(0.0, ti.f64)
        for j in range(p.team.share(t, p.count[0])):
            c = p.team.entry(t, j, p.count[0])
            if not _is_flat(o, p.body[c][1]):
                motion = _motion(p, c, displacement)
                if n_looks > 0:
                    motion += p.obstacle_displacement[c]
                    for e in range(p.first[c], p.first[c] + p.arity[c]):
                        motion -= p.weight[e] * seen[p.node[e]]
                largest = ti.max(largest, motion.norm())
        largest = p.team.largest(t, largest)
        if t == 0:
            result += largest
    return result
