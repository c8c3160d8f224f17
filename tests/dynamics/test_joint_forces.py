"""Forces of exact attachments, and attachments to obstacles:

* what one half of a body exerts on the other is minus what the other exerts on it, in motion, with loads at the joint;
* the force carries a weight, also through a chain, and balances a part's momentum in every step;
* attachments to obstacles are fixed or moved nodes and have their reaction; the body does not touch its obstacle.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.reference import lumped_mass
from tests.dynamics.companion import LOOSE, add_companion, simulator
from tests.dynamics.scenes import rubber
from tests.dynamics.test_attachments import bar, hung

pytestmark = pytest.mark.filterwarnings("ignore:body")  # of long tets


def test_action_is_reaction():
    """In motion, with a load, a pressure and a spring at the joint, too."""
    found = []
    for turned in (False, True):
        scene = bar(2, turned, cells=4)
        scene.body("part0").add_force(lambda X: X[:, 0] > 0.299, (0.0, 1.0, 2.0))
        scene.body("part1").add_pressure(lambda c: (c[:, 1] > 0.0499) & (c[:, 0] < 0.4), 300.0)
        scene.add_spring(("part1", (0.3, 0.05, 0.05)), ("part0", (0.1, 0.05, 0.05)), 200.0, rest_length=0.1, damping=3.0)
        one = scene.attachments[0]
        order = np.lexsort(np.round(scene.body(one.a).rest_positions[one.nodes], 9).T)
        with simulator(scene, "implicit_euler", 2e-3) as sim:
            forces = []
            for _ in range(6):
                assert sim.step().converged
                forces.append(sim.joint_force("joint1")[order])
            found.append(np.array(forces))
    size = np.abs(found[0]).max()
    assert size > 0.05 and np.abs(found[0] + found[1]).max() < 1e-7 * size


@pytest.mark.parametrize("integrator, dt", [("bdf2", 0.02), ("velocity_verlet", 3e-4)])
def test_a_chain_carries_its_weight(integrator, dt):
    """The lowest of three hangs on nodes that depend on the uppermost."""
    scene = hung(mass_damping=20.0)
    plate, cube = scene.bodies
    plate.fix(lambda X: X[:, 1] > 0.049)
    low = scene.add_body(ts.box_mesh((1, 1, 1), (0.05, 0.1, 0.05)), plate.material, name="low", position=(0.02, -0.09, 0.02))
    scene.attach("low", lambda X: X[:, 1] > 0.0, "load", name="lower")
    with simulator(add_companion(scene, attached=True), integrator, dt, **(LOOSE if integrator == "bdf2" else {})) as sim:
        sim.run(seconds=0.8)
        weights = [9.81 * low.mass, 9.81 * (low.mass + cube.mass)]
        for name, weight in zip(("lower", "joint"), weights):
            assert sim.joint_force(name).shape == (len(sim.scene.attachments[name == "lower"].nodes), 3)
            assert sim.joint_force(name).sum(axis=0) == pytest.approx((0.0, weight, 0.0), abs=1e-3 * weight)


@pytest.mark.parametrize("stiffness_damping", [0.0, pytest.param(1e-3, marks=pytest.mark.long)])
def test_a_joint_balances_momentum_in_every_step(stiffness_damping):
    """Of a damped body with a spring at the joint; that of all is kept but for weight and damping."""
    scene = hung(mass_damping=3.0, stiffness_damping=stiffness_damping)
    scene.add_spring(
        ("plate", (0.1, 0.0, 0.1)), ("load", (0.05, 0.05, 0.05)), 300.0, rest_length=0.05, damping=2.0, name="spring"
    )
    load, total = scene.body("load"), sum(body.mass for body in scene.bodies)
    mass = lumped_mass(load)
    add_companion(scene, attached=True)
    with simulator(scene, "implicit_euler", 5e-3) as sim:
        for _ in range(4):
            before, whole = mass @ sim.velocities("load"), sim.momentum("load") + sim.momentum("plate")
            assert sim.step().converged
            after = mass @ sim.velocities("load")
            outside = (after - before) / 5e-3 + 3.0 * after + (0.0, 9.81 * load.mass, 0.0) - sim.joint_force("joint").sum(axis=0)
            assert np.linalg.norm(outside) == pytest.approx(abs(sim.joint_force("spring")), rel=2e-5)
            now = sim.momentum("load") + sim.momentum("plate")
            assert (now - whole) / 5e-3 == pytest.approx(-3.0 * now - (0, 9.81 * total, 0), abs=1e-6 * total)


# --- attachments to obstacles ---------------------------------------------------------------------------------------------


BLOCK = ts.box_mesh((1, 1, 1), (0.3, 0.4, 0.4), (-0.1, 0, 0))
HANDS = {
    "box": ts.Box((-0.1, 0, 0), (0.15, 0.2, 0.2)),
    "sphere": ts.Sphere((-0.1, 0, 0), 0.25),
    "mesh": ts.MeshObstacle(BLOCK.vertices, BLOCK.surface),
}


def carried(exact: bool, path=None, contact: bool = False, hand=HANDS["box"]) -> ts.Scene:
    """A bar whose end, inside the obstacle "hand", is attached to it, or moved along the same path."""
    scene = ts.Scene()
    scene.contact_forces = contact
    bar = scene.add_body(ts.box_mesh((4, 1, 1), (1.0, 0.2, 0.2)), rubber(young=3e5), name="bar", position=(0.5, 0, 0))
    scene.add_obstacle(hand, name="hand", path=path)

    def end(X):
        return X[:, 0] < -0.49

    if exact:
        scene.attach("bar", end, "hand", name="grip")
    elif path is None:
        bar.fix(end)
    else:
        X = bar.rest_positions[end(bar.rest_positions)] + bar.position
        hand = scene.obstacle("hand")
        bar.move(end, lambda t: hand.points_at(t, hand.undisplaced(0.0, X)) - X)
    return add_companion(scene, attached=contact)


TURN = ts.KeyFrames((0.0, 0.2), translations=[(0, 0, 0), (0.1, 0.2, 0)], rotations=[(0, 0, 0), (0.3, 0.0, 0.5)], smooth=True)


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler"])
@pytest.mark.parametrize("path", [None, TURN], ids=["at rest", "moving"])
def test_an_attachment_to_an_obstacle_is_a_constraint(integrator, path):
    found = []
    for exact in (True, False):
        with simulator(carried(exact, path), integrator, 2e-4 if integrator in EXPLICIT else 5e-3) as sim:
            for _ in range(20):
                sim.step()
            found.append((sim.positions(), sim.velocities(), sim.reactions()))
            if exact:
                force = sim.joint_force("grip")
                nodes = np.flatnonzero(sim.scene.body("bar").rest_positions[:, 0] < -0.49)
                assert np.array_equal(force, sim.reactions()[nodes]) and np.abs(force).max() > 1
    assert all(np.array_equal(a, b) for a, b in zip(*found))


@pytest.mark.parametrize("shape", HANDS)
def test_attached_bodies_do_not_touch_their_obstacle(shape):
    scene = carried(True, TURN, contact=True, hand=HANDS[shape])
    scene.add_obstacle(ts.HalfSpace((0, -0.25, 0), (0, 1, 0)), name="ground")
    with simulator(scene, "implicit_euler", 5e-3, **LOOSE) as sim:
        for _ in range(6):
            assert sim.step().n_contacts == 0
        for _ in range(30):
            report = sim.step()
        assert report.converged and report.n_contacts > 0
