"""A surface with trees, obstacles without triangles and the check of its paths, and random motions for it."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.collision.analytic import NO_SHAPES, build_analytic, place_analytic
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

    def __init__(self, made, obstacles, capacity, k_dop):
        self.made, s, arena = made, made.surface, made.arena
        s.node.from_numpy(np.arange(len(made.x), dtype=np.int32))  # a node for each vertex
        first = len(made.soft) - len(obstacles)
        self._placed = [(first + k, o) for k, o in enumerate(obstacles)]
        self.shapes = build_analytic(self._placed, arena) if obstacles else NO_SHAPES
        has_pairs = first > 1 or made.self_on.any()
        self.tree = Bvh(s, made.topology, made.x, made.margin, made.runtime, arena, k_dop) if has_pairs else None
        self.row = Buffer("row", entries, s.chunks, None, s.chunks, arena)
        self.state = arena.vectors("state", ti.f64, len(made.x))
        self._arenas = []
        self.check = self.another(capacity)

    def another(self, capacity: int | None = None) -> PathCheck:
        """Another check of the same surface, with its own lists."""
        made, arena = self.made, FieldArena()
        self._arenas.append(arena)
        self_on, has_pairs = made.self_on, self.tree is not None
        return PathCheck(made.surface, made.topology, self.shapes, self_on, has_pairs, made.margin, FLOOR, arena, capacity)

    def search(self, x: np.ndarray, move: np.ndarray, time: float = 0.0, dt: float = 1.0) -> None:
        """Place vertices (v,3) [m], their displacements [m], and the obstacles."""
        place(self.made, x, move)
        if self._placed:
            place_analytic(self.shapes, self._placed, time, dt)
        self.near = None if self.tree is None else self.tree.near()

    def find(self, state: np.ndarray | None = None, check: PathCheck | None = None):
        """The passages on the searched paths, or on those to a state (v,3) [m]."""
        self.state.from_numpy(self.made.x if state is None else state)
        row, mode = None if self.near is None else self.row, SEARCHED if state is None else TO_STATE
        return (check or self.check).find(self.state, self.near, row, mode)

    def release(self) -> None:
        """Free the memory."""
        for part in (self.check, self.row, *self._arenas):
            part.release()


@contextmanager
def checked(
    parts,
    obstacles=(),
    reach: float = REACH,
    capacity: int | None = None,
    self_on: bool = True,
    k_dop: int = 6,
    serial: bool = True,
) -> Iterator[Checked]:
    """Soft surfaces, each checked against itself too, and obstacles without triangles."""
    soft = np.arange(len(parts) + len(obstacles)) < len(parts)
    nothing = [(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)) for _ in obstacles]
    with surface_of([*parts, *nothing], soft=soft, self_on=soft & self_on, margin=reach, serial=serial) as made:
        one = Checked(made, obstacles, capacity, k_dop)
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


def obstacle(shape, path=None) -> Obstacle:
    """An obstacle alone."""
    scene = ts.Scene()
    scene.add_obstacle(shape, name="shape", path=path)
    return scene.obstacles[0]
