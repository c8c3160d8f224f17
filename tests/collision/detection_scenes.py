"""Scenes for tests of the whole detection: bodies and obstacles of all kinds in light touch, and how two lists are compared."""

from dataclasses import dataclass, fields, replace

import numpy as np

import taisoft as ts
from taisoft.collision.contacts import Contacts
from tests.collision.rotations import rotation

SOFT = {"young": 1e3}
S = np.sqrt(0.5)
DT = 1e-3  # [s]


def simulator(scene: ts.Scene, precision: str = "f64", **settings) -> ts.Simulator:
    """A simulator for looking at a scene: hardly a step is taken, and the explicit integrator is built fastest."""
    return ts.Simulator(scene, dt=DT, integrator="symplectic_euler", precision=precision, allow_unstable=True, **settings)


@dataclass
class Place:
    """Where a whole scene is: x -> Q x + T; paths of obstacles read it."""

    Q: np.ndarray
    T: np.ndarray

    def path(self, pivot: np.ndarray):
        """An obstacle's path that takes it there."""
        return lambda t: (self.Q @ pivot + self.T - pivot, self.Q)


def shifted(shape, by: np.ndarray):
    """An obstacle's shape, moved (3,) [m]."""
    if isinstance(shape, ts.MeshObstacle):
        return ts.MeshObstacle(shape.vertices + by, shape.triangles)
    places = {field.name for field in fields(shape)} & {"point", "center", "a", "b"}
    return replace(shape, **{name: getattr(shape, name) + by for name in places})


def zoo(scale: float = 1.0) -> tuple[ts.Scene, Place]:
    """Four bodies and five obstacles about 1 m in size, times scale, with contacts of every kind between them.

    block (hit by proximity) on a half-space; ball (by its field) and brick (order 2, an edge across one of the block's) on it;
    egg (by its field) on the ball; a sphere in a face of the block, a capsule in one of the brick, a box and a mesh at balls.
    """
    rng = np.random.default_rng(4)
    place = Place(np.eye(3), np.zeros(3))
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.collision = ts.CollisionSettings(margin=0.02 * scale)
    scene.allow_initial_overlap = True
    axes = np.array([[S, -S, 0.0], [0.5, 0.5, -S], [0.5, 0.5, S]]).T @ rotation((1, 2, 3), 0.05)
    half = np.array([0.25, 0.2, 0.3])
    brick = np.array([0.5, 0.3, 0.2]) - 0.008 * np.array([S, S, 0]) - axes @ (0.05, -half[1], -half[2])
    ball = np.array([-0.15, 0.67, 0.1])
    egg = ball + 0.66 * np.array([-0.2, 0.9, 0.3]) / np.linalg.norm([-0.2, 0.9, 0.3])
    bodies = [
        ("block", ts.box_mesh((2, 1, 2), (1.0, 0.6, 1.0)), np.eye(3), np.zeros(3), 1, "proximity"),
        ("ball", ts.ball_mesh(0.4, 4), np.eye(3), ball, 1, "distance_field"),
        ("brick", ts.box_mesh((1, 1, 1), 2 * half), axes, brick, 2, "proximity"),
        ("egg", ts.ball_mesh(0.3, 4), np.eye(3), egg, 1, "distance_field"),
    ]
    for name, mesh, turn, at, order, collision in bodies:
        vertices = mesh.vertices + rng.uniform(-0.004, 0.004, mesh.vertices.shape)  # so that nothing is symmetric
        mesh = ts.TetMesh(scale * (vertices @ turn.T + at), mesh.tets)
        scene.add_body(mesh, ts.Material(young=SOFT["young"] * scale**2), name=name, order=order, collision=collision)
    side = brick + axes @ (0.1, 0.05, half[2] + 0.1 - 0.012)
    way = 0.3 * axes @ (0.3, 1.0, 0.05)
    corners = [(-0.4, -0.4, 0.0), (0.4, -0.4, 0.02), (0.4, 0.4, -0.01), (-0.4, 0.4, 0.0), (0.03, 0.02, 0.0)]
    sheet = np.array(corners) + egg + (0.0, 0.0, 0.3 - 0.02)
    shapes = {
        "ground": ts.HalfSpace(scale * np.array([0.0, -0.295, 0.0]), (0.01, 1.0, 0.02)),
        "sphere": ts.Sphere(scale * np.array([-0.69, 0.03, 0.2]), 0.2 * scale),
        "capsule": ts.Capsule(scale * (side - way), scale * (side + way), 0.1 * scale),
        "box": ts.Box(scale * (ball - (0.58, 0.0, 0.0)), scale * np.array([0.2, 0.25, 0.3])),
        "sheet": ts.MeshObstacle(scale * sheet, [(0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0)]),
    }
    for name, shape in shapes.items():
        scene.add_obstacle(shape, name=name, path=place.path(shape.pivot))
    return scene, place


def keys(c: Contacts) -> list[tuple]:
    """What tells the contacts of a list apart."""
    return [(a, b, kind, *ids) for a, b, kind, ids in zip(c.body_a, c.body_b, c.kind, c.feature.tolist())]


def compare(c: Contacts, other: Contacts, Q=None, T=0.0, scale: float = 1.0, size: float = 1.0, close: float = 1e-9) -> None:
    """Check that `other` is the list c, turned, scaled and shifted: features alike, numbers to `close` of a size [m]."""
    Q = np.eye(3) if Q is None else Q
    mine, theirs = keys(c), keys(other)
    assert set(mine) == set(theirs), f"lost {set(mine) - set(theirs)}, new {set(theirs) - set(mine)}"
    assert len(mine) == len(set(mine)) == len(theirs)
    order = [theirs.index(key) for key in mine]
    assert np.abs(other.point[order] - (scale * c.point @ Q.T + T)).max() <= close * size
    assert np.abs(other.normal[order] - c.normal @ Q.T).max() <= close
    assert np.abs(other.gap[order] - scale * c.gap).max() <= close * size
    assert np.array_equal(other.nodes[order], c.nodes) and np.abs(other.weights[order] - c.weights).max() <= close


def identical(c: Contacts, other: Contacts) -> bool:
    """Whether two lists agree to the last bit, in their order too."""
    names = ("point", "normal", "gap", "nodes", "weights", "body_a", "body_b", "kind", "feature")
    return all(np.array_equal(getattr(c, name), getattr(other, name)) for name in names)


def sheets() -> ts.Scene:
    """Bodies for self-collision, apart: a sheet of 2 m, its thickness below the margin; a thinner plate; a cube; a thin strip."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.collision = ts.CollisionSettings(margin=0.03)
    meshes = {
        "sheet": ts.sheet_mesh((16, 4), (2.0, 0.02, 1.0)),
        "plate": ts.sheet_mesh((5, 5), (1.0, 0.004, 1.0), pattern="six"),
        "cube": ts.box_mesh((3, 3, 3), (1.0, 1.0, 1.0)),
        "strip": ts.sheet_mesh((16, 2), (1.6, 0.005, 0.4)),
    }
    for k, (name, mesh) in enumerate(meshes.items()):
        scene.add_body(mesh, ts.Material(**SOFT), name=name, position=(0, 3.0 * k, 0))
    return scene


def folded(x: np.ndarray, gap: float, radius: float = 0.1, half: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """A sheet's nodes (n,3) [m] bent back over itself from x = 0 on, in an arc and then straight down, so that only its end comes
    near the rest, to a gap [m]. Returns them and a mask (n,) of those beyond the arc. half: of the thickness [m]."""

    def bent(angle: float) -> tuple[np.ndarray, np.ndarray]:
        turn = np.clip(x[:, 0] / radius, 0.0, np.pi + angle)
        beyond = np.maximum(x[:, 0] - radius * (np.pi + angle), 0.0)
        centre = np.stack([np.minimum(x[:, 0], 0.0) + radius * np.sin(turn), radius - radius * np.cos(turn)], axis=1)
        centre += beyond[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        placed = x.copy()
        placed[:, :2] = centre + x[:, 1:2] * np.stack([-np.sin(turn), np.cos(turn)], axis=1)
        return placed, beyond > 0

    low, high = 0.0, 0.8
    for _ in range(60):
        middle = 0.5 * (low + high)
        placed, beyond = bent(middle)
        low, high = (middle, high) if placed[beyond, 1].min() - half > gap else (low, middle)
    return bent(high)
