"""`read_usd`: bodies from USD stages.

* what taisoft writes comes back: vertices equal to the float32 of the rest positions in place, tets equal, for four demos;
  obstacles do not;
* tets, polygons, transforms, handedness, units and the up axis of other stages are understood; closed surfaces are filled;
* a broken stage, of whatever kind, gives one sentence that names the file, within seconds;
* `taisoft info` and `taisoft scene` accept a stage, and a scene file takes one mesh of it, but no stage that names other files.
"""

import random
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Usd, UsdGeom, Vt

import taisoft as ts
from taisoft.cli import main
from taisoft.cli.scene_file import load_scene
from taisoft.errors import MeshError, TaisoftError
from taisoft.output.usd import UsdWriter
from tests.view.fake_simulator import FakeSimulator

MESH = ts.box_mesh((2, 1, 1), (2, 1, 1), center=(0.3, 0.2, 0.1))
CUBE = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]  # outward


def new_stage(path, up=UsdGeom.Tokens.y, metres=1.0):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    return stage


def add_tets(stage, path="/tets", mesh=MESH):
    prim = UsdGeom.TetMesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices.astype(np.float32)))
    prim.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(mesh.tets.astype(np.int32)))
    return prim


def add_surface(stage, path, points, faces):
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    prim.CreateFaceVertexCountsAttr([len(face) for face in faces])
    prim.CreateFaceVertexIndicesAttr([k for face in faces for k in face])
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return prim


@pytest.mark.parametrize("demo", ["hanging_beam", "drop_everything", "cube_on_box", "bending_beam_orders"])
@pytest.mark.filterwarnings("ignore:body ")
def test_what_is_written_comes_back(tmp_path, demo):
    """bending_beam_orders has a quadratic body, drop_everything and cube_on_box have obstacles."""
    scene, _ = load_scene(demo)
    writer = UsdWriter(tmp_path, scene)
    sim = FakeSimulator(scene)
    for frame in (3, 4):  # as of a resumed run in a folder of its own: the rest shape is not in a frame
        sim.time = frame / 60
        writer.frame(sim, frame)
    writer.close()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        meshes = ts.read_usd(tmp_path / "scene.usdc")
    names = ", ".join(obstacle.name for obstacle in scene.obstacles)
    assert any(f"obstacles are left out: {names}" in str(one.message) for one in found) == bool(scene.obstacles)
    assert list(meshes) == [body.name for body in scene.bodies]
    for body in scene.bodies:
        start = (body.rest_positions + body.position).astype(np.float32)
        assert np.array_equal(meshes[body.name].vertices, start)
        assert np.array_equal(meshes[body.name].tets, body.nodes.tets)


def test_units_up_axis_and_transforms(tmp_path):
    """A stage in centimetres with z up, with a body that is turned by 90 degrees about x and moved."""
    path = tmp_path / "a.usda"
    stage = new_stage(path, UsdGeom.Tokens.z, 0.01)
    xform = UsdGeom.Xform.Define(stage, "/part")
    xform.AddTranslateOp().Set(Gf.Vec3d(10, 20, 30))
    xform.AddRotateXOp().Set(90.0)
    add_tets(stage, "/part/body")
    stage.Save()
    (name, mesh), *_ = ts.read_usd(path).items()
    x, y, z = MESH.vertices.astype(np.float32).T.astype(float)
    turned = np.stack([x + 10, -z + 20, y + 30], axis=1)  # z up
    assert name == "body" and np.allclose(mesh.vertices, 0.01 * turned[:, [0, 2, 1]] * (1, 1, -1), atol=1e-12)
    assert mesh.volumes.sum() == pytest.approx(1e-6 * MESH.volumes.sum(), rel=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("left_handed", [False, True])
def test_handedness(tmp_path, mirrored, left_handed):
    """Tets come out positive without a warning, since a mirror turns left-handed ones around."""
    path = tmp_path / "a.usda"
    stage = new_stage(path)
    prim = add_tets(stage)
    if left_handed:
        prim.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
        flipped = MESH.tets[:, [0, 2, 1, 3]]
        prim.GetTetVertexIndicesAttr().Set(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(flipped, dtype=np.int32)))
    if mirrored:
        prim.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    stage.Save()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = ts.read_usd(path)["tets"]
    assert len(mesh.flipped) == 0 and np.allclose(mesh.vertices, MESH.vertices * (-1 if mirrored else 1, 1, 1), atol=1e-6)


def test_points_of_the_first_time_without_default(tmp_path):
    path = tmp_path / "a.usda"
    stage = new_stage(path)
    points = add_tets(stage).GetPointsAttr()
    points.Clear()
    for time, factor in ((3, 1.0), (5, 2.0)):
        points.Set(Vt.Vec3fArray.FromNumpy((factor * MESH.vertices).astype(np.float32)), time)
    stage.Save()
    assert np.array_equal(ts.read_usd(path)["tets"].vertices, MESH.vertices.astype(np.float32))


def test_closed_polygons_are_filled_and_open_ones_left_out(tmp_path):
    pytest.importorskip("wildmeshing")
    path = tmp_path / "a.usda"
    stage = new_stage(path)
    add_surface(stage, "/a/part", CUBE, QUADS)
    add_surface(stage, "/b/part", 2.0 * np.array(CUBE) + 5.0, QUADS)
    add_surface(stage, "/lid", CUBE, QUADS[:5])
    add_surface(stage, "/proxy", CUBE, QUADS).CreatePurposeAttr(UsdGeom.Tokens.proxy)
    stage.Save()
    with pytest.warns(UserWarning, match="lid is open, so it bounds no solid"):
        meshes = ts.read_usd(path, edge_length=0.5)
    assert list(meshes) == ["part", "part_2"]
    volumes = [mesh.volumes.sum() for mesh in meshes.values()]
    assert volumes == [pytest.approx(1, rel=0.05), pytest.approx(8, rel=0.05)]
    assert np.allclose(meshes["part_2"].vertices.min(axis=0), 5, atol=0.06)


@settings(max_examples=12, deadline=None)
@given(
    cells=st.tuples(*[st.integers(1, 3)] * 3),
    angles=st.tuples(*[st.integers(-180, 180)] * 3),
    shift=st.tuples(*[st.floats(-100, 100, width=32)] * 3),
    scale=st.floats(0.125, 8, width=32),
)
def test_any_placed_mesh_keeps_its_shape(tmp_path_factory, cells, angles, shift, scale):
    """Volume and distances scale; the mean vertex is where the stage has it."""
    path = tmp_path_factory.mktemp("any") / "a.usdc"
    mesh = ts.box_mesh(cells, (1, 2, 3))
    stage = new_stage(path)
    prim = add_tets(stage, mesh=mesh)
    prim.AddTranslateOp().Set(Gf.Vec3d(*shift))
    prim.AddRotateXYZOp().Set(Gf.Vec3f(*angles))
    prim.AddScaleOp().Set(Gf.Vec3f(scale, scale, scale))
    stage.Save()
    read = ts.read_usd(path)["tets"]
    assert np.array_equal(read.tets, mesh.tets) and read.volumes.sum() == pytest.approx(6 * scale**3, rel=1e-5)
    assert np.allclose(read.vertices.mean(axis=0), shift, atol=1e-5 * (1 + scale))


# --- refusals ---------------------------------------------------------------------------------------------------------


def broken(tmp_path, name, content) -> str:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MeshError) as error:
        ts.read_usd(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ") and "\n" not in text and text.count(str(path)) == 1
    return text.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.usda", b"#usda 1.0\n\ndef Mesh {{{\n", "not a readable USD stage (line 3 cannot be parsed)"),
        ("a.usdc", b"PXR-USDC" + bytes(200), "not a readable USD stage (it is damaged, or of another format)"),
        ("a.usdz", b"PK\3\4", "not a readable USD stage (it is damaged, or of another format)"),
        ("a.usda", b"", "the file is empty"),
        ("a.usda", b'#usda 1.0\ndef Xform "a" {}\n', "the stage holds no tets and no closed surface"),
        (
            "a.usda",
            b'#usda 1.0\ndef Xform "a" (references = @b.usda@) {}\n',
            "not a readable USD stage (its part 'b.usda' cannot be opened)",
        ),
        ("a.msh", b"x", "a USD stage is read from .usd, .usda, .usdc, .usdz, not from .msh"),
    ],
)
def test_broken_stages_give_one_sentence(tmp_path, name, content, message):
    assert message in broken(tmp_path, name, content)


@pytest.mark.parametrize(
    "attributes, message",
    [
        (
            "point3f[] points = [(0,0,0)]\nint[] faceVertexCounts = [3, 4]\nint[] faceVertexIndices = [0, 0, 0]",
            "do not fit together",
        ),
        (
            "point3f[] points = [(0,0,0)]\nint[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 0, 7]",
            "vertex 7 does not exist",
        ),
        ("point3f[] points = [(nan,0,0)]\nint[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 0, 0]", "is not finite"),
    ],
)
def test_inconsistent_meshes_are_refused(tmp_path, attributes, message):
    text = broken(tmp_path, "a.usda", f'#usda 1.0\ndef Mesh "part" {{\n{attributes}\n}}\n'.encode())
    assert message in text and "part" in text


def test_a_missing_file_and_a_wrong_argument(tmp_path):
    with pytest.raises(MeshError, match="there is no such file"):
        ts.read_usd(tmp_path / "none.usdc")
    with pytest.raises(MeshError, match="path must be a file's name, not 3"):
        ts.read_usd(3)


@pytest.mark.parametrize("ending", [".usda", ".usdc"])
def test_changed_bytes_give_a_mesh_or_one_sentence(tmp_path, ending, capfd):
    """Twelve files of each kind, cut or with changed bytes."""
    path = tmp_path / f"a{ending}"
    stage = new_stage(path)
    add_tets(stage)
    stage.Save()
    content, pick = path.read_bytes(), random.Random(7)
    outcomes = set()
    for k in range(12):
        data = bytearray(content if k % 3 else content[: pick.randrange(1, len(content))])
        for _ in range(pick.choice((0, 1, 4, 16)) if k % 3 == 0 else pick.choice((1, 4, 16))):
            data[pick.randrange(len(data))] = pick.randrange(256)
        changed = tmp_path / f"{k}{ending}"
        changed.write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                ts.read_usd(changed)
            outcomes.add("read")
        except TaisoftError as error:
            assert str(error).startswith(str(changed)) and "\n" not in str(error)
            outcomes.add("refused")
    assert "refused" in outcomes and capfd.readouterr() == ("", "")


# --- commands ---------------------------------------------------------------------------------------------------------


def test_commands_accept_a_stage(tmp_path, capsys):
    path = tmp_path / "two.usda"
    stage = new_stage(path)
    add_tets(stage, "/upper")
    add_tets(stage, "/lower").AddTranslateOp().Set(Gf.Vec3d(0, -3, 0))
    stage.Save()
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert f"{path}: upper\n" in shown and f"{path}: lower\n" in shown and shown.count(f"{MESH.n_tets} tets") == 2
    assert main(["scene", str(path), "--out", str(tmp_path / "two.toml")]) == 0
    scene, _ = ts.read_scene(tmp_path / "two.toml")
    upper, lower = (scene.body(name) for name in ("upper", "lower"))
    start = [body.rest_positions + body.position for body in (upper, lower)]
    assert start[1][:, 1].min() == pytest.approx(0.25 * 4.0) and np.allclose(start[0] - start[1], (0, 3, 0), atol=1e-6)


# --- scene files ------------------------------------------------------------------------------------------------------

BODY = '[bodies.part]\nmaterial = {{ young = 1e5 }}\nmesh = {{ file = "two.usda"{more} }}\n'


@pytest.fixture
def two(tmp_path):
    """A folder with a stage of two bodies of tets and an open surface."""
    stage = new_stage(tmp_path / "two.usda")
    UsdGeom.Xform.Define(stage, "/World/upper")
    add_tets(stage, "/World/upper/tets").AddTranslateOp().Set(Gf.Vec3d(0, 3, 0))
    add_tets(stage, "/World/lower")
    add_surface(stage, "/World/lid", CUBE, QUADS[1:])
    stage.Save()
    return tmp_path


def read_scene(folder, more="", **options):
    (folder / "scene.toml").write_text(BODY.format(more=more))
    return ts.read_scene(folder / "scene.toml", **options)[0].bodies[0].mesh


@pytest.mark.parametrize("prim", ["tets", "/World/upper/tets", "/World/upper", "lower", "/World/lower"])
def test_a_scene_file_takes_a_mesh_of_a_stage(two, prim):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of the surface that is not taken
        mesh = read_scene(two, f', prim = "{prim}"')
    high = 0.0 if "lower" in prim else 3.0
    assert np.array_equal(mesh.vertices, MESH.vertices.astype(np.float32) + (0.0, high, 0.0)) and np.array_equal(
        mesh.tets, MESH.tets
    )


def test_the_only_mesh_of_a_stage_needs_no_name(tmp_path):
    stage = new_stage(tmp_path / "two.usda")
    add_tets(stage)
    stage.Save()
    assert read_scene(tmp_path).n_tets == MESH.n_tets


@pytest.mark.parametrize(
    "more, message",
    [
        ("", "bodies.part.mesh.prim is missing: {stage} holds tets, lower"),
        (', prim = "lid"', "bodies.part.mesh.prim 'lid' fits none: {stage} holds tets, lower"),
        (', prim = "/World"', "bodies.part.mesh.prim '/World' fits several: {stage} holds tets, lower"),
        (', prim = ""', "bodies.part.mesh.prim '' fits none: {stage} holds tets, lower"),
        (", prim = 3", "bodies.part.mesh.prim must be the name or the path of a mesh in the stage, not 3"),
        (", fix_orientation = true", "bodies.part.mesh.fix_orientation is not known; there are file, prim, edge_length"),
    ],
)
def test_a_scene_file_must_name_a_mesh_of_the_stage(two, more, message):
    with pytest.raises(TaisoftError) as caught:
        read_scene(two, more)
    assert str(caught.value) == f"{two / 'scene.toml'}: {message.format(stage=two / 'two.usda')}"


@pytest.mark.parametrize("kind", ["references", "subLayers", "payload", "clips"])
def test_a_stage_of_a_scene_file_names_no_other_files(two, kind):
    """Unless that is allowed."""
    (two / "two.usda").rename(two / "other.usda")
    arcs = {
        "references": 'over "World" (references = @other.usda@</World>) {}',
        "payload": 'over "World" (payload = @other.usda@</World>) {}',
        "clips": 'over "World" (clips = { dictionary default = { asset[] assetPaths = [@other.usda@] } }) {}',
        "subLayers": "",
    }
    head = "(subLayers = [@other.usda@])" if kind == "subLayers" else ""
    (two / "two.usda").write_text(f"#usda 1.0\n{head}\n{arcs[kind]}\n")
    with pytest.raises(TaisoftError, match=r"not a readable USD stage \(it names a further file, 'other.usda'\)$"):
        read_scene(two, ', prim = "lower"')
    if kind != "clips":
        assert read_scene(two, ', prim = "lower"', allow_outside=True).n_tets == MESH.n_tets
