"""Bodies that fall on knives, on points or on each other, and an arch that stands. Gravity acts, and nothing is driven.

Knives and points of the paper have no volume. Here knives are wedges of 1 mm thickness, and points are the tips of upright
needles: MeshObstacles need a side that is solid. Fixed cubes and planes are obstacles rather than fixed bodies.
"""

import numpy as np

import taisoft as ts

from .case import FULL, Case
from .meshes import ball, hull, joined, mat, needed, placed

SOFT = {"law": "stable_neo_hookean", "poisson": 0.4, "density": 1000.0}
BLADE = 1e-3  # thickness of a knife [m]
GAP = 2e-3  # between bodies and the floor at the start [m]


def mat_on_knives(size: str) -> ts.Scene:
    """A mat of side 1 m falls flat on nine fixed vertical blades, right triangles with sides of 0.83 m; a floor is below.

    In the paper's units, of which 1.2 are 1 m: the blades have their corners at (x, -0.1, z), (x, 0.9, z) and (x, -0.1, z +- 1).
    """
    unit = 1.0 / 1.2
    scene = ts.Scene()
    one = placed(mat(size), 1.2 * unit, (0.0, 0.0, 0.05), np.array([0.5, 1.0, 0.1]) * unit)
    scene.add_body(one, ts.Material(young=2e4, friction=0.0, **SOFT), name="mat")
    blades = [(x, -0.7, 1.0) for x in (0.2, 0.4, 0.6, 0.8)] + [(x, 0.3, -1.0) for x in (0.1, 0.3, 0.5, 0.7, 0.9)]
    surfaces = []
    for x, z, along in blades:
        corners = np.array([(x, -0.1, z), (x, 0.9, z), (x, -0.1, z + along)]) * unit
        aside = np.array([0.5 * BLADE, 0.0, 0.0])
        surfaces.append(hull(np.concatenate([corners - aside, corners + aside])))
    scene.add_obstacle(joined(*surfaces), "knives", friction=0.0)
    scene.add_obstacle(ts.HalfSpace((0.0, -0.01 * unit, 0.0), (0.0, 1.0, 0.0)), "floor", friction=0.0)
    return scene


def needles(n_x: int, n_z: int, apart: float, top: float) -> ts.MeshObstacle:
    """Upright needles, 1 m high and 1 cm wide at their foot; their tips are a grid about the y axis at the height `top` [m].

    apart: distance of neighbours [m].
    """
    foot = 0.005 * np.array([(0.0, -1.0), (0.866, 0.5), (-0.866, 0.5)])
    made = []
    for x in apart * (np.arange(n_x) - 0.5 * (n_x - 1)):
        for z in apart * (np.arange(n_z) - 0.5 * (n_z - 1)):
            base = np.stack([x + foot[:, 0], np.full(3, top - 1.0), z + foot[:, 1]], axis=1)
            made.append(hull(np.concatenate([[(x, top, z)], base])))
    return joined(*made)


def sphere_on_points(size: str) -> ts.Scene:
    """A ball of 1 m falls on the tips of 20 x 21 upright needles, 0.2 m apart.

    The needles are 1 m high and 1 cm wide at their foot: their tips are the paper's points.
    """
    unit = 0.2
    scene = ts.Scene()
    scene.add_body(placed(ball(size), 5.0 * unit), ts.Material(young=1e4, friction=0.0, **SOFT), name="ball")
    scene.add_obstacle(needles(20, 21, unit, -0.6), "points", friction=0.0)
    return scene


def house_of_cards(size: str) -> ts.Scene:
    """Seven leaning cards, which friction alone holds, and two cubes that hit them after 0.7 s and 0.9 s.

    The paper's unit is 0.51 m, so that the scene is 5 m high.
    """
    unit = 5.0 / 9.84
    card = mat("small") if size == FULL else ts.sheet_mesh((8, 8), (1.0, 0.013, 1.0))
    stuff = ts.Material(young=1e8, friction=0.9, **SOFT)
    scene = ts.Scene()
    for k, (x, y, angle) in enumerate(
        [(0.0, 0.0, 60), (0.515, 0.0, -60), (1.03, 0.0, 60), (1.545, 0.0, -60), (0.515, 0.89, 60), (1.03, 0.89, -60)]
    ):
        scene.add_body(placed(card, unit, (0, 0, angle), (x * unit, y * unit, 0.0)), stuff, name=f"card{k}")
    scene.add_body(placed(card, unit * np.array([1.1, 1.0, 1.1]), shift=(0.78 * unit, 0.445 * unit, 0.0)), stuff, name="flat")
    for k, low in enumerate([(0.2, 6.0, -0.2), (0.5, 9.0, -0.3)]):
        cube = ts.box_mesh((1, 1, 1), [0.4 * unit] * 3, (np.array(low) + 0.2) * unit)
        scene.add_body(cube, stuff, name=f"cube{k}")
    lowest = min(body.mesh.vertices[:, 1].min() for body in scene.bodies)
    scene.add_obstacle(ts.HalfSpace((0.0, lowest - 1e-3 * unit, 0.0), (0.0, 1.0, 0.0)), "floor", friction=0.9)
    return scene


def masonry_arch(size: str) -> ts.Scene:
    """An arch of 25 stones that stands on the edges of two fixed cubes; friction alone holds it. Both sizes are the same.

    The paper's unit is 0.24 m. The stones start with gaps: stone k of -12 to 12 is shifted by (0.1 k, -0.1 |k|) units.
    """
    unit = 20.0 / 82.0
    scene = ts.Scene()
    stone = ts.Material(law="corotational", young=2e10, poisson=0.2, density=2300.0, friction=0.5)
    for k in range(-12, 13):
        scene.add_body(placed(needed(f"arch/{k + 13:02d}"), unit, shift=(0.1 * k * unit, -0.1 * abs(k) * unit, 0.0)), stone)
    for name, x in (("left", -36.0), ("right", 36.0)):
        scene.add_obstacle(ts.Box(np.array([x, -6.4, 0.0]) * unit, [5.0 * unit] * 3), name, friction=0.5)
    return scene


FALLING = (
    Case("mat_on_knives", "mat on knives", mat_on_knives, 0.04, 6.0, 3_200, 1.4),
    Case("sphere_on_points", "sphere on points", sphere_on_points, 0.04, 8.0, 7_000, 2.8),
    Case("house_of_cards", "house of cards, hit", house_of_cards, 0.025, 5.0, 6_000, 10.0),
    Case("masonry_arch", "masonry arch", masonry_arch, 0.01, 20.0, 216, 0.05),
)
