"""A simulator's present state as a VTK XML file of an unstructured grid (.vtu), for ParaView and other readers of VTK's formats.

Points are the nodes of all bodies, in the order added; cells are their tets, linear ones (VTK's type 10) or quadratic ones (24),
and then the triangles (5) of a skin that is touched; of a rigid body they are its triangles. VTK numbers the edges of a quadratic
tet (01, 12, 20, 03, 13, 23), taisoft (01, 02, 03, 12, 13, 23).

| data | of | meaning |
| --- | --- | --- |
| displacement, velocity | points | from the rest shape at its place [m]; [m/s] |
| contact_impulse | points | of the last step's contacts on the node [N s], where things can touch |
| contact_pressure, contact_traction | points | of the last step, on the deformed surface [Pa], 0 inside |
| contact_slip, accumulated_slip | points | in the last step and since the start [m], see `contact_pressure` |
| contact_state | points | 0 open, 1 stick, 2 slip |
| estimated_error | points | of the position [m], -1 where unknown, in a run with error=True |
| body | cells | number of the body |
| region | cells | of the mesh, 0 for bodies without regions; absent if no body has any |
| stress | cells | Cauchy stress [Pa], xx yy zz xy yz xz, not finite in a flat tet, 0 in triangles |
| von_mises | cells | its von Mises equivalent [Pa] |
| fibres | cells | `sim.fibres()`: directions of fibres, each as long as its stretch, 0 elsewhere; absent if no body has any |
| TimeValue | file | time [s] |
| kinetic, elastic, gravity, loads, dissipated | file | energies [J] |
| body NAME | file | number of the body called NAME |

Points are float64, what is derived from them float32. Arrays are compressed by zlib, where that helps, and encoded in base64.
meshio writes such files too, but without data of the file, so without the time.
"""

import base64
import dataclasses
import functools
import zlib
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np

from taisoft.dynamics.readout import nodal_impulses
from taisoft.errors import OutputError
from taisoft.files import as_path, write_bytes
from taisoft.machine import require
from taisoft.mesh.tet_mesh import VTK_ORDER
from taisoft.output.nodal_fields import UNKNOWN_ERROR, surface_values, von_mises
from taisoft.output.viewpoint import start_positions
from taisoft.scene.rigid import RigidBody

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

ENDING = ".vtu"
CELL_TYPES = {3: 5, 4: 10, 10: 24}  # nodes of a cell -> VTK's number of its type
SYMMETRIC = ([0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2])  # rows and columns of a tensor's six components in VTK's order
TYPES = {"float64": "Float64", "float32": "Float32", "int64": "Int64", "int32": "Int32", "uint8": "UInt8"}
BLOCK = 2**20  # bytes that are compressed at a time
COMPRESSION = 1  # zlib's level; higher ones take several times as long for a few percent of such numbers
OF_SURFACE = {"contact_pressure": "pressure", "contact_traction": "traction", "contact_slip": "slip"}
OF_SURFACE |= {"accumulated_slip": "accumulated_slip", "contact_state": "state"}  # data of points -> field of `ContactPressure`
SAMPLE, WORTHWHILE = 2**14, 0.5  # a block is compressed if its first SAMPLE bytes shrink to this fraction, else stored as it is


def write_vtu(self: "Simulator", path) -> None:
    """Write the present state as a .vtu file, atomically: nodes and tets of all bodies, with displacements, velocities, stresses.

    path: a name that ends in .vtu. `taisoft/output/vtu.py` and the manual's page on files list the data. Raises OutputError for
    another ending, or if the file cannot be written.
    """
    file = as_path(path, "write_vtu", OutputError)
    if file.suffix.lower() != ENDING:
        raise OutputError(f"{file}: the name of a VTK file of tets must end in {ENDING}")
    write_bytes(file, Grid(self.scene).encoded(self))


def to_pyvista(self: "Simulator"):
    """Return the present state as a pyvista.UnstructuredGrid with the data of `write_vtu`. Raises OutputError without pyvista."""
    pyvista, grid = require("pyvista", "to_pyvista", "pyvista"), Grid(self.scene)
    x, points, cells, of_file = grid.state(self)
    offsets = grid.cells["offsets"]
    sizes = np.diff(offsets, prepend=0)  # which pyvista reads before the nodes of each cell
    made = pyvista.UnstructuredGrid(np.insert(grid.cells["connectivity"], offsets - sizes, sizes), grid.cells["types"], x)
    made.point_data.update(points)
    made.cell_data.update(grid.cell_data | cells)
    for name, value in of_file.items():
        made.field_data[name] = [value]
    return made


class Grid:
    """The cells of a scene, which are encoded once; `encoded` adds a state. scene: read once."""

    def __init__(self, scene):
        self._names, self._start = [body.name for body in scene.bodies], start_positions(scene)
        self._has_fibres = any(body.fibres is not None for body in scene.bodies)
        connectivity, of_cells, first, n_tet = [], [], 0, 0
        for k, one in enumerate(scene.bodies):
            n_tets, regions = one.mesh.n_tets, one.mesh.regions
            tets = np.arange(n_tet, n_tet + n_tets)
            parts = [] if isinstance(one, RigidBody) else [(one.nodes.elements, tets, 0 if regions is None else regions)]
            if one.nodes.embedded is not None:
                parts.append((one.nodes.surface, -1, 0))
            for elements, tet, region in parts:
                order = VTK_ORDER if elements.shape[1] == 10 else slice(None)
                connectivity.append((first + elements[:, order]).ravel())
                of_cells.append(np.broadcast_arrays(np.full(len(elements), elements.shape[1]), k, tet, region))
            first, n_tet = first + one.n_nodes, n_tet + n_tets
        sizes, body, self._tet, region = np.concatenate(of_cells, axis=1)  # of each cell, tet -1 for triangles
        self.cells = {
            "connectivity": np.concatenate(connectivity).astype(np.int64),
            "offsets": np.cumsum(sizes, dtype=np.int64),
            "types": np.array([CELL_TYPES.get(n, 0) for n in range(11)], dtype=np.uint8)[sizes],
        }
        self.cell_data = {"body": body.astype(np.int32)}
        if any(one.mesh.regions is not None for one in scene.bodies):
            self.cell_data["region"] = region.astype(np.int32)

    @functools.cached_property
    def _encoded(self) -> list[list[str]]:
        """The arrays of the cells, and those of their constant data, as text."""
        return [[_array(name, values) for name, values in of.items()] for of in (self.cells, self.cell_data)]

    def state(self, sim: "Simulator", errors: bool = False) -> tuple[np.ndarray, dict, dict, dict]:
        """Return positions (n,3) [m] of sim's present state, and its data of points, cells and file by name. errors: as below."""
        x, sigma = sim.positions(), sim.stress()[self._tet]
        sigma[self._tet < 0] = 0.0
        points = {"displacement": x - self._start, "velocity": sim.velocities()}
        if sim.touches:
            points["contact_impulse"] = nodal_impulses(sim.contacts(), len(x))
            points |= dict(zip(OF_SURFACE, surface_values(sim, *OF_SURFACE.values())))
        if errors:
            points["estimated_error"] = np.nan_to_num(sim.nodal_errors(), nan=UNKNOWN_ERROR)
        with np.errstate(invalid="ignore"):  # of flat tets
            cells = {"stress": sigma[:, SYMMETRIC[0], SYMMETRIC[1]], "von_mises": von_mises(sigma)}
        if self._has_fibres:
            cells["fibres"] = sim.fibres()[self._tet]
            cells["fibres"][self._tet < 0] = 0.0
        of_file = {"TimeValue": sim.time} | dataclasses.asdict(sim.energies())
        of_file |= {f"body {name}": k for k, name in enumerate(self._names)}
        points, cells = ({name: values.astype(np.float32) for name, values in of.items()} for of in (points, cells))
        return x, points, cells, of_file

    def encoded(self, sim: "Simulator", errors: bool = False) -> bytes:
        """Return the file's bytes for sim's present state. errors: whether it runs with error=True."""
        x, points, cells, of_file = self.state(sim, errors)
        of_cells, constant = self._encoded
        parts = [
            *("<FieldData>", *(_number(name, value) for name, value in of_file.items()), "</FieldData>"),
            f'<Piece NumberOfPoints="{len(x)}" NumberOfCells="{len(self._tet)}">',
            *("<Points>", _array("Points", x), "</Points>"),
            *("<Cells>", *of_cells, "</Cells>"),
            *("<PointData>", *(_array(name, values) for name, values in points.items()), "</PointData>"),
            *("<CellData>", *constant, *(_array(name, values) for name, values in cells.items()), "</CellData>"),
            "</Piece>",
        ]
        return vtk_file("UnstructuredGrid", parts, 'header_type="UInt64" compressor="vtkZLibDataCompressor"')


def vtk_file(kind: str, parts: list[str], attributes: str = "") -> bytes:
    """Return a VTK XML file of a kind, such as UnstructuredGrid, made of parts."""
    head = f'<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" {attributes}>'
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', head, f"<{kind}>", *parts, f"</{kind}>", "</VTKFile>\n"]).encode()


def _number(name: str, value: float | int) -> str:
    """Return one number of the file as text, all digits of it."""
    kind = "Int32" if isinstance(value, int) else "Float64"
    return f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfTuples="1" format="ascii">{value!r}</DataArray>'


def _array(name: str, values: np.ndarray) -> str:
    """Return an array (n,) or (n,k) with VTK's header: number of blocks, size of each and of the last, compressed sizes."""
    data = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()
    blocks = [data[k : k + BLOCK] for k in range(0, len(data), BLOCK)]
    packed = [zlib.compress(block, _level(block)) for block in blocks]
    header = np.array([len(blocks), BLOCK, len(blocks[-1]), *map(len, packed)], dtype="<u8").tobytes()
    text = (base64.b64encode(header) + base64.b64encode(b"".join(packed))).decode()
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    return f'<DataArray type="{TYPES[values.dtype.name]}" Name={quoteattr(name)}{components} format="binary">{text}</DataArray>'


def _level(block: bytes) -> int:
    """Return zlib's level for a block: most digits of positions and stresses are random, and compressing them only takes time."""
    sample = block[:SAMPLE]
    return COMPRESSION if len(zlib.compress(sample, COMPRESSION)) < WORTHWHILE * len(sample) else 0
