"""Build the contact problem from detected contacts: frames, weights, friction and restitution, warm start.

Targets are in `targets`, what is known of the contacts of the previous step in `past`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.lists import add_up_counts, clear_counts, count_entries, keys_if
from taisoft.backend.runtime import kernel
from taisoft.contact.past import keep_impulses, load_of, warm_impulse
from taisoft.contact.problem import NODES, fill_field, list_entries, to_frame
from taisoft.contact.prox import OPEN, SLIP, dvec, prox, scaled, state_of, tangent
from taisoft.contact.targets import STILL, contact_offset_of
from taisoft.fem.model import Model
from taisoft.fem.state import GO
from taisoft.scene.scene import Scene

NEGLIGIBLE = 1e-12  # a node with a smaller weight is left out of the contact
VANISHING = 1e-9  # a contact with smaller weights alone is rounding: its sides move as one


@dataclass(frozen=True, eq=False)
class PairNumbers:
    """Friction and restitution of each collider and of pairs with their own values (-1: not set)."""

    friction: Any  # (n_colliders) f64
    restitution: Any  # (n_colliders) f64
    n_pairs: Any  # (1) i32
    pair: Any  # (capacity) 2-vectors i32, the lower collider first
    pair_friction: Any
    pair_restitution: Any


def build_pair_numbers(arena: FieldArena, scene: Scene) -> PairNumbers:
    """Upload the scene's coefficients, with room for pairs that are set later."""
    n, capacity = len(scene.colliders), 2 * len(scene.contact_pairs) + 64
    numbers = PairNumbers(
        arena.field("collider_friction", ti.f64, n),
        arena.field("collider_restitution", ti.f64, n),
        arena.field("n_contact_pairs", ti.i32, 1),
        arena.vectors("contact_pair", ti.i32, capacity, n=2),
        arena.field("pair_friction", ti.f64, capacity),
        arena.field("pair_restitution", ti.f64, capacity),
    )
    upload_pair_numbers(numbers, scene)
    return numbers


def upload_pair_numbers(numbers: PairNumbers, scene: Scene) -> bool:
    """Upload the scene's current friction and restitution. Return False if its pairs exceed the capacity."""
    if len(scene.contact_pairs) > numbers.pair.shape[0]:
        return False
    index = {c.name: k for k, c in enumerate(scene.colliders)}
    surfaces = [scene.surface_of(name) for name in index]
    pairs = [(min(ids), max(ids)) for ids in ([index[name] for name in names] for names in scene.contact_pairs)]
    values = [[-1.0 if value is None else value for value in pair] for pair in scene.contact_pairs.values()]
    values = np.array(values, dtype=float).reshape(-1, 2)
    fill_field(numbers.friction, np.array([s.friction for s in surfaces]))
    fill_field(numbers.restitution, np.array([s.restitution for s in surfaces]))
    fill_field(numbers.n_pairs, np.array([len(pairs)]))
    fill_field(numbers.pair, np.array(pairs).reshape(-1, 2))
    fill_field(numbers.pair_friction, values[:, 0])
    fill_field(numbers.pair_restitution, values[:, 1])
    return True


@ti.func
def _pair_coefficients(q: ti.template(), a, b):
    """(friction, restitution) between colliders a < b, as in `Scene.contact_numbers`."""
    friction = ti.sqrt(q.friction[a] * q.friction[b])
    restitution = ti.max(q.restitution[a], q.restitution[b])
    for k in range(q.n_pairs[0]):
        if q.pair[k][0] == a and q.pair[k][1] == b:
            if q.pair_friction[k] >= 0.0:
                friction = q.pair_friction[k]
            if q.pair_restitution[k] >= 0.0:
                restitution = q.pair_restitution[k]
    return friction, restitution


@ti.func
def obstacle_displacement_at(o: ti.template(), body, x):
    """Displacement in the step of the point x of analytic obstacle `body`; 0 for any other collider."""
    displacement = dvec(0.0)
    for k in range(o.count):
        if o.body[k] == body:
            R = ti.Matrix.rows([o.rotation[3 * k], o.rotation[3 * k + 1], o.rotation[3 * k + 2]])
            S = ti.Matrix.rows([o.next_rotation[3 * k], o.next_rotation[3 * k + 1], o.next_rotation[3 * k + 2]])
            displacement = S @ (R.transpose() @ (x - o.origin[k])) + o.next_origin[k] - x
    return displacement


@ti.func
def _add_node(p: ti.template(), c, n, node, weight):
    """Add a weight to a node of contact c, which has n nodes, or to a new one. Return their new number."""
    at, first = p.first[c] + n, p.first[c]
    for j in range(first, first + n):
        if p.node[j] == node:
            at = j
    if at == first + n:
        p.node[at], p.weight[at], p.contact[at] = node, 0.0, c
    p.weight[at] += weight
    return ti.max(n, at - first + 1)


@ti.func
def _add_masters(p: ti.template(), m: ti.template(), c, n_before, i, weight):
    """Add node i to contact c, or the nodes that it depends on; nodes that the contact has already get the sum of weights. Return
    the contact's new number of nodes."""
    n, k = n_before, m.dependents.number[i]
    first, last = 0, 1
    if k >= 0:
        first, last = m.dependents.start[k], m.dependents.start[k + 1]
    for e in range(first, last):
        node, part = i, weight
        if k >= 0:
            node, part = m.dependents.master[e], weight * m.dependents.weight[e]
        n = _add_node(p, c, n, node, part)
    return n


@ti.func
def _add_vertex(p: ti.template(), m: ti.template(), s: ti.template(), c, k, v, weight, sign):
    """Add vertex v of the surface to contact c, which has k nodes. Return its new number of nodes."""
    n = k
    if v >= 0:
        if ti.abs(weight) > NEGLIGIBLE:
            if s.node[v] < 0:  # obstacle vertex
                p.obstacle_displacement[c] = p.obstacle_displacement[c] + weight * s.move[v]
            elif ti.static(m.has_dependents):
                n = _add_masters(p, m, c, n, s.node[v], sign * weight)
            else:
                at = p.first[c] + k
                p.node[at], p.weight[at], p.contact[at] = s.node[v], sign * weight, c
                n = k + 1
    return n


@ti.func
def relative_velocity(p: ti.template(), m: ti.template(), c, dt):
    """Velocity of side a relative to side b at contact c, at the present v [m/s]."""
    v = -p.obstacle_displacement[c] / dt
    for e in range(p.first[c], p.first[c] + p.arity[c]):
        v += p.weight[e] * m.state.v[p.node[e]]
    return v


@kernel
def drop_vanishing(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    found: ti.template(),
    kept: ti.template(),
    n: ti.i32,
    slot: ti.i32,
    first: ti.i32,
) -> ti.i32:
    """Leave out of kept[:n] the contacts whose weights cancel, since both sides depend on the same nodes.

    The rows of n contacts from `slot` on, with entries from `first` on, are overwritten, and `renewal`. Returns the number of
    contacts left.
    """
    clear_counts(p.room, n)
    ti.loop_config(serialize=p.serial)
    for c in range(n):
        count_entries(p.room, c, room_of(m, found, kept[c]))
    add_up_counts(p.room, n)
    ti.loop_config(serialize=p.serial)
    for c in range(n):
        own, largest = slot + c, ti.cast(0.0, ti.f64)
        _add_sides(p, m, s, own, first + p.room.start[c + 1], found, kept[c])
        for e in range(p.first[own], p.first[own] + p.arity[own]):
            largest = ti.max(largest, ti.abs(p.weight[e]))
        p.renewal.match[c] = int(p.arity[own] == 0 or largest > VANISHING)
    n_left = 0
    ti.loop_config(serialize=p.team.alone, block_dim=p.team.threads)
    for t in range(p.team.threads):
        left = 0
        for j in range(p.team.rounds(n)):
            c, row, stays = t + j * p.team.threads, 0, 0
            if c < n:
                row, stays = kept[c], p.renewal.match[c]
            before, staying = p.team.count(t, stays)
            if stays == 1:
                kept[left + before] = row
            left += staying
        if t == 0:
            n_left += left
    return n_left


@ti.func
def _add_sides(p: ti.template(), m: ti.template(), s: ti.template(), c, first, found: ti.template(), row):
    """Set the entries of contact c, from entry `first` on, to the nodes of both sides of a detected contact."""
    k = 0
    p.first[c] = first
    for j in ti.static(range(3)):
        k = _add_vertex(p, m, s, c, k, found.nodes_a[row][j], found.weights_a[row][j], 1.0)
    p.arity_a[c] = k
    for j in ti.static(range(3)):
        k = _add_vertex(p, m, s, c, k, found.nodes_b[row][j], found.weights_b[row][j], -1.0)
    if ti.static(found.has_mortar):
        if found.is_mortar(row):
            begin, n_a = found.entries[row][0], found.entries[row][1]
            for e in range(begin, begin + found.entries[row][2]):
                weight = ti.select(e - begin < n_a, found.weight[e], -found.weight[e])
                if ti.static(m.has_dependents):
                    k = _add_masters(p, m, c, k, s.node[found.vertex[e]], weight)
                elif ti.abs(weight) > NEGLIGIBLE:  # in a notch a node may be on both sides
                    k = _add_node(p, c, k, s.node[found.vertex[e]], weight)
                if e - begin < n_a:
                    p.arity_a[c] = k
            p.obstacle_displacement[c] = p.obstacle_displacement[c] + found.carried[row]
    p.arity[c] = k


def most_entries(m: Model, n: int, n_listed: int) -> int:
    """Most entries that n contacts found may need. n_listed: vertices of those that are mortar contacts."""
    return (NODES * n + n_listed) * m.most_masters


@ti.func
def room_of(m: ti.template(), found: ti.template(), row):
    """Most entries that a contact found may need."""
    return m.most_masters * ti.select(found.is_mortar(row), found.entries[row][2], NODES)


@ti.func
def fill_row(p: ti.template(), m: ti.template(), s: ti.template(), q: ti.template(), c, first, found: ti.template(), row):
    """Set contact c, with entries from `first` on, to one found, but for the displacement of an analytic obstacle."""
    p.normal[c], p.gap[c], p.point[c] = found.normal[row], found.gap[row], found.point[row]
    p.tangent[c], p.sweep.order[c] = tangent(p.normal[c]), c
    p.body[c], p.feature[c] = found.body[row], found.feature[row]
    p.friction[c], p.restitution[c] = _pair_coefficients(q, p.body[c][0], p.body[c][1])
    p.obstacle_displacement[c] = dvec(0.0)
    _add_sides(p, m, s, c, first, found, row)
    p.min_opening[c], p.impact_impulse[c] = 0.0, dvec(0.0)
    p.guard[c], p.area[c] = found.guard[row], found.area[row]
    p.status[c], p.slip[c] = OPEN, dvec(0.0)


@kernel
def fill(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    q: ti.template(),
    found: ti.template(),
    reduction: ti.template(),
    n_kept: ti.i32,
    dt: ti.f64,
    warm: ti.f64,
    common_offset: ti.f64,
    indexes: ti.i32,
):
    """Fill the problem's contacts from rows of the detector's buffer `found`, after its present ones have become those of the
    past, and list the entries of each node. b and the r-factors are not set. Nothing is done in a batch that has ended.

    s: Surface; o: AnalyticObstacles; q: PairNumbers. n_kept: number of the reduction's rows to take, -1 for all. warm: factor of
    the previous step's impulses; common_offset: contact offset between different bodies [m]; indexes: 0 if there are no entries,
    nor were any before.
    """
    keep_impulses(p, common_offset, s.run[GO])
    ti.loop_config(serialize=True)
    for _ in range(1):
        if s.run[GO] == 1:
            p.count[0] = ti.select(n_kept < 0, reduction.n_kept(), n_kept)
    clear_counts(p.room, keys_if(s.run[GO], p.count[0]))
    ti.loop_config(serialize=p.serial)
    for c in range(s.run[GO] * p.count[0]):
        count_entries(p.room, c, room_of(m, found, reduction.kept[c]))
    add_up_counts(p.room, keys_if(s.run[GO], p.count[0]))
    ti.loop_config(serialize=p.serial)
    for c in range(s.run[GO] * p.count[0]):
        row = reduction.kept[c]
        fill_row(p, m, s, q, c, p.room.start[c + 1], found, row)
        normal = p.normal[c]
        if ti.static(o.any):
            if found.nodes_b[row][0] < 0:
                p.obstacle_displacement[c] = obstacle_displacement_at(o, p.body[c][1], p.point[c] - 0.5 * p.gap[c] * normal)
        p.approach[c], p.load[c] = normal.dot(relative_velocity(p, m, c, dt)), warm * load_of(p, c)
        p.r[c] = prox(to_frame(p, c, warm * warm_impulse(p, c)), p.friction[c])
    p.count[2] = p.room.start[p.count[0] + 1]
    list_entries(p, s.run[GO] * indexes)


@kernel
def carry_on(p: ti.template(), m: ti.template(), s: ti.template(), dt: ti.f64, common_offset: ti.f64):
    """Begin a sub-step of dt [s] with the contacts and impulses of the last one, as `fill` does with those of a search."""
    keep_impulses(p, common_offset, s.run[GO])
    ti.loop_config(serialize=p.serial)
    for c in range(s.run[GO] * p.count[0]):
        p.approach[c], p.load[c] = p.normal[c].dot(relative_velocity(p, m, c, dt)), load_of(p, c)


@kernel
def has_impact(p: ti.template(), rigid: ti.template(), dt: ti.f64, contact_offset: ti.f64) -> ti.i32:
    """Return 1 if a contact without impulse in the previous step closes within a step of dt, else 0.

    rigid: (n_colliders) i32, 1 for rigid bodies. The gap to one may have closed to the contact offset in the previous step, which
    stops the body in this one: an impulse then does not tell that the impact is over, only the approach does.
    """
    found = 0
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        closes = p.gap[c] - contact_offset_of(p, c, contact_offset) + dt * p.approach[c] < 0.0
        stops = p.r[c][0] == 0.0 and p.approach[c] < 0.0
        if p.area[c] > 0.0:  # where points carry the load of the pair, a mean comes and goes without an impact
            stops = stops and p.load[c] == 0.0
        if rigid[p.body[c][0]] + rigid[p.body[c][1]] > 0:
            stops = stops or dt * p.approach[c] < -STILL * contact_offset
        if stops and closes:
            ti.atomic_max(found, 1)
    return found


@kernel
def end_contacts(p: ti.template(), m: ti.template(), x_start: ti.template(), accumulated: ti.template(), explicit_dt: ti.f64):
    """See `finish_contacts`."""
    finish_contacts(p, m, x_start, accumulated, explicit_dt, 1)


@ti.func
def finish_contacts(p: ti.template(), m: ti.template(), x_start: ti.template(), accumulated: ti.template(), explicit_dt, go):
    """Set gaps to those at the present positions, after a step from the positions x_start (n_nodes) [m], and the slips since.

    Add to `accumulated` (n_nodes) f64 [m] the length of each node's mean slip, weighted by normal impulses, in which what sticks
    counts 0. explicit_dt: dt of an explicit step [s], whose states are set; 0 for an implicit one, which has set them.
    go: 0 to do nothing. Top-level loops of a kernel.
    """
    ti.loop_config(serialize=p.serial)
    for c in range(go * p.count[0]):
        motion = -p.obstacle_displacement[c]
        for e in range(p.first[c], p.first[c] + p.arity[c]):
            i = p.node[e]
            motion += p.weight[e] * (m.state.x[i] - x_start[i])
        normal = p.normal[c].dot(motion)
        p.gap[c] += normal
        p.slip[c] = motion - normal * p.normal[c]
        if explicit_dt > 0.0:
            step = scaled(p.factor[c], to_frame(p, c, p.slip[c] / explicit_dt))
            p.status[c] = state_of(p.r[c] - step, p.friction[c] * p.r[c][0])
    ti.loop_config(serialize=m.serial)
    for i in range(go * m.n_nodes):
        slip, load = dvec(0.0), ti.cast(0.0, ti.f64)
        for at in range(p.by_node.start[i], p.by_node.start[i + 1]):
            c = p.contact[p.entry[at]]
            if p.status[c] != OPEN:
                part = ti.abs(p.weight[p.entry[at]]) * (p.r[c][0] + p.impact_impulse[c].dot(p.normal[c]))
                load += part
                if p.status[c] == SLIP:
                    slip += part * p.slip[c]
        if load > 0.0:
            accumulated[i] += slip.norm() / load


@kernel
def scale_impulses(p: ti.template(), factor: ti.f64):
    """Multiply all impulses by `factor`."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.r[c] = factor * p.r[c]
