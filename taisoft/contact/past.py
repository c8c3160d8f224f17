"""Contacts of the previous step, which the next one starts from; in a step, those before a renewal of the geometry.

They are found by feature, in counting lists by a hash of it. The contacts of each pair of colliders are represented by the first
of them, in a hash table with open addressing. It is filled in rounds: a contact whose pair has a slot is done, and of the others
that have come to the same free slot the first one gets it.
"""

import taichi as ti

from taisoft.backend.lists import add_up_counts, bucket_of, clear_counts, count_entry, keys_if, place_of_entry
from taisoft.contact.problem import to_world
from taisoft.contact.prox import dvec
from taisoft.contact.targets import contact_offset_of

FEWEST = 63  # buckets, minus one
DIGITS = 2.0**30  # to which impulses are rounded, relative to the largest: sums of such numbers are exact in any order


@ti.func
def enter_past(problem: ti.template(), go):
    """Store the present contacts as those of the past, if go is 1; if it is 0, do nothing. Top-level loops of a kernel."""
    (past,) = ti.static((problem.past,))
    ti.loop_config(serialize=True)
    for _ in range(1):
        mask = FEWEST
        while mask + 1 < 2 * problem.count[0]:
            mask = 2 * mask + 1
        if go == 1:
            past.mask[0] = mask
    clear_counts(past.by_feature, keys_if(go, past.mask[0] + 1))
    ti.loop_config(serialize=problem.serial)
    for c in range(go * problem.count[0]):
        past.feature[c], past.collider[c] = problem.feature[c], problem.body[c]
        past.pair_sum[c] = ti.Vector([0.0, 0.0], ti.f64)
        past.point[c] = problem.point[c]
        past.impulse[c] = to_world(problem, c, problem.r[c])
        past.bucket[c] = _bucket(problem, problem.feature[c])
        count_entry(past.by_feature, past.bucket[c])
    add_up_counts(past.by_feature, keys_if(go, past.mask[0] + 1))
    ti.loop_config(serialize=problem.serial)
    for c in range(go * problem.count[0]):
        past.member[place_of_entry(past.by_feature, past.bucket[c])] = c
    ti.loop_config(serialize=problem.team.alone, block_dim=problem.team.threads)
    for t in range(problem.team.threads):
        if go == 1:
            _enter_pairs(problem, t)


@ti.func
def _bucket(problem: ti.template(), feature):
    return bucket_of(feature[0], feature[1], feature[2], problem.past.mask[0])


@ti.func
def _enter_pairs(problem: ti.template(), t):
    """Find the first contact of each one's pair of colliders, by all threads t of the team."""
    past, team = ti.static((problem.past, problem.team))
    n, n_slots = problem.count[0], problem.past.mask[0] + 1
    for j in range(team.share(t, n_slots)):
        k = team.entry(t, j, n_slots)
        past.pair_slot[k], past.claim[k] = -1, n
    for j in range(team.share(t, n)):
        past.pair[team.entry(t, j, n)] = -1
    team.sync()
    missing = ti.cast(n, ti.f64)
    while missing > 0.0:
        for j in range(team.share(t, n)):
            c = team.entry(t, j, n)
            if past.pair[c] < 0:
                past.bucket[c] = pair_slot(problem, past.collider[c])
                past.pair[c] = past.pair_slot[past.bucket[c]]
                if past.pair[c] < 0:
                    ti.atomic_min(past.claim[past.bucket[c]], c)
        team.sync()
        missing = 0.0
        for j in range(team.share(t, n)):
            c = team.entry(t, j, n)
            if past.pair[c] < 0:
                missing += 1.0
                if past.claim[past.bucket[c]] == c:
                    past.pair_slot[past.bucket[c]] = c
        missing = team.total(t, missing)


@ti.func
def pair_slot(problem: ti.template(), body):
    """Slot of a pair of colliders, or the free one where it belongs."""
    mask, found = problem.past.mask[0], 0
    k = bucket_of(body[0], body[1], 0, mask)
    while found == 0 and problem.past.pair_slot[k] >= 0:
        if (problem.past.collider[problem.past.pair_slot[k]] == body).all():
            found = 1
        else:
            k = (k + 1) & mask
    return k


@ti.func
def keep_impulses(p: ti.template(), common_offset, go):
    """`enter_past`, and sum up the loads of the pairs. common_offset: contact offset between different bodies [m]."""
    enter_past(p, go)
    ti.loop_config(serialize=p.team.alone, block_dim=p.team.threads)
    for t in range(p.team.threads):
        if go == 1:
            _sum_loads(p, common_offset, t)


@ti.func
def _sum_loads(p: ti.template(), common_offset, t):
    """Sum impulses and r-factors of the contacts of each pair that carry an impulse or could be opened, by all threads t of the
    team."""
    (team,) = ti.static((p.team,))
    n, largest = p.count[0], ti.Vector([0.0, 0.0], ti.f64)
    if ti.static(not p.on_cpu):
        for j in range(team.share(t, n)):
            largest = ti.max(largest, _summand(p, team.term(t, j), common_offset))
        for k in ti.static(range(2)):
            largest[k] = team.largest(t, largest[k])
    for j in range(team.share(t, n)):
        c = team.term(t, j)
        one, first = _summand(p, c, common_offset), p.past.pair[c]
        if ti.static(p.on_cpu):
            p.past.pair_sum[first] = p.past.pair_sum[first] + one
        else:
            for k in ti.static(range(2)):
                if one[k] > 0.0:
                    ti.atomic_add(p.past.pair_sum[first][k], ti.round(DIGITS * (one[k] / largest[k])))
    if ti.static(not p.on_cpu):
        team.sync()
        for j in range(team.share(t, n)):
            c = team.entry(t, j, n)
            if p.past.pair[c] == c:
                p.past.pair_sum[c] = p.past.pair_sum[c] * largest


@ti.func
def _summand(p: ti.template(), c, common_offset):
    """Normal impulse and r-factor of contact c, 0 if it carries no impulse and could not be opened."""
    one = ti.Vector([0.0, 0.0], ti.f64)
    if p.r[c][0] > 0.0 or p.gap[c] < contact_offset_of(p, c, common_offset):
        one = ti.Vector([p.r[c][0], p.factor[c][0]], ti.f64)
    return one


@ti.func
def load_of(p: ti.template(), c):
    """Velocity that the impulses of the pair of contact c gave its contacts in the previous step [m/s]."""
    first, load = p.past.pair_slot[pair_slot(p, p.body[c])], ti.cast(0.0, ti.f64)
    if first >= 0:
        if p.past.pair_sum[first][1] > 0.0:
            load = p.past.pair_sum[first][0] / p.past.pair_sum[first][1]
    return load


@ti.func
def past_of(p: ti.template(), feature, point):
    """The past contact with the same feature that is nearest to a point (3,), of several the first; -1 if there is none."""
    best, smallest = -1, ti.cast(ti.math.inf, ti.f64)
    b = _bucket(p, feature)
    for at in range(p.past.by_feature.start[b], p.past.by_feature.start[b + 1]):
        j = p.past.member[at]
        if (p.past.feature[j] == feature).all():
            d = (p.past.point[j] - point).norm()
            if d < smallest or (d == smallest and j < best):
                best, smallest = j, d
    return best


@ti.func
def warm_impulse(p: ti.template(), c):
    """World impulse of the nearest contact with the same feature in the previous step; 0 if there is none."""
    j, impulse = past_of(p, p.feature[c], p.point[c]), dvec(0.0)
    if j >= 0:
        impulse = p.past.impulse[j]
    return impulse
