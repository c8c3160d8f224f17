"""No kernel of the collision detection reads or writes beyond its fields: searches with Taichi's bounds checks on.

The checks are chosen when Taichi starts, and kernels take several times as long to compile with them, so one process of its own
runs all scenes: every kind of geometry at once; contacts, and both broad phases, side by side from buffers of 64 entries.
Bodies lie as they were built, fly to 1e30 m and as far as numbers go, move as fast, are turned inside out, flat, or in one point;
positions that are not finite are refused with a sentence.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import taichi as ti
from contact_cases import wedge
from surfaces import pairs_of, place, surface_of
from test_bvh import colliders, scatter

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision import surface
from taisoft.collision.bvh import Bvh
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.errors import SceneError, SimulationError

ROOT = Path(__file__).resolve().parents[1]


def test_nothing_is_out_of_bounds():
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = os.environ | {"TI_DEBUG": "1", "TI_OPT_LEVEL": "0", "PYTHONPATH": path}  # little optimised: sooner there
    done = subprocess.run([sys.executable, __file__], env=environment, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.strip() and "overflow detected" not in line]
    assert done.returncode == 0, "\n".join([*lines[-5:], done.stderr[-3000:]])
    assert lines[-1] == "the check itself works"


def everything() -> ts.Scene:
    """Every kind of geometry, in contact with every other."""
    scene = ts.Scene()
    scene.collision = ts.CollisionSettings(initial_capacity=4096, field_cells=8)  # growing compiles again
    scene.allow_initial_overlap = True
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


def search_everything() -> None:
    """A dozen states and more of `everything`."""
    rng = np.random.default_rng(1)
    with ts.Simulator(everything(), self_collision=True, precision="f64") as sim:
        x = sim.positions()
        kinds = set(sim.detect_contacts().kind)
        assert kinds == {"vertex_face", "edge_edge", "vertex_field", "face_field"}, kinds
        detection = sim._dynamics.detection
        assert detection.surface.serial
        ball = np.arange(sim.scene.bodies[0].n_nodes)
        inside = ball[np.linalg.norm(sim.scene.bodies[0].rest_positions, axis=1) < 1e-9]
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
            sim.set_state(y, np.zeros_like(x))
            contacts = sim.detect_contacts()
            assert name in ("far", "one point", "huge") or len(contacts) > 0
        for speed in (1.0, 1e30, 1e300):
            sim.set_state(x, speed * rng.standard_normal(x.shape))
            sim.detect_contacts()
            sim.intersecting_triangles()
        sim.set_state(x, 0 * x)
        for bad in (np.nan, np.inf, -np.inf):
            v = np.zeros_like(x)
            v[len(ball) + 3] = bad
            with pytest.raises(SceneError, match="velocities: node .* not finite"):
                sim.set_state(x, v)
            for field in (
                sim._dynamics.state.model.state.x,
                sim._dynamics.state.model.state.v,
            ):  # as a step that failed might leave them
                before = field.to_numpy()
                field.from_numpy(before + v)
                sim._dynamics.contact.forget()
                with pytest.raises(SimulationError, match="body 'wedge', node 3: position or velocity is not finite"):
                    sim.detect_contacts()
                field.from_numpy(before)
            print("node of no triangle", bad)
            before = sim._dynamics.state.model.state.x.to_numpy()
            sim._dynamics.state.model.state.x.from_numpy(np.where(np.isin(np.arange(len(x)), inside)[:, None], bad, before))
            sim._dynamics.contact.forget()
            assert sim.detect_contacts().unmapped > 0
            sim._dynamics.state.model.state.x.from_numpy(before)


def search_in_small_parts() -> None:
    """More contacts than fit into 64 parts of one entry, which may not grow: counted, and not written."""
    surface.SERIAL_BELOW = surface.LIGHT_BELOW = 0
    scene = ts.Scene()
    scene.collision = ts.CollisionSettings(initial_capacity=64, max_capacity=65)
    scene.allow_initial_overlap = True  # or the search for it would need more entries
    scene.add_body(ts.box_mesh((6, 1, 6), (1, 0.2, 1)), ts.Material())
    scene.add_obstacle(ts.HalfSpace((0, -0.1, 0), (0, 1, 0)))
    with ts.Simulator(scene, precision="f64") as sim:
        for scale in (1.0, 1e30):
            sim.set_state(scale * sim.positions())
            with pytest.raises(SimulationError, match=r"contacts: [0-9]+ entries are needed .* max_capacity allows 65"):
                sim.detect_contacts()
        assert sim._dynamics.detection.surface.chunks == 64


def search_by_both_broad_phases() -> None:
    """Random scenes, flyers and NaN among them, side by side, from 64 entries."""
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
    for search in (search_everything, search_in_small_parts, search_by_both_broad_phases):
        print(search.__name__)
        search()
    assert ti.cfg.debug
    with pytest.raises(AssertionError, match="Out of bound access to ndarray at arg 0 with indices .8."):
        write_beyond(FieldArena().field("x", ti.i32, 8), 8)
    print("the check itself works")


if __name__ == "__main__":
    main()
