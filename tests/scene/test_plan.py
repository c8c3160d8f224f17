"""A simulator allocates and launches only what its scene needs:

* the plan lists each feature, whether it is on and why, with the bodies that need it;
* features that are off allocate no field and launch no kernel; features that are on do;
* a simulator takes less than 1 kB per tet.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.scene.plan import make_plan
from tests.dynamics.scenes import block_scene, connected_scene, cube, driven_scene, mixed_scene, rubber

# field names of each feature
LOADS, DAMPING = {"loads"}, {"damping", "node_body"}
PRESCRIBED = {"prescribed_nodes", "prescribed_axes", "targets", "position_before"}
HELD, VERLET, DAMPED_VERLET = {"held", "held_velocity", "reaction"}, {"acceleration"}, {"half_velocity"}


def test_reasons():
    plan = make_plan(mixed_scene(mass_damping=1.0), explicit=True, multistep=False)
    entries = {e["feature"]: (e["on"], e["why"]) for e in plan.entries}
    assert entries == {
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
        "inversion_handling": (False, entries["inversion_handling"][1]),
        "obstacles": (False, "the scene has none"),
        "distance_fields": (False, "every body is hit by proximity"),
        "proximity": (True, "hits beam, block, tower, flyer"),
        "self_collision": (False, "not requested"),
        "contact_forces": (False, "the scene's contact_forces are off"),
    }
    assert plan.on["loads"] is True and plan.on["moving_nodes"] is False


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


def test_connections_are_named():
    entries = {e["feature"]: (e["on"], e["why"]) for e in make_plan(connected_scene(damping=2.0), True, False).entries}
    assert entries["springs"] == (True, "pushes, pulls, within a tet and 6 more")
    assert entries["spring_damping"] == (True, "pushes, pulls, at one place and 2 more")


def test_quadratic_bodies_get_a_consistent_mass_in_implicit_steps_only():
    scene = mixed_scene(order="both")
    names = ", ".join(b.name for b in scene.bodies if b.order == 2)
    for explicit in (True, False):
        plan = make_plan(scene, explicit=explicit, multistep=False)
        entries = {e["feature"]: (e["on"], e["why"]) for e in plan.entries}
        assert entries["quadratic_tets"] == (True, f"bodies of order 2: {names}")
        assert entries["consistent_mass"][0] is entries["consistent_weight"][0] is (not explicit)
    assert entries["consistent_mass"][1] == f"quadratic tets of {names} in implicit steps"


def test_long_lists_of_names_are_shortened():
    scene = ts.Scene()
    for _ in range(6):
        scene.add_body(cube(), rubber())
    entries = {e["feature"]: e["why"] for e in make_plan(scene, explicit=True, multistep=False).entries}
    assert entries["law:stable_neo_hookean"] == "used by body0, body1, body2 and 3 more"


def contact_plan(bodies=(), obstacles=(), self_collision=False) -> dict[str, tuple[bool, str]]:
    """feature -> (on, why) of the contact features; bodies: pairs of a name and a `collision` mode."""
    scene = ts.Scene()
    for name, collision in bodies:
        scene.add_body(ts.ball_mesh(1.0, 8), rubber(), name=name, collision=collision)
    for shape in obstacles:
        scene.add_obstacle(shape)
    entries = make_plan(scene, explicit=True, multistep=False, self_collision=self_collision).entries
    return {e["feature"]: (e["on"], e["why"]) for e in entries[-5:]}


def test_contact_features_are_on_if_something_can_touch():
    plane, box = ts.HalfSpace((0, 0, 0), (0, 1, 0)), ts.Box((0, 0, 0), (1, 1, 1))
    ball = ("ball", "distance_field")
    alone = contact_plan([ball])
    assert not any(on for on, _ in alone.values())
    assert alone["distance_fields"] == alone["proximity"] == (False, "no triangles can hit a body")
    assert alone["contact_forces"] == (False, "one body, and nothing that it could touch")
    # a half-space has no triangles: the body's triangles hit the half-space, nothing hits the body
    grounded = contact_plan([ball], [plane, ts.Sphere((0, 0, 0), 1), ts.Capsule((0, 0, 0), (1, 0, 0), 1)])
    assert grounded["obstacles"] == (True, "obstacle0, obstacle1, obstacle2")
    assert not grounded["distance_fields"][0] and not grounded["proximity"][0]
    assert grounded["contact_forces"] == (True, "ball, obstacle0, obstacle1 and 1 more can touch")
    boxed = contact_plan([ball], [plane, box])
    assert boxed["distance_fields"] == (True, "hits ball (requested)")
    assert boxed["proximity"] == (True, "hits obstacle1 (edges)")
    two = contact_plan([ball, ("block", "proximity"), ("sheet", "auto")])
    assert two["distance_fields"] == (True, "hits ball (requested)")
    assert two["proximity"] == (True, "hits block (requested), sheet")


def test_mesh_obstacles_and_self_collision_need_proximity():
    vertices, triangles = ts.Box((0, 0, 0), (1, 1, 1)).surface()
    meshed = contact_plan([("ball", "distance_field")], [ts.MeshObstacle(vertices, triangles)])
    assert meshed["proximity"] == (True, "hits obstacle0 (triangles)") and meshed["distance_fields"][0]
    itself = contact_plan([("ball", "auto")], self_collision=True)
    assert itself["proximity"] == (True, "hits every body (itself)") and itself["self_collision"] == (True, "requested")
    assert itself["contact_forces"] == (True, "it can touch itself")
    assert itself["distance_fields"] == (False, "no triangles can hit a body")


@pytest.mark.parametrize("integrator", [*EXPLICIT, "implicit_euler", "bdf2"])
def test_features_that_are_off_allocate_nothing(integrator):
    with ts.Simulator(block_scene(), dt=1e-3, integrator=integrator) as sim:
        fields = set(sim.field_bytes)
        assert all(size > 0 for size in sim.field_bytes.values())
    assert not any(field.startswith(("spring", "amplitude")) for field in fields)
    assert not fields & (LOADS | DAMPING | PRESCRIBED | HELD | DAMPED_VERLET) and not any(f.startswith("damping") for f in fields)
    assert bool(fields & VERLET) == (integrator == "velocity_verlet")
    assert any(f.startswith("stiffness") for f in fields) == any(f.startswith("pcg") for f in fields)
    assert any(f.startswith("stiffness") for f in fields) == (integrator not in EXPLICIT)
    assert ("x_before" in fields) == (integrator == "bdf2")


def test_features_that_are_on_allocate_their_fields():
    scene = driven_scene(mass_damping=1.0, stiffness_damping=1e-3)
    with ts.Simulator(scene, dt=1e-4, integrator="velocity_verlet") as sim:
        assert LOADS | DAMPING | PRESCRIBED | HELD | VERLET | DAMPED_VERLET <= set(sim.field_bytes)


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler"])
def test_connections_allocate_their_fields_and_damping_what_it_needs(integrator):
    sizes = []
    for damping in (0.0, 1.0):
        with ts.Simulator(connected_scene(damping=damping), dt=1e-4, integrator=integrator) as sim:
            fields = sim.field_bytes
        assert {"spring_node", "spring_pull", "amplitudes"} <= set(fields) and "amplitude_rows" not in fields
        assert ("spring_pair_at" in fields) == (integrator == "implicit_euler")
        sizes.append(fields)
    assert (sizes[0].keys() ^ sizes[1].keys()) == (DAMPED_VERLET if integrator == "velocity_verlet" else set())


def launched(sim, steps: int) -> dict[str, int]:
    """kernel -> launches in a number of steps."""
    before = dict(runtime.launches)
    for _ in range(steps):
        sim.step()
    return {k: n - before.get(k, 0) for k, n in runtime.launches.items() if n > before.get(k, 0)}


def test_an_explicit_step_is_one_launch_besides_its_report():
    with ts.Simulator(block_scene(), dt=1e-3, integrator="symplectic_euler") as sim:
        assert launched(sim, 3) == {"advance_serial": 3, "measure": 3}


def test_an_implicit_step_launches_only_the_kernels_it_needs():
    with ts.Simulator(block_scene(), dt=1e-3, integrator="implicit_euler") as sim:
        sim.set_gravity((0, 0, 0))
        at_rest = launched(sim, 2)
        # the residual at rest is zero, so nothing is solved
        assert at_rest.keys() == {"begin_step", "begin_stage", "move", "form_residual", "measure"}
        assert set(at_rest.values()) == {2}
        sim.set_gravity((0, -9.81, 0))
        sim.set_state(velocities=0.1 * sim.positions())
        falling = launched(sim, 2)
        assert falling["assemble"] >= 1 and falling["iterate_kernel"] >= 1
        # no second matrix without damping, no backtracking with a falling residual, no contact kernels without contacts
        assert falling["assemble"] <= falling["form_residual"] == falling["move"]
        assert not {"update_impulses", "advance", "begin_linearised", "save_diagonal"} & falling.keys()
        assert falling["measure"] == 2 and "finish_midpoint" not in falling and "elastic_forces" not in falling


def test_a_simulator_takes_less_than_1_kilobyte_per_tet():
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((24, 6, 6), (4, 1, 1)), rubber())
    body.fix(lambda X: X[:, 0] < -1.99)
    with ts.Simulator(scene, integrator="implicit_euler", precision="f32") as sim:
        size = sum(sim.field_bytes.values()) / body.mesh.n_tets
    assert 300 < size < 1000  # [bytes per tet]
