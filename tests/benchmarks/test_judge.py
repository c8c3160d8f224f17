"""The judge of crossing surfaces:

* triangles that pierce each other cross, those that touch, share an edge or lie in one plane do not; a pair with a common vertex
  crosses where the edge opposite it pierces the other triangle;
* the pairs are those of all pairs in random crumpled bodies, and the least distance that of brute force;
* distances of triangles are those of sampled points;
* a closed surface winds once around a point inside it, and vertices inside are counted;
* a surface wholly inside another one counts, and so do shapes inside a body; obstacles may cross each other;
* what is attached to each other exactly may cross, and nothing else.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts

ipctk = pytest.importorskip("ipctk")
from benchmarks import judge as judging  # noqa: E402

FLAT = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
THROUGH = np.array([(0.2, 0.2, -1.0), (0.3, 0.2, 1.0), (0.2, 0.9, 1.0)])


def standing(scene: ts.Scene, x: dict[str, np.ndarray] | None = None, time: float = 0.0) -> SimpleNamespace:
    """A simulator whose bodies are at x, those left out where they start."""
    places = {b.name: b.rest_positions + b.position for b in scene.bodies} | (x or {})
    return SimpleNamespace(scene=scene, time=time, positions=lambda: np.concatenate([places[b.name] for b in scene.bodies]))


def scene_of(*positions, size: float = 1.0, cells: int = 1) -> ts.Scene:
    """Cubes at some positions [m]."""
    scene = ts.Scene()
    for k, position in enumerate(positions):
        scene.add_body(ts.box_mesh((cells,) * 3, (size,) * 3), ts.Material(), name=f"cube {k}", position=position)
    return scene


def test_two_triangles():
    a, b = np.arange(3)[None], np.arange(3, 6)[None]
    for other, crosses in (
        (THROUGH, True),
        (THROUGH + [0.0, 0.0, 1.1], False),  # above it
        (THROUGH + [1.0, 1.0, 0.0], False),  # beside it
        (FLAT + [0.0, 0.0, 1e-12], False),  # parallel and very close
        (FLAT + [0.1, 0.1, 0.0], False),  # in one plane
        (THROUGH * [1.0, 1.0, -1.0], True),
    ):
        x = np.concatenate([FLAT, other])
        assert judging.pierces(x, a, b)[0] == judging.pierces(x, b, a)[0] == crosses
    folded = np.concatenate([FLAT, [(0.3, 0.3, 0.5), (0.3, 0.3, -0.5)]])
    beside = np.concatenate([FLAT, folded[3:] - [2.0, 0.0, 0.0]])
    first, second = np.array([[0, 1, 2]]), np.array([[0, 3, 4]])
    assert judging.pierces(folded, first, second)[0] and not judging.pierces(beside, first, second)[0]
    assert not judging.pierces(folded, first, np.array([[0, 1, 4]]))[0]
    assert judging.triangle_distance(beside, first[0], first[0]) == np.inf


def test_flush_and_aligned_cubes_touch_without_crossing():
    for off, shift, crosses in ((0.0, 0.0, False), (0.0, 0.5, False), (1e-15, 0.3, False), (-1e-9, 0.3, True)):
        scene = scene_of((0, 0, 0), (shift, 1.0 + off, 0.5 * shift), cells=2)
        assert (judging.Judge(standing(scene), True).crossings() > 0) == crosses


def test_distances_are_those_of_sampled_points():
    """Of two triangles, and of a triangle and the axis of a capsule."""
    rng = np.random.default_rng(0)
    weights = np.array([(i, j, 30 - i - j) for i in range(31) for j in range(31 - i)]) / 30
    for _ in range(20):
        x = rng.uniform(-1.0, 1.0, (6, 3)) + np.repeat([[0.0] * 3, [2.0, 0.0, 0.0]], 3, axis=0)
        for other, found in (
            (weights @ x[3:], judging.triangle_distance(x, np.arange(3), np.arange(3, 6))),
            (np.linspace(x[3], x[4], 200), judging.axis_distance(x[3], x[4], x[:3])),
        ):
            brute = np.linalg.norm((weights @ x[:3])[:, None] - other, axis=2).min()
            assert brute - 0.06 <= found <= brute + 1e-9
    assert judging.axis_distance(THROUGH[0], THROUGH[1], FLAT) == 0.0


def crumpled(scene: ts.Scene, seed: int) -> dict[str, np.ndarray]:
    """Positions of each body, folded into itself by waves."""
    rng = np.random.default_rng(seed)
    k, amplitude = rng.uniform(-8.0, 8.0, (3, 4)), 0.3 * rng.standard_normal((4, 3))
    start = {b.name: b.rest_positions + b.position for b in scene.bodies}
    return {name: x + 0.2 * np.sin(x @ k) @ amplitude + 0.01 * rng.standard_normal(x.shape) for name, x in start.items()}


def edges_and_triangles(t: np.ndarray, pairs):
    """Every edge of one triangle of a pair with the other one, if they share no vertex."""
    for a, b in pairs:
        for p, q in ((t[a], t[b]), (t[b], t[a])):
            yield from ((p[k - 1], p[k], q) for k in range(3) if p[k - 1] not in q and p[k] not in q)


def test_crossings_and_distances_are_those_of_all_pairs():
    scene, crossed = scene_of((0, 0, 0), (0.0, 0.55, 0.1), (0.3, -0.6, 0.0), size=0.5), 0
    for seed, self_collision in ((0, True), (1, True), (1, False), (2, False)):
        sim = standing(scene, crumpled(scene, seed))
        judge = judging.Judge(sim, self_collision)
        x, t = judge.vertices(), judge.triangles
        owner = np.arange(len(t)) // (len(t) // 3)
        may = [(a, b) for a in range(len(t)) for b in range(a) if self_collision or owner[a] != owner[b]]
        crossings = judging.pierces(x, *t[np.array(may).T]).sum()
        by_ipctk = sum(ipctk.is_edge_intersecting_triangle(x[i], x[j], *x[q]) for i, j, q in edges_and_triangles(t, may))
        assert (crossings > 0) == (by_ipctk > 0)
        crossed += crossings > 0
        assert judge.crossings() == crossings or (crossings == 0 and not self_collision)
        least = min(judging.triangle_distance(x, t[a], t[b]) for a, b in may)
        assert judge.least_distance(10.0) == pytest.approx(least, rel=1e-9)
        assert judge.least_distance(0.5 * least) == 0.5 * least
    assert crossed >= 1


def test_names_and_bodies_inside_others():
    scene = scene_of((0, 0, 0), (0.9, 0.1, 0.1), (5, 0, 0))
    scene.add_body(ts.box_mesh((1, 1, 1), (0.2,) * 3), ts.Material(), name="small", position=(5.0, 0.0, 0.0))
    names = judging.Judge(standing(scene), False).find().names
    assert set(names) == {("cube 0", "cube 1")}
    apart = {"cube 1": scene.body("cube 1").rest_positions + [0.0, 5.0, 0.0]}
    assert judging.Judge(standing(scene, apart), False).find().names == {("small", "cube 2"): 1}


def test_obstacles():
    scene = scene_of((0, 0.6, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    scene.add_obstacle(ts.Box((0, 0, 0), (3.0, 0.05, 3.0)), name="slab")  # it crosses the ground, which is allowed
    scene.add_obstacle(ts.Sphere((0, 1.6, 0), 0.4), name="ball")
    scene.add_obstacle(ts.Capsule((-1, 0.6, 1.2), (1, 0.6, 1.2), 0.5), name="bar")
    body = scene.body("cube 0").rest_positions

    def judged(y: float) -> judging.Judge:
        return judging.Judge(standing(scene, {"cube 0": body + [0.0, y, 0.0]}), False)

    assert judged(0.6).crossings() == 0 and judged(0.6).least_distance(1.0) == pytest.approx(0.05)
    assert judged(0.65).least_distance(1.0) == pytest.approx(0.05)  # from the ball
    assert set(judged(0.72).find().names) == {("cube 0", "ball")}
    assert judged(0.72).least_distance(1.0) == pytest.approx(-0.02)
    assert set(judged(0.4).find().names) == {("cube 0", "slab"), ("cube 0", "ground")}
    inside = scene_of((0, 0, 0))
    inside.add_obstacle(ts.Sphere((0.1, 0, 0), 0.1), name="ball")
    assert judging.Judge(standing(inside), False).find().names == {("ball", "cube 0"): 1}


def test_attached_bodies_may_cross():
    """The second cube overlaps the first, to which it can be attached at a common face, and the third one."""
    scene = scene_of((0, 0, 0), (1, 0, 0), (1.3, 0.9, 0.1))
    for attached in (False, True):
        if attached:
            scene.attach("cube 1", lambda x: x[:, 0] < -0.49, "cube 0")
        x = scene.body("cube 1").rest_positions + np.array([0.9, 0.05, 0.02])
        names = judging.Judge(standing(scene, {"cube 1": x}), False).find().names
        assert set(names) == {("cube 1", "cube 2")} | (set() if attached else {("cube 0", "cube 1")})
        small = 0.1 * scene.body("cube 1").rest_positions
        names = judging.Judge(standing(scene, {"cube 1": small}), False).find().names
        assert set(names) == (set() if attached else {("cube 1", "cube 0")})


def test_winding_numbers():
    mesh = ts.box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
    points = np.array([(0.1, 0.2, 0.3), (0.499, 0.0, 0.1), (0.501, 0.0, 0.1), (3.0, 2.0, 1.0)])
    assert judging.winding_numbers(mesh.vertices[mesh.surface], points) == pytest.approx([1.0, 1.0, 0.0, 0.0], abs=1e-12)
    scene = ts.Scene()
    for k, (size, at) in enumerate(((1.0, 0.0), (0.2, 0.0), (0.2, 0.5), (0.2, 2.0))):
        scene.add_body(ts.box_mesh((1, 1, 1), (size,) * 3), ts.Material(), name=f"cube {k}", position=(at, 0.03, 0.01))
    assert judging.Judge(standing(scene), False).inside() == 8 + 4
