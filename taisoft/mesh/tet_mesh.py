"""A validated tetrahedral mesh.

Refused: non-finite coordinates, invalid indices, tets without volume, some tets inverted, duplicate tets, faces of three
tets, vertices of no tet. Reported by a warning: all tets inverted (they are flipped), nearly flat tets, coincident vertices,
overlapping neighbours, parts joined only at a vertex or an edge, a mesh far from the origin. Weak: overlaps of tets that share
no face are not detected.
"""

import warnings
from collections.abc import Callable

import numpy as np

from taisoft.attributes import Guarded, MeshAttributeError
from taisoft.errors import MeshError, listed
from taisoft.machine import require
from taisoft.mesh.quality import edge_lengths, mean_ratio
from taisoft.mesh.regions import FIBRES, as_array, checked_names, checked_regions, region_id, region_text
from taisoft.mesh.texture import checked_subsets, checked_uvs
from taisoft.mesh.topology import (
    Faces,
    connected_pieces,
    distinct_edges,
    first_repeated_tet,
    joint_edges,
    joint_vertices,
    merged_points,
)
from taisoft.scene.checks import array as checked_numbers

DEGENERATE = 1e-9  # a tet has no volume if it is below this times its longest edge cubed
NEARLY_FLAT = 0.02  # mean ratio below which a tet causes a warning; grids and common meshers stay above
LARGEST_COORDINATE = float(np.finfo(np.float32).max)  # [m], since forces may be computed in 32 bits
MAX_OFFSET_RATIO = 1e5  # distance from the origin over size above which a warning is issued
VTK_TETRA, VTK_TETRA10 = 10, 24  # VTK's numbers of the cell types
VTK_ORDER = [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]  # taisoft's nodes of a quadratic tet in VTK's order
COINCIDENT = 1e-9  # vertices closer than this times the mesh's diagonal are coincident


def checked_array(values, what: str, width: int, kinds: str, kinds_text: str, error: Callable[[str], MeshError]) -> np.ndarray:
    """Return values as an array (n, width) of these kinds with at least one row. error: makes an error of its text."""
    array = as_array(values, what, kinds_text, error)
    if array.size == 0:
        raise error(f"no {what} found")
    if array.dtype.kind not in kinds:
        raise error(f"{what} must be {kinds_text}, not {array.dtype}")
    if array.ndim != 2 or array.shape[1] != width:
        raise error(f"{what} must have shape ({'n' if width == 3 else 'm'}, {width}), not {array.shape}")
    return array


def checked_points(points, error: Callable[[str], MeshError], what: str = "vertices", one: str = "vertex") -> np.ndarray:
    """Return an (n,3) float64 copy of finite coordinates. error: makes an error of its text."""
    array = np.array(checked_array(points, what, 3, "fiu", "numbers", error), dtype=np.float64, order="C")
    for bad, rule in (
        (~np.isfinite(array), "is not finite"),
        (np.abs(array) > LARGEST_COORDINATE, "is {:g} m, too large for a 32-bit float"),
    ):
        if bad.any():
            i, k = np.argwhere(bad)[0]
            raise error(f"{one} {i} coordinate {k} {rule.format(array[i, k])}")
    return array


def checked_cells(cells, what: str, one: str, width: int, n: int, error: Callable[[str], MeshError]) -> np.ndarray:
    """Return an (m, width) int64 copy of cells whose corners are among n vertices. error: makes an error of its text."""
    array = checked_array(cells, what, width, "iu", "integers", error)
    bad = np.argwhere((array < 0) | (array >= n))
    if len(bad):
        text = f"{one} {bad[0, 0]}: vertex {array[tuple(bad[0])]} does not exist ({n} vertices, counted from 0)"
        if array.min() == 1 and array.max() == n:
            text += f"; all indices are 1 to {n}: they seem to count from 1, subtract 1"
        raise error(text)
    return np.array(array, dtype=np.int64, order="C")


class TetMesh(Guarded):
    """Validated, read-only tetrahedra. Another shape needs a new mesh, such as TetMesh(0.9 * old.vertices, old.tets).

    vertices: (n,3) float64 [m]. tets: (m,4) int64, every det(x1-x0, x2-x0, x3-x0) > 0. volumes: (m,) [m^3].
    surface: (t,3) int64, the faces that belong to one tet, normals outward; surface_tets: (t,) int64, the tet of each.
    flipped: int64 indices of the tets whose orientation was changed. n_components: number of parts connected by vertices.
    regions: (m,) int64, of each tet, or None; region_ids: tuple of those that tets are in, ascending; region_names: {region:
    name}, of regions that have one. mid_edge: (k,3) float64 [m], the nodes on the edges of a second-order mesh, which
    curve bodies of order 2, or None. fibres: (m,3) directions of fibres, of any length, 0 in tets without, or None. surface_uvs:
    (t,3,2) texture coordinates of the corners of `surface`, or None; surface_subsets: {name: rows (k,) of it}, without common
    ones, such as those of one material. warnings: texts, each also issued as a UserWarning. recipe: for a mesh from
    `box_mesh`, `sheet_mesh`, `ball_mesh` or `cylinder_mesh` the shape's name and the arguments that reproduce its arrays, else
    None.
    """

    _error = MeshAttributeError

    def __init__(
        self,
        vertices,
        tets,
        fix_orientation: bool = False,
        *,
        regions=None,
        region_names: dict[int, str] | None = None,
        fibres=None,
        mid_edge=None,
        surface_uvs=None,
        surface_subsets=None,
        source: str | None = None,
        notes: tuple[str, ...] = (),
    ):
        """Validate and copy the arrays.

        vertices: (n,3) numbers [m]. tets: (m,4) integers, counted from 0. fix_orientation: if only some tets are inverted, flip
        them and list them in `warnings` instead of refusing them. regions: (m,) integers, which say what material each tet is
        made of, see `Scene.add_body`; region_names: names of some or all of these numbers. fibres: (m,3)
        numbers. mid_edge: (k,3) [m], nodes on the k edges, which are sorted by their smaller and then by their larger vertex:
        bodies of order 2 are curved by them, others ignore them. surface_uvs, surface_subsets: for the rows of `surface`. source:
        the mesh's origin, such as a file's name, which starts every message. notes: a reader's warnings, added to `warnings`.
        Raises MeshError.
        """
        self.source = source
        self.recipe: dict | None = None
        self.warnings: list[str] = []
        self.vertices = checked_points(vertices, self._mesh_error)
        self.tets = self._checked_tets(tets)
        self.volumes = self._oriented_volumes(fix_orientation)
        self.regions = checked_regions(regions, self.n_tets, self._mesh_error)
        self.region_ids = () if self.regions is None else tuple(np.unique(self.regions).tolist())
        self.region_names = checked_names(region_names, self.region_ids, self._mesh_error)
        self.fibres = None if fibres is None else checked_numbers(fibres, "fibres", ((self.n_tets, 3),), self._mesh_error)
        self.mid_edge = None if mid_edge is None else checked_points(mid_edge, self._mesh_error, "mid_edge", "mid_edge")
        if mid_edge is not None and len(self.mid_edge) != (n := len(distinct_edges(self.tets)[0])):
            raise self._mesh_error(f"mid_edge has {len(self.mid_edge)} rows for {n} edges")
        self._region_of = {key: one for one in self.region_ids for key in (one, self.region_names.get(one, one))}
        faces = self._checked_faces()
        rows = faces.surface()
        self.surface = faces.triangles[rows]
        self.surface_tets = rows // 4
        self.surface_uvs = checked_uvs(surface_uvs, len(rows), self._mesh_error)
        self.surface_subsets = checked_subsets(surface_subsets, len(rows), self._mesh_error)
        self.n_components = int(connected_pieces(self.tets, self.n_verts)[0])
        self._warn_flat()
        self._warn_joints(faces)
        self._warn_coincident()
        self._warn_distance()
        for note in notes:
            self._warn(note)
        self._freeze()
        self._seal(TetMesh.__init__)

    def _label(self) -> str:
        return f"mesh of {self.source}" if self.source else "mesh"

    def _frozen_error(self, name: str) -> MeshAttributeError:
        """Return the error for any assignment: volumes and surface follow from vertices and tets."""
        instead = "make a new mesh, such as ts.TetMesh(0.9 * mesh.vertices, mesh.tets)"
        return self._error(f"{self._label()}: {name} cannot change: {instead}")

    def __setstate__(self, state: dict) -> None:
        super().__setstate__(state)
        self._freeze()  # freeze copies and unpickled meshes too

    @property
    def n_verts(self) -> int:
        """Number of vertices n."""
        return len(self.vertices)

    @property
    def n_tets(self) -> int:
        """Number of tetrahedra m."""
        return len(self.tets)

    def region_id(self, region: int | str) -> int:
        """Return the id of a region given by its name or id. Raises MeshError if no tet is in it."""
        return region_id(region, self._region_of, self._mesh_error)

    def region_text(self, region: int) -> str:
        """Return a region's name in quotes, or its id, for messages."""
        return region_text(region, self.region_names)

    def __repr__(self) -> str:
        regions = f", {len(self.region_ids)} regions" if self.regions is not None else ""
        return f"TetMesh({self.n_verts} vertices, {self.n_tets} tets, {len(self.surface)} surface triangles{regions})"

    @staticmethod
    def from_meshio(mesh, fix_orientation: bool = False, weld: float | None = None, regions: str | None = None) -> "TetMesh":
        """Return the tets of a meshio.Mesh. Arguments, checks and warnings are those of `read_mesh`. Raises MeshError."""
        from taisoft.mesh.files import from_meshio

        return from_meshio(mesh, fix_orientation, weld, regions)

    def to_meshio(self):
        """Return the mesh as a meshio.Mesh, from which `from_meshio` makes an equal one.

        Its regions are the cell data "gmsh:physical" ("region" if all are 0), their names field data, as meshio reads them from
        .msh files; its fibres are the cell data "fibres". With mid-edge nodes its cells are "tetra10".
        """
        import meshio

        points, cells = (self.vertices.copy(), self.tets.copy()) if self.mid_edge is None else self._second_order()
        record = meshio.Mesh(points, [("tetra" if cells.shape[1] == 4 else "tetra10", cells)])
        if self.regions is not None:
            names = ("gmsh:physical", "gmsh:geometrical") if self.regions.any() else ("region",)
            record.cell_data = {name: [self.regions.astype(np.int32)] for name in names}
            record.field_data = {name: np.array([region, 3]) for region, name in self.region_names.items()}
        if self.fibres is not None:
            record.cell_data[FIBRES[0]] = [self.fibres.copy()]
        return record

    def to_pyvista(self):
        """Return the mesh as a pyvista.UnstructuredGrid, regions as cell data "region". Raises OutputError without pyvista."""
        points, cells = (self.vertices.copy(), self.tets) if self.mid_edge is None else self._second_order()
        make = require("pyvista", "to_pyvista", "pyvista").UnstructuredGrid
        grid = make({VTK_TETRA if cells.shape[1] == 4 else VTK_TETRA10: cells}, points)
        if self.regions is not None:
            grid.cell_data["region"] = self.regions
        return grid

    def _second_order(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices and then mid-edge nodes (n + k, 3), and tets (m,10) in VTK's order."""
        cells = np.concatenate([self.tets, self.n_verts + distinct_edges(self.tets)[1]], axis=1)
        return np.concatenate([self.vertices, self.mid_edge]), cells[:, VTK_ORDER]

    def _warn_distance(self) -> None:
        """Warn of a mesh far from the origin: its positions lose some of their 16 digits to the distance."""
        size, distance = float(np.ptp(self.vertices, axis=0).max()), float(np.abs(self.vertices).max())
        if distance > MAX_OFFSET_RATIO * size:
            self._warn(
                f"the mesh lies {distance:.3g} m from the origin, {distance / size:.1g} times its size of {size:.3g} m: "
                f"its strains are accurate to {np.finfo(np.float64).eps * distance / size:.0e} at best; centre it to improve this"
            )

    def _named(self, text: str) -> str:
        return f"{self.source}: {text}" if self.source else text

    def _mesh_error(self, text: str) -> MeshError:
        return MeshError(self._named(text))

    def _warn(self, text: str) -> None:
        self.warnings.append(text)
        warnings.warn(self._named(text), UserWarning, stacklevel=4)

    def _checked_tets(self, tets) -> np.ndarray:
        """Return an (m,4) int64 copy: valid indices, no repeated vertex in a tet, no duplicate tet, no unused vertex."""
        array = checked_cells(tets, "tets", "tet", 4, self.n_verts, self._mesh_error)
        corners = np.sort(array, axis=1)
        twice = (corners[:, 1:] == corners[:, :-1]).any(axis=1)
        if twice.any():
            e = int(np.argmax(twice))
            raise self._mesh_error(f"tet {e} names a vertex twice: {tuple(array[e].tolist())}")
        if pair := first_repeated_tet(array):
            corners = tuple(array[pair[0]].tolist())
            raise self._mesh_error(f"tets {pair[0]} and {pair[1]} have the same four vertices {corners}")
        unused = np.setdiff1d(np.arange(self.n_verts), array)
        if len(unused):
            raise self._mesh_error(f"vertex {unused[0]} belongs to no tet and would have no mass ({len(unused)} such vertices)")
        return array

    def _oriented_volumes(self, fix_orientation: bool) -> np.ndarray:
        """Return positive volumes (m,) [m^3]; set `flipped` and reorient those tets."""
        x = self.vertices[self.tets]
        volumes = np.linalg.det(x[:, 1:] - x[:, :1]) / 6.0
        longest = edge_lengths(self.vertices, self.tets).max(axis=1)
        flat = ~(np.abs(volumes) > DEGENERATE * longest**3)  # also true if the cubed length underflows
        if flat.any():
            e = int(np.argmax(flat))
            raise self._mesh_error(
                f"tet {e} has no volume: {abs(volumes[e]):.3g} m^3 with a longest edge of {longest[e]:.3g} m "
                f"({int(flat.sum())} such tets; the volume must exceed {DEGENERATE:g} longest edge^3)"
            )
        inverted = np.flatnonzero(volumes < 0)
        self.flipped = inverted
        if len(inverted) == self.n_tets:
            self._warn(f"all {self.n_tets} tets are inverted (a mirrored mesh?); all have been flipped")
        elif len(inverted) and not fix_orientation:
            raise self._mesh_error(
                f"{len(inverted)} of {self.n_tets} tets are inverted, the first is tet {inverted[0]}; "
                "fix_orientation=True flips and lists them"
            )
        elif len(inverted):
            self._warn(f"{len(inverted)} of {self.n_tets} inverted tets have been flipped: {listed(inverted)}")
        self.tets[inverted] = self.tets[inverted][:, [0, 1, 3, 2]]
        return np.abs(volumes)

    def _checked_faces(self) -> Faces:
        """Return the faces, none of which belongs to three tets; warn of overlapping neighbours."""
        faces = Faces(self.tets)
        non_manifold = np.flatnonzero(faces.counts > 2)
        if len(non_manifold):
            start = faces.starts[non_manifold[0]]
            rows = faces.order[start : start + faces.counts[non_manifold[0]]]
            owners = np.sort(rows // 4)
            corners = tuple(np.sort(faces.triangles[rows[0]]).tolist())
            raise self._mesh_error(
                f"face {corners} is shared by {len(rows)} tets ({listed(owners)}); a face may have at most two"
            )
        # The outward faces of neighbours on opposite sides have opposite orientation; equal orientation means overlap.
        pairs = faces.pairs()
        a, b = faces.triangles[pairs[:, 0]], faces.triangles[pairs[:, 1]]
        overlap = (a == b).all(axis=1) | (a == b[:, [1, 2, 0]]).all(axis=1) | (a == b[:, [2, 0, 1]]).all(axis=1)
        if overlap.any():
            first = np.sort(pairs[int(np.argmax(overlap))] // 4)
            self._warn(
                f"{int(overlap.sum())} pairs of neighbouring tets overlap: they lie on the same side of their face; "
                f"the first are tets {first[0]} and {first[1]}"
            )
        return faces

    def _warn_flat(self) -> None:
        """Warn of badly shaped tets: the smallest height limits the stable explicit step."""
        quality = mean_ratio(edge_lengths(self.vertices, self.tets), self.volumes)
        count = int((quality < NEARLY_FLAT).sum())
        if count:
            worst = int(np.argmin(quality))
            self._warn(
                f"{count} tets are nearly flat or needles (mean ratio below {NEARLY_FLAT}, a regular tet has 1), the worst is "
                f"tet {worst} with {quality[worst]:.2g}: explicit integrators need very small steps, and the body may be too "
                "stiff there"
            )

    def _warn_joints(self, faces: Faces) -> None:
        edges = joint_edges(self.surface)
        if len(edges):
            first = tuple(edges[0].tolist())
            self._warn(f"parts are joined at an edge only at {len(edges)} edges, the first is {first}")
        vertices = np.setdiff1d(joint_vertices(self.tets, faces), edges)
        if len(vertices):
            self._warn(f"parts are joined at a vertex only at {len(vertices)} vertices: {listed(vertices)}")

    def _warn_coincident(self) -> None:
        """Warn of vertices that coincide with another one; they do not connect their tets."""
        first, labels = merged_points(self.vertices, COINCIDENT * float(np.linalg.norm(np.ptp(self.vertices, axis=0))))
        extra = np.setdiff1d(np.arange(self.n_verts), first)
        if len(extra):
            original = int(first[labels[extra[0]]])
            self._warn(
                f"{len(extra)} vertices coincide with another one, the first is vertex {extra[0]} on vertex {original}; "
                "they are not connected (read_mesh can weld them)"
            )
