"""The camera and the lights of a scene in OpenUSD: `/View`, beside the bodies and outside of the default prim.

Who references the scene gets the bodies alone, and no body's name can meet a light's. The camera is that of the pictures: it
frames the bodies where they start and moves back after them. The lamp shines over the viewer's left shoulder, from where
upright walls along the axes that face the camera cast no shadow into a bin; the dome is grey all round. Intensities suit an
exposure of 1 (a white face square to the lamp comes out near white); the lamp is normalized, since readers that know nothing of
that take its intensity as the irradiance that it is then [W/m^2].
"""

import math
from dataclasses import replace

import numpy as np

from taisoft.output.appearance import start_positions
from taisoft.output.camera import MAX_WIDENING, Camera

VIEW, PLACE = "/View", "xformOp:translate"
PICTURE = (16, 9)  # width and height
SENSOR = 0.036  # width [m], as of a camera for film of 36 mm
LAMP_TURN, LAMP_ELEVATION = -22.0, 54.0  # [deg]: about y from the camera's azimuth, above the horizon
LAMP, DOME = 2.2, 0.4  # a white diffuse face returns LAMP / pi of the one, DOME of the other
LENS = 10.0  # sizes in the lens are told in tenths of the scene's unit


class ViewTrack:
    """The camera's way: `attribute` is the path of its place, `place` the value in a frame. Defines the prims on a stage."""

    def __init__(self, stage, scene):
        from pxr import Gf, UsdGeom, UsdLux

        self.camera = Camera.framing(start_positions(scene), PICTURE)
        self._widest = MAX_WIDENING * self.camera.distance
        UsdGeom.Xform.Define(stage, VIEW)

        camera = UsdGeom.Camera.Define(stage, f"{VIEW}/camera")
        height = SENSOR * PICTURE[1] / PICTURE[0]
        camera.CreateHorizontalApertureAttr(LENS * SENSOR)
        camera.CreateVerticalApertureAttr(LENS * height)
        camera.CreateFocalLengthAttr(LENS * height / 2 / math.tan(math.radians(self.camera.fov) / 2))
        near, far = self.camera.clipping
        camera.CreateClippingRangeAttr(Gf.Vec2f(near, MAX_WIDENING * far))
        camera.AddTranslateOp().Set(Gf.Vec3d(*self.camera.position.tolist()))
        self.attribute = camera.GetPath().AppendProperty(PLACE)
        _turn(camera, self.camera.azimuth, self.camera.elevation)

        lamp = UsdLux.DistantLight.Define(stage, f"{VIEW}/lamp")
        lamp.CreateIntensityAttr(LAMP)
        lamp.CreateNormalizeAttr(True)
        _turn(lamp, self.camera.azimuth + LAMP_TURN, LAMP_ELEVATION)
        UsdLux.DomeLight.Define(stage, f"{VIEW}/dome").CreateIntensityAttr(DOME)

    def go_on(self, place: np.ndarray) -> None:
        """Start from where the camera was last (3,) [m]."""
        self._stand_off(float(np.linalg.norm(place - self.camera.target)))

    def place(self, x: np.ndarray) -> np.ndarray:
        """Where the camera is (3,) [m] once it has moved back after nodes x (n,3) [m]."""
        self._stand_off(self.camera.widened(x, PICTURE, self._widest).distance)
        return self.camera.position

    def _stand_off(self, distance: float) -> None:
        """Rounded, so that a run that goes on finds the same distance from the place that it reads."""
        self.camera = replace(self.camera, distance=float(f"{distance:.12g}"))


def _turn(prim, azimuth: float, elevation: float) -> None:
    """Let what looks or shines along its -z do so from there [deg]."""
    from pxr import Gf

    prim.AddRotateXYZOp().Set(Gf.Vec3f(-elevation, azimuth, 0.0))
