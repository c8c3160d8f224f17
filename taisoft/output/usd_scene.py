"""OpenUSD layer of a scene without its frames: bodies, obstacles, springs and tendons under `/World`, camera and lights
under `/View`.

Solids are single-sided, half-spaces included, so that a viewer with back-face culling can look into a bin. For viewers without
culling, half-spaces that face away from the camera at the start, and so hide the bodies, have purpose guide, which viewers show
only on request. Open obstacle meshes are double-sided.

`/View` is outside of the default prim. So a reference to the scene gets the bodies alone, and the names of bodies and lights
cannot clash. The camera is that of the pictures: it frames the bodies at the start and moves back to keep them in view. The lamp
shines over the viewer's left shoulder; from there upright walls along the axes that face the camera cast no shadow into a bin.
The dome is uniformly grey. Intensities suit an exposure of 1 (a white face perpendicular to the lamp renders nearly white). The
lamp is normalized: readers that ignore this attribute take the intensity as irradiance [W/m^2], which is then the same.
"""

import re
from dataclasses import replace

import numpy as np

from taisoft.mesh.topology import opposite_half_edges
from taisoft.mesh.usd_content import NAME
from taisoft.output.appearance import (
    ObstacleSurface,
    body_colours,
    compact_surface,
    linear_rgb,
    obstacle_colour,
    obstacle_surfaces,
)
from taisoft.output.usd_curves import Curves
from taisoft.output.viewpoint import MAX_WIDENING, Viewpoint, framed_points
from taisoft.scene.obstacles import HalfSpace, MeshObstacle
from taisoft.scene.rigid import RigidBody

ROOT, VIEW = "/World", "/View"
STRESS, IMPULSE, ERROR = "vonMisesStress", "contactImpulse", "estimatedError"  # primvars
TRANSLATE = "xformOp:translate"  # attribute of the camera
MAX_NAME = 64  # characters of a prim name; the full name is stored as display name
PICTURE = (16, 9)  # width and height
SENSOR = 0.036  # width of the film back [m], as for 36 mm film
LAMP_TURN, LAMP_ELEVATION = -22.0, 54.0  # [deg]: about up from the camera's azimuth, above the horizon
LAMP, DOME = 2.2, 0.4  # a white diffuse face reflects LAMP / pi of the lamp and DOME of the dome
LENS = 10.0  # USD gives aperture and focal length in tenths of the scene's unit


def prim_names(names: list[str]) -> list[str]:
    """Return legal, distinct USD prim names for names of bodies and obstacles, in order.

    Characters other than ASCII letters, digits and underscores become underscores (UTF-8 identifiers are new in USD, and
    many readers reject them). A leading digit gets an underscore before it; a repeated name gets a number appended.
    """
    legal: list[str] = []
    for name in names:
        base = re.sub(r"[^A-Za-z0-9_]", "_", name)[:MAX_NAME] or "body"
        base = f"_{base}" if base[0].isdigit() else base
        candidate, count = base, 1
        while candidate in legal:
            candidate, count = f"{base}_{count}", count + 1
        legal.append(candidate)
    return legal


class Track:
    """A prim with time-varying points and primvars.

    gprim: the defined prim; nodes: indices of its points in arrays over the nodes of all bodies; primvars: names; weights: (v,k)
    of those nodes, if its points are sums of them. Paths are built once, since building them at every frame would cost as much
    as setting the values.
    """

    def __init__(self, gprim, nodes: np.ndarray | slice = slice(None), primvars: tuple[str, ...] = (), weights=None):
        self._nodes, self._weights = nodes, weights
        self.points, self._extent = gprim.GetPointsAttr().GetPath(), gprim.GetExtentAttr().GetPath()
        self._primvars = [(name, gprim.GetPath().AppendProperty(f"primvars:{name}")) for name in primvars]

    def samples(self, points: np.ndarray, fields: dict[str, np.ndarray]) -> list[tuple]:
        """Return (path, value) of each attribute. points: (n,3) float32 [m]; fields: primvars by name, (n,) or (n,3) float32."""
        from pxr import Vt

        x = self._own(points)
        found = [(self.points, Vt.Vec3fArray.FromNumpy(x)), (self._extent, Vt.Vec3fArray.FromNumpy(_extent(x)))]
        for name, path in self._primvars:
            values = self._own(fields[name])
            found.append((path, (Vt.FloatArray if values.ndim == 1 else Vt.Vec3fArray).FromNumpy(values)))
        return found

    def _own(self, values: np.ndarray) -> np.ndarray:
        own = values[self._nodes]
        return own if self._weights is None else (self._weights @ own).astype(np.float32)


class ViewTrack:
    """Motion of the camera: `attribute` is the path of its translation, `follow` gives its value in a frame.

    Defines the prims of camera and lights on a stage.
    """

    def __init__(self, stage, scene):
        from pxr import Gf, UsdGeom, UsdLux

        self.camera = Viewpoint.framing(framed_points(scene), PICTURE, up=scene.up)
        self._widest = MAX_WIDENING * self.camera.distance
        UsdGeom.Xform.Define(stage, VIEW)

        camera = UsdGeom.Camera.Define(stage, f"{VIEW}/camera")
        height = SENSOR * PICTURE[1] / PICTURE[0]
        camera.CreateHorizontalApertureAttr(LENS * SENSOR)
        camera.CreateVerticalApertureAttr(LENS * height)
        camera.CreateFocalLengthAttr(LENS * height / 2 / self.camera.slope)
        near, far = self.camera.clipping
        camera.CreateClippingRangeAttr(Gf.Vec2f(near, MAX_WIDENING * far))
        camera.AddTranslateOp().Set(Gf.Vec3d(*self.camera.position.tolist()))
        self.attribute = camera.GetPath().AppendProperty(TRANSLATE)

        lamp = UsdLux.DistantLight.Define(stage, f"{VIEW}/lamp")
        lamp.CreateIntensityAttr(LAMP)
        lamp.CreateNormalizeAttr(True)
        aims = (camera, self.camera.azimuth, self.camera.elevation), (lamp, self.camera.azimuth + LAMP_TURN, LAMP_ELEVATION)
        for prim, azimuth, elevation in aims:  # both look along their -z
            angles = (-elevation, azimuth, 0.0) if scene.up == "y" else (90.0 - elevation, 0.0, azimuth)
            prim.AddRotateXYZOp().Set(Gf.Vec3f(*angles))
        UsdLux.DomeLight.Define(stage, f"{VIEW}/dome").CreateIntensityAttr(DOME)

    def resume(self, position: np.ndarray) -> None:
        """Start from the camera's last position (3,) [m]."""
        self._set_distance(float(np.linalg.norm(position - self.camera.target)))

    def follow(self, x: np.ndarray) -> np.ndarray:
        """Move the camera back until nodes x (n,3) [m] are in view; return its position (3,) [m]."""
        self._set_distance(self.camera.widened(x, PICTURE, self._widest).distance)
        return self.camera.position

    def _set_distance(self, distance: float) -> None:
        """Set the distance [m], rounded so that a resumed run computes the same one from the position that it reads."""
        self.camera = replace(self.camera, distance=float(f"{distance:.12g}"))


def scene_layer(scene, fps: float, touching: bool, errors: bool) -> tuple[list[Track], list, Curves | None, ViewTrack, object]:
    """Build a layer with everything that does not change, and the tracks that get values with the frames.

    touching: whether there can be contacts; errors: whether errors are estimated. Returns the tracks of the bodies, (track,
    surface) of each obstacle, the curves of springs and tendons or None, the camera's track and the layer.
    """
    from pxr import Sdf, Usd, UsdGeom

    import taisoft

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.comment = f"taisoft {taisoft.__version__}"
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, getattr(UsdGeom.Tokens, scene.up))
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    legal = prim_names([one.name for one in (*scene.colliders, *scene.springs, *scene.tendons)])
    tracks, first = [], 0
    for body, name, colour in zip(scene.bodies, legal, body_colours(scene)):
        tracks += _define_body(stage, body, name, colour, first, touching, errors)
        first += body.n_nodes
    view = ViewTrack(stage, scene)
    n_bodies, n_colliders = len(scene.bodies), len(scene.colliders)
    surfaces = [s for s in zip(obstacle_surfaces(scene), legal[n_bodies:n_colliders]) if len(s[0].triangles)]
    obstacles = [(_define_obstacle(stage, surface, name, view.camera.position), surface) for surface, name in surfaces]
    curves = Curves(stage, ROOT, scene, legal[n_colliders:]) if scene.springs or scene.tendons else None
    return tracks, obstacles, curves, view, layer


def _extent(points: np.ndarray) -> np.ndarray:
    """Return the smallest and largest coordinates of points (n,3), (2,3) float32."""
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float32)


def _define_surface(stage, name: str, legal_name: str, srgb: np.ndarray, triangles: np.ndarray):
    """Define the prim of a body or an obstacle with material and surface; return its path, surface and a finishing function.

    The function gives a gprim the colour and the material.
    """
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    path = f"{ROOT}/{legal_name}"
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    prim.SetDisplayName(name)
    prim.SetCustomDataByKey(NAME, name)

    colour = Gf.Vec3f(*linear_rgb(srgb).tolist())
    material = UsdShade.Material.Define(stage, f"{path}/material")
    shader = UsdShade.Shader.Define(stage, f"{path}/material/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.6)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))

    surface = UsdGeom.Mesh.Define(stage, f"{path}/surface")
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, dtype=np.int32)))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.ravel().astype(np.int32)))
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)

    def paint(gprim) -> None:
        gprim.CreateDisplayColorAttr([colour])
        UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)

    return path, surface, paint


def _define_obstacle(stage, shown: ObstacleSurface, legal_name: str, eye: np.ndarray) -> Track:
    """Define an obstacle's surface at its initial pose. eye: position of the camera (3,) [m]."""
    from pxr import UsdGeom, Vt

    shape, x = shown.obstacle.shape, shown.at(0.0)
    _, surface, paint = _define_surface(stage, shown.obstacle.name, legal_name, obstacle_colour(shown.obstacle), shown.triangles)
    points = x.astype(np.float32)
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_extent(points)))
    paint(surface)
    if isinstance(shape, MeshObstacle) and (opposite_half_edges(shown.triangles) < 0).any():
        surface.CreateDoubleSidedAttr(True)
    if isinstance(shape, HalfSpace):
        a, b, c = x[shown.triangles[0]]
        if np.cross(b - a, c - a) @ (eye - a) <= 0.0:
            surface.CreatePurposeAttr(UsdGeom.Tokens.guide)
    return Track(surface)


def _define_body(stage, body, legal_name: str, srgb: np.ndarray, first: int, touching: bool, errors: bool) -> list[Track]:
    """Define a body's surface, tets and primvars. first: index of its first node among the nodes of all bodies."""
    from pxr import Sdf, UsdGeom, Vt

    skin = body.riding_skin
    nodes, local = compact_surface(body.nodes.surface if skin is None else skin.surface.triangles)
    path, surface, paint = _define_surface(stage, body.name, legal_name, srgb, local)
    shown = [surface]
    if not isinstance(body, RigidBody):
        tets = UsdGeom.TetMesh.Define(stage, f"{path}/tets")
        tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(body.nodes.tets, dtype=np.int32)))
        faces = np.ascontiguousarray(body.nodes.boundary, dtype=np.int32)
        tets.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(faces))
        tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
        shown.append(tets)

    def define_primvar(gprim, name: str, kind, meaning: str) -> None:
        primvar = UsdGeom.PrimvarsAPI(gprim).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
        primvar.GetAttr().SetDocumentation(meaning)

    scalars, vectors = Sdf.ValueTypeNames.FloatArray, Sdf.ValueTypeNames.Vector3fArray
    start = (body.rest_positions + body.position).astype(np.float32)  # readers find the rest shape in the default value
    own = start[nodes] if skin is None else (skin.surface.vertices[nodes] + body.position).astype(np.float32)
    for gprim, x in zip(shown, (own, start)):
        gprim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(x)))
        gprim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_extent(x)))
        paint(gprim)
        define_primvar(gprim, STRESS, scalars, "von Mises equivalent of the mean Cauchy stress at the node [Pa]")
        if errors:
            define_primvar(gprim, ERROR, scalars, "estimated error of the node's position [m], 0 where unknown")
    touching = touching and skin is None and body.nodes.embedded is None  # impulses act on the nodes of tets
    if touching:
        define_primvar(surface, IMPULSE, vectors, "impulse of the contacts of the last step on the node [N s]")
    all_nodes = slice(first, first + body.n_nodes)
    primvars = (STRESS, ERROR) if errors else (STRESS,)
    own = (*primvars, IMPULSE) if touching else primvars
    track = Track(surface, first + nodes, own) if skin is None else Track(surface, all_nodes, own, skin.weights[nodes])
    return [track, *(Track(tets, all_nodes, primvars) for tets in shown[1:])]
