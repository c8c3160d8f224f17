"""Assignments to a scene before it is simulated:

* meshes, surfaces and nodes are immutable, and so are their copies and pickles; the message says how to make another one;
* a body's material, position, velocity and collision can be set, with the checks and messages of `add_body`; nothing else can;
* items can be removed from the lists of a scene and a body, and are added by methods only; contact pairs by `set_contact` only;
* values written into arrays are checked when the scene is used.
"""

import copy
import pickle
import warnings

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError, SceneError
from tests.dynamics.scenes import cube, rubber


def block() -> ts.Scene:
    scene = ts.Scene()
    body = scene.add_body(cube(), rubber(), name="block")
    body.fix([0])
    body.add_force([6], (1, 0, 0))
    body.add_traction([0], (0, 1, 0))
    scene.add_body(cube((3, 0, 0)), rubber(), name="other")
    scene.add_obstacle(ts.Sphere((0, -9, 0), 1.0), name="ball")
    scene.set_contact("block", "ball", friction=0.3)
    return scene


def surface() -> ts.SurfaceMesh:
    mesh = cube()
    return ts.SurfaceMesh(mesh.vertices, mesh.surface)


def copies(one) -> tuple:
    return one, copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))


# --- meshes -----------------------------------------------------------------------------------------------------------

MESH_NAMES = (
    "vertices",
    "tets",
    "volumes",
    "surface",
    "surface_tets",
    "flipped",
    "n_components",
    "warnings",
    "recipe",
    "source",
    "n_tets",
)


@pytest.mark.parametrize(
    "make, names, instead",
    [
        (cube, MESH_NAMES, "make a new mesh, such as ts.TetMesh[(]0.9 [*] mesh.vertices, mesh.tets[)]"),
        (surface, ("vertices", "triangles", "warnings", "volume"), "make a new one, such as ts.SurfaceMesh"),
        (lambda: block().bodies[0].nodes, ("positions", "elements"), "they follow from the mesh and the order; add another body"),
    ],
)
def test_meshes_are_immutable(make, names, instead):
    for one in copies(make()):
        for name in names:
            before = getattr(one, name)
            for change, values in ((setattr, [np.ones((4, 3))]), (delattr, [])):
                with pytest.raises(MeshError, match=f": {name} cannot change: {instead}") as caught:
                    change(one, name, *values)
                assert isinstance(caught.value, AttributeError)
            if isinstance(before, np.ndarray):
                assert getattr(one, name) is before
                with pytest.raises(ValueError, match="read-only"):
                    before[...] = 0
        with pytest.raises(MeshError, match="has no attribute 'foo'$"):
            one.foo = 1


def test_lists_of_a_mesh_are_immutable():
    mesh = cube()
    for change in (lambda: mesh.warnings.append("x"), lambda: mesh.recipe.update(shape="ball")):
        with pytest.raises(MeshError, match="cannot change: make a new mesh"):
            change()
    small = ts.TetMesh(0.9 * mesh.vertices, mesh.tets)
    assert small.volumes == pytest.approx(0.729 * mesh.volumes) and small.recipe is None

    class Coloured(ts.TetMesh):
        def __init__(self, *arrays):
            super().__init__(*arrays)
            self.colour = "red"  # a subclass may have attributes of its own

    coloured = Coloured(mesh.vertices, mesh.tets)
    with pytest.raises(MeshError, match="vertices cannot change"):
        coloured.vertices = mesh.vertices


# --- bodies -----------------------------------------------------------------------------------------------------------

ANOTHER = "add another body by scene.add_body"
READ_ONLY = dict.fromkeys(
    ("name", "mesh", "order", "quadrature_degree", "dilatation", "nodes", "rest_positions", "n_nodes"), ANOTHER
) | {
    "constraints": "call body.fix or body.move",
    "forces": "call body.add_force",
    "tractions": "call body.add_traction",
    "contact_mode": "set body.collision",
}


@pytest.mark.parametrize("name", READ_ONLY)
def test_read_only_attributes_of_a_body(name):
    for scene in (*copies(block()), block().snapshot()):
        with pytest.raises(SceneError, match=f"^body 'block': {name} cannot be set: {READ_ONLY[name]}$") as caught:
            setattr(scene.bodies[0], name, [])
        assert isinstance(caught.value, AttributeError)


@pytest.mark.parametrize(
    "name, value",
    [
        ("material", "rubber"),
        ("material", None),
        ("position", (0, np.nan, 0)),
        ("position", (0, 1)),
        ("position", "up"),
        ("velocity", np.zeros((3, 3))),
        ("velocity", (0, np.inf, 0)),
        ("velocity", (1e300, 0, 0)),
        ("collision", "sdf"),
    ],
)
def test_assignments_are_checked_as_by_add_body(name, value):
    body = block().bodies[0]
    given, before = {"material": rubber(), name: value}, getattr(body, name)
    with pytest.raises(SceneError) as added:
        ts.Scene().add_body(cube(), **given, name="block")
    with pytest.raises(SceneError) as set_later:
        setattr(body, name, value)
    assert str(set_later.value) == str(added.value) and getattr(body, name) is before


def test_attributes_of_a_body_can_be_set():
    body = block().bodies[0]
    body.position, body.velocity, body.collision = [1, 2, 3], np.ones((8, 3)), "distance_field"
    assert body.position.tolist() == [1, 2, 3] and body.position.dtype == float and body.velocity.shape == (8, 3)
    with pytest.warns(UserWarning, match="body 'block': poisson = 0.495 is above 0.49") as caught:
        body.material = rubber(poisson=0.495)
    assert caught[0].filename == __file__ and body.material.poisson == 0.495
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copy.deepcopy(body)


# --- lists and pairs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "owner, name, call",
    [
        ("scene", "bodies", "scene.add_body"),
        ("scene", "obstacles", "scene.add_obstacle"),
        ("body 'block'", "constraints", "body.fix or body.move"),
        ("body 'block'", "forces", "body.add_force"),
        ("body 'block'", "tractions", "body.add_traction"),
    ],
)
def test_lists_grow_by_methods_only(owner, name, call):
    for scene in (block(), block().snapshot(), copy.deepcopy(block())):
        one = scene if owner == "scene" else scene.bodies[0]
        items = getattr(one, name)
        before = list(items)
        changes = {"append": ["foo"], "insert": [0, 1], "extend": [[1]], "__iadd__": [[1]], "__setitem__": [slice(None), []]}
        for change, values in changes.items():
            with pytest.raises(SceneError, match=f"^{owner}: {name} cannot be changed by hand: call {call}$"):
                getattr(items, change)(*values)
            assert list(items) == before
        with pytest.raises(SceneError, match=f"^{owner}: {name} cannot be deleted: call {call}$"):
            delattr(one, name)
        assert items.pop() is before[-1] and getattr(one, name) == before[:-1]


def test_items_can_be_removed(tmp_path):
    scene = block()
    body = scene.bodies[0]
    with pytest.raises(SceneError, match="move: node 0 is already fixed along x"):
        body.move([0], lambda t: (0, 0, 0))
    constraints = body.constraints
    constraints.clear()
    body.move([0], lambda t: (0, 0, 0))
    assert len(constraints) == 1 and constraints is body.constraints
    constraints.clear()
    scene.obstacles.clear()  # leaves a contact pair of an obstacle
    ts.write_scene(tmp_path / "a.toml", scene)
    assert "friction = 0.3" not in (tmp_path / "a.toml").read_text()


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.contact_pairs.__setitem__("foo", ("foo", -3)),
        lambda s: s.contact_pairs.update({1: 2}),
        lambda s: s.contact_pairs.clear(),
        lambda s: s.contact_pairs.pop(frozenset(("block", "ball"))),
        lambda s: s.contact_pairs.setdefault("foo", -3),
        lambda s: setattr(s, "contact_pairs", {}),
    ],
)
def test_contact_pairs_are_set_by_set_contact_only(change):
    for scene in (*copies(block()), block().snapshot()):
        with pytest.raises(SceneError, match="^scene: contact_pairs cannot be .*: call scene.set_contact"):
            change(scene)
        assert scene.contact_pairs == {frozenset(("block", "ball")): (0.3, None)}
        scene.set_contact("block", "other", restitution=0.1)
        assert scene.contact_numbers("other", "block")[1] == 0.1


# --- arrays -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda: ts.MeshObstacle(np.eye(3), [(0, 1, 2)]),
        lambda: ts.Box((0, 0, 0), (1, 1, 1)),
        lambda: ts.KeyFrames([0], [(0, 0, 0)], [(0, 0, 1)]),
        lambda: block().bodies[0].forces[0],
    ],
)
def test_arrays_of_records_and_their_copies_are_read_only(make):
    for one in copies(make()):
        arrays = [value for value in vars(one).values() if isinstance(value, np.ndarray)]
        assert arrays and not any(array.flags.writeable for array in arrays)


@pytest.mark.parametrize(
    "array, words",
    [
        (lambda s: s.gravity, "^scene: gravity: entry .0. is nan, not finite"),
        (lambda s: s.bodies[0].position, "^body 'block': position: entry .0. is nan"),
        (lambda s: s.bodies[1].velocity[None], "^body 'other': velocity: entry .0. is nan"),
    ],
)
def test_values_written_into_arrays_are_checked(array, words):
    scene = block()
    array(scene)[..., 0] = np.nan
    with pytest.raises(SceneError, match=words):
        ts.Simulator(scene)
    scene.obstacles.clear()
    with pytest.raises(SceneError, match=words):
        ts.solve_static(scene)
