"""Functions that move obstacles, bodies and nodes must depend on time alone: another value at a time that a step has used is refused."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.prescribed_paths import PrescribedPaths
from taisoft.errors import SimulationError
from tests.dynamics.scenes import cube, rubber

DT = 0.1  # [s]


def by_table(t, past):
    return np.interp(t, DT * np.arange(len(past)), past)


@pytest.mark.parametrize(
    "path, refused",
    [
        (lambda t, past: np.sin(t), False),
        (by_table, False),
        (lambda t, past: None if t > 2.5 * DT else 0.0, False),
        (lambda t, past: 1 / (t < 2.5 * DT), False),  # the step that uses the value refuses it
        (lambda t, past: past[-1], True),
        (lambda t, past: None if past[-1] > 2 else 0.0, "where it may end"),
        (lambda t, past: np.random.random(), True),
    ],
)
@pytest.mark.parametrize("moves", ["obstacle 'it'", "body 'it': moved nodes", "rigid body"])
def test_only_functions_of_time_alone_are_paths(moves, path, refused):
    """past: commands, one a step."""
    past, scene = [0.0], ts.Scene()

    def pose(t):
        return None if (x := path(t, past)) is None else ((x, 0.0, 0.0), np.eye(3))

    if moves == "rigid body":
        scene.add_rigid_body(cube(), name="it").move(pose)
    elif moves.startswith("body"):
        scene.add_body(cube(), rubber(), name="it").move([3, 1], lambda t: pose(t) and pose(t)[0])
    else:
        scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="it", path=pose)
    paths, found = PrescribedPaths(scene), ""
    paths.remember(0.0)
    for k in range(5):
        past.append(float(k))
        try:
            paths.check()
        except SimulationError as error:
            found = str(error)
        paths.remember(DT * (k + 1) * (1 + 1e-15))
    assert bool(found) == (refused is True or (refused and not moves.startswith("obstacle")))
    name = "body 'it': moved nodes" if moves == "rigid body" else moves
    assert not found or found.startswith(f"{name}: the path gives another value at t = ")
