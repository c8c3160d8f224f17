"""Models the bunny of the demos: `python assets/make_bunny.py` (half a minute, extra `mesh`) writes assets/bunny.msh.

A smooth union of spheres and capsules, its zero level as triangles, and those filled with tets. Metres, y up; it looks along x
and stands on y = 0.
"""

from itertools import permutations
from pathlib import Path

import numpy as np

import taisoft as ts

BLEND = 0.07  # [m]: width of the smooth joints
CELL = 0.035  # [m] of the grid on which the level is found
EDGE = 0.085  # [m] of the tets
PARTS = [  # ends of a capsule (a sphere where both are one) and its radius [m]
    ((-0.06, 0.27, 0.0), (0.02, 0.33, 0.0), 0.27),  # body
    ((0.06, 0.50, 0.0), (0.10, 0.58, 0.0), 0.16),  # chest
    ((0.14, 0.80, 0.0), (0.18, 0.80, 0.0), 0.175),  # head
    ((0.33, 0.74, 0.0), (0.33, 0.74, 0.0), 0.07),  # snout
    ((0.06, 0.98, 0.09), (-0.02, 1.48, 0.15), 0.055),  # ears
    ((0.06, 0.98, -0.09), (-0.02, 1.48, -0.15), 0.055),
    ((-0.36, 0.22, 0.0), (-0.36, 0.22, 0.0), 0.09),  # tail
    ((0.12, 0.06, 0.17), (0.28, 0.06, 0.17), 0.06),  # feet
    ((0.12, 0.06, -0.17), (0.28, 0.06, -0.17), 0.06),
    ((0.20, 0.36, 0.11), (0.30, 0.24, 0.10), 0.05),  # paws
    ((0.20, 0.36, -0.11), (0.30, 0.24, -0.10), 0.05),
]


def distance(x: np.ndarray) -> np.ndarray:
    """(n,) signed distance [m] to the bunny, about, of points x (n,3); negative inside."""
    found = None
    for a, b, radius in PARTS:
        a, along = np.array(a), np.subtract(b, a)
        s = np.clip((x - a) @ along / max(along @ along, 1e-30), 0.0, 1.0)
        one = np.linalg.norm(x - a - s[:, None] * along, axis=1) - radius
        if found is None:
            found = one
            continue
        mix = np.clip(0.5 + 0.5 * (found - one) / BLEND, 0.0, 1.0)
        found = mix * one + (1.0 - mix) * found - BLEND * mix * (1.0 - mix)
    return np.maximum(found, -x[:, 1])  # flat below


def zero_level(low: tuple, high: tuple) -> ts.SurfaceMesh:
    """The level as triangles: each cell of a grid is cut into six tets, and each tet by the plane through its zeros."""
    counts = np.ceil(np.subtract(high, low) / CELL).astype(int) + 1
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1)
    points = np.array(low) + CELL * grid.reshape(-1, 3)
    index = np.arange(len(points)).reshape(counts)
    inner = index[:-1, :-1, :-1].ravel()
    steps = index[1, 0, 0] - index[0, 0, 0], index[0, 1, 0] - index[0, 0, 0], 1
    corners = np.array([np.cumsum([0, *order]) for order in permutations(steps)])
    tets = (inner[:, None, None] + corners).reshape(-1, 4)
    value = distance(points)
    value[value == 0.0] = 1e-12
    tets = np.take_along_axis(tets, np.argsort(value[tets] > 0, axis=1, kind="stable"), axis=1)  # those inside first
    n_inside = (value[tets] < 0).sum(axis=1)
    cuts = {1: [[(0, 1), (0, 2), (0, 3)]], 3: [[(0, 3), (1, 3), (2, 3)]], 2: [[(0, 2), (0, 3), (1, 3)], [(0, 2), (1, 3), (1, 2)]]}
    parts, outward = [], []
    for n, triangles in cuts.items():
        of = tets[n_inside == n]
        way = points[of[:, n:]].mean(axis=1) - points[of[:, :n]].mean(axis=1)
        for triangle in triangles:
            ends = np.stack([of[:, pair] for pair in triangle], axis=1)  # (t, 3, 2)
            parts.append(np.sort(ends, axis=2))
            outward.append(way)
    ends, where = np.unique(np.concatenate(parts).reshape(-1, 2), axis=0, return_inverse=True)
    share = value[ends[:, 0]] / (value[ends[:, 0]] - value[ends[:, 1]])
    x = points[ends[:, 0]] + share[:, None] * (points[ends[:, 1]] - points[ends[:, 0]])
    triangles = where.reshape(-1, 3)
    a, b, c = np.moveaxis(x[triangles], 1, 0)
    turned = np.einsum("ti,ti->t", np.cross(b - a, c - a), np.concatenate(outward)) < 0
    triangles[turned] = triangles[turned][:, ::-1]
    return ts.SurfaceMesh(x, triangles, "bunny")


def main() -> None:
    """Writes bunny.msh beside this file."""
    mesh = ts.tetrahedralize(zero_level((-0.6, -0.1, -0.45), (0.55, 1.65, 0.45)), EDGE, 0.1 * EDGE)
    vertices = mesh.vertices - (0.0, mesh.vertices[:, 1].min(), 0.0)
    path = Path(__file__).resolve().parent / "bunny.msh"
    ts.write_mesh(path, ts.TetMesh(np.round(vertices, 6), mesh.tets))
    print(f"{path}: {mesh}, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
