"""The USD export, read back with USD: valid, with every frame; chunks of a killed run join to the file it would have written."""

import resource

import numpy as np
import pytest
from pxr import Tf, Usd, UsdGeom, UsdLux, UsdShade

from taisoft.dynamics.readout import nodal_impulses
from taisoft.errors import OutputError
from taisoft.output.nodal_fields import NodalMean, von_mises
from taisoft.output.usd import UsdWriter
from taisoft.output.usd_scene import prim_names
from taisoft.output.viewpoint import Viewpoint, start_positions
from taisoft.scene.checks import store
from taisoft.scene.obstacles import Sphere
from tests.output.usd_stage import check_frames, faults
from tests.view.fake_simulator import FakeSimulator, beam_scene

NAMES = ("1 cube", "1_cube", "ü", "x" * 300, "material")


def export(folder, scene, n_frames, chunk_frames=10, close=True):
    """Write n_frames of a fake run; returns the positions per frame and body."""
    sim, positions = FakeSimulator(scene), []
    writer = UsdWriter(folder, scene, fps=30.0, chunk_frames=chunk_frames)
    for index in range(n_frames):
        sim.time = index / 30
        positions.append({body.name: sim.positions(body.name) for body in scene.bodies})
        writer.frame(sim, index)
    if close:
        writer.close()
    return positions


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The scene and the stage of 23 frames."""
    folder, scene = tmp_path_factory.mktemp("usd"), beam_scene(NAMES)
    positions = export(folder, scene, 23)
    assert [path.name for path in folder.iterdir()] == ["scene.usdc"]
    assert check_frames(folder / "scene.usdc", positions) == 23
    stage = Usd.Stage.Open(str(folder / "scene.usdc"))
    assert faults(stage) == []
    return scene, stage


def canonical(triangle):
    """The triangle's indices starting with the smallest: the same for equal orientations."""
    return tuple(np.roll(triangle, -np.argmin(triangle)).tolist())


def test_units_tets_and_surface(exported):
    """Tets are not inverted and not drawn; the surface has no inner vertex, and a colour."""
    stage, body = exported[1], exported[0].bodies[0]
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert stage.GetDefaultPrim().GetPath() == "/World" and stage.GetFramesPerSecond() == 30.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (30.0, 0.0, 22.0)
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/World/_1_cube/surface"))
    assert len(surface.GetPointsAttr().Get(0)) == len(np.unique(body.nodes.surface)) < body.n_nodes
    assert surface.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.none
    assert set(surface.GetFaceVertexCountsAttr().Get()) == {3}
    material = UsdShade.MaterialBindingAPI(surface.GetPrim()).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0]
    assert shader.GetInput("diffuseColor").Get() == surface.GetDisplayColorAttr().Get()[0]
    tets = UsdGeom.TetMesh(stage.GetPrimAtPath("/World/_1_cube/tets"))
    assert np.array_equal(np.array(tets.GetTetVertexIndicesAttr().Get()), body.nodes.tets)
    assert len(UsdGeom.TetMesh.FindInvertedElements(tets, Usd.TimeCode(5))) == 0
    faces = np.array(UsdGeom.TetMesh.ComputeSurfaceFaces(tets, Usd.TimeCode(5)))
    assert sorted(map(canonical, faces)) == sorted(map(canonical, body.nodes.surface))
    assert tets.ComputePurpose() == UsdGeom.Tokens.guide


def test_points_have_stress_and_nodal_impulses(exported):
    def primvar(path, name):
        values = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(path)).GetPrimvar(name)
        assert values.GetInterpolation() == UsdGeom.Tokens.vertex
        return np.array(values.Get(22))

    scene, stage = exported
    sim, first = FakeSimulator(scene), np.cumsum([0] + [body.n_nodes for body in scene.bodies])
    sim.time = 22 / 30
    contacts = sim.contacts()
    stress, impulses = von_mises(NodalMean(scene.bodies)(sim.stress())), nodal_impulses(contacts, first[-1])
    assert stress.min() >= 0 and np.ptp(stress) > 1e3 and impulses.any()
    for k, (body, prim_name) in enumerate(zip(scene.bodies, prim_names(list(NAMES)))):
        own, path, nodes = slice(first[k], first[k + 1]), f"/World/{prim_name}", np.unique(body.nodes.surface)
        assert np.array_equal(primvar(f"{path}/tets", "vonMisesStress"), stress[own].astype(np.float32))
        assert np.array_equal(primvar(f"{path}/surface", "vonMisesStress"), stress[own][nodes].astype(np.float32))
        on_surface = primvar(f"{path}/surface", "contactImpulse")
        assert np.array_equal(on_surface, impulses[own][nodes].astype(np.float32))
        total = contacts.impulse[contacts.body_a == body.name].sum(axis=0)
        total = total - contacts.impulse[contacts.body_b == body.name].sum(axis=0)
        assert np.abs(total).max() > 0.5 and np.allclose(on_surface.sum(axis=0), total, atol=1e-5)


def test_impulses_are_written_only_if_contacts_are_possible(tmp_path):
    apart = beam_scene(("one", "two"))
    apart.contact_forces = False
    for name, scene, expected in (("alone", beam_scene(), False), ("off", apart, False), ("itself", beam_scene(), True)):
        writer = UsdWriter(tmp_path / name, scene, self_collision=name == "itself")
        writer.frame(FakeSimulator(scene), 0)
        writer.close()
        stage = Usd.Stage.Open(str(tmp_path / name / "scene.usdc"))
        found = {prim.HasAttribute("primvars:contactImpulse") for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
        assert found == {expected}, name


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_camera_projects_like_that_of_the_images(tmp_path, up):
    """It moves back for bodies that leave the image. No run with another up axis resumes there."""
    scene = beam_scene()
    scene.up = up
    sim, writer, size = FakeSimulator(scene), UsdWriter(tmp_path, scene), (1600, 900)
    camera, expected = Viewpoint.framing(start_positions(scene), size, up=up), []
    for index in range(4):
        sim.time = 0.5 * index
        writer.frame(sim, index)
        camera = camera.widened(sim.positions(), size, 4 * camera.distance)
        expected.append((camera, sim.positions()))
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    assert UsdGeom.GetStageUpAxis(stage) == up.upper()
    lamp = UsdGeom.Xformable(stage.GetPrimAtPath("/View/lamp")).ComputeLocalToWorldTransform(0).TransformDir((0, 0, 1))
    assert lamp["xyz".index(up)] > 0.7
    scene.up = "z" if up == "y" else "y"
    with pytest.raises(OutputError, match="is of another scene, up axis, frame rate or --error"):
        UsdWriter(tmp_path, scene, first=1)
    assert not prim.GetPath().HasPrefix(stage.GetDefaultPrim().GetPath())
    assert expected[3][0].distance > 1.1 * expected[0][0].distance
    for index, (camera, x) in enumerate(expected):
        usd_camera = UsdGeom.Camera(prim).GetCamera(index)
        frustum = usd_camera.frustum
        projection = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        clip = np.column_stack([x, np.ones(len(x))]) @ np.array(projection)
        pixels = (clip[:, :2] / clip[:, 3:] * (1, -1) + 1) / 2 * size
        assert np.abs(pixels - camera.project(x, size)[:, :2]).max() < 0.05
        assert (np.abs(clip[:, :3]) < clip[:, 3:]).all()  # between the clipping planes too
    assert [100 * usd_camera.horizontalAperture, 100 * usd_camera.focalLength] == pytest.approx([36, 37.8], abs=0.1)  # [mm]


def test_lights_are_outside_the_default_prim_and_behind_the_camera(exported):
    stage = exported[1]
    lights = [prim for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert [prim.GetTypeName() for prim in lights] == ["DistantLight", "DomeLight"]
    assert {str(prim.GetPath().GetParentPath()) for prim in lights} == {"/View"}
    lamp, dome = (UsdLux.LightAPI(prim) for prim in lights)
    # brightness of a white diffuse face perpendicular to the lamp's rays
    assert lamp.GetNormalizeAttr().Get() and 0.9 < lamp.GetIntensityAttr().Get() / np.pi + dome.GetIntensityAttr().Get() < 1.2
    towards = np.array(UsdGeom.Xformable(lights[0]).ComputeLocalToWorldTransform(0).TransformDir((0, 0, 1)))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/View/camera")).GetCamera(0).transform
    # over the viewer's left shoulder, and in front of the visible walls, whose normals are along x and z
    seen = np.array([camera.TransformDir(tuple(axis)) for axis in np.eye(3).tolist()]) @ towards
    assert (seen * (-1, 1, 1) > (0.2, 0.4, 0.4)).all() and (towards > (0.05, 0.7, 0.05)).all()


def test_prim_names_are_valid_and_distinct(exported, tmp_path):
    """And invalid settings are refused."""
    names = ["a/b", "a b", "a_b", "a_b_1", "", "9", "ü", "é", "x" * 300, "x" * 299, "__", "body"]
    valid = prim_names(names)
    assert len(set(valid)) == len(names) and prim_names(["beam", "cube"]) == ["beam", "cube"]
    assert all(Tf.IsValidIdentifier(name) and name.isascii() and len(name) < 80 for name in valid)
    prims = exported[1].GetPrimAtPath("/World").GetChildren()
    assert [(prim.GetDisplayName(), prim.GetCustomDataByKey("taisoft:name")) for prim in prims] == [
        (name, name) for name in NAMES
    ]
    for name in ("fps", "chunk_frames"):
        with pytest.raises(OutputError, match=f"{name} must be"):
            UsdWriter(tmp_path, beam_scene(), **{name: 0})


def test_joined_chunks_equal_the_finished_scene(tmp_path):
    """Chunks are written during the run; the third body is quadratic."""
    scene, killed = beam_scene(("one", "two")), tmp_path / "killed"
    scene.add_body(scene.bodies[0].mesh, scene.bodies[0].material, name="three", position=(0, -1.5, 0), order=2)
    export(tmp_path / "whole", scene, 20)
    killed.mkdir()
    (killed / "scene.usdc").write_text("of an earlier run")
    positions = export(killed, scene, 27, close=False)
    assert (killed / "scene.usdc").read_text() == "of an earlier run"
    chunks = sorted((killed / "chunks").iterdir())
    assert [path.name for path in chunks] == ["points_00000.usdc", "points_00010.usdc"]
    assert [check_frames(path, positions, first) for path, first in zip(chunks, (0, 10))] == [10, 10]
    (killed / "scene.usdc").unlink()
    UsdWriter(killed, scene, fps=30.0, first=20).close()
    assert check_frames(killed / "scene.usdc", positions) == 20
    stages = [Usd.Stage.Open(str(folder / "scene.usdc")) for folder in (tmp_path / "whole", killed)]
    whole, joined = (stage.ExportToString() for stage in stages)  # which begin with the file's path
    assert faults(stages[0]) == [] and whole.replace("whole", "killed") == joined and not (killed / "chunks").exists()
    export(tmp_path / "none", scene, 0)
    assert list((tmp_path / "none").iterdir()) == []


def test_a_last_frame_between_two_has_its_own_time(tmp_path):
    """The run that goes on from there replaces it."""
    sim = FakeSimulator(beam_scene())
    for first, times, expected in ((0, (0.0, 0.04, 0.06), [0, 1, 1.5]), (2, (0.08, 0.1), [0, 1, 2, 2.5])):
        writer = UsdWriter(tmp_path, sim.scene, fps=25.0, chunk_frames=2, first=first)
        for index, sim.time in enumerate(times, first):
            writer.frame(sim, index)
        writer.close()
        stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
        stage.Reload()  # the first one may be kept
        points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/beam/surface")).GetPointsAttr()
        assert points.GetTimeSamples() == pytest.approx(expected) and stage.GetEndTimeCode() == pytest.approx(expected[-1])


def test_an_obstacle_that_is_commanded_moves_from_then_on(tmp_path):
    scene = beam_scene()
    obstacle, sim = scene.add_obstacle(Sphere((0, -3, 0), 0.5), name="ball"), FakeSimulator(scene)
    writer = UsdWriter(tmp_path, scene, fps=10.0, chunk_frames=2)
    for index in range(4):
        sim.time = 0.1 * index
        if index == 2:
            store(obstacle, path=lambda t: ((t, 0, 0), np.eye(3)))  # as a command does
        writer.frame(sim, index)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/ball/surface")).GetPointsAttr()
    moved = [float(np.mean(np.array(points.Get(index)) - np.array(points.Get(0)), axis=0)[0]) for index in range(4)]
    resumed = UsdWriter(tmp_path, scene, fps=10.0, first=4)
    sim.time = 0.4
    resumed.frame(sim, 4)
    resumed.close()
    stage.Reload()
    assert np.array(points.Get(3))[:, 0].mean() == pytest.approx(0.3, abs=1e-5), "a resumed run leaves earlier frames as they are"
    assert points.GetTimeSamples() == [1, 2, 3, 4] and moved == pytest.approx([0.0, 0.0, 0.2, 0.3], abs=1e-5)


def test_a_full_disk_is_an_error_and_leaves_no_partial_file(tmp_path):
    scene = beam_scene(cells=(16, 4, 4))
    writer, sim = UsdWriter(tmp_path, scene, chunk_frames=5), FakeSimulator(scene)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*usdc \(\d+ bytes"):
            for index in range(50):
                writer.frame(sim, index)
            writer.close()
        n_chunks = len(list((tmp_path / "chunks").glob("*.usdc")))
        writer.close()  # does not raise again
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    chunks = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(chunks) == n_chunks >= 1 and all(Usd.Stage.Open(str(path)) for path in chunks)
