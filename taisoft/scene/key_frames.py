"""Prescribe motion and loads by key frames: translations, rotations or values at given times, as plain numbers.

Between two keys translation is linear and the rotation rate constant: about a common axis by the difference of the angles, so
that full turns count; otherwise by the shortest rotation between the two. Before the first and after the last key the end
value holds.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from taisoft.attributes import guarded_record
from taisoft.errors import SceneError
from taisoft.scene import checks

MAX_ANGLE = 1e6  # [rad], largest entry of a rotation vector; larger angles lose digits
PARALLEL = 1e-12  # sine of the angle between two axes below which they count as the same


@guarded_record("key frames", "make new KeyFrames")
class KeyFrames:
    """A path for `Body.move` and `Scene.add_obstacle`. Calling it with t [s] returns (translation (3,) [m], rotation (3,3)).

    Also one for `Body.add_force` and `add_traction`: the translations are then values in N or Pa, and there is nothing else. For
    loads that are one number, such as a pressure, it has values instead, and `value_at(t)` returns one.
    Points move as x -> rotation @ (x - pivot) + pivot + translation, where x is the start position. Raises SceneError.
    """

    times: np.ndarray  #: (k,) ascending [s]
    translations: np.ndarray | None = None  #: (k,3) [m]; None: none
    rotations: np.ndarray | None = None  #: (k,3) unit axis times angle [rad]; None: none
    pivot: np.ndarray | None = None  #: (3,) [m]; None: the mean of the prescribed nodes, or the pivot of the obstacle's shape
    smooth: bool = False  #: at rest at every key: a fraction s of the time between two keys covers s^2 (3 - 2 s) of the distance
    release: bool = False  #: prescribed nodes are released at the last time
    values: np.ndarray | None = None  #: (k,) of a load that is one number, in its unit; excludes all but times and smooth

    def __post_init__(self):
        what = "key frames"
        times = checks.times(self.times, f"{what}: times")
        if self.values is not None:
            self._check_values(what, times)
            return
        if self.translations is None and self.rotations is None:
            raise SceneError(f"{what}: translations, rotations or values are needed")
        k = len(times)
        validated = {"times": times, "translations": np.zeros((k, 3))}
        for field, shape in (("translations", (k, 3)), ("rotations", (k, 3)), ("pivot", (3,))):
            if getattr(self, field) is not None:
                validated[field] = checks.array(getattr(self, field), f"{what}: {field}", (shape,))
        for field in ("smooth", "release"):
            checks.flag(getattr(self, field), f"{what}: {field}")
        if "rotations" in validated:
            if np.abs(validated["rotations"]).max() > MAX_ANGLE:
                raise SceneError(f"{what}: rotations must be at most {MAX_ANGLE:g} rad about each axis")
            validated["_turns"] = _turns(validated["rotations"])
        checks.store(self, **validated)

    def _check_values(self, what: str, times: np.ndarray) -> None:
        """Check key frames of a load that is one number."""
        if self.release or any(x is not None for x in (self.translations, self.rotations, self.pivot)):
            raise SceneError(f"{what}: values are those of a load, which has no translations, rotations, pivot or release")
        checks.flag(self.smooth, f"{what}: smooth")
        checks.store(self, times=times, values=checks.array(self.values, f"{what}: values", ((len(times),),)))

    def _interval(self, t: float) -> tuple[int, float]:
        """Return the last key at or before t [s], and the fraction of the way to the next one."""
        last = len(self.times) - 1
        i = min(max(int(np.searchsorted(self.times, t, side="right")) - 1, 0), last)
        weight = 0.0
        if i < last and t > self.times[i]:
            weight = (t - self.times[i]) / (self.times[i + 1] - self.times[i])
            weight = weight * weight * (3.0 - 2.0 * weight) if self.smooth else weight
        return i, weight

    def value_at(self, t: float) -> float:
        """Return the value at time t [s], of key frames that have values."""
        i, weight = self._interval(t)
        value = float(self.values[i])
        return value + weight * float(self.values[i + 1] - self.values[i]) if weight > 0.0 else value

    def __call__(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return translation (3,) [m] and rotation (3,3) at time t [s]."""
        i, weight = self._interval(t)
        translation = self.translations[i].copy()
        if weight > 0.0:
            translation += weight * (self.translations[i + 1] - self.translations[i])
        if self.rotations is None:
            return translation, np.eye(3)
        from_rotvec = scipy.spatial.transform.Rotation.from_rotvec
        rotation = from_rotvec(self.rotations[i].copy())  # scipy needs a writable array
        if weight > 0.0:
            rotation = rotation * from_rotvec(weight * self._turns[i])
        return translation, rotation.as_matrix()


AT_REST = KeyFrames((0.0,), translations=((0.0, 0.0, 0.0),))


@dataclass(frozen=True, eq=False)
class NodePath:
    """Key frames as a path for nodes: t [s] -> displacement (3,) or (k,3) [m], or None once the nodes are released."""

    frames: KeyFrames
    starts: np.ndarray  #: (k,3) [m], start positions

    def __post_init__(self):
        _refuse_values(self.frames)

    def __call__(self, t: float) -> np.ndarray | None:
        if self.frames.release and t >= self.frames.times[-1]:
            return None
        translation, rotation = self.frames(t)
        if self.frames.rotations is None:
            return translation
        arms = self.starts - (self.starts.mean(axis=0) if self.frames.pivot is None else self.frames.pivot)
        return arms @ rotation.T - arms + translation


@dataclass(frozen=True, eq=False)
class ShapePath:
    """Key frames as a path for an obstacle: t [s] -> (translation (3,) [m], rotation (3,3) about its shape's pivot)."""

    frames: KeyFrames
    center: np.ndarray  #: (3,) [m], the shape's pivot

    def __post_init__(self):
        _refuse_values(self.frames)
        if self.frames.release:
            raise SceneError("key frames: release is for nodes; an obstacle cannot be released")

    def __call__(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        translation, rotation = self.frames(t)
        if self.frames.pivot is not None:
            arm = self.center - self.frames.pivot
            translation += rotation @ arm - arm
        return translation, rotation


def _refuse_values(frames: KeyFrames) -> None:
    if frames.values is not None:
        raise SceneError("key frames: values are those of a load; a motion needs translations or rotations")


def _turns(rotations: np.ndarray) -> np.ndarray:
    """Return rotation vectors (k-1,3) from each rotation to the next, in the frame of the first. rotations: (k,3)."""
    a, b = rotations[:-1], rotations[1:]
    if not len(a):
        return a.copy()
    from_rotvec = scipy.spatial.transform.Rotation.from_rotvec
    shortest = (from_rotvec(a).inv() * from_rotvec(b)).as_rotvec()
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    parallel = np.linalg.norm(np.cross(a, b), axis=1) <= PARALLEL * lengths  # a zero rotation is parallel to any axis
    return np.where(parallel[:, None], b - a, shortest)
