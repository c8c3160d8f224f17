"""Numbers of a scene by name: each can be set, alone, and is then what a scene made with it has; others are refused."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import restore_numbers
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.material import FIBRE_NUMBERS
from taisoft.scene.numbers import scene_numbers, set_numbers
from tests.dynamics.scenes import cube, halved, rubber


def scene() -> ts.Scene:
    """With a number of every kind."""
    made = ts.Scene()
    body = made.add_body(cube(), rubber(), name="body")
    body.add_force([0, 1], np.ones((2, 3)))
    body.add_force([2], lambda t: (t, 0.0, 0.0))
    body.add_traction([0], (1.0, 2.0, 3.0))
    body.add_pressure([1], 5.0)
    made.add_body(halved(cube()), {"left": rubber(), 7: rubber(density=900.0)}, name="two", position=(3, 0, 0))
    made.add_body(cube(), rubber(), name="by tet", young=np.linspace(1e5, 2e5, 5), position=(6, 0, 0))
    made.add_rigid_body(cube(), density=500.0, name="rigid", position=(9, 0, 0), angular_velocity=(0, 1, 0)).add_force(
        None, (1, 0, 0)
    )
    muscle = rubber(fibre_stiffness=1e4, active_stress=1e4)
    made.add_body(halved(cube()), {"left": muscle, 7: muscle}, name="muscle", position=(12, 0, 0), fibres=(1, 0, 0)).activate(
        0.5, 7
    )
    made.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name="a.ball", friction=0.4)
    made.add_spring(("body", 0), ("two", 0), 10.0, rest_length=0.1, name="spring")
    made.add_tendon([("body", 0), ("body", 1)], length=2.0, stiffness=4.0, name="rope")
    made.attach("two", [1], "a.ball", stiffness=3.0, name="joint")
    made.attach("two", [2], "a.ball", name="exact")
    made.set_contact("body", "a.ball", friction=0.3)
    return made


REGIONAL = ("young", "poisson", "density", "volume_floor")
NO_NUMBERS = ("law", "parameters", "branches", *FIBRE_NUMBERS)
PLAIN = [field.name for field in dataclasses.fields(ts.Material) if field.name not in NO_NUMBERS]
EXPECTED = {
    *(f"{name}.{number}" for name in ("body", "two", "by tet", "muscle") for number in PLAIN),
    *(f"{name}.{region}.{number}" for name in ("two", "muscle") for region in ("left", 7) for number in REGIONAL),
    *(f"muscle.{region}{number}" for region in ("", "left.", "7.") for number in (*FIBRE_NUMBERS, "activation")),
    *(f"rigid.{number}" for number in ("density", "friction", "restitution", "young")),
    *("gravity", "body.force.0", "body.force.1", "body.traction.0", "body.pressure.0", "rigid.force.0"),
    *("a.ball.friction", "a.ball.restitution", "spring.stiffness", "spring.rest_length", "spring.damping"),
    *("rope.length", "rope.stiffness", "joint.stiffness", "joint.damping"),
    *("contact.a.ball.body.friction", "contact.a.ball.body.restitution"),
}


def test_every_number_can_be_set_and_no_other_changes():
    """Of a whole body, also those of its regions, and of a region that of the whole body, which is then none or both's."""
    before = scene_numbers(scene())
    assert set(before) == EXPECTED and before["two.density"] is None and before["by tet.young"].shape == (5,)
    digests = {scene_digest(scene())}
    for name, old in before.items():
        made, value = scene(), np.full(3, 2.0) if name == "body.force.1" else 0.25
        if old is not None and np.any(old):
            value = np.multiply(old, 0.9)
        set_numbers(made, {name: value})
        now, owner, number = scene_numbers(made), name.split(".")[0], name.split(".")[-1]
        changed = {one for one in before if not np.array_equal(now[one], before[one])} - {name}
        assert np.array_equal(now[name], value), name
        assert changed <= {f"{owner}.{part}{number}" for part in ("", "left.", "7.") if owner in ("two", "muscle")}, name
        digests.add(scene_digest(made))
    assert len(digests) == len(before) + 1


def test_a_number_that_is_set_is_that_of_a_scene_made_with_it():
    made, left = scene(), 1234.0
    set_numbers(
        made, {"rigid.density": 700, "rigid.young": 1e9, "by tet.young": 3e5, "two.left.density": left, "body.poisson": 0.47}
    )
    rigid = ts.Scene().add_rigid_body(cube(), density=700, young=1e9, angular_velocity=(0, 1, 0))
    for name in ("mass", "density", "young"):
        assert getattr(made.body("rigid"), name) == pytest.approx(getattr(rigid, name), rel=1e-12)
    assert np.allclose(made.body("rigid").inertia, rigid.inertia) and made.body("rigid").start_twist.angular_velocity[1] == 1.0
    assert made.body("by tet").young == 3e5 and set(made.body("two").density) == {left, 900.0}
    assert made.body("body").dilatation == "mean" and made.body("rigid").forces
    set_numbers(made, {"two.young": 5e4, "contact.two.body.restitution": 0.5})
    assert set(made.body("two").young) == {5e4} and made.contact_numbers("body", "two")[1] == 0.5


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("body.yuong", 1.0, "the scene has no number 'body.yuong' (did you mean body.young?)"),
        ("zzz", 1.0, "the scene has no number 'zzz'; it has gravity, body.young, body.poisson, ..."),
        ("body.young", -1.0, "body 'body': young must be greater than 0 Pa, not -1.0"),
        ("two.left.friction", 0.1, "the scene has no number 'two.left.friction' (did you mean two.friction?)"),
        ("rigid.density", 0.0, "rigid body 'rigid': density must be greater than 0 kg/m^3, not 0.0"),
        ("gravity", 3.0, "scene: gravity must have shape (3,), not ()"),
        ("body.traction.0", [1.0, 2.0], "body 'body': set_traction: traction 0 must have shape (3,), not (2,)"),
        ("a.ball.restitution", 2.0, "'a.ball': restitution must be at least 0 and at most 1, not 2.0"),
        ("rope.length", 0.0, "tendon 'rope': length"),
        ("contact.a.ball.bode.friction", 0.1, "no body or obstacle is called 'bode' (did you mean body?)"),
        ("contact.a.ball.friction", 0.1, "no body or obstacle is called"),
    ],
)
def test_other_names_and_values_are_refused(name, value, message):
    made = scene()
    before = scene_digest(made)
    with pytest.raises(ts.SceneError) as caught:
        set_numbers(made, {name: value})
    assert message in str(caught.value) and "\n" not in str(caught.value) and scene_digest(made) == before


def test_a_checkpoint_brings_back_regions_whose_numbers_were_given_by_tet():
    made = ts.Scene()
    made.add_body(halved(cube()), {"left": rubber(), 7: rubber()}, name="two", young=np.linspace(1e5, 2e5, 5))
    changed = made.snapshot()
    set_numbers(changed, {"two.young": 1e5})
    set_numbers(changed, {"two.left.young": 3e5})
    restore_numbers(SimpleNamespace(numbers=scene_numbers(changed)), made)
    assert np.array_equal(made.bodies[0].young, changed.bodies[0].young) and np.ptp(made.bodies[0].young) > 1e5


def test_two_numbers_of_one_name_are_refused():
    made = ts.Scene()
    made.add_body(halved(cube()), {"left": rubber(), 7: rubber()}, name="two")
    made.add_body(cube(), rubber(), name="two.left", position=(3, 0, 0))
    with pytest.raises(ts.SceneError, match="two numbers of the scene are called 'two.left.young'"):
        scene_numbers(made)
