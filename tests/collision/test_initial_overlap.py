"""Overlaps in the initial state:

* the deepest overlap has the right names and exact depth: two bodies; a body and each kind of obstacle; one wholly inside the
  other; a face over a sphere; crossing edges and a rod through a sheet or a capsule, where no vertex lies inside;
* flush bodies, and overlaps below 1e-6 of the size, do not count; a Simulator refuses larger ones;
* where overlaps are allowed, every step and the end of a run report them, even if no surfaces touch;
* signed distances at points equal those of a grid and brute force.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.sdf import signed_distances, signed_distances_at
from tests.collision.rotations import rotation

FAR = np.array([0.0, 50.0, 0.0])  # [m] away from everything else
SOFT = ts.Material(young=1e6)
OBSTACLES = {
    "ground": ts.HalfSpace((0, -20, 0), (0, 1, 0)),
    "sphere": ts.Sphere((10, 0, 0), 0.4),
    "box": ts.Box((20, 0, 0), (0.5, 0.3, 0.4)),
    "capsule": ts.Capsule((30, 0, -0.5), (30, 0, 0.5), 0.3),
    "mesh": ts.MeshObstacle(ts.box_mesh((2, 2, 2), (1, 1, 1)).vertices + (40, 0, 0), ts.box_mesh((2, 2, 2), (1, 1, 1)).surface),
}


def two_cubes() -> ts.TetMesh:
    """Two separate cubes in one mesh."""
    cube = ts.box_mesh((1, 1, 1), (1, 1, 1))
    vertices = np.concatenate([cube.vertices, cube.vertices + (2.0, 0, 0)])
    return ts.TetMesh(vertices, np.concatenate([cube.tets, cube.tets + cube.n_verts]))


def make_scene() -> ts.Scene:
    """Separate bodies and one obstacle of each kind."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, (name, mesh) in enumerate(
        (
            ("cube", ts.box_mesh((1, 1, 1), (1, 1, 1))),
            ("small", ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2))),
            ("big", ts.box_mesh((3, 3, 3), (2, 2, 2))),
            ("sheet", ts.sheet_mesh((2, 2), (2.0, 0.05, 2.0))),
            ("rod", ts.box_mesh((1, 1, 1), (0.02, 2.0, 0.02))),
            ("ball", ts.ball_mesh(0.5, 4)),
            ("two cubes", two_cubes()),
        )
    ):
        scene.add_body(mesh, SOFT, name=name, position=FAR + (5.0 * k, 0, 0))
    for name, shape in OBSTACLES.items():
        scene.add_obstacle(shape, name=name)
    return scene


@pytest.fixture(scope="module")
def shared_sim():
    with ts.Simulator(make_scene(), dt=1e-4, integrator="symplectic_euler", precision="f64", self_collision=True) as sim:
        yield sim, sim.positions()


@pytest.fixture
def sim(shared_sim):
    """The simulator with its bodies apart."""
    simulator, start = shared_sim
    simulator.set_state(start)
    return simulator


def place(sim, name: str, center, R=None) -> None:
    """Place a body's center [m], rotated by R (3,3)."""
    x = sim.scene.body(name).rest_positions
    sim.set_state(x @ (np.eye(3) if R is None else R).T + np.asarray(center, dtype=float), body=name)


def overlap(sim) -> tuple[set[str], float] | None:
    """Names and depth [m] of the deepest overlap."""
    deepest = sim.deepest_overlap()
    return None if deepest is None else ({deepest.name_a, deepest.name_b}, deepest.depth)


def test_separate_bodies_do_not_overlap(sim):
    assert overlap(sim) is None


@pytest.mark.parametrize("depth", [1e-4, 0.02, 0.3])
def test_two_bodies(sim, depth):
    place(sim, "cube", (0, 0, 0))
    place(sim, "big", (0.3, 1.5 - depth, 0.2))
    names, found_depth = overlap(sim)
    assert names == {"cube", "big"} and found_depth == pytest.approx(depth, rel=1e-9)


def test_a_corner_in_a_face(sim):
    """The corner of a cube is the only vertex inside."""
    corner_down = rotation((1, 0, -1), np.arccos(np.sqrt(1 / 3)))
    low = (sim.scene.body("cube").rest_positions @ corner_down.T)[:, 1].min()
    place(sim, "big", (0, -1.0, 0))
    place(sim, "cube", (0.1, -low - 0.05, 0.05), corner_down)
    names, found_depth = overlap(sim)
    assert names == {"cube", "big"} and found_depth == pytest.approx(0.05, rel=1e-9)


def test_a_body_wholly_inside(sim):
    place(sim, "big", (0, 0, 0))
    place(sim, "small", (0.3, 0.1, 0.2))
    names, found_depth = overlap(sim)
    assert names == {"big", "small"} and found_depth == pytest.approx(1.0 - 0.2, rel=1e-9)  # of the vertex at x = 0.2


@pytest.mark.parametrize(
    "name, center, depth",
    [
        ("ground", (3, -19.6, 1), 0.1),
        ("ground", (3, -40.0, 1), 20.5),
        ("sphere", (10.1, 0.85, 0.1), 0.05),
        ("box", (20.2, 0.7, 0.05), 0.1),
        ("capsule", (30.05, 0.75, 0.1), 0.05),
        ("mesh", (40.2, 0.9, 0.3), 0.1),
    ],
)
def test_a_body_in_an_obstacle(sim, name, center, depth):
    """The depth is that of a body vertex, of a face over a round obstacle, or of an obstacle vertex."""
    place(sim, "cube", center)
    names, found_depth = overlap(sim)
    assert names == {"cube", name} and found_depth == pytest.approx(depth, rel=1e-6)


@pytest.mark.parametrize("name", ["sphere", "box", "capsule", "mesh"])
def test_an_obstacle_wholly_inside(sim, name):
    place(sim, "big", OBSTACLES[name].pivot)
    names, found_depth = overlap(sim)
    assert names == {"big", name} and found_depth >= 0.1


@pytest.mark.parametrize("depth", [1e-3, -1e-3])
def test_a_corner_beside_a_vertex(sim, depth):
    """The sphere's center lies in the body; whether a corner of the body lies in the sphere too makes no difference."""
    offset = (0.4 - depth) / np.sqrt(3)
    place(sim, "big", OBSTACLES["sphere"].center + np.array([1.0, 1.0, 1.0]) - offset)
    names, found_depth = overlap(sim)
    assert names == {"big", "sphere"} and found_depth == pytest.approx(0.4, rel=1e-9)


@pytest.mark.parametrize("name, depth", [("sphere", 0.4), ("box", 0.29), ("capsule", 0.3), ("mesh", 0.49)])
def test_a_body_wholly_inside_an_obstacle(sim, name, depth):
    """The body's center, 0.01 m above the obstacle's, is deepest; the center of a sphere or capsule lies in the body."""
    place(sim, "small", OBSTACLES[name].pivot + (0.0, 0.01, 0.0))
    names, found_depth = overlap(sim)
    assert names == {"small", name} and found_depth == pytest.approx(depth, rel=1e-9)


def test_a_face_over_a_sphere(sim):
    """A face of the ball overlaps the sphere, and all vertices lie outside."""
    nodes = sim.scene.body("ball").nodes
    face = nodes.positions[nodes.surface[0]]
    n = np.cross(face[1] - face[0], face[2] - face[0])
    n /= np.linalg.norm(n)
    place(sim, "ball", OBSTACLES["sphere"].center - (0.4 - 0.002) * n - face.mean(axis=0))
    x = sim.positions("ball")
    assert np.linalg.norm(x - OBSTACLES["sphere"].center, axis=1).min() > 0.4
    names, found_depth = overlap(sim)
    assert names == {"ball", "sphere"} and found_depth == pytest.approx(0.002, rel=1e-6)


def test_crossing_edges(sim):
    """An edge of a cube across an edge of another, no vertex inside."""
    place(sim, "cube", (0, 0, 0), rotation((0, 0, 1), np.pi / 4))
    top = np.sqrt(0.5)
    place(sim, "big", (0.05, top + np.sqrt(2) - 0.03, 0.1), rotation((1, 0, 0), np.pi / 4))
    names, found_depth = overlap(sim)
    assert names == {"cube", "big"} and found_depth == pytest.approx(0.03, rel=1e-6)


def test_a_rod_through_a_sheet(sim):
    """No vertex of either lies near the other."""
    place(sim, "sheet", (0, 0, 0))
    place(sim, "rod", (0.35, 0.1, 0.55))
    assert len(sim.intersecting_triangles()) > 0
    names, _ = overlap(sim)
    assert names == {"sheet", "rod"}


@pytest.mark.parametrize("offset, depth", [((0.0, 0.0, 0.3), 0.3), ((0.1, 0.0, 0.3), 0.21)])
def test_a_rod_through_a_capsule(sim, offset, depth):
    """Through the axis and beside it."""
    place(sim, "rod", OBSTACLES["capsule"].pivot + np.array(offset))
    names, found_depth = overlap(sim)
    assert names == {"rod", "capsule"} and found_depth == pytest.approx(depth, rel=1e-9)


def test_flush_bodies_do_not_overlap(sim):
    """Face on face, edge along edge, a face on every obstacle, and an overlap below 1e-6 of the size."""
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
    cases += [("big", name, OBSTACLES[name].pivot) for name in ("sphere", "box", "capsule", "mesh")]
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
    sim.set_state(start, np.zeros_like(start))


def two_bodies(depth: float, shift: float = 0.1) -> ts.Scene:
    """Two cubes of 1 m that overlap by a depth [m]."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, name in enumerate(("lower", "upper")):
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), SOFT, name=name, position=(shift * k, (1 - depth) * k, 0))
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


BALL, BOX = ts.ball_mesh(0.5, 4), ts.box_mesh((2, 1, 3), (0.6, 0.9, 0.7))
SURFACES = {
    "ball": (BALL.vertices, BALL.surface),
    "bent box": (BOX.vertices + 0.2 * np.sin(3 * BOX.vertices[:, ::-1]), BOX.surface),
}


@pytest.mark.parametrize("name", SURFACES)
def test_signed_distances_at_points(name):
    vertices, triangles = SURFACES[name]
    axes = [np.linspace(-0.9, 0.8, k) for k in (9, 8, 7)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    phi = signed_distances_at(vertices, triangles, points)
    assert np.abs(phi - signed_distances(vertices, triangles, axes).ravel()).max() < 1e-12
    assert (phi < 0).sum() > 5 and (phi > 0).sum() > 5
    # brute force: distances to samples of every triangle, and the sign by the solid angle of the surface
    k = 24
    u, v = (a.ravel() / k for a in np.meshgrid(np.arange(k + 1), np.arange(k + 1)))
    u, v = u[u + v <= 1], v[u + v <= 1]
    a, b, c = (vertices[triangles[:, j]] for j in range(3))
    samples = (a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]).reshape(-1, 3)
    subset = np.random.default_rng(0).permutation(len(points))[:150]
    nearest = np.array([np.linalg.norm(samples - p, axis=1).min() for p in points[subset]])
    assert (np.abs(phi[subset]) <= nearest + 1e-12).all() and (nearest - np.abs(phi[subset])).max() < 0.03
    A, B, C = (x[None] - points[subset][:, None] for x in (a, b, c))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (A, B, C))
    volume = np.einsum("ptx,ptx->pt", A, np.cross(B, C))
    denominator = la * lb * lc + (A * B).sum(2) * lc + (B * C).sum(2) * la + (C * A).sum(2) * lb
    winding = (2 * np.arctan2(volume, denominator)).sum(axis=1) / (4 * np.pi)  # Van Oosterom and Strackee 1983
    assert np.array_equal(winding > 0.5, phi[subset] < 0)
    on_surface = signed_distances_at(vertices, triangles, vertices[np.unique(triangles)])
    assert np.abs(on_surface).max() < 1e-12 and signed_distances_at(vertices, triangles, np.zeros((0, 3))).shape == (0,)
