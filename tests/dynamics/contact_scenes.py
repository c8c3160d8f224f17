"""A scene for tests of steps with contacts: a cube on a belt, a load on a shelf, two bodies that fly; and its numbers."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import taisoft as ts
from tests.collision.rotations import rotation

SIDE = 0.1  # [m] of the cubes
MASS = 1000.0 * SIDE**3  # [kg] of each
GRAVITY = np.array([0.0, -9.81, 0.0])
FRICTION = 0.5
BELT = np.array([0.0, -0.1, 0.0])  # middle of the belt [m]


def still(t: float) -> tuple[np.ndarray, np.ndarray]:
    """A belt that stands."""
    return np.zeros(3), np.eye(3)


def sliding(speed: float):
    """A belt that runs along x [m/s]."""
    return lambda t: (np.array([speed * t, 0.0, 0.0]), np.eye(3))


def turning(rate: float):
    """A belt that turns about y [rad/s]."""
    return lambda t: (np.zeros(3), rotation((0, 1, 0), rate * t))


@dataclass
class Stage:
    """Where the whole scene is, x -> Q x + T, and how the belt goes: t -> (translation, rotation about its middle)."""

    Q: np.ndarray = field(default_factory=lambda: np.eye(3))
    T: np.ndarray = field(default_factory=lambda: np.zeros(3))
    motion: Callable = still

    def belt(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """The belt's path."""
        shift, turn = self.motion(t)
        return self.Q @ (BELT + shift) + self.T - BELT, self.Q @ turn


def cube(cells: int, seed: int | None = None) -> ts.TetMesh:
    """A cube of that many cells along each side, bottom at y = 0; seed: of the shifts of its vertices."""
    mesh = ts.box_mesh((cells,) * 3, (SIDE,) * 3, (0, 0.5 * SIDE, 0))
    if seed is None:
        return mesh
    return ts.TetMesh(mesh.vertices + np.random.default_rng(seed).uniform(-0.01, 0.01, mesh.vertices.shape), mesh.tets)


def scene(place: Stage) -> ts.Scene:
    """cube on the belt at 0.1 m from its middle; load on shelf, which is held below; left and right, about to meet."""
    made = ts.Scene(gravity=place.Q @ GRAVITY)
    damped = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=FRICTION, mass_damping=4.0)
    free = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=FRICTION)
    gap = 3e-4
    bodies = [
        ("cube", cube(2), damped, (0.1, gap, 0.0), (0, 0, 0)),
        ("shelf", ts.box_mesh((3, 1, 3), (0.3, 0.1, 0.3)), damped, (2.0, -0.05, 0.0), (0, 0, 0)),
        ("load", cube(2), damped, (2.02, gap, 0.01), (0, 0, 0)),
        ("left", cube(1, 1), free, (-4.0, 3.0, 0.0), (1.0, 0.2, 0.0)),
        ("right", cube(1, 2), free, (-3.87, 3.03, 0.02), (-1.0, 0.0, 0.1)),
    ]
    for name, mesh, material, at, v in bodies:
        body = made.add_body(mesh, material, name=name, position=at, velocity=v)
        if name == "shelf":
            body.fix(lambda X: X[:, 1] < -0.04)
    made.add_obstacle(ts.Box(BELT, (0.6, 0.1, 0.6)), name="belt", friction=FRICTION, path=place.belt)
    return made
