"""Read triangle surfaces from modelling programs, find faults that keep them from bounding a solid, and fill them with tets.

Tets are made by fTetWild (package wildmeshing, MPL 2.0, installed by the extra `mesh`). It accepts faulty surfaces, stays within
an envelope around them, and finds the inside by winding numbers.
Source: Hu, Schneider, Wang, Zorin, Panozzo 2020, Fast tetrahedral meshing in the wild.
"""

import warnings
from dataclasses import field
from importlib.util import find_spec

import numpy as np

from taisoft.attributes import MeshAttributeError, guarded_record
from taisoft.errors import MeshError, reworded
from taisoft.files import as_path
from taisoft.machine import require
from taisoft.mesh.obj_off import read_obj, read_off
from taisoft.mesh.ply import read_ply
from taisoft.mesh.safe_reading import read_content, run_child
from taisoft.mesh.stl import read_stl
from taisoft.mesh.tet_mesh import TetMesh, checked_cells, checked_points
from taisoft.mesh.texture import checked_subsets, checked_uvs, subsets_of, transferred
from taisoft.mesh.topology import Faces, connected_pieces, crack_widths, linked_groups, merged_points, triangle_edges
from taisoft.scene.checks import instance, number

READERS = {".obj": read_obj, ".stl": read_stl, ".ply": read_ply, ".off": read_off}
FORMATS = tuple(READERS)
INWARD = "all normals point inward; flip them"
MAKE_ANOTHER = "make a new one, such as ts.SurfaceMesh(0.9 * surface.vertices, surface.triangles)"
FLAT = 1e-12  # a triangle has no area if its area is below this times its longest edge squared
EDGES_PER_DIAGONAL = 20  # default edge length of tets: the diagonal over this
ENVELOPE = 0.1  # default envelope over the edge length


@guarded_record("surface", MAKE_ANOTHER, MeshAttributeError)
class SurfaceMesh:
    """Triangles in space, checked and read-only.

    vertices: (n,3) float64 [m]; triangles: (t,3) int64, counted from 0; source: origin, which starts every message; warnings:
    changes made by the reader; uvs: (t,3,2) float64 texture coordinates of each triangle's corners, or None; subsets: {name:
    triangles (k,) int64}, such as those of one material, without common ones. Accepts anything that NumPy converts to such
    arrays. Raises MeshError.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    source: str = "surface"
    warnings: list[str] = field(default_factory=list)
    uvs: np.ndarray | None = None
    subsets: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self):
        vertices = checked_points(self.vertices, self._error)
        triangles = checked_cells(self.triangles, "triangles", "triangle", 3, len(vertices), self._error)
        n = len(triangles)
        texture = {"uvs": checked_uvs(self.uvs, n, self._error), "subsets": checked_subsets(self.subsets, n, self._error)}
        self.__dict__.update(vertices=vertices, triangles=triangles, **texture)  # the only way to store values in a frozen record

    def _error(self, text: str) -> MeshError:
        return MeshError(f"{self.source}: {text}")

    def __repr__(self) -> str:
        return f"SurfaceMesh({len(self.vertices)} vertices, {len(self.triangles)} triangles)"

    def to_pyvista(self):
        """Return the surface as a pyvista.PolyData. Raises OutputError without pyvista."""
        return require("pyvista", "to_pyvista", "pyvista").PolyData.from_regular_faces(self.vertices.copy(), self.triangles)

    @property
    def volume(self) -> float:
        """Enclosed volume [m^3], negative if all normals point inward; meaningless for a surface with holes."""
        a, b, c = np.moveaxis(self.vertices[self.triangles] - self.vertices.mean(axis=0), 1, 0)
        return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)

    @property
    def area(self) -> float:
        """Total area [m^2]."""
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)

    @property
    def closed(self) -> bool:
        """Whether every edge belongs to more than one triangle."""
        return bool((triangle_edges(self.triangles)[1] > 1).all())

    @property
    def n_pieces(self) -> int:
        """Number of parts that share no vertex."""
        used, corner = np.unique(self.triangles, return_inverse=True)
        return int(connected_pieces(corner.reshape(-1, 3), len(used))[0])

    @property
    def n_holes(self) -> int:
        """Number of connected rims, whose edges belong to one triangle."""
        edges, counts, _ = triangle_edges(self.triangles)
        rims, end = np.unique(edges[counts == 1], return_inverse=True)
        return int(linked_groups(*end.reshape(-1, 2).T, len(rims))[0]) if len(rims) else 0

    def faults(self) -> list[str]:
        """Return what keeps the surface from bounding a solid, one sentence with a remedy for each fault."""
        edges, counts, net_direction = triangle_edges(self.triangles)
        single, crowded = edges[counts == 1], edges[counts > 2]
        mismatched = edges[(counts == 2) & (net_direction != 0)]
        found = []
        if len(single):
            found.append(
                f"{_holes_text(self.n_holes)}: {len(single)} edges belong to one triangle, the first is "
                f"{_edge_text(single)}; {self._cracks_text()}tetrahedralize closes holes, but roughly: fill them "
                "beforehand for a clean surface"
            )
        if len(crowded):
            found.append(
                f"{len(crowded)} edges belong to more than two triangles, the first is {_edge_text(crowded)}; "
                "remove inner walls and duplicate triangles"
            )
        if len(mismatched):
            found.append(
                f"{len(mismatched)} edges have two triangles of opposite orientation, the first is "
                f"{_edge_text(mismatched)}; make the normals consistent"
            )
        return [INWARD] if not found and self.volume < 0.0 else found

    def _cracks_text(self) -> str:
        """Return how wide cracks are, and what welds them; nothing if there are none."""
        widths = crack_widths(self.vertices, self.triangles)
        if not len(widths):
            return ""
        width = float(f"{1.006 * widths.max():.3g}")  # rounded up
        corners = self.vertices[self.triangles]
        shortest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min())
        also = f", and with them edges of {shortest:.3g} m" if width >= shortest else ""
        return f"{len(widths)} of them are the sides of cracks at most {width:g} m wide, which weld = {width:g} m closes{also}; "


def _holes_text(n: int) -> str:
    return f"{n} {'hole' if n == 1 else 'holes'}"


def _edge_text(edges: np.ndarray) -> str:
    return f"({edges[0, 0]}, {edges[0, 1]})"


def read_surface(path, weld: float = 0.0) -> SurfaceMesh:
    """Read triangles from an .obj, .stl, .ply or .off file; polygons are split into triangles.

    path: the file, or another library's surface with `vertices` (n,3) and `faces` (t,3), such as a trimesh.Trimesh. weld: merge
    vertices at most this far apart [m]; 0 merges only equal ones (files with texture or normals per corner repeat vertices).
    Triangles without area, duplicates and unused vertices are removed; all but the last are reported by a warning. Texture
    coordinates of .obj and .ply, and in .obj materials, else groups, else objects, are its uvs and subsets. Raises MeshError.
    """
    surface = as_surface(path, weld)
    if surface is not path:
        return surface
    file = as_path(path, "read_surface", MeshError, "be a file's name or have vertices and faces")
    name, ending = str(file), file.suffix.lower()
    if ending not in FORMATS:
        raise MeshError(f"{name}: a surface is read from {', '.join(FORMATS)}, not from {ending or 'a file without ending'}")
    points, polygons, *texture = READERS[ending](name, read_content(file))
    uvs, subsets = texture or (None, {})
    triangles, notes = _fans(polygons, np.empty((0, 3), dtype=np.int64)), []
    if uvs is not None:
        uvs = _fans(uvs, np.empty((0, 3, 2)))
        missing = np.isnan(uvs).any(axis=(1, 2))
        uvs[missing] = 0.0
        if missing.any():
            notes = [
                f"{missing.sum()} triangles have no texture coordinates, and get 0, the first is triangle {missing.argmax()}"
            ]
    parents = np.repeat(np.arange(len(polygons)), [nodes.shape[0] * (nodes.shape[1] - 2) for nodes in polygons])
    return clean_surface(SurfaceMesh(points, triangles, name, notes, uvs, subsets_of(subsets, parents)), weld)


def _fans(polygons: list[np.ndarray], none: np.ndarray) -> np.ndarray:
    """Return values at the corners of triangles: each polygon is split as a fan around its first corner. none: for no polygon."""
    return np.concatenate([none, *(one[:, [0, k, k + 1]] for one in polygons for k in range(1, one.shape[1] - 1))])


def as_surface(mesh, weld: float = 0.0):
    """Return another library's surface, with vertices and faces, as `read_surface` reads it, anything else as it is."""
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        return mesh
    return clean_surface(SurfaceMesh(mesh.vertices, mesh.faces, type(mesh).__name__), weld)


def clean_surface(surface: SurfaceMesh, weld: float) -> SurfaceMesh:
    """Return the surface, welded [m], without degenerate and duplicate triangles; issue its warnings, at the caller's caller."""
    name, points, triangles = surface.source, surface.vertices, surface.triangles
    notes = list(surface.warnings)
    first, labels = merged_points(points, number(weld, f"{name}: weld", minimum=0.0, unit="m", error=MeshError))
    if len(first) < len(points):
        notes.append(f"{len(points) - len(first)} of {len(points)} vertices were welded to another one")
    points, triangles = points[first], labels[triangles]
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    longest = np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 2.0 * FLAT * longest
    doubled = np.ones(len(triangles), dtype=bool)
    doubled[np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1]] = False
    for which, what in ((flat, "without area"), (doubled & ~flat, "given twice")):
        if which.any():
            notes.append(f"{which.sum()} triangles {what} are left out, the first is triangle {which.argmax()}")
    kept = np.flatnonzero(~(flat | doubled))
    triangles, uvs = triangles[kept], None if surface.uvs is None else surface.uvs[kept]
    if len(triangles) == 0:
        raise MeshError(f"{name}: no triangle has an area")
    used, inverse = np.unique(triangles, return_inverse=True)
    for text in notes:
        warnings.warn(f"{name}: {text}", UserWarning, stacklevel=3)
    return SurfaceMesh(points[used], inverse.reshape(-1, 3), name, notes, uvs, subsets_of(surface.subsets, kept))


def tetrahedralize(surface: SurfaceMesh, edge_length: float | None = None, envelope: float | None = None) -> TetMesh:
    """Return a tetrahedral mesh of the volume enclosed by a surface.

    edge_length: approximate edge length of the tets [m]; None for a twentieth of the diagonal. envelope: largest distance [m]
    of the new surface from the old one, except where holes are closed; None for a tenth of edge_length. Warns of the surface's
    faults, and of the volume with holes closed. The mesh's surface gets the uvs and subsets of the nearest triangles. Raises
    MeshError if the extra `mesh` is missing, nothing is enclosed, or the mesher fails.
    """
    surface = instance(as_surface(surface), "tetrahedralize: surface (see read_surface)", SurfaceMesh, error=MeshError)
    name, diagonal = surface.source, float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    lengths = {"above": 0.0, "below": diagonal, "unit": "m, the surface's diagonal", "error": MeshError}
    edge_length = diagonal / EDGES_PER_DIAGONAL if edge_length is None else number(edge_length, f"{name}: edge_length", **lengths)
    envelope = ENVELOPE * edge_length if envelope is None else number(envelope, f"{name}: envelope", **lengths)
    if find_spec("wildmeshing") is None:
        raise MeshError(f"{name}: tetrahedralize needs the package wildmeshing: pip install 'taisoft[mesh]'")
    faults = surface.faults()
    for text in faults:
        warnings.warn(f"{name}: {text}", UserWarning, stacklevel=2)
    inward = faults == [INWARD]
    triangles = surface.triangles[:, ::-1] if inward else surface.triangles
    vertices, tets = _run_mesher(name, surface.vertices, triangles, edge_length / diagonal, envelope / diagonal)
    if len(tets) == 0:
        raise MeshError(f"{name}: the surface encloses nothing: no tets were made")
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    inverted = np.linalg.det(edges) < 0
    tets[inverted] = tets[inverted][:, [0, 2, 1, 3]]
    used, inverse = np.unique(tets, return_inverse=True)
    vertices, tets = vertices[used], inverse.reshape(-1, 4)
    faces = Faces(tets)
    uvs, subsets = transferred(surface, vertices, faces.triangles[faces.surface()])
    mesh = TetMesh(vertices, tets, surface_uvs=uvs, surface_subsets=subsets, source=name)
    volume_error = abs(mesh.volumes.sum() - abs(surface.volume))
    if (inward or not faults) and volume_error > envelope * surface.area:
        raise MeshError(
            f"{name}: the tets fill {mesh.volumes.sum():.4g} m^3 of {abs(surface.volume):.4g}, a larger difference than an "
            f"envelope of {envelope:.3g} m allows: use a smaller edge_length"
        )
    if holes := surface.n_holes:
        text = f"{_holes_text(holes)} {'was' if holes == 1 else 'were'} closed, and the tets fill {mesh.volumes.sum():.4g} m^3"
        text += "; the closing surface may be rough and bulge beyond the envelope"
        warnings.warn(f"{name}: {text}", UserWarning, stacklevel=2)
    return mesh


def _run_mesher(name: str, vertices: np.ndarray, triangles: np.ndarray, length: float, envelope: float):
    """Return vertices (n,3) and tets (m,4). length, envelope: fractions of the diagonal."""
    center = vertices.mean(axis=0)  # centre the surface: far from the origin digits are lost
    with reworded(MeshError, f"{name}: the mesher failed: "):
        found = run_child("fill", vertices=vertices - center, triangles=triangles, edge_length=length, envelope=envelope)
    return found["vertices"] + center, found["tets"]
