"""A mat and four rods whose ends turn in opposite senses until they are ropes that touch themselves everywhere. No gravity.

The paper turns for 100 s. Here a run ends after five turns of each end, or at the first step after which surfaces cross.
"""

import numpy as np

import taisoft as ts

from .case import FULL, Case
from .falling import SOFT
from .squeezed import WEIGHTLESS

SPEED = 0.4 * np.pi  # of each end [rad/s]
TURNS = 5
SECONDS = TURNS * 2.0 * np.pi / SPEED
HALF = 0.5  # half the length of mat and rods [m]


def twist(body: ts.Body) -> None:
    """Turn the ends of a body at x = -HALF and x = HALF about the x axis, in opposite senses."""
    for sign in (-1.0, 1.0):
        turns = np.array([(0.0, 0.0, 0.0), (sign * SPEED * SECONDS, 0.0, 0.0)])
        path = ts.KeyFrames([0.0, SECONDS], rotations=turns, pivot=(sign * HALF, 0.0, 0.0))
        body.move(lambda x, sign=sign: sign * x[:, 0] > HALF - 1e-6, path)


def twisted_mat(size: str) -> ts.Scene:
    """A mat of side 1 m, 8 mm thick: 150 x 150 x 2 nodes, or in small 20 x 20 x 2 and 13 mm."""
    n, thickness = (150, 0.008) if size == FULL else (20, 0.013)
    scene = ts.Scene(gravity=WEIGHTLESS)
    mesh = ts.sheet_mesh((n - 1, n - 1), (2.0 * HALF, thickness, 2.0 * HALF))
    twist(scene.add_body(mesh, ts.Material(young=2e4, friction=0.0, **SOFT), name="mat"))
    return scene


def twisted_rods(size: str) -> ts.Scene:
    """Four square rods of 1 m x 0.1 m x 0.1 m with gaps of 0.1 m: 13,068 nodes each, or in small 400."""
    cells = (107, 10, 10) if size == FULL else (24, 3, 3)
    scene = ts.Scene(gravity=WEIGHTLESS)
    for y in (-0.1, 0.1):
        for z in (-0.1, 0.1):
            mesh = ts.box_mesh(cells, (2.0 * HALF, 0.1, 0.1), (0.0, y, z))
            twist(scene.add_body(mesh, ts.Material(young=1e4, friction=0.0, **SOFT)))
    return scene


TWISTED = (
    Case("twisted_mat", "twisted mat", twisted_mat, 0.04, SECONDS, 45_000, 776.0, stop_at_crossing=True),
    Case("twisted_rods", "twisted rods", twisted_rods, 0.025, SECONDS, 53_000, 141.5, stop_at_crossing=True),
)
