"""Read the meshes of a USD stage: tets as they are, closed surfaces filled with tets.

The stage is read in a child process (`usd_content.py` says what is taken), since a broken file may end the process.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taisoft.errors import MeshError, listed, value_text
from taisoft.files import as_path
from taisoft.mesh.placing import FROM_Y_UP
from taisoft.mesh.safe_reading import read_content, read_in_child
from taisoft.mesh.surface_mesh import SurfaceMesh, clean_surface, tetrahedralize
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.checks import choice

USD_FORMATS = (".usd", ".usda", ".usdc", ".usdz")


@dataclass(frozen=True)
class _Prim:
    """Tets or a closed surface of a stage. path: in the stage; source: file and name, for messages."""

    path: str
    source: str
    points: np.ndarray
    tets: np.ndarray | None
    surface: SurfaceMesh | None

    def mesh(self, edge_length: float | None) -> TetMesh:
        """Return the mesh; a surface is filled with tets."""
        if self.surface is not None:
            return tetrahedralize(self.surface, edge_length)
        return _tet_mesh(self.source, self.points, self.tets)


def read_usd(path, edge_length: float | None = None, up: str = "y") -> dict[str, TetMesh]:
    """Return the meshes in a USD stage by name, in the stage's order, where they stand in it, in metres.

    up: axis that points up in what is returned, "y" or "z"; the stage's own is turned to it. A TetMesh prim is taken as it is,
    a closed Mesh is filled with tets (`tetrahedralize`, with its edge_length [m]), an open one is left out with a warning.
    Points are the default ones, else those of the first time. A name is the prim's, with a number where it occurs twice. A stage
    that taisoft wrote gives its bodies at their start, quadratic ones cut into linear tets. Raises MeshError.
    """
    file, prims, notes = _read_prims(path, "read_usd", False, up)
    _warn(file, notes)
    return {name: prim.mesh(edge_length) for name, prim in prims.items()}


def read_usd_prim(path, prim: str | None = None, edge_length: float | None = None, alone: bool = False, up: str = "y") -> TetMesh:
    """Return one of the meshes that `read_usd` returns; the others are not filled with tets.

    prim: its name there, or the path of its prim or of one above it; None for the only one. alone: refuse a stage that names
    further files. up: as for `read_usd`. Raises MeshError.
    """
    file, prims, notes = _read_prims(path, "read_usd_prim", alone, up)
    if prim is not None and not isinstance(prim, str):
        raise MeshError(f"prim must be the name or the path of a mesh in the stage, not {value_text(prim)}")
    above = f"{prim}/" if prim and prim.startswith("/") else None
    fitting = [name for name, one in prims.items() if prim in (None, name, one.path) or (above and one.path.startswith(above))]
    if len(fitting) != 1:
        which = "is missing" if prim is None else f"{prim!r} fits {'several' if fitting else 'none'}"
        raise MeshError(f"prim {which}: {file} holds {listed(list(prims))}")
    one = prims[fitting[0]]
    _warn(file, [note for note in notes if note.startswith(f"{one.path} ")])
    return one.mesh(edge_length)


def _read_prims(path, what: str, alone: bool, up: str) -> tuple[Path, dict[str, _Prim], list[str]]:
    """Return the file, its meshes by name, and notes about what is left out. Raises MeshError, if there are none too."""
    file = as_path(path, what, MeshError)
    if file.suffix.lower() not in USD_FORMATS:
        raise MeshError(f"{file}: a USD stage is read from {', '.join(USD_FORMATS)}, not from {file.suffix or 'no ending'}")
    choice(up, f"{what}: up", FROM_Y_UP, MeshError)
    read_content(file)  # refuses what is no file
    try:
        found = read_in_child("usd", file, alone=alone)
    except MeshError as error:
        raise MeshError(f"{file}: not a readable USD stage ({error})") from None
    prims: dict[str, _Prim] = {}
    notes = found["notes"]
    for name, prim_path, points, cells in found["meshes"]:
        points, source, surface = points @ FROM_Y_UP[up].T, f"{file}: {name}", None
        if cells.shape[1] == 3:
            surface = clean_surface(SurfaceMesh(points, cells, source), 0.0)
            if not surface.closed:
                notes.append(f"{name} is open, so it bounds no solid, and is left out")
                continue
        prims[_free(name, prims)] = _Prim(prim_path, source, points, cells if surface is None else None, surface)
    if not prims:
        _warn(file, notes)
        raise MeshError(f"{file}: the stage holds no tets and no closed surface")
    return file, prims, notes


def _warn(file: Path, notes: list[str]) -> None:
    for text in notes:
        warnings.warn(f"{file}: {text}", UserWarning, stacklevel=3)


def _free(name: str, taken) -> str:
    """Return the name, with a number appended if it is taken."""
    numbered = (name if k == 1 else f"{name}_{k}" for k in range(1, len(taken) + 2))
    return next(one for one in numbered if one not in taken)


def _tet_mesh(source: str, points: np.ndarray, tets: np.ndarray) -> TetMesh:
    """Return the mesh without vertices of no tet. TetMesh itself refuses invalid arrays."""
    if tets.min() >= 0 and tets.max() < len(points):
        used, inverse = np.unique(tets, return_inverse=True)
        points, tets = points[used], inverse.reshape(-1, 4)
    return TetMesh(points, tets, source=source)
