"""Depth of crossing surface triangles:

* in crumpled bodies it equals that of NumPy over all pairs, by separating axes: with the BVH and the spatial hash, in one thread
  and in many; rotation, translation, scale and the order of bodies do not change it;
* surfaces that only touch do not cross, nor does a body without self-collision cross itself;
* steps report crossings deeper than contact detection reaches, and a run that ends with them is degraded.
"""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import taisoft as ts
from taisoft.collision.detector import Detection
from taisoft.collision.intersections import CROSSED
from taisoft.dynamics.dynamics import Dynamics
from tests.dynamics.scenes import dynamics, set_state

RUBBER = ts.Material(young=1e5)


def sat_depth(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Separation (k,) [m] of triangles a and b (k,3,3) along the best of eleven axes; 0 where they do not cross."""
    ea, eb = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    across = np.cross(ea[:, :, None], eb[:, None]).reshape(-1, 9, 3)
    axes = np.concatenate([np.cross(ea[:, :1], ea[:, 1:2]), np.cross(eb[:, :1], eb[:, 1:2]), across], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    pa, pb = np.einsum("kix,knx->kni", a, axes), np.einsum("kix,knx->kni", b, axes)
    width = np.minimum(pa.max(axis=2) - pb.min(axis=2), pb.max(axis=2) - pa.min(axis=2))
    return np.maximum(width.min(axis=1), 0.0)


def brute_force(d: Detection, self_collision: bool) -> tuple[float, float, int]:
    """Largest depth [m], largest depth over the edge, and number of crossings among all pairs without a common vertex."""
    x, t, owner = d.surface.x.to_numpy(), d.topology.triangle, d.topology.body
    shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
    same = owner[:, None] == owner[None]
    a, b = np.nonzero(np.triu(np.where(same, self_collision & ~shared, True), 1))
    depth = np.concatenate([sat_depth(x[t[i]], x[t[j]]) for i, j in zip(np.array_split(a, 64), np.array_split(b, 64))])
    over = depth / np.minimum(d.edges[owner[a]], d.edges[owner[b]])
    return depth.max(), over.max(), int((over > CROSSED).sum())


def boxes(order=(0, 1, 2), size: float = 1.0, **settings) -> ts.Scene:
    """Three boxes above each other; the size scales them."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.collision = ts.CollisionSettings(**settings)
    mesh = ts.box_mesh((4, 3, 4), (0.4 * size, 0.3 * size, 0.4 * size))
    for k in order:
        scene.add_body(mesh, RUBBER, name=f"box {k}", position=(0.0, 0.35 * size * k, 0.0))
    return scene


def crumpled(scene: ts.Scene, seed: int) -> dict[str, np.ndarray]:
    """Positions of each body (n,3) [m], folded into itself by waves, plus noise."""
    rng, found = np.random.default_rng(seed), {}
    k, amplitude = rng.uniform(-12.0, 12.0, (3, 4)), rng.standard_normal((4, 3))
    for name in sorted(body.name for body in scene.bodies):
        x = scene.body(name).mesh.vertices + scene.body(name).position
        found[name] = x + 0.2 * np.sin(x @ k) @ amplitude + 0.01 * rng.standard_normal(x.shape)
    return found


def detect(made: Dynamics, x: dict[str, np.ndarray]) -> Detection:
    """Contact detection with the bodies at x."""
    set_state(made, np.concatenate([x[body.name] for body in made.scene.bodies]))
    return made.find_contacts(0.0)


@pytest.mark.parametrize("precision, broad_phase, self_collision", [("f64", "bvh", True), ("f32", "spatial_hash", False)])
def test_crossings_equal_those_of_all_pairs(precision, broad_phase, self_collision):
    scene = boxes(broad_phase=broad_phase)
    with dynamics(scene, dt=0.01, precision=precision, self_collision=self_collision) as made:
        d = detect(made, crumpled(scene, 0))
        parallel = Detection(scene, d.model, d.layout, made.runtime, self_collision, serial=False)
        for seed in range(5):
            d = detect(made, crumpled(scene, seed))
            depth, over, pairs = brute_force(d, self_collision)
            found = d.crossings()
            assert found[:2] == pytest.approx((depth, over), rel=1e-12) and found[2] == pairs > 20
            parallel.find(0.0, 0.0)
            assert np.array_equal(parallel.crossings(), found)
        parallel.release()


def test_rotation_translation_scale_and_order_do_not_matter():
    settings = {"dt": 0.01, "precision": "f64", "self_collision": True}
    with dynamics(boxes(), **settings) as made:
        expected = [detect(made, crumpled(made.scene, seed)).crossings() for seed in range(4)]
        turn = Rotation.from_rotvec((0.3, -0.7, 0.2))
        for seed, crossings in enumerate(expected):
            x = {name: turn.apply(nodes) + (1.0, -2.0, 0.5) for name, nodes in crumpled(made.scene, seed).items()}
            assert detect(made, x).crossings() == pytest.approx(crossings, rel=1e-9)
    with dynamics(boxes((2, 0, 1), 1e3), **settings) as made:
        for seed, crossings in enumerate(expected):
            x = {name: 1e3 * nodes for name, nodes in crumpled(boxes(), seed).items()}
            assert detect(made, x).crossings() == pytest.approx(crossings * (1e3, 1.0, 1.0), rel=1e-9)


def test_touching_surfaces_do_not_cross():
    """Flush boxes, aligned and shifted by half a cell, share planes and edges."""
    scene = ts.Scene()
    mesh = ts.box_mesh((4, 4, 4), (0.4, 0.4, 0.4))
    for k in range(2):
        scene.add_body(mesh, RUBBER, name=f"box {k}", position=(0.0, 0.4 * k, 0.0))
    with dynamics(scene, dt=0.01, precision="f64") as made:
        for off, shift in itertools.product((0.0, 1e-12), (0.0, 0.05)):
            x = {"box 0": mesh.vertices, "box 1": mesh.vertices + (shift, 0.4 - off, 0.0)}
            depth, over, pairs = detect(made, x).crossings()
            assert depth <= 1.01 * off and over <= 1e-10 and pairs == 0


@pytest.mark.parametrize("integrator", ["implicit_euler", "symplectic_euler"])
def test_steps_report_deep_crossings(integrator):
    """Two plates cross in their middle, far deeper than contact detection reaches."""
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
