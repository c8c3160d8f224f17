"""Meshes of the scenes: those of the paper where they are at hand, otherwise equivalent ones, and surfaces of rigid obstacles."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import taisoft as ts
from taisoft.errors import MeshError

from .case import FULL

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "meshes"
BUNNY = Path(ts.__file__).resolve().parents[1] / "assets" / "bunny.msh"


def placed(mesh: ts.TetMesh, scale=1.0, turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)) -> ts.TetMesh:
    """The mesh scaled by a number or (3,), turned by angles about x, y, z [degrees] in this order, then shifted (3,) [m]."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True)
    return ts.TetMesh(rotation.apply(mesh.vertices * scale) + np.asarray(shift), mesh.tets)


def stored(name: str) -> ts.TetMesh | None:
    """The mesh shared/meshes/NAME.msh, None if it is absent."""
    path = SHARED / f"{name}.msh"
    return ts.read_mesh(path) if path.is_file() else None


def needed(name: str) -> ts.TetMesh:
    """A mesh as `stored`. Raises MeshError if it is absent."""
    mesh = stored(name)
    if mesh is None:
        raise MeshError(f"{name}.msh is not in {SHARED}, and no other mesh is equivalent")
    return mesh


def mat(size: str) -> ts.TetMesh:
    """A square mat of side 1 m in the x-z plane: 40 x 40 x 2 nodes, 8 mm thick, or in small 20 x 20 x 2, 13 mm thick."""
    n, thickness = (40, 0.008) if size == FULL else (20, 0.013)
    return stored(f"mat{n}x{n}") or ts.sheet_mesh((n - 1, n - 1), (1.0, thickness, 1.0))


def ball(size: str) -> ts.TetMesh:
    """A ball of diameter 1 m about the origin: 7,034 nodes, or in small 1,760."""
    return stored("sphere5K" if size == FULL else "sphere1K") or ts.ball_mesh(0.5, 18 if size == FULL else 10)


def bunny(size: str) -> ts.TetMesh:
    """A bunny, 3.1 m long, with its lowest point at y = -0.34 m: 4,670 nodes, or in small 852."""
    if size == FULL:
        return needed("bunny")
    mesh = ts.read_mesh(BUNNY)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return placed(
        mesh, 3.08 / (high - low).max(), shift=np.array([-0.336, 1.2, -0.028]) - (low + high) * 1.54 / (high - low).max()
    )


def joined(*surfaces: tuple[np.ndarray, np.ndarray]) -> ts.MeshObstacle:
    """One obstacle of several surfaces: vertices (n,3) [m] and triangles (t,3) each."""
    starts = np.cumsum([0, *(len(v) for v, _ in surfaces)])
    triangles = np.concatenate([t + start for (_, t), start in zip(surfaces, starts)])
    return ts.MeshObstacle(np.concatenate([v for v, _ in surfaces]), triangles)


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points (n,3) of a prism or tet as a closed surface. The points are vertices of their convex hull."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(points)
    t, middle = found.simplices.astype(np.int64), points.mean(axis=0)
    a, b, c = (points[t[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - middle) < 0.0
    t[inward] = t[inward][:, ::-1]
    return points, t


def revolved(profile: np.ndarray, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface that a closed profile makes when it turns about the x axis, with outward normals.

    profile: (k,2) x and radius [m], counter-clockwise with x to the right; a radius of 0 is a point on the axis. sides: of the
    circle.
    """
    angle = 2.0 * np.pi * np.arange(sides) / sides
    vertices, rings = [], []
    for x, radius in profile:
        start = sum(len(v) for v in vertices)
        count = sides if radius > 0.0 else 1
        vertices.append(np.stack([np.full(sides, x), radius * np.cos(angle), radius * np.sin(angle)], axis=1)[:count])
        rings.append(start + (np.arange(sides) if count > 1 else np.zeros(sides, dtype=int)))
    triangles = []
    for a, b in zip(rings, rings[1:] + rings[:1]):
        a_next, b_next = np.roll(a, -1), np.roll(b, -1)
        triangles += [np.stack([a, b, b_next], axis=1), np.stack([a, b_next, a_next], axis=1)]
    t = np.concatenate(triangles)
    area = (t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])
    return np.concatenate(vertices), t[area]


def cylinder(length: float, radius: float, sides: int = 36, cells: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface of a cylinder about the x axis, centred at the origin [m]. cells: along its length."""
    x = np.linspace(0.5 * length, -0.5 * length, cells + 1)
    rings = [(one, radius) for one in x]
    return revolved(np.array([(-0.5 * length, 0.0), (0.5 * length, 0.0), *rings]), sides)
