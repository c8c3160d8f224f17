"""Fibres in mesh files: vectors of cells in .vtu, .vtk and Gmsh's element data, text and binary, are read back bit for bit, with
regions too; elements without data have none; broken sections are refused with their line; what a format cannot hold is reported.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError

BOX = ts.box_mesh((2, 1, 1), (0.3, 0.1, 1 / 3))
FIBRES = np.random.default_rng(0).standard_normal((BOX.n_tets, 3)) / 3.0
IDS = np.arange(10) // 4 + 1


@pytest.mark.parametrize("ending", [".msh", ".vtu", ".vtk"])
@pytest.mark.parametrize("regions", [None, IDS])
def test_fibres_are_read_back(tmp_path, ending, regions):
    mesh = ts.TetMesh(BOX.vertices, BOX.tets, regions=regions, fibres=FIBRES)
    ts.write_mesh(tmp_path / f"a{ending}", mesh)
    again = ts.read_mesh(tmp_path / f"a{ending}")
    assert np.array_equal(again.fibres, FIBRES) and np.array_equal(again.tets, BOX.tets) and again.warnings == ()
    assert (again.regions is None) == (regions is None) and not again.fibres.flags.writeable
    assert np.array_equal(ts.TetMesh.from_meshio(mesh.to_meshio()).fibres, FIBRES)


def test_medit_files_cannot_hold_them(tmp_path):
    with pytest.warns(UserWarning, match="a.mesh: .mesh cannot hold fibres"):
        ts.write_mesh(tmp_path / "a.mesh", ts.TetMesh(BOX.vertices, BOX.tets, fibres=FIBRES))
    assert ts.read_mesh(tmp_path / "a.mesh").fibres is None


def view(rows: str, head: str = '1\n"fibers"\n1\n0.0\n3\n0\n3\n2\n') -> str:
    return f"$ElementData\n{head}{rows}$EndElementData\n"


OTHER = '$ElementData\n1\n"temperature"\n0\n3\n0\n1\n1\n1 20.0\n$EndElementData\n'


def test_element_data_go_to_their_tags_and_others_are_left_out(tmp_path):
    file = tmp_path / "a.msh"
    ts.write_mesh(file, BOX)
    text = file.read_text()
    file.write_text(text + OTHER + view("7 0 0.5 1e-3\n2 1 2 3\n"))
    found = ts.read_mesh(file).fibres
    assert found[6].tolist() == [0.0, 0.5, 1e-3] and found[1].tolist() == [1.0, 2.0, 3.0] and np.count_nonzero(found) == 5
    bad = [
        (view("1 1 2 3\n"), r"line \d+ \(\$ElementData\): 8 numbers should follow, but only 4 do"),
        (view("1 1 2 x\n2 0 0 1\n"), r"line \d+ \(\$ElementData\): expected a number, not 'x'"),
        (
            view("", '1\n"fibres"\n1\n0.0\n3\n0\n1\n2\n'),
            r"line \d+ \(\$ElementData\): expected numbers of tags, three components",
        ),
        (view("1 1 2 3\n2 0 0 1\n3 0 0 1\n"), "4 numbers are left over"),
    ]
    for section, message in bad:
        file.write_text(text + section)
        with pytest.raises(MeshError, match=f"a.msh: .*{message}"):
            ts.read_mesh(file)


def test_binary_element_data(tmp_path):
    n, m = BOX.n_verts, BOX.n_tets

    def pack(*parts) -> bytes:
        return b"".join(np.array(values, "<" + kind).tobytes() for kind, values in parts)

    nodes = pack(("u8", [1, n, 1, n]), ("i4", [3, 1, 0]), ("u8", [n]), ("u8", np.arange(1, n + 1)), ("f8", BOX.vertices))
    rows = np.column_stack([np.arange(m) + 5, BOX.tets + 1])
    elements = pack(("u8", [1, m, 5, m + 4]), ("i4", [3, 1, 4]), ("u8", [m]), ("u8", rows))
    data = b"".join(pack(("i4", [k + 5]), ("f8", FIBRES[k])) for k in reversed(range(m)))
    head = f'1\n"fibres"\n1\n0.0\n4\n0\n3\n{m}\n0\n'.encode()
    file = tmp_path / "a.msh"
    sections = {b"Nodes": nodes + b"\n", b"Elements": elements + b"\n", b"ElementData": head + data + b"\n"}
    body = b"".join(b"$" + name + b"\n" + content + b"$End" + name + b"\n" for name, content in sections.items())
    file.write_bytes(b"$MeshFormat\n4.1 1 8\n" + pack(("i4", [1])) + b"\n$EndMeshFormat\n" + body)
    assert np.array_equal(ts.read_mesh(file).fibres, FIBRES)
