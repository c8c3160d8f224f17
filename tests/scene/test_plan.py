"""The plan lists each feature, whether it is on and why; features that are off allocate nothing."""

import numpy as np

import taisoft as ts
from taisoft.scene.plan import make_plan
from tests.dynamics.scenes import block_scene, connected_scene, cube, driven_scene, mixed_scene, rubber


def entries(scene: ts.Scene, explicit: bool = True, **options) -> dict[str, tuple[bool, str]]:
    """feature -> (on, why)."""
    return {e["feature"]: (e["on"], e["why"]) for e in make_plan(scene, explicit, False, **options).entries}


def test_features_and_reasons_of_a_scene():
    found = entries(mixed_scene(mass_damping=1.0))
    assert {name: why for name, (on, why) in found.items() if on} == {
        "law:st_venant_kirchhoff": "used by block, flyer",
        "law:corotational": "used by tower",
        "law:stable_neo_hookean": "used by beam",
        "loads": "tractions or forces on beam, block",
        "fixed_nodes": "on beam, block, tower",
        "mass_damping": "material of beam, tower",
        "proximity": "hits beam, block, tower, flyer",
        "mortar": "mean gaps of beam, block, tower and 1 more to meshes",
    }
    assert found["contact_forces"][1] == "the scene's contact_forces are off"
    connected = entries(connected_scene(damping=2.0))
    assert connected["springs"] == (True, "pushes, pulls, within a tet and 6 more")
    assert connected["spring_damping"] == (True, "pushes, pulls, at one place and 2 more")
    mixed = mixed_scene(order="both")
    assert entries(mixed, explicit=True)["consistent_mass"] == (False, "explicit steps need a diagonal mass")
    for name in "cd":
        mixed.add_body(cube((9, 0, 0)), rubber(poisson=0.47), name=name, dilatation="auto" if name == "c" else "mean")
    why = "a poisson of at least 0.45 in linear tets of c; requested for d"
    assert entries(mixed)["mean_dilatation"] == (True, why)
    assert entries(mixed, explicit=False)["consistent_mass"] == (True, "quadratic tets of beam, tower in implicit steps")


def test_every_feature_can_be_on_and_off():
    off = make_plan(block_scene(), explicit=True, multistep=False).on
    full = driven_scene(order=2, mass_damping=1.0, stiffness_damping=1.0, connected=True)
    full.add_spring(("beam", 0), ("flyer", 0), 1.0, damping=1.0)
    full.add_body(full.body("beam").mesh, full.body("beam").material, name="companion", position=full.body("beam").position)
    full.attach("companion", [0], "beam")
    full.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    full.body("beam").young = np.full(full.body("beam").mesh.n_tets, 1e5)
    full.body("beam").add_force([4], lambda t: (t, 0, 0))
    full.body("beam").add_pressure([4], 1.0)
    full.body("beam").collision, full.contact_forces = "distance_field", True
    full.add_body(cube((9, 0, 0)), rubber(volume_floor=0.1, branches=((0.1, 0.5),)), dilatation="mean")
    full.add_rigid_body(cube((19, 0, 0)))
    full.add_body(cube((29, 0, 0)), rubber(active_stress=1.0), fibres=(1, 0, 0))
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
    assert two["distance_fields"][1] == "hits ball (requested)" and two["proximity"][1] == "hits block (requested), sheet"
    meshed = contact_plan([ball], [ts.MeshObstacle(*box.surface())])
    assert meshed["proximity"] == (True, "hits obstacle0 (triangles)") and meshed["distance_fields"][0]
    assert two["mortar"] == (True, "mean gaps of block, sheet to meshes") and not (boxed["mortar"][0] or meshed["mortar"][0])
    itself = contact_plan([("ball", "auto")], self_collision=True)
    assert itself["proximity"] == (True, "hits every body (itself)") and itself["self_collision"] == (True, "requested")
    assert itself["contact_forces"] == (True, "it can touch itself")


def test_a_simulator_allocates_what_its_scene_needs():
    kinds = ["damping", "loads", "spring", "stage_moved"]
    driven = driven_scene(mass_damping=1.0, stiffness_damping=1e-3, connected=True)
    for scene, expected in ((block_scene(), []), (driven, kinds)):
        with ts.Simulator(scene, dt=1e-4, integrator="implicit_euler", precision="f64") as sim:
            assert [kind for kind in kinds if any(field.startswith(kind) for field in sim.field_bytes)] == expected


def test_a_number_replaces_a_path_and_numbers_by_tet():
    scene = ts.Scene()
    body = scene.add_body(cube(), rubber(young=7.0), young=np.linspace(1.0, 2.0, 5))
    body.add_force([0, 1], lambda t: (t, 0.0, 0.0))
    with ts.Simulator(scene, dt=1e-4) as sim:
        sim.set_material(body.name, young=3.0)
        sim.set_force(body.name, 0, (0.0, 5.0, 0.0))
        body = sim.scene.body(body.name)
    assert np.unique(body.composition.number("young")).tolist() == [3.0]
    assert body.forces[0].path is None and np.array_equal(body.forces[0].value, (0.0, 5.0, 0.0))
