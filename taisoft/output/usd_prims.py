"""OpenUSD prims of a scene: bodies and obstacles with their topology, colours and materials; see `usd.py`.

Solids are single-sided, half-spaces included, so that a viewer with back-face culling can look into a bin. For viewers without
culling, half-spaces that face away from the camera at the start, and so hide the bodies, have purpose guide, which viewers show
only on request. Open obstacle meshes are double-sided.
"""

import re

import numpy as np

from taisoft.mesh.topology import opposite_half_edges
from taisoft.output.appearance import OBSTACLE_COLOUR, body_colour, compact_surface, linear_rgb
from taisoft.output.obstacle_surface import ObstacleSurface, obstacle_surfaces
from taisoft.output.usd_view import ViewTrack
from taisoft.scene.obstacles import HalfSpace, MeshObstacle

ROOT = "/World"
STRESS, IMPULSE = "vonMisesStress", "contactImpulse"  # primvars
MAX_NAME = 64  # characters of a prim name; the full name is stored as display name


def prim_names(names: list[str]) -> list[str]:
    """Return legal, distinct USD prim names for names of bodies and obstacles, in order.

    Characters other than ASCII letters, digits and underscores become underscores (UTF-8 identifiers are new in USD, and
    many readers reject them). A leading digit gets an underscore before it; a repeated name gets a number appended.
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


class Track:
    """A prim with time-varying points and primvars.

    gprim: the defined prim; nodes: indices of its points in arrays over the nodes of all bodies; primvars: names. Paths are
    built once, since building them at every frame would cost as much as setting the values.
    """

    def __init__(self, gprim, nodes: np.ndarray | slice = slice(None), primvars: tuple[str, ...] = ()):
        self._nodes = nodes
        self._points, self._extent = gprim.GetPointsAttr().GetPath(), gprim.GetExtentAttr().GetPath()
        self._primvars = [(name, gprim.GetPath().AppendProperty(f"primvars:{name}")) for name in primvars]

    def samples(self, points: np.ndarray, fields: dict[str, np.ndarray]) -> list[tuple]:
        """Return (path, value) of each attribute. points: (n,3) float32 [m]; fields: primvars by name, (n,) or (n,3) float32."""
        from pxr import Vt

        x = points[self._nodes]
        found = [(self._points, Vt.Vec3fArray.FromNumpy(x)), (self._extent, Vt.Vec3fArray.FromNumpy(extent(x)))]
        for name, path in self._primvars:
            values = fields[name][self._nodes]
            found.append((path, (Vt.FloatArray if values.ndim == 1 else Vt.Vec3fArray).FromNumpy(values)))
        return found


def scene_layer(scene, fps: float, touching: bool) -> tuple[list[Track], list, ViewTrack, object]:
    """Build a layer with everything that does not change, and the tracks that get values with the frames.

    touching: whether there can be contacts. Returns the tracks of the bodies, (track, surface) of each obstacle that follows a
    path, the camera's track and the layer.
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
    tracks, first = [], 0
    for k, (body, name) in enumerate(zip(scene.bodies, legal)):
        tracks += _define_body(stage, body, name, k, first, touching)
        first += body.n_nodes
    view = ViewTrack(stage, scene)
    surfaces = [s for s in zip(obstacle_surfaces(scene), legal[len(scene.bodies) :]) if len(s[0].triangles)]
    moving = [(_define_obstacle(stage, surface, name, view.camera.position), surface) for surface, name in surfaces]
    return tracks, [one for one in moving if one[1].obstacle.path is not None], view, layer


def _define_named(stage, name: str, legal_name: str, colour: np.ndarray):
    """Define the prim of a body or an obstacle; return its path, linear colour and material."""
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
    """Return the smallest and largest coordinates of points (n,3), (2,3) float32."""
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float32)


def _define_obstacle(stage, shown: ObstacleSurface, legal_name: str, eye: np.ndarray) -> Track:
    """Define an obstacle's surface at its initial pose. eye: position of the camera (3,) [m]."""
    from pxr import UsdGeom, UsdShade, Vt

    path, colour, material = _define_named(stage, shown.obstacle.name, legal_name, OBSTACLE_COLOUR)
    surface, points = _define_surface(stage, f"{path}/surface", shown.triangles), shown.at(0.0).astype(np.float32)
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent(points)))
    surface.CreateDisplayColorAttr([colour])
    if isinstance(shown.obstacle.shape, MeshObstacle) and (opposite_half_edges(shown.triangles) < 0).any():
        surface.CreateDoubleSidedAttr(True)
    if isinstance(shown.obstacle.shape, HalfSpace):
        a, b, c = shown.at(0.0)[shown.triangles[0]]
        if np.cross(b - a, c - a) @ (eye - a) <= 0.0:
            surface.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)
    return Track(surface)


def _define_body(stage, body, legal_name: str, index: int, first: int, touching: bool) -> list[Track]:
    """Define a body's surface, tets and primvars. first: index of its first node among the nodes of all bodies."""
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
        _define_primvar(gprim, STRESS, "FloatArray", "von Mises equivalent of the mean Cauchy stress at the node [Pa]")
        UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)
    if touching:
        _define_primvar(surface, IMPULSE, "Vector3fArray", "impulse of the contacts of the last step on the node [N s]")
    all_nodes = slice(first, first + body.n_nodes)
    primvars = (STRESS, IMPULSE) if touching else (STRESS,)
    return [Track(surface, first + nodes, primvars), Track(tets, all_nodes, (STRESS,))]


def _define_primvar(gprim, name: str, kind: str, meaning: str) -> None:
    """Define a primvar at the points, without values. meaning: its documentation."""
    from pxr import Sdf, UsdGeom

    primvar = UsdGeom.PrimvarsAPI(gprim).CreatePrimvar(name, getattr(Sdf.ValueTypeNames, kind), UsdGeom.Tokens.vertex)
    primvar.GetAttr().SetDocumentation(meaning)


def _define_material(stage, path: str, colour):
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material
