"""No kernel of collision detection reads or writes out of bounds: detection with Taichi's bounds checks on.

The checks are chosen when Taichi starts, and slow down compiling several times, so one process runs all scenes: every kind of
geometry at once; contacts, and both broad phases, from buffers of 64 entries. Bodies are at rest, as far away and as fast as
numbers allow, inside out, flat, or in one point; positions that are not finite are refused.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision import surface
from taisoft.collision.bvh import Bvh
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.errors import SimulationError
from tests.collision.contact_cases import wedge
from tests.collision.surfaces import pairs_of, place, surface_of
from tests.collision.test_bvh import colliders, scatter
from tests.dynamics.scenes import dynamics, set_state

ROOT = Path(__file__).resolve().parents[2]
DT = 1 / 60  # [s]


def test_nothing_is_out_of_bounds():
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = os.environ | {"TI_DEBUG": "1", "TI_OPT_LEVEL": "0", "PYTHONPATH": path}  # compiles faster
    done = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.strip() and "overflow detected" not in line]
    assert done.returncode == 0, "\n".join([*lines[-5:], done.stderr[-3000:]])
    assert lines[-1] == "the bounds checks work"


def everything() -> ts.Scene:
    """Every kind of geometry, all in contact."""
    scene = ts.Scene()
    scene.collision = ts.CollisionSettings(initial_capacity=4096, field_cells=8)  # growing recompiles
    cube, above = ts.box_mesh((1, 1, 1), (1, 1, 1)), wedge(0.49, along="x")
    corners, triangles = np.unique(above.surface, return_inverse=True)
    across = above.vertices[corners] + (0, 0, -0.5), triangles.reshape(-1, 3)
    scene.add_body(ts.ball_mesh(0.5, 2), ts.Material(), name="ball", collision="distance_field", position=(0, 0.9, 0))
    scene.add_body(wedge(0.5, up=True), ts.Material(), name="wedge", collision="proximity")
    scene.add_body(cube, ts.Material(), name="quadratic", order=2, collision="distance_field", position=(0.5, 0.1, 0))
    scene.add_obstacle(ts.HalfSpace((0, -0.45, 0), (0, 1, 0)))
    scene.add_obstacle(ts.Sphere((0, 0, 0.8), 0.4))
    scene.add_obstacle(ts.Capsule((-1, 0, 0.5), (1, 0, 0.7), 0.2))
    scene.add_obstacle(ts.Box((-0.5, 0, 0), (0.5, 0.5, 0.5)), path=lambda t: ((0, t, 0), np.eye(3)))
    scene.add_obstacle(ts.MeshObstacle(*across))
    return scene


def detect_everything() -> None:
    """Many states of `everything`."""
    rng = np.random.default_rng(1)
    with dynamics(everything(), dt=DT, self_collision=True, precision="f64") as made:
        x = made.state.state()[0]
        kinds = set(made.find_contacts(DT).contacts().kind)
        assert kinds == {"vertex_face", "edge_edge", "vertex_field", "face_field"}, kinds
        assert made.detection.surface.serial
        ball = np.arange(made.scene.bodies[0].n_nodes)
        inside = ball[np.linalg.norm(made.scene.bodies[0].rest_positions, axis=1) < 1e-9]
        assert len(inside) == 1  # behind every triangle of the ball
        states = {"pressed": x * (1, 0.8, 1), "flat": x * (1, 0, 1), "one point": 0 * x, "mirrored": x * (1, 1, -1)}
        states["shaken"] = x + 0.2 * rng.standard_normal(x.shape)
        states["far"] = x + (1e30, 0, 0)
        states["huge"] = 1e300 * x
        for far in (1e3, 1e30, 1e155, 1e300, 1.7e308):
            for nodes in (inside, ball[rng.integers(0, len(ball), 2)], rng.integers(len(ball), len(x), 3)):
                states[f"{far} {nodes}"] = y = x.copy()
                y[nodes] = far * np.array([1.0, -0.7, 0.4])
        for name, y in states.items():
            print(name)
            set_state(made, y, np.zeros_like(x))
            contacts = made.find_contacts(DT).contacts()
            assert name in ("far", "one point", "huge") or len(contacts) > 0
        for speed in (1.0, 1e30, 1e300):
            set_state(made, x, speed * rng.standard_normal(x.shape))
            made.find_contacts(DT).contacts()
            made.find_contacts(0.0).intersections()
        for bad in (np.nan, np.inf, -np.inf):
            error = np.zeros_like(x)
            error[len(ball) + 3] = bad
            for state in ((x + error, 0 * x), (x, error)):
                set_state(made, *state)
                with pytest.raises(SimulationError, match="body 'wedge', node 3: position or velocity is not finite"):
                    made.find_contacts(DT)
            print("node of no triangle", bad)
            set_state(made, np.where(np.isin(np.arange(len(x)), inside)[:, None], bad, x), 0 * x)
            assert made.find_contacts(DT).contacts().unmapped > 0


def detect_in_full_buffers() -> None:
    """More contacts than fit into 64 chunks of one entry, which may not grow: counted, and not written."""
    surface.SERIAL_BELOW, surface.parallel.pays = 0, lambda seconds: True
    scene = ts.Scene()
    scene.collision = ts.CollisionSettings(initial_capacity=64, max_capacity=65)
    scene.add_body(ts.box_mesh((6, 1, 6), (1, 0.2, 1)), ts.Material())
    scene.add_obstacle(ts.HalfSpace((0, -0.1, 0), (0, 1, 0)))
    with dynamics(scene, dt=DT, precision="f64") as made:
        for scale in (1.0, 1e30):
            set_state(made, scale * made.state.state()[0])
            with pytest.raises(SimulationError, match=r"contacts: [0-9]+ entries are needed .* max_capacity allows 65"):
                made.find_contacts(DT)
        assert made.detection.surface.chunks == 64


def detect_with_both_broad_phases() -> None:
    """Random scenes, with vertices far away and NaN, from 64 entries."""
    rng = np.random.default_rng(2)
    arenas = FieldArena(), FieldArena()
    with surface_of(**colliders(rng), precision="f64", serial=False) as made:
        made.x0 = made.x
        tree = Bvh(made.surface, made.topology, made.x, made.margin, made.machine, arenas[0], capacity=64, leaves=5)
        grid = SpatialHash(made.surface, arenas[1], 0.3, np.ones(3), capacity=64)
        for kind in range(5):
            scatter(rng, made, kind)
            tree.margin, grid.cell = made.margin, (0.3, 1e-3)[kind % 2]
            assert np.array_equal(pairs_of(tree.find()), pairs_of(grid.find()))
        place(made, np.full_like(made.x, np.nan))
        assert len(pairs_of(tree.find())) == len(pairs_of(grid.find())) == 0
        assert tree.rows.growths and grid.members.growths and grid.rows.growths
        tree.release()
        grid.release()


@kernel
def write_beyond(x: ti.template(), i: ti.i32):
    x[i] = 1


def main() -> None:
    for detect in (detect_everything, detect_in_full_buffers, detect_with_both_broad_phases):
        print(detect.__name__)
        detect()
    assert ti.cfg.debug
    with pytest.raises(AssertionError, match="Out of bound access to ndarray at arg 0 with indices .8."):
        write_beyond(FieldArena().field("x", ti.i32, 8), 8)
    print("the bounds checks work")


if __name__ == "__main__":
    main()
