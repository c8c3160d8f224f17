"""The prims of a scene in OpenUSD: bodies and obstacles with their topology, colours and materials; see `usd.py`.

Surfaces are single-sided, so that a viewer that leaves out back faces looks into a bin.
"""

import re

import numpy as np

from taisoft.output.appearance import OBSTACLE_COLOUR, body_colour, compact_surface, linear_rgb
from taisoft.output.obstacle_surface import ObstacleSurface, obstacle_surfaces

ROOT = "/World"
MAX_NAME = 64  # characters of a prim name; the whole name is kept beside it


def prim_names(names: list[str]) -> list[str]:
    """Legal, distinct USD prim names for names of bodies and obstacles, in order.

    Anything but ASCII letters, digits and underscores becomes an underscore (UTF-8 identifiers are young in USD, and
    many readers refuse them); a leading digit gets one before it; a name met before gets a number behind it.
    """
    used: set[str] = set()
    legal = []
    for name in names:
        base = re.sub(r"[^A-Za-z0-9_]", "_", name)[:MAX_NAME] or "body"
        base = f"_{base}" if base[0].isdigit() else base
        candidate, count = base, 1
        while candidate in used:
            candidate, count = f"{base}_{count}", count + 1
        used.add(candidate)
        legal.append(candidate)
    return legal


def scene_layer(scene, fps: float) -> tuple[dict[str, list], list, object]:
    """What gets points with the frames, and a layer with all else.

    Per body the (prim path, nodes or None for all), and the (prim path, surface) of each obstacle that follows a path.
    """
    from pxr import Sdf, Usd, UsdGeom

    import taisoft

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.comment = f"taisoft {taisoft.__version__}"
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    legal = prim_names([one.name for one in (*scene.bodies, *scene.obstacles)])
    tracks = {body.name: _define_body(stage, body, name, k) for k, (body, name) in enumerate(zip(scene.bodies, legal))}
    surfaces = [s for s in zip(obstacle_surfaces(scene), legal[len(scene.bodies) :]) if len(s[0].triangles)]
    paths = [(_define_obstacle(stage, surface, name), surface) for surface, name in surfaces]
    return tracks, [(path, surface) for path, surface in paths if surface.obstacle.path is not None], layer


def _define_named(stage, name: str, legal_name: str, colour: np.ndarray):
    """The prim of a body or an obstacle: its path, linear colour and material."""
    from pxr import Gf, UsdGeom

    path = f"{ROOT}/{legal_name}"
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    prim.SetDisplayName(name)
    prim.SetCustomDataByKey("taisoft:name", name)
    linear = Gf.Vec3f(*linear_rgb(colour).tolist())
    return path, linear, _define_material(stage, f"{path}/material", linear)


def _define_surface(stage, path: str, triangles: np.ndarray):
    from pxr import UsdGeom, Vt

    surface = UsdGeom.Mesh.Define(stage, path)
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, dtype=np.int32)))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.ravel().astype(np.int32)))
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return surface


def extent(points: np.ndarray) -> np.ndarray:
    """(2,3) float32: least and largest coordinates of points (n,3)."""
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float32)


def _define_obstacle(stage, shown: ObstacleSurface, legal_name: str) -> str:
    """Its surface where it starts. Returns the path of that prim."""
    from pxr import UsdShade, Vt

    path, colour, material = _define_named(stage, shown.obstacle.name, legal_name, OBSTACLE_COLOUR)
    surface, points = _define_surface(stage, f"{path}/surface", shown.triangles), shown.at(0.0).astype(np.float32)
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent(points)))
    surface.CreateDisplayColorAttr([colour])
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)
    return f"{path}/surface"


def _define_body(stage, body, legal_name: str, index: int) -> list[tuple[str, np.ndarray | None]]:
    from pxr import UsdGeom, UsdShade, Vt

    path, colour, material = _define_named(stage, body.name, legal_name, body_colour(index))
    nodes, local = compact_surface(body.nodes.surface)
    surface = _define_surface(stage, f"{path}/surface", local)

    tets = UsdGeom.TetMesh.Define(stage, f"{path}/tets")
    tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(body.nodes.tets, dtype=np.int32)))
    faces = np.ascontiguousarray(body.nodes.surface, dtype=np.int32)
    tets.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(faces))
    tets.CreatePurposeAttr(UsdGeom.Tokens.guide)

    for gprim in (surface, tets):
        gprim.CreatePointsAttr()
        gprim.CreateExtentAttr()
        gprim.CreateDisplayColorAttr([colour])
        UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)
    return [(f"{path}/surface", nodes), (f"{path}/tets", None)]


def _define_material(stage, path: str, colour):
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material
