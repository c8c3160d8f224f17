"""Read triangle surfaces from modelling programs, weld them, and find faults that keep them from bounding a solid."""

import re
import warnings
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from taisoft.attributes import MeshAttributeError, guarded_record
from taisoft.errors import MeshError
from taisoft.mesh.content import one_line, read_content
from taisoft.mesh.safe_meshio import read_safely
from taisoft.mesh.tet_mesh import merge_labels
from taisoft.mesh.topology import triangle_edges

FORMATS = (".obj", ".stl", ".ply", ".off")
HEAD = re.compile(r"(?:ST)?C?N?OFF(\d*)$")  # of .off; some programs write no space before the counts
INWARD = "all normals point inward; flip them"
MAKE_ANOTHER = "make a new one, such as ts.SurfaceMesh(0.9 * surface.vertices, surface.triangles)"
FLAT = 1e-12  # a triangle has no area if its area is below this times its longest edge squared


@guarded_record("surface", MAKE_ANOTHER, MeshAttributeError)
@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles in space, checked and read-only.

    vertices: (n,3) float64 [m]; triangles: (t,3) int64, counted from 0; source: origin, which starts every message; warnings:
    changes made by the reader. Accepts anything that NumPy converts to such arrays. Raises MeshError.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    source: str = "surface"
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self):
        vertices = self._as_array("vertices", "fiu", "numbers").astype(np.float64)
        bad = np.argwhere(~np.isfinite(vertices))
        if len(bad):
            raise MeshError(f"{self.source}: vertex {bad[0, 0]} coordinate {bad[0, 1]} is not finite")
        triangles = self._as_array("triangles", "iu", "integers")
        bad = np.argwhere((triangles < 0) | (triangles >= len(vertices)))
        if len(bad):
            t, k = bad[0]
            raise MeshError(f"{self.source}: triangle {t}: vertex {triangles[t, k]} does not exist ({len(vertices)} vertices)")
        for field_name, array in (("vertices", vertices), ("triangles", triangles.astype(np.int64))):
            array.setflags(write=False)
            # The only way to store a validated value in a frozen record.
            object.__setattr__(self, field_name, array)

    def _as_array(self, what: str, kinds: str, description: str) -> np.ndarray:
        """Return the field as an array (n,3) of these kinds with at least one row."""
        try:
            array = np.asarray(getattr(self, what))
        except (ValueError, TypeError, OverflowError) as error:
            raise MeshError(f"{self.source}: {what} must be {description} of shape (n, 3): {one_line(str(error))}") from error
        if array.size == 0:
            raise MeshError(f"{self.source}: no {what} found")
        if array.dtype.kind not in kinds:
            raise MeshError(f"{self.source}: {what} must be {description}, not {array.dtype}")
        if array.ndim != 2 or array.shape[1] != 3:
            raise MeshError(f"{self.source}: {what} must have shape (n, 3), not {array.shape}")
        return array

    def __repr__(self) -> str:
        return f"SurfaceMesh({len(self.vertices)} vertices, {len(self.triangles)} triangles)"

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
        used, inverse = np.unique(self.triangles, return_inverse=True)
        return _components(len(used), inverse.reshape(-1, 3)[:, [0, 1]], inverse.reshape(-1, 3)[:, [1, 2]])

    def faults(self) -> list[str]:
        """Return what keeps the surface from bounding a solid, one sentence with a remedy for each fault."""
        ends = self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        distinct, edge, counts = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
        net_direction = np.bincount(edge.ravel(), np.where(ends[:, 0] < ends[:, 1], 1, -1), minlength=len(distinct))
        found = []
        open_edges = distinct[counts == 1]
        if len(open_edges):
            rims, inverse = np.unique(open_edges, return_inverse=True)
            holes = _components(len(rims), inverse.reshape(-1, 2))
            found.append(
                f"{holes} {'hole' if holes == 1 else 'holes'}: {len(open_edges)} edges belong to one triangle, the first is "
                f"{_edge_text(open_edges[0])}; fill holes in a modelling program, or read with a larger weld if they are cracks"
            )
        non_manifold = distinct[counts > 2]
        if len(non_manifold):
            found.append(
                f"{len(non_manifold)} edges belong to more than two triangles, the first is {_edge_text(non_manifold[0])}; "
                "remove inner walls and duplicate triangles"
            )
        mismatched = (counts == 2) & (net_direction != 0)
        if mismatched.any():
            found.append(
                f"{mismatched.sum()} edges have two triangles of opposite orientation, the first is "
                f"{_edge_text(distinct[mismatched][0])}; make the normals consistent"
            )
        if not found and self.volume < 0.0:
            found.append(INWARD)
        return found


def _edge_text(edge: np.ndarray) -> str:
    return f"({edge[0]}, {edge[1]})"


def _components(n: int, *pairs: np.ndarray) -> int:
    links = np.concatenate(pairs)
    graph = coo_matrix((np.ones(len(links), dtype=np.int8), (links[:, 0], links[:, 1])), shape=(n, n))
    return int(connected_components(graph, directed=False)[0])


def read_surface(path, weld: float = 0.0) -> SurfaceMesh:
    """Read triangles from an .obj, .stl, .ply or .off file; polygons are split into triangles.

    weld: merge vertices at most this far apart [m]; 0 merges only equal ones (files with texture or normals per corner repeat
    vertices). Triangles without area, duplicates and unused vertices are removed; all but the last are reported by a
    warning. Raises MeshError.
    """
    try:
        file = Path(path)
    except TypeError as error:
        raise MeshError(f"read_surface: path must be a file's name, not {path!r}") from error
    name, ending = str(file), file.suffix.lower()
    if ending not in FORMATS:
        raise MeshError(f"{name}: a surface is read from {', '.join(FORMATS)}, not from {ending or 'a file without ending'}")
    if isinstance(weld, bool) or not isinstance(weld, Real) or not 0.0 <= weld < np.inf:
        raise MeshError(f"{name}: weld must be a distance of at least 0 m, not {weld!r}")
    data = read_content(file)
    reader = {".obj": _read_obj, ".off": _read_off}.get(ending)
    points, triangles = reader(name, data) if reader else _read_by_meshio(file, name, data)
    return _clean(SurfaceMesh(points, triangles, name), float(weld))


def _clean(surface: SurfaceMesh, weld: float) -> SurfaceMesh:
    """Return the welded surface without degenerate and duplicate triangles; issue its warnings."""
    name, points, triangles = surface.source, surface.vertices, surface.triangles
    notes = []
    labels = merge_labels(points, weld)
    first = np.unique(labels, return_index=True)[1]
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
    triangles = triangles[~(flat | doubled)]
    if len(triangles) == 0:
        raise MeshError(f"{name}: no triangle has an area")
    used, inverse = np.unique(triangles, return_inverse=True)
    for text in notes:
        warnings.warn(f"{name}: {text}", UserWarning, stacklevel=3)
    return SurfaceMesh(points[used], inverse.reshape(-1, 3), name, notes)


def _fans(polygons: list[np.ndarray]) -> np.ndarray:
    """Return triangles (t,3) of polygons (m,k), each split as a fan around its first corner."""
    parts = [p[:, [0, k, k + 1]] for p in polygons for k in range(1, p.shape[1] - 1)]
    return np.concatenate(parts).astype(np.int64) if parts else np.empty((0, 3), dtype=np.int64)


def _read_obj(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Read positions and faces of a Wavefront file; meshio refuses files with fewer texture coordinates than positions."""
    points, polygons = [], []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        words = _split_line(line)
        try:
            if words[:1] == ["v"]:
                x, y, z = words[1:4]
                points.append((float(x), float(y), float(z)))
            elif words[:1] == ["f"]:
                corners = [int(word.split("/", 1)[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners or max(map(abs, corners)) > len(data):
                    raise ValueError
                polygons.append(np.array([[k - 1 if k > 0 else len(points) + k for k in corners]]))
        except (ValueError, OverflowError):
            raise MeshError(f"{name}: line {number} cannot be read: {one_line(line)!r}") from None
    return np.array(points, dtype=np.float64).reshape(-1, 3), _fans(polygons)


def _read_off(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Read positions and faces of an Object File Format file: OFF, counts of vertices and faces, one line each, # comments.

    Data after a vertex's position and a face's corners, such as colours, are skipped.
    Source: Geomview manual, "OFF Files".
    """
    lines = [(i, words) for i, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1) if (words := _split_line(line))]
    if not lines:
        raise MeshError(f"{name}: the file is empty")
    number, words = lines[0]
    head = HEAD.match(words[0])
    if not head:
        raise MeshError(f"{name}: line {number}: not a supported surface: expected OFF, not {one_line(words[0])!r}")
    counts, rows = [*filter(None, head.groups()), *words[1:]], lines[1:]
    if not counts and rows:
        (number, counts), rows = rows[0], rows[1:]
    try:
        n_points, n_faces = int(counts[0]), int(counts[1])
        if min(n_points, n_faces) < 0:
            raise ValueError
    except (ValueError, IndexError):
        raise MeshError(f"{name}: line {number}: expected the counts of vertices and faces") from None
    if n_points + n_faces > len(rows):
        raise MeshError(f"{name}: line {number} declares {n_points} vertices and {n_faces} faces, but {len(rows)} lines follow")
    points, polygons = [], []
    for k, (number, words) in enumerate(rows[: n_points + n_faces]):
        try:
            if k < n_points:
                x, y, z = words[:3]
                points.append((float(x), float(y), float(z)))
                continue
            n_corners = int(words[0])
            corners = [int(word) for word in words[1 : 1 + n_corners]]
            if n_corners < 3 or len(corners) < n_corners:
                raise ValueError
        except ValueError:
            what = "three coordinates" if k < n_points else "a number of at least 3 corners and as many vertices"
            raise MeshError(f"{name}: line {number}: expected {what}, not {one_line(' '.join(words))!r}") from None
        missing = [corner for corner in corners if not 0 <= corner < n_points]
        if missing:
            raise MeshError(f"{name}: line {number}: vertex {missing[0]} does not exist ({n_points} vertices)")
        polygons.append(np.array([corners]))
    return np.array(points, dtype=np.float64).reshape(-1, 3), _fans(polygons)


def _split_line(line: str) -> list[str]:
    return line.split("#", 1)[0].split()


def _read_by_meshio(file: Path, name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    counts = re.finditer(rb"^element (\w{1,20}) (\d+)", data, re.MULTILINE) if file.suffix.lower() == ".ply" else ()
    for found in counts:
        if int(found[2][:30]) > len(data):
            what = f"{found[2][:30].decode()} of element {found[1].decode()}"
            raise MeshError(f"{name}: the header declares {what}, but the file has {len(data)} bytes")
    mesh = read_safely(file, name, data, "surface")
    try:
        blocks = [np.asarray(b.data) for b in mesh.cells if b.type in ("triangle", "quad") or "polygon" in b.type]
        return np.asarray(mesh.points), _fans([b for b in blocks if b.ndim == 2])
    except (ValueError, OverflowError) as error:  # rows of different lengths
        raise MeshError(f"{name}: not a supported surface ({one_line(str(error))})") from error
