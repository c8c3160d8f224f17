"""A scene on a finer mesh or with another order, `taisoft.scene.refine`:

* cells of eight, each an eighth of the volume, old nodes first, new ones in the middle between two old ones;
* what a function chose is what it chooses there; ids choose faces as wholes, and what cannot be told is refused;
* the load of a traction and of a total force, and the mean velocity, stay the same; paths lead the new nodes too.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.fem.reference import traction_forces
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


def test_orders_there_and_back():
    scene, old = one_body()
    old.fix(lambda X: X[:, 0] < -0.99)
    quadratic = with_order(scene, 2)
    assert np.array_equal(quadratic.bodies[0].mesh.vertices, old.mesh.vertices)
    linear = with_order(quadratic, 1).bodies[0]
    assert np.array_equal(linear.constraints[0].nodes, old.constraints[0].nodes)
    assert with_order(scene, 1).bodies[0].nodes is old.nodes


@pytest.mark.parametrize("change", [refined, lambda scene: with_order(scene, 2)])
@pytest.mark.parametrize("by_ids", [False, True])
def test_a_held_face_is_held_everywhere(change, by_ids):
    scene, old = one_body()
    left = old.rest_positions[:, 0] < -0.99
    old.fix(np.flatnonzero(left) if by_ids else lambda X: X[:, 0] < -0.99, axes="xz")
    new = change(scene).bodies[0]
    assert np.array_equal(new.constraints[0].nodes, np.flatnonzero(new.rest_positions[:, 0] < -0.99))
    assert new.constraints[0].axes.tolist() == [True, False, True]


def test_two_faces_held_by_ids_leave_what_is_between_them_untold():
    scene, old = one_body(cells=(1, 1, 1))
    old.fix(np.flatnonzero(np.abs(old.rest_positions[:, 0]) > 0.99))  # both ends of a bar that is one cell long
    new = refined(scene).bodies[0]  # every tet has its nodes there: the bar is held as a whole
    assert len(new.constraints[0].nodes) == new.n_nodes
    scene, old = one_body(cells=(1, 1, 1))
    corners = np.flatnonzero((old.rest_positions[:, 1] > 0) & (old.rest_positions[:, 2] > 0))
    old.fix(corners)
    with pytest.raises(SceneError, match="bar.*ambiguous.*choose by a function"):
        refined(scene)


def test_loads_stay_what_they_are():
    scene, old = one_body()
    top = old.mesh.vertices[old.mesh.surface].mean(axis=1)[:, 1] > 0.49
    old.add_traction(top, (1.0, -5.0, 2.0))
    old.add_force(lambda X: X[:, 0] > 0.99, (0.0, 3.0, 0.0))
    old.add_force([0, 3], [(1, 0, 0), (0, 1, 0)])
    for new in (refined(scene).bodies[0], with_order(scene, 2).bodies[0]):
        load = new.tractions[0]
        total = traction_forces(new, load.triangles, load.value).sum(axis=0)
        assert np.allclose(total, np.multiply(2.0, (1.0, -5.0, 2.0)), rtol=1e-12)
        assert np.array_equal(new.forces[0].nodes, np.flatnonzero(new.rest_positions[:, 0] > 0.99))
        assert new.forces[0].value.tolist() == [0.0, 3.0, 0.0]
        assert new.forces[1].nodes.tolist() == [0, 3]


def test_nodal_velocities_are_interpolated():
    scene = ts.Scene()
    mesh = ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0))
    scene.add_body(mesh, RUBBER, velocity=np.cross((0.0, 0.0, 3.0), mesh.vertices))
    new = refined(scene).bodies[0]
    assert np.allclose(new.velocity, np.cross((0.0, 0.0, 3.0), new.rest_positions), atol=1e-12)


def test_paths_lead_new_nodes():
    scene, old = one_body()

    def chooses(X):  # more than a face, so that the mean of the old nodes and that of the new ones differ
        return X[:, 0] + X[:, 1] > 0.4

    where = chooses(old.rest_positions)
    old.move(chooses, ts.KeyFrames([0.0, 1.0], rotations=[(0, 0, 0), (0.5, 0, 0)]))
    new = refined(scene).bodies[0]
    ours = new.constraints[0]
    places = [np.flatnonzero(ours.nodes == node)[0] for node in np.flatnonzero(where)]
    assert np.allclose(ours.path(0.7)[places], old.constraints[0].path(0.7), atol=1e-12)
    assert where.sum() < len(ours.nodes)


def test_a_path_of_single_nodes_cannot_be_carried_over():
    scene, old = one_body()
    where = old.rest_positions[:, 0] > 0.99
    n = int(where.sum())
    old.move(where, lambda t: np.full((n, 3), t))
    with pytest.raises(SceneError, match="one displacement for each of its 4 nodes.*KeyFrames"):
        refined(scene)
    scene, old = one_body()
    old.move(where, lambda t: (t, 0.0, 0.0))
    assert refined(scene).bodies[0].constraints[0].path(2.0) == (2.0, 0.0, 0.0)


def test_what_is_held_on_middles_alone_has_no_place_on_linear_tets():
    scene, old = one_body(order=2)
    old.fix([old.n_nodes - 1])
    with pytest.raises(SceneError, match="mid-edge nodes are chosen, which linear tets do not have"):
        with_order(scene, 1)
