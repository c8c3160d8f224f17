"""What overlaps at the start is refused, and told with both names and its depth:

* two bodies, a body and every kind of obstacle; one wholly inside another; a ball's face over a sphere; edges that cross, and
  a rod through a sheet or a capsule, where no vertex lies inside; doubles and others whose surfaces coincide;
* the depth is the exact one; bodies that lie flush, and those deeper by less than 1e-6 of their size, are allowed;
* where it is allowed, every step and the end of a run tell what lies inside what, although nothing touches;
* signed distances at points are those of a grid and those of brute force.
"""

import numpy as np
import pytest
from rotations import rotation

import taisoft as ts
from taisoft.collision.overlap import find_overlaps
from taisoft.mesh.sdf import signed_distances, signed_distances_at

FAR = np.array([0.0, 50.0, 0.0])  # [m] where a body is out of the way
SOFT = ts.Material(young=1e6)
OBSTACLES = {
    "ground": ts.HalfSpace((0, -20, 0), (0, 1, 0)),
    "sphere": ts.Sphere((10, 0, 0), 0.4),
    "box": ts.Box((20, 0, 0), (0.5, 0.3, 0.4)),
    "capsule": ts.Capsule((30, 0, -0.5), (30, 0, 0.5), 0.3),
    "mesh": ts.MeshObstacle(ts.box_mesh((2, 2, 2), (1, 1, 1)).vertices + (40, 0, 0), ts.box_mesh((2, 2, 2), (1, 1, 1)).surface),
}


def parts() -> ts.TetMesh:
    """Two cubes in one mesh, beside each other."""
    one = ts.box_mesh((1, 1, 1), (1, 1, 1))
    vertices = np.concatenate([one.vertices, one.vertices + (2.0, 0, 0)])
    return ts.TetMesh(vertices, np.concatenate([one.tets, one.tets + one.n_verts]))


def scene() -> ts.Scene:
    """Bodies apart, and one obstacle of each kind; the tests put bodies where they overlap."""
    made = ts.Scene(gravity=(0, 0, 0))
    for k, (name, mesh) in enumerate(
        (
            ("cube", ts.box_mesh((1, 1, 1), (1, 1, 1))),
            ("small", ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2))),
            ("big", ts.box_mesh((3, 3, 3), (2, 2, 2))),
            ("sheet", ts.sheet_mesh((2, 2), (2.0, 0.05, 2.0))),
            ("rod", ts.box_mesh((1, 1, 1), (0.02, 2.0, 0.02))),
            ("ball", ts.ball_mesh(0.5, 4)),
            ("parts", parts()),
        )
    ):
        made.add_body(mesh, SOFT, name=name, position=FAR + (5.0 * k, 0, 0))
    for name, shape in OBSTACLES.items():
        made.add_obstacle(shape, name=name)
    return made


@pytest.fixture(scope="module")
def made():
    with ts.Simulator(scene(), dt=1e-4, integrator="symplectic_euler", precision="f64", self_collision=True) as sim:
        yield sim, sim.positions()


@pytest.fixture
def sim(made):
    """Everything apart."""
    made[0].set_state(made[1])
    return made[0]


def put(sim, name: str, at, turn=None) -> None:
    """A body's middle to a place [m]."""
    x = sim.scene.body(name).rest_positions
    sim.set_state(x @ (np.eye(3) if turn is None else turn).T + np.asarray(at, dtype=float), body=name)


def overlap(sim) -> tuple[set[str], float] | None:
    sim._dynamics.contact.search(0.0, sim.dt)
    found = next(iter(find_overlaps(sim._dynamics.contact.detection)), None)
    return None if found is None else ({found.name_a, found.name_b}, found.depth)


def test_nothing_overlaps(sim):
    assert overlap(sim) is None


@pytest.mark.parametrize("depth", [1e-4, 0.02, 0.3])
def test_two_bodies(sim, depth):
    put(sim, "cube", (0, 0, 0))
    put(sim, "big", (0.3, 1.5 - depth, 0.2))
    names, found = overlap(sim)
    assert names == {"cube", "big"} and found == pytest.approx(depth, rel=1e-9)


def test_a_corner_in_a_face(sim):
    """A cube on its corner; the corner is the only vertex inside."""
    corner_down = rotation((1, 0, -1), np.arccos(np.sqrt(1 / 3)))
    low = (sim.scene.body("cube").rest_positions @ corner_down.T)[:, 1].min()
    put(sim, "big", (0, -1.0, 0))
    put(sim, "cube", (0.1, -low - 0.05, 0.05), corner_down)
    names, found = overlap(sim)
    assert names == {"cube", "big"} and found == pytest.approx(0.05, rel=1e-9)


def test_a_body_wholly_inside(sim):
    put(sim, "big", (0, 0, 0))
    put(sim, "small", (0.3, 0.1, 0.2))
    names, found = overlap(sim)
    assert names == {"big", "small"} and found == pytest.approx(1.0 - 0.2, rel=1e-9)  # of the vertex at x = 0.2


@pytest.mark.parametrize(
    "name, at, depth",
    [
        ("ground", (3, -19.6, 1), 0.1),
        ("ground", (3, -40.0, 1), 20.5),
        ("sphere", (10.1, 0.85, 0.1), 0.05),
        ("box", (20.2, 0.7, 0.05), 0.1),
        ("capsule", (30.05, 0.75, 0.1), 0.05),
        ("mesh", (40.2, 0.9, 0.3), 0.1),
    ],
)
def test_a_body_in_an_obstacle(sim, name, at, depth):
    """By its vertices, by its faces over something round, or by the obstacle's own vertices."""
    put(sim, "cube", at)
    names, found = overlap(sim)
    assert names == {"cube", name} and found == pytest.approx(depth, rel=1e-6)


@pytest.mark.parametrize("name", ["sphere", "box", "capsule", "mesh"])
def test_an_obstacle_wholly_inside(sim, name):
    put(sim, "big", OBSTACLES[name].pivot)
    names, found = overlap(sim)
    assert names == {"big", name} and found >= 0.1


@pytest.mark.parametrize("depth", [1e-3, -1e-3])
def test_a_corner_beside_a_vertex(sim, depth):
    """The sphere's middle lies in the body; whether a corner of that is in the sphere too makes no difference."""
    reach = (0.4 - depth) / np.sqrt(3)
    put(sim, "big", OBSTACLES["sphere"].center + np.array([1.0, 1.0, 1.0]) - reach)
    names, found = overlap(sim)
    assert names == {"big", "sphere"} and found == pytest.approx(0.4, rel=1e-9)


@pytest.mark.parametrize("name, depth", [("sphere", 0.4), ("box", 0.29), ("capsule", 0.3), ("mesh", 0.49)])
def test_a_body_wholly_inside_an_obstacle(sim, name, depth):
    """Its middle lies deepest, 0.01 m above that of the obstacle; of a sphere and a capsule the middle lies in the body."""
    put(sim, "small", OBSTACLES[name].pivot + (0.0, 0.01, 0.0))
    names, found = overlap(sim)
    assert names == {"small", name} and found == pytest.approx(depth, rel=1e-9)


def test_a_face_over_a_sphere(sim):
    """A face of the ball is the only part of it that touches; the sphere is smaller than the face is far from its corners."""
    nodes = sim.scene.body("ball").nodes
    face = nodes.positions[nodes.surface[0]]
    n = np.cross(face[1] - face[0], face[2] - face[0])
    n /= np.linalg.norm(n)
    put(sim, "ball", OBSTACLES["sphere"].center - (0.4 - 0.002) * n - face.mean(axis=0))
    x = sim.positions("ball")
    assert np.linalg.norm(x - OBSTACLES["sphere"].center, axis=1).min() > 0.4
    names, found = overlap(sim)
    assert names == {"ball", "sphere"} and found == pytest.approx(0.002, rel=1e-6)


def test_edges_that_cross(sim):
    """Two cubes on their edges, one edge across the other, no vertex inside."""
    put(sim, "cube", (0, 0, 0), rotation((0, 0, 1), np.pi / 4))
    top = np.sqrt(0.5)
    put(sim, "big", (0.05, top + np.sqrt(2) - 0.03, 0.1), rotation((1, 0, 0), np.pi / 4))
    names, found = overlap(sim)
    assert names == {"cube", "big"} and found == pytest.approx(0.03, rel=1e-6)


def test_a_rod_through_a_sheet(sim):
    """No vertex of either is near the other."""
    put(sim, "sheet", (0, 0, 0))
    put(sim, "rod", (0.35, 0.1, 0.55))
    assert len(sim.intersecting_triangles()) > 0
    names, _ = overlap(sim)
    assert names == {"sheet", "rod"}


@pytest.mark.parametrize("at, depth", [((0.0, 0.0, 0.3), 0.3), ((0.1, 0.0, 0.3), 0.21)])
def test_a_rod_through_a_capsule(sim, at, depth):
    """Across its axis, which is the deepest, and beside it."""
    put(sim, "rod", OBSTACLES["capsule"].pivot + np.array(at))
    names, found = overlap(sim)
    assert names == {"rod", "capsule"} and found == pytest.approx(depth, rel=1e-9)


def test_flush_bodies_are_allowed(sim):
    """Faces on faces, an edge along an edge, a face on every obstacle; and less than 1e-6 of the size."""
    put(sim, "big", (0, 0, 0))
    put(sim, "cube", (0.5, 1.5, 0.5))
    put(sim, "small", (1.1, 1.1, 0.0))
    put(sim, "ball", (-0.2, -1.5 + 4e-7, 0.1))
    assert overlap(sim) is None
    for at in ((3, -19.5, 0), (10, 0.9, 0), (20, 0.8, 0), (30, 0.8, 0), (40, 1.0, 0)):
        put(sim, "cube", at)
        assert overlap(sim) is None
        put(sim, "cube", np.add(at, (0, -1e-5, 0)))
        assert overlap(sim)[1] == pytest.approx(1e-5, rel=1e-3)


def problems(sim) -> tuple[list[str], list[str]]:
    """What two steps and the end of their run tell, and what the first of them does."""
    report = sim.run(2 * sim.dt, fps=None)
    assert all(r.deep == bool(r.problems) and (r.max_penetration > 0.01) == bool(r.problems) for r in report.step_reports)
    assert (report.status == "ok") == (not report.problems)
    return report.problems, [text.split(": ", 1)[1] for text in report.step_reports[0].problems]


def test_steps_tell_what_lies_inside_what(sim):
    """Nothing touches there, and no triangles cross."""
    start = sim.positions()
    assert problems(sim) == ([], [])
    cases = [("small", "big", (0.3, 0.1, 0.2)), ("cube", "mesh", OBSTACLES["mesh"].pivot)]  # inside, and a double
    cases += [("small", name, OBSTACLES[name].pivot + (0.0, 0.01, 0.0)) for name in ("sphere", "box", "capsule", "mesh")]
    cases += [("big", name, OBSTACLES[name].pivot) for name in ("sphere", "box", "capsule", "mesh")]
    for inner, outer, at in cases:
        sim.set_state(start, np.zeros_like(start))
        if outer == "big":
            put(sim, "big", (0, 0, 0))
        put(sim, inner, at)
        at_end, at_first = problems(sim)
        told = [f"'{a}' and '{b}' overlap by" for a, b in ((inner, outer), (outer, inner))]
        assert any(text.startswith(tuple(told)) for text in at_first)
        assert any(text.startswith(tuple(f"at the end {one}" for one in told)) for text in at_end)
    sim.set_state(start, np.zeros_like(start))
    x = sim.positions("parts")
    for scale, shift in ((1.0, 0.0), (0.1, 0.2)):  # one part the double of the other, and inside it
        x[8:] = x[8:].mean(axis=0) + scale * (x[:8] - x[:8].mean(axis=0))
        sim.set_state(x + np.repeat([[0.0], [1.0]], 8, axis=0) * (x[:8].mean(axis=0) - x[8:].mean(axis=0) + shift), body="parts")
        at_end, at_first = problems(sim)
        assert any(text.startswith("parts of 'parts' overlap by") for text in at_first) and len(at_end) == 1
    sim.set_state(start, np.zeros_like(start))


def two(depth: float, step: float = 0.1) -> ts.Scene:
    made = ts.Scene(gravity=(0, 0, 0))
    for k in range(2):
        at = (step * k, (1 - depth) * k, 0)
        made.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), SOFT, name=("lower", "upper")[k], position=at)
    return made


def test_a_simulator_refuses_it():
    """Two bodies with nothing but their names to tell them apart."""
    with pytest.raises(ts.SceneError, match=r"^'lower' and 'upper' overlap at the start, 0.5 m deep: move them apart, or set "):
        ts.Simulator(two(1.0, 0.0), dt=1e-4, integrator="symplectic_euler", precision="f64")


def test_without_contact_forces_bodies_pass_through_each_other():
    made = two(0.125)
    with pytest.raises(ts.SceneError, match="^scene: contact_forces must be True or False, not 1$"):
        made.contact_forces = 1
    made.gravity, made.contact_forces = (0, -9.81, 0), False
    with ts.Simulator(made, dt=1e-4, integrator="symplectic_euler", precision="f64") as sim:
        assert len(sim.detect_contacts()) and len(sim.contacts()) == 0
        start = sim.positions()
        reports = [sim.step() for _ in range(3)]
        fallen = sim.positions() - start
    assert np.abs(fallen - 6 * np.array([0, -9.81, 0]) * 1e-4**2).max() < 1e-14  # [m], of 1 + 2 + 3 steps' speeds
    assert all(r.converged and not r.n_contacts and not r.problems for r in reports)


def surfaces():
    ball, box = ts.ball_mesh(0.5, 4), ts.box_mesh((2, 1, 3), (0.6, 0.9, 0.7))
    bent = box.vertices + 0.2 * np.sin(3 * box.vertices[:, ::-1])
    return {"ball": (ball.vertices, ball.surface), "bent box": (bent, box.surface)}


@pytest.mark.parametrize("name", ["ball", "bent box"])
def test_signed_distances_at_points(name):
    vertices, triangles = surfaces()[name]
    axes = [np.linspace(-0.9, 0.8, k) for k in (9, 8, 7)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    phi = signed_distances_at(vertices, triangles, points)
    assert np.abs(phi - signed_distances(vertices, triangles, axes).ravel()).max() < 1e-12
    assert (phi < 0).sum() > 5 and (phi > 0).sum() > 5
    # brute force: the distance of samples of every triangle; the sign by how much of the whole angle the surface fills
    k = 24
    u, v = (a.ravel() / k for a in np.meshgrid(np.arange(k + 1), np.arange(k + 1)))
    u, v = u[u + v <= 1], v[u + v <= 1]
    a, b, c = (vertices[triangles[:, j]] for j in range(3))
    samples = (a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]).reshape(-1, 3)
    some = np.random.default_rng(0).permutation(len(points))[:150]
    nearest = np.array([np.linalg.norm(samples - p, axis=1).min() for p in points[some]])
    assert (np.abs(phi[some]) <= nearest + 1e-12).all() and (nearest - np.abs(phi[some])).max() < 0.03
    A, B, C = (x[None] - points[some][:, None] for x in (a, b, c))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (A, B, C))
    volume = np.einsum("ptx,ptx->pt", A, np.cross(B, C))
    other = la * lb * lc + (A * B).sum(2) * lc + (B * C).sum(2) * la + (C * A).sum(2) * lb
    winding = (2 * np.arctan2(volume, other)).sum(axis=1) / (4 * np.pi)
    assert np.array_equal(winding > 0.5, phi[some] < 0)
    on = signed_distances_at(vertices, triangles, vertices[np.unique(triangles)])
    assert np.abs(on).max() < 1e-12 and signed_distances_at(vertices, triangles, np.zeros((0, 3))).shape == (0,)
