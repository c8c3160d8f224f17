"""`read_usd`: bodies from USD stages; `read_stage` is what its child process runs. What taisoft writes comes back; transforms,
handedness, units and the up axis are understood; closed surfaces are filled; a broken stage gives one sentence; `taisoft
info` and scene files accept a stage, but none that names other files.
"""

import warnings

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, Vt

import taisoft as ts
from taisoft.cli import main
from taisoft.errors import MeshError, TaisoftError
from taisoft.mesh.usd_content import read_stage
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


def add_tets(stage, path="/tets", points=MESH.vertices, tets=MESH.tets):
    prim = UsdGeom.TetMesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    prim.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(tets, dtype=np.int32)))
    return prim


def add_surface(stage, path, points, faces):
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    prim.CreateFaceVertexCountsAttr([len(face) for face in faces])
    prim.CreateFaceVertexIndicesAttr([k for face in faces for k in face])
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return prim


def only(path) -> ts.TetMesh:
    """The tets of a stage that holds one mesh; a warning fails the test."""
    found = read_stage(str(path))
    ((_, _, points, cells),) = found["meshes"]
    assert found["notes"] == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return ts.TetMesh(points, cells)


@pytest.mark.filterwarnings("ignore:body ")
def test_what_is_written_comes_back(tmp_path):
    """A linear and a quadratic body; the obstacle is left out with a warning."""
    scene = ts.Scene()
    scene.add_body(MESH, ts.Material(), name="linear", position=(0.1, 0.2, 0.3))
    scene.add_body(MESH, ts.Material(), name="quadratic", order=2, position=(0, 3, 0))
    scene.add_obstacle(ts.Sphere((0, -9, 0), 1), name="stone")
    writer = UsdWriter(tmp_path, scene)
    sim = FakeSimulator(scene)
    for frame in (3, 4):  # as of a resumed run in a folder of its own: the rest shape is not in a frame
        sim.time = frame / 60
        writer.frame(sim, frame)
    writer.close()
    with pytest.warns(UserWarning, match="obstacles are left out: stone"):
        meshes = ts.read_usd(tmp_path / "scene.usdc")
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
    points = add_tets(stage, "/part/body").GetPointsAttr()
    points.Clear()  # no default, but two times, of which the first counts
    for time, factor in ((3, 1.0), (5, 2.0)):
        points.Set(Vt.Vec3fArray.FromNumpy((factor * MESH.vertices).astype(np.float32)), time)
    stage.Save()
    mesh = only(path)
    x, y, z = MESH.vertices.astype(np.float32).T.astype(float)
    turned = np.stack([x + 10, -z + 20, y + 30], axis=1)  # z up
    assert np.allclose(mesh.vertices, 0.01 * turned[:, [0, 2, 1]] * (1, 1, -1), atol=1e-12)
    with pytest.raises(MeshError, match="^read_usd: up must be one of y, z, not 'x'$"):
        ts.read_usd(path, up="x")
    assert mesh.volumes.sum() == pytest.approx(1e-6 * MESH.volumes.sum(), rel=1e-6)


def test_handedness(tmp_path):
    """Tets come out positive without a warning, since a mirror turns left-handed ones around."""
    for mirrored, left_handed in ((False, True), (True, False), (True, True)):
        path = tmp_path / f"{mirrored}{left_handed}.usda"
        stage = new_stage(path)
        prim = add_tets(stage, tets=MESH.tets[:, [0, 2, 1, 3]] if left_handed else MESH.tets)
        if left_handed:
            prim.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
        if mirrored:
            prim.AddScaleOp().Set(Gf.Vec3f(-2, 1, 1))
        stage.Save()
        mesh = only(path)
        assert len(mesh.flipped) == 0 and np.allclose(mesh.vertices, MESH.vertices * (-2 if mirrored else 1, 1, 1), atol=1e-6)


def test_closed_polygons_are_filled_and_open_ones_left_out(tmp_path):
    pytest.importorskip("wildmeshing")
    path = tmp_path / "a.usda"
    stage = new_stage(path)
    add_surface(stage, "/a/part", 2.0 * np.array(CUBE) + 5.0, QUADS)
    add_tets(stage, "/b/part")
    add_surface(stage, "/lid", CUBE, QUADS[:5])
    add_surface(stage, "/proxy", CUBE, QUADS).CreatePurposeAttr(UsdGeom.Tokens.proxy)
    stage.Save()
    with pytest.warns(UserWarning, match="lid is open, so it bounds no solid"):
        meshes = ts.read_usd(path, edge_length=1.5)
    assert list(meshes) == ["part", "part_2"] and np.array_equal(meshes["part_2"].tets, MESH.tets)
    assert meshes["part"].volumes.sum() == pytest.approx(8, rel=0.15)  # coarse tets, and another mesh in every run
    assert np.allclose(meshes["part"].vertices.min(axis=0), 5, atol=0.3)


FACE = (
    '#usda 1.0\ndef Mesh "part" {{\npoint3f[] points = [(0,0,0)]\nint[] faceVertexCounts = {}\nint[] faceVertexIndices = {}\n}}'
)


def test_broken_stages_give_one_sentence(tmp_path):
    path = tmp_path / "a.usda"
    for content, message in (
        ("", "the file is empty"),
        ('#usda 1.0\ndef Xform "a" {}\n', "the stage holds no tets and no closed surface"),
        (FACE.format([3], [0, 0, 7]), "part: triangle 0: vertex 7 does not exist"),
    ):
        path.write_text(content)
        with pytest.raises(MeshError) as error:
            ts.read_usd(path)
        text = str(error.value)
        assert text.startswith(f"{path}: {message}") and "\n" not in text and text.count(str(path)) == 1
    for content, message in (
        ("#usda 1.0\n\ndef Mesh {{{\n", "line 3 cannot be parsed"),
        ('#usda 1.0\ndef Xform "a" (references = @b.usda@) {}', "its part 'b.usda' cannot be opened"),
        (FACE.format([3, 4], [0, 0, 0]), "do not fit together"),
    ):
        path.write_text(content)
        with pytest.raises(MeshError, match=message):
            read_stage(str(path))


def read_scene(folder, more="", **options):
    text = f'[bodies.part]\nmaterial = {{ young = 1e5 }}\nmesh = {{ file = "two.usda"{more} }}\n'
    (folder / "scene.toml").write_text(text)
    return ts.read_scene(folder / "scene.toml", **options)[0].bodies[0].mesh


def test_info_and_scene_files_take_a_stage(tmp_path, capsys):
    """With two bodies of tets and an open surface; a mesh by its name or path, turned to z up."""
    path = tmp_path / "two.usda"
    stage = new_stage(path)
    UsdGeom.Xform.Define(stage, "/World/upper")
    add_tets(stage, "/World/upper/tets").AddTranslateOp().Set(Gf.Vec3d(0, 3, 0))
    add_tets(stage, "/World/lower")
    add_surface(stage, "/World/lid", CUBE, QUADS[1:])
    stage.Save()
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "two.usda: tets\n" in shown and "two.usda: lower\n" in shown and shown.count(f"{MESH.n_tets} tets") == 2
    for more, message in (
        (', prim = "/World"', "mesh.prim '/World' fits several: {stage} holds tets, lower"),
        (", fix_orientation = true", "mesh.fix_orientation is not known; there are file, prim, edge_length, up"),
    ):
        with pytest.raises(TaisoftError) as caught:
            read_scene(tmp_path, more)
        assert str(caught.value) == f"{tmp_path / 'scene.toml'}: bodies.part.{message.format(stage=path)}"
    # it names no other files, unless that is allowed
    path.rename(tmp_path / "other.usda")
    path.write_text('#usda 1.0\n(\nmetersPerUnit = 1\n)\nover "World" (references = @other.usda@</World>) {}\n')
    with pytest.raises(TaisoftError, match=r"not a readable USD stage \(it names a further file, 'other.usda'\)$"):
        read_scene(tmp_path, ', prim = "lower"')
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of the surface that is not taken
        mesh = read_scene(tmp_path, ', prim = "/World/upper", up = "z"', allow_outside=True)
    x, y, z = MESH.vertices.astype(np.float32).T.astype(float)
    assert np.array_equal(mesh.vertices, np.stack([x, -z, y + 3.0], axis=1))
