"""Signed distances of the analytic obstacles in their own frames, and the deepest point of a triangle in them, by Frank-Wolfe:

* distances agree with other formulas in NumPy to a few roundings, from 1e-6 m to 1e150 m: inside, outside, on the surface and
  where gradients jump; gradients are unit vectors and agree with finite differences where the distance is smooth;
* they are convex: none is below a tangent anywhere, whatever gradient is taken where several are possible;
* no triangle that may have a contact in a step is skipped by the sphere around its box, whatever moves, and most others are;
* weights of deepest points are convex, phi belongs to their point, no corner lies deeper, for needles and points too; the point
  is the deepest one of a dense sampling, to 1e-6 of the triangle's size.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.analytic import AnalyticFrames, build_analytic, may_touch, obstacle_frame
from taisoft.collision.deepest_point import deepest_point
from taisoft.collision.surface import dvec
from tests.collision.checked_paths import obstacle

SHAPES = {
    "half_space": ts.HalfSpace((0, 0, 0), (0, 1, 0)),
    "sphere": ts.Sphere((0, 0, 0), 0.7),
    "box": ts.Box((0, 0, 0), (1.0, 0.5, 0.75)),
    "flat_box": ts.Box((0, 0, 0), (1.0, 1e-3, 0.75)),
    "cube": ts.Box((0, 0, 0), (0.5, 0.5, 0.5)),
    "capsule": ts.Capsule((-0.8, 0, 0), (0.8, 0, 0), 0.3),
    "short_capsule": ts.Capsule((-1e-3, 0, 0), (1e-3, 0, 0), 0.6),
}
array = ti.types.ndarray(dtype=ti.f64)


@kernel
def distances(o: ti.template(), k: ti.i32, X: array, out: array):
    for i in range(X.shape[0]):
        phi, g = o.sample(k, dvec(X[i, 0], X[i, 1], X[i, 2]))
        out[i, 0] = phi
        for q in ti.static(range(3)):
            out[i, 1 + q] = g[q]


@kernel
def deepest(o: ti.template(), k: ti.i32, X: array, out: array):
    for i in range(X.shape[0]):
        A, B = dvec(X[i, 0, 0], X[i, 0, 1], X[i, 0, 2]), dvec(X[i, 1, 0], X[i, 1, 1], X[i, 1, 2])
        C = dvec(X[i, 2, 0], X[i, 2, 1], X[i, 2, 2])
        a, _ = o.sample(k, A)
        b, _ = o.sample(k, B)
        c, _ = o.sample(k, C)
        w, phi = deepest_point(o, k, A, B, C, dvec(a, b, c))
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = w[0], w[1], w[2], phi


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of triangles in a step."""

    lo: Any
    hi: Any


@kernel
def select(s: ti.template(), o: ti.template(), k: ti.i32, margin: ti.f64, out: ti.template()):
    for t in range(out.shape[0]):
        out[t] = int(may_touch(s, o, t, k, margin))


def test_no_triangle_with_contacts_is_skipped(run):
    rng, n, margin = np.random.default_rng(3), 2000, 0.02
    X = rng.uniform(-2.5, 2.5, (n, 1, 3)) + 0.1 * rng.standard_normal((n, 3, 3))
    move = 0.02 * rng.standard_normal((n, 3, 3))
    ends = np.concatenate([X, X + move], axis=1)
    arena, w = FieldArena(), np.concatenate([np.eye(3), rng.dirichlet(np.ones(3), 9)])
    boxes = Boxes(*(arena.vectors(name, ti.f64, n, x) for name, x in (("lo", ends.min(axis=1)), ("hi", ends.max(axis=1)))))
    chosen = arena.field("chosen", ti.i32, n)
    path = ts.KeyFrames((0.0, 1.0), ((0.0, 0.0, 0.0), (0.03, -0.2, 0.01)), ((0.0, 0.0, 0.0), (0.04, 0.02, -0.1)))
    placed = [(k, obstacle(shape, path)) for k, shape in enumerate(SHAPES.values())]
    shapes = build_analytic(placed, arena)
    AnalyticFrames(shapes, placed).place(range(len(placed)), 0.0, 1.0)
    for k, one in placed:
        frames = [obstacle_frame(one, t) for t in (0.0, 1.0)]
        now, then = ((w @ x - origin) @ R for x, (origin, R) in zip((X, X + move), frames))
        phi, *g = run(distances, list(SHAPES)[k], now.reshape(-1, 3)).T
        closest = phi + np.minimum(((then - now).reshape(-1, 3) * np.array(g).T).sum(axis=1), 0.0)
        select(boxes, shapes, k, margin, chosen)
        may, near = chosen.to_numpy() == 1, (closest.reshape(n, -1) <= margin).any(axis=1)
        assert near.any() and may[near].all() and may.mean() < 0.8
    arena.release()


@pytest.fixture(scope="module")
def run():
    """A function that runs a kernel for a shape, `scale` times as large, at scale * X."""
    arena = FieldArena()
    shapes = build_analytic([(k, obstacle(shape)) for k, shape in enumerate(SHAPES.values())], arena)

    def run(function, name: str, X: np.ndarray, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        shapes.size.from_numpy(scale * np.array([shape.size() for shape in SHAPES.values()]))
        out = np.full((len(X), 4), np.nan)
        function(shapes, list(SHAPES).index(name), np.ascontiguousarray(scale * X), out)
        assert np.isfinite(out).all()
        return out

    yield run
    arena.release()


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_convex(run, name):
    rng = np.random.default_rng(6)
    X = np.round(rng.uniform(-1.5, 1.5, (300, 3)), 1)  # some on axes and diagonal planes
    phi, g = np.split(run(distances, name, X), (1,), axis=1)
    assert (phi[:, 0] + ((X[:, None] - X) * g).sum(axis=2) <= phi + 1e-12).all()


def reference_distance(shape, X: np.ndarray) -> np.ndarray:
    """Return phi (k,) from the nearest point of the shape's core or surface."""
    if isinstance(shape, ts.HalfSpace):
        return X[:, 1]
    if isinstance(shape, ts.Sphere):
        return np.sqrt((X**2).sum(axis=1)) - shape.radius
    if isinstance(shape, ts.Capsule):
        t = np.clip((X - shape.a) @ (shape.b - shape.a) / ((shape.b - shape.a) ** 2).sum(), 0, 1)
        return np.linalg.norm(X - shape.a - t[:, None] * (shape.b - shape.a), axis=1) - shape.radius
    h = shape.half_extents
    inside = (np.abs(X) < h).all(axis=1)
    faces = np.concatenate([h - X, h + X], axis=1)  # to the planes of the six faces
    return np.where(inside, -faces.min(axis=1), np.linalg.norm(X - np.clip(X, -h, h), axis=1))


def points(shape) -> np.ndarray:
    """Random points, and special ones: centre, axes, symmetry planes, diagonals, corners and edges."""
    rng = np.random.default_rng(1)
    random = np.concatenate([rng.uniform(-2, 2, (4000, 3)), 0.3 * rng.standard_normal((2000, 3))])
    h = shape.size() if isinstance(shape, ts.Box) else np.array([0.8, 0.3, 0.3])
    lattice = np.stack(np.meshgrid(*[[-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5]] * 3), axis=-1).reshape(-1, 3)
    diagonal = rng.uniform(-1, 1, (500, 1)) * rng.choice([-1.0, 1.0], (500, 3))
    return np.concatenate([random, lattice * h, lattice, diagonal])


@pytest.mark.parametrize("name", SHAPES)
def test_values_and_gradients_agree_with_numpy(run, name):
    shape, h = SHAPES[name], 1e-6
    X = points(shape)
    expected = reference_distance(shape, X)
    for scale in (1e-6, 1e6, 1.0):
        out = run(distances, name, X, scale)
        phi, g = out[:, 0] / scale, out[:, 1:]
        assert np.abs(phi - expected).max() < 2e-15 * 4
        assert np.abs(np.linalg.norm(g, axis=1) - 1).max() < 1e-15
    assert (expected > 0).sum() > 1000 and (expected < 0).sum() > (0 if name == "flat_box" else 50)
    up, down = (np.array([reference_distance(shape, X + e) for e in steps]) for steps in (h * np.eye(3), -h * np.eye(3)))
    smooth = np.abs(up + down - 2 * expected).max(axis=0) < 1e-10  # about h at a kink, h^2 / phi near an edge
    assert smooth.mean() > 0.4
    assert np.abs((up - down).T / (2 * h) - g)[smooth].max() < 1e-6 + 1e-10 / h
    directions = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0, -0.8], [-0.48, 0.6, 0.64]])
    out, far = run(distances, name, 1e150 * directions), 1e150
    expected = (far * directions[:, 1], np.eye(3)[[1] * 5]) if name == "half_space" else (np.full(5, far), directions)
    assert np.abs(out[:, 0] - expected[0]).max() < 2e-10 * far and np.abs(out[:, 1:] - expected[1]).max() < 2e-10


def sampled_minimum(shape, X: np.ndarray) -> np.ndarray:
    """Least phi (k,) of a dense sampling of each triangle, refined twice about the deepest sample."""
    i, j = np.triu_indices(41)
    w = np.broadcast_to(np.stack([i, j - i, 40 - j], axis=1) / 40, (len(X), len(i), 3))
    u, v = (a.ravel() for a in np.meshgrid(*[np.linspace(-1.5, 1.5, 31)] * 2))
    around = np.stack([u, v, -u - v], axis=1)
    for reach in (1 / 40, 1 / 400, 0):
        phi = reference_distance(shape, np.einsum("isk,ikd->isd", w, X).reshape(-1, 3)).reshape(len(X), -1)
        best = np.take_along_axis(w, phi.argmin(axis=1)[:, None, None], axis=1)
        w = np.clip(best + reach * around, 0, None)
        w = w / w.sum(axis=2, keepdims=True)
    return phi.min(axis=1)


@pytest.mark.parametrize("name, misses", [("half_space", 0.0), ("sphere", 0.005), ("box", 0.05), ("capsule", 0.05)])
def test_deepest_points(run, name, misses):
    """misses: phi of a box or a capsule has kinks, where the search may stop early."""
    rng, n = np.random.default_rng(1), 300
    X = 10.0 ** rng.uniform(-3, 0, (n, 1, 1)) * rng.standard_normal((n, 3, 3)) + rng.uniform(-1.5, 1.5, (n, 1, 3))
    X[::11, 2] = X[::11, 1] + 10.0 ** rng.uniform(-15, -2, (len(X[::11]), 1)) * X[::11, 2]  # needles
    X[::23, 1] = X[::23, 0]
    X[::46, 2] = X[::46, 0]  # points
    out = run(deepest, name, X)
    w, phi = out[:, :3], out[:, 3]
    assert w.min() >= 0 and np.abs(w.sum(axis=1) - 1).max() < 1e-14
    reached = reference_distance(SHAPES[name], np.einsum("ik,ikd->id", w, X))
    assert np.abs(reached - phi).max() < 2e-14 * (1 + np.abs(X).max())
    corners = reference_distance(SHAPES[name], X.reshape(-1, 3)).reshape(n, 3)
    assert (phi <= corners.min(axis=1) + 1e-15).all()
    size = np.linalg.norm(X - np.roll(X, 1, axis=1), axis=2).max(axis=1)
    assert np.mean(phi - sampled_minimum(SHAPES[name], X) > 1e-6 * np.maximum(size, 1e-9)) <= misses
    assert name == "half_space" or (w.max(axis=1) < 1 - 1e-6).sum() > 20
