"""The deepest point of a triangle in a signed distance, by Frank-Wolfe. The precision is that of the runtime; phi is f64 in both.

* Reference triangles against plane, sphere, box, capsule and torus: phi and its gradient are those of a listed minimum.
* Random triangles, needles and points too: the weights are convex, phi belongs to their point, and no corner lies deeper.
* Where phi is convex and smooth, the point is the deepest one of a dense sampling, to 1e-6 of the triangle's size.
* A uniform scale and the order of the corners change nothing but rounding.
"""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision import analytic
from taisoft.collision.deepest_point import deepest_point
from taisoft.collision.surface import dvec
from tests.backend.lanes import opened

array = ti.types.ndarray(dtype=ti.f64)
NAMES = ("plane", "sphere", "box", "capsule", "torus")  # as in the reference; the first four in the order of the obstacle kinds
TORUS = 4
SIZE = np.array([(0, 0, 0), (1, 0, 0), (1, 0.5, 0.75), (1, 0.3, 0), (1, 0.25, 0)])  # of the torus about y: its two radii


@dataclass(frozen=True, eq=False)
class Distances:
    """The five distances, indexed as NAMES."""

    size: Any  # (5) 3-vectors f64

    @ti.func
    def sample(self, k, p):
        phi, g = analytic.distance(k, self.size[k], p)
        if k == TORUS:
            ring = dvec(p[0], 0.0, p[2])
            offset = p - self.size[k][0] * ring / ring.norm()
            phi, g = offset.norm() - self.size[k][1], offset / offset.norm()
        return phi, g


@kernel
def deepest(field: ti.template(), kind: ti.types.ndarray(dtype=ti.i32), X: array, out: array):
    for i in range(X.shape[0]):
        A, B, C = dvec(X[i, 0, 0], X[i, 0, 1], X[i, 0, 2]), dvec(X[i, 1, 0], X[i, 1, 1], X[i, 1, 2]), dvec(0.0)
        for q in ti.static(range(3)):
            C[q] = X[i, 2, q]
        a, _ = field.sample(kind[i], A)
        b, _ = field.sample(kind[i], B)
        c, _ = field.sample(kind[i], C)
        w, phi = deepest_point(field, kind[i], A, B, C, dvec(a, b, c))
        for q in ti.static(range(3)):
            out[i, q] = w[q]
        out[i, 3] = phi


@kernel
def sample(field: ti.template(), kind: ti.types.ndarray(dtype=ti.i32), X: array, out: array):
    for i in range(X.shape[0]):
        phi, g = field.sample(kind[i], dvec(X[i, 0], X[i, 1], X[i, 2]))
        out[i, 0] = phi
        for q in ti.static(range(3)):
            out[i, 1 + q] = g[q]


@pytest.fixture(scope="module", params=["f64", "f32"])
def field(request):
    arena = FieldArena()
    with opened(request.param):
        yield Distances(arena.vectors("size", ti.f64, 5, SIZE))
        arena.release()


def sampled(field: Distances, kind: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """phi (k,) and gradients (k,3) at X (k,3)."""
    out = np.full((len(X), 4), np.nan)
    sample(field, kind.astype(np.int32), np.ascontiguousarray(X), out)
    return out[:, 0], out[:, 1:]


def deepest_points(field: Distances, kind: np.ndarray, X: np.ndarray, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Weights (k,3) and phi (k,) of the deepest points of triangles X (k,3,3), computed at `scale`; phi is scaled back to 1."""
    field.size.from_numpy(scale * SIZE)
    out = np.full((len(X), 4), np.nan)
    deepest(field, kind.astype(np.int32), np.ascontiguousarray(scale * X), out)
    field.size.from_numpy(SIZE)
    w, phi = out[:, :3], out[:, 3] / scale
    assert w.min() >= 0 and np.abs(w.sum(axis=1) - 1).max() < 1e-14
    reached, _ = sampled(field, kind, np.einsum("ik,ikd->id", w, X))
    assert np.abs(reached - phi).max() < 2e-14 * (1 + np.abs(X).max())
    return w, phi


def test_reference_minima(field, shared):
    cases = json.loads((shared / "references" / "sdf_triangle_minimum.json").read_text(encoding="utf-8"))["value"]
    kind = np.array([NAMES.index(case["sdf"]) for case in cases])
    X = np.array([case["triangle"] for case in cases])
    assert set(kind) == set(range(5)) and len(cases) == 8
    for order in ((0, 1, 2), (2, 0, 1), (1, 0, 2)):
        w, phi = deepest_points(field, kind, X[:, order])
        point = np.einsum("ik,ikd->id", w, X[:, order])
        _, gradient = sampled(field, kind, point)
        for i, case in enumerate(cases):
            error = [max(abs(m["phi"] - phi[i]), 1e-3 * np.abs(m["gradient"] - gradient[i]).max()) for m in case["minima"]]
            nearest = case["minima"][int(np.argmin(error))]
            assert abs(phi[i] - nearest["phi"]) < 1e-6
            assert np.abs(point[i] - nearest["point"]).max() < 1e-3  # phi is flat there
            if case["sdf"] == "box" and phi[i] < 0:  # equally far from two faces; the reference gives the mean gradient
                assert gradient[i] @ nearest["gradient"] > 0.4
            else:
                assert np.abs(gradient[i] - nearest["gradient"]).max() < 1e-3


def triangles(seed: int, n: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """n triangles per distance, large and small, including needles and points."""
    rng = np.random.default_rng(seed)
    kind = np.repeat(np.arange(5), n)
    X = 10.0 ** rng.uniform(-3, 0, (len(kind), 1, 1)) * rng.standard_normal((len(kind), 3, 3))
    X += rng.uniform(-1.5, 1.5, (len(kind), 1, 3))
    X[::11, 2] = X[::11, 1] + 10.0 ** rng.uniform(-15, -2, (len(X[::11]), 1)) * X[::11, 2]  # needles
    X[::23, 1] = X[::23, 0]
    X[::46, 2] = X[::46, 0]  # points
    return kind, X


def sampled_minimum(field: Distances, kind: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Least phi (k,) of a dense sampling of each triangle, refined twice about the deepest sample."""
    i, j = np.triu_indices(41)
    w = np.broadcast_to(np.stack([i, j - i, 40 - j], axis=1) / 40, (len(X), len(i), 3))
    u = np.linspace(-1.5, 1.5, 31)
    u, v = (a.ravel() for a in np.meshgrid(u, u))
    around = np.stack([u, v, -u - v], axis=1)
    for reach in (1 / 40, 1 / 400, 0):
        points = np.einsum("isk,ikd->isd", w, X).reshape(-1, 3)
        phi = sampled(field, np.repeat(kind, w.shape[1]), points)[0].reshape(len(X), -1)
        best = np.take_along_axis(w, phi.argmin(axis=1)[:, None, None], axis=1)
        w = np.clip(best + reach * around, 0, None)
        w = w / w.sum(axis=2, keepdims=True)
    return phi.min(axis=1)


def test_random_triangles(field):
    kind, X = triangles(1)
    w, phi = deepest_points(field, kind, X)
    corners = np.stack([sampled(field, kind, X[:, k])[0] for k in range(3)], axis=1)
    assert (phi <= corners.min(axis=1)).all()
    size = np.linalg.norm(X - np.roll(X, 1, axis=1), axis=2).max(axis=1)
    excess = (phi - sampled_minimum(field, kind, X)) / np.maximum(size, 1e-9)
    misses = {name: np.mean(excess[kind == k] > 1e-6) for k, name in enumerate(NAMES)}
    assert misses["plane"] == 0 and excess[kind == 1].max() < 1e-5 and misses["sphere"] < 2e-3
    # phi has kinks, where the search may stop early, and that of the torus may have two minima on a triangle
    assert max(misses.values()) < 0.05
    inner = w.max(axis=1) < 1 - 1e-6
    assert all((inner & (kind == k)).sum() > 100 for k in range(1, 5))


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_invariance(field, scale):
    kind, X = triangles(2, 200)
    w, phi = deepest_points(field, kind, X)
    w_scaled, phi_scaled = deepest_points(field, kind, X, scale)
    same = np.abs(phi_scaled - phi) < 1e-9
    assert same.mean() > 0.99  # where phi is flat, rounding decides where the search ends
    assert np.abs(w_scaled - w)[same].max() < 1e-2
