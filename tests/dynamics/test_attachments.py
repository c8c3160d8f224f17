"""Exact attachments, their forces, and attachments to obstacles:

* a body cut in parts and attached at matching nodes equals the whole, with springs, pressure and loads at the joints: statics,
  motion, also while joints are dragged, reactions, contact;
* attached bodies do not collide with each other, but with everything else; chains that close are refused;
* what one half of a body exerts on the other is minus what the other exerts on it, in motion, with loads at the joint;
* the force carries a weight, also through a chain;
* attachments to obstacles are fixed or moved nodes and have their reaction; the body does not touch its obstacle.
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.fem.dependent_table import dependent_table
from tests.dynamics.companion import LOOSE, add_companion, simulator
from tests.dynamics.scenes import rubber

pytestmark = pytest.mark.filterwarnings("ignore:body")  # of long tets
LENGTH, SIDE = 0.6, 0.1
RUBBER = rubber(mass_damping=2.0)


def step_of(integrator: str) -> float:
    return 3e-4 if integrator in EXPLICIT else 0.01


def bar(parts: int, turned: bool = False, cells: int = 6) -> ts.Scene:
    """A bar along x that is fixed at x = 0, cut in equal parts, with a spring, a tendon, a traction and a pressure beyond 0.4 m.

    turned: each part hangs on the next one.
    """
    scene, n = ts.Scene(), cells // parts
    scene.contact_forces = False
    for k in range(parts):
        center = ((k + 0.5) * LENGTH / parts, 0.0, 0.0)
        mesh = ts.box_mesh((n, 2, 2), (LENGTH / parts, SIDE, SIDE), center, pattern="six")
        scene.add_body(mesh, RUBBER, name=f"part{k}")
    scene.body("part0").fix(lambda X: X[:, 0] < 1e-9)
    for k in range(1, parts):
        a, b = (f"part{k - 1}", f"part{k}") if turned else (f"part{k}", f"part{k - 1}")
        scene.attach(a, lambda X, k=k: np.abs(X[:, 0] - k * LENGTH / parts) < 1e-9, b, name=f"joint{k}")
    first, last = (scene.bodies[min(k, parts - 1)] for k in (0, parts - 1))
    ends = [(last.name, (0.4, 0.05, 0.05)), (last.name, (0.6, 0.05, 0.05))]  # the first is at the last joint of three parts
    scene.add_spring(*ends, 300.0, rest_length=0.15, damping=0.5, name="spring")
    scene.add_tendon([(first.name, (0.05, -0.05, 0.0)), (last.name, (0.4, -0.05, 0.0)), ends[1]], 0.3, name="line")
    last.add_pressure(lambda c: (c[:, 1] > 0.0499) & (c[:, 0] > 0.4), 200.0)
    last.add_traction(lambda c: (c[:, 1] > 0.0499) & (c[:, 0] > 0.4), (50.0, 0.0, 100.0))
    return add_companion(scene, attached=True)


def parts_of(scene: ts.Scene) -> list[ts.Body]:
    return [body for body in scene.bodies if body.name.startswith("part")]


def of_parts(scene: ts.Scene, x: np.ndarray) -> np.ndarray:
    """The rows of the parts, which come first."""
    return x[: sum(body.n_nodes for body in parts_of(scene))]


def distance(scene: ts.Scene, x: np.ndarray, whole: ts.Scene, y: np.ndarray) -> float:
    """Largest distance [m] between the nodes of a scene and those of the whole body at the same places at rest."""
    starts, places = (np.concatenate([b.rest_positions + b.position for b in parts_of(s)]) for s in (scene, whole))
    apart, row = cKDTree(places).query(starts)
    assert apart.max() < 1e-12
    return float(np.abs(of_parts(scene, x) - y[row]).max())


def test_statics_of_parts_equals_the_whole():
    """As one scene, without a companion, since statics has no damping and so kernels of its own."""
    scene, shift = ts.Scene(), np.array([0.0, 1.0, 0.0])
    scene.contact_forces = False
    for name, cells, x, position in (("whole", 6, 0.3, -shift), ("a", 2, 0.1, 0), ("b", 2, 0.3, 0), ("c", 2, 0.5, 0)):
        mesh = ts.box_mesh((cells, 2, 2), (0.1 * cells, SIDE, SIDE), (x, 0.0, 0.0), pattern="six")
        scene.add_body(mesh, RUBBER, name=name, position=np.zeros(3) + position)
    for name in ("whole", "a"):
        scene.body(name).fix(lambda X: X[:, 0] < 1e-9)
    scene.attach("a", lambda X: X[:, 0] > 0.1999, "b")
    scene.attach("c", lambda X: X[:, 0] < 0.4001, "b")
    found = ts.solve_static(scene, tolerance=1e-8)
    x, rest = (np.concatenate(own) for own in zip(*((found.positions(n), scene.body(n).rest_positions) for n in "abc")))
    _, row = cKDTree(scene.body("whole").rest_positions).query(rest)
    assert found.converged and np.abs(x - rest).max() > 1e-3
    assert np.abs(x - found.positions("whole")[row] - shift).max() < 1e-6 * LENGTH
    weight = found.reactions("whole").sum(axis=0)
    assert found.reactions("a").sum(axis=0) == pytest.approx(weight, abs=1e-5 * weight[1]) and weight[1] > 50.0


@pytest.mark.parametrize("integrator", ["velocity_verlet", *IMPLICIT])
def test_motion_and_reactions_of_parts_equal_the_whole(integrator):
    """While the nodes of the last part at its joint are dragged, which depend on others or not."""
    found, turned = [], integrator in ("bdf2", "velocity_verlet")
    for scene in (bar(1), bar(3, turned)):
        with simulator(scene, integrator, step_of(integrator), draggable=True) as sim:
            last = parts_of(scene)[-1]
            nodes = np.flatnonzero(np.abs(last.rest_positions[:, 0] - 0.4) < 1e-9)
            sim.drag(last.name, nodes, np.arange(1.0, 10.0), (0.4, 0.1, 0.05), 200.0)
            report = sim.run(seconds=0.05)
            assert report.status == "ok", report.problems
            found.append((scene, sim.positions(), of_parts(scene, sim.reactions()).sum(axis=0)))
    (whole, y, expected), (cut, x, reaction) = found
    assert np.abs(of_parts(whole, y) - whole.body("part0").rest_positions).max() > 0.008
    assert distance(cut, x, whole, y) < 1e-8 * LENGTH
    assert reaction == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_a_chain_that_closes_is_refused():
    scene = ts.Scene()
    for k in range(2):
        scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), RUBBER, name=f"part{k}", position=(0.1 * k, 0.0, 0.0))
    scene.attach("part0", lambda X: X[:, 0] > 0.0, "part1")
    scene.attach("part1", lambda X: X[:, 0] < 0.0, "part0")
    with pytest.raises(ts.SceneError, match=r"attachments: node \d of body 'part0' is attached, through others, to itself"):
        dependent_table(scene)


def hung(**damping) -> ts.Scene:
    """A cube below a plate, with nodes that do not match."""
    scene, material = ts.Scene(), rubber(**damping)
    scene.contact_forces = False
    scene.add_body(ts.box_mesh((4, 1, 4), (0.3, 0.1, 0.3)), material, name="plate", position=(0, 0.1, 0))
    scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="load")
    scene.attach("load", lambda X: X[:, 1] > 0.049, "plate", name="joint")
    return scene


def standing(cut: bool) -> ts.Scene:
    """A column above a slope, whole or cut at half its height."""
    scene, material = ts.Scene(), rubber(young=2e5, friction=0.5)
    heights = (0.1, 0.1) if cut else (0.2,)
    for k, height in enumerate(heights):
        mesh = ts.box_mesh((2, 2 if cut else 4, 2), (0.1, height, 0.1), pattern="six")
        scene.add_body(mesh, material, name=f"part{k}", position=(0.0, 0.006 + (k + 0.5) * height, 0.0))
    if cut:
        scene.attach("part0", lambda X: X[:, 1] > 0.0499, "part1")
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.1, 1.0, 0.0)), name="ground")
    return add_companion(scene, attached=True)


@pytest.mark.parametrize("integrator", ["implicit_euler", "velocity_verlet"])
def test_contact_of_parts_equals_the_whole(integrator):
    found = []
    for scene in (standing(False), standing(True)):
        with simulator(scene, integrator, step_of(integrator)) as sim:
            assert sim.run(seconds=0.06).status == "ok"
            found.append((scene, sim.positions()))
    (whole, y), (cut, x) = found
    assert of_parts(cut, x)[:, 1].min() < 0.005  # it has landed
    assert distance(cut, x, whole, y) < 1e-7 * LENGTH


def test_contacts_of_attached_nodes_count():
    """All nodes of the pad are attached, and the block stands on it."""
    scene, material = ts.Scene(), rubber(young=2e5, mass_damping=40.0, friction=0.5)
    block = scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="block", position=(1.0, 0.051, 0.0))
    pad = scene.add_body(ts.box_mesh((2, 1, 2), (0.06, 0.02, 0.06)), material, name="pad", position=(1.0, 0.01, 0.0))
    scene.attach("pad", np.arange(pad.n_nodes), "block", name="joint")
    scene.add_obstacle(ts.HalfSpace((0.0, -1e-4, 0.0), (0.0, 1.0, 0.0)), name="ground")
    with simulator(add_companion(scene, attached=True), "implicit_euler", 0.01, **LOOSE) as sim:
        assert sim.overlaps() == []
        sim.run(seconds=0.4)
        contact, weight = sim.contact_force("pad"), 9.81 * (block.mass + pad.mass)
        assert contact[1] == pytest.approx(weight, rel=5e-2) and not sim.contact_force("block").any()
        assert np.abs(sim.contact_torque("pad")).max() < 1e-3 * weight * 0.06 and not sim.contact_torque("block", "ground").any()
        expected = -contact + (0.0, 9.81 * pad.mass, 0.0)
        assert np.linalg.norm(sim.joint_force("joint").sum(axis=0) - expected) < 1e-2 * weight


def test_attached_bodies_do_not_touch_each_other():
    """Two that overlap, and three of which two meet on a third: contacts of nodes that depend on the same ones are left out."""
    scene, size = ts.Scene(gravity=(0.0, 0.0, 0.0)), (0.1, 0.1, 0.1)
    scene.add_body(ts.box_mesh((2, 2, 2), size), RUBBER, name="corner")
    half_inside = (-0.04, 0.0, 0.0)
    scene.add_body(ts.box_mesh((2, 2, 2), (0.05, 0.05, 0.05)), RUBBER, name="core", position=half_inside)
    scene.add_obstacle(ts.HalfSpace((0.0, -1.0, 0.0), (0.0, 1.0, 0.0)))
    add_companion(scene, attached=True)
    with pytest.raises(ts.SceneError, match="'corner' and 'core' overlap at the start"):
        simulator(scene, "implicit_euler", 0.01)
    scene.attach("core", lambda X: X[:, 0] > -0.02, "corner")
    for name, axis in (("right", 0), ("top", 1)):
        scene.add_body(ts.box_mesh((3, 3, 3), size), RUBBER, name=name, position=np.eye(3)[axis] * 0.1)
        scene.attach(name, lambda X, axis=axis: X[:, axis] < -0.0499, "corner")
    with simulator(scene, "implicit_euler", 0.005, **LOOSE) as sim:
        report = sim.run(seconds=0.025)
        rest = np.concatenate([b.rest_positions + b.position for b in scene.bodies])
        assert report.status == "ok" and np.abs(sim.positions() - rest).max() < 1e-9
        assert not [pair for pair in sim.intersecting_triangles() if "core" in pair]


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


@pytest.mark.parametrize("integrator, dt, damping", [("bdf2", 0.02, 20.0), ("velocity_verlet", 3e-4, 80.0)])
def test_a_chain_carries_its_weight(integrator, dt, damping):
    """The lowest of three hangs on nodes that depend on the uppermost."""
    scene = hung(mass_damping=damping)
    plate, cube = scene.bodies
    plate.fix(lambda X: X[:, 1] > 0.049)
    low = scene.add_body(ts.box_mesh((1, 1, 1), (0.05, 0.1, 0.05)), plate.material, name="low", position=(0.02, -0.09, 0.02))
    scene.attach("low", lambda X: X[:, 1] > 0.0, "load", name="lower")
    with simulator(add_companion(scene, attached=True), integrator, dt, **(LOOSE if integrator == "bdf2" else {})) as sim:
        sim.run(seconds=16.0 / damping)
        weights = [9.81 * low.mass, 9.81 * (low.mass + cube.mass)]
        for name, weight in zip(("lower", "joint"), weights):
            assert sim.joint_force(name).shape == (len(sim.scene.attachments[name == "lower"].nodes), 3)
            assert sim.joint_force(name).sum(axis=0) == pytest.approx((0.0, weight, 0.0), abs=1e-3 * weight)


BLOCK = ts.box_mesh((1, 1, 1), (0.3, 0.4, 0.4), (-0.1, 0, 0))
HANDS = {
    "box": ts.Box((-0.1, 0, 0), (0.15, 0.2, 0.2)),
    "sphere": ts.Sphere((-0.1, 0, 0), 0.25),
    "mesh": ts.MeshObstacle(BLOCK.vertices, BLOCK.surface),
}


TURN = ts.KeyFrames((0.0, 0.2), translations=[(0, 0, 0), (0.1, 0.2, 0)], rotations=[(0, 0, 0), (0.3, 0.0, 0.5)], smooth=True)


def carried(exact: bool, contact: bool = False, hand=HANDS["box"]) -> ts.Scene:
    """A bar whose end, inside the obstacle "hand", is attached to it, or moved along the same path."""
    scene = ts.Scene()
    scene.contact_forces = contact
    bar = scene.add_body(ts.box_mesh((4, 1, 1), (1.0, 0.2, 0.2)), rubber(young=3e5), name="bar", position=(0.5, 0, 0))
    scene.add_obstacle(hand, name="hand", path=TURN)

    def end(X):
        return X[:, 0] < -0.49

    if exact:
        scene.attach("bar", end, "hand", name="grip")
    else:
        X = bar.rest_positions[end(bar.rest_positions)] + bar.position
        hand = scene.obstacle("hand")
        bar.move(end, lambda t: hand.points_at(t, hand.undisplaced(X)) - X)
    return add_companion(scene, attached=True)


def test_an_attachment_to_an_obstacle_is_a_constraint():
    found = []
    for exact in (True, False):
        with simulator(carried(exact), "implicit_euler", 5e-3) as sim:
            for _ in range(8):
                sim.step()
            found.append((sim.positions(), sim.velocities(), sim.reactions()))
            if exact:
                force = sim.joint_force("grip")
                nodes = np.flatnonzero(sim.scene.body("bar").rest_positions[:, 0] < -0.49)
                assert np.array_equal(force, sim.reactions()[nodes]) and np.abs(force).max() > 1
    assert all(np.array_equal(a, b) for a, b in zip(*found))


@pytest.mark.parametrize("shape", HANDS)
def test_attached_bodies_do_not_touch_their_obstacle(shape):
    scene = carried(True, contact=True, hand=HANDS[shape])
    scene.add_obstacle(ts.HalfSpace((0, -0.25, 0), (0, 1, 0)), name="ground")
    with simulator(scene, "implicit_euler", 5e-3, **LOOSE) as sim:
        for _ in range(6):
            assert sim.step().n_contacts == 0
        for _ in range(26):
            report = sim.step()
        assert report.converged and report.n_contacts > 0
