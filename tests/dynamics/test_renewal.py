"""Contacts take their geometry at the end of an implicit step.

* Normals and gaps that a step reports are those of its end: of a curved obstacle, one that turns, of attached bodies, of a body
  that touches itself.
* What slides without friction passes a seam of flush boxes, meshes and bodies.
* A frictionless cube swings in a bowl as far up as it came down, and never farther.
* Where nothing moves, nothing is searched again.
* What overlaps from the start is not thrown apart.
* Contacts that outgrow their storage within a step get more.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.detector import Detection
from tests.dynamics.scenes import dynamics

RUBBER = ts.Material(young=1e5, friction=0.0)
CENTRE, RADIUS = np.array([0.0, -0.5, 0.0]), 0.5


def end_errors(scene: ts.Scene, truth, steps: int = 20, integrator: str = "implicit_euler") -> tuple[float, float, int]:
    """How far the contacts that press are from truth(points (k,3), time) -> (distances (k,), normals (k,3)) of an obstacle.

    Compared at the end of each of some steps of 10 ms: the largest errors of normals and of gaps [m], and the number of contacts.
    """
    turned, missed, n = 0.0, 0.0, 0
    with ts.Simulator(scene, dt=0.01, integrator=integrator, precision="f64") as sim:
        for _ in range(steps):
            assert sim.step().converged
            c = sim.contacts()
            pressed = np.linalg.norm(c.impulse, axis=1) > 0.0
            points = np.einsum("kj,kjx->kx", np.where(c.nodes >= 0, c.weights, 0.0), sim.positions()[c.nodes])
            distance, normal = truth(points, sim.time)
            turned = max(turned, np.linalg.norm(c.normal - normal, axis=1)[pressed].max(initial=0.0))
            missed = max(missed, np.abs(c.gap - distance)[pressed].max(initial=0.0))
            n += pressed.sum()
    return turned, missed, n


def from_ball(points: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    offset = points - CENTRE
    distance = np.linalg.norm(offset, axis=1)
    return distance - RADIUS, offset / distance[:, None]


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "linearly_implicit_euler"])
def test_normals_and_gaps_are_those_of_the_end(integrator):
    """Of a cube that slides over a ball by a tenth of an edge a step, which turns a normal by 0.022 to 0.028."""
    scene = ts.Scene()
    scene.add_obstacle(ts.Sphere(CENTRE, RADIUS), name="ball", friction=0.0)
    cube = ts.box_mesh((3, 3, 3), (0.3, 0.3, 0.3))
    scene.add_body(cube, RUBBER, name="cube", position=(0, 0.151, 0), velocity=(1.0, 0, 0.5))
    turned, missed, n = end_errors(scene, from_ball, integrator=integrator)
    linear = integrator == "linearly_implicit_euler"
    assert n > 50 and turned < (0.024 if linear else 0.002)
    assert missed < (2e-4 if linear else 1e-5)  # [m]; the slip in a step is 1e-2 m


def test_contacts_of_attached_nodes():
    """Of two halves of that cube, joined over the ball: points of their own nodes are those of the nodes that these depend on."""
    scene = ts.Scene()
    scene.add_obstacle(ts.Sphere(CENTRE, RADIUS), name="ball", friction=0.0)
    half = ts.box_mesh((2, 3, 3), (0.15, 0.3, 0.3))
    for name, x in (("left", -0.075), ("right", 0.075)):
        scene.add_body(half, RUBBER, name=name, position=(x, 0.151, 0), velocity=(1.0, 0, 0.5))
    scene.attach("right", lambda X: X[:, 0] < -0.07, "left")
    turned, missed, n = end_errors(scene, from_ball)
    assert n > 20 and turned < 0.002 and missed < 1e-5
    changed, differ = 0, 0
    with dynamics(scene, dt=0.01, precision="f64") as made:
        for _ in range(20):
            made.advance(1)
            x, rows = made.state.state()[0], (made.contact.rows(), made.contact.rows(own=True))
            masters, own = (np.einsum("kj,kjx->kx", np.where(r.nodes >= 0, r.weights, 0.0), x[r.nodes]) for r in rows)
            assert len(own) == len(masters) and np.abs(own - masters).max(initial=0.0) < 1e-12
            changed += made.contact.problem.renewal.match.to_numpy().any()
            differ += sum(set(a[a >= 0]) != set(b[b >= 0]) for a, b in zip(*(r.nodes for r in rows)))
    assert changed and differ  # contacts were renewed, and some are at the joint


def test_an_obstacle_that_turns():
    """A plate turns by 0.02 a step under a cube that rests on it."""

    def pose(t):
        c, s = np.cos(2.0 * t), np.sin(2.0 * t)
        return np.zeros(3), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def from_plate(points, time):
        normal = pose(time)[1][:, 1]
        return points @ normal - 0.1, np.tile(normal, (len(points), 1))

    scene = ts.Scene()
    scene.add_obstacle(ts.Box((0, 0, 0), (1.0, 0.1, 1.0)), name="plate", friction=0.3, path=pose)
    scene.add_body(ts.box_mesh((2, 2, 2), (0.2,) * 3), RUBBER, name="cube", position=(0.1, 0.201, 0))
    turned, missed, n = end_errors(scene, from_plate)
    assert n > 50 and turned < 0.002 and missed < 1e-5


def test_a_body_on_itself():
    """A clip, whose upper jaw closes and slides along the lower one by a tenth of an edge a step.

    Normals of contacts that press are those that a search then finds.
    """
    mesh, scene, turned, n = ts.box_mesh((6, 3, 2), (0.6, 0.15, 0.2)), ts.Scene(gravity=(0, 0, 0)), 0.0, 0
    middle = mesh.vertices[mesh.tets].mean(axis=1)
    clip = ts.TetMesh(mesh.vertices, mesh.tets[(np.abs(middle[:, 1]) > 0.025) | (middle[:, 0] < -0.2)])
    body = scene.add_body(clip, ts.Material(young=1e5, friction=0.0), name="clip")
    body.fix(lambda X: X[:, 1] < -0.02)
    with ts.Simulator(scene, dt=0.01, self_collision=True, precision="f64") as sim:
        x = sim.positions()
        upper = (x[:, 1] > 0.02) & (x[:, 0] > -0.2)
        sim.set_state(velocities=np.where(upper[:, None], [0.0, -2.0, 1.0], 0.0))
        for _ in range(20):
            assert sim.step().converged
            c, end = sim.contacts(), sim.detect_contacts()
            for k in np.flatnonzero(np.linalg.norm(c.impulse, axis=1) > 0.0):
                same = (end.kind == c.kind[k]) & (end.feature == c.feature[k]).all(axis=1)
                turned = max(turned, 1.0 - max(end.normal[same] @ c.normal[k], default=1.0))
                n += same.any()
    assert n > 20 and turned < 1e-4


def floor_of(kind: str, scene: ts.Scene) -> None:
    """Add two flush boxes of a kind, whose tops are at y = 0 and which meet at x = 0."""
    for k, x in enumerate((-0.5, 0.5)):
        mesh = ts.box_mesh((5, 1, 2), (1.0, 0.2, 1.0))
        if kind == "boxes":
            scene.add_obstacle(ts.Box((x, -0.1, 0), (0.5, 0.1, 0.5)), name=f"floor {k}", friction=0.0)
        elif kind == "meshes":
            scene.add_obstacle(ts.MeshObstacle(mesh.vertices + [x, -0.1, 0], mesh.surface), name=f"floor {k}", friction=0.0)
        else:
            body = scene.add_body(mesh, RUBBER, name=f"floor {k}", position=(x, -0.1, 0))
            body.fix(lambda X: np.ones(len(X), dtype=bool))


@pytest.mark.parametrize("kind", ["boxes", "meshes", "bodies"])
@pytest.mark.parametrize("integrator", ["implicit_euler", "linearly_implicit_euler"])
def test_a_seam_does_not_brake(kind, integrator):
    scene = ts.Scene()
    floor_of(kind, scene)
    mesh = ts.box_mesh((2, 1, 2), (0.2, 0.1, 0.2))
    soft = ts.Material(young=1e6, friction=0.0)
    scene.add_body(mesh, soft, name="slider", position=(-0.13, 0.0503, 0.03), velocity=(1, 0, 0))
    with ts.Simulator(scene, dt=1 / 120, integrator=integrator) as sim:
        result = sim.run(30 / 120)
        assert result.status == "ok" and sim.velocities("slider")[:, 0].mean() > (
            0.99 if integrator == "implicit_euler" else 0.98
        )


def bowl(facets: int, radius: float) -> ts.MeshObstacle:
    """A tube about z, seen from inside."""
    angle, i = np.linspace(0.0, 2.0 * np.pi, facets, endpoint=False), np.arange(facets)
    ring, j = radius * np.column_stack([np.cos(angle), np.sin(angle)]), (i + 1) % facets
    vertices = np.concatenate([np.column_stack([ring, np.full(facets, z)]) for z in (-0.3, 0.3)])
    return ts.MeshObstacle(
        vertices, np.concatenate([np.stack([i, j, i + facets], 1), np.stack([j, j + facets, i + facets], 1)])[:, ::-1]
    )


def test_a_bowl_keeps_energy():
    scene, start, facets = ts.Scene(), np.radians(45.0), 180
    scene.add_obstacle(bowl(facets, 1.0 / np.cos(np.pi / facets)), name="bowl", friction=0.0)
    cube, c, s = ts.box_mesh((2, 2, 2), (0.1,) * 3), np.cos(start), np.sin(start)
    tilted = ts.TetMesh(cube.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T, cube.tets)
    at = 1.0 - 0.051 - 0.00125
    scene.add_body(tilted, ts.Material(young=1e6, friction=0.0), name="cube", position=(at * s, -at * c, 0))
    with ts.Simulator(scene, dt=1 / 120, integrator="bdf2") as sim:
        angles = []
        for _ in range(144):
            sim.step()
            x = sim.positions("cube").mean(axis=0)
            angles.append(np.degrees(np.arctan2(x[0], -x[1])))
    assert 44.0 < -min(angles) < 45.5, min(angles)


@pytest.mark.gpu_path
def test_what_rests_is_not_searched_again(monkeypatch):
    looks, find = [], Detection.find_at_end
    monkeypatch.setattr(Detection, "find_at_end", lambda self, *arguments: looks.append(1) or find(self, *arguments))
    scene = ts.Scene()
    scene.add_obstacle(ts.Box((0, -0.1, 0), (0.5, 0.1, 0.5)), name="floor", friction=0.5)
    scene.add_body(
        ts.box_mesh((2, 2, 2), (0.1,) * 3), ts.Material(young=1e5, mass_damping=20.0), name="cube", position=(0, 0.0505, 0)
    )
    with ts.Simulator(scene, dt=0.01) as sim:
        sim.run(1.0, fps=None)
        assert looks
        looks.clear()
        sim.run(0.2, fps=None)
        assert not looks


@pytest.mark.parametrize("depth", [2e-4, 3e-3])
def test_an_overlap_opens_slowly(depth):
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    scene.add_obstacle(ts.Sphere(CENTRE, RADIUS), name="ball", friction=0.0)
    scene.add_body(ts.box_mesh((2, 2, 2), (0.2,) * 3), RUBBER, name="cube", position=(0, 0.1 - depth, 0))
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        sim.step()
        assert sim.velocities()[:, 1].mean() < 0.02


@pytest.mark.parametrize(
    "shape", [ts.Sphere(CENTRE, RADIUS), ts.Box((0, -0.1, 0), (2.0, 0.1, 2.0))], ids=["new geometry", "the same geometry"]
)
def test_contacts_that_outgrow_their_storage(shape):
    """The same motion, bit by bit, and as many iterations as with storage that was large enough."""
    scene = ts.Scene()
    scene.add_obstacle(shape, name="ball", friction=0.5)
    scene.add_body(ts.box_mesh((3, 3, 3), (0.3,) * 3), RUBBER, name="cube", position=(0, 0.151, 0), velocity=(1.0, 0, 0.5))
    found = []
    for tight in (False, True):
        with dynamics(scene, dt=0.01, precision="f64") as made:
            for _ in range(8):
                if tight and made.contact.n_contacts:
                    kept = made.contact.snapshot()
                    made.contact.restore(kept | {"capacity": made.contact.n_contacts + 3})
                report = made.advance(1)
            found.append((made.state.state()[0], report.newton_iterations))
    assert np.array_equal(found[0][0], found[1][0]) and found[0][1] == found[1][1]
