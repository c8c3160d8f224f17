"""A scene on a finer mesh or with another order: every tet becomes eight; selections, loads, velocities and paths apply to the
new nodes, too; ambiguous ids are refused.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.fem.reference import triangle_areas
from taisoft.scene.refine import refined, with_order

RUBBER = ts.Material(young=1e5)


def one_body(order: int = 1, cells=(2, 1, 1)):
    scene = ts.Scene()
    return scene, scene.add_body(ts.box_mesh(cells, (2.0, 1.0, 1.0)), RUBBER, name="bar", order=order, position=(0, 1, 0))


@pytest.mark.parametrize("order", [1, 2])
def test_every_tet_becomes_eight(order):
    scene, old = one_body(order)
    new = refined(scene).bodies[0]
    assert new.mesh.n_tets == 8 * old.mesh.n_tets and new.order == order
    assert new.mesh.volumes.sum() == pytest.approx(old.mesh.volumes.sum(), rel=1e-12)
    assert np.array_equal(new.rest_positions[: old.n_nodes], old.rest_positions)
    assert np.array_equal(new.position, old.position) and new.name == "bar"
    assert len(new.mesh.surface) == 4 * len(old.mesh.surface)
    assert len(np.unique(new.rest_positions.round(9), axis=0)) == new.n_nodes


@pytest.mark.parametrize("change", [refined, lambda scene: with_order(scene, 2)])
@pytest.mark.parametrize("by_ids", [False, True])
def test_a_fixed_face_is_fixed_at_all_its_nodes(change, by_ids):
    scene, old = one_body()
    left = old.rest_positions[:, 0] < -0.99
    old.fix(np.flatnonzero(left) if by_ids else lambda X: X[:, 0] < -0.99, axes="xz")
    new = change(scene).bodies[0]
    assert np.array_equal(new.constraints[0].nodes, np.flatnonzero(new.rest_positions[:, 0] < -0.99))
    assert new.constraints[0].axes.tolist() == [True, False, True]
    linear = with_order(with_order(scene, 2), 1).bodies[0]
    assert np.array_equal(linear.constraints[0].nodes, old.constraints[0].nodes)


def test_ids_fix_nodes_between_them_or_are_ambiguous():
    scene, old = one_body(cells=(1, 1, 1))
    old.fix(np.flatnonzero(np.abs(old.rest_positions[:, 0]) > 0.99))  # both ends of a bar of one cell: all its nodes
    new = refined(scene).bodies[0]
    assert len(new.constraints[0].nodes) == new.n_nodes
    scene, old = one_body(cells=(1, 1, 1))
    corners = np.flatnonzero((old.rest_positions[:, 1] > 0) & (old.rest_positions[:, 2] > 0))
    old.fix(corners)
    with pytest.raises(SceneError, match="bar.*ambiguous.*choose by a function"):
        refined(scene)


def test_total_loads_and_velocities_are_kept():
    scene, old = one_body()
    old.velocity = np.cross((0.0, 0.0, 3.0), old.rest_positions)
    top = old.mesh.vertices[old.mesh.surface].mean(axis=1)[:, 1] > 0.49
    old.add_traction(top, (1.0, -5.0, 2.0))
    old.add_force(lambda X: X[:, 0] > 0.99, (0.0, 3.0, 0.0))
    old.add_force([0, 3], [(1, 0, 0), (0, 1, 0)])
    for new in (refined(scene).bodies[0], with_order(scene, 2).bodies[0]):
        load = new.tractions[0]
        total = triangle_areas(new, load.triangles).sum() * load.value
        assert np.allclose(total, np.multiply(2.0, (1.0, -5.0, 2.0)), rtol=1e-12)
        assert np.array_equal(new.forces[0].nodes, np.flatnonzero(new.rest_positions[:, 0] > 0.99))
        assert new.forces[0].value.tolist() == [0.0, 3.0, 0.0]
        assert new.forces[1].nodes.tolist() == [0, 3]
        assert np.allclose(new.velocity, np.cross((0.0, 0.0, 3.0), new.rest_positions), atol=1e-12)


def test_key_frames_apply_to_new_nodes():
    """Of a selection that is more than a face, so that old and new nodes have different means."""
    scene, old = one_body()
    before = old.move(lambda X: X[:, 0] + X[:, 1] > 0.4, ts.KeyFrames([0.0, 1.0], rotations=[(0, 0, 0), (0.5, 0, 0)]))
    after = refined(scene).bodies[0].constraints[0]
    kept = np.isin(after.nodes, before.nodes)
    assert np.allclose(after.path(0.7)[kept], before.path(0.7), atol=1e-12) and kept.sum() == len(before.nodes) < len(kept)


def test_a_path_with_a_displacement_per_node_is_refused():
    scene, old = one_body()
    where = old.rest_positions[:, 0] > 0.99
    n = int(where.sum())
    old.move(where, lambda t: np.full((n, 3), t))
    with pytest.raises(SceneError, match="one displacement for each of its 4 nodes.*KeyFrames"):
        refined(scene)
    scene, old = one_body()
    old.move(where, lambda t: (t, 0.0, 0.0))
    assert refined(scene).bodies[0].constraints[0].path(2.0) == (2.0, 0.0, 0.0)
