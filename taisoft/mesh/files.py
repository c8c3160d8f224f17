"""Read and write tetrahedral meshes in files.

The formats that meshio reads wrongly have modules of their own; every other one is read by meshio in a child process
(`safe_reading.py`).

Second-order tets in a file have ten nodes, four corners and then one on each edge. Where some edge is curved, the latter become
the mesh's `mid_edge`; straight ones need none. Formats differ in the order of the edges, and readers do not always know it, so
the order is inferred from the nodes' positions.

Regions are numbers of the elements: physical groups, references, or other cell data. Weak: only .msh holds their names.
"""

import contextlib
import io
import warnings
from pathlib import Path

import meshio
import numpy as np

from taisoft.errors import MeshError, listed, value_text
from taisoft.files import as_path, replacing
from taisoft.mesh.abaqus import read_abaqus
from taisoft.mesh.gmsh import PHYSICAL, element_data, read_gmsh, split_names
from taisoft.mesh.medit import REFERENCE, read_medit
from taisoft.mesh.nastran import read_nastran
from taisoft.mesh.nodes import STRAIGHT
from taisoft.mesh.quality import edge_lengths
from taisoft.mesh.regions import FIBRES, LARGEST_ID, usable_names
from taisoft.mesh.safe_reading import Blocks, FileContent, content_of, read_by_meshio, read_content
from taisoft.mesh.surface_mesh import READERS as SURFACE_READERS
from taisoft.mesh.tet_mesh import LARGEST_COORDINATE, TetMesh
from taisoft.mesh.tetgen import read_tetgen
from taisoft.mesh.topology import EDGES, distinct_edges, merged_points
from taisoft.mesh.vtu import read_vtu
from taisoft.scene.checks import instance, number

TETS = ("tetra", "tetra10")
BOUNDARY = ("vertex", "line", "line3", "triangle", "triangle6")  # boundary markers that meshers add; ignored with a warning
READERS = {".mesh": read_medit, ".vtu": read_vtu, ".inp": read_abaqus, **dict.fromkeys((".bdf", ".nas", ".fem"), read_nastran)}
WRITERS = {".msh": "gmsh", ".vtk": "vtk", ".vtu": "vtu", ".mesh": "medit"}
REGION = "region"  # a name of cell data that hold regions, as PHYSICAL and REFERENCE do
NONE_IF_ZERO = (PHYSICAL, REFERENCE)  # such data are in files without regions too, where all are 0

# largest median distance of nodes from their edges' midpoints, over the edges' lengths, for which their order is inferred
KNOWN_ORDER = 0.25

_PLURALS = {"vertex": "vertices", "line": "lines", "triangle": "triangles", "quad": "quads", "hexahedron": "hexahedra"}


def read_mesh(path, fix_orientation: bool = False, weld: float | None = None, regions: str | None = None) -> TetMesh:
    """Read a tetrahedral mesh from a file of any format that meshio knows.

    path: the file; its extension selects the format. fix_orientation: as for `TetMesh`. weld: merge vertices at most this far
    apart [m]; 0 merges only equal ones, None merges nothing. regions: name of the cell data that hold the tets' regions; by
    default the physical groups of .msh, the references of .mesh, or data called "region". Cell data "fibres" or "fibers" of three
    components are its fibres. Points, lines and triangles beside the tets, and vertices of no tet, are ignored with a warning;
    any other element type is refused with its name and count. Nodes on curved edges of second-order tets are the mesh's
    `mid_edge`. Raises MeshError.
    """
    file = as_path(path, "read_mesh", MeshError)
    name = str(file)
    data = read_content(file)
    ending = file.suffix.lower()
    if ending in SURFACE_READERS:
        raise MeshError(f"{name}: no tetrahedra; {ending} holds surfaces; make a volume mesh first: taisoft tetrahedralize")
    content = None
    if ending == ".msh" and data.lstrip()[:1] == b"$":
        content = read_gmsh(name, data)
        if content is None:
            names, rest = split_names(data)
            content = _read_by_meshio(file, rest)._replace(region_names=names)
    elif ending in (".node", ".ele"):
        content = read_tetgen(file)
    elif ending in READERS:
        content = READERS[ending](name, data)
    return _clean_mesh(name, content or _read_by_meshio(file, data), fix_orientation, weld, regions)


def from_meshio(mesh, *options) -> TetMesh:
    """Return the tets of a meshio.Mesh, as `TetMesh.from_meshio`. options: its other arguments. Raises MeshError."""
    instance(mesh, "from_meshio: mesh of meshio", meshio.Mesh, error=MeshError)
    return _clean_mesh("meshio.Mesh", content_of(mesh), *options)


def write_mesh(path, mesh: TetMesh, regions: bool = True) -> None:
    """Write a mesh atomically as .msh (Gmsh 4.1, with regions 2.2, text), .vtk, .vtu or .mesh (Medit).

    Regions become physical groups in .msh, references in .mesh, and else cell data called "region"; a warning says where their
    names are lost. Fibres are vectors of the cells, which .mesh cannot hold. regions: whether to write them. Raises MeshError
    for another extension, anything but a TetMesh, or regions that would be read as none, OutputError if the file cannot be
    written.
    """
    file = Path(path)
    ending = check_ending(file)
    record = instance(mesh, f"{file}: mesh", TetMesh, error=MeshError).to_meshio()
    if ending == ".mesh" and mesh.mid_edge is not None:
        warnings.warn(f"{file}: {ending} cannot hold mid-edge nodes; its edges are straight", UserWarning, stacklevel=2)
        record.points, record.cells[0] = mesh.vertices, meshio.CellBlock("tetra", mesh.tets)
    fibres = record.cell_data.pop(FIBRES[0], None)
    if not regions:
        record.cell_data, record.field_data = {}, {}
    options = {"file_format": WRITERS[ending]} | ({"binary": False} if ending == ".msh" else {})
    if record.cell_data:
        options |= _region_options(file, record, mesh)
    elif ending == ".mesh":
        record.cell_data[REFERENCE] = [np.zeros(mesh.n_tets, dtype=np.int32)]  # meshio would write 1
    if fibres is not None and ending == ".mesh":
        warnings.warn(f"{file}: {ending} cannot hold fibres", UserWarning, stacklevel=2)
    elif fibres is not None and ending != ".msh":
        record.cell_data[FIBRES[0]] = fibres
    with replacing(file) as part:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            meshio.write(part, record, **options)
        if fibres is not None and ending == ".msh":  # meshio writes numbers of NumPy 2 as np.float64(...)
            with open(part, "ab") as stream:
                stream.write(element_data(FIBRES[0], fibres[0]))


def _region_options(file: Path, record: meshio.Mesh, mesh: TetMesh) -> dict:
    """Give the regions in meshio's record of a mesh the name of the format; return options of the writer."""
    ending = file.suffix.lower()
    name = {".msh": PHYSICAL, ".mesh": REFERENCE}.get(ending, REGION)
    if name in NONE_IF_ZERO and not mesh.regions.any():
        raise MeshError(
            f"{file}: a mesh whose only region is 0 cannot be written, since in {ending} 0 means none: use another number"
        )
    if ending != ".msh":
        record.cell_data = {name: [mesh.regions.astype(np.int32)]}
        if mesh.region_names:
            warnings.warn(f"{file}: {ending} cannot hold the names of regions, only their numbers", UserWarning, stacklevel=3)
        return {}
    return {"file_format": "gmsh22"}  # 4.1 would need a block of elements for each region, in another order


def check_ending(file: Path) -> str:
    """Return the file's extension in lower case. Raises MeshError if `write_mesh` does not support it."""
    ending = file.suffix.lower()
    if ending not in WRITERS:
        raise MeshError(f"{file}: a mesh can be written as {', '.join(WRITERS)}, not with the ending {ending!r}")
    return ending


def _regions(name: str, content: FileContent, requested: str | None) -> tuple[np.ndarray | None, dict[int, str], list[str]]:
    """Return the region (m,) of each tet, or None, names of regions, and warnings.

    requested: name of the cell data, or None for the known ones.
    """
    if requested is not None and not isinstance(requested, str):
        raise MeshError(f"{name}: regions must be the name of cell data, or None, not {value_text(requested)}")
    if requested is not None and requested not in content.cell_data:
        known = listed([value_text(one) for one in content.cell_data]) or "none"
        raise MeshError(f"{name}: no cell data are called {value_text(requested)}; there are {known}")
    key = next((one for one in (requested, *NONE_IF_ZERO, REGION) if one in content.cell_data), None)
    if key is None:
        return None, {}, []
    data = content.cell_data[key]
    data = data() if callable(data) else data
    blocks = [values for (kind, nodes), values in zip(content.cells, data) if kind in TETS and len(nodes)]
    values = np.concatenate(blocks) if data else np.empty(0)
    whole = np.isfinite(values) & (np.abs(values) <= LARGEST_ID) & (np.floor(values) == values)
    if not data or not whole.all():
        tet = int(np.argmin(whole)) if data else 0
        reason = f"that of tet {tet} is {values[tet]:g}, not a whole number of 32 bits" if data else "not all pieces have them"
        text = f"cell data {key!r} are no regions, since {reason}"
        if requested is not None:
            raise MeshError(f"{name}: {text}")
        return None, {}, [text]
    ids = values.astype(np.int64)
    if key in NONE_IF_ZERO and not ids.any() and requested is None:
        return None, {}, []
    are_named = key == PHYSICAL or PHYSICAL not in content.cell_data
    return ids, *usable_names(content.region_names if are_named else {}, np.unique(ids).tolist())


def _read_by_meshio(file: Path, data: bytes) -> FileContent:
    known = meshio.extension_to_filetypes
    if not any("".join(file.suffixes[-n:]).lower() in known for n in (1, 2)):
        raise MeshError(f"{file}: not a supported mesh: the ending {file.suffix.lower()!r} is not known")
    return read_by_meshio(file, data)


def _tet_blocks(name: str, cells: Blocks) -> tuple[list[np.ndarray], list[str]]:
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
    return ", ".join(f"{n} {kind if n == 1 else _PLURALS.get(kind, f'{kind} elements')}" for kind, n in counts.items())


def _clean_mesh(name: str, content: FileContent, fix_orientation: bool, weld, regions: str | None) -> TetMesh:
    """Return the TetMesh of the corners, unused vertices removed, the rest welded. TetMesh itself refuses invalid arrays.

    regions: name of cell data, as for `read_mesh`.
    """
    blocks, notes = _tet_blocks(name, content.cells)
    ids, names, region_notes = _regions(name, content, regions)
    points, notes, labels = content.points, content.notes + notes + region_notes, {"regions": ids, "region_names": names}
    if content.fibres:
        of_tets = [own for (kind, nodes), own in zip(content.cells, content.fibres) if kind in TETS and len(nodes)]
        labels["fibres"] = np.concatenate(of_tets)
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
        return TetMesh(points, tets, fix_orientation, source=name, notes=tuple(notes), **labels)
    points = points.astype(np.float64)
    unused = np.ones(len(points), dtype=bool)
    unused[tets] = False
    used, middles = ~unused, None
    second_order = [nodes for nodes in blocks if nodes.shape[1] == 10]
    if second_order:
        cells = np.concatenate(second_order)
        bad = np.argwhere((cells < 0) | (cells >= len(points)))
        if len(bad):
            raise MeshError(f"{name}: second-order tet {bad[0, 0]}: node {cells[tuple(bad[0])]} does not exist")
        middles = _curved_middles(name, points, cells)
        unused[cells] = False
    if unused.any():
        notes.append(f"{unused.sum()} vertices of no tet are left out, the first is vertex {unused.argmax()} of the file")
    points, tets = points[used], (np.cumsum(used) - 1)[tets]
    if weld is not None:
        points, tets, note = _weld(name, points, tets, weld)
        notes += note
    if middles is not None:
        is_second = np.repeat([nodes.shape[1] == 10 for nodes in blocks], [len(nodes) for nodes in blocks])
        labels["mid_edge"] = _middles_by_edge(name, points, tets, is_second, middles)
    return TetMesh(points, tets, fix_orientation, source=name, notes=tuple(notes), **labels)


def _curved_middles(name: str, points: np.ndarray, cells: np.ndarray) -> np.ndarray | None:
    """Return the nodes (m,6,3) on the EDGES of second-order tets (m,10), None if all are straight. Raises MeshError if nodes do
    not lie on the edges."""
    corners, nodes = points[cells[:, :4]], points[cells[:, 4:]]
    a, b = np.array(EDGES).T
    midpoints = 0.5 * (corners[:, a] + corners[:, b])
    length = np.linalg.norm(corners[:, a] - corners[:, b], axis=2)
    length[length == 0] = np.inf  # a tet without volume, refused later by TetMesh
    deviation = np.array([np.linalg.norm(nodes[:, k, None] - midpoints, axis=2) / length for k in range(6)])  # (node, tet, edge)
    typical = np.median(deviation, axis=1)
    edge = typical.argmin(axis=1)
    if len(set(edge.tolist())) < 6 or typical.min(axis=1).max() > KNOWN_ORDER:
        raise MeshError(f"{name}: the tets' ten nodes are not four corners and then one on each edge")
    is_curved = deviation[np.arange(6), :, edge].max() > STRAIGHT
    return nodes[:, np.argsort(edge)] if is_curved else None


def _middles_by_edge(name: str, points: np.ndarray, tets: np.ndarray, rows: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the nodes (k,3) on all edges of tets (m,4), in the order of `distinct_edges`; those of first order get midpoints.

    rows: (m,) bool, tets of second order, with nodes (., 6, 3) on their EDGES. Raises MeshError if tets differ about an edge.
    """
    edges, edge_of_tet = distinct_edges(tets)
    ends, of_nodes = points[edges], edge_of_tet[rows]
    middles = ends.mean(axis=1)
    middles[of_nodes.reshape(-1)] = nodes.reshape(-1, 3)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    differ = np.argwhere(np.linalg.norm(middles[of_nodes] - nodes, axis=2) > STRAIGHT * length[of_nodes])
    if len(differ):
        a, b = edges[of_nodes[tuple(differ[0])]]
        raise MeshError(f"{name}: tets have different nodes on the edge between vertices {a} and {b}: weld or remesh their parts")
    return middles


def _weld(name: str, points: np.ndarray, tets: np.ndarray, weld) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Merge vertices at most `weld` [m] apart into the first of each group; return points, tets and warnings."""
    weld = number(weld, f"{name}: weld", minimum=0.0, unit="m", error=MeshError)
    shortest = float(edge_lengths(points, tets).min())
    if weld >= shortest > 0:
        raise MeshError(f"{name}: weld = {weld:g} m must be less than the shortest edge, {shortest:g} m")
    first, labels = merged_points(points, weld)
    merged = len(points) - len(first)
    return points[first], labels[tets], [f"{merged} vertices were welded to another one"] if merged else []
