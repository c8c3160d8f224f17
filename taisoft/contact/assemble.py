"""Build the contact problem from detected contacts: frames, weights, friction and restitution, warm start.

The target is the smallest gap that a contact may have at the end of a step. It is at most the contact offset, a distance that
keeps surfaces apart despite the error of linearising the motion. A gap above the offset may close to it. A gap below it opens
slowly, a true penetration within a few steps, and never faster than strains the softest body by one percent: bodies would fly
apart otherwise. Contacts of a body with itself have SELF_CONTACT times the contact offset and are corrected SELF_CONTACT times
as fast. Where the surfaces meet within the step, restitution raises the target (`restitution`). The impulse must satisfy
    u_n = (gap - target)/dt + n.(v_a - v_b) >= 0,
which counts motion once, since the gap is the one at the start of the step.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, upload
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem, to_frame, to_world
from taisoft.contact.prox import dvec, prox, tangents
from taisoft.scene.scene import Scene

NEGLIGIBLE = 1e-12  # a node with a smaller weight is left out of the contact
SELF_CONTACT = 5.0  # factor of contact offset and correction rate in contacts of a body with itself: folds turn as they meet


@dataclass(frozen=True, eq=False)
class FoundContacts:
    """Data of each contact beside the problem, row by row."""

    problem: ContactProblem
    n_slots: Count  # size of the hash table, a power of two
    point: Any  # 3-vectors f64 [m]
    gap: Any  # f64 [m]
    obstacle_displacement: Any  # 3-vectors f64: obstacle's displacement at the contact in the step [m]
    approach: Any  # f64: normal velocity at the start of the step, negative if surfaces approach [m/s]
    restitution: Any  # f64
    min_velocity: Any  # f64: least normal velocity after the impact, set only in steps with one [m/s]
    min_opening: Any  # f64: least opening of the gap in the step, 0 without restitution [m]
    impact_impulse: Any  # 3-vectors f64: impulse of the impact before the step [N s]
    body: Any  # 2-vectors i32: colliders
    feature: Any  # 3-vectors i32
    previous_feature: Any  # 3-vectors i32: of the previous step
    previous_point: Any  # 3-vectors f64
    previous_impulse: Any  # 3-vectors f64, world frame
    slot: Any  # (n_slots) i32: hash table of the previous step's contacts, -1 if empty


@dataclass(frozen=True, eq=False)
class PairNumbers:
    """Friction and restitution of each collider and of pairs with their own values (-1: not set)."""

    friction: Any  # (n_colliders) f64
    restitution: Any  # (n_colliders) f64
    n_pairs: Any  # (1) i32
    pair: Any  # (capacity) 2-vectors i32, the lower collider first
    pair_friction: Any
    pair_restitution: Any


def build_found(arena: FieldArena, problem: ContactProblem) -> FoundContacts:
    """Allocate the fields, with the capacity of the problem."""
    n = problem.capacity
    n_slots = 1 << (2 * n - 1).bit_length()

    def vectors(name: str, dtype=ti.f64, k: int = 3):
        return arena.vectors(f"found_{name}", dtype, n, n=k)

    def numbers(name: str):
        return arena.field(f"found_{name}", ti.f64, n)

    return FoundContacts(
        problem,
        n_slots,
        vectors("point"),
        numbers("gap"),
        vectors("obstacle_displacement"),
        numbers("approach"),
        numbers("restitution"),
        numbers("min_velocity"),
        numbers("min_opening"),
        vectors("impact_impulse"),
        vectors("body", ti.i32, 2),
        vectors("feature", ti.i32),
        vectors("previous_feature", ti.i32),
        vectors("previous_point"),
        vectors("previous_impulse"),
        arena.field("found_slot", ti.i32, n_slots),
    )


def build_pair_numbers(arena: FieldArena, scene: Scene) -> PairNumbers:
    """Upload the scene's coefficients, with room for pairs that are set later."""
    n = len(scene.colliders)
    capacity = 2 * len(scene.contact_pairs) + 64
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
    index, surfaces = {c.name: k for k, c in enumerate(scene.colliders)}, [scene.surface_of(c.name) for c in scene.colliders]
    capacity = numbers.pair_friction.shape[0]
    if len(scene.contact_pairs) > capacity:
        return False
    pairs, values = np.zeros((capacity, 2), dtype=np.int32), np.full((capacity, 2), -1.0)
    for k, (names, (friction, restitution)) in enumerate(scene.contact_pairs.items()):
        ids = sorted(index[name] for name in names)
        pairs[k] = ids[0], ids[-1]
        values[k] = -1.0 if friction is None else friction, -1.0 if restitution is None else restitution
    upload(
        [
            (numbers.friction, np.array([o.friction for o in surfaces])),
            (numbers.restitution, np.array([o.restitution for o in surfaces])),
            (numbers.n_pairs, np.array([len(scene.contact_pairs)])),
            (numbers.pair, pairs),
            (numbers.pair_friction, values[:, 0]),
            (numbers.pair_restitution, values[:, 1]),
        ]
    )
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
def _add_vertex(f: ti.template(), s: ti.template(), c, k, v, weight, sign):
    """Add vertex v of the surface to contact c, which has k nodes. Return its new number of nodes."""
    (p,) = ti.static((f.problem,))
    n = k
    if v >= 0:
        if ti.abs(weight) > NEGLIGIBLE:
            if s.node[v] >= 0:
                p.node[c, k] = s.node[v]
                p.weight[c, k] = sign * weight
                n = k + 1
            else:  # obstacle vertex
                f.obstacle_displacement[c] = f.obstacle_displacement[c] + weight * s.move[v]
    return n


@ti.func
def _slot(f: ti.template(), feature):
    x, y, z = ti.cast(feature[0], ti.i64), ti.cast(feature[1], ti.i64), ti.cast(feature[2], ti.i64)
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return ti.cast((h ^ (h >> 17)) & (f.n_slots - 1), ti.i32)


@kernel
def keep_impulses(f: ti.template()):
    """Store the present contacts as those of the previous step."""
    (p,) = ti.static((f.problem,))
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        f.previous_feature[c] = f.feature[c]
        f.previous_point[c] = f.point[c]
        f.previous_impulse[c] = to_world(p, c, p.r[c])
    ti.loop_config(serialize=p.serial)
    for k in range(f.n_slots):
        f.slot[k] = -1
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            k = _slot(f, f.previous_feature[c])
            while f.slot[k] >= 0:
                k = (k + 1) & (f.n_slots - 1)
            f.slot[k] = c


@ti.func
def _warm_impulse(f: ti.template(), c):
    """World impulse of the nearest contact with the same feature in the previous step; 0 if there is none."""
    best, smallest = -1, ti.cast(ti.math.inf, ti.f64)
    k = _slot(f, f.feature[c])
    while f.slot[k] >= 0:
        j = f.slot[k]
        if (f.previous_feature[j] == f.feature[c]).all():
            d = (f.previous_point[j] - f.point[c]).norm()
            if d < smallest:
                best, smallest = j, d
        k = (k + 1) & (f.n_slots - 1)
    impulse = dvec(0.0)
    if best >= 0:
        impulse = f.previous_impulse[best]
    return impulse


@kernel
def fill(
    f: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    q: ti.template(),
    found: ti.template(),
    kept: ti.template(),
    n: ti.i32,
    dt: ti.f64,
    warm: ti.f64,
):
    """Fill the problem's contacts from rows kept[:n] of the detector's buffer `found`. b and the r-factors are not set.

    s: Surface; o: AnalyticObstacles; q: PairNumbers. warm: factor of the previous step's impulses.
    """
    (p,) = ti.static((f.problem,))
    p.count[0] = n
    ti.loop_config(serialize=p.serial)
    for c in range(n):
        row = kept[c]
        normal, gap, point = found.normal[row], found.gap[row], found.point[row]
        p.normal[c], f.gap[c], f.point[c] = normal, gap, point
        t1, _t2 = tangents(normal)
        p.tangent[c] = t1
        f.body[c], f.feature[c] = found.body[row], found.feature[row]
        a, b = found.body[row][0], found.body[row][1]
        friction, restitution = _pair_coefficients(q, a, b)
        p.friction[c], f.restitution[c] = friction, restitution
        f.obstacle_displacement[c] = dvec(0.0)
        k = 0
        for j in ti.static(range(3)):
            k = _add_vertex(f, s, c, k, found.nodes_a[row][j], found.weights_a[row][j], 1.0)
        for j in ti.static(range(3)):
            k = _add_vertex(f, s, c, k, found.nodes_b[row][j], found.weights_b[row][j], -1.0)
        p.arity[c] = k
        if ti.static(o.any):
            if found.nodes_b[row][0] < 0:
                f.obstacle_displacement[c] = obstacle_displacement_at(o, b, point - 0.5 * gap * normal)
        p.order[c] = c
        v = -f.obstacle_displacement[c] / dt
        for j in range(k):
            v += p.weight[c, j] * ti.cast(m.state.v[p.node[c, j]], ti.f64)
        f.approach[c] = normal.dot(v)
        f.min_opening[c], f.impact_impulse[c] = 0.0, dvec(0.0)
        p.r[c] = prox(to_frame(p, c, warm * _warm_impulse(f, c)), friction)


@ti.func
def _self_contact_factor(f: ti.template(), c):
    """SELF_CONTACT if contact c joins a body with itself, else 1."""
    return ti.select(f.body[c][0] == f.body[c][1], ti.cast(SELF_CONTACT, ti.f64), ti.cast(1.0, ti.f64))


@ti.func
def contact_offset_of(f: ti.template(), c, common):
    """Contact offset of contact c [m]; common: that between different bodies."""
    return _self_contact_factor(f, c) * common


@ti.func
def gap_minus_target(f: ti.template(), c, dt, common_offset, penetration_fraction, offset_fraction, max_speed, min_opening):
    """gap - target of contact c [m].

    common_offset: contact offset between different bodies [m]. penetration_fraction, offset_fraction: fractions of a penetration
    and of a missing contact offset that the step corrects, at most at max_speed [m/s]. min_opening: for restitution, or 0 [m].
    """
    gap, own, contact_offset = f.gap[c], _self_contact_factor(f, c), contact_offset_of(f, c, common_offset)
    target = contact_offset
    if gap < contact_offset:
        above = ti.max(gap, 0.0)
        target = gap + ti.min(
            own * (offset_fraction * (contact_offset - above) + penetration_fraction * (above - gap)), max_speed * dt
        )
    if min_opening > 0.0:
        target = ti.max(target, gap + min_opening)
    return gap - target


@kernel
def find_impact(f: ti.template(), dt: ti.f64, contact_offset: ti.f64) -> ti.i32:
    """Return 1 if a contact without impulse in the previous step closes within a step of dt."""
    (p,) = ti.static((f.problem,))
    found = 0
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            closes = f.gap[c] - contact_offset_of(f, c, contact_offset) + dt * f.approach[c] < 0.0
            if p.r[c][0] == 0.0 and f.approach[c] < 0.0 and closes:
                found = 1
    return found


@kernel
def scale_impulses(p: ti.template(), factor: ti.f64):
    """Multiply all impulses by `factor`."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.r[c] = factor * p.r[c]
