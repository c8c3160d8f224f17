"""Meshes from files and into files.

Gmsh's and TetGen's files are read by `gmsh.py` and `tetgen.py`, which say where one is broken; every other format by
meshio, behind a fence (`fence.py`).
"""

import contextlib
import io
import re
from pathlib import Path

import meshio
import numpy as np

from taisoft.errors import MeshError
from taisoft.files import replacing
from taisoft.mesh.content import read_content
from taisoft.mesh.gmsh import read_gmsh
from taisoft.mesh.quality import edge_lengths
from taisoft.mesh.safe_meshio import read_safely
from taisoft.mesh.tet_mesh import LARGEST_COORDINATE, TetMesh, merge_labels
from taisoft.mesh.tetgen import read_tetgen
from taisoft.mesh.tetra10 import straightened

TETS = ("tetra", "tetra10")
BOUNDARY = ("vertex", "line", "line3", "triangle", "triangle6")  # elements that meshers add to mark boundaries; told and left out
WRITERS = {".msh": "gmsh", ".vtk": "vtk", ".vtu": "vtu", ".mesh": "medit"}

# How to count the faces in a file of a format that cannot hold tets.
SURFACES = {
    ".obj": rb"^[ \t]*f[ \t]",
    ".stl": rb"^[ \t]*facet\b",
    ".off": rb"\A\s*OFF\s+(?:#[^\n]*\s+)*\d+\s+(\d+)",
    ".ply": rb"^[ \t]*element[ \t]+face[ \t]+(\d+)",
}

# Where a format announces a count: a file of n bytes cannot hold more than n of anything.
_COUNTS = {
    ".vtk": rb"(?:POINTS|CELLS|CELL_TYPES|OFFSETS|CONNECTIVITY)\s+(\d+)",
    ".vtu": rb"NumberOf(?:Points|Cells)\s*=\s*\"(\d+)",
    ".mesh": rb"(?:Vertices|Edges|Triangles|Quadrilaterals|Tetrahedra|Hexahedra|Prisms|Pyramids)\s+(\d+)",
    ".vol": rb"(?:points|volumeelements|surfaceelements\w*|edgesegments\w*)\s+(\d+)",
    ".su2": rb"N(?:POIN|ELEM)\s*=\s*(\d+)",
    ".xml": rb"size\s*=\s*\"(\d+)",
    ".dat": rb"\b(?:NODES|ELEMENTS|N|E)\s*=\s*(\d+)",
    ".tec": rb"\b(?:NODES|ELEMENTS|N|E)\s*=\s*(\d+)",
    ".msh": rb"\$(?:Nodes|Elements)\s+(\d+)[ \t\r]*\n",
}

# Of these, what a mesh cannot be without.
_NEEDED = {".vtk": rb"(?:POINTS\s+|CELLS\s+(?:1\s+)?)(\d+)", ".vtu": rb"NumberOf(?:Points|Cells)\s*=\s*\"(\d+)"}

_PLURAL = {"vertex": "vertices", "line": "lines", "triangle": "triangles", "quad": "quads", "hexahedron": "hexahedra"}

def read_mesh(path, fix_orientation: bool = False, weld: float | None = None) -> TetMesh:
    """Read a tetrahedral mesh from a file of any format that meshio knows.

    path: the file; its ending tells the format. fix_orientation: as for `TetMesh`. weld: merge vertices at most this
    far apart [m], 0 for equal ones only; None merges nothing. Points, lines and triangles next to the tets, and
    vertices of no tet, are left out with a warning; any other element is refused by name and number. Of second-order
    tets the corners are taken; a warning tells how many curved edges are straightened. Raises MeshError.
    """
    try:
        file = Path(path)
    except TypeError as error:
        raise MeshError(f"read_mesh: path must be a file's name, not {path!r}") from error
    name = str(file)
    data = read_content(file)
    ending = file.suffix.lower()
    found = None
    if ending in SURFACES:
        found = _count_faces(ending, data)
        raise MeshError(f"{name}: no tetrahedra; {found} found; make a volume mesh first: taisoft tetrahedralize")
    if ending == ".msh" and data.lstrip()[:1] == b"$":
        found = read_gmsh(name, data)
    elif ending in (".node", ".ele"):
        found = read_tetgen(file)
    points, cells = found or _read_by_meshio(file, name, data)
    blocks, notes = _tets_among(name, cells)
    return _clean_mesh(name, np.asarray(points), blocks, notes, fix_orientation, weld)


def write_mesh(path, mesh: TetMesh) -> None:
    """Write a mesh as .msh (Gmsh 4.1, text), .vtk, .vtu or .mesh (Medit); the file appears complete or not at all.

    Raises MeshError for another ending or no TetMesh, OutputError where the file cannot be written.
    """
    file = Path(path)
    ending = check_ending(file)
    if not isinstance(mesh, TetMesh):
        raise MeshError(f"{file}: write_mesh needs a TetMesh, not {type(mesh).__name__}")
    record = meshio.Mesh(mesh.vertices, [("tetra", mesh.tets)])
    options = {"binary": False} if ending == ".msh" else {}
    with replacing(file) as part:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            meshio.write(part, record, file_format=WRITERS[ending], **options)


def check_ending(file: Path) -> str:
    """The file's ending in small letters. Raises MeshError where `write_mesh` could not write such a file."""
    ending = file.suffix.lower()
    if ending not in WRITERS:
        raise MeshError(f"{file}: a mesh can be written as {', '.join(WRITERS)}, not with the ending {ending!r}")
    return ending


def _count_faces(ending: str, data: bytes) -> str:
    """The faces in a surface file, as text."""
    if ending == ".stl" and len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return _counted({"triangle": int.from_bytes(data[80:84], "little")})
    found = re.findall(SURFACES[ending], data, re.MULTILINE)
    if ending in (".off", ".ply"):
        return f"{found[0][:20].decode()} faces" if found else "no faces"
    if ending == ".obj" and any(len(line.split()) != 4 for line in data.splitlines() if line.split()[:1] == [b"f"]):
        return f"{len(found)} faces"
    return _counted({"triangle": len(found)})


def _read_by_meshio(file: Path, name: str, data: bytes):
    """Points and blocks of elements as meshio gives them, whatever it does on a file that is broken."""
    ending = file.suffix.lower()
    known = meshio.extension_to_filetypes
    if not any("".join(file.suffixes[-n:]).lower() in known for n in (1, 2)):
        raise MeshError(f"{name}: not a supported mesh: the ending {ending!r} is not known")
    for found in re.finditer(_COUNTS.get(ending, rb"(?!)"), data):
        if int(found[1][:30]) > len(data):
            line = data.count(b"\n", 0, found.start(1)) + 1
            raise MeshError(
                f"{name}: line {line} announces {found[1][:30].decode()} items, but the file has {len(data)} bytes"
            )
    try:
        mesh = read_safely(file, name, data)
    except MeshError as error:
        if any(int(found[1][:30]) == 0 for found in re.finditer(_NEEDED.get(ending, rb"(?!)"), data)):
            raise MeshError(f"{name}: no tetrahedra; the file announces 0 points or cells") from error
        raise
    return mesh.points, [(block.type, np.asarray(block.data)) for block in mesh.cells]


def _tets_among(name: str, cells: list[tuple[str, np.ndarray]]) -> tuple[list[np.ndarray], list[str]]:
    """The blocks of tets, (m,4) or (m,10), and what has to be told about other elements."""
    counts: dict[str, int] = {}
    for kind, nodes in cells:
        if len(nodes):
            counts[kind] = counts.get(kind, 0) + len(nodes)
    foreign = {kind: count for kind, count in counts.items() if kind not in (*TETS, *BOUNDARY)}
    if foreign:
        raise MeshError(f"{name}: only tetrahedra with four or ten nodes can be used, but the file holds {_counted(foreign)}")
    boundary = {kind: count for kind, count in counts.items() if kind in BOUNDARY}
    if len(boundary) == len(counts):
        advice = "; make a volume mesh first" if boundary else ""
        raise MeshError(f"{name}: no tetrahedra; {_counted(boundary) if boundary else 'no elements'} found{advice}")
    blocks = [nodes for kind, nodes in cells if kind in TETS and len(nodes)]
    return blocks, [f"{_counted(boundary)} next to the tets are not used"] if boundary else []


def _counted(counts: dict[str, int]) -> str:
    """Such as "3 quads, 1 line"."""
    parts = []
    for kind, count in counts.items():
        several = _PLURAL.get(kind, f"{kind} elements")
        parts.append(f"{count} {kind if count == 1 else several}")
    return ", ".join(parts)


def _clean_mesh(name, points, blocks, notes, fix_orientation, weld) -> TetMesh:
    """The TetMesh of the corners, without other vertices and welded; where the arrays are wrong, TetMesh says so first."""
    tets = np.concatenate([nodes[..., :4] for nodes in blocks])
    sound = (
        points.ndim == 2 and points.shape[1] == 3 and points.dtype.kind in "fiu"
        and (np.abs(points) <= LARGEST_COORDINATE).all() and tets.ndim == 2 and tets.size > 0
        and tets.min() >= 0 and tets.max() < len(points)
        and all(nodes.dtype.kind in "iu" for nodes in blocks)
    )  # fmt: skip
    if not sound:
        return TetMesh(points, tets, fix_orientation, source=name, notes=tuple(notes))
    points = points.astype(np.float64)
    loose = np.ones(len(points), dtype=bool)
    loose[tets] = False
    kept = ~loose
    second = [nodes for nodes in blocks if nodes.shape[1] == 10]
    if second:
        cells = np.concatenate(second)
        bad = np.argwhere((cells < 0) | (cells >= len(points)))
        if len(bad):
            raise MeshError(f"{name}: second-order tet {bad[0, 0]}: node {cells[tuple(bad[0])]} does not exist")
        notes += straightened(name, points, cells)
        loose[cells] = False
    if loose.any():
        notes.append(f"{loose.sum()} vertices of no tet are left out, the first is vertex {loose.argmax()} of the file")
    points, tets = points[kept], (np.cumsum(kept) - 1)[tets]
    if weld is not None:
        points, tets, note = _welded(name, points, tets, weld)
        notes += note
    return TetMesh(points, tets, fix_orientation, source=name, notes=tuple(notes))


def _welded(name: str, points: np.ndarray, tets: np.ndarray, weld) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Points and tets with vertices at most `weld` [m] apart merged into the first of each group, and what to tell."""
    if isinstance(weld, bool) or not isinstance(weld, (int, float, np.number)) or not 0 <= weld < np.inf:
        raise MeshError(f"{name}: weld must be a distance of at least 0 m, or None, not {weld!r}")
    shortest = float(edge_lengths(points, tets).min())
    if weld >= shortest > 0:
        raise MeshError(f"{name}: weld = {float(weld):g} m must be less than the shortest edge, {shortest:g} m")
    labels = merge_labels(points, float(weld))
    first = np.unique(labels, return_index=True)[1]
    merged = len(points) - len(first)
    return points[first], labels[tets], [f"{merged} vertices were welded to another one"] if merged else []
