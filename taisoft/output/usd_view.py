"""Camera and lights of a scene in OpenUSD: `/View`, outside of the default prim.

So a reference to the scene gets the bodies alone, and the names of bodies and lights cannot clash. The camera is that of the
pictures: it frames the bodies at the start and moves back to keep them in view. The lamp shines over the viewer's left shoulder;
from there upright walls along the axes that face the camera cast no shadow into a bin. The dome is uniformly grey. Intensities
suit an exposure of 1 (a white face perpendicular to the lamp renders nearly white). The lamp is normalized: readers that ignore
this attribute take the intensity as irradiance [W/m^2], which is then the same.
"""

import math
from dataclasses import replace

import numpy as np

from taisoft.output.appearance import start_positions
from taisoft.output.camera import MAX_WIDENING, Camera

VIEW, TRANSLATE = "/View", "xformOp:translate"
PICTURE = (16, 9)  # width and height
SENSOR = 0.036  # width of the film back [m], as for 36 mm film
LAMP_TURN, LAMP_ELEVATION = -22.0, 54.0  # [deg]: about y from the camera's azimuth, above the horizon
LAMP, DOME = 2.2, 0.4  # a white diffuse face reflects LAMP / pi of the lamp and DOME of the dome
LENS = 10.0  # USD gives aperture and focal length in tenths of the scene's unit


class ViewTrack:
    """Motion of the camera: `attribute` is the path of its translation, `follow` gives its value in a frame.

    Defines the prims of camera and lights on a stage.
    """

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
        self.attribute = camera.GetPath().AppendProperty(TRANSLATE)
        _aim(camera, self.camera.azimuth, self.camera.elevation)

        lamp = UsdLux.DistantLight.Define(stage, f"{VIEW}/lamp")
        lamp.CreateIntensityAttr(LAMP)
        lamp.CreateNormalizeAttr(True)
        _aim(lamp, self.camera.azimuth + LAMP_TURN, LAMP_ELEVATION)
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


def _aim(prim, azimuth: float, elevation: float) -> None:
    """Rotate a prim that looks or shines along its -z so that it does so from azimuth and elevation [deg]."""
    from pxr import Gf

    prim.AddRotateXYZOp().Set(Gf.Vec3f(-elevation, azimuth, 0.0))
