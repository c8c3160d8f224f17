"""A scene for tests of steps with contacts: a cube on a belt, a load on a shelf, two bodies that fly; and its numbers.

Tests of implicit steps share its structure, and so its kernels: linear tets of `material`, a half-space, f64.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import taisoft as ts
from tests.collision.rotations import rotation

SIDE = 0.1  # [m] of the cubes
MASS = 1000.0 * SIDE**3  # [kg] of each
GRAVITY = np.array([0.0, -9.81, 0.0])
FRICTION = 0.5


def material(**numbers) -> ts.Material:
    """A soft material with friction and mass damping, which is small by default."""
    return ts.Material(**{"young": 1e5, "poisson": 0.3, "density": 1000.0, "friction": FRICTION, "mass_damping": 0.01, **numbers})


def ground() -> ts.HalfSpace:
    """The half-space below y = 0."""
    return ts.HalfSpace((0, 0, 0), (0, 1, 0))


def still(t: float) -> tuple[np.ndarray, np.ndarray]:
    """A belt at rest."""
    return np.zeros(3), np.eye(3)


def sliding(speed: float):
    """A belt that runs along x [m/s]."""
    return lambda t: (np.array([speed * t, 0.0, 0.0]), np.eye(3))


def turning(rate: float):
    """A belt that turns about y [rad/s]."""
    return lambda t: (np.zeros(3), rotation((0, 1, 0), rate * t))


@dataclass
class Stage:
    """Place of the whole scene, x -> Q x + T, and motion of the belt: t -> (translation, rotation about the origin)."""

    Q: np.ndarray = field(default_factory=lambda: np.eye(3))
    T: np.ndarray = field(default_factory=lambda: np.zeros(3))
    motion: Callable = still

    def belt(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """The belt's path."""
        shift, turn = self.motion(t)
        return self.Q @ shift + self.T, self.Q @ turn


def cube(cells: int, seed: int | None = None) -> ts.TetMesh:
    """A cube of that many cells along each side, bottom at y = 0; seed: of the shifts of its vertices."""
    mesh = ts.box_mesh((cells,) * 3, (SIDE,) * 3, (0, 0.5 * SIDE, 0))
    if seed is None:
        return mesh
    return ts.TetMesh(mesh.vertices + np.random.default_rng(seed).uniform(-0.01, 0.01, mesh.vertices.shape), mesh.tets)


def scene(place: Stage) -> ts.Scene:
    """cube on the belt at 0.1 m from its axis; load on shelf, which is held below; left and right, about to meet."""
    made = ts.Scene(gravity=place.Q @ GRAVITY)
    damped, gap = material(mass_damping=4.0), 3e-4
    bodies = [
        ("cube", cube(2), damped, (0.1, gap, 0.0), (0, 0, 0)),
        ("shelf", ts.box_mesh((3, 1, 3), (0.3, 0.1, 0.3)), damped, (2.0, 0.45, 0.0), (0, 0, 0)),
        ("load", cube(2), damped, (2.02, 0.5 + gap, 0.01), (0, 0, 0)),
        ("left", cube(1, 1), material(mass_damping=0.0), (-4.0, 3.0, 0.0), (1.0, 0.2, 0.0)),
        ("right", cube(1, 2), material(mass_damping=0.0), (-3.87, 3.03, 0.02), (-1.0, 0.0, 0.1)),
    ]
    for name, mesh, rubber, at, v in bodies:
        body = made.add_body(mesh, rubber, name=name, position=at, velocity=v)
        if name == "shelf":
            body.fix(lambda X: X[:, 1] < -0.04)
    made.add_obstacle(ground(), name="belt", friction=FRICTION, path=place.belt)
    return made
