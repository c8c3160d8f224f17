"""Errors between meshes: nodes are paired by initial position within each body; the accuracy of the finest mesh is estimated."""

from dataclasses import replace

import numpy as np
import pytest

from taisoft.errors import SimulationError
from taisoft.estimation.comparison import Error, distance, shared_nodes
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.shapes import box_mesh
from taisoft.study.accuracy import Reference, _momentum_error, error_in_space, finest_own_error

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


def test_meshes_without_shared_nodes_are_rejected():
    with pytest.raises(SimulationError, match="body 'a': no node of one mesh"):
        shared_nodes(COARSE.vertices + 0.1, [["a", COARSE.n_verts]], FINE, [["a", len(FINE)]])


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


def test_distance_is_relative_to_the_scale():
    path = np.zeros((2, 2, 3))
    other = path.copy()
    other[1, 0] = (3.0, 0.0, 4.0)
    assert distance(path, other, 10.0) == Error(pytest.approx(0.25), 0.5)


@pytest.mark.parametrize("start, change, scale", [(100.0, 2.0, 2.0), (100.0, 1e-12, 100.0), (0.0, 2.0, 2.0)])
def test_momentum_error_is_relative_to_the_largest_change(start, change, scale):
    exact = reference(FINE, [["a", len(FINE)]], shift=1.0)
    exact.momentum = np.array([[start, 0, 0], [start + change, 0, 0]])
    inexact = exact.momentum + [[0, 0, 0], [0, 0.5, 0]]
    assert _momentum_error({"momentum_rate": None}, inexact, exact) == pytest.approx(0.5 / scale)
