"""Bodies squeezed between rollers, through a funnel and by closing planes.

Planes are half-spaces: the paper's squares of side 3 m cross each other, so that what is between them cannot leave. The funnel
has a wall of 5 cm, since an open surface is solid on one side only.
"""

import math
from functools import partial

import numpy as np

import taisoft as ts

from .case import FULL, Case
from .falling import SOFT
from .meshes import ball, bunny, cylinder, mat, placed, revolved

WEIGHTLESS = (0.0, 0.0, 0.0)
ROLLER_SPEED = 0.5 * np.pi  # [rad/s]
PULL_SPEED = 0.5  # [m/s]
CLOSING_SPEED, CLOSED = 1.0, 0.05  # [m/s]; half the least distance of two planes [m]


def roller_and_ball(size: str) -> ts.Scene:
    """A ball of 1 m lies on two pairs of crossed rollers, 2 m long and 0.1 m apart, which turn inwards and draw it in."""
    scene = ts.Scene()
    soft = ts.Material(young=1e4, friction=0.5, **SOFT)
    scene.add_body(placed(ball(size), shift=(0.25, 0.25, 0.25)), soft, name="ball")
    rollers = [  # name, axis, middle, sense of turning about the axis
        ("upper left", 0, (0.5, -0.5, 0.0), 1.0),
        ("upper right", 0, (0.5, -0.5, 0.5), -1.0),
        ("lower left", 2, (0.0, -1.0, 0.5), -1.0),
        ("lower right", 2, (0.5, -1.0, 0.5), 1.0),
    ]
    for name, axis, middle, sense in rollers:
        vertices, triangles = cylinder(2.0, 0.2)
        vertices = np.roll(vertices, axis, axis=1) + middle  # a cyclic permutation keeps the orientation
        end = np.zeros(3)
        end[axis] = sense * ROLLER_SPEED * 10.0
        path = ts.KeyFrames([0.0, 10.0], rotations=[np.zeros(3), end], pivot=middle)
        scene.add_obstacle(ts.MeshObstacle(vertices, triangles), name, friction=0.5, path=path)
    scene.add_obstacle(ts.HalfSpace((0.0, -1.5, 0.0), (0.0, 1.0, 0.0)), "floor", friction=0.0)
    return scene


def funnel(size: str, friction: float = 0.0) -> ts.Scene:
    """An ellipsoid, 1 m long and 0.36 m thick, is pulled at its tip through a static funnel with a neck of 0.2 m.

    It stands for the paper's dolphin. The nodes of the foremost 4 % of its length move at 0.5 m/s along x. With friction the body
    slides all the time.
    """
    scene = ts.Scene(gravity=WEIGHTLESS)
    mesh = placed(ts.ball_mesh(0.5, 20 if size == FULL else 8), (1.0, 0.36, 0.36))
    body = scene.add_body(mesh, ts.Material(young=1e4, friction=friction, **SOFT), name="body")
    last = 32.0
    path = ts.KeyFrames([0.0, last], translations=[np.zeros(3), (PULL_SPEED * last, 0.0, 0.0)])
    body.move(lambda x: x[:, 0] > 0.46, path)
    inner = [(0.3, 0.35), (0.4, 0.3), (0.5, 0.24), (0.6, 0.18), (0.7, 0.13), (0.8, 0.1), (0.95, 0.1), (1.1, 0.1)]
    outer = [(x, radius + 0.05) for x, radius in reversed(inner)]
    scene.add_obstacle(ts.MeshObstacle(*revolved(np.array([*inner, *outer]), 48)), "funnel", friction=friction)
    return scene


def trash_compactor(size: str) -> ts.Scene:
    """A ball, an upright mat and a bunny between six planes that close at 1 m/s from +-1 m to +-5 cm, then open again."""
    scene = ts.Scene(gravity=WEIGHTLESS)
    soft = ts.Material(law="corotational", young=1e4, poisson=0.4, density=1000.0, friction=0.0)
    scene.add_body(placed(ball(size), shift=(-0.48, 0.0, 0.0)), soft, name="ball")
    scene.add_body(placed(mat(size), turn=(0, 0, 90), shift=(0.04, 0.0, 0.0)), soft, name="mat")
    scene.add_body(placed(bunny(size), 0.3, shift=(0.63, 0.0, 0.0)), soft, name="bunny")
    closing = (1.0 - CLOSED) / CLOSING_SPEED
    for axis, letter in enumerate("xyz"):
        for sign in (-1.0, 1.0):
            outward = np.zeros(3)
            outward[axis] = sign
            inward = -outward
            path = ts.KeyFrames([0.0, closing, 2.0 * closing], [np.zeros(3), closing * CLOSING_SPEED * inward, np.zeros(3)])
            scene.add_obstacle(ts.HalfSpace(outward, inward), f"{'-+'[sign > 0]}{letter}", friction=0.0, path=path)
    return scene


SQUEEZED = (
    Case("roller_and_ball", "roller and ball", roller_and_ball, 0.01, 10.0, 7_000, 63.3),
    Case("funnel", "funnel", funnel, 0.04, 32.0, 8_000, 27.9),
    Case("trash_compactor", "trash compactor", trash_compactor, 0.01, 2.5, 15_000, 61.9),
)
ROUGH = Case("rough_funnel", "funnel, mu = 0.2", partial(funnel, friction=0.2), 0.04, 32.0, 8_000, math.nan)
