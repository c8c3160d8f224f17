"""Regions of mesh files: random ones are written and read back, and pass through meshio's record; Gmsh's physical groups of all
versions, references of .mesh and cell data of .vtu are read; names and data that a mesh cannot have are reported or refused;
scene files find regions.
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.errors import MeshError
from tests.cli.command import write
from tests.mesh.test_mesh_files import GMSH2, write_by_meshio

BOX = ts.box_mesh((2, 1, 1), (0.3, 0.1, 1 / 3))
IDS = np.arange(10) // 4 + 1
NAMED = ts.TetMesh(BOX.vertices, BOX.tets, regions=IDS, region_names={1: "bone", 3: "soft tissue"})
texts = st.text(min_size=1, max_size=8).filter(
    lambda text: text.strip() and text.isprintable() and '"' not in text and not text.isdigit()
)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_random_regions_are_read_back(tmp_path, data):
    ids = data.draw(st.lists(st.integers(-(2**31) + 1, 2**31 - 1) | st.integers(0, 3), min_size=10, max_size=10))
    names = data.draw(st.lists(texts, unique=True, max_size=len(set(ids))))
    mesh = ts.TetMesh(BOX.vertices, BOX.tets, regions=ids, region_names=dict(zip(sorted(set(ids)), names)))
    path, record = tmp_path / "part.msh", mesh.to_meshio()
    again = ts.TetMesh.from_meshio(record)
    assert again.regions.tolist() == ids and again.region_names == mesh.region_names and again.warnings == ()
    assert np.array_equal(again.vertices, BOX.vertices) and np.array_equal(again.tets, BOX.tets)
    record.points[:] = 0.0  # its own copy
    if not any(ids):
        with pytest.raises(MeshError, match="part.msh: a mesh whose only region is 0 cannot be written"):
            ts.write_mesh(path, mesh)
        return
    ts.write_mesh(path, mesh)
    again = ts.read_mesh(path)
    assert again.regions.tolist() == ids and again.region_names == mesh.region_names and again.warnings == ()
    assert np.array_equal(again.vertices, BOX.vertices) and np.array_equal(again.tets, BOX.tets)
    ts.write_mesh(path, mesh, regions=False)
    assert ts.read_mesh(path).regions is None


@pytest.mark.parametrize("ending, ids", [(".mesh", -IDS), (".vtu", 0 * IDS)])
def test_other_formats_hold_regions_without_their_names(tmp_path, ending, ids):
    mesh = ts.TetMesh(BOX.vertices, BOX.tets, regions=ids, region_names={int(ids[0]): "bone"})
    with pytest.warns(UserWarning, match=f"a{ending}: {ending} cannot hold the names of regions") as caught:
        ts.write_mesh(tmp_path / f"a{ending}", mesh)
    assert caught[0].filename == __file__
    assert ts.read_mesh(tmp_path / f"a{ending}").regions.tolist() == ids.tolist()


@pytest.mark.parametrize("order", ["<", ">"])
def test_physical_groups_of_binary_version_4(tmp_path, order):
    """The first volume is in the groups 4, reversed, and 8, the second in none; a group of surfaces has the same number."""

    def pack(*parts) -> bytes:
        return b"".join(np.array(values, order + kind).tobytes() for kind, values in parts)

    n, m = BOX.n_verts, BOX.n_tets
    volume = [("i4", [1]), ("f8", [0] * 6), ("u8", [2]), ("i4", [-4, 8]), ("u8", [1]), ("i4", [-7])]
    surface = [("i4", [7]), ("f8", [0] * 6), ("u8", [0]), ("u8", [0])]
    point = [("i4", [9]), ("f8", [0] * 3), ("u8", [1]), ("i4", [3])]
    entities = pack(("u8", [1, 0, 1, 2]), *point, *surface, *volume, ("i4", [2]), *surface[1:])
    nodes = pack(("u8", [1, n, 1, n]), ("i4", [3, 1, 0]), ("u8", [n]), ("u8", np.arange(1, n + 1)), ("f8", BOX.vertices))
    rows = np.column_stack([np.arange(m), BOX.tets + 1])
    blocks = [part for e, own in ((2, rows[:4]), (1, rows[4:])) for part in (("i4", [3, e, 4]), ("u8", [len(own)]), ("u8", own))]
    sections = {"Entities": entities, "Nodes": nodes, "Elements": pack(("u8", [2, m, 1, m]), *blocks)}
    data = b"$MeshFormat\n4.1 1 8\n" + pack(("i4", [1])) + b"\n$EndMeshFormat\n"
    data += b'$PhysicalNames\n2\n2 4 "skin"\n3 4 "muscle"\n$EndPhysicalNames\n'
    data += b"".join(f"${name}\n".encode() + part + f"\n$End{name}\n".encode() for name, part in sections.items())
    (tmp_path / "a.msh").write_bytes(data)
    mesh = ts.read_mesh(tmp_path / "a.msh")
    assert mesh.regions.tolist() == [0] * 4 + [4] * 6 and mesh.region_names == {4: "muscle"}
    assert np.array_equal(mesh.tets, BOX.tets)
    (tmp_path / "a.msh").write_bytes(data.replace(entities, entities[:-4]))
    with pytest.raises(MeshError, match=r"a.msh: byte \d+ \(\$Entities\): "):
        ts.read_mesh(tmp_path / "a.msh")


def named_file(path, names: dict[int, str], ids, binary: bool, encoding: str = "utf-8"):
    """A file of version 2 whose physical groups of volumes have any names, as Gmsh allows."""
    groups = [np.asarray(ids, dtype=np.int32)]
    data = {"gmsh:physical": groups, "gmsh:geometrical": groups}
    write_by_meshio(path, [("tetra", BOX.tets)], BOX.vertices, cell_data=data, file_format="gmsh22", binary=binary)
    rows = "".join(f'3 {region} "{name}"\n' for region, name in names.items())
    section = f'$PhysicalNames\n{len(names)}\n{rows}2 1 "skin"\n3 99 "absent"\n$EndPhysicalNames\n'.encode(encoding)
    path.write_bytes(path.read_bytes().replace(b"$Nodes", section + b"$Nodes", 1))
    return path


def test_names_are_kept_or_changed_with_a_warning(tmp_path):
    """Apostrophes and blanks in them, and groups below 1, are kept."""
    ids, path = [-1] * 4 + [0] * 4 + [7] * 2, tmp_path / "a.msh"
    for binary in (False, True):
        mesh = ts.read_mesh(named_file(path, {-1: "l'os", 0: " two  blanks", 7: "7"}, ids, binary))
        assert mesh.regions.tolist() == ids and mesh.warnings == ()
        assert mesh.region_names == {-1: "l'os", 0: " two  blanks", 7: "7"}
    for names, encoding, found, message in (
        ({1: "a", 2: "a"}, "utf-8", {1: "a (1)", 2: "a (2)"}, r"region 2 is called 'a \(2\)' instead of 'a'$"),
        ({1: "hüft"}, "latin-1", {1: "hüft"}, "region 1 is called 'hüft' instead of 'h.udcfcft'"),
        ({1: "\x01", 2: "b"}, "utf-8", {2: "b"}, "region 1 is without a name instead of '.x01'$"),
    ):
        with pytest.warns(UserWarning, match=f"names of regions must be different lines of UTF-8 text.*{message}") as caught:
            mesh = ts.read_mesh(named_file(path, names, IDS, False, encoding))
        assert len(caught) == 1 and mesh.region_names == found and mesh.regions.tolist() == IDS.tolist()


def test_cell_data_are_regions_by_name(tmp_path):
    path, tets = tmp_path / "a.vtu", [("tetra", BOX.tets)]
    data = {"MaterialIds": [IDS.astype(float)], "stress": [np.ones((10, 9))], "region": [np.full(10, np.nan)]}
    write_by_meshio(path, tets, BOX.vertices, cell_data=data)
    assert ts.read_mesh(path, regions="MaterialIds").regions.tolist() == IDS.tolist()
    with pytest.raises(MeshError, match="a.vtu: cell data 'region' are no regions, since that of tet 0 is nan, not a whole"):
        ts.read_mesh(path, regions="region")
    with pytest.raises(MeshError, match="a.vtu: regions must be the name of cell data, or None, not 3"):
        ts.read_mesh(path, regions=3)


def test_regions_follow_their_tets(tmp_path):
    """Other elements, unused points and welding do not shift them."""
    surface, path = BOX.surface[:3], tmp_path / "a.msh"
    cells = [("triangle", surface), ("tetra", BOX.tets[:6] + 1), ("triangle", surface), ("tetra", BOX.tets[6:] + 1)]
    groups = [one.astype(np.int32) for one in (np.full(3, 8), IDS[:6], np.full(3, 9), IDS[6:])]
    data = {"gmsh:physical": groups, "gmsh:geometrical": groups}
    write_by_meshio(path, cells, np.concatenate([[(9.0, 9, 9)], BOX.vertices]), cell_data=data, **GMSH2)
    with pytest.warns(UserWarning, match="6 triangles next to the tets are not used"):
        mesh = ts.read_mesh(path, weld=0.0)
    assert mesh.regions.tolist() == IDS.tolist() and np.array_equal(mesh.tets, BOX.tets)


SCENE = """
[materials.stiff]
young = 1e7
[bodies.leg]
mesh = { file = "leg.msh" }
[bodies.leg.materials]
bone = "stiff"
2 = "stiff"
"soft tissue" = { young = 1e4, law = "corotational" }
"""


def test_scene_files_give_materials_by_region(tmp_path):
    ts.write_mesh(tmp_path / "leg.msh", NAMED)
    scene, _ = ts.read_scene(write(tmp_path / "a.toml", SCENE))
    assert scene.bodies[0].young.tolist() == [1e7] * 8 + [1e4] * 2
    assert [material.law for material in scene.bodies[0].material.values()] == ["stable_neo_hookean"] * 2 + ["corotational"]
