"""Generate tet meshes of a box, a thin sheet, a ball and a cylinder by array arithmetic, without loops over cells.

A grid cell is split into five tets (a regular one in the middle, four at corners; neighbours are mirrored in a
checkerboard) or six (Kuhn's, all around one diagonal). Five are fewer and better shaped. Six are the same in every cell,
which gives the whole mesh a preferred diagonal.

Balls and discs are graded by a translation x -> a + x of the ball in hyperbolic geometry (Moebius addition). It is conformal, so
that the shapes of small tets stay, and maps the sphere to itself.
"""

import itertools
from functools import partial
from numbers import Integral

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import MeshError, value_text
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.checks import choice, number, vector

MAX_TETS = 50_000_000  # about 20 GB of memory while a mesh is built and checked
_vector, _positive = partial(vector, error=MeshError), partial(number, above=0.0, error=MeshError)

# Corners of a cell are numbered 4 dx + 2 dy + dz.
_FIVE_EVEN = np.array([(0, 6, 3, 5), (4, 6, 0, 5), (2, 0, 6, 3), (1, 0, 3, 5), (7, 6, 5, 3)])


def box_mesh(cells, size, center=(0.0, 0.0, 0.0), pattern: str = "five", grading=(1.0, 1.0, 1.0)) -> TetMesh:
    """Return the mesh of a box of nx x ny x nz cells.

    cells: three positive integers, the number of cells along x, y, z. size: (3,) edge lengths [m]. center: (3,) [m].
    pattern: "five" tets per cell, mirrored by the parity of i+j+k, even cells with the middle tet 000,110,101,011;
    or "six", Kuhn's tets around the diagonal 000-111. grading: (3,) length of the last cell along x, y, z over that of the first,
    between which lengths grow by a constant factor: below 1 the box is finer at its upper face. Vertex (i,j,k) has index
    (i*(ny+1)+j)*(nz+1)+k.
    Raises MeshError for arguments outside these rules.
    """
    cells = _checked_cells(cells, "box_mesh", (3,))
    size, center = _vector(size, "box_mesh: size", above=0.0), _vector(center, "box_mesh: center")
    choice(pattern, "box_mesh: pattern", ("five", "six"), MeshError)
    _check_count(cells, 5 if pattern == "five" else 6, "box_mesh")
    grading = _vector(grading, "box_mesh: grading", above=0.0)
    vertices = center + size * _grid_points(cells, grading)
    corners = _cell_corners(cells)
    recipe = {"shape": "box", "cells": cells, "size": size, "center": center, "pattern": pattern}
    recipe |= {"grading": grading} if (grading != 1.0).any() else {}
    if pattern == "six":
        return _with_recipe(recipe, vertices, corners[:, _kuhn()])
    odd = _cell_indices(cells).sum(axis=1) % 2 == 1
    # Mirroring x exchanges the corners c and c ^ 4 and inverts every tet; swapping two vertices restores its orientation.
    table = np.stack([_FIVE_EVEN, (_FIVE_EVEN ^ 4)[:, [1, 0, 2, 3]]])[odd.astype(int)]
    return _with_recipe(recipe, vertices, np.take_along_axis(corners, table.reshape(len(corners), -1), axis=1))


def sheet_mesh(cells, size, center=(0.0, 0.0, 0.0), pattern: str = "five", up: str = "y") -> TetMesh:
    """Return the mesh of a flat sheet: a box that is thin along the axis `up`, "y" or "z".

    cells: (nx, ny, nz), or without the number of layers, which is then one. size: (3,) along x, y, z [m]; the thickness must not
    exceed the lengths. center, pattern, vertex order and errors as for `box_mesh`.
    """
    across = "xyz".index(choice(up, "sheet_mesh: up", ("y", "z"), MeshError))
    cells = _checked_cells(cells, "sheet_mesh", (2, 3))
    if len(cells) == 2:
        cells = np.insert(cells, across, 1)
    size = _vector(size, "sheet_mesh: size", above=0.0)
    if size[across] > min(size):
        raise MeshError(f"sheet_mesh: size {size.tolist()} has a thickness size[{across}] above one of the lengths")
    return box_mesh(cells, size, center, pattern)


def ball_mesh(radius: float, cells: int, center=(0.0, 0.0, 0.0), grading: float = 1.0, towards=(0.0, -1.0, 0.0)) -> TetMesh:
    """Return the mesh of a ball: a cube of cells^3 cells whose shells become rounder towards the surface.

    radius: [m] of the surface vertices; the volume is slightly below the ball's. cells: even number of cells across,
    at least 2. center: (3,) [m]. grading: how many times as long cells are opposite the point of the surface in the direction
    `towards` (3,) as at that point. Raises MeshError for arguments outside these rules.

    The six tets of a cell share the diagonal that points away from the center, so that no tet has all four vertices on
    the sphere, which would make it nearly flat.
    """
    _check_across(cells, "ball_mesh")
    radius = _positive(radius, "ball_mesh: radius")
    center, grid = _vector(center, "ball_mesh: center"), np.array([cells] * 3)
    _check_count(grid, 6, "ball_mesh")
    grading, towards = _checked_grading(grading, towards, "ball_mesh")
    recipe = {"shape": "ball", "radius": radius, "cells": int(cells), "center": center}
    recipe |= {"grading": grading, "towards": towards} if grading != 1.0 else {}
    points = _shifted(_cube_to_ball(2.0 * _grid_points(grid)), grading, towards)
    return _with_recipe(recipe, center + radius * points, _outward_tets(grid, 3))


def cylinder_mesh(
    radius: float, height: float, cells, center=(0.0, 0.0, 0.0), axis: str = "y", grading: float = 1.0, towards=(0.0, -1.0, 0.0)
) -> TetMesh:
    """Return the mesh of a cylinder.

    radius, height: [m]. cells: (across, along), an even number of cells across, at least 2, and one along the axis "x", "y" or
    "z". center: (3,) [m]. grading: how many times as long cells are opposite the face or the line of the surface in the direction
    `towards` (3,), along the axis or perpendicular to it, as there. Raises MeshError for arguments outside these rules.
    """
    choice(axis, "cylinder_mesh: axis", ("x", "y", "z"), MeshError)
    across, along = _checked_cells(cells, "cylinder_mesh", (2,)).tolist()
    _check_across(across, "cylinder_mesh")
    radius, height = _positive(radius, "cylinder_mesh: radius"), _positive(height, "cylinder_mesh: height")
    center, grid = _vector(center, "cylinder_mesh: center"), np.array([across, across, along])
    _check_count(grid, 6, "cylinder_mesh")
    grading, towards = _checked_grading(grading, towards, "cylinder_mesh")
    order = (np.arange(1, 4) + "xyz".index(axis)) % 3  # the axis last
    local = np.round(towards[order], 12)
    if grading != 1.0 and 0.0 < abs(local[2]) < 1.0:
        raise MeshError(f"cylinder_mesh: towards must be along the axis or perpendicular to it, not {value_text(towards)}")
    recipe = {"shape": "cylinder", "radius": radius, "height": height, "cells": np.array([across, along])}
    recipe |= {"center": center, "axis": axis} | ({"grading": grading, "towards": towards} if grading != 1.0 else {})
    points = _grid_points(grid, np.array([1.0, 1.0, grading ** -local[2]]))
    disc = _cube_to_ball(2.0 * points[:, :2])
    vertices = np.empty_like(points)
    vertices[:, order[:2]] = radius * (disc if local[2] else _shifted(disc, grading, local[:2]))
    vertices[:, order[2]] = height * points[:, 2]
    return _with_recipe(recipe, center + vertices, _outward_tets(grid, 2))


def _check_across(cells, shape: str) -> None:
    if isinstance(cells, bool) or not isinstance(cells, Integral) or cells < 2 or cells % 2:
        raise MeshError(f"{shape}: cells must be an even integer, at least 2, not {value_text(cells)}")


def _checked_grading(grading, towards, shape: str) -> tuple[float, np.ndarray]:
    """Return the grading and the unit vector (3,)."""
    grading, towards = _positive(grading, f"{shape}: grading"), _vector(towards, f"{shape}: towards")
    length = np.linalg.norm(towards)
    if length == 0.0:
        raise MeshError(f"{shape}: towards must be a direction, not (0, 0, 0)")
    return grading, towards / length


def _shifted(x: np.ndarray, grading: float, towards: np.ndarray) -> np.ndarray:
    """Return points x (n,d) of the unit ball moved towards a point of the unit sphere (d,), near which they get closer."""
    root = np.sqrt(grading)  # lengths shrink at the point by this factor, and grow by it opposite
    a = (root - 1.0) / (root + 1.0) * towards
    ax, xx, aa = (x @ a)[:, None], np.einsum("ni,ni->n", x, x)[:, None], a @ a
    return ((1.0 + 2.0 * ax + xx) * a + (1.0 - aa) * x) / (1.0 + 2.0 * ax + aa * xx)


def _outward_tets(grid: np.ndarray, axes: int) -> np.ndarray:
    """Return tets (6 cells, 4): the six of a cell share the diagonal that points away from the middle along the first axes."""
    inward = 2 * _cell_indices(grid)[:, :axes] < grid[:axes]  # cells below the middle along an axis are mirrored along it
    mirror = inward @ np.array([4, 2, 1])[:axes]
    table = _kuhn()[None] ^ mirror[:, None, None]
    flipped = inward.sum(axis=1) % 2 == 1
    table[flipped] = table[flipped][:, :, [0, 1, 3, 2]]
    return np.take_along_axis(_cell_corners(grid), table.reshape(len(table), -1), axis=1)


def _with_recipe(recipe: dict, vertices: np.ndarray, tets: np.ndarray) -> TetMesh:
    """Return the mesh of vertices (n,3) and tets, four indices each, with its recipe."""
    mesh = TetMesh(vertices, tets.reshape(-1, 4))
    for value in recipe.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    with thawed(mesh):
        mesh.recipe = recipe
    return mesh


def _cube_to_ball(p: np.ndarray) -> np.ndarray:
    """Map the cube [-1,1]^3 to the unit ball along rays: cubic at the center, increasingly round outwards. p: (n,3)."""
    shell = np.abs(p).max(axis=1, keepdims=True)
    length = np.linalg.norm(p, axis=1, keepdims=True)
    to_sphere = shell / np.where(length > 0, length, 1.0)
    return p * (1.0 - shell + shell * to_sphere)


def _kuhn() -> np.ndarray:
    """Return (6,4) corner numbers: for each order of the axes the path 000 -> ... -> 111, positively oriented."""
    tets = []
    for axes in itertools.permutations(range(3)):
        bits = [4 >> axis for axis in axes]
        path = [0, bits[0], bits[0] + bits[1], 7]
        even = axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        tets.append(path if even else [path[0], path[2], path[1], path[3]])
    return np.array(tets)


def _cell_indices(cells: np.ndarray) -> np.ndarray:
    """Return (nx*ny*nz, 3) indices i, j, k of the cells, k fastest."""
    return np.indices(cells).reshape(3, -1).T


def _cell_corners(cells: np.ndarray) -> np.ndarray:
    """Return (nx*ny*nz, 8) vertex indices of every cell's corners, numbered 4 dx + 2 dy + dz."""
    corner = np.indices((2, 2, 2)).reshape(3, -1).T
    index = _cell_indices(cells)[:, None, :] + corner[None]
    return (index[..., 0] * (cells[1] + 1) + index[..., 1]) * (cells[2] + 1) + index[..., 2]


def _grid_points(cells: np.ndarray, grading: np.ndarray | None = None) -> np.ndarray:
    """Return ((nx+1)(ny+1)(nz+1), 3) grid points in [-1/2, 1/2]^3. grading: (3,) length of the last cell over the first."""
    index = np.indices(cells + 1).reshape(3, -1).T
    if grading is None or (grading == 1.0).all():
        return index / cells - 0.5
    q = np.where(cells > 1, grading, 1.0) ** (1.0 / np.maximum(cells - 1, 1))  # a factor of 1 keeps its axis even
    even = q == 1.0
    graded = np.expm1(index * np.log(q)) / np.where(even, 1.0, np.expm1(cells * np.log(q)))
    return np.where(even, index / cells, graded) - 0.5


def _checked_cells(cells, shape: str, lengths: tuple[int, ...]) -> np.ndarray:
    values = list(cells) if isinstance(cells, (list, tuple, np.ndarray)) else [cells]
    valid = all(isinstance(c, Integral) and not isinstance(c, bool) and c > 0 for c in values)
    if len(values) not in lengths or not valid:
        counts = " or ".join({2: "two", 3: "three"}[n] for n in lengths)
        raise MeshError(f"{shape}: cells must be {counts} positive integers, not {value_text(cells)}")
    if max(values) > MAX_TETS:
        raise MeshError(f"{shape}: {max(values)} cells along an axis give more than the {MAX_TETS} tets allowed")
    return np.array([int(c) for c in values])


def _check_count(cells: np.ndarray, tets_per_cell: int, shape: str) -> None:
    n = tets_per_cell * int(np.prod([int(c) for c in cells], dtype=object))
    if n > MAX_TETS:
        raise MeshError(
            f"{shape}: cells {tuple(cells.tolist())} give {n} tets, about {400 * n / 1e9:.3g} GB of memory; "
            f"at most {MAX_TETS} tets are allowed"
        )
