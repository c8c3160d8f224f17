"""Crossing surfaces of a simulator's present state, judged by ipctk rather than by taisoft's own search.

Judged are the surfaces of bodies, and of obstacles that have triangles, against each other and, with self-collision, against
themselves; not those of bodies attached to each other exactly, which share nodes and do not collide. Surfaces cross where an
edge pierces a triangle with which it shares no vertex; ipctk says whether any does, and exact determinants, which. Half-spaces,
spheres and capsules have no triangles: a body crosses them where a triangle comes closer than zero. A surface that lies wholly
inside another one has crossed it before, and counts too.

Weakness: only states are judged, so a body that passes another one completely within one step is not noticed; nor is one that
sinks into another so symmetrically that edges only meet edges and planes.
"""

from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction

import ipctk
import numpy as np

from taisoft import Simulator
from taisoft.mesh.distances import winding_numbers
from taisoft.mesh.solids import connected_parts
from taisoft.scene.obstacles import Capsule, HalfSpace, Sphere

DET_ERROR = 1e-15  # bound of the rounding error of a determinant, relative to the sum of its absolute terms
ROUNDING = 1e-15  # of a distance from a shape, relative to the largest coordinate


def close_pairs(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """(k,2) indices a < b of the boxes that overlap or touch. lo, hi: their corners (n,3) [m]."""
    axis = int(np.argmax(np.ptp(lo, axis=0))) if len(lo) else 0
    order = np.argsort(lo[:, axis], kind="stable")
    ends = np.searchsorted(lo[order, axis], hi[order, axis], side="right")
    count = ends - np.arange(len(lo)) - 1
    first = np.repeat(np.arange(len(lo)), count)
    second = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count) + first + 1
    a, b = order[first], order[second]
    meet = ((lo[a] <= hi[b]) & (lo[b] <= hi[a])).all(axis=1)
    pairs = np.sort(np.stack([a[meet], b[meet]], axis=1), axis=1)
    return pairs[np.lexsort(pairs.T[::-1])]


def orientation(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Exact signs (n,) of det(a - d, b - d, c - d) for points (n,3): 1 where d is below the plane in which a, b, c turn left."""
    u, v, w = a - d, b - d, c - d
    left, right = (v[:, [1, 2, 0]] * w[:, [2, 0, 1]], v[:, [2, 0, 1]] * w[:, [1, 2, 0]])
    found = (u * (left - right)).sum(axis=1)
    unsure = np.abs(found) <= DET_ERROR * (np.abs(u) * (np.abs(left) + np.abs(right))).sum(axis=1)
    signs = np.sign(found)
    for k in np.flatnonzero(unsure):
        p, q, r, s = ([Fraction(float(value)) for value in point[k]] for point in (a, b, c, d))
        u, v, w = ([one - other for one, other in zip(point, s)] for point in (p, q, r))
        exact = sum(u[i] * (v[i - 2] * w[i - 1] - v[i - 1] * w[i - 2]) for i in range(3))
        signs[k] = (exact > 0) - (exact < 0)
    return signs


def pierces(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether (n,) an edge of one of two triangles pierces the interior of the other and shares no vertex with it.

    x: vertices (v,3) [m]. a, b: triangles (n,3). Exact: triangles that only touch do not pierce each other, nor do those in one
    plane.
    """
    found = np.zeros(len(a), dtype=bool)
    for p, t in ((a, b), (b, a)):
        for k in range(3):
            i, j = p[:, k], p[:, k - 1]
            left = np.flatnonzero(~found & ~((t == i[:, None]) | (t == j[:, None])).any(axis=1))
            e, f = x[i[left]], x[j[left]]
            q, r, s = (x[t[left, n]] for n in range(3))
            apart = orientation(q, r, s, e) * orientation(q, r, s, f) < 0.0
            left, (e, f, q, r, s) = left[apart], (one[apart] for one in (e, f, q, r, s))
            turns = [orientation(e, f, *side) for side in ((q, r), (r, s), (s, q))]
            found[left] = (np.abs(np.sum(turns, axis=0)) == 3.0) if len(left) else False
    return found


def triangle_distance(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Least distance [m] of a vertex or edge of one of two triangles, (3,) vertices each, from those of the other with which it
    shares none; inf without any."""
    least = np.inf
    for p, q in ((a, b), (b, a)):
        least = min([least, *(ipctk.point_triangle_distance(x[i], *x[q]) for i in p if i not in q)])
    for i, j in ((a[k - 1], a[k]) for k in range(3)):
        for k, l in ((b[n - 1], b[n]) for n in range(3)):
            if not {i, j} & {k, l}:
                least = min(least, ipctk.edge_edge_distance(x[i], x[j], x[k], x[l]))
    return float(np.sqrt(least))


def separation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How far (n,) [m] triangles of (n,3,3) corners must move to part; 0 if they are apart. By separating axes."""
    ea, eb = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    across = np.cross(ea[:, :, None], eb[:, None]).reshape(-1, 9, 3)
    axes = np.concatenate([np.cross(ea[:, :1], ea[:, 1:2]), np.cross(eb[:, :1], eb[:, 1:2]), across], axis=1)
    length = np.linalg.norm(axes, axis=2, keepdims=True)
    axes = np.divide(axes, length, out=np.zeros_like(axes), where=length > 0.0)
    pa, pb = a @ axes.transpose(0, 2, 1), b @ axes.transpose(0, 2, 1)
    width = np.minimum(pa.max(axis=1) - pb.min(axis=1), pb.max(axis=1) - pa.min(axis=1))
    return np.where(length[:, :, 0] > 0.0, width, np.inf).min(axis=1).clip(0.0)


@dataclass
class Crossings:
    """Crossings of a state: their number by the names of both sides, a body's own with its name twice, and the largest depth [m]:
    how far triangles must move to part, or how deep one is in a half-space, sphere or capsule."""

    names: Counter[tuple[str, str]] = field(default_factory=Counter)
    depth: float = 0.0

    @property
    def count(self) -> int:
        """The number of all crossings."""
        return self.names.total()


class Judge:
    """Judge the states of one simulator."""

    def __init__(self, sim: Simulator, self_collision: bool):
        """self_collision: whether bodies are judged against themselves too."""
        self._sim, bodies, self._self = sim, sim.scene.bodies, self_collision
        surfaces = [o.shape.surface() for o in sim.scene.obstacles]
        self._meshes = [(o, s[0]) for o, s in zip(sim.scene.obstacles, surfaces) if s is not None]
        self._shapes = [o for o in sim.scene.obstacles if isinstance(o.shape, (HalfSpace, Sphere, Capsule))]
        triangles = [b.nodes.surface for b in bodies] + [s[1] for s in surfaces if s is not None]
        starts = np.cumsum([0, *(b.n_nodes for b in bodies), *(len(v) for _, v in self._meshes)])
        every = np.concatenate([t + start for t, start in zip(triangles, starts)]).astype(np.int64)
        self._used, t = np.unique(every, return_inverse=True)
        self.triangles = t.reshape(-1, 3)  #: (n,3) of all judged surfaces
        self._names = [one.name for one in (*bodies, *(o for o, _ in self._meshes))]
        self._owner = np.repeat(np.arange(len(triangles)), [len(t) for t in triangles])
        self._of = [np.flatnonzero(self._owner == k) for k in range(len(triangles))]
        self._n_soft = len(bodies)
        self._attached = {frozenset((one.a, one.b)) for one in sim.scene.exact_attachments}
        x, faces = self.vertices(), np.asfortranarray(self.triangles.astype(np.int32))
        self._mesh = ipctk.CollisionMesh(np.asfortranarray(x), ipctk.edges(faces), faces)
        parts = connected_parts(self.triangles)
        self._components = [[np.unique(self.triangles[own][parts[own] == k]) for k in np.unique(parts[own])] for own in self._of]
        self._solid = [self._is_solid(x, own) for own in self._of]

    def _is_solid(self, x: np.ndarray, own: np.ndarray) -> bool:
        """Whether triangles bound a volume from outside."""
        t = self.triangles[own]
        half = np.sort(t[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        closed = (np.unique(half, axis=0, return_counts=True)[1] == 2).all()
        return bool(closed and np.linalg.det(x[t] - x[t[0, 0]]).sum() > 0.0)

    def _are_attached(self, a: str, b: str) -> bool:
        """Whether two bodies, or a body and an obstacle, are attached to each other exactly."""
        return frozenset((a, b)) in self._attached

    def vertices(self) -> np.ndarray:
        """The (v,3) vertices of all judged surfaces now [m]."""
        sim = self._sim
        return np.concatenate([sim.positions(), *(o.points_at(sim.time, v) for o, v in self._meshes)])[self._used]

    def crossings(self) -> int:
        """The number of pairs of triangles that cross now, of triangles that cross a shape without triangles, and of surfaces
        wholly inside another one."""
        return self.find().count

    def find(self) -> Crossings:
        """The crossings of the present state."""
        x, found = self.vertices(), Crossings()
        if ipctk.has_intersections(self._mesh, np.asfortranarray(x)):
            pairs = self._close(x, 0.0)
            pairs = pairs[pierces(x, *self.triangles[pairs.T])]
            found.names.update((self._names[a], self._names[b]) for a, b in self._owner[pairs])
            found.depth = float(separation(*x[self.triangles[pairs.T]]).max(initial=0.0))
        for obstacle in self._shapes:
            distances = self._shape_distances(x, obstacle) + ROUNDING * np.abs(x).max()
            found.depth = max(found.depth, -float(distances.min()))
            for k in range(self._n_soft):
                inside = int((distances[self._of[k]] < 0.0).sum())
                if inside and not self._are_attached(self._names[k], obstacle.name):
                    found.names[self._names[k], obstacle.name] += inside
        if not found.names:
            found.names = self._enclosed(x)
        return found

    def _close(self, x: np.ndarray, padding: float) -> np.ndarray:
        """(k,2) triangles that may cross and whose boxes, padded on each side [m], overlap."""
        lo, hi = (pick(x[self.triangles], axis=1) + off for pick, off in ((np.min, -padding), (np.max, padding)))
        low = np.array([lo[own].min(axis=0) for own in self._of])
        high = np.array([hi[own].max(axis=0) for own in self._of])
        pairs = [np.empty((0, 2), dtype=np.int64)]
        for a, b in close_pairs(low, high):
            if a < self._n_soft and not self._are_attached(self._names[a], self._names[b]):
                p, q = (o[((lo[o] <= high[c]) & (hi[o] >= low[c])).all(axis=1)] for o, c in ((self._of[a], b), (self._of[b], a)))
                both = np.concatenate([p, q])
                near = close_pairs(lo[both], hi[both])
                near = near[(near[:, 0] < len(p)) & (near[:, 1] >= len(p))]
                pairs.append(both[near])
        for own in self._of[: self._n_soft if self._self else 0]:
            pairs.append(own[close_pairs(lo[own], hi[own])])
        return np.concatenate(pairs)

    def _enclosed(self, x: np.ndarray) -> Counter[tuple[str, str]]:
        """Components and shapes wholly inside a surface that they may not cross, where nothing crosses now."""
        points = [(k, self._names[k], x[own]) for k, parts in enumerate(self._components) for own in parts]
        far = len(self._of)  # beyond all owners of triangles
        points += [(far, o.name, self._axis(o)) for o in self._shapes if not isinstance(o.shape, HalfSpace)]
        found = Counter()
        for k in filter(self._solid.__getitem__, range(len(self._of))):
            corners = x[self.triangles[self._of[k]]]
            lo, hi = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
            for j, name, part in points:
                may_touch = j != k and min(j, k) < self._n_soft and not self._are_attached(name, self._names[k])
                if may_touch and (part > lo).all() and (part < hi).all():
                    found[name, self._names[k]] += winding_numbers(corners, part[:1])[0] > 0.5
        return +found

    def inside(self) -> int:
        """The number of vertices around which a closed surface of another body or obstacle, that they may not cross, winds.

        Where nothing has got through anything there are none, even if surfaces cross themselves."""
        x, found = self.vertices(), 0
        for k in filter(self._solid.__getitem__, range(len(self._of))):
            corners = x[self.triangles[self._of[k]]]
            lo, hi = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
            for j, parts in enumerate(self._components):
                if j != k and min(j, k) < self._n_soft and not self._are_attached(self._names[j], self._names[k]):
                    points = x[np.concatenate(parts)]
                    near = points[((points > lo) & (points < hi)).all(axis=1)]
                    found += int((np.abs(winding_numbers(corners, near)) > 0.5).sum())
        return found

    def least_distance(self, within: float) -> float:
        """The least distance [m] between surfaces that may meet, `within` if it is larger; of vertices and edges from faces and
        edges without a common vertex. Below 0: how deep a vertex is in a half-space, or a triangle in a sphere or capsule."""
        x = self.vertices()
        pairs = (triangle_distance(x, *self.triangles[[a, b]]) for a, b in self._close(x, 0.5 * within))
        shapes = (float(self._shape_distances(x, obstacle).min()) for obstacle in self._shapes)
        return min([within, *pairs, *shapes])

    def _axis(self, obstacle) -> np.ndarray:
        """The (2,3) ends of a capsule's axis now, both the center of a sphere [m]."""
        shape = obstacle.shape
        return obstacle.points_at(
            self._sim.time, np.stack([shape.center] * 2 if isinstance(shape, Sphere) else [shape.a, shape.b])
        )

    def _shape_distances(self, x: np.ndarray, obstacle) -> np.ndarray:
        """Distances (n,) [m] of triangles from a half-space, sphere or capsule, below 0 inside; inf for far ones and those of
        obstacles."""
        shape, found = obstacle.shape, np.full(len(self.triangles), np.inf)
        soft = np.flatnonzero(self._owner < self._n_soft)
        corners = x[self.triangles[soft]]
        if isinstance(shape, HalfSpace):
            point, tip = obstacle.points_at(self._sim.time, np.stack([shape.point, shape.point + shape.normal]))
            found[soft] = ((corners - point) @ (tip - point)).min(axis=1)
            return found
        a, b = self._axis(obstacle)
        lo, hi = np.minimum(a, b) - 2.0 * shape.radius, np.maximum(a, b) + 2.0 * shape.radius
        near = (corners.min(axis=1) <= hi).all(axis=1) & (corners.max(axis=1) >= lo).all(axis=1)
        found[soft[near]] = [axis_distance(a, b, one) - shape.radius for one in corners[near]]
        return found


def axis_distance(a: np.ndarray, b: np.ndarray, corners: np.ndarray) -> float:
    """Distance [m] of the segment a b, or point if both are equal, from a triangle of (3,3) corners."""
    if (a == b).all():
        return float(np.sqrt(ipctk.point_triangle_distance(a, *corners)))
    if ipctk.is_edge_intersecting_triangle(a, b, *corners):
        return 0.0
    ends = (ipctk.point_triangle_distance(p, *corners) for p in (a, b))
    return float(np.sqrt(min(*ends, *(ipctk.edge_edge_distance(a, b, corners[k - 1], corners[k]) for k in range(3)))))
