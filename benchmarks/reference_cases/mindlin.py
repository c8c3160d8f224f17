"""Balls that are pressed together and pushed across: within c = a (1 - Q / (mu P))^(1/3) they stick.

For two like balls, in which tangential forces do not change the pressure. Nor do they between an incompressible ball and a rigid
plane, where no meshes meet. Within c the friction is mu p - mu p_0 (c / a) sqrt(1 - r^2 / c^2), outside mu p: what is left of
mu p is a pressure of Hertz's form, whose reach gives c, as that of p gives a. Source: Cattaneo 1938, Mindlin 1949.
"""

from functools import partial

import numpy as np

import taisoft as ts

from .pressing import AWAY, graded, half_ball, reach, solved
from .record import Case, near

FRICTION, DOWN, ACROSS = 0.3, 0.015, {False: 0.006, True: 0.0046}  # paths [m] of a ball of radius 1 m; of like balls both move
STEPS = 4  # load steps each way


def scene(n: int, order: int, like: bool) -> ts.Scene:
    """Half of half a ball on another one, or on a plane; at t = 1 s pressed, then pushed along x."""
    made = ts.Scene(gravity=(0, 0, 0))
    soft = ts.Material(young=1e6, poisson=0.3 if like else 0.49, friction=FRICTION)
    for name, up in (("upper", 1.0), ("lower", -1.0))[: 1 + like]:
        curve = ts.Sphere((0.0, up, 0.0), 1.0) if order == 2 else None
        ball = made.add_body(half_ball(n, up > 0.0), soft, name=name, order=order, curve=curve)
        ball.fix(lambda X: np.abs(X[:, 2]) < 1e-9, axes="z")
        path = lambda t, up=up: (up * ACROSS[like] * max(0.0, t - 1.0), -up * DOWN * min(t, 1.0), 0.0)  # noqa: E731
        ball.move(lambda X, up=up: up * X[:, 1] > AWAY, path, axes="xy")
    if not like:
        made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="lower", friction=FRICTION)
    return made


def mindlin(n: int, order: int, like: bool, precision: str, limits: dict, _reference: dict, arch: str):
    """The sticking zone by the states of nodes and by the friction, after each load step across."""
    made = scene(n, order, like)
    found, check = solved(made, arch, time=2.0, steps=2 * STEPS, precision=precision)
    yield check
    X, width = made.body("upper").rest_positions, graded(n)
    for step in range(STEPS, 2 * STEPS):
        p = found.contact_pressure("upper", step=step)
        r, force = np.hypot(X[p.index, 0], X[p.index, 2]), p.force
        friction, a = np.hypot(force[:, 0], force[:, 2]), reach(force[:, 1], r)
        share = np.linalg.norm(force[:, 0].sum()) / (FRICTION * force[:, 1].sum())
        c, what = a * np.cbrt(1.0 - share), f"Q = {share:.2f} mu P: "
        element = np.interp(c, 0.5 * (width[1:] + width[:-1]), np.diff(width))
        sticks = np.sqrt(2.0 * p.area[p.state == "stick"].sum() / np.pi)
        yield near(what + "sticking zone by states, in elements", sticks / element, c / element, limits["states"], scale=1.0)
        by_friction = reach(FRICTION * force[:, 1] - friction, r)
        yield near(what + "sticking zone by friction [m]", by_friction, c, limits["friction"])


CASES = tuple(
    Case(
        "cattaneo_mindlin",
        "SNH",
        f"{'like balls' if like else 'on a plane'}, n = {n}, order {order}, {precision}",
        partial(mindlin, n, order, like, precision, limits),
        fine=True,
        closed_form=True,
        precision=precision,
    )
    for n, order, like, precision, limits in (
        (12, 1, False, "f64", {"states": 0.5, "friction": 0.03}),
        (12, 1, False, "f32", {"states": 0.5, "friction": 0.03}),
        (8, 2, False, "f64", {"states": 0.6, "friction": 0.06}),
        (10, 1, True, "f64", {"states": 0.8, "friction": 0.05}),
        (10, 1, True, "f32", {"states": 0.8, "friction": 0.05}),
    )
)
