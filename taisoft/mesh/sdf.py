"""Grids of exact signed distances from a closed surface, see `distances.py`, cached on disk under the SHA-256 of their inputs.

A damaged file is computed again; if the folder is not writable, nothing is cached.
"""

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taisoft.errors import MeshError, OutputError
from taisoft.files import cache_folders, replacing
from taisoft.mesh.distances import signed_distances

FORMAT = 1  # version of cached grids; increase it when their numbers or meaning change
MIN_CELLS = 8  # smallest number of cells across a side
MIN_PADDING = 2  # cells beyond the surface on every side
MAX_POINTS = 2_000_000  # default limit on the number of grid points
_ROUNDING = 1e-9  # fraction of a cell ignored when the number of cells is rounded up


@dataclass(frozen=True, eq=False)
class SdfGrid:
    """Signed distances at the points origin + (i, j, k) * spacing. Arrays are read-only."""

    origin: np.ndarray  # (3,) [m]
    spacing: np.ndarray  # (3,) [m]
    phi: np.ndarray  # (nx,ny,nz) float64 [m], negative inside

    def __post_init__(self):
        for array in (self.origin, self.spacing, self.phi):
            array.setflags(write=False)


def sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = MAX_POINTS, margin: float = 0.0
) -> SdfGrid:
    """Compute exact signed distances on a grid around a closed surface.

    vertices: (n,3) [m]. triangles: (t,3) int, normals outward; every edge has two. cells: along the longest side; other
    sides get cells of about that size, but at least 8. max_points: limit on the number of grid points. margin: minimum
    distance [m] from the surface to the grid's border, which is at least two cells. Raises MeshError for an open surface,
    triangles without area, and a grid above max_points.
    """
    vertices, triangles = _arrays(vertices, triangles)
    origin, spacing, shape = _layout(vertices[np.unique(triangles)], cells, max_points, margin)
    axes = [origin[a] + spacing[a] * np.arange(shape[a]) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return SdfGrid(origin, spacing, signed_distances(vertices, triangles, points).reshape(shape))


def cached_sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = MAX_POINTS, margin: float = 0.0
) -> SdfGrid:
    """Return `sdf_grid` of the same arguments, read from the cache or computed and stored there."""
    vertices, triangles = _arrays(vertices, triangles)
    origin, spacing, shape = _layout(vertices[np.unique(triangles)], cells, max_points, margin)
    inputs = f"{FORMAT} {len(vertices)} {len(triangles)} {int(cells)} {float(margin).hex()}\n".encode()
    path = cache_folder() / f"{hashlib.sha256(inputs + vertices.tobytes() + triangles.tobytes()).hexdigest()}.npz"
    with suppress(Exception):  # a damaged archive raises many kinds of errors, some from the decompression modules
        # Open here, because np.load leaves an unreadable file open.
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            phi = file["phi"]
        if phi.shape == shape and phi.dtype == np.float64 and np.isfinite(phi).all():
            return SdfGrid(origin, spacing, phi)
    grid = sdf_grid(vertices, triangles, cells, max_points, margin)
    with suppress(OSError, OutputError):  # the folder is not writable
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, open(part, "wb") as file:
            np.savez(file, phi=grid.phi)
    return grid


def cache_folder() -> Path:
    """Return the folder of cached grids."""
    return next(cache_folders(), Path(os.devnull)) / "sdf"  # os.devnull cannot contain files


def _arrays(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(triangles, dtype=np.int64)


def _layout(vertices: np.ndarray, cells: int, max_points: int, margin: float):
    """Return origin (3,) [m], spacing (3,) [m] and shape of the grid of `sdf_grid` around vertices (n,3) [m]."""
    low, side = vertices.min(axis=0), np.ptp(vertices, axis=0)
    if not side.min() > 0:
        raise MeshError("sdf_grid: the surface is flat and has no inside")
    n_cells = np.maximum(np.ceil(side / (side.max() / cells) - _ROUNDING), MIN_CELLS)
    spacing = side / n_cells
    pad = np.maximum(np.ceil(margin / spacing - _ROUNDING), MIN_PADDING)
    shape = tuple(int(n) for n in n_cells + 2 * pad + 1)
    count = int(np.prod(shape, dtype=object))
    if count > max_points:
        raise MeshError(
            f"sdf_grid: {cells} cells along the longest side and a margin of {margin:g} m need {count} points "
            f"({' x '.join(map(str, shape))}); at most {max_points} are allowed"
        )
    return low - pad * spacing, spacing, shape
