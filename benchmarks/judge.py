"""Crossing surfaces of a simulator's present state, judged by ipctk rather than by taisoft's own search.

Judged are the surfaces of bodies, and of obstacles that have triangles, against each other and, with self-collision, against
themselves. Half-spaces, spheres and capsules have none: a body crosses them where a triangle comes closer than zero.
"""

import ipctk
import numpy as np

from taisoft import Simulator
from taisoft.scene.obstacles import Capsule, HalfSpace, Sphere


def close_pairs(x: np.ndarray, t: np.ndarray, padding: float = 1e-13) -> np.ndarray:
    """(k,2) triangles a < b that share no vertex and whose boxes overlap, up to `padding` [m]. x (v,3) [m], t (n,3)."""
    lo, hi = x[t].min(axis=1) - padding, x[t].max(axis=1) + padding
    order = np.argsort(lo[:, 0], kind="stable")
    ends = np.searchsorted(lo[order, 0], hi[order, 0], side="right")
    count = ends - np.arange(len(t)) - 1
    first = np.repeat(np.arange(len(t)), count)
    second = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count) + first + 1
    a, b = order[first], order[second]
    meet = ((lo[a] <= hi[b]) & (lo[b] <= hi[a])).all(axis=1)
    a, b = np.minimum(a, b)[meet], np.maximum(a, b)[meet]
    apart = ~(t[a][:, :, None] == t[b][:, None, :]).any(axis=(1, 2))
    pairs = np.stack([a[apart], b[apart]], axis=1)
    return pairs[np.lexsort(pairs.T[::-1])]


def pierces(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether an edge of one of two triangles, (3,) vertices each, pierces the other."""
    sides = ((x[a], x[b]), (x[b], x[a]))
    return any(ipctk.is_edge_intersecting_triangle(p[k], p[k - 1], *q) for p, q in sides for k in range(3))


class Judge:
    """Judge the states of one simulator."""

    def __init__(self, sim: Simulator, self_collision: bool):
        """self_collision: whether bodies are judged against themselves too."""
        self._sim, self._bodies = sim, sim.scene.bodies
        surfaces = [o.shape.surface() for o in sim.scene.obstacles]
        self._meshes = [(o, s[0]) for o, s in zip(sim.scene.obstacles, surfaces) if s is not None]
        self._shapes = [o for o in sim.scene.obstacles if isinstance(o.shape, (HalfSpace, Sphere, Capsule))]
        triangles = [b.nodes.surface for b in self._bodies] + [s[1] for s in surfaces if s is not None]
        sizes = [b.n_nodes for b in self._bodies] + [len(v) for _, v in self._meshes]
        starts = np.cumsum([0, *sizes])
        self._n_soft = int(starts[len(self._bodies)])
        every = np.concatenate([t + start for t, start in zip(triangles, starts)]).astype(np.int64)
        self._used, t = np.unique(every, return_inverse=True)
        self.triangles = t.reshape(-1, 3)  #: (n,3) of all judged surfaces
        owner = np.repeat(np.arange(len(triangles)), [len(t) for t in triangles])
        self._soft, self._owner, self._self = owner < len(self._bodies), owner, self_collision
        x = self.vertices()
        edges = ipctk.edges(self.triangles.astype(np.int32))
        self._mesh = ipctk.CollisionMesh(np.asfortranarray(x), edges, np.asfortranarray(self.triangles.astype(np.int32)))

    def vertices(self) -> np.ndarray:
        """The (v,3) vertices of all judged surfaces now [m]."""
        sim = self._sim
        return np.concatenate([sim.positions(), *(o.points_at(sim.time, v) for o, v in self._meshes)])[self._used]

    def crossings(self) -> int:
        """The number of pairs of triangles that cross now, and of triangles that cross a shape without triangles."""
        x, count = self.vertices(), 0
        if ipctk.has_intersections(self._mesh, np.asfortranarray(x)):
            count = sum(pierces(x, *self.triangles[[a, b]]) for a, b in close_pairs(x, self.triangles) if self._may_meet(a, b))
        return count + sum(int((d < 0.0).sum()) for d in self._shape_distances(x))

    def _may_meet(self, a: int, b: int) -> bool:
        one = self._owner[a] == self._owner[b]
        return bool(self._soft[a] or self._soft[b]) and not (one and not self._self)

    def least_distance(self, within: float) -> float:
        """The least distance [m] between surfaces that may meet, `within` if it is larger; edges and faces without a common
        vertex."""
        x = self.vertices()
        found, m = ipctk.Candidates(), self._mesh
        found.build(m, np.asfortranarray(x), inflation_radius=0.5 * within)
        owner, soft = np.zeros(len(x), dtype=np.int64), np.zeros(len(x), dtype=bool)
        owner[self.triangles], soft[self.triangles] = self._owner[:, None], self._soft[:, None]

        def meet(i: int, j: int) -> bool:
            return bool(soft[i] or soft[j]) and (self._self or owner[i] != owner[j])

        least = within**2
        for c in found.fv_candidates:
            face = m.faces[c.face_id]
            if meet(c.vertex_id, face[0]):
                least = min(least, ipctk.point_triangle_distance(x[c.vertex_id], *x[face]))
        for c in found.ee_candidates:
            one, other = m.edges[c.edge0_id], m.edges[c.edge1_id]
            if meet(one[0], other[0]):
                least = min(least, ipctk.edge_edge_distance(*x[one], *x[other]))
        return min([np.sqrt(least), *(float(d.min()) for d in self._shape_distances(x))])

    def _shape_distances(self, x: np.ndarray) -> list[np.ndarray]:
        """Distances [m] of the bodies' triangles from half-spaces, spheres and capsules, below 0 inside."""
        t, found = self.triangles[self._soft], []
        for obstacle in self._shapes:
            shape, time = obstacle.shape, self._sim.time
            if isinstance(shape, HalfSpace):
                point, tip = obstacle.points_at(time, np.stack([shape.point, shape.point + shape.normal]))
                found.append(((x[t] - point) @ (tip - point)).min(axis=1))
                continue
            ends = np.stack([shape.center] * 2 if isinstance(shape, Sphere) else [shape.a, shape.b])
            a, b = obstacle.points_at(time, ends)
            distances = np.array([_axis_distance(a, b, x[corners]) for corners in self._near(t, x, a, b, shape.radius)])
            found.append((distances if len(distances) else np.array([np.inf])) - shape.radius)
        return found

    @staticmethod
    def _near(t: np.ndarray, x: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
        """The triangles whose boxes come within twice the radius of the axis a b."""
        lo, hi = np.minimum(a, b) - 2.0 * radius, np.maximum(a, b) + 2.0 * radius
        return t[(x[t].min(axis=1) <= hi).all(axis=1) & (x[t].max(axis=1) >= lo).all(axis=1)]


def _axis_distance(a: np.ndarray, b: np.ndarray, corners: np.ndarray) -> float:
    """Distance [m] of the segment a b from a triangle of (3,3) corners."""
    if (a != b).any() and ipctk.is_edge_intersecting_triangle(a, b, *corners):
        return 0.0
    least = min(ipctk.point_triangle_distance(p, *corners) for p in (a, b))
    if (a != b).any():
        least = min(least, *(ipctk.edge_edge_distance(a, b, corners[k - 1], corners[k]) for k in range(3)))
    return float(np.sqrt(least))
