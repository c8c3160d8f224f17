"""Contact forces that act along normals that do not hold at the step's end.

The impulse r of a contact should act along the normal n' of the step's end, but acts along that with which the step was solved,
n: the same to a thousandth where `contact_geometry` has renewed it, else that of the start. If R turns n into n', the force
r - R r is misplaced. It matters as it brakes or drives the slip u of the step:
    W = sum (r - R r).u   against   S = sum |r| max(|u|, contact offset)
over the contacts of a pair. Sliding by D over a radius R makes W / S = D / R: friction seems larger by (1 + mu^2) D / R of the
normal force, or a body without friction drags. At a seam, the edge of the neighbouring box stops what should slide over it.
Where nothing slides the force follows from balance, whatever the normal, and W is 0.

A contact whose point has left a face over an edge held until then, and counts as right. So do passages in a substep that finds
some: what would go through something then is stopped along the normal of that time, as by an impact.

Both sums fade by FADING with every step in which the pair touches, and a step counts no more than a MIN_STEPS-th of all: one
impact on an edge may turn a force by 20 %, a slide over many steps by no more than 2 %. What grazes beside larger forces on both
bodies for a few steps is not reported.

Weak: the work of a force that is misplaced across the slip is 0; contacts with distance fields of bodies count as right.
"""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.contacts import EDGE_EDGE, FACE_FACE, MORTAR, VERTEX_FACE
from taisoft.collision.detector import Detection
from taisoft.collision.end_normals import nearest_of_edges, normal_at, normal_on_shape
from taisoft.collision.features import FLAT_COSINE
from taisoft.collision.mortar import SAME_CLUSTER
from taisoft.collision.passages import ADJACENT, N_FEATURES, N_KINDS, NEAR
from taisoft.collision.surface import dvec
from taisoft.contact.build import relative_velocity
from taisoft.contact.problem import ContactProblem, to_world
from taisoft.dynamics.simulation_state import SimulationState

FADING, MIN_STEPS = 0.95, 10
AT_REST = 0.01  # of the contact offset: slip in a step below which a contact sticks
LEFT = 0.5  # of the slip: distance beyond that of the linearised motion from which a point that stays at edges has left them
# columns of the sums over steps: S, W, the work of friction, the largest S of a step; then S, W, friction and impulse of this
# step; the pair, first collider * n_colliders + second, -1 in unused rows
SLIP_WORK, FALSE_WORK, FRICTION_WORK, LARGEST, NOW, IMPULSE, PAIR, COLUMNS = 0, 1, 2, 3, 4, 7, 8, 9
NO_SUMS = np.tile(np.where(np.arange(COLUMNS) == PAIR, -1.0, 0.0), (16, 1))


@ti.func
def _lowest(s: ti.template(), t):
    return ti.min(s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2])


@ti.func
def _lower_end(s: ti.template(), e):
    return ti.min(s.triangle[e // 3, e % 3], s.triangle[e // 3, (e % 3 + 1) % 3])


@ti.func
def _side(s: ti.template(), t, u, i, j):
    """1 if triangle t is on side a of a contact and u on side b, else -1; i, j: the lowest vertices of what meets."""
    return ti.select(s.body[t] < s.body[u] or (s.body[t] == s.body[u] and i <= j), ti.cast(1.0, ti.f64), ti.cast(-1.0, ti.f64))


@ti.func
def _normal_on_shape(p: ti.template(), m: ti.template(), o: ti.template(), c, lasting):
    """`_end_normal` of a contact with an analytic obstacle, or with none of the kinds that it follows."""
    n, end, gap, is_smooth, was_smooth = p.normal[c], 1.0 * p.normal[c], lasting, True, True
    if ti.static(o.any):
        x = dvec(0.0)
        for e in range(p.first[c], p.first[c] + p.arity[c]):
            x += p.weight[e] * m.state.x[p.node[e]]
        v, d, flag, before = normal_on_shape(o, p.body[c][1], x, n)
        if v.dot(v) > 0.0:
            end, gap, is_smooth, was_smooth = v, d, flag, before
    return end, gap, is_smooth, was_smooth


@ti.func
def _mortar_normal(p: ti.template(), overlay: ti.template(), found: ti.template(), c):
    """Normal (3,) of mortar contact c in the last search; its own if it was not found there with nearly that."""
    own, best = p.normal[c], ti.cast(SAME_CLUSTER, ti.f64)
    end = 1.0 * own
    first, n = overlay.contacts[p.feature[c][1]][0], overlay.contacts[p.feature[c][1]][1]
    for row in range(first, first + n):
        along = found.normal[row].dot(own)
        if (found.body[row] == p.body[c]).all() and along > best:
            end, best = found.normal[row], along
    return end


@ti.func
def _end_normal(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    overlay: ti.template(),
    found: ti.template(),
    c,
    lasting,
):
    """Normal (3,) of contact c at the present positions, its gap [m], and whether its point lies on a smooth part of a surface
    now, and did at first. lasting: what the gap counts as where the normal does not change [m]."""
    kind, one, other, n = p.feature[c][0], p.feature[c][1], p.feature[c][2], p.normal[c]
    end, gap, is_smooth, was_smooth = n, lasting, True, True
    vertex, face, e, f, side = -1, -1, -1, -1, ti.cast(1.0, ti.f64)
    if kind == VERTEX_FACE:
        vertex, face = one, other
        side = _side(s, s.ring[s.ring_start[one]], other, one, _lowest(s, other))
    elif kind == EDGE_EDGE:
        e, f, side = one, other, _side(s, one // 3, other // 3, _lower_end(s, one), _lower_end(s, other))
    elif kind == FACE_FACE and one % N_KINDS == NEAR:
        t, u, k = one // N_KINDS, other // N_FEATURES, other % N_FEATURES
        side = _side(s, t, u, _lowest(s, t), _lowest(s, u))
        if k >= 6:
            e, f = 3 * t + (k - 6) // 3, 3 * u + (k - 6) % 3
        elif k < 3:
            vertex, face = s.triangle[t, k], u
        else:
            vertex, face, side = s.triangle[u, k - 3], t, -side
    elif kind == MORTAR:
        if ti.static(found.has_mortar):
            end = _mortar_normal(p, overlay, found, c)
    elif kind != FACE_FACE or one % N_KINDS != ADJACENT:
        end, gap, is_smooth, was_smooth = _normal_on_shape(p, m, o, c, lasting)
    own, foot, first, second, n_points = dvec(0.0), dvec(0.0), face, -1, int(vertex >= 0)
    if vertex >= 0:
        own = s.x[vertex]
    if e >= 0:
        x, y, across, is_inner = nearest_of_edges(s, e, f)
        across = ti.select(across.dot(n) < 0.0, -across, across)
        height = side * (x - y).dot(across)
        if is_inner and height <= 0.0:  # they have passed each other
            end, gap = across, height
        else:
            own, foot, first, second, n_points = x, y, f // 3, e // 3, 2
    least = ti.cast(ti.math.inf, ti.f64)
    for k in range(n_points):  # two edges that are not nearest to each other: take the closer of the two surface points
        t = ti.select(k == 0, first, second)
        v, d, flag = normal_at(s, ti.select(k == 0, own, foot), t)
        v *= ti.select(k == 0, side, -side)
        if ti.abs(d) < least:
            end, gap, is_smooth, least = v, d, flag, ti.abs(d)
            cosine = ti.abs(s.normal[t].dot(n))
            if e >= 0:
                u = s.neighbour[t, ti.select(k == 0, f, e) % 3]
                if u >= 0:
                    cosine = ti.max(cosine, ti.abs(s.normal[u].dot(n)))
            was_smooth = cosine > ti.cast(FLAT_COSINE, ti.f64)
    return end, gap, is_smooth, was_smooth


@ti.func
def _false_work(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    overlay: ti.template(),
    found: ti.template(),
    has_pairs: ti.template(),
    c,
    dt,
    contact_offset,
    passes,
):
    """What contact c adds to S, W and the work of friction of its pair, (3,) [J s], at the end of a step of dt [s]."""
    n, r, false = p.normal[c], to_world(p, c, p.r[c]), dvec(0.0)
    u = dt * relative_velocity(p, m, c, dt)
    lasting = p.gap[c] + u.dot(n)
    slip, across = u - u.dot(n) * n, r - r.dot(n) * n
    if slip.norm() > ti.cast(AT_REST, ti.f64) * contact_offset and not (passes == 1 and p.feature[c][0] == FACE_FACE):
        end, gap, is_smooth, was_smooth = 1.0 * n, lasting, True, True
        if ti.static(has_pairs):
            end, gap, is_smooth, was_smooth = _end_normal(p, m, s, o, overlay, found, c, lasting)
        else:
            end, gap, is_smooth, was_smooth = _normal_on_shape(p, m, o, c, lasting)
        left = ti.select(was_smooth, ti.cast(0.0, ti.f64), ti.cast(LEFT, ti.f64) * slip.norm())
        if is_smooth or gap - lasting <= left:
            turned = across - end.dot(across) / ti.max(1.0 + n.dot(end), 1e-6) * (n + end)
            false = r.dot(n) * (n - end) + across - turned
    return dvec(r.norm() * ti.max(slip.norm(), contact_offset), false.dot(slip), ti.abs(across.dot(slip)))


@ti.func
def _pair_of(p: ti.template(), n_colliders, c):
    """The pair of colliders of contact c, as in the sums."""
    return ti.cast(p.body[c][0] * n_colliders + p.body[c][1], ti.f64)


@ti.func
def _row_of(sums: ti.template(), n_rows, pair, guess):
    """Row of a pair in the sums, or the unused one where it belongs; n_rows if there is none. guess: looked at first."""
    row = guess
    if sums[row, PAIR] != pair:
        row = 0
        while row < n_rows and sums[row, PAIR] != pair and sums[row, PAIR] >= 0.0:
            row += 1
    return row


@ti.func
def _sum_in_order(p: ti.template(), n_colliders, sums: ti.template(), n_rows):
    """Add what the contacts add in this step to their rows. Return whether there are enough."""
    row = 0
    for c in range(p.count[0]):
        if p.sweep.sweep_start[c][0] > 0.0 and row < n_rows:
            pair = _pair_of(p, n_colliders, c)
            row = _row_of(sums, n_rows, pair, row)  # contacts of a pair mostly follow each other
            if row < n_rows:
                sums[row, PAIR] = pair
                for q in ti.static(range(3)):
                    sums[row, NOW + q] += p.sweep.sweep_start[c][q]
                sums[row, IMPULSE] += p.r[c].norm()
    return row < n_rows


@ti.func
def _find_rows(p: ti.template(), n_colliders, sums: ti.template(), n_rows, t):
    """Set `renewal.source` of contacts to their rows, n_rows if they have none. Return the first contact whose pair is missing,
    the number of contacts if none is. For thread t of a team."""
    first = p.count[0]
    for j in range(p.team.share(t, p.count[0])):
        c, row = p.team.entry(t, j, p.count[0]), n_rows
        if p.sweep.sweep_start[c][0] > 0.0:
            pair = _pair_of(p, n_colliders, c)
            row = _row_of(sums, n_rows, pair, 0)
            if row == n_rows or sums[ti.min(row, n_rows - 1), PAIR] != pair:
                first = ti.min(first, c)
        p.renewal.source[c] = row
    return p.team.least(t, first)


@ti.func
def _sum_by_team(p: ti.template(), n_colliders, sums: ti.template(), n_rows, t):
    """`_sum_in_order` by thread t of a team: pairs without a row get one in turn, then all threads sum each row."""
    fits, first = True, _find_rows(p, n_colliders, sums, n_rows, t)
    while fits and first < p.count[0]:
        row = p.renewal.source[first]
        fits = row < n_rows
        if fits and t == 0:
            sums[row, PAIR] = _pair_of(p, n_colliders, first)
        p.team.sync()
        first = _find_rows(p, n_colliders, sums, n_rows, t)
    for k in range(ti.select(fits, n_rows, 0)):
        if sums[k, PAIR] >= 0.0:
            own = ti.Vector([0.0, 0.0, 0.0, 0.0], ti.f64)
            for j in range(p.team.share(t, p.count[0])):
                c = p.team.term(t, j)
                if p.renewal.source[c] == k:
                    one = p.sweep.sweep_start[c]
                    own += ti.Vector([one[0], one[1], one[2], p.r[c].norm()], ti.f64)
            for q in ti.static(range(4)):
                own[q] = p.team.total(t, own[q])
                if t == 0:
                    sums[k, NOW + q] = own[q]
    p.team.sync()
    return fits


@kernel(cse=False)
def add_step(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    overlay: ti.template(),
    found: ti.template(),
    has_pairs: ti.template(),
    dt: ti.f64,
    contact_offset: ti.f64,
    n_colliders: ti.i32,
    sums: ti.template(),
    n_rows: ti.i32,
    passes: ti.i32,
):
    """Add a step of dt [s] to the sums (n_rows + 1, 9) of pairs.

    overlay, found: those of the search at its end; has_pairs: whether contacts may be of two triangles; passes: 1 if the substep
    found passages.

    The first number of the last row becomes the row of the pair of the largest misplaced part among those that touch, -1 if none
    does, -2 without change if there are too few rows. p.sweep.sweep_start
    and p.renewal.source are used as workspace.
    """
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.sweep.sweep_start[c] = dvec(0.0)
        if p.r[c][0] > 0.0:
            p.sweep.sweep_start[c] = _false_work(p, m, s, o, overlay, found, has_pairs, c, dt, contact_offset, passes)
    ti.loop_config(serialize=p.team.alone, block_dim=p.team.threads)
    for t in range(p.team.threads):
        for j in range(p.team.share(t, n_rows)):
            for q in ti.static(range(4)):
                sums[p.team.entry(t, j, n_rows), NOW + q] = 0.0
        p.team.sync()
        fits = False
        if ti.static(p.on_cpu):
            fits = _sum_in_order(p, n_colliders, sums, n_rows)
        else:
            fits = _sum_by_team(p, n_colliders, sums, n_rows, t)
        largest, first = ti.cast(-1.0, ti.f64), n_rows
        for j in range(p.team.share(t, ti.select(fits, n_rows, 0))):
            k = p.team.entry(t, j, n_rows)
            own = sums[k, NOW]
            if own > 0.0:
                for q in range(3):
                    sums[k, q] = FADING * sums[k, q] + sums[k, NOW + q]
                sums[k, LARGEST] = ti.max(FADING * sums[k, LARGEST], own)
                part = ti.abs(sums[k, FALSE_WORK]) / ti.max(sums[k, SLIP_WORK], MIN_STEPS * sums[k, LARGEST])
                if part > largest or (part == largest and k < first):
                    first, largest = k, part
        overall = p.team.largest(t, largest)
        first = p.team.least(t, ti.select(largest == overall, first, n_rows))
        if t == 0:
            sums[n_rows, 0] = ti.select(fits, ti.select(first < n_rows, first, -1), -2)


class Misplacement:
    """Contact forces of a simulation's pairs that the normals of steps' starts misplace. Their sums are `StepState.misplaced`."""

    MAX_MISPLACED = 0.02  # of a pair's contact force: more is reported
    LEAST_SHARE = 0.2  # of the contact impulses on a body in a step: where a pair has less, an event of few steps is not reported

    def __init__(self, simulation: SimulationState, detection: Detection):
        self._simulation, self._detection = simulation, detection
        self._arena, self._stored = FieldArena(), None  # the latter: the numbers that the next one has
        self._sums = self._arena.field("misplaced", ti.f64, (len(NO_SUMS) + 1, COLUMNS))  # for kernels; of `add_step`
        self.start_step()

    def _store(self, sums: np.ndarray) -> None:
        """Put the sums where kernels find them."""
        is_there, self._stored = sums is self._stored, None
        if is_there:
            return
        sums = np.append(sums, sums[:1], axis=0)
        if self._sums.shape[0] == len(sums):
            self._sums.from_numpy(sums)
        else:
            self._arena.release()
            self._sums = self._arena.field("misplaced", ti.f64, sums.shape, sums)

    def release(self) -> None:
        """Free their memory."""
        self._arena.release()

    def start_step(self) -> None:
        """Begin a step."""
        self.part, self.text = 0.0, ""  # largest misplaced part in this step, and a sentence if that is too much

    def add(self, problem: ContactProblem, dt: float, contact_offset: float, passes: bool) -> None:
        """Add a substep of dt [s], whose end was searched last; passes: whether passages were found in it."""
        detection, now, n = self._detection, self._simulation.now, len(self._detection.scene.colliders)
        last = detection.surface, detection.shapes, detection.overlay, detection.buffer.data, detection.has_pairs
        records = problem, self._simulation.model, *last
        self._store(now.misplaced)
        while True:
            add_step(*records, dt, contact_offset, n, self._sums, self._sums.shape[0] - 1, int(passes))
            *sums, (row, *_) = self._sums.to_numpy()
            now.misplaced = self._stored = np.array(sums)
            if row != -2:
                break
            self._store(np.concatenate([now.misplaced, np.resize(NO_SUMS, now.misplaced.shape)]))
        row = int(row)
        if row < 0:
            return
        slip, false, friction, largest, slip_now, false_now, *_, pair = now.misplaced[row].tolist()
        part = abs(false) / max(slip, MIN_STEPS * largest)
        if part > self.part:
            self.part = part
            is_event, is_false = MIN_STEPS * largest > slip, abs(false_now) > self.MAX_MISPLACED * slip_now
            if part > self.MAX_MISPLACED and is_false and not (is_event and self._share(row) < self.LEAST_SHARE):
                self.text = self._describe(*divmod(int(pair), n), slip, false, friction)

    def _share(self, row: int) -> float:
        """Return the part that a row has of the impulses of this step on its two bodies, that in which it has more."""
        n, sums = len(self._detection.scene.colliders), self._simulation.now.misplaced
        of, now = np.stack(np.divmod(sums[:, PAIR], n), axis=1), sums[:, IMPULSE]
        bodies = of[row][of[row] < len(self._detection.scene.bodies)]
        return max(float(now[row] / now[(of == body).any(axis=1)].sum()) for body in bodies)

    def _describe(self, a: int, b: int, slip: float, false: float, friction: float) -> str:
        """Return a sentence about colliders a and b and the sums of their contacts."""
        names = [f"'{self._detection.scene.colliders[k].name}'" for k in (a, b)]
        where = f"within {names[0]}" if a == b else f"between {names[0]} and {names[1]}"
        if abs(false) < friction:
            size = "large" if false < 0.0 else "small"
            return f"friction {where} may be {100.0 * abs(false) / friction:.2g} % too {size}: smaller steps"
        what = "drag" if false < 0.0 else "push"
        return f"{100.0 * abs(false) / slip:.2g} % of the contact force {where} may be a false {what}: smaller steps"
