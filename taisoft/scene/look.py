"""How a scene looks, which changes nothing in a simulation: colours, opacity, lights, and the camera."""

import math

import numpy as np
import scipy

from taisoft.attributes import checked, guarded_record
from taisoft.errors import SceneError, value_text
from taisoft.mesh.placing import FROM_Y_UP, UP
from taisoft.scene import checks

MAX_LIGHTS = 8
MIN_OPACITY = 0.02  # below it nothing would be seen


def colour_of(value, what: str) -> np.ndarray:
    """Return an sRGB colour (3,) in [0, 1], given so or as "#rrggbb". what: start of the message. Raises SceneError."""
    if isinstance(value, str):
        digits = value.removeprefix("#")
        if len(digits) != 6 or len(value) != 7 or not all(digit in "0123456789abcdefABCDEF" for digit in digits):
            raise SceneError(f"{what} must be '#rrggbb', such as '#d94a3d', or three numbers, not {value_text(value)}")
        return np.array([int(digits[k : k + 2], 16) / 255.0 for k in (0, 2, 4)])
    colour = checks.array(value, what, ((3,),))
    if ((colour < 0.0) | (colour > 1.0)).any():
        raise SceneError(f"{what}: red, green and blue must be from 0 to 1, not {value_text(value)}")
    return colour


def colour_or_none(value, what: str) -> np.ndarray | None:
    """Return an sRGB colour as `colour_of`, or None."""
    return None if value is None else colour_of(value, what)


def opacity_of(value, what: str) -> float:
    """Return an opacity: 1 hides what is behind. what: start of the message. Raises SceneError."""
    return checks.number(value, what, minimum=MIN_OPACITY, maximum=1.0)


def background_of(value) -> np.ndarray | None:
    """Return the colours (2,3) at the top and the bottom of pictures, given so or as one for both; None for None."""
    if value is None:
        return None
    two = isinstance(value, (list, tuple, np.ndarray)) and len(value) == 2
    return np.array([colour_of(one, "scene: background") for one in (value if two else (value, value))])


def lights_of(value) -> "tuple[Light, ...] | None":
    """Return lights as a tuple; None for None. Raises SceneError."""
    if value is None:
        return None
    lights = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    for k, one in enumerate(lights):
        if not isinstance(one, Light):
            raise SceneError(f"scene: light {k} must be a Light, not {value_text(one)}")
    if len(lights) > MAX_LIGHTS:
        raise SceneError(f"scene: there are {len(lights)} lights; {MAX_LIGHTS} are the most")
    return lights


def check_follow(camera: "Camera | None", bodies) -> "Camera | None":
    """Return a camera. Raises SceneError if it follows none of the bodies."""
    if camera is not None and camera.follow is not None:
        checks.index(camera.follow, [body.name for body in bodies], "camera: follow: no body")
    return camera


def _depth(value) -> int:
    """Return the number of dimensions of a value that should be an array; 0 if it is none."""
    try:
        return np.ndim(value)
    except ValueError:
        return 0


@guarded_record("light", "make a new Light")
class Light:
    """Light from far away, of a scene's `lights`. Raises SceneError."""

    direction: np.ndarray = checked(checks.direction)  #: (3,) in which it shines, of any length
    strength: float = checked(
        checks.number, 0.7, minimum=0.0, maximum=10.0
    )  #: fraction of its colour that a face perpendicular to it shows
    colour: np.ndarray | str = checked(colour_of, (1.0, 1.0, 1.0))  #: sRGB, (3,) in [0, 1] or "#rrggbb"


@guarded_record("camera", "make a new Camera")
class Camera:
    """From where pictures and films show a scene: `scene.camera`. With times, positions, targets and fields of view are key
    frames, between which the camera turns about its target on a smooth curve. Raises SceneError.
    """

    position: np.ndarray  #: (3,) of the eye [m], or (k,3)
    target: np.ndarray = (0.0, 0.0, 0.0)  #: (3,) [m] in the middle of the picture, or (k,3)
    up: str | None = checked(checks.choice, None, allowed=tuple(UP))  #: axis that points up, "y" or "z"; None: the scene's
    fov: float | np.ndarray = 45.0  #: vertical field of view [deg], or (k,)
    times: np.ndarray | None = None  #: (k,) ascending [s]; before the first and after the last the camera stays
    follow: str | None = checked(checks.text, None)  #: name of a body with whose mean displacement the camera moves along

    def __post_init__(self):
        varying = (self.position, 1), (self.target, 1), (self.fov, 0)
        if self.times is None and any(_depth(value) > least for value, least in varying):
            raise SceneError("camera: key frames of position, target or fov need times [s]")
        times = None if self.times is None else checks.times(self.times, "camera: times")
        k = () if times is None else (len(times),)
        shapes = {"position": {(3,), (*k, 3)}, "target": {(3,), (*k, 3)}, "fov": {(), k}}
        values = {name: checks.array(getattr(self, name), f"camera: {name}", (*sorted(ones),)) for name, ones in shapes.items()}
        if ((values["fov"] < 1.0) | (values["fov"] > 120.0)).any():
            raise SceneError(f"camera: fov must be from 1 to 120 degrees, not {value_text(self.fov)}")
        offsets = np.atleast_2d(values["position"] - values["target"])
        if (equal := ~offsets.any(axis=1)).any():
            at = f" at time {times[int(equal.argmax())]:g} s" if times is not None else ""
            raise SceneError(f"camera: position and target must differ, but are the same{at}")
        fov = values["fov"] if values["fov"].ndim else float(values["fov"])
        checks.store(self, **(values | {"fov": fov, "times": times}))

    def zoom(self, factor: float) -> "Camera":
        """Return the camera with a narrower field of view, so that everything looks this many times as large."""
        factor = checks.number(factor, "camera: zoom", above=0.0)
        fov = 2.0 * np.degrees(np.arctan(np.tan(np.radians(self.fov) / 2.0) / factor))
        return Camera(self.position, self.target, self.up, fov if np.ndim(fov) else float(fov), self.times, self.follow)

    def at(self, t: float, up: str) -> dict:
        """Return target (3,) [m], distance [m], azimuth, elevation and fov [deg], and up at time t [s], but without following.

        up: the scene's. The angles are those of `taisoft.output.viewpoint.Viewpoint`.
        """
        up, k = self.up or up, 1 if self.times is None else len(self.times)
        x, y, z = (np.broadcast_to(self.position - self.target, (k, 3)) @ FROM_Y_UP[up]).T
        level = np.hypot(x, z)
        angles = np.unwrap(np.arctan2(x, z)), np.arctan2(y, level)
        slope = np.broadcast_to(np.log(np.tan(np.radians(self.fov) / 2.0)), k)
        keys = np.column_stack([np.broadcast_to(self.target, (k, 3)), np.log(np.hypot(level, y)), *angles, slope])
        row = keys[0]
        if k > 1:
            row = scipy.interpolate.PchipInterpolator(self.times, keys)(np.clip(t, self.times[0], self.times[-1]))
        angles = {"azimuth": math.degrees(row[4]), "elevation": math.degrees(row[5])}
        fov = 2.0 * math.degrees(math.atan(math.exp(row[6])))
        return {"target": row[:3], "distance": math.exp(row[3]), **angles, "fov": fov, "up": up}
