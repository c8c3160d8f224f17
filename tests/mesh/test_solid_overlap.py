"""Overlap of solids whose surfaces coincide, wholly or in part: the depth is invariant under rigid motions and under exchange of
the two; flush faces do not overlap; depths of cuts agree with linear programming, distances with sampling.
"""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

import taisoft as ts
from taisoft.mesh.distances import (
    are_inside,
    distances,
    greatest_depth,
    is_closed,
    nearest_hit,
    segment_distance,
    signed_distances,
)
from taisoft.mesh.solids import ALLOWED, Solid, connected_parts, cut_depths, inner_depths, inner_tets, overlap_depth, solid_depths


def box(n: int, size=(1, 1, 1), pattern="five") -> ts.TetMesh:
    return ts.box_mesh((n, n, n), size, pattern=pattern)


def rotated(mesh: ts.TetMesh, rotvec) -> ts.TetMesh:
    return ts.TetMesh(Rotation.from_rotvec(rotvec).apply(mesh.vertices.copy()), mesh.tets)


def subset(mesh: ts.TetMesh, kept: np.ndarray) -> ts.TetMesh:
    used, tets = np.unique(mesh.tets[kept], return_inverse=True)
    return ts.TetMesh(mesh.vertices[used], tets.reshape(-1, 4))


def hollow() -> ts.TetMesh:
    """A cube of side 3 with a cubic cavity of side 1."""
    full = box(3, (3, 3, 3))
    return subset(full, (np.abs(full.vertices[full.tets].mean(axis=1)) > 0.5).any(axis=1))


MESHES = {
    "coarse": box(1),
    "cube": box(2),
    "fine": box(3),
    "six": box(2, pattern="six"),
    "eighth": box(1, (0.5, 0.5, 0.5)),
    "hollow": hollow(),
    "tilted": rotated(box(1), (0, 0, np.pi / 4)),
    "rotated": rotated(box(2), (0, np.pi / 2, 0)),
}
NO_MOTION = Rotation.identity(), np.zeros(3)
MOTIONS = [NO_MOTION, (Rotation.random(random_state=1), np.array([30.0, -60.0, 10.0]))]


def solid(name: str, shift=(0, 0, 0), motion=NO_MOTION, filled: bool = True) -> Solid:
    mesh = MESHES[name]
    nodes = motion[0].apply(mesh.vertices + np.array(shift, dtype=float)) + motion[1]
    used, triangles = np.unique(mesh.surface, return_inverse=True)
    filling = (nodes, mesh.tets) if filled else (np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))
    return Solid(nodes[used], triangles.reshape(-1, 3), *filling)


def depths(a: str, b: str, shift) -> np.ndarray:
    """(motions, 6) [m]: both orders, with tets in both, in the first only, in the second only."""
    found = []
    for motion in MOTIONS:
        for filled in ((True, True), (True, False), (False, True)):
            one, other = solid(a, shift, motion, filled[0]), solid(b, (0, 0, 0), motion, filled[1])
            found += [overlap_depth(one, other), overlap_depth(other, one)]
    return np.reshape(found, (len(MOTIONS), 6))


OVERLAPPING = [  # meshes, shift of the first [m], bounds of the depth [m]
    ("cube", "fine", (0, 0, 0), 0.5, 0.5),
    ("cube", "rotated", (0, 0, 0), 0.5, 0.5),
    ("cube", "cube", (1e-5, 2e-5, -1e-5), 0.4999, 0.5),
    ("cube", "six", (0.5, 0, 0), 0.5, 0.5),
    ("coarse", "coarse", (1 - 1e-5, 0, 0), 1e-5, 1e-5),  # no vertex lies inside: only cuts show the depth
    ("cube", "cube", (0.9, 0, 0.9), 0.1, 0.1),
    ("eighth", "fine", (0.01, 0.02, 0.03), 0.4, 0.5),
    ("cube", "hollow", (1, 0, 0), 0.5, 0.5),
]
TOUCHING = [
    ("cube", "fine", (0.3, 1, 0.2)),
    ("coarse", "hollow", (0, 0, 0)),
    ("eighth", "hollow", (0.1, 0.2, -0.2)),
    ("tilted", "coarse", (0, 0.5 + np.sqrt(0.5), 0)),
    ("coarse", "cube", (0, 1 - 5e-7, 0)),
]


@pytest.mark.parametrize("a, b, shift, lower, upper", OVERLAPPING)
def test_depth_of_overlapping_solids(a, b, shift, lower, upper):
    found = depths(a, b, shift)
    assert found[:, 0].min() > lower - 1e-9 and found[:, 0].max() < upper + 1e-9
    assert found[:, 2:].min() > 9e-6 and found[:, 2:].max() < found[:, 0].max() + 1e-9  # without tets a lower bound
    assert np.ptp(found, axis=0).max() < 1e-11 and np.abs(found[:, ::2] - found[:, 1::2]).max() < 1e-11


@pytest.mark.parametrize("a, b, shift", TOUCHING)
def test_touching_solids_do_not_overlap(a, b, shift):
    assert depths(a, b, shift).max() < 0.6 * ALLOWED


def test_solid_joined_at_an_edge_only(monkeypatch):
    """Four surface triangles share that edge, where vertex normals cannot decide what is inside."""
    full = box(2)
    middle = full.vertices[full.tets].mean(axis=1)
    with pytest.warns(UserWarning, match="edge"):
        monkeypatch.setitem(MESHES, "joined", subset(full, middle[:, 0] * middle[:, 1] > 0.0))
    assert overlap_depth(solid("joined"), solid("eighth", (0.25, 0.25, 0))) == pytest.approx(0.25, abs=1e-9)
    assert overlap_depth(solid("joined"), solid("eighth", (0.25, -0.25, 0))) < 1e-12


def test_cut_depths_agree_with_linear_programming():
    """The depth is 0 exactly where the two have no point in common; otherwise it is the least width over all directions."""
    rng = np.random.default_rng(0)
    triangles, tets = rng.random((40, 3, 3)), rng.random((40, 4, 3))
    pairs, depth = cut_depths(triangles, tets, 0.0)
    assert len(np.unique(pairs, axis=0)) == len(pairs) > 500 and 200 < (depth > 0.0).sum() < len(pairs) - 200
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for (t, m), d in list(zip(pairs, depth))[:120]:
        # weights of both sets of corners that give the same point
        points = np.concatenate([triangles[t], -tets[m]])
        equal = np.vstack([points.T, [1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 1, 1, 1, 1]])
        intersect = linprog(np.zeros(7), A_eq=equal, b_eq=[0, 0, 0, 1, 1]).status == 0
        assert intersect == (d > 0.0)
        width = (triangles[t] @ directions.T).max(axis=0) - (tets[m] @ directions.T).min(axis=0)
        assert d <= max(width.min(), 0.0) + 1e-12 and (not intersect or width.min() < d + 0.05)
    above, below = triangles.max(axis=1)[:, None] >= tets.min(axis=1), triangles.min(axis=1)[:, None] <= tets.max(axis=1)
    assert np.array_equal(np.argwhere((above & below).all(axis=2)), pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


def test_distances_of_points_rays_and_segments():
    rng, mesh = np.random.default_rng(1), MESHES["hollow"]
    corners, points = mesh.vertices[mesh.surface], rng.uniform(-2, 2, (300, 3))
    exact = signed_distances(mesh.vertices, mesh.surface, points)
    assert np.abs(distances(corners, points) - np.abs(exact)).max() < 1e-12
    assert np.array_equal(are_inside(corners, points), exact < 0.0) and 50 < (exact < 0.0).sum() < 250
    assert np.abs(solid_depths(corners, points) - np.maximum(-exact, 0.0)).max() < 1e-12
    assert greatest_depth(mesh.vertices, mesh.surface, points) == pytest.approx(-exact.min(), rel=1e-12)
    assert np.array_equal(are_inside(corners[:, ::-1], points), exact > 0.0)  # inside out
    assert is_closed(mesh.surface) and not is_closed(mesh.surface[1:])
    assert nearest_hit(corners, np.zeros(3), np.array([1.0, 0, 0])) == pytest.approx(0.5)
    assert nearest_hit(corners, np.array([0, 2.0, 0]), np.array([0, 1.0, 0])) == np.inf
    steps = np.linspace(0.0, 1.0, 400)[:, None]
    for a, b in rng.uniform(-4, 4, (12, 2, 3)):
        sampled, found = distances(corners, a + steps * (b - a)).min(), segment_distance(corners, a, b)
        assert found <= sampled + 1e-12 and sampled - found < 0.02
    assert segment_distance(corners, np.array([-5.0, 2, 0]), np.array([5.0, 2, 0])) == pytest.approx(0.5)  # along a face


def test_inner_points_lie_inside_their_own_component():
    one, two = box(2), rotated(box(3, (0.3, 0.2, 0.4)), (0.3, 0.2, 0.1))
    both = ts.TetMesh(
        np.concatenate([one.vertices, two.vertices + (0, 3, 0)]), np.concatenate([one.tets, two.tets + one.n_verts])
    )
    part, surface = connected_parts(both.tets), connected_parts(both.surface)
    assert np.array_equal(part, np.repeat([0, 1], [one.n_tets, two.n_tets]))
    best, room = inner_tets(both.vertices, both.tets, part)
    triangle, behind, clear = inner_depths(both.vertices, both.surface, surface)
    assert np.array_equal(part[best], [0, 1]) and np.array_equal(surface[triangle], [0, 1])
    x = both.vertices[both.surface[triangle]]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    back = x.mean(axis=1) - behind[:, None] * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    for points, distance in ((both.vertices[both.tets[best]].mean(axis=1), room), (back, clear)):
        deep = [solid_depths(both.vertices[both.surface[surface == k]], points) for k in range(2)]
        assert (np.diagonal(deep) >= distance - 1e-12).all() and distance.min() > 0.01 and deep[0][1] == deep[1][0] == 0.0
    _, behind, clear = inner_depths(both.vertices, both.surface[:1], np.zeros(1, dtype=np.int64))
    assert behind[0] == clear[0] == 0.0  # nothing lies behind a single triangle
