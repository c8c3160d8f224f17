"""Forces, torques and slip velocities of pairs, against closed forms; energies of bodies; details of a run's reports."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.part_check import BLOCKED, PartCheck
from taisoft.fem.reference import consistent_mass, gravity_mass, lumped_mass, shape_gradients

G, MU, SPEED, SIDE = 9.81, 0.3, 0.4, 0.1


def resting_and_pulled() -> ts.Scene:
    """A soft cube with a rigid one on it, a soft one with a skin that is pulled over the ground, and one held on a turntable."""
    scene, mesh = ts.Scene(), ts.box_mesh((2, 2, 2), (SIDE, SIDE, SIDE))
    soft = ts.Material(young=2e5, density=800.0, friction=MU, mass_damping=20.0)
    scene.add_body(mesh, soft, name="cube", position=(0, 0.0505, 0))
    scene.add_rigid_body(mesh, density=500.0, name="top", position=(0, 0.1515, 0), friction=MU)
    sled = scene.add_body(mesh, soft, name="sled", position=(1, 0.0505, 0), order=2)
    inner = ts.box_mesh((1, 1, 1), (0.09, 0.1, 0.09))
    sled.embed(ts.SurfaceMesh(inner.vertices, inner.surface), contact=True)
    held = scene.add_body(mesh, soft, name="held", position=(3.5, 0.0705, 0))
    for body, path in ((sled, lambda t: (SPEED * t, 0, 0)), (held, lambda t: (0, 0, 0))):
        body.move(lambda X: X[:, 1] > 0.049, path, axes="xz")
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=MU)
    turn = ts.KeyFrames((0, 10), [(0, 0, 0)] * 2, [(0, 0, 0), (0, 10 * SPEED, 0)])  # SPEED is in rad/s, and in m/s at 1 m
    scene.add_obstacle(ts.Box((2.5, 0.01, 0), (1.2, 0.01, 1)), name="table", friction=MU, path=turn)
    return scene


@pytest.fixture(scope="module", params=["implicit_euler", "symplectic_euler"])
def sim(request):
    explicit = request.param == "symplectic_euler"
    with ts.Simulator(resting_and_pulled(), dt=2e-4 if explicit else 1 / 120, integrator=request.param, precision="f64") as sim:
        sim.run(0.04 if explicit else 0.5, fps=100)
        yield sim


def mass_times(sim, name, v):
    body = sim.scene.body(name)
    return consistent_mass(body) @ v if body.order == 2 and not sim.settings.explicit else lumped_mass(body)[:, None] * v


def check_closed_forms(sim):
    weight = {body.name: G * body.mass for body in sim.scene.bodies}
    for other, load in {"ground": weight["cube"] + weight["top"], "top": -weight["top"]}.items():
        assert sim.contact_force("cube", other) == pytest.approx([0, load, 0], abs=1e-4 * weight["cube"])
        assert np.abs(sim.contact_torque("cube", other)).max() < 1e-4 * SIDE * weight["cube"]
        assert np.abs(sim.slip_velocity("cube", other)).max() < 1e-5
    drag, load, _ = sim.contact_force("sled", "ground")
    assert load == pytest.approx(weight["sled"], rel=5e-3) and drag == pytest.approx(-MU * load, rel=1e-5)
    assert sim.slip_velocity("sled", "ground") == pytest.approx([SPEED, 0, 0], abs=0.01 * SPEED)


def test_forces_torques_and_slip_of_pairs(sim, monkeypatch):
    """Also as means over a step that is cut, as if a substep had ended too deep."""
    found, c, v = sim.pairs_in_contact(), sim.contacts(), sim.velocities()
    assert found == [("cube", "top"), ("cube", "ground"), ("sled", "ground"), ("held", "table")]
    turning = c.body_b == "table"
    own = np.einsum("cj,cji->ci", c.weights[turning, :3], v[c.nodes[turning, :3]])
    slip = own - np.cross([0, SPEED, 0], c.point[turning] - sim.scene.obstacle("table").shape.pivot)
    slip = np.average(slip * [1, 0, 1], axis=0, weights=(c.impulse * c.normal).sum(axis=1)[turning])
    assert slip[2] > 0.8 * SPEED and np.abs(sim.slip_velocity("held", "table") - slip).max() < 2e-3 * SPEED
    for query in (sim.contact_force, sim.slip_velocity):
        assert all(np.array_equal(query(a, b), -query(b, a)) for a, b in found) and not query("top", "table").any()
    torque = sum(sim.contact_torque("cube", other) for other in ("top", "ground"))
    assert np.abs(torque - sim.contact_torque("cube")).max() < 1e-9
    with pytest.raises(ts.SceneError, match="no body or obstacle is called 'sledge' .did you mean sled"):
        sim.slip_velocity("sledge")
    if not sim.settings.explicit:
        check_closed_forms(sim)
        monkeypatch.setattr(PartCheck, "certify", lambda *_: monkeypatch.undo() or BLOCKED)
        assert sim.step().substeps > 1 and sim.contacts().duration < sim.dt
        check_closed_forms(sim)


def test_energies_of_bodies_are_those_of_numpy_and_add_up(sim):
    total, own = sim.energies(), {body.name: sim.energies(body.name) for body in sim.scene.bodies}
    for name in ("kinetic", "elastic", "gravity", "loads"):
        assert sum(getattr(one, name) for one in own.values()) == pytest.approx(getattr(total, name), rel=1e-12)
    for name in ("cube", "sled"):
        body, x, v = sim.scene.body(name), sim.positions(name), sim.velocities(name)
        gradients, volumes = shape_gradients(body)
        F = np.einsum("mai,mqaj->mqij", x[body.nodes.elements], gradients).reshape(-1, 3, 3)
        psi, _ = ts.evaluate_law("stable_neo_hookean", F, 2e5, 0.3)
        assert own[name].elastic == pytest.approx(psi @ volumes.reshape(-1), rel=1e-9)
        assert own[name].kinetic == pytest.approx(0.5 * (v * mass_times(sim, name, v)).sum(), rel=1e-9)
        mass = lumped_mass(body) if sim.settings.explicit else gravity_mass(body)
        assert own[name].gravity == pytest.approx(G * mass @ x[:, 1], rel=1e-9)


def test_details_are_those_of_the_last_step_and_only_on_request(sim):
    queries = sim.contact_force, sim.contact_torque, sim.slip_velocity
    last = sim.run(0.01, fps=100, details=("pairs", "bodies")).step_reports[-1].details
    for axis, force, torque, slip in zip("xyz", *(query("sled", "ground") for query in queries)):
        assert last[f"force {axis} on sled by ground [N]"] == force and last[f"torque {axis} on sled by ground [N m]"] == torque
        assert last[f"slip velocity {axis} of sled on ground [m/s]"] == slip
    assert last["kinetic of top [J]"] == sim.energies("top").kinetic
    assert last["elastic of sled [J]"] == sim.energies("sled").elastic
    assert len(last) == 9 * len(sim.pairs_in_contact()) + 2 * len(sim.scene.bodies)
    assert sim.run(0.01, fps=100).step_reports[-1].details == {}
    with pytest.raises(ts.SceneError, match="details must be one of pairs, bodies, not 'pair'"):
        sim.run(0.01, details=("pair",))
