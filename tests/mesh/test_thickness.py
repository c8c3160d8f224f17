"""Detection of meshes whose linear tets bend too stiffly, from geometry alone: sheets and bars of few layers, invariance under
motion, scaling and reordering, agreement with measured factors; the warning when such a body is added.
"""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.mesh.thickness import coarse_bending, measure_thickness
from taisoft.scene.refine import refined, with_order
from tests.collision.rotations import rotation

RUBBER = ts.Material()
SHEET = ts.sheet_mesh((12, 12), (1.0, 0.02, 1.0))
BAR = ts.box_mesh((12, 1, 1), (12.0, 1.0, 1.0))
FINE = ts.box_mesh((12, 3, 3), (4.0, 1.0, 1.0))


def curved(mesh: ts.TetMesh) -> ts.TetMesh:
    """A sheet of length 1 rolled into three quarters of a tube."""
    x, y, z = mesh.vertices.T
    angle, radius = 1.5 * np.pi * x, y + 1.0 / (1.5 * np.pi)
    return ts.TetMesh(np.stack([radius * np.sin(angle), radius * np.cos(angle), z], axis=1), mesh.tets)


def joined(*meshes: ts.TetMesh) -> ts.TetMesh:
    starts = np.cumsum([0, *(mesh.n_verts for mesh in meshes)])
    tets = [mesh.tets + start for mesh, start in zip(meshes, starts)]
    return ts.TetMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(tets))


CUBES = joined(*(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0), (1.5 * k, 0.0, 0.0)) for k in range(12)))
UNEVEN = joined(ts.box_mesh((3, 3, 3), (3.0, 3.0, 3.0)), ts.box_mesh((6, 1, 1), (6.0, 0.5, 1.0), (5.0, 0.0, 0.0)))

TUBE = curved(SHEET)
TWO = joined(BAR, TUBE)


def test_thin_meshes_of_few_layers_are_detected_and_others_not():
    for mesh, layers in ((SHEET, 1), (TUBE, 1), (BAR, 1), (ts.box_mesh((6, 2, 2), (12.0, 1.0, 1.0)), 2), (TWO, 1)):
        found = coarse_bending(mesh)
        assert found is not None and found.layers == pytest.approx(layers, rel=0.05) and found.stiffness >= 2.0
    for mesh in (FINE, ts.box_mesh((20, 2, 2), (10.0, 1.0, 1.0)), CUBES, ts.ball_mesh(1.0, 6), UNEVEN):
        assert coarse_bending(mesh) is None


@pytest.mark.parametrize("pattern", ["five", "six"])
def test_thickness_and_layers_of_a_grid(pattern):
    mesh = ts.box_mesh((5, 2, 3), (5.0, 1.0, 6.0), pattern=pattern)
    thickness, layers = measure_thickness(mesh, np.arange(len(mesh.surface)))
    corners = mesh.vertices[mesh.surface]
    axis = np.ptp(corners, axis=1).argmin(axis=1)  # of the triangle's normal
    assert thickness == pytest.approx(np.array([5.0, 1.0, 6.0])[axis])
    assert layers == pytest.approx(np.array([5.0, 2.0, 3.0])[axis])


@settings(max_examples=8, deadline=None)
@given(st.sampled_from([SHEET, BAR, FINE, TUBE, TWO, CUBES]), st.integers(0, 2**32 - 1))
def test_result_is_invariant_under_motion_scaling_and_reordering(mesh, seed):
    rng = np.random.default_rng(seed)
    rotated = mesh.vertices @ rotation(rng.normal(size=3), rng.uniform(0, np.pi)).T
    moved = 10.0 ** rng.uniform(-4, 4) * (rotated + rng.normal(size=3))
    order, tets = rng.permutation(mesh.n_verts), rng.permutation(mesh.tets)
    new_index = np.argsort(order)
    corners = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [3, 2, 1, 0], [2, 3, 0, 1]])[rng.integers(0, 4, mesh.n_tets)]
    other = ts.TetMesh(moved[order], new_index[np.take_along_axis(tets, corners, axis=1)])
    expected, found = coarse_bending(mesh), coarse_bending(other)
    assert (expected is None) == (found is None)
    if expected is not None:
        assert found.stiffness == pytest.approx(expected.stiffness, rel=1e-6)
        assert found.layers == pytest.approx(expected.layers, rel=1e-6)


# of cantilevers, 10 m long and 1 m thick: cells along and across, pattern; factor by which linear tets are too stiff in statics,
# against Timoshenko's beam
CANTILEVERS = [(10, 1, "five", 2.82), (4, 1, "five", 8.06), (10, 1, "six", 4.57), (20, 2, "five", 1.49), (10, 2, "five", 2.36)]


def test_estimated_stiffness_agrees_with_the_measured_one():
    for along, across, pattern, stiffness in CANTILEVERS:
        found = coarse_bending(ts.box_mesh((along, across, across), (10.0, 1.0, 1.0), pattern=pattern))
        assert (found is None) == (stiffness < 2.0)
        assert found is None or 0.6 < found.stiffness / stiffness < 1.4


def test_adding_a_thin_body_warns_at_the_callers_line_but_copying_it_does_not():
    scene = ts.Scene()
    message = "body 'mat': about 1 linear tet lies through its thickness, and it bends about 30 times too stiffly: order=2 bends"
    with pytest.warns(UserWarning, match=message) as found:
        scene.add_body(SHEET, RUBBER, name="mat")
    assert [warning.filename for warning in found] == [__file__]
    with pytest.warns(UserWarning, match="body 'bar': about 2 linear tets lie through its thickness"):
        scene.add_body(ts.box_mesh((6, 2, 2), (12, 1, 1)), RUBBER, name="bar")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.add_body(SHEET, RUBBER, order=2)
        scene.add_body(FINE, RUBBER)
        refined(scene.snapshot())
        with_order(with_order(scene, 2), 1)
