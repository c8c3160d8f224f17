"""From contacts that were found to the contact problem: frames, weights, numbers of each pair, warm start.

Where a contact must be at the end of a step, its target, is a gap of at least the contact offset, a distance that keeps surfaces
apart in spite of what linearising the motion misses. A gap above it may close so far. A gap below it opens slowly, a true
penetration in a few steps, and never faster than strains the softest body by a percent: else bodies would fly apart. Parts of
one body keep OWN times the contact offset and are mended OWN times as fast. Where the surfaces meet within the step,
restitution asks for more (`restitution`). The velocity that an impulse must leave is then
    u_n = (gap - target)/dt + n.(v_a - v_b) >= 0,
which counts motion once: the gap is that at the start of the step.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.arrays import Count
from taisoft.contact.problem import ContactProblem, to_frame, to_world
from taisoft.contact.prox import dvec, prox, tangents
from taisoft.fields import FieldArena
from taisoft.runtime import kernel
from taisoft.scene.scene import Scene
from taisoft.transfer import upload

NEGLIGIBLE = 1e-12  # a weight below it: the node is not part of the contact
OWN = 5.0  # times the contact offset, and times the share of what is mended, between parts of one body: folds turn as they meet


@dataclass(frozen=True, eq=False)
class FoundContacts:
    """What a step keeps of each contact besides the problem itself; rows as in the problem."""

    problem: ContactProblem
    n_slots: Count  # of the table, a power of two
    point: Any  # 3-vectors f64 [m]
    gap: Any  # f64 [m]
    obstacle_displacement: Any  # 3-vectors f64: way of an obstacle at the contact in the step [m]
    approach: Any  # f64: normal velocity at the start of the step, negative where surfaces come nearer [m/s]
    restitution: Any  # f64
    leave: Any  # f64: normal velocity that an impact leaves at least, set where a step has one [m/s]
    rise: Any  # f64: how far the gap opens at least in the step, 0 without restitution [m]
    struck: Any  # 3-vectors f64: impulse of the impact before the step [N s]
    body: Any  # 2-vectors i32: colliders
    feature: Any  # 3-vectors i32
    before_feature: Any  # 3-vectors i32: the step before
    before_point: Any  # 3-vectors f64
    before_impulse: Any  # 3-vectors f64, in the world
    slot: Any  # (n_slots) i32: contact of the step before, -1 where there is none


@dataclass(frozen=True, eq=False)
class PairNumbers:
    """Friction and restitution of each collider, and of pairs that have their own (-1 where they have not)."""

    friction: Any  # (n_colliders) f64
    restitution: Any  # (n_colliders) f64
    n_pairs: Any  # (1) i32
    pair: Any  # (capacity) 2-vectors i32, the lower collider first
    pair_friction: Any
    pair_restitution: Any


def build_found(arena: FieldArena, problem: ContactProblem) -> FoundContacts:
    """Room for as many contacts as the problem has."""
    n = problem.capacity
    n_slots = 1 << (2 * n - 1).bit_length()

    def vectors(name: str, dtype=ti.f64, k: int = 3):
        return arena.vectors(f"found_{name}", dtype, n, n=k)

    def numbers(name: str):
        return arena.field(f"found_{name}", ti.f64, n)

    return FoundContacts(
        problem, n_slots, vectors("point"), numbers("gap"), vectors("obstacle_displacement"), numbers("approach"), numbers("restitution"),
        numbers("leave"), numbers("rise"), vectors("struck"), vectors("body", ti.i32, 2), vectors("feature", ti.i32),
        vectors("before_feature", ti.i32), vectors("before_point"), vectors("before_impulse"),
        arena.field("found_slot", ti.i32, n_slots),
    )  # fmt: skip


def build_pair_numbers(arena: FieldArena, scene: Scene) -> PairNumbers:
    """The scene's numbers, with room for pairs that are set later."""
    n = len(scene.colliders)
    capacity = 2 * len(scene.contact_pairs) + 64
    numbers = PairNumbers(
        arena.field("collider_friction", ti.f64, n), arena.field("collider_restitution", ti.f64, n),
        arena.field("n_contact_pairs", ti.i32, 1), arena.vectors("contact_pair", ti.i32, capacity, n=2),
        arena.field("pair_friction", ti.f64, capacity), arena.field("pair_restitution", ti.f64, capacity),
    )  # fmt: skip
    upload_pair_numbers(numbers, scene)
    return numbers


def upload_pair_numbers(numbers: PairNumbers, scene: Scene) -> bool:
    """Friction and restitution as the scene has them now; False where there are more pairs than room."""
    place, own = {c.name: k for k, c in enumerate(scene.colliders)}, [scene.surface_of(c.name) for c in scene.colliders]
    capacity = numbers.pair_friction.shape[0]
    if len(scene.contact_pairs) > capacity:
        return False
    pairs, values = np.zeros((capacity, 2), dtype=np.int32), np.full((capacity, 2), -1.0)
    for k, (names, (friction, restitution)) in enumerate(scene.contact_pairs.items()):
        ids = sorted(place[name] for name in names)
        pairs[k] = ids[0], ids[-1]
        values[k] = -1.0 if friction is None else friction, -1.0 if restitution is None else restitution
    upload([
        (numbers.friction, np.array([o.friction for o in own])), (numbers.restitution, np.array([o.restitution for o in own])),
        (numbers.n_pairs, np.array([len(scene.contact_pairs)])), (numbers.pair, pairs),
        (numbers.pair_friction, values[:, 0]), (numbers.pair_restitution, values[:, 1]),
    ])  # fmt: skip
    return True


@ti.func
def _numbers_of(q: ti.template(), a, b):
    """(friction, restitution) between colliders a < b: as `Scene.contact_numbers`."""
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
    """How far the point x of analytic obstacle `body` goes in the step; 0 for any other collider."""
    way = dvec(0.0)
    for k in range(o.count):
        if o.body[k] == body:
            R = ti.Matrix.rows([o.rotation[3 * k], o.rotation[3 * k + 1], o.rotation[3 * k + 2]])
            S = ti.Matrix.rows([o.next_rotation[3 * k], o.next_rotation[3 * k + 1], o.next_rotation[3 * k + 2]])
            way = S @ (R.transpose() @ (x - o.origin[k])) + o.next_origin[k] - x
    return way


@ti.func
def _take(
    f: ti.template(), s: ti.template(), c, k, v, weight, sign
):  # fmt: skip
    """Add vertex v of the surface to contact c, which has k nodes. Returns their number after it."""
    (p,) = ti.static((f.problem,))
    n = k
    if v >= 0:
        if ti.abs(weight) > NEGLIGIBLE:
            if s.node[v] >= 0:
                p.node[c, k] = s.node[v]
                p.weight[c, k] = sign * weight
                n = k + 1
            else:  # of an obstacle
                f.obstacle_displacement[c] = f.obstacle_displacement[c] + weight * s.move[v]
    return n


@ti.func
def _slot(f: ti.template(), feature):
    x, y, z = ti.cast(feature[0], ti.i64), ti.cast(feature[1], ti.i64), ti.cast(feature[2], ti.i64)
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return ti.cast((h ^ (h >> 17)) & (f.n_slots - 1), ti.i32)


@kernel
def keep_impulses(f: ti.template()):
    """The present contacts become those of the step before."""
    (p,) = ti.static((f.problem,))
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        f.before_feature[c] = f.feature[c]
        f.before_point[c] = f.point[c]
        f.before_impulse[c] = to_world(p, c, p.r[c])
    ti.loop_config(serialize=p.serial)
    for k in range(f.n_slots):
        f.slot[k] = -1
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            k = _slot(f, f.before_feature[c])
            while f.slot[k] >= 0:
                k = (k + 1) & (f.n_slots - 1)
            f.slot[k] = c


@ti.func
def _warm_impulse(f: ti.template(), c):
    """The impulse that the step before left at the nearest contact of the same feature, in the world; 0 without one."""
    best, least = -1, ti.cast(ti.math.inf, ti.f64)
    k = _slot(f, f.feature[c])
    while f.slot[k] >= 0:
        j = f.slot[k]
        if (f.before_feature[j] == f.feature[c]).all():
            d = (f.before_point[j] - f.point[c]).norm()
            if d < least:
                best, least = j, d
        k = (k + 1) & (f.n_slots - 1)
    impulse = dvec(0.0)
    if best >= 0:
        impulse = f.before_impulse[best]
    return impulse


@kernel
def fill(
    f: ti.template(), m: ti.template(), s: ti.template(), o: ti.template(), q: ti.template(), found: ti.template(),
    kept: ti.template(), n: ti.i32, dt: ti.f64, warm: ti.f64,
):  # fmt: skip
    """The problem's contacts from the search: rows kept[:n] of the buffer `found`. b and the r-factors are not set.

    s: Surface; o: AnalyticObstacles; q: PairNumbers. warm: what the impulses of the step before are multiplied by.
    """
    (p,) = ti.static((f.problem,))
    p.count[0] = n
    ti.loop_config(serialize=p.serial)
    for c in range(n):
        at = kept[c]
        normal, gap, point = found.normal[at], found.gap[at], found.point[at]
        p.normal[c], f.gap[c], f.point[c] = normal, gap, point
        t1, _t2 = tangents(normal)
        p.tangent[c] = t1
        f.body[c], f.feature[c] = found.body[at], found.feature[at]
        a, b = found.body[at][0], found.body[at][1]
        friction, restitution = _numbers_of(q, a, b)
        p.friction[c], f.restitution[c] = friction, restitution
        f.obstacle_displacement[c] = dvec(0.0)
        k = 0
        for j in ti.static(range(3)):
            k = _take(f, s, c, k, found.nodes_a[at][j], found.weights_a[at][j], 1.0)
        for j in ti.static(range(3)):
            k = _take(f, s, c, k, found.nodes_b[at][j], found.weights_b[at][j], -1.0)
        p.arity[c] = k
        if ti.static(o.any):
            if found.nodes_b[at][0] < 0:
                f.obstacle_displacement[c] = obstacle_displacement_at(o, b, point - 0.5 * gap * normal)
        p.order[c] = c
        v = -f.obstacle_displacement[c] / dt
        for j in range(k):
            v += p.weight[c, j] * ti.cast(m.state.v[p.node[c, j]], ti.f64)
        f.approach[c] = normal.dot(v)
        f.rise[c], f.struck[c] = 0.0, dvec(0.0)
        p.r[c] = prox(to_frame(p, c, warm * _warm_impulse(f, c)), friction)


@ti.func
def _own(f: ti.template(), c):
    """OWN where contact c is of a body with itself, else 1."""
    return ti.select(f.body[c][0] == f.body[c][1], ti.cast(OWN, ti.f64), ti.cast(1.0, ti.f64))


@ti.func
def contact_offset_of(f: ti.template(), c, common):
    """Standoff of contact c [m]; common: that of contacts between bodies."""
    return _own(f, c) * common


@ti.func
def gap_minus_target(f: ti.template(), c, dt, common_offset, fast, slow, fastest, rise):
    """gap - goal of contact c [m].

    common_standoff [m]: of contacts between bodies. rise: how far restitution opens the gap in the step, or 0 [m].
    fast, slow: shares of a penetration and of a missing contact offset that the step mends; fastest: speed of that at most [m/s].
    """
    gap, own, contact_offset = f.gap[c], _own(f, c), contact_offset_of(f, c, common_offset)
    target = contact_offset
    if gap < contact_offset:
        above = ti.max(gap, 0.0)
        target = gap + ti.min(own * (slow * (contact_offset - above) + fast * (above - gap)), fastest * dt)
    if rise > 0.0:
        target = ti.max(target, gap + rise)
    return gap - target


@kernel
def find_impact(f: ti.template(), dt: ti.f64, contact_offset: ti.f64) -> ti.i32:
    """1 where a contact closes within a step of dt that bore no impulse in the one before."""
    (p,) = ti.static((f.problem,))
    found = 0
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            closes = f.gap[c] + dt * f.approach[c] < contact_offset_of(f, c, contact_offset)
            if p.r[c][0] == 0.0 and f.approach[c] < 0.0 and closes:
                found = 1
    return found


@kernel
def scale_impulses(p: ti.template(), share: ti.f64):
    """Multiply all impulses."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.r[c] = share * p.r[c]
