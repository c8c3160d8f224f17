"""How deep surfaces have passed through each other:

* triangles of crumpled bodies, of one and of several, cross as deep as NumPy says of all pairs, by separating axes: from trees
  and from the spatial hash, in one thread and in many; rotation, translation and scale do not change it, nor the order of bodies;
* what only touches does not cross, nor does a body that is not tested against itself;
* steps tell it: of bodies that have passed each other by more than contacts see, one that ends so is not ok.
"""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import taisoft as ts
from taisoft.collision.detector import Detection
from taisoft.collision.intersections import CROSSED

RUBBER = ts.Material(young=1e5)


def sat_depth(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How far (k,) [m] triangles a and b (k,3,3) must part along the best of eleven axes; 0 where they are clear."""
    ea, eb = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    across = np.cross(ea[:, :, None], eb[:, None]).reshape(-1, 9, 3)
    axes = np.concatenate([np.cross(ea[:, :1], ea[:, 1:2]), np.cross(eb[:, :1], eb[:, 1:2]), across], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    pa, pb = np.einsum("kix,knx->kni", a, axes), np.einsum("kix,knx->kni", b, axes)
    width = np.minimum(pa.max(axis=2) - pb.min(axis=2), pb.max(axis=2) - pa.min(axis=2))
    return np.maximum(width.min(axis=1), 0.0)


def brute(d: Detection, self_collision: bool) -> tuple[float, float, int]:
    """The deepest [m], the deepest over the edge, and how many: of all pairs without a common vertex."""
    x, t, owner = d.surface.x.to_numpy(), d.topology.triangle, d.topology.body
    shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
    same = owner[:, None] == owner[None]
    a, b = np.nonzero(np.triu(np.where(same, self_collision & ~shared, True), 1))
    depth = np.concatenate([sat_depth(x[t[i]], x[t[j]]) for i, j in zip(np.array_split(a, 64), np.array_split(b, 64))])
    over = depth / np.minimum(d.edges[owner[a]], d.edges[owner[b]])
    return depth.max(), over.max(), int((over > CROSSED).sum())


def boxes(order=(0, 1, 2), size: float = 1.0, **settings) -> ts.Scene:
    """Three boxes above each other, in an order, of a size."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.collision = ts.CollisionSettings(**settings)
    mesh = ts.box_mesh((4, 3, 4), (0.4 * size, 0.3 * size, 0.4 * size))
    for k in order:
        scene.add_body(mesh, RUBBER, name=f"box {k}", position=(0.0, 0.35 * size * k, 0.0))
    return scene


def crumpled(scene: ts.Scene, seed: int) -> dict[str, np.ndarray]:
    """Nodes of each body (n,3) [m], moved by waves that fold it into itself, and each node a little."""
    rng, found = np.random.default_rng(seed), {}
    k, way = rng.uniform(-12.0, 12.0, (3, 4)), rng.standard_normal((4, 3))
    for name in sorted(body.name for body in scene.bodies):
        x = scene.body(name).mesh.vertices + scene.body(name).position
        found[name] = x + 0.2 * np.sin(x @ k) @ way + 0.01 * rng.standard_normal(x.shape)
    return found


def put(sim: ts.Simulator, x: dict[str, np.ndarray]) -> Detection:
    """The search's result where the bodies are there."""
    sim.set_state(np.concatenate([x[body.name] for body in sim.scene.bodies]))
    return sim._dynamics.find_contacts(0.0)


@pytest.mark.parametrize("precision, broad_phase, self_collision", [("f64", "bvh", True), ("f32", "spatial_hash", False)])
def test_all_pairs_by_separating_axes(precision, broad_phase, self_collision):
    scene = boxes(broad_phase=broad_phase)
    with ts.Simulator(scene, dt=0.01, precision=precision, self_collision=self_collision) as sim:
        d = put(sim, crumpled(scene, 0))
        parallel = Detection(scene, d.model, d.layout, sim._dynamics.runtime, self_collision, serial=False)
        for seed in range(5):
            d = put(sim, crumpled(scene, seed))
            depth, over, pairs = brute(d, self_collision)
            told = d.crossings()
            assert told[:2] == pytest.approx((depth, over), rel=1e-12) and told[2] == pairs > 20
            parallel.find(0.0, 0.0)
            assert np.array_equal(parallel.crossings(), told)
        parallel.release()


def test_rotation_translation_scale_and_order():
    with ts.Simulator(boxes(), dt=0.01, precision="f64", self_collision=True) as sim:
        wanted = [put(sim, crumpled(sim.scene, seed)).crossings() for seed in range(4)]
        turn = Rotation.from_rotvec((0.3, -0.7, 0.2))
        for seed, told in enumerate(wanted):
            x = {name: turn.apply(nodes) + (1.0, -2.0, 0.5) for name, nodes in crumpled(sim.scene, seed).items()}
            assert put(sim, x).crossings() == pytest.approx(told, rel=1e-9)
    with ts.Simulator(boxes((2, 0, 1), 1e3), dt=0.01, precision="f64", self_collision=True) as sim:
        for seed, told in enumerate(wanted):
            x = {name: 1e3 * nodes for name, nodes in crumpled(boxes(), seed).items()}
            assert put(sim, x).crossings() == pytest.approx(told * (1e3, 1.0, 1.0), rel=1e-9)


def test_what_touches_does_not_cross():
    """Flush boxes, aligned and shifted by half a cell, share planes and edges."""
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    mesh = ts.box_mesh((4, 4, 4), (0.4, 0.4, 0.4))
    for k in range(2):
        scene.add_body(mesh, RUBBER, name=f"box {k}", position=(0.0, 0.4 * k, 0.0))
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        for off, shift in itertools.product((0.0, 1e-12), (0.0, 0.05)):
            sim.set_state(np.concatenate([mesh.vertices, mesh.vertices + (shift, 0.4 - off, 0.0)]))
            depth, over, pairs = sim._dynamics.find_contacts(0.0).crossings()
            assert depth <= 1.01 * off and over <= 1e-10 and pairs == 0


@pytest.mark.parametrize("integrator", ["implicit_euler", "symplectic_euler"])
def test_steps_tell_what_contacts_do_not_see(integrator):
    """Two plates, each in the middle of the other, cross by far more than the search for contacts reaches."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.allow_initial_overlap = True
    mesh = ts.box_mesh((8, 1, 8), (0.4, 0.02, 0.4))
    scene.add_body(mesh, RUBBER, name="flat")
    upright = ts.TetMesh(mesh.vertices @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T, mesh.tets)
    scene.add_body(upright, RUBBER, name="upright")
    dt = 0.005 if integrator == "implicit_euler" else 1e-5
    with ts.Simulator(scene, dt=dt, integrator=integrator) as sim:
        report = sim.run(2 * dt, fps=None)
        last = report.step_reports[-1]
        assert last.crossings > 20 and last.deep == 1 and last.max_penetration > 1e-3
        assert report.status == "degraded" and any("crossing pairs of triangles" in text for text in report.problems)
        apart = np.concatenate([mesh.vertices, upright.vertices + (0.0, 0.3, 0.0)])
        sim.set_state(apart, np.zeros_like(apart))
        report = sim.run(2 * dt, fps=None)
        assert report.status == "ok" and report.step_reports[-1].crossings == 0
