"""Forces of exact attachments as the whole constraint force:

* what one half of a body exerts on the other is minus what the other exerts on it, in motion, with other forces at the joint;
* it carries a weight, with damping and where attached nodes touch, and balances a part's momentum in every step;
* a chain passes forces on; tables are built once; the matrix knows pressures at attached nodes.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem import dependents, springs
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.reference import consistent_mass, lumped_mass
from taisoft.linear import block_csr
from tests.dynamics.scenes import dynamics, set_state

pytestmark = pytest.mark.filterwarnings("ignore:body")
TIGHT = {"precision": "f64", "newton_tolerance": 1e-12, "linear_tolerance": 1e-12}


def halves(turned: bool, order: int, busy: bool, **damping) -> ts.Scene:
    """A bar that is cut in two, the right half attached to the left one, or turned. busy: with springs and loads at the joint."""
    scene, material = ts.Scene(), ts.Material(young=1e5, poisson=0.3, density=1000.0, **damping)
    scene.contact_forces = False
    for name, x in (("left", 0.1), ("right", 0.3)):
        mesh = ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1), (x, 0.0, 0.0), pattern="six")
        scene.add_body(mesh, material, name=name, order=order)
    scene.body("left").fix(lambda X: X[:, 0] < 1e-9)
    a, b = ("left", "right") if turned else ("right", "left")
    scene.attach(a, lambda X: np.abs(X[:, 0] - 0.2) < 1e-9, b, name="joint")
    if busy:
        scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="pin")
        scene.add_spring(("right", (0.2, 0.05, 0.05)), ("pin", (0.2, 0.3, 0.2)), 200.0, rest_length=0.1, damping=3.0)
        scene.add_tendon([("left", (0.2, -0.05, 0.0)), ("pin", (0.3, -0.3, 0.1)), ("right", (0.4, -0.05, 0.0))], 2.0)
        scene.body("left").add_force(lambda X: X[:, 0] > 0.19, (0.0, 1.0, 2.0))
        scene.body("right").add_pressure(lambda c: c[:, 1] > 0.049, 500.0)
    return scene


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("busy", [False, True])
@pytest.mark.parametrize("damping", [{}, {"mass_damping": 5.0}, {"mass_damping": 5.0, "stiffness_damping": 0.01}])
def test_action_is_reaction(order, busy, damping):
    found = []
    for turned in (False, True):
        with ts.Simulator(halves(turned, order, busy, **damping), dt=2e-3, **TIGHT) as sim:
            forces = []
            for _ in range(8):
                assert sim.step().converged
                body = sim.scene.body(sim.scene.attachments[0].a)
                rows = sim.scene.attachments[0].nodes
                places = np.round(body.rest_positions[rows], 9)
                forces.append(sim.joint_force("joint")[np.lexsort(places.T)])
            found.append(np.array(forces))
    size = np.abs(found[0]).max()
    # the damping matrix is that of the start of the step, and here that of its end
    assert size > 0.05 and np.abs(found[0] + found[1]).max() < (2e-2 if "stiffness_damping" in damping else 1e-7) * size


def hung(order: int, integrator: str, **damping) -> ts.Scene:
    scene = ts.Scene()
    scene.contact_forces = False
    material = ts.Material(young=1e5, poisson=0.3, density=1000.0, **damping)
    plate = scene.add_body(ts.box_mesh((4, 1, 4), (0.3, 0.1, 0.3)), material, name="plate", position=(0, 0.1, 0))
    plate.fix(lambda X: X[:, 1] > 0.049)
    scene.add_body(ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1)), material, name="load", order=order)
    scene.attach("load", lambda X: X[:, 1] > 0.049, "plate", name="joint")
    return scene


@pytest.mark.parametrize(("integrator", "dt"), [("bdf2", 0.02), ("implicit_euler", 0.02), ("symplectic_euler", 1e-4)])
def test_a_damped_joint_carries_the_weight(integrator, dt):
    scene = hung(2 if integrator == "bdf2" else 1, integrator, mass_damping=20.0, stiffness_damping=2e-3)
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
        sim.run(seconds=1.0)
        weight = 9.81 * scene.body("load").mass
        assert np.linalg.norm(sim.joint_force("joint").sum(axis=0) - (0.0, weight, 0.0)) < 1e-4 * weight


@pytest.mark.parametrize("order", [1, 2])
def test_a_joint_balances_momentum_in_every_step(order):
    """Of a body with mass damping in a scene of free bodies, whose joint alone and a spring at it act from outside."""
    scene = hung(order, "implicit_euler", mass_damping=3.0, stiffness_damping=1e-3)
    scene.body("plate").constraints.clear()
    scene.add_spring(
        ("plate", (0.1, 0.0, 0.1)), ("load", (0.05, 0.05, 0.05)), 300.0, rest_length=0.05, damping=2.0, name="spring"
    )
    load = scene.body("load")
    M = consistent_mass(load) if order == 2 else np.diag(lumped_mass(load))
    with ts.Simulator(scene, dt=5e-3, **TIGHT) as sim:
        for _ in range(6):
            before = (M @ sim.velocities("load")).sum(axis=0)
            assert sim.step().converged
            after = (M @ sim.velocities("load")).sum(axis=0)
            outside = (after - before) / 5e-3 + 3.0 * after + (0.0, 9.81 * load.mass, 0.0) - sim.joint_force("joint").sum(axis=0)
            assert np.linalg.norm(outside) == pytest.approx(abs(sim.joint_force("spring")), rel=2e-5)


@pytest.mark.parametrize(("integrator", "dt"), [("bdf2", 0.005), ("implicit_euler", 0.005), ("symplectic_euler", 1e-4)])
def test_contacts_of_attached_nodes_count(integrator, dt):
    """All nodes of the pad are attached, and the block stands on it."""
    scene = ts.Scene()
    material = ts.Material(young=2e5, poisson=0.3, density=1000.0, mass_damping=40.0, friction=0.5)
    block = scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="block", position=(0.0, 0.051, 0.0))
    pad = scene.add_body(ts.box_mesh((2, 1, 2), (0.06, 0.02, 0.06)), material, name="pad", position=(0.0, 0.01, 0.0))
    scene.attach("pad", np.arange(pad.n_nodes), "block", name="joint")
    scene.add_obstacle(ts.HalfSpace((0.0, -1e-4, 0.0), (0.0, 1.0, 0.0)), name="ground")
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
        sim.run(seconds=0.6)
        contact, weight = sim.contact_force("pad"), 9.81 * (block.mass + pad.mass)
        assert contact[1] == pytest.approx(weight, rel=1e-3) and not sim.contact_force("block").any()
        expected = -contact + (0.0, 9.81 * pad.mass, 0.0)
        assert np.linalg.norm(sim.joint_force("joint").sum(axis=0) - expected) < 1e-4 * weight


def test_a_chain_passes_forces_on():
    """The lowest of three hangs on nodes that depend on the uppermost."""
    scene = ts.Scene()
    scene.contact_forces = False
    material = ts.Material(young=1e5, poisson=0.3, density=1000.0, mass_damping=20.0)
    top = scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="top")
    top.fix(lambda X: X[:, 1] > 0.049)
    scene.add_body(ts.box_mesh((2, 1, 2), (0.1, 0.05, 0.1)), material, name="middle", position=(0, -0.075, 0))
    scene.add_body(ts.box_mesh((1, 1, 1), (0.05, 0.1, 0.05)), material, name="low", position=(0.025, -0.0, 0.025))
    scene.attach("middle", lambda X: X[:, 1] > 0.024, "top", name="upper")
    scene.attach("low", lambda X: X[:, 1] < -0.049, "middle", name="lower")
    with ts.Simulator(scene, dt=0.02, integrator="bdf2", precision="f64") as sim:
        sim.run(seconds=1.0)
        masses = {body.name: 9.81 * body.mass for body in scene.bodies}
        lower, upper = (sim.joint_force(name).sum(axis=0) for name in ("lower", "upper"))
        assert lower == pytest.approx((0.0, masses["low"], 0.0), abs=1e-4 * masses["low"])
        assert upper == pytest.approx((0.0, masses["low"] + masses["middle"], 0.0), abs=1e-4 * masses["middle"])


def test_tables_are_built_once(monkeypatch):
    calls = []
    for module, name in ((dependents, "locate_nodes"), (springs, "locate")):
        original = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, f=original, name=name: (calls.append(name), f(*a))[1])
    scene = halves(False, 1, True)
    with ts.Simulator(scene, dt=2e-3, precision="f64") as sim:
        assert calls.count("locate_nodes") == 1 and calls.count("locate") == 3  # ends on bodies: of a spring and of a tendon
        sim.step()
        for name in ("joint", "spring0", "joint", "tendon0", "spring0"):
            sim.joint_force(name)
        assert calls.count("locate_nodes") == 1 and calls.count("locate") == 6  # once more, for springs at attached nodes


@pytest.mark.parametrize("order", [1, 2])
def test_pressures_at_attached_nodes_are_in_the_matrix(order):
    matrices, x, rng = [], None, np.random.default_rng(2)
    for attached in (True, False):
        scene = halves(False, order, False)
        for body in scene.bodies:
            body.add_pressure(lambda c: c[:, 0] > -1.0, 2e4)
        if not attached:
            scene.attachments.clear()
        with dynamics(scene, dt=0.01, integrator="implicit_euler", precision="f64") as made:
            if attached:
                table = made.state.dependents
                T = table.matrix
                x = T @ (made.state.state()[0] + 0.004 * rng.normal(size=(made.model.n_nodes, 3)))
            set_state(made, x)
            solver = made.stepper.solver
            solver.form(EVERYTHING, False, 0.0, 1.0)
            matrices.append(block_csr.to_scipy(made.model, solver.matrix).toarray())
    T3, free = np.kron(T.toarray(), np.eye(3)), np.repeat(~np.isin(np.arange(len(x)), table.node), 3)
    expected = (T3.T @ matrices[1] @ T3)[np.ix_(free, free)]
    assert np.abs(matrices[0][np.ix_(free, free)] - expected).max() < 1e-12 * np.abs(expected).max()
