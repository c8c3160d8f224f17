"""Overlaps in the initial state:

* the deepest overlap has the right names and exact depth: two bodies; a body and each kind of obstacle; one wholly inside the
  other; a face over a sphere; crossing edges and a rod through a sheet or a capsule, where no vertex lies inside;
* flush bodies, and overlaps below 1e-6 of the size, do not count; a Simulator refuses larger ones;
* where overlaps are allowed, every step and the end of a run report them, even if no surfaces touch; crossings are counted;
* without contact forces bodies pass through each other.
"""

import numpy as np
import pytest

import taisoft as ts
from tests.collision.rotations import rotation

FAR = np.array([0.0, 50.0, 0.0])  # [m] away from everything else
SOFT = ts.Material(young=1e6)
BOX = ts.box_mesh((2, 2, 2), (1, 1, 1))
OBSTACLES = {
    "ground": ts.HalfSpace((0, -20, 0), (0, 1, 0)),
    "sphere": ts.Sphere((10, 0, 0), 0.4),
    "box": ts.Box((20, 0, 0), (0.5, 0.3, 0.4)),
    "capsule": ts.Capsule((30, 0, -0.5), (30, 0, 0.5), 0.3),
    "mesh": ts.MeshObstacle(BOX.vertices + (40, 0, 0), BOX.surface),
}
CUBE = ts.box_mesh((1, 1, 1), (1, 1, 1))
BODIES = {
    "cube": CUBE,
    "small": ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2)),
    "big": ts.box_mesh((3, 3, 3), (2, 2, 2)),
    "sheet": ts.sheet_mesh((2, 2), (2.0, 0.05, 2.0)),
    "rod": ts.box_mesh((1, 1, 1), (0.02, 2.0, 0.02)),
    "ball": ts.ball_mesh(0.5, 4),
    "two cubes": ts.TetMesh(
        np.concatenate([CUBE.vertices, CUBE.vertices + (2.0, 0, 0)]), np.concatenate([CUBE.tets, CUBE.tets + 8])
    ),
}


@pytest.fixture(scope="module")
def shared_sim():
    """Separate bodies and one obstacle of each kind."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, (name, mesh) in enumerate(BODIES.items()):
        scene.add_body(mesh, SOFT, name=name, position=FAR + (5.0 * k, 0, 0))
    for name, shape in OBSTACLES.items():
        scene.add_obstacle(shape, name=name)
    with ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision="f64", self_collision=True) as sim:
        yield sim, sim.positions()


@pytest.fixture
def sim(shared_sim):
    """The simulator with its bodies apart."""
    simulator, start = shared_sim
    simulator.set_state(start, np.zeros_like(start))
    return simulator


def place(sim, name: str, center, R=None) -> None:
    """Place a body's center [m], rotated by R (3,3)."""
    x = sim.scene.body(name).rest_positions
    sim.set_state(x @ (np.eye(3) if R is None else R).T + np.asarray(center, dtype=float), body=name)


def overlap(sim) -> tuple[set[str], float] | None:
    """Names and depth [m] of the deepest overlap."""
    deepest = sim.deepest_overlap()
    return None if deepest is None else ({deepest.name_a, deepest.name_b}, deepest.depth)


CORNER_DOWN = rotation((1, 0, -1), np.arccos(np.sqrt(1 / 3)))
LOW, TOP = np.sqrt(0.75), np.sqrt(0.5)  # [m] of a corner below the cube's center, and of an edge of the cube turned by 45 degrees
FACE = BODIES["ball"].vertices[BODIES["ball"].surface[0]]
NORMAL = np.cross(FACE[1] - FACE[0], FACE[2] - FACE[0])
OVER_FACE = (10, 0, 0) - (0.4 - 0.002) * NORMAL / np.linalg.norm(NORMAL) - FACE.mean(axis=0)
ABOUT_Z, ABOUT_X = rotation((0, 0, 1), np.pi / 4), rotation((1, 0, 0), np.pi / 4)
EDGE = (0.05, TOP + np.sqrt(2) - 0.03, 0.1)
CASES = {  # a body with its center [m] and rotation, the big body or none, the collider that it overlaps, and how deep [m]
    "two bodies": (("cube", (0, 0, 0)), ("big", (0.3, 1.48, 0.2)), "big", 0.02),
    "a corner in a face": (("cube", (0.1, LOW - 0.05, 0.05), CORNER_DOWN), ("big", (0, -1, 0)), "big", 0.05),
    "wholly inside": (("small", (0.3, 0.1, 0.2)), ("big", (0, 0, 0)), "big", 0.8),  # of the vertex at x = 0.2
    "crossing edges": (("cube", (0, 0, 0), ABOUT_Z), ("big", EDGE, ABOUT_X), "big", 0.03),
    "on ground": (("cube", (3, -19.6, 1)), None, "ground", 0.1),
    "a vertex in a sphere": (("cube", (10.1, 0.85, 0.1)), None, "sphere", 0.05),
    "in a box": (("cube", (20.2, 0.7, 0.05)), None, "box", 0.1),
    "in a capsule": (("cube", (30.05, 0.75, 0.1)), None, "capsule", 0.05),
    "inside a sphere": (("small", (10, 0.01, 0)), None, "sphere", 0.4),  # its center lies in the body
    "inside a box": (("small", (20, 0.01, 0)), None, "box", 0.29),
    "inside a mesh": (("small", (40, 0.01, 0)), None, "mesh", 0.49),
    "a corner beside a sphere's center": (("big", (11, 1, 1) - np.full(3, 0.401 / np.sqrt(3))), None, "sphere", 0.4),
    "a face over a sphere": (("ball", OVER_FACE), None, "sphere", 0.002),  # all vertices lie outside
    "a rod beside the axis of a capsule": (("rod", (30.1, 0, 0.3)), None, "capsule", 0.21),
}


@pytest.mark.parametrize("name", CASES)
def test_depth_and_names(sim, name):
    first, second, other, depth = CASES[name]
    for body in (first, second) if second else (first,):
        place(sim, *body)
    names, found = overlap(sim)
    assert names == {first[0], other} and found == pytest.approx(depth, rel=1e-6)


def test_separate_and_flush_bodies_do_not_overlap(sim):
    """Face on face, edge along edge, a face on every obstacle, and an overlap below 1e-6 of the size."""
    assert overlap(sim) is None
    for name in ("sphere", "box", "capsule", "mesh"):
        place(sim, "big", OBSTACLES[name].pivot)  # it lies wholly inside the body
        names, depth = overlap(sim)
        assert names == {"big", name} and depth >= 0.1
    place(sim, "big", (0, 0, 0))
    place(sim, "cube", (0.5, 1.5, 0.5))
    place(sim, "small", (1.1, 1.1, 0.0))
    place(sim, "ball", (-0.2, -1.5 + 4e-7, 0.1))
    assert overlap(sim) is None
    for center in ((3, -19.5, 0), (10, 0.9, 0), (20, 0.8, 0), (30, 0.8, 0), (40, 1.0, 0)):
        place(sim, "cube", center)
        assert overlap(sim) is None
        place(sim, "cube", np.add(center, (0, -1e-5, 0)))
        assert overlap(sim)[1] == pytest.approx(1e-5, rel=1e-3)


def problems(sim) -> tuple[list[str], list[str]]:
    """Problems of a run of two steps, and of its first step."""
    report = sim.run(2 * sim.dt, fps=None)
    assert all(r.deep == bool(r.problems) and (r.max_penetration > 0.01) == bool(r.problems) for r in report.step_reports)
    assert (report.status == "ok") == (not report.problems)
    return report.problems, [text.split(": ", 1)[1] for text in report.step_reports[0].problems]


def test_runs_report_overlaps_without_crossing_triangles(sim):
    start = sim.positions()
    assert problems(sim) == ([], [])
    cases = [("small", "big", (0.3, 0.1, 0.2)), ("cube", "mesh", OBSTACLES["mesh"].pivot)]  # inside; coincident surfaces
    cases += [("small", name, OBSTACLES[name].pivot + (0.0, 0.01, 0.0)) for name in ("sphere", "box", "capsule", "mesh")]
    cases += [("big", name, OBSTACLES[name].pivot) for name in ("sphere", "mesh")]
    for inner, outer, center in cases:
        sim.set_state(start, np.zeros_like(start))
        if outer == "big":
            place(sim, "big", (0, 0, 0))
        place(sim, inner, center)
        of_run, of_step = problems(sim)
        expected = [f"'{a}' and '{b}' overlap by" for a, b in ((inner, outer), (outer, inner))]
        assert any(text.startswith(tuple(expected)) for text in of_step)
        assert any(text.startswith(tuple(f"at the end {text}" for text in expected)) for text in of_run)
    sim.set_state(start, np.zeros_like(start))
    a, b = np.split(sim.positions("two cubes"), 2)
    for scale, shift in ((1.0, 0.0), (0.1, 0.2)):  # the second cube coincides with the first, or lies inside it
        b = a.mean(axis=0) + shift + scale * (a - a.mean(axis=0))
        sim.set_state(np.concatenate([a, b]), body="two cubes")
        of_run, of_step = problems(sim)
        assert any(text.startswith("parts of 'two cubes' overlap by") for text in of_step) and len(of_run) == 1


def test_runs_report_crossings(sim):
    """A rod through a sheet: no vertex of either lies near the other."""
    place(sim, "sheet", (0, 0, 0))
    place(sim, "rod", (0.35, 0.1, 0.55))
    assert overlap(sim)[0] == {"sheet", "rod"} and len(sim.intersecting_triangles()) > 0
    report = sim.run(2 * sim.dt, fps=None)
    last = report.step_reports[-1]
    assert last.crossings > 3 and last.deep == 1 and last.max_penetration > 1e-3
    assert report.status == "degraded" and any("crossing pairs of triangles" in text for text in report.problems)


def two_bodies(depth: float, shift: float = 0.1) -> ts.Scene:
    """Two cubes of 1 m that overlap by a depth [m]."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, name in enumerate(("lower", "upper")):
        scene.add_body(CUBE, SOFT, name=name, position=(shift * k, (1 - depth) * k, 0))
    return scene


def test_a_simulator_refuses_coincident_bodies():
    with pytest.raises(ts.SceneError, match=r"^'lower' and 'upper' overlap at the start, 0.5 m deep: move them apart, or set "):
        ts.Simulator(two_bodies(1.0, 0.0), dt=1e-4, integrator="symplectic_euler", precision="f64")


def test_without_contact_forces_bodies_pass_through_each_other():
    scene = two_bodies(0.125)
    with pytest.raises(ts.SceneError, match="^scene: contact_forces must be True or False, not 1$"):
        scene.contact_forces = 1
    scene.gravity, scene.contact_forces = (0, -9.81, 0), False
    with ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision="f64") as sim:
        assert len(sim.detect_contacts()) and len(sim.contacts()) == 0
        start = sim.positions()
        reports = [sim.step() for _ in range(3)]
        displacement = sim.positions() - start
    assert np.abs(displacement - (1 + 2 + 3) * np.array([0, -9.81, 0]) * 1e-4**2).max() < 1e-14  # [m]
    assert all(r.converged and not r.n_contacts and not r.problems for r in reports)
