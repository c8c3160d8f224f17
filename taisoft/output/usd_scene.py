"""OpenUSD layer of a scene without its frames: bodies, obstacles, springs and tendons under `/World`, camera and lights
under `/View`.

Solids are single-sided, half-spaces included, so that a viewer with back-face culling can look into a bin. For viewers without
culling, half-spaces that face away from the camera at the start, and so hide the bodies, have purpose guide, which viewers show
only on request. Open obstacle meshes are double-sided.

`/View` is outside of the default prim. So a reference to the scene gets the bodies alone, and the names of bodies and lights
cannot clash. Camera and lights are those of the scene. Else the camera is that of the pictures: it frames the bodies at the start
and moves back to keep them in view. Else one lamp shines over the viewer's left shoulder; from there upright walls along the axes
that face the camera cast no shadow into a bin. The dome is uniformly white. Intensities suit an exposure of 1 (a white face
perpendicular to the lamp renders nearly white). Lamps are normalized: readers that ignore this attribute take the intensity as
irradiance [W/m^2], which is then the same. Weak: Blender takes four times as much.
"""

import math
from dataclasses import replace

import numpy as np

from taisoft.output.appearance import body_colours, linear_rgb, obstacle_surfaces
from taisoft.output.usd_curves import Curves
from taisoft.output.usd_surface import ROOT, Track, define_body, define_obstacle, prim_names
from taisoft.output.viewpoint import MAX_WIDENING, Viewpoint, camera_viewpoint, framed_points, start_positions
from taisoft.scene.look import Light

VIEW = "/View"
OF_CAMERA = {"xformOp:transform", "focalLength", "clippingRange"}  # its attributes that change
PICTURE = (16, 9)  # width and height
SENSOR = 0.036  # width of the film back [m], as for 36 mm film
HEIGHT = SENSOR * PICTURE[1] / PICTURE[0]  # of the film back [m]
LAMP_TURN, LAMP_ELEVATION = -22.0, 54.0  # [deg]: about up from the camera's azimuth, above the horizon
LAMP, DOME = 2.2, 0.4  # a white diffuse face reflects LAMP / pi of the lamp and DOME of the dome
LENS = 10.0  # USD gives aperture and focal length in tenths of the scene's unit


class ViewTrack:
    """Motion of the camera: `samples` gives the values of its attributes in a frame; `transform` is the path of its transform.

    Defines the prims of camera and lights on a stage.
    """

    def __init__(self, stage, scene):
        from pxr import Gf, UsdGeom, UsdLux

        self._scene, self._camera = scene, Viewpoint.framing(framed_points(scene), PICTURE, up=scene.up)
        self._widest = MAX_WIDENING * self._camera.distance
        UsdGeom.Xform.Define(stage, VIEW)
        camera = UsdGeom.Camera.Define(stage, f"{VIEW}/camera")
        camera.CreateHorizontalApertureAttr(LENS * SENSOR)
        camera.CreateVerticalApertureAttr(LENS * HEIGHT)
        attributes = camera.AddTransformOp().GetAttr(), camera.CreateFocalLengthAttr(), camera.CreateClippingRangeAttr()
        self._paths = [attribute.GetPath() for attribute in attributes]
        self.transform = self._paths[0]
        for attribute, (_, value) in zip(attributes, self.samples(0.0, start_positions(scene))):
            attribute.Set(value)
        lamp = Viewpoint(azimuth=self._camera.azimuth + LAMP_TURN, elevation=LAMP_ELEVATION, up=scene.up)
        lights = (Light(lamp.forward, LAMP / math.pi),) if scene.lights is None else scene.lights
        for name, light in zip(prim_names(["lamp"] * len(lights)), lights):
            prim = UsdLux.DistantLight.Define(stage, f"{VIEW}/{name}")
            prim.CreateIntensityAttr(math.pi * light.strength)
            prim.CreateColorAttr(Gf.Vec3f(*linear_rgb(light.colour).tolist()))
            prim.CreateNormalizeAttr(True)
            turn = Gf.Rotation(Gf.Vec3d(0.0, 0.0, -1.0), Gf.Vec3d(*light.direction.tolist()))  # it shines along its -z
            prim.AddOrientOp().Set(Gf.Quatf(turn.GetQuat()))
        dome = UsdLux.DomeLight.Define(stage, f"{VIEW}/dome")
        dome.CreateIntensityAttr(DOME)
        dome.CreateColorAttr(Gf.Vec3f(1.0))  # without it Blender keeps the dark grey of its world

    @property
    def eye(self) -> np.ndarray:
        """Position of the camera (3,) [m]."""
        return self._camera.position

    def resume(self, transform: np.ndarray) -> None:
        """Start from the camera's last transform (4,4), if that was one of the automatic camera."""
        axes = self._camera.axes
        right, up, back = axes @ (transform[3, :3] - self._camera.target)
        if np.allclose(transform[:3, :3], axes * [[1.0], [1.0], [-1.0]]):
            self._move(self._camera.target + (right, up) @ axes[:2], -back)

    def samples(self, t: float, x: np.ndarray) -> list[tuple]:
        """Return (path, value) of each attribute at time t [s], with nodes at x (n,3) [m].

        The scene's own camera is where it is at that time, another one moves back until it sees the nodes.
        """
        from pxr import Gf

        if self._scene.camera is None:
            moved = self._camera.widened(x, PICTURE, self._widest)
            self._move(moved.target, moved.distance)
        else:
            self._camera = camera_viewpoint(self._scene, t, x)
        right, up, forward = self._camera.axes
        transform = np.eye(4)
        transform[:, :3] = right, up, -forward, self.eye
        lens = LENS * HEIGHT / 2 / self._camera.slope
        return list(zip(self._paths, (Gf.Matrix4d(transform.tolist()), lens, Gf.Vec2f(*self._camera.clipping))))

    def _move(self, target: np.ndarray, distance: float) -> None:
        """Set target and distance [m], rounded so that a resumed run computes the same ones from the position that it reads."""
        unit = 1e-12 * self._widest
        self._camera = replace(self._camera, target=unit * np.round(target / unit), distance=unit * round(distance / unit))


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
    obstacles = [(define_obstacle(stage, surface, name, view.eye), surface) for surface, name in surfaces]
    curves = Curves(stage, ROOT, scene, legal[n_colliders:]) if scene.springs or scene.tendons else None
    return tracks, obstacles, curves, view, layer
