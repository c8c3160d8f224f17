"""Contact points as the report's first program found them: interpreted Python, one pair of triangles after the other.

Each of two triangles whose boxes meet goes to the material space of the other's tet, by the barycentric coordinates of its
corners there, and Frank-Wolfe with steps 2 / (i + 2) looks for its deepest point in the signed distances at rest (report, section
2.3.2). Weak, as there: a tet far from the triangle maps it all the same, so most points are found many times.
The pairs, distances and places are those of a `Rig`, so that both do the same work; here nothing is compiled.
"""

import numpy as np

from taisoft.collision.colliders import body_grid
from taisoft.mesh.sdf import SdfGrid

from ..collision_runs import Rig

STEPS, CLOSED = 32, 1e-4  # of Frank-Wolfe at most; gap, in lengths of the triangle, at which it ends


def candidate_pairs(rig: Rig) -> np.ndarray:
    """(k, 2) triangles of two bodies whose boxes meet, each pair once."""
    rows, n = rig.detection.broad.find(), rig.detection.surface.n_triangles
    start, end, entry = (field.to_numpy() for field in (rows.start, rows.end, rows.entry))
    own = np.repeat(np.arange(n), (end - start)[:n])
    other = np.concatenate([entry[a:b] for a, b in zip(start[:n], end[:n])]) if len(own) else np.zeros(0, int)
    body = rig.detection.topology.body
    return np.column_stack([own, other])[(own < other) & (body[own] != body[other])]


def sample(grid: SdfGrid, X: np.ndarray) -> tuple[float, np.ndarray]:
    """Signed distance [m] and its gradient (3,) at a material point (3,), trilinear; outside of the grid, at its border."""
    at = np.clip((X - grid.origin) / grid.spacing, 0.0, np.array(grid.phi.shape) - 1.0)
    i = np.minimum(at.astype(int), np.array(grid.phi.shape) - 2)
    u, v, w = at - i
    f = grid.phi[i[0] : i[0] + 2, i[1] : i[1] + 2, i[2] : i[2] + 2]
    a = f[0] * (1 - u) + f[1] * u
    b = a[0] * (1 - v) + a[1] * v
    along_x = ((f[1] - f[0])[0] * (1 - v) + (f[1] - f[0])[1] * v) @ (1 - w, w)
    along_y = (a[1] - a[0]) @ (1 - w, w)
    return float(b @ (1 - w, w)), np.array([along_x, along_y, b[1] - b[0]]) / grid.spacing


def deepest_point(grid: SdfGrid, corners: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights (3,) and signed distance [m] of the deepest point that Frank-Wolfe finds in a triangle (3,3) of material points."""
    values = [sample(grid, X)[0] for X in corners]
    w = np.eye(3)[int(np.argmin(values))]
    best, least = w, min(values)
    size = max(np.linalg.norm(corners[k] - corners[k - 1]) for k in range(3))
    for i in range(STEPS):
        phi, gradient = sample(grid, w @ corners)
        if phi < least:
            best, least = w, phi
        slope = corners @ gradient
        k = int(np.argmin(slope))
        if w @ slope - slope[k] <= CLOSED * size:
            break
        w = w + 2.0 / (i + 2.0) * (np.eye(3)[k] - w)
    return best, least


class PlainPoints:
    """Contact points of a rig's pairs by the plain loop."""

    def __init__(self, rig: Rig):
        d = rig.detection
        self._rig, self._body, self._triangle = rig, d.topology.body, d.topology.triangle
        bodies = rig.scene.bodies
        self._grids = [body_grid(b, rig.scene.collision.field_cells, 2.0 * d.margin) for b in bodies]
        starts = np.cumsum([0] + [b.n_nodes for b in bodies])
        self._behind = np.concatenate([b.nodes.surface_tets + n for b, n in zip(bodies, starts)])
        self._rest = np.concatenate([b.nodes.positions for b in bodies])

    def find(self, pairs: np.ndarray) -> list[tuple[int, int, np.ndarray, float]]:
        """(triangle, the other, weights (3,), signed distance [m]) of each whose deepest point is nearer than the margin."""
        x, margin, found = self._rig.model.state.x.to_numpy(), self._rig.detection.margin, []
        surface = x[self._rig.detection.topology.node]
        for pair in pairs:
            for t, u in (pair, pair[::-1]):
                tet = self._behind[u]
                world = np.vstack([x[tet].T, np.ones(4)])  # of barycentric coordinates: corners, and their sum
                weights = np.linalg.solve(world, np.vstack([surface[self._triangle[t]].T, np.ones(3)]))
                w, phi = deepest_point(self._grids[self._body[u]], weights.T @ self._rest[tet])
                if phi <= margin:
                    found.append((int(t), int(u), w, phi))
        return found
