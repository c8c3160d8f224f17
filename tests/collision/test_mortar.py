"""Mortar contacts, as found:

* their weights times areas are the integrals of the shape functions of both orders over what two surfaces share, however the
  scene is turned and its bodies are ordered, also between faces of different order and where one lies within the other;
* their gaps are the means of the distance between surfaces that are not parallel or partly beyond the margin, and none is far;
* threads, the broad phase and small buffers change nothing;
* a node in a groove has one for each wall; thin bodies have none through their thickness; a fold has them within a body;
* guards are the contacts of points beside them, not those of another pair.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.contacts import Contacts
from taisoft.collision.detector import Detection
from taisoft.collision.mortar import FARTHEST
from taisoft.mesh.quality import mean_surface_edge
from tests.collision.rotations import rotation
from tests.dynamics.scenes import dynamics

SIZE, GAP = (1.0, 0.5, 0.8), 1e-3
MATERIAL = ts.Material("st_venant_kirchhoff", young=1e6, density=1.0)
TURN = rotation(np.array([1.0, 2.0, -0.5]), 1.1)


def faces(body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes (k, 3 or 6) of a body's faces, and barycentric points (p,3) and weights (p,) exact to degree 3 on them."""
    surface = body.nodes.surface
    if body.order == 2:
        corners, middles = np.stack([surface[k::4, k] for k in range(3)], axis=1), surface[3::4]
        surface = np.hstack([corners, middles])
    points = np.array([[1 / 3] * 3, [0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])
    return surface, points, np.array([-27, 25, 25, 25]) / 48


def shape(points: np.ndarray, n: int) -> np.ndarray:
    """Shape functions (p, n) of a face."""
    a, b, c = points.T
    quadratic = [a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * c * a]
    return points if n == 3 else np.stack(quadratic, axis=1)


def integrals(body, keep) -> np.ndarray:
    """Integrals (n_nodes,) of the shape functions over the faces whose corners at rest `keep` accepts."""
    nodes, points, weights = faces(body)
    corners = body.rest_positions[nodes[:, :3]]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total, chosen = np.zeros(body.n_nodes), keep(corners).all(axis=1)
    np.add.at(total, nodes[chosen], areas[chosen, None] * (weights @ shape(points, nodes.shape[1])))
    return total


def nodal(c: Contacts, values: np.ndarray, side: int, n_nodes: int) -> np.ndarray:
    """Sum (n_nodes,) of the weights of a side of contacts times values (k,)."""
    half = c.nodes.shape[1] // 2
    nodes, weights = c.nodes[:, side * half :][:, :half], c.weights[:, side * half :][:, :half]
    total = np.zeros(n_nodes)
    np.add.at(total, nodes[nodes >= 0], (weights * values[:, None])[nodes >= 0])
    return total


def mortar_of(sim: ts.Simulator) -> Contacts:
    """The mortar contacts of the present state."""
    c = sim.detect_contacts()
    own, rows = c.kind == "mortar", {}
    for name, value in vars(c).items():
        rows[name] = value[own] if np.ndim(value) else value
    return Contacts(**rows)


def blocks(orders=(1, 1), swapped=False, cells=((4, 2, 3), (3, 2, 5))) -> ts.Scene:
    """Two blocks of different meshes, flush but for GAP; the upper one is added first if swapped."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k in (1, 0) if swapped else (0, 1):
        mesh = ts.box_mesh(cells[k], SIZE, (0, (k - 0.5) * SIZE[1], 0))
        scene.add_body(mesh, MATERIAL, name=("low", "top")[k], order=orders[k], position=(0, k * GAP, 0))
    return scene


def turned(sim: ts.Simulator, change=lambda x: x) -> None:
    """Set the positions to the start's, changed and then turned."""
    sim.reset()
    sim.set_state(positions=change(sim.positions()) @ TURN.T)


@pytest.mark.parametrize("orders, swapped", [((1, 1), False), ((2, 2), True), ((2, 1), False)])
def test_weights_are_integrals_of_shape_functions(orders, swapped):
    scene = blocks(orders, swapped)
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        turned(sim)
        c, n = mortar_of(sim), sum(body.n_nodes for body in scene.bodies)
        expected = np.concatenate([integrals(body, lambda x: np.abs(x[..., 1]) < 1e-9) for body in scene.bodies])
        found = nodal(c, c.area, 0, n) + nodal(c, c.area, 1, n)
        assert np.abs(found - expected).max() < 1e-14 and abs(c.area.sum() - SIZE[0] * SIZE[2]) < 1e-13
        up = 1.0 if c.body_a[0] == "top" else -1.0
        assert np.abs(c.gap - GAP).max() < 1e-13 and np.abs(c.normal - up * TURN[:, 1]).max() < 1e-13


@pytest.mark.parametrize("orders", [(1, 1), (2, 2), (2, 1)])
@pytest.mark.parametrize("capacity", [None, 64])
def test_a_block_within_a_larger_one_of_finer_faces(orders, capacity):
    """Nodes of the slave beside the master's rim count, whichever triangles around them are near it; buffers grow as needed."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.collision = ts.CollisionSettings(initial_capacity=capacity)
    scene.add_body(
        ts.box_mesh((8 // orders[0], 1, 8 // orders[0]), (1, 0.3, 1), (0, -0.15, 0)), MATERIAL, name="low", order=orders[0]
    )
    scene.add_body(ts.box_mesh((1, 1, 1), (0.45,) * 3, (0.03, 0.225 + GAP, 0.02)), MATERIAL, name="top", order=orders[1])
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        turned(sim)
        c, n = mortar_of(sim), sum(body.n_nodes for body in scene.bodies)
        assert abs(c.area.sum() - 0.45**2) < 1e-14 and np.abs(c.gap - GAP).max() < 1e-13
        expected = integrals(scene.bodies[1], lambda x: np.abs(x[..., 1] - GAP) < 1e-9)
        assert np.abs(nodal(c, c.area, 1, n)[-len(expected) :] - expected).max() < 1e-14
        if capacity:
            found = sim.detect_contacts()
            assert (found.kind == "edge_edge").sum() > 4


def upper(scene: ts.Scene) -> np.ndarray:
    """Which nodes belong to the second body (n_nodes, 1)."""
    return (np.arange(sum(body.n_nodes for body in scene.bodies)) >= scene.bodies[0].n_nodes)[:, None]


@pytest.mark.gpu_path
def test_gaps_are_means_over_what_is_near():
    scene, tilt = blocks(), np.array([0.0, 0.004, 0.0])
    far = FARTHEST * 0.1 * mean_surface_edge([(body.rest_positions, body.nodes.surface) for body in scene.bodies])
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:

        def opened(gap):
            turned(sim, lambda x: x + upper(scene) * (tilt * (x[:, :1] + 0.5) + [0, gap, 0]))
            c = mortar_of(sim)
            return c, GAP + gap + tilt[1] * ((c.point @ TURN)[:, 0] + 0.5)  # the distance is linear

        c, distance = opened(0.0)
        assert c.gap.max() < far and abs(c.area.sum() - SIZE[0] * SIZE[2]) < 1e-3
        assert np.abs(c.gap - distance).max() < 1e-3 * distance.max()
        near, _ = opened(far - 0.5 * tilt[1] - GAP)  # half of the contacts are beyond it
        assert 0.3 < near.area.sum() / c.area.sum() < 0.7 and near.gap.max() < far
        assert len(opened(1.1 * far)[0]) == 0
    with dynamics(scene, dt=0.01, precision="f64") as made:  # what will be near in the step
        m, d = made.state.model, Detection(scene, made.state.model, made.state.layout, made.runtime)
        m.state.x.from_numpy(m.state.x.to_numpy() + upper(scene) * [0, 2 * far, 0])
        for speed in (0.0, 2 * far / 0.01):
            m.state.v.from_numpy(upper(scene) * [0, -speed, 0])
            d.find(0.0, 0.01)
            assert ((d.contacts().kind == "mortar").sum() == len(c)) == (speed > 0.0)
        d.release()


def test_neither_threads_nor_the_order_of_bodies_matter():
    found = []
    for swapped, phase in ((False, "bvh"), (True, "spatial_hash")):
        scene = blocks((2, 1), swapped)
        scene.collision = ts.CollisionSettings(broad_phase=phase)
        with dynamics(scene, dt=0.01, precision="f64") as made:
            for serial in (True, False):
                d = Detection(scene, made.state.model, made.state.layout, made.runtime, serial=serial)
                d.find(0.0, 0.01)
                c = d.contacts()
                own = c.kind == "mortar"
                found.append(np.column_stack([c.point, c.area, c.gap])[own])
                found[-1] = found[-1][np.lexsort(found[-1].round(9).T)]
                d.release()
    assert all(np.array_equal(one, found[k - k % 2]) for k, one in enumerate(found))  # threads: bitwise
    assert np.abs(found[0] - found[2]).max() < 1e-14


def test_a_node_in_a_groove_has_a_contact_for_each_wall():
    """A cube in the corner of a mesh obstacle. One that stands on an edge has no means, nor guards, beside it."""
    corner = ts.box_mesh((1, 1, 1), (1, 1, 1), (0.5, 0.5, 0.5))
    inside = ts.MeshObstacle(corner.vertices, corner.surface[:, ::-1])  # seen from within
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_obstacle(inside, name="room")
    scene.add_body(ts.box_mesh((2, 2, 2), (0.2,) * 3, (0.1 + GAP, 0.1 + 2 * GAP, 0.5)), MATERIAL, name="cube")
    tilted = ts.box_mesh((1, 1, 1), (0.1,) * 3)
    turn = rotation(np.array([0.0, 0.0, 1.0]), np.pi / 4)
    at = np.array([0.7, 0.05 * np.sqrt(2) + GAP, 0.5])
    scene.add_body(ts.TetMesh(tilted.vertices @ turn.T + at, tilted.tets), MATERIAL, name="tilted")
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        c = sim.detect_contacts()
    room = c.body_a == "cube"
    mortar = room & (c.kind == "mortar")
    by_node = {}
    for node, normal, gap in zip(c.feature[mortar, 0], c.normal[mortar], c.gap[mortar]):
        axis = np.argmax(normal)
        assert normal[axis] > 1 - 1e-12 and abs(gap - (GAP, 2 * GAP)[axis]) < 1e-12
        by_node.setdefault(node, []).append(axis)
    assert sorted(map(sorted, by_node.values())).count([0, 1]) == 3 and len(by_node) == 15
    assert c.guard[room & ~mortar].all() and not c.guard[mortar].any()
    assert not c.guard[~room].any() and set(c.kind[~room]) <= {"vertex_face", "edge_edge"} and (~room).any()


def test_thin_plates_meet_only_with_the_sides_that_face_each_other():
    scene = ts.Scene(gravity=(0, 0, 0))
    for k in range(2):
        scene.add_body(ts.sheet_mesh((3, 4 - k), (1.0, 2 * GAP, 1.0)), MATERIAL, name=f"plate {k}", position=(0, 3 * k * GAP, 0))
    with ts.Simulator(scene, dt=0.01, precision="f64", self_collision=True) as sim:
        c = mortar_of(sim)
    assert np.abs(c.gap - GAP).max() < 1e-12 and abs(c.area.sum() - 1.0) < 1e-12
    assert (c.normal[:, 1] < -1 + 1e-12).all() and set(zip(c.body_a, c.body_b)) == {("plate 0", "plate 1")}


@pytest.mark.gpu_path
@pytest.mark.parametrize("order", [1, 2])
def test_a_fold_has_contacts_within_a_body(order):
    """A sheet that is bent back over itself, to a gap of GAP between its halves."""
    thick, scene = 0.05, ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(ts.box_mesh((20, 1, 5), (2.0, thick, 0.5)), MATERIAL, name="sheet", order=order)
    radius = (thick + GAP) / 2
    along, bend = body.rest_positions[:, 0], np.pi * radius
    angle = np.clip(along / radius, 0.0, np.pi)
    x = np.where(along < 0, along, np.where(along < bend, radius * np.sin(angle), bend - along))
    middle = np.column_stack([x, radius * (1 - np.cos(angle)), body.rest_positions[:, 2]])
    across = np.column_stack([-np.sin(angle), np.cos(angle), 0.0 * angle])
    with ts.Simulator(scene, dt=0.01, precision="f64", self_collision=True) as sim:
        sim.set_state(positions=middle + body.rest_positions[:, 1:2] * across)
        c = mortar_of(sim)
    flat = c.point[:, 0] < -0.12
    assert np.abs(c.gap[flat] - GAP).max() < 1e-9 and np.abs(np.abs(c.normal[flat, 1]) - 1.0).max() < 1e-9
    assert 0.9 < c.area.sum() / (0.5 * (1.0 - bend)) < 1.01
