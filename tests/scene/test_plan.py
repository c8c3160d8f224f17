"""The plan lists each feature, whether it is on and why; features that are off allocate nothing."""

import numpy as np

import taisoft as ts
from taisoft.scene.plan import make_plan
from tests.dynamics.scenes import block_scene, connected_scene, cube, driven_scene, mixed_scene, rubber


def entries(scene: ts.Scene, explicit: bool = True, **options) -> dict[str, tuple[bool, str]]:
    """feature -> (on, why)."""
    return {e["feature"]: (e["on"], e["why"]) for e in make_plan(scene, explicit, False, **options).entries}


def test_reasons():
    found = entries(mixed_scene(mass_damping=1.0))
    assert found == {
        "law:st_venant_kirchhoff": (True, "used by block, flyer"),
        "law:corotational": (True, "used by tower"),
        "law:stable_neo_hookean": (True, "used by beam"),
        "elasticity_by_tet": (False, "every body has one young and one poisson"),
        "volume_floor": (False, "every volume_floor is 0"),
        "mean_dilatation": (False, "every body has local dilatation"),
        "quadratic_tets": (False, "every body is of order 1"),
        "consistent_weight": (False, "on linear tets it is the lumped mass"),
        "consistent_mass": (False, "the mass of linear tets is lumped"),
        "loads": (True, "tractions or forces on beam, block"),
        "pressure": (False, "no surface is under pressure"),
        "load_paths": (False, "every load is constant"),
        "fixed_nodes": (True, "on beam, block, tower"),
        "moving_nodes": (False, "no node follows a path"),
        "mass_damping": (True, "material of beam, tower"),
        "stiffness_damping": (False, "every stiffness_damping is 0"),
        "springs": (False, "no spring, tendon or attachment by springs"),
        "dependent_nodes": (False, "no node is attached exactly, and no surface embedded"),
        "rigid_bodies": (False, "every body is elastic"),
        "rigid_damping": (False, "no impact strains a rigid body"),
        "rigid_motion": (False, "every body is elastic"),
        "spring_damping": (False, "no spring or attachment is damped"),
        "assembled_stiffness": (False, "explicit steps need forces only"),
        "past_states": (False, "a one-step integrator"),
        "inversion_handling": (False, found["inversion_handling"][1]),
        "obstacles": (False, "the scene has none"),
        "distance_fields": (False, "every body is hit by proximity"),
        "proximity": (True, "hits beam, block, tower, flyer"),
        "self_collision": (False, "not requested"),
        "contact_forces": (False, "the scene's contact_forces are off"),
    }
    connected = entries(connected_scene(damping=2.0))
    assert connected["springs"] == (True, "pushes, pulls, within a tet and 6 more")
    mixed = mixed_scene(order="both")
    assert entries(mixed, explicit=True)["consistent_mass"] == (False, "explicit steps need a diagonal mass")
    assert entries(mixed, explicit=False)["consistent_mass"] == (True, "quadratic tets of beam, tower in implicit steps")
    assert connected["spring_damping"] == (True, "pushes, pulls, at one place and 2 more")


def test_every_feature_can_be_on_and_off():
    off = make_plan(block_scene(), explicit=True, multistep=False).on
    full = driven_scene(order=2, mass_damping=1.0, stiffness_damping=1.0, connected=True)
    full.add_spring(("beam", 0), ("flyer", 0), 1.0, damping=1.0)
    full.add_body(full.body("beam").mesh, full.body("beam").material, name="twin", position=full.body("beam").position)
    full.attach("twin", [0], "beam")
    full.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    full.body("beam").young = np.full(full.body("beam").mesh.n_tets, 1e5)
    full.body("beam").add_force([4], lambda t: (t, 0, 0))
    full.body("beam").add_pressure([4], 1.0)
    full.body("beam").collision, full.contact_forces = "distance_field", True
    full.add_body(cube((9, 0, 0)), rubber(volume_floor=0.1), dilatation="mean")
    full.add_rigid_body(cube((19, 0, 0)))
    on = make_plan(full, explicit=False, multistep=True, self_collision=True).on
    laws = {name for name in on if name.startswith("law:")}
    on["rigid_motion"] |= make_plan(full, explicit=True, multistep=False).on["rigid_motion"]
    assert {name for name in on if not on[name]} < laws and {name for name in off if off[name]} < laws


def contact_plan(bodies=(), obstacles=(), self_collision=False) -> dict[str, tuple[bool, str]]:
    """bodies: pairs of a name and a `collision` mode."""
    scene = ts.Scene()
    for name, collision in bodies:
        scene.add_body(ts.ball_mesh(1.0, 8), rubber(), name=name, collision=collision)
    for shape in obstacles:
        scene.add_obstacle(shape)
    return entries(scene, self_collision=self_collision)


def test_contact_features_are_on_if_something_can_touch():
    plane, box, ball = ts.HalfSpace((0, 0, 0), (0, 1, 0)), ts.Box((0, 0, 0), (1, 1, 1)), ("ball", "distance_field")
    alone = contact_plan([ball])
    assert alone["distance_fields"] == alone["proximity"] == (False, "no triangles can hit a body")
    assert alone["contact_forces"] == (False, "one body, and nothing that it could touch") and not alone["obstacles"][0]
    # a half-space has no triangles: the body's triangles hit the half-space, nothing hits the body
    grounded = contact_plan([ball], [plane, ts.Sphere((0, 0, 0), 1), ts.Capsule((0, 0, 0), (1, 0, 0), 1)])
    assert grounded["obstacles"] == (True, "obstacle0, obstacle1, obstacle2")
    assert not grounded["distance_fields"][0] and not grounded["proximity"][0]
    assert grounded["contact_forces"] == (True, "ball, obstacle0, obstacle1 and 1 more can touch")
    boxed = contact_plan([ball], [plane, box])
    assert boxed["distance_fields"] == (True, "hits ball (requested)") and boxed["proximity"] == (True, "hits obstacle1 (edges)")
    two = contact_plan([ball, ("block", "proximity"), ("sheet", "auto")])
    assert two["distance_fields"] == (True, "hits ball (requested)") and two["proximity"] == (
        True,
        "hits block (requested), sheet",
    )
    meshed = contact_plan([ball], [ts.MeshObstacle(*box.surface())])
    assert meshed["proximity"] == (True, "hits obstacle0 (triangles)") and meshed["distance_fields"][0]
    itself = contact_plan([("ball", "auto")], self_collision=True)
    assert itself["proximity"] == (True, "hits every body (itself)") and itself["self_collision"] == (True, "requested")
    assert itself["contact_forces"] == (True, "it can touch itself")


def test_a_simulator_allocates_what_its_scene_needs():
    """In double precision at most 1.5 kB per tet, which is less than 1 kB in single precision."""
    bodies = ts.Scene()
    bodies.add_body(ts.box_mesh((24, 6, 6), (4, 1, 1)), rubber()).fix(lambda X: X[:, 0] < -1.99)
    driven = driven_scene(mass_damping=1.0, stiffness_damping=1e-3, connected=True)
    kinds = ["damping", "loads", "spring", "stage_moved"]
    for scene, expected in ((bodies, []), (driven, kinds)):
        with ts.Simulator(scene, dt=1e-4, integrator="implicit_euler", precision="f64") as sim:
            fields = sim.field_bytes
        assert [kind for kind in kinds if any(field.startswith(kind) for field in fields)] == expected
        assert scene is driven or 500 < sum(fields.values()) / scene.bodies[0].mesh.n_tets < 1500  # [bytes]
