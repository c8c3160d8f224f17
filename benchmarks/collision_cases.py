"""Configurations of `collision.py`: piles of touching cubes, two cubes, and the report's scenes, from one seed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import taisoft as ts

SEED = 3
SIDE = 3  # cubes along a side of a pile
SHAKEN = 0.1  # random displacement of vertices over the edge, so that no two faces have the same grid
APART = 1e-4  # distance between cubes that do not touch, over the edge
DEEP_PENETRATION = 1e-3  # penetration of a body that lies on another, over the edge
FRAMES, FPS = 60, 60.0

PILES = (2, 3, 4, 6, 8, 11)  # cells n along a cube's edge; a pile has 162 n^3 tets
LARGE_PILE = 18  # about 100,000 surface triangles
CUBES = (2, 3, 5, 7, 9, 11, 15, 20)  # two cubes have 10 n^3 tets; the report has 1,250 and 13,310
SWEPT = (5, 11)
RATIOS = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.2, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0)


@dataclass(frozen=True)
class Setup:
    """A configuration. build: contact geometry -> scene without gravity. motion: (scene, fraction of the film) -> positions of
    all nodes (n,3) [m], None without motion."""

    name: str
    build: Callable[[str], ts.Scene]
    motion: Callable[[ts.Scene, float], np.ndarray] | None = None


def start(scene: ts.Scene) -> np.ndarray:
    """Initial positions of all nodes (n,3) [m]."""
    return np.concatenate([body.rest_positions + body.position for body in scene.bodies])


def _scene() -> tuple[ts.Scene, ts.Material]:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False  # only the search is measured
    return scene, ts.Material(young=1e5, density=1000.0)


def shaken_cube(cells: int) -> ts.TetMesh:
    """A unit cube of 6 n^3 tets with vertices displaced at random within their faces and edges."""
    mesh = ts.box_mesh((cells,) * 3, (1, 1, 1), pattern="six")
    x = mesh.vertices
    free = np.abs(np.abs(x) - 0.5) > 1e-9
    shift = np.random.default_rng(SEED).uniform(-SHAKEN, SHAKEN, x.shape) / cells
    return ts.TetMesh(x + free * shift, mesh.tets)


def pile(cells: int, collision: str) -> ts.Scene:
    """27 cubes at rest: neighbours touch or nearly touch, and each layer is shifted relative to the one below."""
    scene, material = _scene()
    rng, mesh = np.random.default_rng(SEED), shaken_cube(cells)
    gaps = rng.choice([0.0, APART / cells], (3, SIDE))
    shift = rng.uniform(-0.3 / cells, 0.3 / cells, (SIDE, 3)) * (1, 0, 1)
    places = np.arange(SIDE) + np.cumsum(gaps, axis=1)
    for i, j, k in np.ndindex(SIDE, SIDE, SIDE):
        position = np.array([places[0, i], places[1, j], places[2, k]]) + shift[j]
        scene.add_body(mesh, material, name=f"cube {i}{j}{k}", position=position, collision=collision)
    return scene


def two_cubes(cells: int, collision: str) -> ts.Scene:
    """A cube on another, 5 n^3 tets each, slightly penetrating it."""
    scene, material = _scene()
    mesh = ts.box_mesh((cells,) * 3, (1, 1, 1))
    scene.add_body(mesh, material, name="below", collision=collision)
    scene.add_body(mesh, material, name="above", position=(0.1, 1 - DEEP_PENETRATION / cells, 0.05), collision=collision)
    return scene


def turning(scene: ts.Scene, fraction: float) -> np.ndarray:
    """The upper of two cubes moves down by 1 cm and turns by 30 degrees."""
    below, above = (body.rest_positions + body.position for body in scene.bodies)
    angle = np.radians(30.0) * fraction
    c, s = np.cos(angle), np.sin(angle)
    middle = above.mean(axis=0)
    turned = (above - middle) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + middle
    return np.concatenate([below, turned + (0, 0.005 - 0.01 * fraction, 0)])


def sheet_and_cube(collision: str) -> ts.Scene:
    """A sheet of 4 x 0.05 x 4 m with a cube of 1 m on it, 990 tets: demonstration 3 of the report."""
    scene, material = _scene()
    sheet = ts.box_mesh((19, 1, 9), (4, 0.05, 4))
    scene.add_body(sheet, material, name="sheet", collision=collision)
    cube = ts.box_mesh((3, 3, 3), (1, 1, 1))
    scene.add_body(cube, material, name="cube", position=(0.03, 0.525 - 2e-4, 0.05), collision=collision)
    return scene


def sagging(scene: ts.Scene, fraction: float) -> np.ndarray:
    """The sheet, held at both ends, sags by 0.25 m; the cube follows, with its edges 0.2 mm deep."""
    sheet, cube = (body.rest_positions + body.position for body in scene.bodies)
    sag = 0.25 * fraction

    def height(x):
        return -sag * (1 - (x / 2) ** 2)

    edges = height(cube[:, 0].min()), height(cube[:, 0].max())
    down = np.column_stack([np.zeros(len(sheet)), height(sheet[:, 0]), np.zeros(len(sheet))])
    return np.concatenate([sheet + down, cube + (0, max(edges), 0)])


def cubes_on_boxes(cells: tuple, places: tuple, collision: str) -> ts.Scene:
    """Cubes with these cells, each on a box of 16 cells, side by side."""
    scene, material = _scene()
    box, cube = ts.box_mesh((4, 1, 4), (2, 0.5, 2)), ts.box_mesh(cells, (1, 1, 1))
    for k, x in enumerate(places):
        scene.add_body(box, material, name=f"box {k}", position=(x, 0, 0), collision=collision)
    for k, x in enumerate(places):
        scene.add_body(cube, material, name=f"cube {k}", position=(x + 0.03, 0.75 - 2e-4, 0.02), collision=collision)
    return scene


def pile_setup(cells: int) -> Setup:
    """A pile with these cells."""
    return Setup(f"pile {cells}", partial(pile, cells))


def cubes_setup(cells: int) -> Setup:
    """Two cubes with these cells."""
    return Setup(f"cubes {cells}", partial(two_cubes, cells), turning)


SHEET = Setup("sheet and cube", sheet_and_cube, sagging)
REPORT = (  # 990, 215 and 240 tets
    SHEET,
    Setup("cube on box", partial(cubes_on_boxes, (3, 3, 3), (0.0,))),
    Setup("two on two", partial(cubes_on_boxes, (2, 2, 2), (-1.0, 1.0))),
)
