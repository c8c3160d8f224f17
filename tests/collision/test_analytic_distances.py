"""Signed distances of the analytic obstacles in their own frames, with f32 and f64 runtimes, from 1e-6 m to 1e6 m:

* values agree with other formulas in NumPy to a few roundings: inside, outside, on the surface and where gradients jump;
* gradients are unit vectors, and agree with finite differences where the distance is smooth;
* gradients are subgradients everywhere, also in centres and on medial axes: these distances are convex.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.collision import analytic
from taisoft.collision.surface import dvec
from tests.backend.lanes import opened

SHAPES = {
    "half_space": ts.HalfSpace((0, 0, 0), (0, 1, 0)),
    "sphere": ts.Sphere((0, 0, 0), 0.7),
    "box": ts.Box((0, 0, 0), (1.0, 0.5, 0.75)),
    "flat_box": ts.Box((0, 0, 0), (1.0, 1e-3, 0.75)),
    "cube": ts.Box((0, 0, 0), (0.5, 0.5, 0.5)),
    "capsule": ts.Capsule((-0.8, 0, 0), (0.8, 0, 0), 0.3),
    "short_capsule": ts.Capsule((-1e-3, 0, 0), (1e-3, 0, 0), 0.6),
}


@kernel
def distances(
    kind: ti.i32, a: ti.f64, b: ti.f64, c: ti.f64, X: ti.types.ndarray(dtype=ti.f64), out: ti.types.ndarray(dtype=ti.f64)
):
    for i in range(X.shape[0]):
        phi, g = analytic.distance(kind, dvec(a, b, c), dvec(X[i, 0], X[i, 1], X[i, 2]))
        out[i, 0] = phi
        for k in ti.static(range(3)):
            out[i, 1 + k] = g[k]


@pytest.fixture(scope="module", params=["f64", "f32"], autouse=True)
def machine(request):
    with opened(request.param) as runtime:
        yield runtime


def sampled(shape, X: np.ndarray, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return phi (k,) and its gradient (k,3) of a shape `scale` times as large, at scale * X."""
    out = np.full((len(X), 4), np.nan)
    distances(shape.kind, *(scale * shape.size()), np.ascontiguousarray(scale * X), out)
    assert np.isfinite(out).all()
    return out[:, 0], out[:, 1:]


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
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_values_agree_with_numpy(name, scale):
    shape = SHAPES[name]
    X = points(shape)
    phi, g = sampled(shape, X, scale)
    expected = reference_distance(shape, X)
    assert np.abs(phi / scale - expected).max() < 2e-15 * 4
    assert np.abs(np.linalg.norm(g, axis=1) - 1).max() < 1e-15
    assert (expected > 0).sum() > 1000 and (expected < 0).sum() > (0 if name == "flat_box" else 50)


@pytest.mark.parametrize("name", SHAPES)
def test_gradients_agree_with_finite_differences(name):
    shape, h = SHAPES[name], 1e-6
    X = points(shape)
    _, g = sampled(shape, X)
    steps = h * np.eye(3)
    up = np.array([reference_distance(shape, X + e) for e in steps])
    down = np.array([reference_distance(shape, X - e) for e in steps])
    smooth = np.abs(up + down - 2 * reference_distance(shape, X)).max(axis=0) < 1e-10  # about h at a kink, h^2 / phi near an edge
    assert smooth.mean() > 0.4
    assert np.abs((up - down).T / (2 * h) - g)[smooth].max() < 1e-6 + 1e-10 / h


@pytest.mark.parametrize("name", SHAPES)
def test_gradients_are_subgradients(name):
    shape = SHAPES[name]
    X = points(shape)
    phi, g = sampled(shape, X)
    others = np.concatenate([X[::40], X[-600:]])
    slack = reference_distance(shape, others) - phi[:, None] - (g @ others.T - (g * X).sum(axis=1)[:, None])
    assert slack.min() > -1e-14


@pytest.mark.parametrize("name", SHAPES)
def test_distance_far_away(name):
    """Distance and direction stay right far from the obstacle."""
    directions = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0, -0.8], [-0.48, 0.6, 0.64]])
    for far in (1e10, 1e30, 1e150):
        phi, g = sampled(SHAPES[name], far * directions)
        expected = (far * directions[:, 1], np.eye(3)[[1] * 5]) if name == "half_space" else (np.full(5, far), directions)
        assert np.abs(phi - expected[0]).max() < 2e-10 * far and np.abs(g - expected[1]).max() < 2e-10
