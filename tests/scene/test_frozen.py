"""Which attributes may be assigned, and when:

* assigning an unknown attribute of a scene, body, material, shape, obstacle, settings or simulator raises an error that suggests
  the nearest name; assigning a read-only one raises an error with the call to use; reading and copying work as in plain classes;
* a Simulator freezes its scene and its own copy: later changes to either, or to their bodies, are refused with the call to use;
  a failed construction, statics and modes do not freeze the scene, and a second Simulator can be made from it;
* snapshots, copies and pickles of a frozen scene can change, and the simulator's own set_ methods still work.
"""

import copy
import pickle

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import dynamics
from taisoft.errors import SceneError, SimulationError
from taisoft.scene.refine import with_order
from tests.dynamics.scenes import cube, rubber

DT = 1e-4


def loaded() -> ts.Scene:
    """A body with velocities, constraints and loads, a second body and an obstacle."""
    scene = ts.Scene()
    scene.contact_forces = False  # for shorter compilation
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


# --- unknown and read-only attributes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "select, name, message",
    [
        (lambda s: s, "gravty", "^scene has no attribute 'gravty'; did you mean 'gravity'[?]$"),
        (lambda s: s, "zzz", "^scene has no attribute 'zzz'$"),
        (lambda s: s, "_hidden", "^scene has no attribute '_hidden'$"),
        (lambda s: s.body("block"), "materal", "^body 'block' has no attribute 'materal'; did you mean 'material'[?]$"),
        (lambda s: s.body("block").material, "youngs", "^material has no attribute 'youngs'; did you mean 'young'[?]$"),
        (lambda s: s.body("block").material, "young", "^material: young cannot change: .*sim.set_material.body, young=...."),
        (lambda s: s.obstacle("ball"), "fricton", "^obstacle 'ball' has no attribute 'fricton'; did you mean 'friction'[?]$"),
        (lambda s: s.obstacle("ball"), "friction", "^obstacle 'ball': friction cannot change: .*scene.set_contact"),
        (lambda s: s.obstacle("ball").shape, "radios", "^sphere has no attribute 'radios'; did you mean 'radius'[?]$"),
        (lambda s: s.obstacle("ball").shape, "radius", "^sphere: radius cannot change: make another shape"),
        (lambda s: s.collision, "margn", "^collision settings has no attribute 'margn'; did you mean 'margin'[?]$"),
        (lambda s: s.collision, "margin", "^collision settings: margin cannot change: .*CollisionSettings.margin=...."),
        (lambda s: s.springs[0], "stifness", "^spring 'spring' has no attribute 'stifness'; did you mean 'stiffness'[?]$"),
        (
            lambda s: s.springs[0],
            "stiffness",
            "^spring 'spring': stiffness cannot change: remove it from its list and add another",
        ),
        (lambda s: s.springs[0].points[0], "position", "^point: position cannot change: remove it from its list and add another"),
        (lambda s: s.tendons[0], "value", "^tendon 'line': value cannot change: call sim.set_tension.name, force."),
        (lambda s: s.attachments[0], "nodes", "^attachment 'pins': nodes cannot change: remove it from its list and add another"),
        (lambda s: s.body("block").forces[0], "value", "^force: value cannot change: call sim.set_force"),
        (lambda s: s.body("block").tractions[0], "value", "^traction: value cannot change: call sim.set_traction"),
    ],
)
def test_unknown_and_read_only_attributes_of_a_scene_are_refused(select, name, message):
    target = select(loaded())
    before = dict(target.__dict__)
    with pytest.raises(SceneError, match=message) as caught:
        setattr(target, name, 1.0)
    assert isinstance(caught.value, AttributeError) and target.__dict__ == before


def test_shapes_and_key_frames_refuse_unknown_attributes():
    shapes = [
        ts.HalfSpace((0, 0, 0), (0, 1, 0)),
        ts.Sphere((0, 0, 0), 1),
        ts.Box((0, 0, 0), (1, 1, 1)),
        ts.Capsule((0, 0, 0), (1, 0, 0), 1),
        ts.MeshObstacle(np.eye(3), [(0, 1, 2)]),
        ts.KeyFrames([0], [(0, 0, 0)]),
    ]
    for shape in shapes:
        with pytest.raises(SceneError, match="has no attribute 'colour'$"):
            shape.colour = 1


def test_reading_an_unknown_attribute_is_a_plain_attribute_error():
    scene = loaded()
    assert not hasattr(scene, "gravty") and getattr(scene, "gravty", 7) == 7 and hasattr(scene.bodies[0], "material")
    with pytest.raises(AttributeError, match="object has no attribute 'gravty'"):
        _ = scene.gravty

    class Mine(ts.Scene):
        def __init__(self):
            super().__init__()
            self.colours = {}  # a subclass may add attributes

    assert Mine().colours == {}


# --- a frozen scene ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frozen():
    """A frozen scene, its simulator, and a copy from before."""
    scene = loaded()
    before = copy.deepcopy(scene)
    with ts.Simulator(scene, DT, "symplectic_euler", precision="f64") as sim:
        yield scene, sim, before


CHANGES = {
    "gravity": (lambda s: setattr(s, "gravity", (0, 0, 0)), "call sim.set_gravity"),
    "collision": (lambda s: setattr(s, "collision", ts.CollisionSettings()), "scene.snapshot"),
    "allow_initial_overlap": (lambda s: setattr(s, "allow_initial_overlap", True), "make a new Simulator"),
    "contact_forces": (lambda s: setattr(s, "contact_forces", True), "make a new Simulator"),
    "add_body": (lambda s: s.add_body(cube((0, 5, 0)), rubber()), "scene.snapshot"),
    "add_obstacle": (lambda s: s.add_obstacle(ts.Sphere((0, -20, 0), 1)), "scene.snapshot"),
    "set_contact": (lambda s: s.set_contact("block", "ball", friction=1), "call sim.set_contact"),
    "contact_pairs": (lambda s: s.contact_pairs.clear(), "call sim.set_contact"),
    "bodies": (lambda s: s.bodies.pop(), "scene.snapshot"),
    "obstacles": (lambda s: setattr(s, "obstacles", []), "scene.snapshot"),
    "add_spring": (lambda s: s.add_spring(("block", 0), ("other", 1), 1.0), "scene.snapshot"),
    "add_tendon": (lambda s: s.add_tendon([("block", 0), ("other", 1)], 1.0), "call sim.set_tension"),
    "attach": (lambda s: s.attach("block", [0], "ball", 1.0), "scene.snapshot"),
    "springs": (lambda s: setattr(s, "springs", []), "scene.snapshot"),
    "tendons": (lambda s: setattr(s, "tendons", []), "call sim.set_tension"),
    "attachments": (lambda s: s.attachments.append(1), "scene.snapshot"),
    "material": (lambda s: setattr(s.body("block"), "material", rubber()), "call sim.set_material"),
    "position": (lambda s: setattr(s.body("block"), "position", np.zeros(3)), "call sim.set_state"),
    "velocity": (lambda s: setattr(s.body("block"), "velocity", np.zeros(3)), "call sim.set_state"),
    "name": (lambda s: setattr(s.body("block"), "name", "b"), "scene.snapshot"),
    "fix": (lambda s: s.body("block").fix([3]), "scene.snapshot"),
    "move": (lambda s: s.body("block").move([3], lambda t: (0, 0, 0)), "scene.snapshot"),
    "add_force": (lambda s: s.body("block").add_force([3], (0, 0, 0)), "call sim.set_force"),
    "add_traction": (lambda s: s.body("block").add_traction([3], (0, 0, 0)), "call sim.set_traction"),
    "forces": (lambda s: s.body("block").forces.append(1), "call sim.set_force"),
    "tractions": (lambda s: s.body("block").tractions.__setitem__(0, 1), "call sim.set_traction"),
    "constraints": (lambda s: s.body("block").constraints.clear(), "scene.snapshot"),
    "mesh": (lambda s: delattr(s.body("block"), "mesh"), "scene.snapshot"),
}
ALWAYS_REFUSED = {
    "obstacles",
    "contact_pairs",
    "name",
    "forces",
    "tractions",
    "mesh",
    "springs",
    "tendons",
    "attachments",
}  # not assignable before freezing either


@pytest.mark.parametrize("name", CHANGES)
def test_changes_to_a_frozen_scene_are_refused(frozen, name):
    scene, sim, before = frozen
    change, instead = CHANGES[name]
    message = f"^(scene|body 'block'): {name} cannot (change|be called) any more, since a Simulator has .*{instead}"
    for target in (scene, sim.scene):
        with pytest.raises(SceneError, match=message):
            change(target)
        assert target.gravity.tolist() == before.gravity.tolist() and target.contact_pairs == before.contact_pairs
        assert [b.name for b in target.bodies] == ["block", "other"] and len(target.body("block").forces) == 1
    for copied in (before.snapshot(), scene.snapshot()):
        if name in ALWAYS_REFUSED:
            with pytest.raises(SceneError, match=f"{name} cannot be (set|changed by hand|deleted): (call|add)"):
                change(copied)
        else:
            change(copied)


def test_arrays_of_a_frozen_scene_are_read_only(frozen):
    scene, _, before = frozen
    body = scene.body("block")
    connections = scene.springs[0].points[0].position, scene.attachments[0].nodes
    with pytest.raises(ValueError, match="read-only"):
        scene.tendons[0].value[()] = 2.0
    arrays = (
        *connections,
        scene.gravity,
        body.position,
        body.velocity,
        body.forces[0].value,
        body.tractions[0].value,
        body.constraints[0].nodes,
    )
    for array in (*arrays, body.rest_positions, body.mesh.vertices):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    before.snapshot().gravity[1] = 0.0


def test_unknown_attributes_of_a_frozen_scene_are_still_reported_as_unknown(frozen):
    with pytest.raises(SceneError, match="^scene has no attribute 'gravty'"):
        frozen[0].gravty = 1


def test_copies_of_a_frozen_scene_can_change(frozen):
    scene = frozen[0]
    picklable = scene.snapshot()
    del picklable.body("block").constraints[1:]  # its path is a lambda
    for copied in (scene.snapshot(), copy.copy(scene), copy.deepcopy(scene), pickle.loads(pickle.dumps(picklable))):
        copied.gravity = (0, -1, 0)
        copied.add_obstacle(ts.Sphere((0, -20, 0), 1))
        copied.set_contact("block", "ball", friction=0.9)
        copied.bodies.pop()
    for copied in (scene.snapshot(), copy.deepcopy(scene)):
        copied.body("block").add_force([3], (0, 0, 0))
        copied.body("block").velocity[0] = 1.0
    assert scene.gravity[1] == -9.81 and len(scene.bodies) == 2 and len(scene.body("block").forces) == 1
    with_order(scene, 1).bodies[0].add_force([3], (0, 0, 0))


def test_set_methods_change_the_simulators_copy_alone(frozen):
    scene, sim, _ = frozen
    sim.set_gravity((0, -1, 0))
    sim.set_material("block", young=2e4)
    sim.set_contact("block", "ball", friction=0.1)
    sim.set_force("block", 0, (2, 0, 0))
    sim.set_tension("line", 3.0)
    assert (sim.scene.tendons[0].value, scene.tendons[0].value) == (3.0, 1.0)
    assert (sim.scene.gravity[1], sim.scene.body("block").material.young) == (-1, 2e4)
    assert sim.scene.contact_numbers("block", "ball")[0] == 0.1 and sim.scene.body("block").forces[0].value[0] == 2
    assert (scene.gravity[1], scene.body("block").material.young) == (-9.81, 1e5)
    for call in (
        lambda: sim.set_gravity("down"),
        lambda: sim.set_contact("block", "ball", friction=-1),
        lambda: sim.set_material("block", young=1e13),  # unstable at this dt
    ):
        with pytest.raises((SceneError, SimulationError)):
            call()
        assert sim.scene.body("block").material.young == 2e4
        with pytest.raises(SceneError, match="cannot change any more"):
            sim.scene.gravity = (0, 0, 0)
    with pytest.raises(ValueError, match="read-only"):
        sim.scene.gravity[1] = 0.0


def test_only_a_successful_construction_freezes(frozen, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("construction failed")

    scene = loaded()
    for settings in ({"integrator": "nope"}, {"dt": 1.0, "integrator": "symplectic_euler", "precision": "f64"}):
        with pytest.raises(SimulationError):
            ts.Simulator(scene, **settings)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="construction failed"):
        patch.setattr(dynamics, "make_stepper", fail)
        ts.Simulator(scene, DT, "symplectic_euler", precision="f64")
    held = ts.Scene()
    held.add_body(cube(), rubber()).fix(lambda X: X[:, 0] < 0)
    ts.solve_static(held)
    ts.modes(held, 1)
    for target in (scene, held):
        target.gravity[1] = -1.0
        target.bodies[0].fix([5])
    saved, first = tmp_path / "c.npz", frozen[1]
    first.save_checkpoint(saved)
    with ts.Simulator(frozen[0], DT, "symplectic_euler", precision="f64") as second:  # from a frozen scene
        assert second.scene.gravity[1] == -9.81
    again = loaded()
    with ts.Simulator.load_checkpoint(saved, again) as restored, pytest.raises(SceneError, match="sim.set_gravity"):
        assert restored.scene.gravity[1] == first.scene.gravity[1]
        again.gravity = (0, 0, 0)


@pytest.mark.parametrize(
    "name, message",
    [
        ("dtt", "^simulator has no attribute 'dtt'; did you mean 'dt'[?]$"),
        ("gravity", "^simulator has no attribute 'gravity': call sim.set_gravity.gravity.$"),
        ("gravty", "^simulator has no attribute 'gravty'; did you mean 'gravity'[?] .call sim.set_gravity.gravity..$"),
        ("young", "^simulator has no attribute 'young': call sim.set_material.body, young=....$"),
        ("friction", "^simulator has no attribute 'friction': call sim.set_contact"),
        ("integrator", "^simulator has no attribute 'integrator': call sim.rebuild.integrator=....$"),
        ("tension", "^simulator has no attribute 'tension': call sim.set_tension.name, force.$"),
        ("positions", "^simulator: positions is a method and cannot be set: call sim.set_state"),
        ("step", "^simulator: step is a method and cannot be set$"),
        ("time", "^simulator: time cannot be set: call sim.reset"),
        ("stable_dt", "^simulator: stable_dt cannot be set: .*set sim.dt"),
        ("compile_seconds", "^simulator: compile_seconds cannot be set: it is read-only$"),
        ("scene", "^simulator: scene cannot be set: make a new Simulator"),
        ("settings", "^simulator: settings cannot be set: call sim.rebuild"),
        ("plan", "^simulator: plan cannot be set: it follows"),
    ],
)
def test_unknown_and_read_only_attributes_of_a_simulator_are_refused(frozen, name, message):
    sim = frozen[1]
    with pytest.raises(SimulationError, match=message) as caught:
        setattr(sim, name, 1.0)
    assert isinstance(caught.value, AttributeError)
    sim.dt = sim.dt
    with pytest.raises(SceneError, match="^settings: dt cannot change: call sim.rebuild.dt=....$"):
        sim.settings.dt = 1.0


def test_a_method_may_be_replaced(frozen, monkeypatch):
    sim = frozen[1]
    with monkeypatch.context() as patch:
        patch.setattr(sim, "step", lambda: "stepped")
        assert sim.step() == "stepped"
    assert sim.step.__func__ is ts.Simulator.step
