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

import math
from dataclasses import replace

import numpy as np

from taisoft.mesh.placing import FROM_Y_UP
from taisoft.output.appearance import body_colours, linear_rgb, obstacle_surfaces
from taisoft.output.usd_curves import Curves
from taisoft.output.usd_surface import ROOT, Track, define_body, define_obstacle, prim_names
from taisoft.output.viewpoint import MAX_WIDENING, Viewpoint, camera_viewpoint, framed_points, start_positions

VIEW = "/View"
TRANSLATE, TRANSFORM, FOCAL, CLIPPING = "xformOp:translate", "xformOp:transform", "focalLength", "clippingRange"  # of the camera
PICTURE = (16, 9)  # width and height
SENSOR = 0.036  # width of the film back [m], as for 36 mm film
HEIGHT = SENSOR * PICTURE[1] / PICTURE[0]  # of the film back [m]
LAMP_TURN, LAMP_ELEVATION = -22.0, 54.0  # [deg]: about up from the camera's azimuth, above the horizon
LAMP, DOME = 2.2, 0.4  # a white diffuse face reflects LAMP / pi of the lamp and DOME of the dome
LENS = 10.0  # USD gives aperture and focal length in tenths of the scene's unit


class ViewTrack:
    """Motion of the camera: `attribute` is the path of its translation or transform, `samples` gives its values in a frame.

    Defines the prims of camera and lights on a stage. The scene's own camera has a transform, a focal length and clipping planes
    in each frame, the other one only a translation.
    """

    def __init__(self, stage, scene):
        from pxr import Gf, UsdGeom, UsdLux

        x = start_positions(scene)
        self._scene, own = scene, camera_viewpoint(scene, 0.0, x)
        self.camera = own or Viewpoint.framing(framed_points(scene), PICTURE, up=scene.up)
        self._widest = MAX_WIDENING * self.camera.distance
        UsdGeom.Xform.Define(stage, VIEW)
        camera = UsdGeom.Camera.Define(stage, f"{VIEW}/camera")
        camera.CreateHorizontalApertureAttr(LENS * SENSOR)
        camera.CreateVerticalApertureAttr(LENS * HEIGHT)
        camera.CreateFocalLengthAttr(LENS * HEIGHT / 2 / self.camera.slope)
        near, far = self.camera.clipping
        camera.CreateClippingRangeAttr(Gf.Vec2f(near, MAX_WIDENING * far))
        self._path = camera.GetPath()
        self.attribute = self._path.AppendProperty(TRANSFORM if own else TRANSLATE)
        aims = [] if own else [(camera, self.camera.azimuth, self.camera.elevation)]
        (camera.AddTransformOp if own else camera.AddTranslateOp)()
        for path, value in self.samples(0.0, x):
            stage.GetAttributeAtPath(path).Set(value)
        for name, azimuth, elevation, intensity, colour in self._lamps():
            lamp = UsdLux.DistantLight.Define(stage, f"{VIEW}/{name}")
            lamp.CreateIntensityAttr(intensity)
            lamp.CreateColorAttr(Gf.Vec3f(*linear_rgb(colour).tolist()))
            lamp.CreateNormalizeAttr(True)
            aims.append((lamp, azimuth, elevation))
        for prim, azimuth, elevation in aims:  # all look along their -z
            angles = (-elevation, azimuth, 0.0) if scene.up == "y" else (90.0 - elevation, 0.0, azimuth)
            prim.AddRotateXYZOp().Set(Gf.Vec3f(*angles))
        dome = UsdLux.DomeLight.Define(stage, f"{VIEW}/dome")
        dome.CreateIntensityAttr(DOME)
        dome.CreateColorAttr(Gf.Vec3f(1.0))  # without it Blender keeps the dark grey of its world

    def _lamps(self) -> list[tuple[str, float, float, float, np.ndarray]]:
        """Return name, azimuth and elevation [deg], intensity and sRGB colour of each lamp."""
        if self._scene.lights is None:
            return [("lamp", self.camera.azimuth + LAMP_TURN, LAMP_ELEVATION, LAMP, np.ones(3))]
        found = []
        for k, light in enumerate(self._scene.lights):
            x, y, z = -light.direction @ FROM_Y_UP[self._scene.up]
            angles = math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, math.hypot(x, z)))
            found.append((f"light_{k}", *angles, math.pi * light.strength, light.colour))
        return found

    def resume(self, value: np.ndarray) -> None:
        """Start from the last value of `attribute`: the position (3,) [m] of a camera that steps back."""
        if self._scene.camera is None:
            self._set_distance(float(np.linalg.norm(value - self.camera.target)))

    def samples(self, t: float, x: np.ndarray) -> list[tuple]:
        """Return (path, value) of each attribute at time t [s], with nodes at x (n,3) [m]; a camera moves back to see them."""
        from pxr import Gf

        if self._scene.camera is None:
            self._set_distance(self.camera.widened(x, PICTURE, self._widest).distance)
            return [(self.attribute, Gf.Vec3d(*self.camera.position.tolist()))]
        self.camera = camera_viewpoint(self._scene, t, x)
        right, up, forward = self.camera.axes
        transform = np.eye(4)
        transform[:, :3] = right, up, -forward, self.camera.position
        values = Gf.Matrix4d(transform.tolist()), LENS * HEIGHT / 2 / self.camera.slope, Gf.Vec2f(*self.camera.clipping)
        return [(self._path.AppendProperty(name), value) for name, value in zip((TRANSFORM, FOCAL, CLIPPING), values)]

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
        tracks += define_body(stage, body, name, colour, first, touching, errors)
        first += body.n_nodes
    view = ViewTrack(stage, scene)
    n_bodies, n_colliders = len(scene.bodies), len(scene.colliders)
    surfaces = [s for s in zip(obstacle_surfaces(scene), legal[n_bodies:n_colliders]) if len(s[0].triangles)]
    obstacles = [(define_obstacle(stage, surface, name, view.camera.position), surface) for surface, name in surfaces]
    curves = Curves(stage, ROOT, scene, legal[n_colliders:]) if scene.springs or scene.tendons else None
    return tracks, obstacles, curves, view, layer
