"""What it falsifies that a step uses the contact normals of its start.

The impulse r of a contact should act along the normal n' of the step's end, but acts along that of its start, n. If R turns n into
n', the force r - R r is misplaced. It matters as it brakes or drives the slip u of the step:
    W = sum (r - R r).u   against   S = sum |r| max(|u|, contact offset)
over the contacts of a pair. Sliding by D over a radius R makes W / S = D / R: friction seems larger by (1 + mu^2) D / R of the
normal force, or a body without friction drags. At a seam, the edge of the neighbouring box stops what should slide over it.
Where nothing slides the force follows from balance, whatever the normal, and W is 0.

A contact whose point has left the surface, over an edge or a corner, held until then and counts as right.

Both sums fade by FADING with every step in which the pair touches, and a step counts no more than a MIN_STEPS-th of all: one
impact on an edge may turn a force by 20 %, a slide over many steps by no more than 2 %.

Weak: the work of a force that is misplaced across the slip is 0; contacts with distance fields of bodies count as right.
"""

from typing import NamedTuple

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.contacts import EDGE_EDGE, FACE_FACE, VERTEX_FACE
from taisoft.collision.detector import Detection
from taisoft.collision.end_normals import normal_at_vertex, normal_of_edges, normal_on_shape
from taisoft.collision.passages import ADJACENT, N_FEATURES, N_KINDS, NEAR
from taisoft.collision.surface import dvec
from taisoft.contact.build import relative_velocity
from taisoft.contact.problem import ContactProblem, to_world
from taisoft.dynamics.simulation_state import SimulationState

MAX_MISPLACED = 0.02  # of a pair's contact force: more is reported
FADING, MIN_STEPS = 0.95, 10
LEFT = 0.5  # of the slip: distance beyond that of the linearised motion from which a point beside an edge has left the surface
SLIP_WORK, FALSE_WORK, FRICTION_WORK, LARGEST = range(4)  # columns of the sums: S, W, that of friction, largest S of a step


class Sums(NamedTuple):
    """Fading sums over steps: pairs (k,), first collider * n_colliders + second, ascending; values (k,4) [J s]."""

    pairs: np.ndarray
    values: np.ndarray


NO_SUMS = Sums(np.zeros(0, dtype=np.int64), np.zeros((0, 4)))


@ti.func
def _lowest(s: ti.template(), t):
    return ti.min(s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2])


@ti.func
def _lower_end(s: ti.template(), e):
    return ti.min(s.triangle[e // 3, e % 3], s.triangle[e // 3, (e % 3 + 1) % 3])


@ti.func
def _side(s: ti.template(), t, u, i, j):
    """1 if triangle t belongs to side a and u to side b of a contact, else -1; i, j: the lowest vertices of what meets."""
    return ti.select(s.body[t] < s.body[u] or (s.body[t] == s.body[u] and i <= j), ti.cast(1.0, ti.f64), ti.cast(-1.0, ti.f64))


@ti.func
def _end_normal(p: ti.template(), m: ti.template(), s: ti.template(), o: ti.template(), c, lasting):
    """Normal (3,) of contact c at the present positions, its gap [m], and whether its point lies on a smooth part of a surface.
    lasting: what the gap counts as where the normal does not change [m]."""
    kind, one, other, n = p.feature[c][0], p.feature[c][1], p.feature[c][2], p.normal[c]
    end, gap, is_smooth = n, lasting, True
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
    elif kind != FACE_FACE or one % N_KINDS != ADJACENT:
        if ti.static(o.any):
            x = dvec(0.0)
            for k in range(p.arity[c]):
                x += p.weight[c, k] * m.state.x[p.node[c, k]]
            v, d, flag = normal_on_shape(o, p.body[c][1], x)
            if v.dot(v) > 0.0:
                end, gap, is_smooth = v, d, flag
    if vertex >= 0:
        v, d, flag = normal_at_vertex(s, vertex, face)
        end, gap, is_smooth = side * v, d, flag
    if e >= 0:
        v, d, flag = normal_of_edges(s, e, f, side * n)
        end, gap, is_smooth = side * v, d, flag
    return end, gap, is_smooth


@kernel(cse=False)
def find_false_work(
    p: ti.template(),
    m: ti.template(),
    s: ti.template(),
    o: ti.template(),
    dt: ti.f64,
    least: ti.f64,
    n_colliders: ti.i32,
    pair: ti.types.ndarray(),
    work: ti.types.ndarray(),
):
    """Compute what each contact adds to S, W and the work of friction, work (k,3) [J s], of its pair (k,), at the end of a step of
    dt [s]. least [m]: the contact offset."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        n, r = p.normal[c], to_world(p, c, p.r[c])
        pair[c] = p.body[c][0] * n_colliders + p.body[c][1]
        u = dt * relative_velocity(p, m, c, dt)
        lasting, false = p.gap[c] + u.dot(n), dvec(0.0)
        slip = u - u.dot(n) * n
        across = r - r.dot(n) * n
        if r.dot(r) > 0.0 and slip.norm() > 0.01 * least:
            end, gap, is_smooth = _end_normal(p, m, s, o, c, lasting)
            if is_smooth or gap - lasting <= ti.cast(LEFT, ti.f64) * slip.norm():
                turned = across - end.dot(across) / ti.max(1.0 + n.dot(end), 1e-6) * (n + end)
                false = r.dot(n) * (n - end) + across - turned
        work[c, 0], work[c, 1] = r.norm() * ti.max(slip.norm(), least), false.dot(slip)
        work[c, 2] = ti.abs(across.dot(slip))


class Misplacement:
    """Contact forces of a simulation's pairs that the normals of steps' starts misplace."""

    def __init__(self, simulation: SimulationState, detection: Detection):
        self._simulation, self._detection = simulation, detection
        self.sums = self._start = NO_SUMS
        self.forget()

    def forget(self) -> None:
        """Discard all sums, after a state was set."""
        self.sums = self._start = NO_SUMS
        self.start_step()

    def start_step(self) -> None:
        """Begin a step."""
        self.part, self.text, self._start = 0.0, "", self.sums  # largest misplaced part, and a sentence if that is too much

    def return_to_start(self) -> None:
        """Discard what was added since the step began."""
        self.sums = self._start
        self.start_step()

    def add(self, p: ContactProblem, dt: float, contact_offset: float) -> None:
        """Add a substep of dt [s], whose end was searched last."""
        k, d, n = int(p.count[0]), self._detection, len(self._detection.scene.colliders)
        pair, work = np.zeros(k, dtype=np.int32), np.zeros((k, 3))
        find_false_work(p, self._simulation.model, d.surface, d.shapes, dt, contact_offset, n, pair, work)
        loaded = work[:, 0] > 0.0
        if not loaded.any():
            return
        present, at = np.unique(pair[loaded], return_inverse=True)
        new = np.stack([np.bincount(at, work[loaded, q], len(present)) for q in (0, 1, 2, 0)], axis=1)
        pairs = np.union1d(self.sums.pairs, present)
        values, touching = np.zeros((len(pairs), 4)), np.searchsorted(pairs, present)
        values[np.searchsorted(pairs, self.sums.pairs)] = self.sums.values
        old = FADING * values[touching]
        values[touching] = np.where(np.arange(4) == LARGEST, np.maximum(old, new), old + new)
        self.sums = Sums(pairs, values)
        slipped = np.maximum(values[touching, SLIP_WORK], MIN_STEPS * values[touching, LARGEST])
        parts = np.abs(values[touching, FALSE_WORK]) / slipped
        worst = int(parts.argmax())
        if parts[worst] > self.part:
            self.part = float(parts[worst])
            if self.part > MAX_MISPLACED:
                self.text = self._describe(*divmod(int(present[worst]), n), *values[touching[worst]])

    def _describe(self, a: int, b: int, slip: float, false: float, friction: float, _largest: float) -> str:
        """Return a sentence about a pair of colliders and its sums."""
        names = [f"'{self._detection.scene.colliders[k].name}'" for k in (a, b)]
        where = f"within {names[0]}" if a == b else f"between {names[0]} and {names[1]}"
        if abs(false) < friction:
            size = "large" if false < 0.0 else "small"
            return f"friction {where} may be {100.0 * abs(false) / friction:.2g} % too {size}: smaller steps"
        what = "drag" if false < 0.0 else "push"
        return f"{100.0 * abs(false) / slip:.2g} % of the contact force {where} may be a false {what}: smaller steps"
