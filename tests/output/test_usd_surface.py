"""What film needs of scene.usdc: the pictures' normals, velocities, UVs, subsets with materials, opacity, lights and a moving
camera; all valid, in a linear body and a quadratic one, a skin, a rigid body and obstacles.
"""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdLux, UsdShade

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.mesh.texture import split_uvs
from taisoft.output.smoothing import smoothing_groups, vertex_normals
from taisoft.output.usd import UsdWriter
from taisoft.output.viewpoint import camera_viewpoint
from tests.output.usd_stage import faults
from tests.view.fake_simulator import RUBBER, FakeSimulator

BOX, BALL = ts.box_mesh((2, 2, 2), (1, 1, 1)), ts.ball_mesh(0.5, 4)
USED, CORNERS = np.unique(BALL.surface, return_inverse=True)
SKIN = ts.SurfaceMesh(
    0.9 * BALL.vertices[USED],
    CORNERS.reshape(-1, 3),
    uvs=np.random.default_rng(2).uniform(size=(len(BALL.surface), 3, 2)),
    subsets={"top": [0, 1, 2], "ünten": np.arange(3, 9)},
)
TEXTURED = ts.TetMesh(
    BOX.vertices,
    BOX.tets,
    surface_uvs=np.random.default_rng(1).uniform(size=(len(BOX.surface), 3, 2)),
    surface_subsets={"surface": [0, 5]},
)


class Shaken(FakeSimulator):
    """Every node goes its own way."""

    def positions(self, name=None):
        x = super().positions(name)
        return x if name is None else x + 0.02 * np.sin(40.0 * x[:, [1, 2, 0]] + 9.0 * self.time)


def film_scene() -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(TEXTURED, RUBBER, name="box", colour="#ff0000", opacity=0.25)
    scene.add_body(TEXTURED, RUBBER, name="quadratic", position=(2, 0, 0), order=2)
    scene.add_body(BALL, RUBBER, name="ball", position=(4, 0, 0))
    scene.add_body(BALL, RUBBER, name="clad", position=(6, 0, 0)).embed(SKIN)
    scene.add_body(BALL, RUBBER, name="touched", position=(8, 0, 0)).embed(SKIN, contact=True)
    scene.add_rigid_body(SKIN, name="rigid", position=(10, 0, 0))
    scene.add_obstacle(ts.Box((0, -3, 0), (1, 1, 1)), name="press", path=lambda t: ((0.5 * t * t, 0, 0), np.eye(3)), opacity=0.5)
    scene.add_obstacle(ts.Sphere((0, -9, 0), 1), name="stone")
    scene.lights = (ts.Light((0, -2, 0), 0.5, "#ff8000"), ts.Light((1, -1, 3), 0.2))
    scene.camera = ts.Camera([(20, 5, 9), (9, 9, 20)], (5, 0, 0), fov=[30.0, 50.0], times=[0.0, 0.1])
    return scene


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """The simulation and the stage of a run of 4 frames, resumed after the second one."""
    folder = tmp_path_factory.mktemp("film")
    sim = Shaken(film_scene())
    for first in (0, 2):
        writer = UsdWriter(folder, sim.scene, fps=30.0, chunk_frames=1, first=first)
        for index in (first, first + 1):
            sim.time = index / 30
            writer.frame(sim, index)
        writer.close()
    stage = Usd.Stage.Open(str(folder / "scene.usdc"))
    assert faults(stage) == [] and stage.GetEndTimeCode() == 3.0
    return sim, stage


def mesh_of(stage, name):
    return UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/surface"))


def at_corners(mesh, primvar, code):
    """The values of a primvar at the corners of all triangles."""
    values = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(primvar)
    flat = np.array(values.ComputeFlattened(code))
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    return flat[corners] if values.GetInterpolation() == UsdGeom.Tokens.vertex else flat


def shown(sim, name):
    """The rest and present positions and the velocities of the shown vertices, and the triangles, of a body."""
    body = sim.scene.body(name)
    x, v = sim.positions(name), sim.velocities(name)
    if name == "clad":
        return SKIN.vertices, body.skin.weights @ x, body.skin.weights @ v, SKIN.triangles
    return body.rest_positions, x, v, body.nodes.surface


@pytest.mark.parametrize("code", [1, 3])
def test_normals_and_velocities_of_bodies(film, code):
    sim, stage = film
    sim.time = code / 30
    smooth = {}
    for body in sim.scene.bodies:
        rest, x, v, triangles = shown(sim, body.name)
        nodes, corners = smoothing_groups(rest, triangles)
        mesh = mesh_of(stage, body.name)
        expected = vertex_normals(x[nodes], corners)[corners].reshape(-1, 3)
        assert np.abs(at_corners(mesh, "normals", code) - expected).max() < 1e-5, body.name
        used = np.unique(triangles)
        assert np.abs(np.array(mesh.GetVelocitiesAttr().Get(code)) - v[used]).max() < 1e-6, body.name
        smooth[body.name] = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals").GetInterpolation() == UsdGeom.Tokens.vertex
    assert [name for name in smooth if not smooth[name]] == ["box", "quadratic"]


def test_a_corner_of_a_box_has_three_normals(film):
    mesh = mesh_of(film[1], "press")
    normals, corners = at_corners(mesh, "normals", 2), np.array(mesh.GetFaceVertexIndicesAttr().Get())
    for corner in range(8):
        assert len(np.unique(np.round(normals[corners == corner], 5), axis=0)) == 3
    assert np.allclose(np.sort(np.abs(normals), axis=1), (0, 0, 1))


def test_velocities_of_obstacles(film):
    """Those of the path, and none where an obstacle rests."""
    moved = mesh_of(film[1], "press").GetVelocitiesAttr()
    for code in range(4):
        assert np.allclose(np.array(moved.Get(code)), (code / 30, 0, 0), atol=2e-4)
    assert mesh_of(film[1], "stone").GetVelocitiesAttr().Get() is None


def test_uvs_and_subsets(film):
    stage = film[1]
    expected = {"box": TEXTURED.surface_uvs, "quadratic": split_uvs(TEXTURED.surface_uvs)}
    expected |= dict.fromkeys(("clad", "touched", "rigid"), SKIN.uvs)
    for name, uvs in expected.items():
        assert np.allclose(at_corners(mesh_of(stage, name), "st", 0), uvs.reshape(-1, 2), atol=1e-7), name
    assert not UsdGeom.PrimvarsAPI(mesh_of(stage, "ball")).HasPrimvar("st")
    for name, subsets in (
        ("box", {"surface_1": [0, 5]}),
        ("quadratic", {"surface_1": [0, 1, 2, 3, 20, 21, 22, 23]}),
        ("clad", {"top": [0, 1, 2], "_nten": list(range(3, 9))}),
        ("ball", {}),
    ):
        found = UsdShade.MaterialBindingAPI(mesh_of(stage, name)).GetMaterialBindSubsets()
        assert {one.GetPrim().GetName(): list(one.GetIndicesAttr().Get()) for one in found} == subsets
        for one in found:
            material, _ = UsdShade.MaterialBindingAPI(one.GetPrim()).ComputeBoundMaterial()
            assert material.GetPath() == f"/World/{name}/{one.GetPrim().GetName()}"


def test_opacity(film):
    stage = film[1]
    for name, opacity in (("box", 0.25), ("ball", 1.0), ("press", 0.5), ("stone", 1.0)):
        mesh = mesh_of(stage, name)
        assert list(mesh.GetDisplayOpacityAttr().Get()) == [opacity]
        for prim in (mesh.GetPrim(), *mesh.GetPrim().GetChildren()):
            shader = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
            assert shader.GetInput("opacity").Get() == opacity
            assert shader.GetInput("diffuseColor").Get() == mesh.GetDisplayColorAttr().Get()[0]
    assert np.allclose(mesh_of(stage, "box").GetDisplayColorAttr().Get()[0], (1, 0, 0))


def test_lights_and_camera_are_those_of_the_scene(film):
    sim, stage = film
    lights = [UsdLux.DistantLight(prim) for prim in stage.Traverse() if prim.IsA(UsdLux.DistantLight)]
    assert len(lights) == 2
    for light, prim in zip(sim.scene.lights, lights):
        shines = UsdGeom.Xformable(prim.GetPrim()).ComputeLocalToWorldTransform(0).TransformDir((0, 0, -1))
        assert np.allclose(np.array(shines), light.direction, atol=1e-6)
        assert prim.GetIntensityAttr().Get() == pytest.approx(np.pi * light.strength)
    assert np.allclose(lights[0].GetColorAttr().Get(), (1.0, 0.2158605, 0.0), atol=1e-6)  # linear
    size = (1600, 900)
    for code in range(4):
        sim.time = code / 30
        x = np.concatenate([sim.positions(body.name) for body in sim.scene.bodies])
        frustum = UsdGeom.Camera(stage.GetPrimAtPath("/View/camera")).GetCamera(code).frustum
        projection = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
        clip = np.column_stack([x, np.ones(len(x))]) @ projection
        pixels = (clip[:, :2] / clip[:, 3:] * (1, -1) + 1) / 2 * size
        assert np.abs(pixels - camera_viewpoint(sim.scene, sim.time, x).project(x, size)[:, :2]).max() < 0.05


def test_a_scene_without_lamps_and_a_path_that_fails(tmp_path):
    """The first has the light of the sky alone. The second is an error as it is in pictures."""
    scene = ts.Scene()
    scene.add_body(BOX, RUBBER)
    scene.add_obstacle(ts.Sphere((0, -9, 0), 1), name="stone", path=lambda t: ((1 / (1 - t), 0, 0), np.eye(3)))
    scene.lights = ()
    sim, writer = FakeSimulator(scene), UsdWriter(tmp_path, scene)
    writer.frame(sim, 0)
    sim.time = 1.0
    with pytest.raises(OutputError, match="an obstacle cannot be shown: .*'stone': the path"):
        writer.frame(sim, 1)
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert [prim.GetTypeName() for prim in stage.GetPrimAtPath("/View").GetChildren()] == ["Camera", "DomeLight"]
