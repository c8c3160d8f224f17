"""Exact attachments:

* a body cut in parts and attached at matching nodes equals the whole, with springs, pressure and loads at the joints: statics,
  motion, reactions, contact; the assembled matrix is T^T K T;
* attached bodies do not collide with each other, but with everything else;
* chains that close are refused.
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.fem.dependents import dependent_table
from taisoft.fem.node_graph import EVERYTHING
from taisoft.linear import block_csr
from tests.dynamics.companion import LOOSE, add_companion, simulator
from tests.dynamics.scenes import dynamics, rubber, set_state

pytestmark = pytest.mark.filterwarnings("ignore:body")  # of long tets
LENGTH, SIDE = 0.6, 0.1
RUBBER = rubber(mass_damping=2.0)
INTEGRATORS = [pytest.param("symplectic_euler", marks=pytest.mark.long), "velocity_verlet", *IMPLICIT]


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


# --- parts and the whole --------------------------------------------------------------------------------------------------


def test_statics():
    """A whole bar and one in three parts, as one scene."""
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
    parts = [scene.body(name) for name in "abc"]
    x, rest = (np.concatenate(own) for own in zip(*((found.positions(b.name), b.rest_positions) for b in parts)))
    apart, row = cKDTree(scene.body("whole").rest_positions).query(rest)
    assert found.converged and apart.max() < 1e-12 and np.abs(x - rest).max() > 1e-3
    assert np.abs(x - found.positions("whole")[row] - shift).max() < 1e-6 * LENGTH
    weight = found.reactions("whole").sum(axis=0)
    assert found.reactions("a").sum(axis=0) == pytest.approx(weight, abs=1e-5 * weight[1]) and weight[1] > 50.0


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_motion_and_reactions_of_parts_equal_the_whole(integrator):
    found, turned = [], integrator in ("bdf2", "velocity_verlet")
    for scene in (bar(1), bar(3, turned)):
        with simulator(scene, integrator, step_of(integrator)) as sim:
            report = sim.run(seconds=0.05)
            assert report.status == "ok", report.problems
            found.append((scene, sim.positions(), of_parts(scene, sim.reactions()).sum(axis=0)))
    (whole, y, expected), (cut, x, reaction) = found
    assert np.abs(of_parts(whole, y) - whole.body("part0").rest_positions).max() > 0.008
    assert distance(cut, x, whole, y) < 1e-8 * LENGTH
    assert reaction == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_matrix_is_projected():
    cut, apart = bar(3), bar(3)
    del apart.attachments[:2]
    table, matrices, rng = dependent_table(cut), [], np.random.default_rng(1)
    for scene in (cut, apart):
        with dynamics(scene, dt=0.01, integrator="implicit_euler", precision="f64") as made:
            if not matrices:
                x = made.state.state()[0]
                x = table.matrix @ (x + 0.004 * rng.normal(size=x.shape))
            set_state(made, x)
            solver = made.stepper.solver
            solver.form(EVERYTHING, False, 0.0, 1.0)
            matrices.append(block_csr.to_scipy(made.model, solver.matrix).toarray())
    T3, free = np.kron(table.matrix.toarray(), np.eye(3)), np.repeat(~np.isin(np.arange(len(x)), table.node), 3)
    expected = (T3.T @ matrices[1] @ T3)[np.ix_(free, free)]
    n = 3 * len(of_parts(cut, x))  # the rigid body is much stiffer
    parts = free[:n].sum()
    difference = np.abs(matrices[0][np.ix_(free, free)] - expected)[:parts, :parts]
    assert difference.max() < 1e-12 * np.abs(expected[:parts, :parts]).max()


def test_a_chain_that_closes_is_refused():
    scene = ts.Scene()
    for k in range(2):
        scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), RUBBER, name=f"part{k}", position=(0.1 * k, 0.0, 0.0))
    scene.attach("part0", lambda X: X[:, 0] > 0.0, "part1")
    scene.attach("part1", lambda X: X[:, 0] < 0.0, "part0")
    with pytest.raises(ts.SceneError, match=r"attachments: node \d of body 'part0' is attached, through others, to itself"):
        dependent_table(scene)


# --- conservation ---------------------------------------------------------------------------------------------------------


def hung(**damping) -> ts.Scene:
    """A cube below a plate, with nodes that do not match."""
    scene, material = ts.Scene(), rubber(**damping)
    scene.contact_forces = False
    scene.add_body(ts.box_mesh((4, 1, 4), (0.3, 0.1, 0.3)), material, name="plate", position=(0, 0.1, 0))
    scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="load")
    scene.attach("load", lambda X: X[:, 1] > 0.049, "plate", name="joint")
    return scene


# --- contacts -------------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    "integrator, dt, damping, seconds",
    [("implicit_euler", 0.01, 40.0, 0.4), pytest.param("velocity_verlet", 2e-4, 250.0, 0.06, marks=pytest.mark.long)],
)
def test_contacts_of_attached_nodes_count(integrator, dt, damping, seconds):
    """All nodes of the pad are attached, and the block stands on it."""
    scene, material = ts.Scene(), rubber(young=2e5, mass_damping=damping, friction=0.5)
    block = scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), material, name="block", position=(0.0, 0.051, 0.0))
    pad = scene.add_body(ts.box_mesh((2, 1, 2), (0.06, 0.02, 0.06)), material, name="pad", position=(0.0, 0.01, 0.0))
    scene.attach("pad", np.arange(pad.n_nodes), "block", name="joint")
    scene.add_obstacle(ts.HalfSpace((0.0, -1e-4, 0.0), (0.0, 1.0, 0.0)), name="ground")
    with simulator(add_companion(scene, attached=True), integrator, dt, **(LOOSE if integrator in IMPLICIT else {})) as sim:
        assert sim.overlaps() == []
        sim.run(seconds=seconds)
        contact, weight = sim.contact_force("pad"), 9.81 * (block.mass + pad.mass)
        assert contact[1] == pytest.approx(weight, rel=5e-2) and not sim.contact_force("block").any()
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
