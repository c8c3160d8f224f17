"""Read the meshes of a USD stage: tets as they are, closed surfaces filled with tets.

The stage is read in a child process (`usd_content.py` says what is taken), since a broken file may end the process.
"""

import tempfile
import warnings
from pathlib import Path

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.safe_reading import SECONDS, SECONDS_PER_BYTE, WALL_FACTOR, read_content, run_child
from taisoft.mesh.surface_mesh import SurfaceMesh, clean_surface, tetrahedralize
from taisoft.mesh.tet_mesh import TetMesh

USD_FORMATS = (".usd", ".usda", ".usdc", ".usdz")


def read_usd(path, edge_length: float | None = None) -> dict[str, TetMesh]:
    """Return the meshes in a USD stage by name, in the stage's order, where they stand in it, in metres and with y up.

    A TetMesh prim is taken as it is, a closed Mesh is filled with tets (`tetrahedralize`, with its edge_length [m]), an open
    one is left out with a warning. Points are the default ones, else those of the first time. A name is the prim's, with a
    number where it occurs twice. A stage that taisoft wrote gives its bodies at their start, quadratic ones cut into linear
    tets. Raises MeshError.
    """
    try:
        file = Path(path)
    except TypeError as error:
        raise MeshError(f"read_usd: path must be a file's name, not {path!r}") from error
    if file.suffix.lower() not in USD_FORMATS:
        raise MeshError(f"{file}: a USD stage is read from {', '.join(USD_FORMATS)}, not from {file.suffix or 'no ending'}")
    seconds = SECONDS + SECONDS_PER_BYTE * len(read_content(file))
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:
        try:
            found = run_child(folder, "usd", str(file.absolute()), str(seconds), seconds=WALL_FACTOR * seconds)
        except MeshError as error:
            raise MeshError(f"{file}: not a readable USD stage ({error})") from None
    notes, meshes = found["notes"].tolist(), {}
    for k, prim_name in enumerate(found["names"].tolist()):
        points, cells, name = found[f"points{k}"], found[f"cells{k}"], _free(prim_name, meshes)
        source = f"{file}: {prim_name}"
        if cells.shape[1] == 4:
            meshes[name] = _tet_mesh(source, points, cells)
            continue
        surface = clean_surface(SurfaceMesh(points, cells, source), 0.0)
        if surface.closed:
            meshes[name] = tetrahedralize(surface, edge_length)
        else:
            notes.append(f"{prim_name} is open, so it bounds no solid, and is left out")
    for text in notes:
        warnings.warn(f"{file}: {text}", UserWarning, stacklevel=2)
    if not meshes:
        raise MeshError(f"{file}: the stage holds no tets and no closed surface")
    return meshes


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
