"""A surface with trees, obstacles without triangles and the check of its paths, and random motions for it."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.collision.analytic import AnalyticFrames, build_analytic
from taisoft.collision.bvh import Bvh
from taisoft.collision.candidates import Buffer, entries
from taisoft.collision.near_list import SEARCHED, TO_STATE
from taisoft.collision.path_check import PathCheck
from taisoft.scene.obstacles import Obstacle
from tests.collision.rotations import rotation
from tests.collision.surfaces import place, surface_of

REACH, FLOOR = 0.1, 2e-4  # [m]; ipctk may call a step colliding that comes within some 1e-5 m


class Checked:
    """A surface with trees and the check of its paths."""

    def __init__(self, made, obstacles, capacity):
        self.made, s, arena = made, made.surface, made.arena
        s.node.from_numpy(np.arange(len(made.x), dtype=np.int32))  # a node for each vertex
        self._placed = list(enumerate(obstacles, len(made.soft) - len(obstacles)))
        self.shapes = build_analytic(self._placed, arena)
        self.tree = Bvh(s, made.topology, made.x, made.margin, made.runtime, arena)
        self.row = Buffer("row", entries, s.chunks, None, s.chunks, arena)
        self.state = arena.vectors("state", ti.f64, len(made.x))
        self._made = []
        self.check = self.another(capacity)

    def another(self, capacity: int | None = None) -> PathCheck:
        """Another check of the same surface, with its own lists."""
        made, arena = self.made, FieldArena()
        self._made.append(arena)
        return PathCheck(made.surface, made.topology, self.shapes, made.self_on, True, made.margin, FLOOR, arena, capacity)

    def search(self, x: np.ndarray, move: np.ndarray) -> None:
        """Place vertices (v,3) [m], their displacements [m], and the obstacles from 0 to 1 s."""
        place(self.made, x, move)
        AnalyticFrames(self.shapes, self._placed).place(range(len(self._placed)), 0.0, 1.0)
        self.near = self.tree.near()

    def find(self, state: np.ndarray | None = None, check: PathCheck | None = None):
        """The passages on the searched paths, or on those to a state (v,3) [m]."""
        self.state.from_numpy(self.made.x if state is None else state)
        return (check or self.check).find(self.state, self.near, self.row, SEARCHED if state is None else TO_STATE)

    def release(self) -> None:
        """Free the memory."""
        for part in (self.check, self.row, *self._made):
            part.release()


def obstacle(shape, path=None) -> Obstacle:
    """An obstacle alone."""
    scene = ts.Scene()
    scene.add_obstacle(shape, name="shape", path=path)
    return scene.obstacles[0]


def axis_at(o: Obstacle, s: float) -> np.ndarray:
    """The ends (2,3) of a capsule's axis, both the centre of a sphere, at a part of the straight path from 0 to 1 s [m]."""
    ends = np.stack([o.shape.center] * 2 if isinstance(o.shape, ts.Sphere) else [o.shape.a, o.shape.b])
    return (1.0 - s) * o.points_at(0.0, ends) + s * o.points_at(1.0, ends)


@contextmanager
def checked(parts, obstacles=None, capacity: int | None = None) -> Iterator[Checked]:
    """Soft surfaces, each checked against itself too on all threads, and obstacles without triangles, if only a distant one."""
    obstacles = obstacles or [obstacle(ts.Sphere((0.0, 1e3, 0.0), 0.1))]
    soft = np.arange(len(parts) + len(obstacles)) < len(parts)
    nothing = [(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)) for _ in obstacles]
    with surface_of([*parts, *nothing], soft=soft, self_on=soft, margin=REACH, serial=False) as made:
        one = Checked(made, obstacles, capacity)
        yield one
        one.release()


def waves(x: np.ndarray, rng: np.random.Generator, size: float) -> np.ndarray:
    """Smooth random displacements (n,3) up to about a size [m]."""
    k, phase = rng.uniform(-6.0, 6.0, (3, 3)), rng.uniform(0.0, 6.3, 3)
    return size * np.sin(x @ k + phase) @ rng.standard_normal((3, 3)) / 2.0


def turned(x: np.ndarray, rng: np.random.Generator, angle: float) -> np.ndarray:
    """Points turned about their centre by up to an angle [rad]."""
    middle = x.mean(axis=0)
    return (x - middle) @ rotation(rng.standard_normal(3), rng.uniform(0.0, angle)).T + middle
