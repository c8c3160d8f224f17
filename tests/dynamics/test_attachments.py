"""Exact attachments:

* a body cut in two or three and attached at matching nodes equals the whole: statics, motion, contact, frequencies, springs;
* the assembled matrix is T^T K T, and forces, masses and weights follow;
* momentum and angular momentum of attached free bodies are kept, also where their nodes do not match;
* the force of an attachment carries the weight that hangs on it;
* attached bodies do not collide with each other, but with everything else;
* scene files, checkpoints, refinement and every refusal.
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.dependents import dependent_table
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.reference import lumped_masses, mass_matrix
from taisoft.linear import block_csr
from taisoft.scene.refine import refined, with_order
from tests.dynamics.scenes import dynamics, set_state

LENGTH, SIDE = 0.6, 0.1
RUBBER = ts.Material("stable_neo_hookean", young=1e5, poisson=0.3, density=1000.0)
INTEGRATORS = {
    "implicit_euler": 0.01,
    "bdf2": 0.01,
    "implicit_midpoint": 0.01,
    "linearly_implicit_euler": 0.01,
    "symplectic_euler": 3e-4,
    "velocity_verlet": 3e-4,
}
TIGHT = {"precision": "f64", "newton_tolerance": 1e-11}


def bar(parts: int, order: int = 1, turned: bool = False, **numbers) -> ts.Scene:
    """A bar of six cells along x that is fixed at x = 0, cut in equal parts. turned: each part hangs on the next one."""
    scene, cells = ts.Scene(**numbers), 6 // parts
    scene.contact_forces = False
    for k in range(parts):
        center = ((k + 0.5) * LENGTH / parts, 0.0, 0.0)
        mesh = ts.box_mesh((cells, 2, 2), (LENGTH / parts, SIDE, SIDE), center, pattern="six")
        scene.add_body(mesh, RUBBER, name=f"part{k}", order=order)
    scene.body("part0").fix(lambda X: X[:, 0] < 1e-9)
    for k in range(1, parts):
        a, b = (f"part{k - 1}", f"part{k}") if turned else (f"part{k}", f"part{k - 1}")
        scene.attach(a, lambda X, k=k: np.abs(X[:, 0] - k * LENGTH / parts) < 1e-9, b, name=f"joint{k}")
    return scene


def distance(scene: ts.Scene, x: np.ndarray, whole: ts.Scene, y: np.ndarray) -> float:
    """Largest distance [m] between the nodes of a scene and those of the whole body at the same places at rest."""
    starts, places = (np.concatenate([b.rest_positions + b.position for b in s.bodies]) for s in (scene, whole))
    apart, row = cKDTree(places).query(starts)
    assert apart.max() < 1e-12
    return float(np.abs(x - y[row]).max())


def run(scene: ts.Scene, integrator: str, seconds: float, **settings) -> tuple[np.ndarray, "ts.RunReport"]:
    implicit = integrator not in EXPLICIT
    given = (TIGHT if implicit else {"precision": "f64"}) | settings
    with ts.Simulator(scene.snapshot(), dt=INTEGRATORS[integrator], integrator=integrator, **given) as sim:
        report = sim.run(seconds=seconds)
        return sim.positions(), report


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("parts", "turned"), [(2, False), (2, True), (3, False), (3, True)])
def test_statics_of_parts_equal_the_whole(order, parts, turned):
    whole, cut = bar(1, order), bar(parts, order, turned)
    expected, found = (ts.solve_static(scene, tolerance=1e-9) for scene in (whole, cut))
    assert found.converged and expected.converged
    x = np.concatenate([found.positions(body.name) for body in cut.bodies])
    assert distance(cut, x, whole, expected.positions("part0")) < 1e-7 * LENGTH


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_motion_of_parts_equals_the_whole(order, integrator):
    whole, cut = bar(1, order), bar(3, order, turned=order == 2)
    y, _ = run(whole, integrator, 0.06)
    x, report = run(cut, integrator, 0.06)
    assert report.status == "ok" and np.abs(x - np.concatenate([b.rest_positions for b in cut.bodies])).max() > 0.01
    assert distance(cut, x, whole, y) < 1e-9 * LENGTH


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("order", [1, 2])
def test_matrix_is_projected(order):
    cut = bar(3, order)
    apart = cut.snapshot()
    apart.attachments.clear()
    table, rng = dependent_table(cut), np.random.default_rng(1)
    T, matrices = table.matrix, []
    for scene in (cut, apart):
        with dynamics(scene, dt=0.01, integrator="implicit_euler", precision="f64") as made:
            if not matrices:
                x = made.state.state()[0]
                x = T @ (x + 0.004 * rng.normal(size=x.shape))
            set_state(made, x)
            solver = made.stepper.solver
            solver.form(EVERYTHING, False, 0.0, 1.0)
            matrices.append(block_csr.to_scipy(made.model, solver.matrix).toarray())
    T3 = np.kron(T.toarray(), np.eye(3))
    free = np.repeat(~np.isin(np.arange(len(x)), table.node), 3)
    expected = (T3.T @ matrices[1] @ T3)[np.ix_(free, free)]
    assert np.abs(matrices[0][np.ix_(free, free)] - expected).max() < 1e-12 * np.abs(expected).max()
    assert lumped_masses(cut).sum() == pytest.approx(sum(b.mass for b in cut.bodies), rel=1e-9)
    assert mass_matrix(cut).sum() == pytest.approx(sum(b.mass for b in cut.bodies), rel=1e-12)


@pytest.mark.filterwarnings("ignore:body")
def test_frequencies_equal_those_of_the_whole():
    for mass in ("lumped", "consistent"):
        expected, found = (ts.modes(scene, 5, mass=mass).frequencies for scene in (bar(1), bar(2)))
        assert found == pytest.approx(expected, rel=1e-8)
    whole, cut = bar(1), bar(2)
    with (
        ts.Simulator(cut, integrator="velocity_verlet", dt=1e-5) as sim,
        ts.Simulator(whole, integrator="velocity_verlet", dt=1e-5) as one,
    ):
        assert 0.9 * one.stable_dt < sim.stable_dt < 1.1 * one.stable_dt


@pytest.mark.filterwarnings("ignore:body")
def test_spring_at_an_attached_node():
    scenes = bar(1), bar(2)
    scenes[0].add_spring(("part0", (0.3, 0.05, 0.05)), ("part0", (0.6, 0.05, 0.05)), stiffness=300.0, rest_length=0.2)
    scenes[1].add_spring(("part1", (0.3, 0.05, 0.05)), ("part1", (0.6, 0.05, 0.05)), stiffness=300.0, rest_length=0.2)
    y, x = (run(scene, "bdf2", 0.06)[0] for scene in scenes)
    assert distance(scenes[1], x, scenes[0], y) < 1e-9 * LENGTH


def unlike(order_a: int, order_b: int, gravity=(0.0, 0.0, 0.0), **numbers) -> ts.Scene:
    """A plate with a cube at it whose nodes do not match, as free bodies."""
    scene = ts.Scene(gravity=gravity)
    scene.contact_forces = False
    material = ts.Material("corotational", young=1e5, poisson=0.3, density=1000.0, **numbers)
    scene.add_body(ts.box_mesh((4, 4, 2), (0.3, 0.3, 0.1)), material, name="plate", order=order_b, velocity=(0.1, 0.0, 0.3))
    cube = ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1))
    scene.add_body(cube, material, name="cube", position=(0.02, 0.01, -0.1), order=order_a, velocity=(0.0, 1.0, 0.5))
    scene.attach("cube", lambda X: X[:, 2] > 0.0499, "plate", name="joint")
    return scene


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("orders", [(1, 1), (2, 1), (1, 2)])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_momentum_is_kept(orders, integrator):
    scene = unlike(*orders)
    implicit = integrator not in EXPLICIT
    consistent = implicit and 2 in orders  # masses of linear tets are lumped

    def momenta(sim) -> tuple[np.ndarray, np.ndarray]:
        x, v = sim.positions(), sim.velocities()
        p = mass_matrix(scene) @ v if consistent else lumped_masses(scene)[:, None] * v
        return p.sum(axis=0), np.cross(x, p).sum(axis=0)

    settings = TIGHT if implicit else {"precision": "f64"}
    with ts.Simulator(scene, dt=2e-3 if implicit else 1e-4, integrator=integrator, **settings) as sim:
        start = momenta(sim)
        sim.run(seconds=0.05)
        end = momenta(sim)
    assert end[0] == pytest.approx(start[0], abs=1e-9)
    if integrator in ("implicit_midpoint", "velocity_verlet"):
        assert end[1] == pytest.approx(start[1], abs=1e-10)


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize(("integrator", "precision"), [("bdf2", "f64"), ("symplectic_euler", "f64"), ("bdf2", "f32")])
def test_joint_carries_the_weight(integrator, precision):
    scene = unlike(2, 1, gravity=(0.0, 0.0, -9.81), mass_damping=30.0)
    for body in scene.bodies:
        body.velocity = (0.0, 0.0, 0.0)
    scene.body("plate").fix(lambda X: X[:, 2] > 0.0499)
    with ts.Simulator(scene, dt=0.02 if integrator == "bdf2" else 3e-4, integrator=integrator, precision=precision) as sim:
        assert sim.joint_force("joint").shape == (len(scene.attachments[0].nodes), 3)
        sim.run(seconds=1.0)
        weight, tolerance = 9.81 * scene.body("cube").mass, 1e-4 if precision == "f64" else 1e-3
        assert np.linalg.norm(sim.joint_force("joint").sum(axis=0) - (0.0, 0.0, weight)) < tolerance * weight
        with pytest.raises(ts.SceneError, match=r"no spring, tendon or attachment is called 'joints' \(did you mean joint\?\)"):
            sim.joint_force("joints")


def standing(cut: bool) -> ts.Scene:
    """A column above a slope, whole or cut at half its height."""
    scene, material = ts.Scene(), ts.Material("stable_neo_hookean", young=2e5, poisson=0.3, density=1000.0, friction=0.5)
    heights = (0.1, 0.1) if cut else (0.2,)
    for k, height in enumerate(heights):
        mesh = ts.box_mesh((2, 2 if cut else 4, 2), (0.1, height, 0.1), pattern="six")
        scene.add_body(mesh, material, name=f"part{k}", position=(0.0, 0.006 + (k + 0.5) * height, 0.0))
    if cut:
        scene.attach("part0", lambda X: X[:, 1] > 0.0499, "part1")
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.1, 1.0, 0.0)), name="slope")
    return scene


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize(
    "integrator", ["bdf2", "implicit_euler", "linearly_implicit_euler", "symplectic_euler", "velocity_verlet"]
)
def test_contact_of_parts_equals_the_whole(integrator):
    whole, cut = standing(False), standing(True)
    y, _ = run(whole, integrator, 0.12)
    x, report = run(cut, integrator, 0.12)
    assert report.status == "ok"
    assert x[:, 1].min() < 0.005  # it has landed
    assert distance(cut, x, whole, y) < 1e-7 * LENGTH


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("integrator", ["bdf2", "symplectic_euler"])
def test_attached_nodes_touch_others(integrator):
    """The nodes that touch the ground are those that depend on the other body."""
    scene = ts.Scene()
    material = ts.Material("stable_neo_hookean", young=2e5, poisson=0.3, density=1000.0)
    block = scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="block", position=(0.0, 0.061, 0.0))
    skid = scene.add_body(ts.box_mesh((1, 1, 1), (0.08, 0.02, 0.08)), material, name="skid", position=(0.0, 0.0101, 0.0))
    scene.attach("skid", lambda X: X[:, 1] > 0.0099, "block")
    scene.add_obstacle(ts.HalfSpace((0.0, -0.001, 0.0), (0.0, 1.0, 0.0)), name="ground")
    with ts.Simulator(scene, dt=0.005 if integrator == "bdf2" else 2e-4, integrator=integrator) as sim:
        assert sim.overlaps() == []
        report = sim.run(seconds=0.5)
        assert report.status == "ok"
        if integrator == "bdf2":  # explicit steps go on bouncing a little
            weight = 9.81 * (block.mass + skid.mass)
            assert sim.contact_force("ground")[1] == pytest.approx(-weight, rel=0.2)
        assert (sim.positions("skid")[:, 1] > -0.001).all()


@pytest.mark.parametrize("integrator", ["bdf2", "symplectic_euler"])
@pytest.mark.parametrize("cells", [2, 3])
def test_two_parts_meet_on_a_third(integrator, cells):
    """Contacts of nodes that depend on the same ones are left out."""
    x = []
    for touches in (True, False):
        scene, size = ts.Scene(), (0.1, 0.1, 0.1)
        scene.contact_forces = touches
        scene.add_body(ts.box_mesh((2, 2, 2), size), RUBBER, name="corner")
        for name, axis in (("right", 0), ("top", 1)):
            place = np.eye(3)[axis] * 0.1
            scene.add_body(ts.box_mesh((cells,) * 3, size), RUBBER, name=name, position=place)
            scene.attach(name, lambda X, axis=axis: X[:, axis] < -0.0499, "corner")
        with ts.Simulator(scene, dt=0.005 if integrator == "bdf2" else 2e-4, integrator=integrator, precision="f64") as sim:
            report = sim.run(seconds=0.1)
            assert report.status == "ok"
            x.append(sim.positions())
    assert np.abs(x[0] - x[1]).max() < 1e-8


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_reactions_are_those_of_the_whole(integrator):
    settings = TIGHT if integrator not in EXPLICIT else {"precision": "f64"}
    totals = []
    for parts in (1, 2):
        with ts.Simulator(bar(parts), dt=INTEGRATORS[integrator], integrator=integrator, **settings) as sim:
            sim.run(seconds=0.05)
            totals.append(sim.reactions().sum(axis=0))
    assert totals[1] == pytest.approx(totals[0], abs=1e-5 * np.abs(totals[0]).max())
    found = ts.solve_static(bar(2), tolerance=1e-9)
    weight = 9.81 * sum(body.mass for body in bar(2).bodies)
    assert sum(found.reactions(name) for name in ("part0", "part1")).sum(axis=0)[1] == pytest.approx(weight, rel=1e-6)


@pytest.mark.filterwarnings("ignore:body")
def test_an_attached_node_can_be_dragged():
    moved = []
    for parts in (1, 2):
        with ts.Simulator(
            bar(parts, gravity=(0, 0, 0)), dt=0.01, integrator="implicit_euler", draggable=True, precision="f64"
        ) as sim:
            body = sim.scene.bodies[-1]
            node = int(np.argmin(np.linalg.norm(body.rest_positions - (0.3, 0.05, 0.05), axis=1)))
            sim.drag(body.name, [node], [1.0], (0.3, 0.3, 0.05), 100.0)
            sim.run(seconds=0.1)
            moved.append(sim.positions(body.name)[node])
    assert moved[0][1] > 0.06 and moved[1] == pytest.approx(moved[0], abs=1e-3)


@pytest.mark.filterwarnings("ignore:body")
def test_a_cavity_of_given_volume_with_attached_nodes():
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    box = ts.box_mesh((5, 5, 5), (0.1, 0.1, 0.1))
    solid = (np.abs(box.vertices[box.tets].mean(axis=1)) > 0.03).any(axis=1)
    used, tets = np.unique(box.tets[solid], return_inverse=True)
    shell = scene.add_body(ts.TetMesh(box.vertices[used], tets.reshape(-1, 4)), RUBBER, name="shell")
    scene.add_body(ts.box_mesh((3, 2, 3), (0.1, 0.08, 0.1)), RUBBER, name="base", position=(0.0, -0.04, 0.0))
    scene.attach("shell", lambda X: X[:, 1] < -0.029, "base")
    scene.body("base").fix(lambda X: X[:, 1] < -0.039)
    inner = lambda c: (np.abs(c) < 0.0301).all(axis=1)  # noqa: E731
    volume = 1.1 * shell.enclosed_volume(inner)
    shell.add_cavity(inner, volume=volume, name="air")
    with ts.Simulator(scene, dt=0.02, integrator="implicit_euler", precision="f64") as sim:
        reports = [sim.step() for _ in range(5)]
        assert all(report.converged and report.newton_iterations < 9 for report in reports)
        assert sim.cavity_volume("air") == pytest.approx(volume, rel=1e-6)


@pytest.mark.filterwarnings("ignore:body")
def test_refined_where_nodes_lie_outside():
    scene = ts.Scene()
    for k, name in enumerate(("left", "right")):
        scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), RUBBER, name=name, position=(0.1035 * k, 0.0, 0.0))
    scene.attach("right", lambda X: X[:, 0] < -0.0499, "left")
    finer = refined(scene)
    finer.check()
    assert len(finer.attachments[0].nodes) == 25


def test_attached_bodies_do_not_collide():
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(ts.box_mesh((3, 3, 3), (0.2, 0.2, 0.2)), RUBBER, name="block")
    scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), RUBBER, name="core", position=(0.07, 0.0, 0.0))  # half of it inside
    with pytest.raises(ts.SceneError, match="overlap at the start"):
        ts.Simulator(scene, dt=0.01, integrator="bdf2")
    scene.attach("core", lambda X: X[:, 0] < 0.03, "block")
    assert not scene.pushes(self_collision=False) and scene.pushes(self_collision=True)
    scene.add_obstacle(ts.HalfSpace((0.0, -1.0, 0.0), (0.0, 1.0, 0.0)))
    with ts.Simulator(scene.snapshot(), dt=0.01, integrator="bdf2", precision="f64") as sim:
        report = sim.run(seconds=0.1)
        assert report.status == "ok" and len(sim.contacts().gap) == 0 and not sim.intersecting_triangles()
        assert np.abs(sim.positions() - np.concatenate([b.rest_positions + b.position for b in scene.bodies])).max() < 1e-9


@pytest.mark.filterwarnings("ignore:body")
def test_files_checkpoints_and_refinement(tmp_path):
    scene = bar(2)
    ts.write_scene(tmp_path / "bar.toml", scene)
    again, _ = ts.read_scene(tmp_path / "bar.toml")
    (one,) = again.attachments
    assert (one.name, one.a, one.b, one.stiffness) == ("joint1", "part1", "part0", None)
    assert np.array_equal(one.nodes, scene.attachments[0].nodes)
    with ts.Simulator(scene, dt=0.01, integrator="bdf2") as sim:
        sim.run(seconds=0.05)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.run(seconds=0.05)
        x = sim.positions()
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene) as sim:
        sim.run(seconds=0.05)
        assert np.array_equal(sim.positions(), x)
    other = scene.snapshot()
    other.attachments.clear()
    with pytest.raises(ts.SceneError, match="differs in attachment 'joint1'"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", other)
    assert len(refined(scene).attachments[0].nodes) == len(with_order(scene, 2).attachments[0].nodes) == 25


def test_a_chain_that_closes_is_refused():
    scene = ts.Scene()
    for k in range(2):
        scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), RUBBER, name=f"part{k}", position=(0.1 * k, 0.0, 0.0))
    scene.attach("part0", lambda X: X[:, 0] > 0.0, "part1")
    scene.attach("part1", lambda X: X[:, 0] < 0.0, "part0")
    with pytest.raises(ts.SceneError, match=r"attachments: node \d of body 'part0' is attached, through others, to itself"):
        ts.Simulator(scene, dt=0.01, integrator="bdf2")


@pytest.mark.filterwarnings("ignore:body")
def test_refusals():
    def refused(message: str, change) -> None:
        scene = bar(2)
        scene.add_obstacle(ts.HalfSpace((0.0, -1.0, 0.0), (0.0, 1.0, 0.0)), name="ground")
        with pytest.raises(ts.SceneError, match=message):
            change(scene)
            scene.check()

    refused("damping is that of springs: give a stiffness, too", lambda s: s.attach("part0", [35], "part1", damping=1.0))
    refused("body 'part0' cannot be attached to itself", lambda s: s.attach("part0", [0], "part0"))
    refused("no body or obstacle is called 'part3'", lambda s: s.attach("part0", [0], "part3"))
    refused(
        "node 0 of body 'part0' lies outside of body 'part1', by .* times the height", lambda s: s.attach("part0", [0], "part1")
    )
    refused("attachment 'joint1': node 0 of body 'part1' is fixed or moved, too", lambda s: s.body("part1").fix([0]))
    refused(
        "attachment 'again': node 0 of body 'part1' is attached already", lambda s: s.attach("part1", [0], "part0", name="again")
    )
    refused("attachment 'joint1': .*no body or obstacle is called 'part0'", lambda s: s.bodies.pop(0))
    refused("name 'joint1' is taken", lambda s: s.attach("part1", [0], "part0", name="joint1"))


def test_mean_dilatation_is_refused():
    scene = ts.Scene()
    for k in range(2):
        mesh = ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1))
        scene.add_body(mesh, RUBBER, name=f"part{k}", position=(0.1 * k, 0.0, 0.0), dilatation="local" if k else "mean")
    scene.attach("part0", lambda X: X[:, 0] > 0.0, "part1")
    with pytest.raises(ts.SceneError, match="nodes of body 'part0' cannot be attached exactly, since its dilatation is a mean"):
        scene.check()
    scene.attachments.clear()
    scene.attach("part1", lambda X: X[:, 0] < 0.0, "part0")
    scene.check()


def test_stiffness_damping_must_agree():
    scene = ts.Scene()
    for k in range(2):
        material = ts.Material("corotational", young=1e5, poisson=0.3, density=1000.0, stiffness_damping=0.001 * k)
        scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), material, name=f"part{k}", position=(0.1 * k, 0.0, 0.0))
    scene.attach("part0", lambda X: X[:, 0] > 0.0, "part1")
    with pytest.raises(ts.SceneError, match="'part0' and 'part1' must have the same stiffness_damping"):
        ts.Simulator(scene, dt=0.01, integrator="bdf2")
