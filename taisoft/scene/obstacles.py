"""Define obstacles: rigid shapes that bodies collide with and that move only along a prescribed path.

A shape is a validated, frozen record with a local frame: x = frame() @ x_local + pivot. Half-space: the local y axis is the
normal, the solid lies at y <= 0. Capsule: the local x axis runs from a to b. Box and sphere: the world's axes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from taisoft.attributes import checked, guarded_record
from taisoft.errors import MeshError, SceneError, reason, reworded, value_text
from taisoft.mesh.shapes import box_mesh
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.topology import normals_and_heights, opposite_half_edges
from taisoft.scene import checks
from taisoft.scene.checks import vector
from taisoft.scene.commands import Command
from taisoft.scene.key_frames import KeyFrames, ShapePath
from taisoft.scene.look import colour_of, opacity_of

DEGENERATE = 1e-9  # a triangle has no area if its smallest height is below this times its longest edge
MAKE_ANOTHER = "make another shape; an obstacle moves by its path"
RIGID_TOLERANCE = 1e-6  # largest allowed entry of R^T R - I for a path's rotation R


@dataclass(frozen=True, eq=False)
class Shape:
    """Base of all shapes. `kind` identifies them where branching on a class is impossible. Arrays are read-only."""

    kind: ClassVar[int]
    word: ClassVar[str]

    @property
    def pivot(self) -> np.ndarray:
        """Center (3,) [m] of a path's rotation and origin of the local frame; by default the shape's center."""
        return self.center

    def frame(self) -> np.ndarray:
        """Return the rotation (3,3) whose columns are the local axes."""
        return np.eye(3)

    def size(self) -> np.ndarray:
        """Return (3,) [m]: (radius, 0, 0) of a sphere, half extents of a box, (half length, radius, 0) of a capsule, else 0."""
        return np.zeros(3)

    def surface(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return vertices (n,3) [m] and outward-oriented triangles (t,3) int64; None for a shape without triangles."""
        return None


@guarded_record("half-space", MAKE_ANOTHER)
class HalfSpace(Shape):
    """All points x with (x - point) . normal <= 0. Raises SceneError for a normal without length."""

    point: np.ndarray = checked(vector)  #: (3,) [m] of its boundary
    normal: np.ndarray = checked(checks.direction)  #: (3,), any length; kept as a unit vector
    kind: ClassVar[int] = 0
    word: ClassVar[str] = "half-space"

    @property
    def pivot(self) -> np.ndarray:
        """The given point (3,) [m]."""
        return self.point

    def frame(self) -> np.ndarray:
        """Return the rotation (3,3) with local y along the normal."""
        return _axes(self.normal, 1)


@guarded_record("sphere", MAKE_ANOTHER)
class Sphere(Shape):
    """A solid sphere. Raises SceneError unless its radius is above 0."""

    center: np.ndarray = checked(vector)  #: (3,) [m]
    radius: float = checked(checks.number, above=0.0, unit="m")  #: [m]
    kind: ClassVar[int] = 1
    word: ClassVar[str] = "sphere"

    def size(self) -> np.ndarray:
        """Return (radius, 0, 0) [m]."""
        return np.array([self.radius, 0.0, 0.0])


@guarded_record("box", MAKE_ANOTHER)
class Box(Shape):
    """An axis-aligned box. Raises SceneError unless its half extents are above 0."""

    center: np.ndarray = checked(vector)  #: (3,) [m]
    half_extents: np.ndarray = checked(vector)  #: (3,) [m]
    kind: ClassVar[int] = 2
    word: ClassVar[str] = "box"

    def __post_init__(self):
        if not (self.half_extents > 0).all():
            raise SceneError(f"box: half_extents must be greater than 0 m, not {self.half_extents.tolist()}")

    def size(self) -> np.ndarray:
        """Return the half extents (3,) [m]."""
        return self.half_extents.copy()

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return 8 vertices and 12 triangles; corner (i,j,k) has index 4 i + 2 j + k."""
        corners, triangles = _unit_box()
        return self.center + self.half_extents * corners, triangles.copy()


@guarded_record("capsule", MAKE_ANOTHER)
class Capsule(Shape):
    """All points within a radius of the segment from a to b. Raises SceneError unless the radius is above 0 and a is not b."""

    a: np.ndarray = checked(vector)  #: (3,) [m]
    b: np.ndarray = checked(vector)  #: (3,) [m]
    radius: float = checked(checks.number, above=0.0, unit="m")  #: [m]
    kind: ClassVar[int] = 3
    word: ClassVar[str] = "capsule"

    def __post_init__(self):
        checks.unit(self.b - self.a, "capsule: a and b must not be the same point (that is a sphere)")

    @property
    def pivot(self) -> np.ndarray:
        """Midpoint (3,) [m] of a and b."""
        return self.a + 0.5 * (self.b - self.a)

    def frame(self) -> np.ndarray:
        """Return the rotation (3,3) with local x from a to b."""
        return _axes(checks.unit(self.b - self.a, "capsule"), 0)

    def size(self) -> np.ndarray:
        """Return (half length of the segment, radius, 0) [m]."""
        return np.array([0.5 * float(np.linalg.norm(self.b - self.a)), self.radius, 0.0])


@guarded_record("mesh obstacle", MAKE_ANOTHER)
class MeshObstacle(Shape):
    """Triangles whose normals point out of the solid; they may be open, and inward normals bound a cavity.

    Raises SceneError for invalid indices, triangles without area, an edge of more than two triangles, and
    inconsistent orientation.
    """

    vertices: np.ndarray  #: (n,3) [m]
    triangles: np.ndarray  #: (t,3) int64
    kind: ClassVar[int] = 4
    word: ClassVar[str] = "mesh obstacle"

    def __post_init__(self):
        with reworded(MeshError, "mesh obstacle: ", raised=SceneError, without="mesh obstacle: "):
            surface = SurfaceMesh(self.vertices, self.triangles, "mesh obstacle")
            vertices, triangles = surface.vertices, surface.triangles
            flat = np.flatnonzero(~(normals_and_heights(vertices, triangles)[1] > DEGENERATE))
            if len(flat):
                raise SceneError(
                    f"mesh obstacle: triangle {flat[0]} {tuple(triangles[flat[0]].tolist())} has no area "
                    f"({len(flat)} such triangles; the smallest height must exceed {DEGENERATE:g} of the longest edge)"
                )
            opposite_half_edges(triangles)
        checks.store(self, vertices=vertices, triangles=triangles, _mean=vertices.mean(axis=0))

    @property
    def pivot(self) -> np.ndarray:
        """Mean vertex (3,) [m]."""
        return self._mean

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of the given arrays."""
        return self.vertices.copy(), self.triangles.copy()


def _axes(direction: np.ndarray, axis: int) -> np.ndarray:
    """Return a rotation (3,3) whose column `axis` is the unit direction; the identity if it is that axis already."""
    second = np.zeros(3)
    second[np.argmin(np.abs(direction))] = 1.0
    second = second - (second @ direction) * direction
    second /= np.linalg.norm(second)
    if axis == 0:
        return np.stack([direction, second, np.cross(direction, second)], axis=1)
    return np.stack([second, direction, np.cross(second, direction)], axis=1)


@cache
def _unit_box() -> tuple[np.ndarray, np.ndarray]:
    """Return corners (8,3) at -1 and 1, and triangles (12,3). Made as a cube, since meshing a flat box would warn."""
    mesh = box_mesh((1, 1, 1), (2.0, 2.0, 2.0), pattern="six")
    return mesh.vertices, mesh.surface


def surface_numbers(friction, restitution, what: str) -> tuple[float, float]:
    """Return validated friction and restitution as floats. what: start of the message. Raises SceneError."""
    friction = checks.number(friction, f"{what}: friction", minimum=0.0)
    return friction, checks.number(restitution, f"{what}: restitution", minimum=0.0, maximum=1.0)


@guarded_record(
    "obstacle", "scene.set_contact sets friction and restitution of a pair, sim.set_contact in a simulation, and a path moves it"
)
class Obstacle:
    """A shape in a scene; made by `Scene.add_obstacle`.

    path: None, `KeyFrames`, or callable t [s] -> (translation (3,) [m], rotation (3,3)), called once here for t = 0. In a
    simulation a command may replace the given_path. Raises SceneError for an invalid shape, values outside the rules, and a path
    with another result.
    """

    shape: Shape
    name: str
    friction: float = checked(checks.number, 0.5, minimum=0.0)  #: Coulomb's coefficient, >= 0
    restitution: float = checked(checks.number, 0.0, minimum=0.0, maximum=1.0)  #: 0 to 1
    path: Callable | None = None
    colour: np.ndarray | None = checked(colour_of, None)  #: sRGB (3,) in pictures, also given as "#rrggbb"; None: grey
    opacity: float = checked(opacity_of, 1.0)  #: 1 hides what is behind
    numbers: ClassVar = ("friction", "restitution")  #: that may change

    def __post_init__(self):
        what = f"obstacle {self.name!r}"
        if not isinstance(self.shape, Shape) or type(self.shape) is Shape:
            raise SceneError(
                f"{what}: shape must be a HalfSpace, Sphere, Box, Capsule or MeshObstacle, not {type(self.shape).__name__}"
            )
        checks.store(self, path=ShapePath(self.path, self.shape.pivot) if isinstance(self.path, KeyFrames) else self.path)
        if self.path is not None and not callable(self.path):
            raise SceneError(f"{what}: path must be a function of time, not {value_text(self.path)}")
        checks.store(self, given_path=self.path, _start=self.pose(0.0))  # a simulation may replace the path

    def rests(self, t: float) -> bool:
        """Return whether it stays where it is from a time t [s] on, unless it is commanded."""
        return self.path is None or (isinstance(self.path, Command) and t >= self.path.end)

    def pose(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return translation (3,) [m] and rotation (3,3) at time t [s]: x -> rotation @ (x - pivot) + pivot + translation.

        Raises SceneError with the obstacle and the time if the path fails or returns no rigid motion.
        """
        if self.path is None:
            return np.zeros(3), np.eye(3)
        what = f"obstacle {self.name!r}: the path"
        try:
            value = self.path(t)
        except Exception as error:
            raise SceneError(f"{what} must give (translation, rotation) and failed at t = {t:g}: {reason(error)}") from error
        return checked_pose(value, t, what)

    def points_at(self, t: float, points: np.ndarray) -> np.ndarray:
        """Return the positions (n,3) [m] at time t [s] of points (n,3) given on the undisplaced shape."""
        translation, rotation = self.pose(t)
        pivot = self.shape.pivot
        return (points - pivot) @ rotation.T + pivot + translation

    def undisplaced(self, points: np.ndarray) -> np.ndarray:
        """Return the points (n,3) [m] of the undisplaced shape that are at these positions at the start."""
        (translation, rotation), pivot = self._start, self.shape.pivot
        return (points - pivot - translation) @ rotation + pivot


def checked_pose(value, t: float, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the translation (3,) and rotation (3,3) that a path gave at t [s]. what: start of messages. Raises SceneError."""
    try:
        translation, rotation = value
    except Exception as error:
        raise SceneError(f"{what} must give (translation, rotation) and failed at t = {t:g}: {reason(error)}") from error
    translation = checks.vector(translation, f"{what}'s translation at t = {t:g}")
    rotation = checks.array(rotation, f"{what}'s rotation at t = {t:g}", ((3, 3),))
    with np.errstate(over="ignore", invalid="ignore"):
        rigid = np.abs(rotation.T @ rotation - np.eye(3)).max() <= RIGID_TOLERANCE and np.linalg.det(rotation) > 0
    if not rigid:
        rule = f"must be orthonormal to {RIGID_TOLERANCE:g} with determinant 1, not {rotation.tolist()}"
        raise SceneError(f"{what}'s rotation at t = {t:g} {rule}")
    return translation, rotation
