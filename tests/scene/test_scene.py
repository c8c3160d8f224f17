"""Scenes, bodies and materials:

* Lamé's parameters follow from Young's modulus and Poisson's ratio; invalid material numbers are refused, near
  incompressibility is warned of, and a misspelt law gets a suggestion;
* gravity, positions, velocities, loads and paths are finite numbers of the right shape; names are unique;
* nodes and triangles are selected by ids, masks or functions; empty selections, unknown ids and other results are refused;
* a node can be fixed twice, but a moved axis of a node has no other constraint.
"""

import warnings

import numpy as np
import pytest

from taisoft.errors import SceneError
from taisoft.mesh.shapes import box_mesh
from taisoft.scene.material import LAWS
from taisoft.scene.scene import Material, Scene

MESH = box_mesh((2, 2, 2), (1.0, 1.0, 1.0))


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def body(scene):
    return scene.add_body(MESH, Material(), name="beam")


def still(t):
    return (0.0, 0.0, 0.0)


@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.3, 0.49])
def test_lame_parameters_satisfy_hookes_law(poisson):
    rubber = Material(young=2e6, poisson=poisson)
    # uniaxial stress: a strain of (1, -nu, -nu) e gives a stress of young e along the axis and none across it
    trace = 1.0 - 2.0 * poisson
    assert 2 * rubber.mu + rubber.lam * trace == pytest.approx(2e6)
    assert -2 * rubber.mu * poisson + rubber.lam * trace == pytest.approx(0.0, abs=1e-6)


def test_a_material_is_frozen_and_holds_floats():
    rubber = Material(young=1000000, density=np.float32(900.0))
    assert type(rubber.young) is float and rubber.density == 900.0
    with pytest.raises(AttributeError):
        rubber.young = 2.0
    assert {Material(law=law).law for law in LAWS} == set(LAWS)


@pytest.mark.parametrize("poisson", [0.5, 0.7, -1, -1.5, 0.5000001])
def test_poissons_ratio_must_lie_in_the_open_interval(poisson):
    with pytest.raises(SceneError, match=r"poisson must lie in the open interval \(-1, 0.5\), not"):
        Material(poisson=poisson)


def test_near_incompressibility_is_warned_of_for_linear_tets():
    soft = Material(poisson=0.495)
    with pytest.warns(UserWarning, match="body 'locks': poisson = 0.495 is above 0.49, where linear tets lock"):
        Scene().add_body(box_mesh((1, 1, 1), (1, 1, 1)), soft, name="locks")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene().add_body(box_mesh((1, 1, 1), (1, 1, 1)), soft, order=2)


@pytest.mark.parametrize(
    "field, values",
    [
        ("young", [0, -1, np.nan, np.inf, "1e5 Pa", None, True, 1j, [1e5], 10**400]),
        ("density", [0, -1, np.nan, "1000"]),
        ("friction", [-0.1, np.nan, np.inf, "0.5"]),
        ("restitution", [-0.1, 1.5, np.nan]),
        ("mass_damping", [-1e-9, np.nan, "0"]),
        ("stiffness_damping", [-1e-9, np.inf]),
        ("poisson", [np.nan, "0.3", None]),
        ("volume_floor", [-0.1, 1e-4, 1.0, np.nan, "0.1", None]),
    ],
)
def test_invalid_material_numbers_are_refused(field, values):
    for value in values:
        with pytest.raises(SceneError, match=f"^material: {field} must be"):
            Material(**{field: value})


@pytest.mark.parametrize(
    "law, suggestion", [("corotated", "corotational"), ("Neo_Hookean", "stable_neo_hookean"), ("stvenantkirchhoff", LAWS[0])]
)
def test_a_misspelt_law_gets_a_suggestion(law, suggestion):
    with pytest.raises(SceneError, match=f"law must be one of .*did you mean '{suggestion}'"):
        Material(law=law)


@pytest.mark.parametrize("law", ["hooke", "", None, 3])
def test_an_unknown_law_lists_the_known_ones(law):
    with pytest.raises(SceneError, match="law must be one of st_venant_kirchhoff, corotational, stable_neo_hookean, not"):
        Material(law=law)


@pytest.mark.parametrize(
    "gravity", [(0, -9.81), "down", (0, np.nan, 0), (0, np.inf, 0), 9.81, None, ("0", "1", "2"), [[0, 1, 2]]]
)
def test_gravity_must_be_three_finite_numbers(gravity, scene):
    with pytest.raises(SceneError, match="^scene: gravity"):
        Scene(gravity=gravity)
    with pytest.raises(SceneError, match="^scene: gravity"):
        scene.gravity = gravity
    assert scene.gravity.tolist() == [0.0, -9.81, 0.0]


def test_bodies_are_found_by_name(scene, body):
    other = scene.add_body(MESH, Material(), position=(1, 2, 3), velocity=np.ones((27, 3)))
    assert scene.body("beam") is body and scene.body(other.name) is other and scene.bodies == [body, other]
    assert other.name == "body0" and other.velocity.shape == (27, 3) and other.position.tolist() == [1, 2, 3]
    assert np.array_equal(other.rest_positions, MESH.vertices)  # position shifts the initial state only
    with pytest.raises(SceneError, match="no body is called 'bean'; did you mean 'beam'"):
        scene.body("bean")
    with pytest.raises(SceneError, match="no body is called 7"):
        scene.body(7)


def test_default_names_skip_used_ones(scene):
    scene.add_body(MESH, Material(), name="body1")
    assert [scene.add_body(MESH, Material()).name for _ in range(3)] == ["body0", "body2", "body3"]


@pytest.mark.parametrize(
    "options, rule",
    [
        ({"name": "beam"}, "body name 'beam' is taken"),
        ({"name": ""}, "body name must be a text that is not empty"),
        ({"name": "  "}, "body name must be a text that is not empty"),
        ({"name": 3}, "body name must be a text"),
        ({"order": 3}, "order must be 1 or 2, not 3"),
        ({"order": True}, "order must be 1 or 2, not True"),
        ({"order": 1.0}, "order must be 1 or 2, not 1.0"),
        ({"quadrature_degree": 2}, "quadrature_degree of order 1 must be 1, not 2"),
        ({"order": 2, "quadrature_degree": 3}, "quadrature_degree of order 2 must be 2 or 4, not 3"),
        ({"position": (0, 0)}, r"'b': position must have shape \(3,\), not \(2,\)"),
        ({"position": (0, np.nan, 0)}, r"position: entry \[1\] is nan, not finite"),
        ({"velocity": np.zeros((26, 3))}, r"velocity must have shape \(3,\) or \(27, 3\), not \(26, 3\)"),
        ({"velocity": (0, 0, np.inf)}, "velocity: .* not finite"),
        ({"velocity": "fast"}, "velocity must be numbers"),
        ({"mesh": MESH.vertices}, "mesh must be a TetMesh, not ndarray"),
        ({"material": {"young": 1e6}}, "materials are given by region, but its mesh has no regions"),
        ({"collision": "distance"}, "'b': collision must be one of auto, distance_field, proximity, not 'distance'; did you"),
        ({"collision": None}, "'b': collision must be one of"),
    ],
)
def test_invalid_bodies_are_refused(scene, body, options, rule):
    with pytest.raises(SceneError, match=rule):
        scene.add_body(**({"mesh": MESH, "material": Material(), "name": "b"} | options))
    assert scene.bodies == [body]


def test_nodes_are_selected_by_ids_masks_and_functions(body):
    left = MESH.vertices[:, 0] < -0.4
    expected = np.flatnonzero(left).tolist()
    for where in (expected, np.flatnonzero(left), left, lambda X: X[:, 0] < -0.4):
        assert body.fix(where).nodes.tolist() == expected
    assert body.fix([5, 3, 5]).nodes.tolist() == [5, 3]
    assert body.fix(4, axes="zx").axes.tolist() == [True, False, True]


def test_a_selector_cannot_change_the_mesh(body):
    def shift(X):
        X += 1.0
        return X[:, 0] > 1.4

    assert len(body.fix(shift).nodes) == 9 and body.rest_positions.max() == 0.5


@pytest.mark.parametrize(
    "where, rule",
    [
        ([-1], "node -1 does not exist"),
        ([3, 27], "node 27 does not exist"),
        ([], "no node is chosen"),
        (np.zeros(27, dtype=bool), "no node is chosen"),
        (np.ones(26, dtype=bool), r"a mask must have shape \(27,\), not \(26,\)"),
        ([1.0], "list of integers"),
        ("left", "list of integers"),
        (None, "list of integers"),
        ([[1, 2]], "list of integers"),
        ([[1], [2, 3]], "choose by node ids"),
        (lambda X: X[:, 0] > 9, "no node is chosen"),
        (lambda X: X[:, 0], r"must return a bool mask of shape \(27,\), not float64"),
        (lambda X: np.array([1, 2]), "must return a bool mask"),
        (lambda X: True, r"must return a bool mask of shape \(27,\), not bool of shape \(\)"),
        (lambda X: X.missing, "the selection function failed: AttributeError"),
    ],
)
def test_invalid_selections_are_refused(body, where, rule):
    for call in (body.fix, lambda where: body.move(where, still), lambda where: body.add_force(where, (0, 0, 1))):
        with pytest.raises(SceneError, match=f"^body 'beam': .*{rule}"):
            call(where)
    assert not body.constraints and not body.forces


@pytest.mark.parametrize("axes", ["", "xx", "w", "xyzz", "XY", None, 1, ["x"], "x y"])
def test_invalid_axes_are_refused(body, axes):
    with pytest.raises(SceneError, match="axes must be some of 'x', 'y', 'z'"):
        body.fix([0], axes=axes)
    with pytest.raises(SceneError, match="axes must be some of 'x', 'y', 'z'"):
        body.move([0], still, axes=axes)


def test_paths_are_evaluated_once_at_time_0(body):
    times = []

    def path(t):
        times.append(t)
        return np.zeros((2, 3))

    constraint = body.move([9, 4], path, axes="y")
    assert times == [0.0] and constraint.nodes.tolist() == [9, 4] and constraint.path is path


@pytest.mark.parametrize(
    "path, rule",
    [
        (lambda t: None, "must give a displacement at t = 0, not None"),
        (lambda t: (0, 0), r"must have shape \(3,\) or \(2, 3\), not \(2,\)"),
        (lambda t: np.zeros((3, 3)), "must have shape"),
        (lambda t: (0, np.nan, 0), "not finite"),
        (lambda t: "up", "must be numbers"),
        (lambda t: 1 / t, "the path failed at t = 0: ZeroDivisionError"),
        ((0, 0, 1), "path must be a function of time"),
        (None, "path must be a function of time"),
    ],
)
def test_invalid_paths_are_refused(body, path, rule):
    with pytest.raises(SceneError, match=f"^body 'beam': move: .*{rule}"):
        body.move([1, 2], path)
    assert not body.constraints


def test_a_node_moved_twice_is_refused(body):
    with pytest.raises(SceneError, match="move: node 4 is chosen twice"):
        body.move([4, 3, 4], still)


def test_contradicting_constraints_are_refused(body):
    body.fix([0, 1])
    body.fix([1, 2], "y")  # node 1 again
    body.move([2], still, "x")  # another axis of a fixed node
    with pytest.raises(SceneError, match="move: node 1 is already fixed along x"):
        body.move([5, 1], still)
    with pytest.raises(SceneError, match="fix: node 2 is already moved along x"):
        body.fix([0, 2])
    with pytest.raises(SceneError, match="move: node 2 is already moved along x"):
        body.move([2], still, "zx")
    body.move([5], still)  # refused above for node 1
    assert len(body.constraints) == 4


def test_tractions_select_triangles_by_their_centroids(body):
    load = body.add_traction(lambda c: c[:, 1] > 0.49, (0, 2000, 0))
    x = MESH.vertices[MESH.surface[load.triangles]]
    areas = 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    assert areas.sum() == pytest.approx(1.0) and load.value.tolist() == [0, 2000, 0]
    assert body.tractions == [load] and body.add_traction([3, 1], (1, 0, 0)).triangles.tolist() == [3, 1]


@pytest.mark.parametrize("where, rule", [([48], "surface triangle 48 does not exist"), ([], "no surface triangle is chosen")])
def test_invalid_traction_selections_are_refused(body, where, rule):
    with pytest.raises(SceneError, match=rule):
        body.add_traction(where, (0, 1, 0))


@pytest.mark.parametrize("value", [(0, 1), 5.0, (0, np.nan, 0), "up", None])
def test_loads_must_be_three_finite_numbers(body, value):
    with pytest.raises(SceneError, match="add_traction: traction"):
        body.add_traction([0], value)
    with pytest.raises(SceneError, match="add_force: force"):
        body.add_force([0], value)
    assert not body.tractions and not body.forces
