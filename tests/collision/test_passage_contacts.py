"""Passages in the contact detection:

* those that are held become contacts: the nearest points of their features at their time, the normal between these, and the gap
  of the same points now, against NumPy and ipctk;
* where nothing crosses, a contact of surfaces behind each other is none; passages and obstacles remain;
* pairs of colliders that cross or lie inside each other are exempt until they do not, and no others.
"""

from contextlib import contextmanager

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.collision.near_list import SEARCHED
from taisoft.collision.passages import ADJACENT, FLAT, N_FEATURES, N_KINDS, NEAR, ROUND
from taisoft.collision.path_check import NO_PASSAGES, HeldPassages, adjacent_rows
from tests.collision.checked_paths import axis_at
from tests.collision.detection_scenes import folded
from tests.collision.rotations import rotation
from tests.dynamics.scenes import dynamics, rows_of, set_state

ipctk = pytest.importorskip("ipctk")
from benchmarks.judge import axis_distance  # noqa: E402

SETTINGS = {"dt": 1e-3, "precision": "f64", "integrator": "symplectic_euler", "allow_unstable": True, "self_collision": True}
MATERIAL = ts.Material(young=1e3)


class Detected:
    """The detection of a scene, and searches along paths of its nodes."""

    def __init__(self, made, path):
        self.made, self._path, self.detection = made, path, made.find_contacts(0.0)
        self.held, self.none_cross = NO_PASSAGES, False

    def search(self, x: np.ndarray, move: np.ndarray) -> None:
        """Find contacts from nodes (n,3) [m] displaced by `move` [m], and obstacles from 0 to 1 s."""
        set_state(self.made, x)
        self._path.from_numpy(move)
        self.again()

    def again(self) -> None:
        """Repeat the last search, with the passages held by now."""
        self.detection.find(0.0, 1.0, None, self._path, self.held, self.none_cross)

    def meeting(self) -> set[frozenset[str]]:
        """The names of colliders that would pass each other."""
        names = [c.name for c in self.made.scene.colliders]
        found = self.detection.paths.colliders(self.detection.passages(SEARCHED)[0])
        return {frozenset((names[a], names[b])) for a, b in found}


@contextmanager
def detected(scene: ts.Scene):
    arena = FieldArena()
    with dynamics(scene, **SETTINGS) as made:
        yield Detected(made, arena.vectors("path", ti.f64, made.model.n_nodes))
    arena.release()


def crowd() -> ts.Scene:
    """Two boxes turned at random above each other, on a ground that turns, beside a sphere and a capsule that move."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, axis in enumerate(((1, 2, 3), (3, -1, 1))):
        mesh = ts.box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
        mesh = ts.TetMesh(mesh.vertices @ rotation(axis, 0.7).T, mesh.tets)
        scene.add_body(mesh, MATERIAL, name=f"box {k}", position=(0.0, 1.7 * k, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, -1.0, 0), (0, 1, 0)), path=lambda t: (np.zeros(3), rotation((0, 0, 1), 0.1 * t)))
    scene.add_obstacle(ts.Sphere((1.4, 0, 0), 0.4), path=lambda t: ((-0.3 * t, 0, 0), np.eye(3)))
    capsule = ts.Capsule((-1.3, 1.5, -0.5), (-1.3, 1.8, 0.5), 0.2)
    scene.add_obstacle(capsule, path=lambda t: ((0.3 * t, 0, 0), rotation((0, 1, 0), 0.2 * t)))
    return scene


def distance_of(y: np.ndarray, f: int) -> float:
    """Distance [m] of features f of the triangles in rows 0 to 2 and 3 to 5, by ipctk."""
    corners, (i, j) = np.unique(y[3:] if f < 3 else y[:3], axis=0), divmod(f - 6, 3)
    if f >= 6:
        return np.sqrt(ipctk.edge_edge_distance(y[i], y[(i + 1) % 3], y[3 + j], y[3 + (j + 1) % 3]))
    return np.sqrt((ipctk.point_edge_distance if len(corners) == 2 else ipctk.point_triangle_distance)(y[f], *corners))


def axis_point(o, p: np.ndarray, s: float) -> tuple[np.ndarray, np.ndarray]:
    """The point of the axis nearest to p at a part of the path: where it is at first, and its displacement [m]."""
    a, b = axis_at(o, s)
    w = 0.0 if (a == b).all() else np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    now, then = ((1.0 - w) * axis_at(o, at)[0] + w * axis_at(o, at)[1] for at in (0.0, 1.0))
    return now, then - now


def test_held_passages_are_contacts():
    kinds, rng = {}, np.random.default_rng(0)
    with detected(crowd()) as one:
        d, scene, start = one.detection, one.made.scene, one.made.state.state()[0]
        t, node = d.topology.triangle, d.topology.node
        rows, n_soft = adjacent_rows(t)[:, :6], len(scene.bodies)
        for noise in (0.15, 0.15, 0.5):
            move = rng.uniform(-noise, noise, start.shape)
            move[rows_of(one.made, "box 1"), 1] -= 0.5
            move[rows_of(one.made, "box 0"), 1] -= 0.2
            one.search(start, move)
            one.held = HeldPassages(*d.passages(SEARCHED))
            time = dict(zip(map(tuple, one.held[0].tolist()), one.held[1].tolist()))
            one.again()
            c = d.contacts()
            own = np.flatnonzero(c.kind == "face_face")
            first, second = c.feature[own].T
            keys = list(zip(first % N_KINDS, first // N_KINDS, second // N_FEATURES, second % N_FEATURES))
            assert len(keys) == len(time) and set(keys) == set(time)
            for k, (kind, a, b, f) in zip(own, keys):
                s, nodes, w, n = time[kind, a, b, f], c.nodes[k], c.weights[k], c.normal[k]
                x_a, move_a = w[:3] @ start[nodes[:3]], w[:3] @ move[nodes[:3]]
                if kind in (NEAR, ADJACENT):
                    i = node[np.concatenate([t[a], t[b]]) if kind == NEAR else rows[a]]
                    x_b, move_b = w[3:] @ start[nodes[3:]], w[3:] @ move[nodes[3:]]
                    radius, expected = 0.0, distance_of(start[i] + s * move[i], f)
                    assert set(nodes[w > 0]) <= set(i)
                else:
                    o = scene.obstacles[d.paths.colliders(np.array([(kind, a, b, f)]))[0, 1] - n_soft]
                    x_b, move_b, radius, expected = o.shape.pivot, np.zeros(3), 0.0, 0.0
                    if kind == ROUND:
                        i, radius = node[t[a]], o.shape.radius
                        x_b, move_b = axis_point(o, x_a + s * move_a, s)
                        expected = axis_distance(*axis_at(o, s), np.asfortranarray(start[i] + s * move[i]))
                    assert (nodes[3:] == -1).all() and c.body_b[k] == o.name
                if kind != FLAT:
                    offset = x_a + s * move_a - x_b - s * move_b
                    assert np.linalg.norm(offset) == pytest.approx(expected, abs=1e-9)
                    assert n == pytest.approx(offset / np.linalg.norm(offset), abs=1e-9 / expected)
                else:
                    assert n == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
                assert c.gap[k] == pytest.approx((x_a - x_b) @ n - radius, abs=1e-9)
                kinds[kind] = kinds.get(kind, 0) + 1
    assert set(kinds) == {NEAR, ADJACENT, ROUND, FLAT} and min(kinds.values()) > 2


def test_where_nothing_crosses_nothing_is_behind():
    """A vertex behind a face, found by its distance alone, is then in front of another part of the surface."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.allow_initial_overlap = True
    for k in range(2):
        scene.add_body(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), MATERIAL, name=f"box {k}", position=(0.2 * k, 0.98 * k, 0.1 * k))
    scene.add_obstacle(ts.HalfSpace((0, -0.49, 0), (0, 1, 0)), name="ground")
    with detected(scene) as one:
        d, start = one.detection, one.made.state.state()[0]
        one.search(start, np.zeros_like(start))
        every = d.contacts()
        assert set(every.body_b[every.gap < -1e-4]) == {"box 1", "ground"}
        one.none_cross = True
        one.held = HeldPassages(np.array([(NEAR, 0, len(d.topology.triangle) - 1, 9)], dtype=np.int32), np.zeros(1))
        one.again()
        left = d.contacts()
        deep, mortar = left.gap < -1e-4, left.kind == "mortar"
        assert (
            set(left.body_b[mortar]) <= {"box 1"}
            and set(left.body_b[deep & ~mortar]) == {"ground"}
            and (left.kind == "face_face").sum() == 1 < len(left)
        )


@pytest.mark.gpu_path
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_crossing_pairs_are_exempt_until_they_do_not_cross():
    """Two crossing boxes and a crossing sphere; a core inside a box; a box apart that moves into one of them; a ground; a sheet
    folded through itself."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.allow_initial_overlap = True
    box, x = ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), {"a": 0.0, "b": 0.9, "c": 2.1, "core": 0.01}
    for name, at in x.items():
        mesh = ts.box_mesh((1, 1, 1), (0.3, 0.3, 0.3)) if name == "core" else box
        scene.add_body(mesh, MATERIAL, name=name, position=(at, 0.03 * at, 0.02 * at))
    scene.add_body(ts.sheet_mesh((16, 4), (2.0, 0.02, 1.0)), MATERIAL, name="sheet", position=(0.0, 0.0, 20.0))
    scene.add_obstacle(ts.Sphere((-0.6, 0, 0), 0.2), name="sphere")
    scene.add_obstacle(ts.HalfSpace((0, -0.49, 0), (0, 1, 0)), name="ground")
    crossing = {frozenset(pair) for pair in (("a", "b"), ("a", "sphere"), ("sheet",), ("a", "core"))}
    expected = {frozenset(pair) for pair in (("b", "c"), ("a", "ground"))}
    with detected(scene) as one:
        d, start = one.detection, one.made.state.state()[0].copy()
        rows = {name: rows_of(one.made, name) for name in (*x, "sheet")}
        flat = start[rows["sheet"]].copy()
        start[rows["sheet"]], far = folded(flat, -0.002)
        move = np.tile([0.0, -0.05, 0.0], (len(start), 1))
        move[rows["c"], 0], move[rows["core"], 0], move[rows["b"], 2] = -0.5, -0.6, 0.6
        move[rows["sheet"]] *= far[:, None]
        one.search(start, move)
        assert one.meeting() >= expected | crossing
        assert d.exempt_crossing()
        assert one.meeting() & crossing == set() and one.meeting() >= expected
        apart = start.copy()
        apart[rows["b"], 0] += 0.15
        apart[rows["sheet"]] = folded(flat, 0.004)[0]
        one.search(apart, move)
        assert d.exempt_crossing()
        move[rows["b"], 0] = -0.2
        one.search(apart, move)
        assert frozenset(("a", "b")) in one.meeting() and frozenset(("a", "sphere")) not in one.meeting()
        apart[rows["a"]] += (0.12, 0.1, 0.0)  # off the sphere and the ground
        apart[rows["core"], 1] += 2.0
        apart[rows["b"], 1] += 4.0
        one.search(apart, 0.0 * move)
        assert not d.exempt_crossing()
