"""Read and write tetrahedral meshes.

Gmsh and TetGen files are read by `gmsh.py` and `tetgen.py`, which report the place of an error. Every other format is read
by meshio through `safe_meshio.py`.
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
from taisoft.mesh.tetra10 import curved_edge_warnings

TETS = ("tetra", "tetra10")
BOUNDARY = ("vertex", "line", "line3", "triangle", "triangle6")  # boundary markers that meshers add; ignored with a warning
WRITERS = {".msh": "gmsh", ".vtk": "vtk", ".vtu": "vtu", ".mesh": "medit"}

# Pattern that counts the faces in a file of a format that cannot hold tets.
SURFACES = {
    ".obj": rb"^[ \t]*f[ \t]",
    ".stl": rb"^[ \t]*facet\b",
    ".off": rb"\A\s*OFF\s+(?:#[^\n]*\s+)*\d+\s+(\d+)",
    ".ply": rb"^[ \t]*element[ \t]+face[ \t]+(\d+)",
}

# Where a format declares counts: a file of n bytes cannot hold more than n items.
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

# The declared counts that must not be 0 in a mesh.
_REQUIRED = {".vtk": rb"(?:POINTS\s+|CELLS\s+(?:1\s+)?)(\d+)", ".vtu": rb"NumberOf(?:Points|Cells)\s*=\s*\"(\d+)"}

_PLURALS = {"vertex": "vertices", "line": "lines", "triangle": "triangles", "quad": "quads", "hexahedron": "hexahedra"}


def read_mesh(path, fix_orientation: bool = False, weld: float | None = None) -> TetMesh:
    """Read a tetrahedral mesh from a file of any format that meshio knows.

    path: the file; its extension selects the format. fix_orientation: as for `TetMesh`. weld: merge vertices at most this
    far apart [m]; 0 merges only equal ones, None merges nothing. Points, lines and triangles beside the tets, and vertices of
    no tet, are ignored with a warning; any other element type is refused with its name and count. Second-order tets keep only
    their corners; a warning reports the number of curved edges that become straight. Raises MeshError.
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
    blocks, notes = _tet_blocks(name, cells)
    return _clean_mesh(name, np.asarray(points), blocks, notes, fix_orientation, weld)


def write_mesh(path, mesh: TetMesh) -> None:
    """Write a mesh atomically as .msh (Gmsh 4.1, text), .vtk, .vtu or .mesh (Medit).

    Raises MeshError for another extension or anything but a TetMesh, OutputError if the file cannot be written.
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
    """Return the file's extension in lower case. Raises MeshError if `write_mesh` does not support it."""
    ending = file.suffix.lower()
    if ending not in WRITERS:
        raise MeshError(f"{file}: a mesh can be written as {', '.join(WRITERS)}, not with the ending {ending!r}")
    return ending


def _count_faces(ending: str, data: bytes) -> str:
    """Return the number of faces in a surface file, as text."""
    if ending == ".stl" and len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return _format_counts({"triangle": int.from_bytes(data[80:84], "little")})
    found = re.findall(SURFACES[ending], data, re.MULTILINE)
    if ending in (".off", ".ply"):
        return f"{found[0][:20].decode()} faces" if found else "no faces"
    if ending == ".obj" and any(len(line.split()) != 4 for line in data.splitlines() if line.split()[:1] == [b"f"]):
        return f"{len(found)} faces"
    return _format_counts({"triangle": len(found)})


def _read_by_meshio(file: Path, name: str, data: bytes):
    """Return points and element blocks read by meshio. Raises MeshError for a broken file."""
    ending = file.suffix.lower()
    extensions = meshio.extension_to_filetypes
    if not any("".join(file.suffixes[-n:]).lower() in extensions for n in (1, 2)):
        raise MeshError(f"{name}: not a supported mesh: the ending {ending!r} is not known")
    for found in re.finditer(_COUNTS.get(ending, rb"(?!)"), data):
        if int(found[1][:30]) > len(data):
            line = data.count(b"\n", 0, found.start(1)) + 1
            raise MeshError(f"{name}: line {line} declares {found[1][:30].decode()} items, but the file has {len(data)} bytes")
    try:
        mesh = read_safely(file, name, data)
    except MeshError as error:
        if any(int(found[1][:30]) == 0 for found in re.finditer(_REQUIRED.get(ending, rb"(?!)"), data)):
            raise MeshError(f"{name}: no tetrahedra; the file declares 0 points or cells") from error
        raise
    return mesh.points, [(block.type, np.asarray(block.data)) for block in mesh.cells]


def _tet_blocks(name: str, cells: list[tuple[str, np.ndarray]]) -> tuple[list[np.ndarray], list[str]]:
    """Return the blocks of tets, (m,4) or (m,10), and warnings about other elements."""
    counts: dict[str, int] = {}
    for kind, nodes in cells:
        if len(nodes):
            counts[kind] = counts.get(kind, 0) + len(nodes)
    unsupported = {kind: count for kind, count in counts.items() if kind not in (*TETS, *BOUNDARY)}
    if unsupported:
        raise MeshError(
            f"{name}: only tetrahedra with four or ten nodes can be used, but the file holds {_format_counts(unsupported)}"
        )
    boundary = {kind: count for kind, count in counts.items() if kind in BOUNDARY}
    if len(boundary) == len(counts):
        advice = "; make a volume mesh first" if boundary else ""
        raise MeshError(f"{name}: no tetrahedra; {_format_counts(boundary) if boundary else 'no elements'} found{advice}")
    blocks = [nodes for kind, nodes in cells if kind in TETS and len(nodes)]
    return blocks, [f"{_format_counts(boundary)} next to the tets are not used"] if boundary else []


def _format_counts(counts: dict[str, int]) -> str:
    """Format counts by element type, such as "3 quads, 1 line"."""
    parts = []
    for kind, count in counts.items():
        plural = _PLURALS.get(kind, f"{kind} elements")
        parts.append(f"{count} {kind if count == 1 else plural}")
    return ", ".join(parts)


def _clean_mesh(name, points, blocks, notes, fix_orientation, weld) -> TetMesh:
    """Return the TetMesh of the corners, unused vertices removed, the rest welded. TetMesh itself refuses invalid arrays."""
    tets = np.concatenate([nodes[..., :4] for nodes in blocks])
    valid = (
        points.ndim == 2
        and points.shape[1] == 3
        and points.dtype.kind in "fiu"
        and (np.abs(points) <= LARGEST_COORDINATE).all()
        and tets.ndim == 2
        and tets.size > 0
        and tets.min() >= 0
        and tets.max() < len(points)
        and all(nodes.dtype.kind in "iu" for nodes in blocks)
    )
    if not valid:
        return TetMesh(points, tets, fix_orientation, source=name, notes=tuple(notes))
    points = points.astype(np.float64)
    unused = np.ones(len(points), dtype=bool)
    unused[tets] = False
    used = ~unused
    second_order = [nodes for nodes in blocks if nodes.shape[1] == 10]
    if second_order:
        cells = np.concatenate(second_order)
        bad = np.argwhere((cells < 0) | (cells >= len(points)))
        if len(bad):
            raise MeshError(f"{name}: second-order tet {bad[0, 0]}: node {cells[tuple(bad[0])]} does not exist")
        notes += curved_edge_warnings(name, points, cells)
        unused[cells] = False
    if unused.any():
        notes.append(f"{unused.sum()} vertices of no tet are left out, the first is vertex {unused.argmax()} of the file")
    points, tets = points[used], (np.cumsum(used) - 1)[tets]
    if weld is not None:
        points, tets, note = _weld(name, points, tets, weld)
        notes += note
    return TetMesh(points, tets, fix_orientation, source=name, notes=tuple(notes))


def _weld(name: str, points: np.ndarray, tets: np.ndarray, weld) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Merge vertices at most `weld` [m] apart into the first of each group; return points, tets and warnings."""
    if isinstance(weld, bool) or not isinstance(weld, (int, float, np.number)) or not 0 <= weld < np.inf:
        raise MeshError(f"{name}: weld must be a distance of at least 0 m, or None, not {weld!r}")
    shortest = float(edge_lengths(points, tets).min())
    if weld >= shortest > 0:
        raise MeshError(f"{name}: weld = {float(weld):g} m must be less than the shortest edge, {shortest:g} m")
    labels = merge_labels(points, float(weld))
    first = np.unique(labels, return_index=True)[1]
    merged = len(points) - len(first)
    return points[first], labels[tets], [f"{merged} vertices were welded to another one"] if merged else []
