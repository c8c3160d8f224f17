"""Functions that move obstacles, bodies and nodes depend on time alone: another value at a time that a step used is refused."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.prescribed_paths import PrescribedPaths
from tests.dynamics.scenes import cube, rubber

DT, END = 0.1, 0.25  # [s]
PATHS = [  # height at t with past commands, one a step; whether it is refused
    (lambda t, past: np.interp(t, DT * np.arange(len(past)), past), False),
    (lambda t, past: None if t > END else np.sin(t), False),
    (lambda t, past: 1 / (t < END), False),  # the step that uses the value refuses it
    (lambda t, past: past[-1], True),
    (lambda t, past: np.random.random(), True),
    (lambda t, past: None if past[-1] > 2 else 0.0, True),
]


@pytest.mark.parametrize("moves", ["obstacle 'it'", "body 'it': moved nodes", "rigid"])
@pytest.mark.parametrize("height, refused", PATHS)
def test_only_functions_of_time_alone_are_paths(moves, height, refused):
    past, scene = [0.0], ts.Scene()

    def pose(t):
        return None if (y := height(t, past)) is None else ((0.0, y, 0.0), np.eye(3))

    if moves == "rigid":
        scene.add_rigid_body(cube(), name="it").move(pose)
    elif moves == "obstacle 'it'":
        scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="it", path=lambda t: pose(t) or 1 / 0)
    else:
        scene.add_body(cube(), rubber(), name="it").move([3, 1], lambda t: pose(t) and pose(t)[0])
    paths, found = PrescribedPaths(scene), ""
    for k in range(5):
        paths.remember(DT * k * (1 + 1e-15))
        past.append(float(k))
        try:
            paths.check()
        except ts.SimulationError as error:
            found = str(error)
    is_error = moves == "obstacle 'it'" and height is PATHS[-1][0]  # obstacles have no end
    assert bool(found) == (refused and not is_error) and found[: 0 if moves == "rigid" else len(moves)] in moves
