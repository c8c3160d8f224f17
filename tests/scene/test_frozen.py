"""Which attributes may be assigned, and when: unknown and read-only ones are refused with a hint; meshes and records are
immutable; lists grow by methods only; a successfully made Simulator freezes its scene and its own copy, but no other copy.
"""

import copy
import pickle

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError, SceneError, SimulationError
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import with_order
from tests.dynamics.scenes import cube, rubber

DT = 1e-4


def loaded() -> ts.Scene:
    """A body with velocities, constraints and loads, a second body and an obstacle."""
    scene = ts.Scene()
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(), name="block", velocity=np.zeros((8, 3)))
    body.fix([0])
    body.move([1], lambda t: (0, 0, 0))
    body.add_force([6, 7], (1, 0, 0))
    body.add_traction([0], (0, 1, 0))
    scene.add_body(cube((3, 0, 0)), rubber(), name="other")
    scene.add_spring(("block", 0), ("other", 0), 1.0, name="spring")
    scene.add_tendon([("block", 1), ("other", 1)], 1.0, name="line")
    scene.add_obstacle(ts.Sphere((0, -9, 0), 1.0), name="ball")
    scene.attach("block", [2, 3], "ball", 1.0, name="pins")
    scene.set_contact("block", "ball", friction=0.3)
    return scene


def copies(one) -> tuple:
    return one, copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))


REMOVE = "call scene.remove and add another"
ANOTHER = "add another body by scene.add_body"


def test_unknown_and_read_only_attributes_are_refused():
    for select, name, message in (
        (lambda s: s, "gravty", "scene has no attribute 'gravty'; did you mean 'gravity'[?]$"),
        (lambda s: s.body("block"), "materal", "body 'block' has no attribute 'materal'; did you mean 'material'[?]$"),
        *(
            (lambda s: s.body("block"), name, f"body 'block': {name} cannot be set: {ANOTHER}$")
            for name in ("name", "mesh", "order", "dilatation", "nodes", "rest_positions")
        ),
        (
            lambda s: s.body("block"),
            "constraints",
            "body 'block': constraints cannot be set: call body.fix, body.move or body.remove$",
        ),
        (lambda s: s.body("block"), "contact_mode", "body 'block': contact_mode cannot be set: set body.collision$"),
        (lambda s: s.body("block").material, "young", "material: young cannot change: .*sim.set_material.body, young=...."),
        (lambda s: s.obstacle("ball"), "friction", "obstacle 'ball': friction cannot change: .*scene.set_contact"),
        (lambda s: s.obstacle("ball").shape, "radius", "sphere: radius cannot change: make another shape"),
        (lambda s: s.collision, "margin", "collision settings: margin cannot change: .*CollisionSettings.margin=...."),
        (lambda s: s.springs[0], "stiffness", f"spring 'spring': stiffness cannot change: {REMOVE}"),
        (lambda s: s.body("block").forces[0], "value", "force: value cannot change: call sim.set_force"),
        (lambda s: ts.KeyFrames([0], [(0, 0, 0)]), "colour", "key frames has no attribute 'colour'$"),
    ):
        target = select(loaded())
        before = dict(target.__dict__)
        with pytest.raises(SceneError, match=f"^{message}") as caught:
            setattr(target, name, 1.0)
        assert isinstance(caught.value, AttributeError) and target.__dict__ == before


def test_meshes_are_immutable():
    mesh = cube()
    for made, name, instead in (
        (mesh, "vertices", "make a new mesh, such as ts.TetMesh[(]0.9 [*] mesh.vertices, mesh.tets[)]"),
        (ts.SurfaceMesh(mesh.vertices, mesh.surface), "triangles", "make a new one, such as ts.SurfaceMesh"),
        (loaded().bodies[0].nodes, "positions", "they follow from the mesh and the order; add another body"),
    ):
        for one in copies(made):
            for change in (lambda o, n: setattr(o, n, np.ones((4, 3))), delattr):
                with pytest.raises(MeshError, match=f": {name} cannot change: {instead}"):
                    change(one, name)
            assert not any(value.flags.writeable for value in vars(one).values() if isinstance(value, np.ndarray))
            with pytest.raises(MeshError, match="has no attribute 'foo'$"):
                one.foo = 1
    for change in (lambda: mesh.warnings.append("x"), lambda: mesh.recipe.update(shape="ball")):
        with pytest.raises(MeshError, match="cannot change: make a new mesh"):
            change()


def test_assignments_are_checked_as_by_add_body():
    body = loaded().bodies[0]
    for name, value in {"material": "", "position": (0, np.nan, 0), "velocity": np.eye(3), "collision": "sdf"}.items():
        before = getattr(body, name)
        with pytest.raises(SceneError) as added:
            ts.Scene().add_body(cube(), **({"material": rubber(), name: value}), name="block")
        with pytest.raises(SceneError) as set_later:
            setattr(body, name, value)
        assert str(set_later.value) == str(added.value) and getattr(body, name) is before
    body.position, body.velocity = [1, 2, 3], np.ones((8, 3))
    assert body.position.tolist() == [1, 2, 3] and body.position.dtype == float and body.velocity.shape == (8, 3)
    body = ts.Scene().add_body(cube(), rubber(), name="block", dilatation="local")
    with pytest.warns(UserWarning, match="body 'block': poisson = 0.495 is at least 0.45") as caught:
        body.material = rubber(poisson=0.495)
    assert len(caught) == 1 and caught[0].filename == __file__ and body.material.poisson == 0.495


def test_lists_grow_by_methods_only_and_items_can_be_removed():
    scene = loaded()
    changes = {"append": ["foo"], "insert": [0, 1], "extend": [[1]], "__iadd__": [[1]], "__setitem__": [slice(None), []]}
    body = scene.bodies[0]
    for one, name, call in (
        (scene, "bodies", "scene.add_body or scene.remove"),
        (body, "constraints", "body.fix, body.move or body.remove"),
        (body, "forces", "body.add_force or body.remove"),
    ):
        items = getattr(one, name)
        before = tuple(items)
        for change, values in changes.items():
            with pytest.raises(SceneError, match=f": {name} cannot be changed by hand: call {call}$"):
                getattr(items, change)(*values)
        with pytest.raises(AttributeError):
            delattr(one, name)
        assert items == before
        one.remove(before[-1])
        assert getattr(one, name) == before[:-1]
        with pytest.raises(SceneError, match=": remove: .* is none of its"):
            one.remove(before[-1])
    for change in (lambda: scene.contact_pairs.update({1: 2}), lambda: setattr(scene, "contact_pairs", {})):
        with pytest.raises(SceneError, match="^scene: contact_pairs cannot be .*: call scene.set_contact"):
            change()
    assert scene.contact_pairs == {frozenset(("block", "ball")): (0.3, None)}


def test_values_written_into_arrays_are_checked():
    scene = loaded()
    for array, words in ((scene.bodies[0].position, "body 'block': position"), (scene.gravity, "scene: gravity")):
        array[0] = np.nan
        with pytest.raises(SceneError, match=f"^{words}: entry .0. is nan, not finite"):
            ts.Simulator(scene)


def freeze():
    """A frozen scene, its simulator, and a copy from before."""
    scene = loaded()
    before = copy.deepcopy(scene)
    with ts.Simulator(scene, DT, "symplectic_euler", precision="f64") as sim:
        yield scene, sim, before


frozen = pytest.fixture(scope="module", name="frozen")(freeze)
changed = pytest.fixture(name="changed")(freeze)  # for a test that changes the simulator


CHANGES = {
    "gravity": (lambda s: setattr(s, "gravity", (0, 0, 0)), "call sim.set_gravity"),
    "collision": (lambda s: setattr(s, "collision", ts.CollisionSettings()), "scene.snapshot"),
    "contact_forces": (lambda s: setattr(s, "contact_forces", True), "make a new Simulator"),
    "add_body": (lambda s: s.add_body(cube((0, 5, 0)), rubber()), "scene.snapshot"),
    "remove": (lambda s: s.remove(*s.springs), "scene.snapshot"),
    "velocity": (lambda s: setattr(s.body("block"), "velocity", np.zeros(3)), "call sim.set_state"),
    "set_contact": (lambda s: s.set_contact("block", "ball", friction=1), "call sim.set_contact"),
    "add_tendon": (lambda s: s.add_tendon([("block", 0), ("other", 1)], 1.0), "call sim.set_tension"),
    "material": (lambda s: setattr(s.body("block"), "material", rubber()), "call sim.set_material"),
    "fix": (lambda s: s.body("block").fix([3]), "scene.snapshot"),
    "add_force": (lambda s: s.body("block").add_force([3], (0, 0, 0)), "call sim.set_force"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_changes_to_a_frozen_scene_are_refused_and_to_its_copies_allowed(frozen, name):
    scene, sim, before = frozen
    change, instead = CHANGES[name]
    message = f"^(scene|body 'block'): {name} cannot (change|be called) any more, since a Simulator has .*{instead}"
    for target in (scene, sim.scene):
        with pytest.raises(SceneError, match=message):
            change(target)
        assert target.gravity.tolist() == before.gravity.tolist() and target.contact_pairs == before.contact_pairs
        assert [b.name for b in target.bodies] == ["block", "other"] and len(target.body("block").forces) == 1
    picklable = scene.snapshot()
    picklable.body("block").remove(*picklable.body("block").constraints[1:])  # its path is a lambda
    pickled = pickle.loads(pickle.dumps(picklable))
    for copied in (before.snapshot(), scene.snapshot(), copy.deepcopy(scene), pickled, with_order(scene, 1)):
        change(copied)
    if hasattr(scene, name):  # a shallow copy shares its bodies
        change(copy.copy(scene))


def test_arrays_of_a_frozen_scene_and_of_records_are_read_only(frozen):
    scene = frozen[0]
    body, spring = scene.body("block"), scene.springs[0]
    arrays = [scene.gravity, body.position, body.velocity, body.rest_positions, body.mesh.vertices, spring.points[0].position]
    records = (*body.forces, *body.tractions, *body.constraints, *scene.attachments, *scene.tendons)
    records += (ts.Box((0, 0, 0), (1, 1, 1)), *copies(ts.KeyFrames([0], [(0, 0, 0)], [(0, 0, 1)])))
    for one in (*records, *copies(ts.MeshObstacle(np.eye(3), [(0, 1, 2)]))):
        found = [value for value in vars(one).values() if isinstance(value, np.ndarray)]
        assert found
        arrays += found
    assert not any(array.flags.writeable for array in arrays)
    copied = scene.snapshot()
    copied.gravity[1] = copied.body("block").velocity[0] = 0.0
    assert scene.gravity[1] == -9.81


def test_set_methods_change_the_simulators_copy_alone(changed):
    scene, sim, before = changed
    sim.set_gravity((0, -1, 0))
    with pytest.warns(UserWarning, match="body 'block': poisson = 0.495 is at least 0.45.*of a body that starts so") as caught:
        sim.set_material("block", young=2e4, poisson=0.495)
    assert caught[0].filename == __file__ and sim.scene.snapshot().body("block").dilatation == "local"  # as decided at the start
    sim.set_contact("block", "ball", friction=0.1)
    sim.set_force("block", 0, (2, 0, 0))
    sim.set_tension("line", 3.0)
    block = sim.scene.body("block")
    assert (sim.scene.gravity[1], block.material.young, block.forces[0].value[0], sim.scene.tendons[0].value) == (-1, 2e4, 2, 3.0)
    assert sim.scene.contact_numbers("block", "ball")[0] == 0.1 and scene_digest(scene) == scene_digest(before)
    with pytest.raises(SimulationError):
        sim.set_material("block", young=1e13)  # unstable at this dt
    assert block.material.young == 2e4 and not sim.scene.gravity.flags.writeable
    with pytest.raises(SceneError, match="cannot change any more"):
        sim.scene.gravity = (0, 0, 0)


def test_only_a_successful_construction_freezes(frozen):
    scene = loaded()
    for settings in ({"integrator": "nope"}, {"dt": 1.0, "integrator": "symplectic_euler", "precision": "f64"}):
        with pytest.raises(SimulationError):
            ts.Simulator(scene, **settings)
    scene.gravity[1] = -1.0
    scene.bodies[0].fix([5])
    with ts.Simulator(frozen[0], DT, "symplectic_euler", precision="f64") as second:  # from a frozen scene
        assert second.scene.gravity[1] == -9.81
