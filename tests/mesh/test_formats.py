"""Formats with readers of their own, by their specifications: a mesh where its file puts it, or a refusal with the line or byte
(broken files: faults/test_fuzz.py). Rows of EXPECTED are the name, the text, and the mesh's range along x or the message.
"""

import base64
import re
import struct
import warnings
import zlib

import numpy as np
import pytest

import taisoft as ts

POINTS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))


def rows(text: str, x=0, first=1) -> str:
    """The four points, by a row's format with number and coordinates."""
    return "".join(text.format(first + k, x + a, b, c) for k, (a, b, c) in enumerate(POINTS))


NODE, TET, NEXT_TET = "{},{},{},{}\n", "*Element, type=c3d4, elset=a\n1, 1, 2,\n3, 4\n", "*ELEMENT, TYPE=C3D4H\n2,11,12,13,14\n"
NODES, NEXT_NODES = "** c\n*Node, nset=All\n" + rows(NODE), "*NODE\n" + rows(NODE, 5, 11)
PART = "*PART, NAME=A\n" + NODES + TET + "*END PART\n"
INSTANCE = "*Instance, name=B, part=a\n{}*End Instance\n"
GRID, CTETRA = rows("GRID,{},,{}.,{}.,{}.\n"), "CTETRA,1,1,1,2,3,4\n"
CORD, END = "CORD2R,5,,10.,0.,0.,10.,0.,1.\n,11.,0.,0.\n", "ENDDATA\n"
IN_5 = GRID.replace(",,", ",5,")
LARGE = rows("GRID*   {:<16}" + 16 * " " + "{:<16.1f}{:<16.1f}*G\n*G      {:<16.1f}\n") + "ctetra* " + "1               " * 3
MEDIT = "MeshVersionFormatted 2 # double\nDimension\n3\nVertices 4\n" + "".join("{} {} {} 0\n".format(*p) for p in POINTS)
GMSH = "$MeshFormat\n4 0 8\n$EndMeshFormat\n$Entities\n1 0 0 1\n9 0 0 0 0 0 0 0\n1 0 0 0 1 1 1 1 7 0\n$EndEntities\n$Nodes\n1 4\n"
GMSH += "1 3 0 4\n" + rows("{} {} {} {}\n") + "$EndNodes\n$Elements\n1 1\n1 3 4 1\n1 1 2 3 4\n$EndElements\n"
PARTS = "$PartitionedEntities\n2 0\n0 0 0 1\n5 3 1 1 2 0 0 0 1 1 1 1 8 0\n$EndPartitionedEntities\n"
EXPECTED = (
    ("a.inp", NODES + NEXT_NODES + TET + NEXT_TET, (0, 6)),
    ("a.inp", "*SYSTEM\n0,0,0,0,1,0\n-1,0,0\n" + NODES + "*SYSTEM\n" + TET + NEXT_NODES + NEXT_TET, (-1, 6)),
    ("a.inp", PART + "*PART, NAME=B\n*NODE\n" + rows(NODE, 5) + TET + "*END PART\n", (0, 6)),
    ("a.inp", PART + INSTANCE.format("") + INSTANCE.format("3,0,0\n0,0,0,0,0,2,90\n"), (-1, 1)),
    ("a.inp", PART + "*PART, NAME=Q\n" + INSTANCE.format("9,0,0\n"), "part 'Q' has no .INSTANCE and is left out"),
    ("a.inp", PART + INSTANCE.format("9,0,0\n").replace("=a", "=c"), "line 12: expected the name of a part above as PART of"),
    ("a.inp", NODES + "*NGEN\n1,9,1\n" + TET, r"line 7: \*NGEN is not supported: write its nodes out"),
    ("a.inp", "*SYST\n5,0,0\n" + NODES + TET, r"line 1: expected the whole keyword \*SYSTEM, not \*SYST"),
    ("a.inp", PART.replace("*END P", "*En Dp") + INSTANCE.format("3,0,0\n").replace("*In", "* i n"), (3, 4)),
    ("a.inp", NODES + TET.replace("type", "inp=b.inp, type"), "line 7: expected TYPE or ELSET as option of .ELEMENT, not 'INP'"),
    ("a.inp", NODES + "*NODE, SYSTEM=C\n9,1,0,0\n" + TET, "line 7: expected SYSTEM=R of .NODE, not 'C'"),
    ("a.inp", NODES + NODES + TET, "line 9: expected the number of a new node, not '1'"),
    ("a.inp", NODES + TET + TET, "line 11: expected the number of a new element, not '1'"),
    ("a.inp", NODES.replace("1,0,0,0", "1,0,0,1d999") + TET, "line 3: expected finite numbers, not .0, 0, 1d999"),
    ("a.inp", NODES + NEXT_TET, r"line 8: node 11 does not exist \(4 nodes\)"),
    ("a.bdf", "SOL 1\nbegin bulk\n" + CORD + IN_5 + CTETRA + END, (10, 11)),
    ("a.nas", CORD + "GRDSET,,5\n" + GRID + CTETRA, (10, 11)),
    ("a.fem", CORD + "CORD2C,6,5,0.,0.,0.,0.,0.,1.\n+,1.,0.,0.\nGRID,9,6,2.,90.,0.\n" + GRID, "no tetrahedra"),
    ("a.fem", "CORD2C,6,,0.,0.,0.,0.,0.,1.\n+,1.,0.,0.\n" + GRID.replace("3,,0.,1.", "3,6,1.,90.") + CTETRA, (0, 1)),
    ("a.bdf", LARGE + "2               *\n*       3               4\n", (0, 1)),
    ("a.bdf", CORD.replace(",,", ",5,") + IN_5 + CTETRA, "line 1: expected a definition of coordinate system 5, n"),
    ("a.bdf", "BEGIN BULK\n" + GRID + CTETRA, "line 6: expected ENDDATA before the file's end"),
    ("a.bdf", GRID + 2 * CTETRA, "line 6: expected the number of a new element, not 1"),
    ("a.bdf", GRID.replace("4,,0.,", "4,,1e999,") + CTETRA, "line 4: expected finite numbers, not .1e999"),
    ("a.bdf", GRID.replace("4,,0.", "4,,1_0.") + CTETRA, "line 4: expected a number in field 4 of GRID, not '1_0.'"),
    ("a.mesh", MEDIT + "Tetrahedra 1 1 2 3 4 1_0\nEnd", "line 9: expected a number, not '1_0'"),
    ("a.mesh", MEDIT + "Tetrahedra 1 1 2\n3 4", "line 9: 5 numbers should follow, but only 4 do"),
    ("a.mesh", MEDIT + "SubDomainFromGeom\n1\n3 1 1 7\nTetrahedra 1 1 2 3 4 7\nRequiredTetrahedra 1 1 End", (0, 1)),
    ("a.mesh", MEDIT + "Tetrahedra 1 1 2 3 4 7\n", "the keyword End is missing"),
    ("a.mesh", MEDIT + "Tetrahedr 1 1 2 3 4 7\nEnd\n", "line 9: expected a keyword of Medit's format, not 'Tetrahedr'"),
    ("a.mesh", MEDIT + "Tetrahedra 1\n1 2 3 5 7\nEnd\n", "line 10: expected vertices from 1 to 4, not '5'"),
    ("a.msh", GMSH, (0, 1)),
    ("a.msh", GMSH.replace("$Nodes", PARTS + "$Nodes").replace("1 3 4 1", "5 3 4 1"), (0, 1)),
    ("a.msh", GMSH.replace("4 0 8", "3.0 0 8"), r"line 2 \(.MeshFormat\): expected version 2, 4.0 or 4.1, not '3.0'"),
)


def outcome(path, data: bytes):
    """What `read_mesh` or `read_surface` gives: the mesh, or the text of its refusal or of its warnings."""
    path.write_bytes(data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            mesh = ts.read_surface(path) if path.suffix in (".ply", ".stl") else ts.read_mesh(path)
        except ts.MeshError as error:
            caught.append(error)
    texts = [str(getattr(one, "message", one)) for one in caught]
    assert all(text.startswith(f"{path}: ") and "\n" not in text for text in texts)
    return texts[0].removeprefix(f"{path}: ") if texts else mesh


@pytest.mark.parametrize("name, text, expected", EXPECTED)
def test_nodes_are_where_the_file_puts_them(tmp_path, name, text, expected):
    found = outcome(tmp_path / name, text.encode())
    if isinstance(expected, str):
        assert re.match(expected, found)
    else:
        x = found.vertices[:, 0]
        assert (x.min(), x.max()) == pytest.approx(expected, abs=1e-12) and found.volumes == pytest.approx(1 / 6)
        if name == "a.msh":
            assert found.regions.tolist() == [7]


FORMS = "ascii", "binary", "binary zlib", "appended", "appended zlib", "appended raw", "appended raw zlib"


def vtu(form: str, region: str = "region") -> bytes:
    """Two tets 5 m apart and an empty piece before them. form: "ascii", or "binary" or "appended", with "raw" and "zlib"."""
    body, appended = '<Piece NumberOfPoints="0" NumberOfCells="0"/>', b""
    head = 'byte_order="BigEndian" header_type="UInt64"' + (' compressor="vtkZLibDataCompressor"' if "zlib" in form else "")
    for x, of_cells in ((0, "region"), (5, region)):
        arrays = [("Points", "", "Float64", np.add(POINTS, (x, 0, 0)).astype(">f8")), ("Cells", "types", "UInt8", np.uint8([10]))]
        arrays += [("Cells", "connectivity", "Int64", np.arange(4, dtype=">i8")), ("Cells", "offsets", "Int8", np.int8([4]))]
        body += '<Piece NumberOfPoints="4" NumberOfCells="1">'
        for section, name, kind, values in (*arrays, ("CellData", of_cells, "Int8", np.int8([x]))):
            start = f'<{section}><DataArray type="{kind}" Name="{name}" format="{form.split()[0]}"'
            if form == "ascii":
                body += f"{start}>{' '.join(map(str, values.ravel()))}<InformationKey>2</InformationKey>"
            else:
                data = zlib.compress(values.tobytes()) if "zlib" in form else values.tobytes()
                sizes = struct.pack(">4Q", 1, values.nbytes, 0, len(data)) if "zlib" in form else struct.pack(">Q", len(data))
                coded = (base64.b64encode(sizes) + base64.b64encode(data)) if "zlib" in form else base64.b64encode(sizes + data)
                body += f"{start}>{coded.decode()}" if form[0] == "b" else f'{start} offset="{len(appended)}">'
                appended += sizes + data if "raw" in form else coded
            body += f"</DataArray></{section}>"
        body += "</Piece>"
    tail = f'<AppendedData encoding="{"raw" if "raw" in form else "base64"}">_'.encode() + appended + b"</AppendedData>"
    text = f'<VTKFile type="UnstructuredGrid" version="2.2" {head}><UnstructuredGrid>\n{body}</UnstructuredGrid>'.encode()
    return text + (tail if appended else b"") + b"</VTKFile>"


@pytest.mark.parametrize("form", FORMS)
def test_all_pieces_of_vtu_are_read(tmp_path, form):
    mesh = outcome(tmp_path / "a.vtu", vtu(form))
    assert mesh.vertices.tolist() == [[a + x, b, c] for x in (0, 5) for a, b, c in POINTS]
    assert mesh.regions.tolist() == [0, 5] and mesh.tets.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    if form == "ascii":
        path, no_types = tmp_path / "a.vtu", vtu(form, "vtkGhostType").replace(b">5<Inf", b">1<Inf")
        assert "1 cells that vtkGhostType marks are left out" in outcome(path, no_types)
        text = vtu(form, "String").replace(b'"Int8" Name="String"', b'"String" Name="String"')
        assert outcome(path, text) == "cell data 'region' are no regions, since not all pieces have them"
        assert outcome(path, vtu(form).replace(b'Points="4"', b'Points="0"')).startswith("line 2: expected 0 numbers of Points")
        assert outcome(tmp_path / "a.vtu", vtu(form).replace(b">10<", b">11<")).endswith("the file holds 2 VTK type 11 elements")


CUBE = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
HALVES = [(a, b, c) for a, *others in QUADS for b, c in zip(others, others[1:])]
MIXED = [*QUADS[:2], *HALVES[4:8], *QUADS[4:]]


@pytest.mark.parametrize("order", ["ascii", "<", ">"])
def test_ply_with_any_elements_and_properties(tmp_path, order):
    """A list before, a number beside and another list after the one of vertices; triangles among quads."""

    def packed(types: str, *values) -> bytes:
        return " ".join(map(str, values)).encode() + b"\n" if order == "ascii" else struct.pack(order + types, *values)

    kind = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"ply\nformat {kind} 1.0\ncomment \xfc\nelement edge 1\nproperty list uchar short ends\nelement vertex 8\n"
    head += "property double x\nproperty double y\nproperty double z\nproperty uchar red\n"
    head += f"element face {len(MIXED)}\nproperty float area\nproperty list uint8 int32 vertex_index\n"
    head += "property list uchar float texcoord\nend_header\n"
    data = head.encode("latin-1") + packed("B2h", 2, 0, 1) + b"".join(packed("3dB", *map(float, x), 7) for x in CUBE)
    faces = [packed(f"fB{len(face)}iBf", 0.5, len(face), *face, 1, 0.25) for face in MIXED]
    surface = outcome(tmp_path / "a.ply", data + b"".join(faces))
    assert len(surface.triangles) == 12 and surface.volume == pytest.approx(1.0) and not surface.faults()
    line, end = data.count(b"\n") + len(faces), len(data) + len(b"".join(faces))
    place = f"line {line}" if order == "ascii" else f"byte {end - 1}"
    assert outcome(tmp_path / "a.ply", (data + b"".join(faces))[: end - 5 if order == "ascii" else end - 1]).startswith(place)
    assert outcome(tmp_path / "a.ply", data + b"".join(faces) + b"1").endswith("the last row that the header declares")
    lost = outcome(tmp_path / "a.ply", (data + b"".join(faces)).replace(b"vertex_index", b"vertices"))
    assert lost.startswith("line 11: expected faces with a list called vertex_indices or vertex_index, not 'face' with area, ")


def test_stl_of_any_header(tmp_path):
    """Text of several solids in capitals, with exponents, a name that is not UTF-8 and old line ends; a byte more or less."""
    path, facet = tmp_path / "a.stl", "facet normal 0 0 nan\nouter loop\n{}endloop\nendfacet\n"
    facets = [facet.format("".join("vertex {:.1e} {:+} {}\n".format(*CUBE[k]) for k in triangle)) for triangle in HALVES]
    solids = [f"solid Würfel\n{''.join(own)}endsolid facet normal\n" for own in (facets[:5], facets[5:])]
    text = "".join(solids).encode("latin-1")
    binary = struct.pack("<I", 12) + b"".join(struct.pack("<12fH", *3 * [0] + [x for k in t for x in CUBE[k]], 0) for t in HALVES)
    texts = text, text.upper(), text.replace(b"\n", b"\r")
    for data in (*texts, *(head.ljust(80) + binary for head in (b"solid a facet", b"\xef\xbb\xbf"))):
        surface = outcome(path, data)
        assert len(surface.triangles) == 12 and surface.volume == pytest.approx(1.0) and len(surface.vertices) == 8
    assert outcome(path, b"solid facet normal".ljust(80) + binary + b"\0").endswith(", but there are 685")
    for data, n in ((binary + b"\0", 685), (binary[:-1], 683)):
        assert outcome(path, b"solid".ljust(80) + data).endswith(f" 684 bytes for 12 triangles, but there are {n}")
    assert outcome(path, text.replace(b"endloop", b"endlop")) == "line 7: expected 'endloop', not 'endlop'"
    assert outcome(path, text[: text.rfind(b"endsolid")]) == "line 87: the file ends where 'endsolid' should follow"
