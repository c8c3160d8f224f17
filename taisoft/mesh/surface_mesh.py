"""A surface of triangles as modelling programs give it: read, welded, and looked at for what makes it unfit for a solid."""

import contextlib
import io
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import meshio
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from taisoft.errors import MeshError
from taisoft.mesh.content import one_line, read_content
from taisoft.mesh.tet_mesh import merge_labels

FORMATS = (".obj", ".stl", ".ply", ".off")
FLAT = 1e-12  # a triangle's area below this times its longest edge squared counts as none


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """vertices: (n,3) float64 [m]; triangles: (t,3) int64; source: where it comes from; warnings: what the reader changed."""

    vertices: np.ndarray
    triangles: np.ndarray
    source: str = "surface"
    warnings: list[str] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"SurfaceMesh({len(self.vertices)} vertices, {len(self.triangles)} triangles)"

    @property
    def volume(self) -> float:
        """What it encloses [m^3], negative where it is inside out; of a surface with holes a number without meaning."""
        a, b, c = np.moveaxis(self.vertices[self.triangles] - self.vertices.mean(axis=0), 1, 0)
        return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)

    @property
    def area(self) -> float:
        """Of all triangles together [m^2]."""
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)

    @property
    def closed(self) -> bool:
        """Whether every edge belongs to more than one triangle."""
        ends = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        return bool((np.unique(ends, axis=0, return_counts=True)[1] > 1).all())

    @property
    def n_pieces(self) -> int:
        """Parts that share no vertex."""
        used, inverse = np.unique(self.triangles, return_inverse=True)
        return _components(len(used), inverse.reshape(-1, 3)[:, [0, 1]], inverse.reshape(-1, 3)[:, [1, 2]])

    def faults(self) -> list[str]:
        """What keeps the surface from bounding a solid, a sentence each with what to do; empty where nothing does."""
        ends = self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        distinct, edge, counts = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
        ways = np.bincount(edge.ravel(), np.where(ends[:, 0] < ends[:, 1], 1, -1), minlength=len(distinct))
        found = []
        open_edges = distinct[counts == 1]
        if len(open_edges):
            rims, inverse = np.unique(open_edges, return_inverse=True)
            holes = _components(len(rims), inverse.reshape(-1, 2))
            found.append(
                f"{holes} {'hole' if holes == 1 else 'holes'}: {len(open_edges)} edges belong to one triangle, the first is "
                f"{_named(open_edges[0])}; fill holes in a modelling program, or read with a larger weld if they are cracks"
            )
        many = distinct[counts > 2]
        if len(many):
            found.append(
                f"{len(many)} edges belong to more than two triangles, the first is {_named(many[0])}; remove inner walls and "
                "doubled triangles"
            )
        turned = (counts == 2) & (ways != 0)
        if turned.any():
            found.append(
                f"{turned.sum()} edges whose two triangles look to opposite sides, the first is {_named(distinct[turned][0])}; "
                "make the normals consistent"
            )
        if not found and self.volume < 0.0:
            found.append("all triangles look inward; flip the normals")
        return found


def _named(edge: np.ndarray) -> str:
    return f"({edge[0]}, {edge[1]})"


def _components(n: int, *pairs: np.ndarray) -> int:
    links = np.concatenate(pairs)
    graph = coo_matrix((np.ones(len(links), dtype=np.int8), (links[:, 0], links[:, 1])), shape=(n, n))
    return int(connected_components(graph, directed=False)[0])


def read_surface(path, weld: float = 0.0) -> SurfaceMesh:
    """Read triangles from an .obj, .stl, .ply or .off file; polygons are cut into triangles.

    weld: vertices at most this far apart [m] become one, 0 for equal ones only (files with texture or normals per corner hold
    each vertex several times). Triangles without area and doubled ones, and vertices of none, are left out and told as a
    warning. Raises MeshError.
    """
    file = Path(path)
    name, ending = str(file), file.suffix.lower()
    if ending not in FORMATS:
        raise MeshError(f"{name}: a surface is read from {', '.join(FORMATS)}, not from {ending or 'a file without ending'}")
    if not np.isscalar(weld) or isinstance(weld, (bool, str)) or not 0.0 <= weld < np.inf:
        raise MeshError(f"{name}: weld must be a distance of at least 0 m, not {weld!r}")
    data = read_content(file)
    points, triangles = _read_obj(name, data) if ending == ".obj" else _read_by_meshio(file, name)
    return _cleaned(name, points, triangles, float(weld))


def _cleaned(name: str, points: np.ndarray, triangles: np.ndarray, weld: float) -> SurfaceMesh:
    if len(triangles) == 0:
        raise MeshError(f"{name}: no triangles found")
    bad = np.argwhere(~np.isfinite(points))
    if len(bad):
        raise MeshError(f"{name}: vertex {bad[0, 0]} coordinate {bad[0, 1]} is not finite")
    bad = np.argwhere((triangles < 0) | (triangles >= len(points)))
    if len(bad):
        raise MeshError(
            f"{name}: triangle {bad[0, 0]}: vertex {triangles[tuple(bad[0])]} does not exist ({len(points)} vertices)"
        )
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
    return SurfaceMesh(points[used], inverse.reshape(-1, 3).astype(np.int64), name, notes)


def _fans(polygons: list[np.ndarray]) -> np.ndarray:
    """(t,3) triangles of polygons (m,k), each as a fan round its first corner."""
    parts = [p[:, [0, k, k + 1]] for p in polygons for k in range(1, p.shape[1] - 1)]
    return np.concatenate(parts).astype(np.int64) if parts else np.empty((0, 3), dtype=np.int64)


def _read_obj(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Positions and faces of a Wavefront file; meshio refuses those with fewer texture coordinates than positions."""
    points, polygons = [], []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        try:
            if words[:1] == ["v"]:
                x, y, z = words[1:4]
                points.append((float(x), float(y), float(z)))
            elif words[:1] == ["f"]:
                corners = [int(word.split("/", 1)[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError
                polygons.append(np.array([[k - 1 if k > 0 else len(points) + k for k in corners]]))
        except (ValueError, OverflowError):
            raise MeshError(f"{name}: line {number} cannot be read: {one_line(line)!r}") from None
    return np.array(points, dtype=np.float64).reshape(-1, 3), _fans(polygons)


def _read_by_meshio(file: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), np.errstate(all="ignore"):
            mesh = meshio.read(file)
        blocks = [np.asarray(b.data) for b in mesh.cells if b.type in ("triangle", "quad", "polygon") or "polygon" in b.type]
        return np.asarray(mesh.points, dtype=np.float64).reshape(-1, 3), _fans([b for b in blocks if b.ndim == 2])
    except (Exception, SystemExit) as error:  # meshio may end the program or raise anything on a broken file
        said = f"{type(error).__name__}: {error}" if isinstance(error, Exception) else printed.getvalue()
        raise MeshError(f"{name}: not a supported surface ({one_line(said)})") from error
