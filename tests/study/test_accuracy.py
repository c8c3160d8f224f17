"""Errors and results of a study:

* nodes of two meshes are paired by initial position within each body; the accuracy of the finest mesh is estimated;
* the Pareto front of time against error, and the cheapest setting within a tolerance.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taisoft.errors import SimulationError
from taisoft.estimation.comparison import Error, shared_nodes
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.shapes import box_mesh
from taisoft.study import Request
from taisoft.study.accuracy import Reference, Row, error_in_space, finest_own_error, momentum_error
from taisoft.study.results import Study, front

COARSE = box_mesh((2, 1, 1), (2.0, 1.0, 1.0))
FINE = make_nodes(COARSE, 2).positions


def reference(start: np.ndarray, bodies: list, shift: float, own: float = 0.0, refine: int = 0) -> Reference:
    """Two frames in which all nodes move 1 + shift [m] along x."""
    path = np.stack([start, start + [1.0 + shift, 0, 0]])
    zeros = np.zeros(2), 1.0, np.zeros((2, 3))
    return Reference({"refine": refine, "order": None}, path, 1.0 + shift, Error(own, own), *zeros, bodies)


def test_nodes_are_paired_by_position_within_their_body():
    shuffled = np.random.default_rng(0).permutation(len(FINE))
    start = np.concatenate([COARSE.vertices, COARSE.vertices])  # two coincident bodies
    other = np.concatenate([FINE[shuffled], FINE])
    n, m = COARSE.n_verts, len(FINE)
    first, second = shared_nodes(start, [["a", n], ["b", n]], other, [["a", m], ["b", m]])
    assert np.array_equal(first, np.arange(2 * n)) and np.array_equal(start[first], other[second])
    assert (second[:n] < m).all() and (second[n:] >= m).all()
    with pytest.raises(SimulationError, match="body 'a': no node of one mesh"):
        shared_nodes(COARSE.vertices + 0.1, [["a", n]], FINE, [["a", m]])


def test_error_in_space_uses_shared_nodes_and_the_finest_excursion():
    finest = reference(FINE, [["a", len(FINE)]], shift=1.0)
    path = np.stack([COARSE.vertices, COARSE.vertices + [1.5, 0, 0]])
    found = error_in_space(path, [["a", COARSE.n_verts]], finest)
    assert (found.max, found.rms) == (pytest.approx(0.25), pytest.approx(0.25 / np.sqrt(2)))


def test_error_of_the_finest_mesh_is_a_third_of_the_distance_to_the_next():
    finest = reference(FINE, [["a", len(FINE)]], shift=1.0, own=1e-3, refine=2)
    near = reference(COARSE.vertices, [["a", COARSE.n_verts]], shift=0.9, refine=1)
    far = reference(COARSE.vertices, [["a", COARSE.n_verts]], shift=0.5)
    own, explanation = finest_own_error(finest, [far, near])
    assert own.max == pytest.approx(0.1 / 2.0 / 3.0) and "refine 1" in explanation
    coarser = reference(COARSE.vertices, [["a", COARSE.n_verts]], shift=0.99)  # nearer by chance
    assert finest_own_error(finest, [coarser, near])[0] == own
    own, explanation = finest_own_error(replace(finest, order_in_time=1), [far, near])  # as with contacts
    assert own.max == pytest.approx(0.1 / 2.0) and explanation.startswith("the distance")
    assert finest_own_error(finest, [])[0] == finest.own_error
    finest.own_error = Error(0.5, 0.5)
    assert finest_own_error(finest, [far, near])[0].max == 0.5


def test_momentum_error_is_relative_to_the_largest_change():
    exact = reference(FINE, [["a", len(FINE)]], shift=1.0)
    for start, change, scale in ((100.0, 2.0, 2.0), (100.0, 1e-12, 100.0), (0.0, 2.0, 2.0)):
        exact.momentum = np.array([[start, 0, 0], [start + change, 0, 0]])
        inexact = exact.momentum + [[0, 0, 0], [0, 0.5, 0]]
        assert momentum_error({"momentum_rate": None}, inexact, exact) == pytest.approx(0.5 / scale)


few = st.integers(0, 4).map(float)  # points often coincide or share a coordinate
points = st.lists(st.tuples(few, few) | st.tuples(st.floats(1e-9, 1e9), st.floats(1e-12, 10.0)), max_size=20)


def dominates(a, b) -> bool:
    """Whether a is not larger than b in either coordinate, and smaller in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


@given(points)
def test_front_holds_exactly_the_undominated_points(candidates):
    found = front(candidates)
    assert len(found) == len(set(found))
    for k, point in enumerate(candidates):
        assert (k in found) == (not any(dominates(other, point) for other in candidates))
    times, errors = [candidates[k][0] for k in found], [candidates[k][1] for k in found]
    assert times == sorted(times) and errors == sorted(errors, reverse=True)


@given(points, st.floats(0.0, 5.0))
def test_cheapest_is_the_fastest_within_the_tolerance_and_nearest_has_the_smallest_error(candidates, tolerance):
    study = Study(Request("bar", tolerance=tolerance), {})
    study.rows = [Row({}, "ok", seconds=[p[0]], in_time=Error(0.0, p[1]), in_time_sure=Error(0.0, 0.0)) for p in candidates]
    found, nearest, accurate = study.cheapest(), study.nearest(), [p for p in candidates if p[1] <= tolerance]
    assert (found is None) == (not accurate) and (nearest is None) == (not candidates)
    if accurate:
        assert study.point(found) == min(accurate)
    if candidates:
        assert study.point(nearest) == min(candidates, key=lambda p: (p[1], p[0]))


def test_points_with_nan_are_left_out():
    assert front([(math.nan, 0.0), (1.0, math.nan), (2.0, 0.5)]) == [2] and front([]) == []
