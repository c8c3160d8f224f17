"""How far triangles move and certainly stay apart from each other:

* random motions that are called free are so by ipctk's exact continuous detection, and most that ipctk calls free are;
* the distance kept is the floor, or half of the first distance;
* triangles that turn together, slide on each other or meet head on: free, free, and stopped just before;
* rigid motions of both and the order of corners and triangles change nothing.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision import separation
from taisoft.collision.intersections import row_of
from tests.collision.rotations import rotation

ipctk = pytest.importorskip("ipctk")
array = ti.types.ndarray(dtype=ti.f64)
matrix = ti.types.matrix(6, 3, ti.f64)


@ti.func
def rows(X: ti.template(), i):
    return matrix([X[i, k, q] for k in ti.static(range(6)) for q in ti.static(range(3))])


@kernel
def free(X: array, P: array, radius: ti.f64, floor: ti.f64, are_apart: ti.i32, out: array):
    for i in range(X.shape[0]):
        out[i], _ = separation.free_until(rows(X, i), rows(P, i), radius, floor, are_apart)


@kernel
def plane(X: array, P: array, floor: ti.f64, first: ti.i32, out: array):
    for i in range(X.shape[0]):
        x, p = rows(X, i), rows(P, i)
        y = x + p
        start = [row_of(x, k) - row_of(x, 3) for k in ti.static((0, 1, 2, 4, 5))]
        end = [row_of(y, k) - row_of(y, 3) for k in ti.static((0, 1, 2, 4, 5))]
        out[i] = separation.separating_plane(*start, *end, floor, first, 0)


def free_until(x: np.ndarray, p: np.ndarray, radius: float = 0.0, floor: float = 1e-6, are_apart: bool = True) -> np.ndarray:
    out = np.zeros(len(x))
    free(np.ascontiguousarray(x), np.ascontiguousarray(p), radius, floor, int(are_apart), out)
    return out


def distance(x: np.ndarray) -> float:
    """Distance of two triangles (6,3) by ipctk [m]; 0 if they cross."""
    a, b = x[:3], x[3:]
    if any(ipctk.is_edge_intersecting_triangle(s[k], s[k - 1], *t) for s, t in ((a, b), (b, a)) for k in range(3)):
        return 0.0
    solid = [len(np.unique(t, axis=0)) == 3 for t in (b, a)]
    squares = [ipctk.point_triangle_distance(p, *t) for s, t in np.array(((a, b), (b, a)))[solid] for p in s]
    edges = [[(t[k], t[k - 1]) for k in range(3) if (t[k] != t[k - 1]).any()] for t in (a, b)]
    squares += [ipctk.edge_edge_distance(*e, *f) for e in edges[0] for f in edges[1]]
    return float(np.sqrt(min(squares)))


def exactly_free(x: np.ndarray, p: np.ndarray) -> bool:
    """Whether two triangles never touch on the way, by ipctk's continuous detection."""
    faces = np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32)
    mesh = ipctk.CollisionMesh(np.asfortranarray(x), ipctk.edges(faces), np.asfortranarray(faces))
    return ipctk.is_step_collision_free(mesh, np.asfortranarray(x), np.asfortranarray(x + p))


def apart(n: int, rng: np.random.Generator, speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """n pairs of triangles that start apart, and random displacements of their corners."""
    x = rng.standard_normal((4 * n, 6, 3))
    x[:, 3:] += rng.standard_normal((4 * n, 1, 3))
    x = x[[distance(y) > 1e-3 for y in x]][:n]
    return x, speed * (rng.standard_normal((len(x), 2, 1, 3)) + 0.3 * rng.standard_normal((len(x), 2, 3, 3))).reshape(-1, 6, 3)


@pytest.fixture(scope="module")
def motions() -> tuple[np.ndarray, np.ndarray]:
    """Pairs that start apart, and slow and fast displacements."""
    rng = np.random.default_rng(1)
    return tuple(map(np.concatenate, zip(apart(200, rng, 0.3), apart(200, rng, 2.0))))


def test_free_motions_are_free_and_stopped_ones_near(motions):
    x, p = motions
    part = free_until(x, p)
    assert ((part >= 0.0) & (part <= 1.0)).all()
    truth = np.array([exactly_free(y, q) for y, q in zip(x, p)])
    called = part == 1.0
    assert not (called & ~truth).any() and (~truth).sum() > 20
    assert (called & truth).sum() > 0.99 * truth.sum()
    floor = 1e-3  # [m]; ipctk's own tolerance is 1e-6
    part = free_until(x, p, floor=floor)
    assert all(exactly_free(y, f * q) for y, q, f in zip(x, p, part))
    stopped = part < 1.0
    left = np.array([distance(y + f * q) for y, q, f in zip(x[stopped], p[stopped], part[stopped])])
    first = np.array([distance(y) for y in x[stopped]])
    assert (left >= np.minimum(floor, 0.5 * first) * (1.0 - 1e-9)).all()
    assert np.median(left) < 1.5 * floor and np.quantile(left, 0.9) < 0.1  # unless the motion turns as it comes near


def test_what_simple_tests_call_clear_is_free(motions):
    """Whatever plane is tried first."""
    (x, p), floor = motions, 1e-2
    found = np.zeros((separation.N_PLANES, len(x)))
    for first in range(separation.N_PLANES):
        plane(x, p, floor, first, found[first])
    clear = found[0] >= 0.0
    assert ((found >= 0.0) == clear).all() and 60 < clear.sum() < len(x)
    assert all((found[k] == k).any() for k in range(separation.N_PLANES)) and (free_until(x, p, floor=floor)[clear] == 1.0).all()
    for y, q in zip(x[clear], p[clear]):
        assert min(distance(y + t * q) for t in (0.0, 0.5, 1.0)) >= floor * (1.0 - 1e-9)


FLAT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]])


def test_head_on_gliding_and_touching():
    x = np.concatenate([FLAT + [0.1, 0.01, 0.1], FLAT])[None]
    down, along = np.zeros((1, 6, 3)), np.zeros((1, 6, 3))
    down[0, :3, 1], along[0, :3, 0] = -0.02, 0.5
    assert free_until(x, along, floor=1e-3) == 1.0
    assert free_until(x, down, floor=1e-3) == pytest.approx(0.45, rel=1e-9)
    assert free_until(x, 0.4 * down, floor=1e-3) == 1.0
    assert free_until(x, down, radius=0.005, floor=1e-3) == pytest.approx(0.2, rel=1e-9)
    x[0, :3, 1] = 0.0  # the side on which they are is unknown
    for move in (down, -down, 0.0 * down):
        assert free_until(x, move) == 0.0


def test_turning_together_is_free():
    rng = np.random.default_rng(3)
    together = np.concatenate([FLAT + [0.2, 1e-4, 0.1], FLAT])
    x = np.stack([together @ rotation(rng.standard_normal(3), rng.uniform(0.0, 3.0)).T for _ in range(50)])
    turned = np.stack([y @ rotation(rng.standard_normal(3), 0.5).T for y in x])
    assert (free_until(x, turned - x, floor=1e-5) == 1.0).all()


def test_crossing_triangles_cannot_move():
    x = np.random.default_rng(5).standard_normal((200, 6, 3))
    crossing = np.array([distance(y) == 0.0 for y in x])
    assert 10 < crossing.sum() < 190
    assert np.array_equal(free_until(x, 0.0 * x, are_apart=False) < 1.0, crossing)


def test_frame_and_order_change_nothing(motions):
    (x, p), rng = motions, np.random.default_rng(4)
    part = free_until(x, p)
    R, shift, drift = rotation(rng.standard_normal(3), 2.0), rng.standard_normal(3), rng.standard_normal(3)
    assert np.allclose(free_until(x @ R.T + shift, p @ R.T + drift), part, atol=1e-6)
    order = [4, 3, 5, 1, 2, 0]
    assert np.allclose(free_until(x[:, order], p[:, order]), part, atol=1e-6)
