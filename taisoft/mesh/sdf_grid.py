"""Signed distance of a body at rest on a grid whose cells follow each axis's extent, and a folder that keeps such grids.

A grid is kept under the SHA-256 of what it is made from, so that a body simulated again finds it. A file that is damaged is
made again; a folder that cannot be written only costs time.
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

FORMAT = 1  # of what a kept grid holds; raised when its numbers or their meaning change
LEAST_CELLS = 8  # across the thinnest side
PAD = 2  # cells beyond the surface on every side
_ROUNDING = 1e-9  # of a cell: a side of that little more than n cells has n


@dataclass(frozen=True, eq=False)
class SdfGrid:
    """Signed distances at the points origin + (i, j, k) * spacing; arrays are read-only."""

    origin: np.ndarray  # (3,) [m]
    spacing: np.ndarray  # (3,) [m]
    phi: np.ndarray  # (nx,ny,nz) float64 [m], negative inside

    def __post_init__(self):
        for array in (self.origin, self.spacing, self.phi):
            array.setflags(write=False)


def grid_points(vertices: np.ndarray, cells: int, margin: float) -> tuple[np.ndarray, np.ndarray, tuple[int, int, int]]:
    """Origin (3,) [m], spacing (3,) [m] and shape of the grid that `sdf_grid` lays round vertices (n,3)."""
    low, side = vertices.min(axis=0), np.ptp(vertices, axis=0)
    inside = np.maximum(np.ceil(side / (side.max() / cells) - _ROUNDING), LEAST_CELLS)
    spacing = side / inside
    pad = np.maximum(np.ceil(margin / spacing - _ROUNDING), PAD)
    shape = tuple(int(n) for n in inside + 2 * pad + 1)
    return low - pad * spacing, spacing, shape


def sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = 2_000_000, margin: float = 0.0
) -> SdfGrid:
    """Exact signed distances on a grid round a closed surface.

    vertices: (n,3) [m]. triangles: (t,3) int, normals outward; every edge has two. cells: along the longest side; the
    other sides get cells of about that size, but at least 8. max_points: above which the grid is refused. margin: [m] by
    which the grid reaches beyond the surface at least; two cells are the least. Raises MeshError for a surface that is
    open or has triangles without area, and for a grid that is too large.
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
    """`sdf_grid` of the same arguments, taken from the folder of kept grids where it is there, else kept there."""
    vertices, triangles = _arrays(vertices, triangles)
    path = cache_folder() / f"{_key(vertices, triangles, cells, margin)}.npz"
    grid = _read(path)
    # Of a file that is whole but not what its name says, or is larger than allowed now, nothing is used.
    if grid is None or not _fits(grid, vertices[np.unique(triangles)], cells, margin) or grid.phi.size > max_points:
        grid = sdf_grid(vertices, triangles, cells, max_points, margin)
        _write(path, grid)
    return grid


def cache_folder() -> Path:
    """Where grids are kept."""
    return next(cache_folders(), Path(os.devnull)) / "sdf"  # the latter can hold nothing


def _arrays(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(triangles, dtype=np.int64)


def _key(vertices: np.ndarray, triangles: np.ndarray, cells: int, margin: float) -> str:
    """Hexadecimal SHA-256 of everything that the numbers of a grid depend on."""
    digest = hashlib.sha256(
        f"{FORMAT} {len(vertices)} {len(triangles)} {int(cells)} {float(margin).hex()}\n".encode()
    )
    digest.update(vertices.tobytes())
    digest.update(triangles.tobytes())
    return digest.hexdigest()


def _read(path: Path) -> SdfGrid | None:
    """The grid in a file, or None where there is none that is whole."""
    try:
        # Opened here, since np.load leaves what it cannot read open.
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            return SdfGrid(*(file[name] for name in ("origin", "spacing", "phi")))
    except Exception:  # a damaged archive raises errors of many kinds, some from the modules that unpack it
        return None


def _fits(grid: SdfGrid, vertices: np.ndarray, cells: int, margin: float) -> bool:
    """Whether a grid lies where that of these vertices lies, and holds finite numbers."""
    origin, spacing, shape = grid_points(vertices, cells, margin)
    return (
        np.array_equal(grid.origin, origin) and np.array_equal(grid.spacing, spacing) and grid.phi.shape == shape
        and grid.phi.dtype == np.float64 and bool(np.isfinite(grid.phi).all())
    )  # fmt: skip


def _write(path: Path, grid: SdfGrid) -> None:
    """Keep a grid, in one step: a reader never sees half a file. Does nothing where the folder cannot be written."""
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
