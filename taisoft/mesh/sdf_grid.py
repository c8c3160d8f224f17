"""Compute and cache signed distance grids of bodies at rest; the cell size adapts to the extent along each axis.

Grids are cached on disk under the SHA-256 of their inputs. A damaged file is computed again; if the folder is not writable,
nothing is cached.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taisoft.errors import MeshError
from taisoft.files import cache_folders
from taisoft.mesh.signed_distance import signed_distances

FORMAT = 1  # version of cached grids; increase it when their numbers or meaning change
MIN_CELLS = 8  # smallest number of cells across a side
MIN_PADDING = 2  # cells beyond the surface on every side
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


def grid_points(vertices: np.ndarray, cells: int, margin: float) -> tuple[np.ndarray, np.ndarray, tuple[int, int, int]]:
    """Return origin (3,) [m], spacing (3,) [m] and shape of the grid of `sdf_grid` around vertices (n,3) [m]."""
    low, side = vertices.min(axis=0), np.ptp(vertices, axis=0)
    n_cells = np.maximum(np.ceil(side / (side.max() / cells) - _ROUNDING), MIN_CELLS)
    spacing = side / n_cells
    pad = np.maximum(np.ceil(margin / spacing - _ROUNDING), MIN_PADDING)
    shape = tuple(int(n) for n in n_cells + 2 * pad + 1)
    return low - pad * spacing, spacing, shape


def sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = 2_000_000, margin: float = 0.0
) -> SdfGrid:
    """Compute exact signed distances on a grid around a closed surface.

    vertices: (n,3) [m]. triangles: (t,3) int, normals outward; every edge has two. cells: along the longest side; other
    sides get cells of about that size, but at least 8. max_points: limit on the number of grid points. margin: minimum
    distance [m] from the surface to the grid's border, which is at least two cells. Raises MeshError for an open surface,
    triangles without area, and a grid above max_points.
    """
    vertices, triangles = _arrays(vertices, triangles)
    used = vertices[np.unique(triangles)]
    if not np.ptp(used, axis=0).min() > 0:
        raise MeshError("sdf_grid: the surface is flat and has no inside")
    origin, spacing, shape = grid_points(used, cells, margin)
    count = int(np.prod(shape, dtype=object))
    if count > max_points:
        raise MeshError(
            f"sdf_grid: {cells} cells along the longest side and a margin of {margin:g} m need {count} points "
            f"({' x '.join(map(str, shape))}); at most {max_points} are allowed"
        )
    axes = [origin[a] + spacing[a] * np.arange(shape[a]) for a in range(3)]
    return SdfGrid(origin, spacing, signed_distances(vertices, triangles, axes))


def cached_sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = 2_000_000, margin: float = 0.0
) -> SdfGrid:
    """Return `sdf_grid` of the same arguments, read from the cache or computed and stored there."""
    vertices, triangles = _arrays(vertices, triangles)
    path = cache_folder() / f"{_key(vertices, triangles, cells, margin)}.npz"
    grid = _read(path)
    # Ignore an intact file that does not match its name or exceeds max_points.
    if grid is None or not _matches(grid, vertices[np.unique(triangles)], cells, margin) or grid.phi.size > max_points:
        grid = sdf_grid(vertices, triangles, cells, max_points, margin)
        _write(path, grid)
    return grid


def cache_folder() -> Path:
    """Return the folder of cached grids."""
    return next(cache_folders(), Path(os.devnull)) / "sdf"  # os.devnull cannot contain files


def _arrays(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(triangles, dtype=np.int64)


def _key(vertices: np.ndarray, triangles: np.ndarray, cells: int, margin: float) -> str:
    """Return the hexadecimal SHA-256 of all inputs of a grid."""
    digest = hashlib.sha256(f"{FORMAT} {len(vertices)} {len(triangles)} {int(cells)} {float(margin).hex()}\n".encode())
    digest.update(vertices.tobytes())
    digest.update(triangles.tobytes())
    return digest.hexdigest()


def _read(path: Path) -> SdfGrid | None:
    """Return the grid in a file, or None if the file is missing or damaged."""
    try:
        # Open here, because np.load leaves an unreadable file open.
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            return SdfGrid(*(file[name] for name in ("origin", "spacing", "phi")))
    except Exception:  # a damaged archive raises many kinds of errors, some from the decompression modules
        return None


def _matches(grid: SdfGrid, vertices: np.ndarray, cells: int, margin: float) -> bool:
    """Return whether a grid has the layout for these vertices and finite float64 values."""
    origin, spacing, shape = grid_points(vertices, cells, margin)
    return (
        np.array_equal(grid.origin, origin)
        and np.array_equal(grid.spacing, spacing)
        and grid.phi.shape == shape
        and grid.phi.dtype == np.float64
        and bool(np.isfinite(grid.phi).all())
    )


def _write(path: Path, grid: SdfGrid) -> None:
    """Write a grid atomically. Does nothing if the folder is not writable."""
    name = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            name = file.name
            np.savez(file, origin=grid.origin, spacing=grid.spacing, phi=grid.phi)
        os.replace(name, path)
    except OSError:
        if name is not None and os.path.exists(name):
            os.unlink(name)
