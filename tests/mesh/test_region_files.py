"""Regions of mesh files:

* random regions and names are written and read back in every format that can hold them, with the tets in order;
* Gmsh's physical groups are read from versions 2 and 4.1, text and binary; a volume without a group is in region 0;
* references of .mesh and cell data of .vtu are read; other cell data by name;
* data that are no whole numbers, unknown names and regions that a format cannot tell from none are refused or reported;
* `taisoft info` lists regions, and scene files find them.
"""

import warnings

import meshio
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.cli.files import describe
from taisoft.errors import MeshError, SceneError
from tests.cli.command import write

BOX = ts.box_mesh((2, 1, 1), (0.3, 0.1, 1 / 3))
IDS = np.arange(10) // 4 + 1
NAMED = ts.TetMesh(BOX.vertices, BOX.tets, regions=IDS, region_names={1: "bone", 3: "soft tissue"})
texts = st.text(min_size=1, max_size=8).filter(
    lambda text: text.strip() and text.isprintable() and '"' not in text and not text.isdigit()
)


def written(path, data: dict, **options):
    """A file of the box written by meshio with cell data."""
    cells = {name: [np.asarray(values)] for name, values in data.items()}
    meshio.write(path, meshio.Mesh(BOX.vertices, [("tetra", BOX.tets)], cell_data=cells), **options)
    return path


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
@pytest.mark.parametrize("ending", [".msh", ".mesh", ".vtu", ".vtk"])
def test_random_regions_are_read_back(tmp_path, ending, data):
    ids = data.draw(st.lists(st.integers(0, 2**31 - 1) | st.integers(0, 3), min_size=10, max_size=10))
    present = sorted(set(ids) - {0})
    names = dict(zip(present, data.draw(st.lists(texts, unique=True, max_size=len(present))))) if ending == ".msh" else {}
    mesh = ts.TetMesh(BOX.vertices, BOX.tets, regions=ids, region_names=names)
    path = tmp_path / f"part{ending}"
    if ending in (".msh", ".mesh") and not any(ids):
        with pytest.raises(MeshError, match=f"part{ending}: a mesh whose only region is 0 cannot be written"):
            ts.write_mesh(path, mesh)
        return
    ts.write_mesh(path, mesh)
    again = ts.read_mesh(path)
    assert again.regions.tolist() == ids and again.region_names == names and again.warnings == []
    assert np.array_equal(again.vertices, BOX.vertices) and np.array_equal(again.tets, BOX.tets)


def test_negative_regions_are_read_back(tmp_path):
    for ending in (".msh", ".mesh", ".vtu", ".vtk"):
        ts.write_mesh(tmp_path / f"a{ending}", ts.TetMesh(BOX.vertices, BOX.tets, regions=-IDS))
        assert ts.read_mesh(tmp_path / f"a{ending}").regions.tolist() == (-IDS).tolist()


@pytest.mark.parametrize("ending", [".mesh", ".vtu", ".vtk"])
def test_names_are_lost_with_a_warning(tmp_path, ending):
    with pytest.warns(UserWarning, match=f"a{ending}: {ending} cannot hold the names of regions") as caught:
        ts.write_mesh(tmp_path / f"a{ending}", NAMED)
    assert caught[0].filename == __file__
    assert ts.read_mesh(tmp_path / f"a{ending}").regions.tolist() == IDS.tolist()


def gmsh_4_text() -> str:
    """Two tets, each a volume: the first in the groups 5 and 9, the second in none; a group of surfaces has the same number."""
    return (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
        '$PhysicalNames\n3\n2 5 "skin"\n3 5 "bone"\n3 9 "all"\n$EndPhysicalNames\n'
        "$Entities\n1 1 1 2\n1 0 0 0 0\n3 0 0 0 1 1 1 0 2 1 -1\n4 0 0 0 1 1 1 1 5 1 3\n"
        "1 0 0 0 1 1 1 2 5 9 1 4\n2 0 0 0 1 1 1 0 1 -4\n$EndEntities\n"
        "$Nodes\n1 5 1 5\n3 1 0 5\n1\n2\n3\n4\n5\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0.5 0.5 -1\n$EndNodes\n"
        "$Elements\n2 2 1 2\n3 2 4 1\n1 2 1 3 5\n3 1 4 1\n2 1 2 3 4\n$EndElements\n"
    )


def test_physical_groups_of_version_4(tmp_path):
    path = write(tmp_path / "a.msh", gmsh_4_text())
    mesh = ts.read_mesh(path)
    assert mesh.regions.tolist() == [0, 5] and mesh.region_names == {5: "bone"} and repr(mesh).endswith("2 regions)")
    path.write_text(gmsh_4_text().replace("1 1 1 2 5 9 1 4", "1 1 1 2 -5 9 1 4"))  # of reversed orientation
    assert ts.read_mesh(path).regions.tolist() == [0, 5]
    path.write_text(gmsh_4_text().replace("1 1 1 2 5 9 1 4", "1 1 1 0 1 4"))
    assert ts.read_mesh(path).regions is None


@pytest.mark.parametrize("order", ["<", ">"])
def test_physical_groups_of_binary_version_4(tmp_path, order):
    def pack(*parts) -> bytes:
        return b"".join(np.array(values, order + kind).tobytes() for kind, values in parts)

    n, m = BOX.n_verts, BOX.n_tets
    volume = [("i4", [1]), ("f8", [0] * 6), ("u8", [2]), ("i4", [4, 8]), ("u8", [1]), ("i4", [-7])]
    surface = [("i4", [7]), ("f8", [0] * 6), ("u8", [0]), ("u8", [0])]
    other = [("i4", [2]), ("f8", [0] * 6), ("u8", [1]), ("i4", [6]), ("u8", [0])]
    point = [("i4", [9]), ("f8", [0] * 3), ("u8", [1]), ("i4", [3])]
    entities = pack(("u8", [1, 0, 1, 2]), *point, *surface, *volume, *other)
    nodes = pack(("u8", [1, n, 1, n]), ("i4", [3, 1, 0]), ("u8", [n]), ("u8", np.arange(1, n + 1)), ("f8", BOX.vertices))
    rows = np.column_stack([np.arange(m), BOX.tets + 1])
    blocks = [part for e, own in ((2, rows[:4]), (1, rows[4:])) for part in (("i4", [3, e, 4]), ("u8", [len(own)]), ("u8", own))]
    sections = {"Entities": entities, "Nodes": nodes, "Elements": pack(("u8", [2, m, 1, m]), *blocks)}
    data = b"$MeshFormat\n4.1 1 8\n" + pack(("i4", [1])) + b"\n$EndMeshFormat\n"
    data += b'$PhysicalNames\n1\n3 4 "muscle"\n$EndPhysicalNames\n'
    data += b"".join(f"${name}\n".encode() + part + f"\n$End{name}\n".encode() for name, part in sections.items())
    (tmp_path / "a.msh").write_bytes(data)
    mesh = ts.read_mesh(tmp_path / "a.msh")
    assert mesh.regions.tolist() == [6] * 4 + [4] * 6 and mesh.region_names == {4: "muscle"}
    assert np.array_equal(mesh.tets, BOX.tets)
    (tmp_path / "a.msh").write_bytes(data.replace(entities, entities[:-4]))
    with pytest.raises(MeshError, match=r"a.msh: byte \d+ \(\$Entities\): "):
        ts.read_mesh(tmp_path / "a.msh")


def named_file(path, names: dict[int, str], ids=IDS, binary: bool = False, encoding: str = "utf-8"):
    """A file of version 2 whose physical groups of volumes have any names, as Gmsh allows."""
    groups = [np.asarray(ids, dtype=np.int32)]
    record = meshio.Mesh(BOX.vertices, [("tetra", BOX.tets)], cell_data={"gmsh:physical": groups, "gmsh:geometrical": groups})
    meshio.write(path, record, file_format="gmsh22", binary=binary)
    rows = "".join(f'3 {region} "{name}"\n' for region, name in names.items())
    section = f"$PhysicalNames\n{len(names)}\n{rows}$EndPhysicalNames\n".encode(encoding)
    path.write_bytes(path.read_bytes().replace(b"$Nodes", section + b"$Nodes", 1))
    return path


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    "names, encoding, found, message",
    [
        (
            {1: "bone", 2: "bone", 3: "skin"},
            "utf-8",
            {1: "bone (1)", 2: "bone (2)", 3: "skin"},
            r"region 1 is called 'bone \(1\)' instead of 'bone', region 2 is called 'bone \(2\)' instead of 'bone'$",
        ),
        ({1: "a", 2: "a", 3: "a (2)"}, "utf-8", {1: "a (1)", 2: "a (2)'", 3: "a (2)"}, "region 2 is called"),
        (
            {1: "soft\ttissue", 2: "b\xa0c"},
            "utf-8",
            {1: "soft tissue", 2: "b c"},
            r"region 1 is called 'soft tissue' instead of 'soft\\tti",
        ),
        ({1: "a b", 2: "a\tb"}, "utf-8", {1: "a b (1)", 2: "a b (2)"}, r"region 2 is called 'a b \(2\)' instead of 'a\\tb'"),
        (
            {1: "Fußknochen", 3: "hüft"},
            "latin-1",
            {1: "Fußknochen", 3: "hüft"},
            "region 1 is called 'Fußknochen' instead of 'Fu.udcdf",
        ),
        ({1: "\x01", 2: "b"}, "utf-8", {2: "b"}, "region 1 is without a name instead of '.x01'$"),
        ({1: "2", 3: "3"}, "utf-8", {1: "2 (1)", 3: "3"}, r"region 1 is called '2 \(1\)' instead of '2'$"),
    ],
)
def test_names_that_a_mesh_cannot_have_are_changed_with_a_warning(tmp_path, names, encoding, found, message, binary):
    path = named_file(tmp_path / "a.msh", names, binary=binary, encoding=encoding)
    with pytest.warns(UserWarning, match=f"a.msh: names of regions must be different lines of UTF-8 text.*{message}") as caught:
        mesh = ts.read_mesh(path)
    assert len(caught) == 1 and mesh.region_names == found and mesh.regions.tolist() == IDS.tolist()


@pytest.mark.parametrize("binary", [False, True])
def test_names_that_a_mesh_can_have_are_kept(tmp_path, binary):
    """Apostrophes and blanks in them, and groups below 1."""
    ids = [-1] * 4 + [0] * 4 + [7] * 2
    mesh = ts.read_mesh(named_file(tmp_path / "a.msh", {-1: "l'os", 0: " two  blanks", 7: "7"}, ids, binary))
    assert mesh.regions.tolist() == ids and mesh.warnings == []
    assert mesh.region_names == {-1: "l'os", 0: " two  blanks", 7: "7"}


def test_the_warning_of_many_names_is_short(tmp_path):
    big = ts.box_mesh((20, 5, 4), (4, 1, 1))
    mesh = ts.TetMesh(big.vertices, big.tets, regions=np.arange(big.n_tets), region_names={k: f"part {k}" for k in range(2000)})
    path = tmp_path / "a.msh"
    ts.write_mesh(path, mesh)
    path.write_bytes(
        b"\n".join(line.rpartition(b" ")[0] + b' x"' if b"part" in line else line for line in path.read_bytes().split(b"\n"))
    )
    with pytest.warns(UserWarning, match=r"\(2000 in all\)$") as caught:
        assert ts.read_mesh(path).region_names[5] == "part x (5)"
    assert len(str(caught[0].message)) < 600


@pytest.mark.parametrize("binary", [False, True])
def test_physical_groups_of_version_2(tmp_path, binary):
    path, groups = tmp_path / "a.msh", [IDS.astype(np.int32)]
    record = meshio.Mesh(BOX.vertices, [("tetra", BOX.tets)], cell_data={"gmsh:physical": groups, "gmsh:geometrical": groups})
    record.field_data = {"bone": np.array([1, 3]), "skin": np.array([2, 2]), "absent": np.array([9, 3])}
    meshio.write(path, record, file_format="gmsh22", binary=binary)
    mesh = ts.read_mesh(path)
    assert mesh.regions.tolist() == IDS.tolist() and mesh.region_names == {1: "bone"}


def test_references_and_cell_data(tmp_path):
    assert ts.read_mesh(written(tmp_path / "a.mesh", {"medit:ref": IDS})).regions.tolist() == IDS.tolist()
    ts.write_mesh(tmp_path / "b.mesh", BOX)
    assert ts.read_mesh(tmp_path / "b.mesh").regions is None
    assert ts.read_mesh(written(tmp_path / "a.vtu", {"region": IDS.astype(float)})).regions.tolist() == IDS.tolist()
    assert ts.read_mesh(written(tmp_path / "b.vtu", {"region": 0 * IDS})).regions.tolist() == [0] * 10
    path = written(tmp_path / "c.vtu", {"MaterialIds": IDS, "stress": np.ones((10, 9)), "heat": np.linspace(0, 1, 10)})
    assert ts.read_mesh(path).regions is None
    assert ts.read_mesh(path, regions="MaterialIds").regions.tolist() == IDS.tolist()
    with pytest.raises(MeshError, match="c.vtu: cell data 'heat' are no regions, since that of tet 1 is 0.111111, not a whole"):
        ts.read_mesh(path, regions="heat")
    with pytest.raises(MeshError, match="c.vtu: no cell data are called 'stress'; there are 'MaterialIds', 'heat'"):
        ts.read_mesh(path, regions="stress")
    for bad in (["x"], 3, b"x"):
        with pytest.raises(MeshError, match="b.mesh: regions must be the name of cell data, or None, not"):
            ts.read_mesh(tmp_path / "b.mesh", regions=bad)
    with pytest.raises(MeshError, match="b.mesh: no cell data are called 'x'; there are 'medit:ref'"):
        ts.read_mesh(tmp_path / "b.mesh", regions="x")
    with pytest.warns(UserWarning, match="cell data 'region' are no regions, since that of tet 0 is nan"):
        assert ts.read_mesh(written(tmp_path / "d.vtu", {"region": np.full(10, np.nan)})).regions is None


def test_regions_follow_their_tets(tmp_path):
    """Other elements, unused points and welding do not shift them."""
    surface = BOX.surface[:3]
    cells = [("triangle", surface), ("tetra", BOX.tets[:6] + 1), ("triangle", surface), ("tetra", BOX.tets[6:] + 1)]
    data = {"medit:ref": [np.full(3, 8), IDS[:6], np.full(3, 9), IDS[6:]]}
    points = np.concatenate([[(9.0, 9, 9)], BOX.vertices])
    meshio.write(tmp_path / "a.mesh", meshio.Mesh(points, cells, cell_data=data))
    with pytest.warns(UserWarning, match="6 triangles next to the tets are not used"):
        mesh = ts.read_mesh(tmp_path / "a.mesh", weld=0.0)
    assert mesh.regions.tolist() == IDS.tolist() and np.array_equal(mesh.tets, BOX.tets)


def test_info_lists_the_regions():
    assert ("regions", "'bone' of 4 tets, 2 of 4 tets, 'soft tissue' of 2 tets") in describe(NAMED)
    many = ts.TetMesh(*(lambda mesh: (mesh.vertices, mesh.tets))(ts.box_mesh((5, 1, 1), (5, 1, 1))), regions=range(25))
    assert dict(describe(many))["regions"].endswith("19 of 1 tets, and 5 more") and "regions" not in dict(describe(BOX))


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


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('bone = "stiff"\n', "", "bodies.leg: region 'bone' has no material; every region needs one"),
        ("bone =", "bones =", "bodies.leg.*no region is called 'bones'; did you mean 'bone'"),
        ("2 =", "7 =", "bodies.leg.*no tet is in region 7; there are 'bone', 2, 'soft tissue'"),
        ('bone = "stiff"', 'bone = "stif"', "bodies.leg.materials.bone 'stif' is not among the materials .did you mean stiff"),
        ("young = 1e4", "young = -1", 'bodies.leg.materials."soft tissue".young must be greater than 0'),
        ("[bodies.leg.materials]", 'material = "stiff"\n[bodies.leg.materials]', "bodies.leg must have either a material or mat"),
        (SCENE[SCENE.index("[bodies.leg.materials]") :], "materials = 3\n", "bodies.leg.materials must be tables .*, not 3$"),
        ("2 =", "02 =", "bodies.leg.*no region is called '02'; there are 'bone', 2, 'soft tissue'"),
        ("2 =", '"٢" =', "bodies.leg.*no region is called '٢'; there are 'bone', 2, 'soft tissue'"),
        (
            "[bodies.leg.materials]",
            "young = [1e5]\n[bodies.leg.materials]",
            r"bodies.leg.young must have shape \(10,\), not \(1,\)",
        ),
    ],
)
def test_bad_scene_files_are_refused(tmp_path, old, new, message):
    ts.write_mesh(tmp_path / "leg.msh", NAMED)
    assert old in SCENE
    path = write(tmp_path / "a.toml", SCENE.replace(old, new))
    with pytest.raises(SceneError, match=f"a.toml: {message}"), warnings.catch_warnings():
        warnings.simplefilter("error")
        ts.read_scene(path)
