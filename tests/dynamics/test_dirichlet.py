"""Dirichlet conditions of linear and quadratic bodies:

* fixed and prescribed axes are constrained, those of a released group are not; a reset prescribes it again;
* targets are the rest positions plus the path's displacement, one for all nodes or one for each;
* targets end before the first release; the next call, at that time, releases the group and continues;
* a step that ends with a path follows it to there, its accelerations too;
* paths that fail or give invalid values are refused with the body's name and the time.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.dirichlet import DirichletConditions
from tests.dynamics.scenes import cube, element, rubber

both_orders = pytest.mark.parametrize("order, n", [(1, 8), (2, 26)])  # of the second body, and its number of nodes


def made(*paths, order: int = 1):
    """Two cubes; the second, 1 m higher, is moved by paths (nodes, axes, path) and fixed at node 7 along x, y."""
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="still").fix([2], axes="z")
    second = scene.add_body(cube(), rubber(), name="prescribed", position=(0, 1, 0), **element(order))
    second.fix([7], axes="xy")
    for nodes, axes, path in paths:
        second.move(nodes, path, axes=axes)
    rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    layout = SimpleNamespace(rest=rest, node_start=np.array([0, 8, len(rest)]))
    return DirichletConditions(scene, layout), rest


def until(end, path):
    return lambda t: None if t > end else path(t)


@both_orders
def test_masks(order, n):
    """The last prescribed node is at the middle of an edge if the body is quadratic."""
    dirichlet, _ = made(([0, 1], "xz", lambda t: (t, 0, 0)), ([1, n - 2], "y", lambda t: (0, t, 0)), order=order)
    expected = np.zeros((8 + n, 3), dtype=bool)
    expected[2, 2] = expected[15, :2] = True
    expected[[8, 9], 0] = expected[[8, 9], 2] = expected[[9, 6 + n], 1] = True
    assert np.array_equal(dirichlet.constrained(), expected)
    assert list(dirichlet.prescribed_nodes) == [8, 9, 9, 6 + n] and dirichlet.n_prescribed == 4
    assert list(dirichlet.held) == sorted([2, 8, 9, 6 + n, 15])
    assert dirichlet.prescribed_axes().tolist() == [[1, 0, 1], [1, 0, 1], [0, 1, 0], [0, 1, 0]]


@both_orders
def test_targets(order, n):
    displacement = np.array([[1.0, 2, 3], [4, 5, 6]])
    dirichlet, rest = made(([n - 3, 2], "xyz", lambda t: t * displacement), ([3], "y", lambda t: (0, -t, 0)), order=order)
    rows, releasing = dirichlet.targets(np.array([0.5, 2.0]))
    assert rows.shape == (2, 3, 3) and not releasing
    for row, t in zip(rows, (0.5, 2.0)):
        assert row == pytest.approx(np.concatenate([rest[[5 + n, 10]] + t * displacement, rest[[11]] + [[0, -t, 0]]]))


def test_release():
    dirichlet, rest = made(([0, 1], "xyz", until(1.0, lambda t: (t, 0, 0))), ([3], "y", until(2.0, lambda t: (0, t, 0))))
    times = np.array([0.5, 1.0, 1.5, 1.75, 2.5])
    rows, releasing = dirichlet.targets(times)
    assert len(rows) == 2 and releasing and dirichlet.constrained()[8].all()  # not released before its time
    rows, releasing = dirichlet.targets(times[2:])
    assert len(rows) == 0 and releasing and not dirichlet.constrained()[[8, 9]].any() and dirichlet.constrained()[11, 1]
    assert dirichlet.prescribed_axes().tolist() == [[0, 0, 0], [0, 0, 0], [0, 1, 0]]
    rows, releasing = dirichlet.targets(times[2:])
    assert len(rows) == 2 and releasing and rows[1, 2] == pytest.approx(rest[11] + [0, 1.75, 0])
    assert dirichlet.targets(times[4:])[1]
    rows, releasing = dirichlet.targets(times[4:])
    assert len(rows) == 1 and not releasing
    dirichlet.reset()
    assert dirichlet.constrained()[8].all() and len(dirichlet.targets(times)[0]) == 2


@pytest.mark.parametrize("steps", [3, 10, 1000])
def test_a_step_that_ends_with_the_path_follows_it_to_there(steps):
    """Whatever the rounding of the step's end: nodes are not released a step early."""
    dirichlet, rest = made(([0, 1], "xyz", lambda t: (t, 0.0, 0.0) if t < 0.3 else None))
    times = 0.3 / steps * np.arange(1, steps + 2)
    rows, releasing = dirichlet.targets(times)
    assert len(rows) == steps and releasing and rows[-1, 0] == pytest.approx(rest[8] + [0.3, 0, 0], abs=1e-8)


@pytest.mark.parametrize("middle", [False, True])
@pytest.mark.parametrize("steps", [3, 1000])
def test_accelerations_of_a_step_that_ends_with_the_path(steps, middle):
    """They are those of the path until then."""
    dirichlet, _ = made(([0, 1], "xyz", lambda t: (t * t, 0.0, 0.0) if t < 0.3 else None))
    dt = 0.3 / steps
    assert dirichlet.accelerations(0.3 - dt, dt, middle) == pytest.approx(np.tile((2.0, 0.0, 0.0), (2, 1)), abs=1e-6)


@pytest.mark.parametrize(
    "late, words",
    [
        (lambda t: np.zeros((3, 3)), r"'s displacement at t = 1.5 must have shape \(3,\) or \(2, 3\), not \(3, 3\)$"),
        (lambda t: (0, np.nan, 0), r"'s displacement at t = 1.5: entry \[1\] is nan, not finite$"),
        (lambda t: ("1", "2", "3"), r"'s displacement at t = 1.5 must be numbers of shape \(3,\) or \(2, 3\), not .*"),
        (lambda t: (True, False, True), r"'s displacement at t = 1.5 must be numbers of shape \(3,\) or \(2, 3\), not .*"),
        (lambda t: (0, 1e39, 0), r"'s displacement at t = 1.5: entry \[1\] is 1e\+39, too large for a 32-bit float$"),
        (lambda t: {}["a\n b"], r" failed at t = 1.5: KeyError: 'a.n b'$"),
        (lambda t: float("x\n" * 999), " failed at t = 1.5: ValueError: could not convert .{1,90}$"),
    ],
)
def test_invalid_paths_are_refused(late, words):
    dirichlet, _ = made(([0, 1], "xyz", lambda t: (0, 0, 0) if t < 1 else late(t)))
    dirichlet.targets(np.array([0.5]))
    with pytest.raises(ts.SimulationError, match=f"^body 'prescribed': moved nodes: the path{words}"):
        dirichlet.targets(np.array([1.5]))


def test_a_displacement_after_a_release_is_refused():
    """Also in a part of the step, where accelerations need the path."""
    dirichlet, _ = made(([0, 1], "xyz", lambda t: None if 0.004 < t < 0.006 else (t, 0.0, 0.0)))
    with pytest.raises(ts.SimulationError, match="body 'prescribed': moved nodes: the path gave None at t = 0.005,"):
        dirichlet.targets(np.array([0.01]))
        dirichlet.accelerations(0.0, 0.01, True)
