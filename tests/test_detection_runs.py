"""Detection over the life of a simulator:

* what arrives within the step is found before it does, what leaves is not, whoever moves;
* a body meets itself where it is folded, and nowhere at rest, however thin it is;
* what is not asked for costs nothing, and what a step found is not looked for again; a reset and a new simulator find the
  same again; memory comes back.
"""

import importlib
import pkgutil

import numpy as np
import pytest
from detection_scenes import DT, SOFT, folded, identical, pairs_of, sheets, simulator, sweeping

import taisoft as ts
from taisoft import collision
from taisoft.backend import runtime
from taisoft.errors import SimulationError


def test_sweeps():
    """Cubes 0.1 m over what is below them, with a margin of 0.01 m: found where 0.09 m or more of that are closed in a step."""
    rising = [0.0]
    with simulator(sweeping(rising)) as sim:
        moving = {"over_block": "block", "over_field": "field", "over_ground": "ground"}
        led = {"over_led": "led", "over_box": "box", "over_mesh": "mesh"}
        assert len(sim.detect_contacts()) == 0
        for way, met in ((0.095, True), (0.085, False), (-0.095, False)):
            rising[0] = way / DT
            sim.set_state(velocities=np.zeros(sim.positions().shape))  # what was found before is for the old paths
            assert pairs_of(sim.detect_contacts()) == {frozenset(pair) for pair in (led.items() if met else ())}
            rising[0] = 0.0
            for name in (*moving, *led):
                sim.set_state(velocities=np.tile([0.0, -way / DT, 0.0], (8, 1)), body=name)
            c = sim.detect_contacts()
            assert pairs_of(c) == {frozenset(pair) for pair in ((moving | led).items() if met else ())}
            if met:
                assert c.gap == pytest.approx(0.1, abs=1e-6) and np.abs(c.normal[:, 1]) == pytest.approx(1, abs=1e-6)
            sim.set_state(velocities=np.zeros(sim.positions().shape))
        # what is near already is told even while it leaves
        sim.set_state(positions=sim.positions("over_block") - (0, 0.095, 0), body="over_block")
        sim.set_state(velocities=np.tile([0.0, 90.0, 0.0], (8, 1)), body="over_block")
        c = sim.detect_contacts()
        assert pairs_of(c) == {frozenset(("over_block", "block"))} and c.gap == pytest.approx(0.005, abs=1e-9)


def test_a_body_meets_itself_only_where_it_is_folded():
    with simulator(sheets(), self_collision=True) as sim:
        assert len(sim.detect_contacts()) == 0 and sim.intersecting_triangles() == []
        rest = sim.positions()
        for stretch in ((1.3, 0.9, 1.3), (0.8, 0.7, 0.8), (1.0, 0.2, 1.0)):  # thinner, and shorter
            sim.set_state(positions=rest * stretch)
            assert len(sim.detect_contacts()) == 0
        sim.set_state(positions=rest)
        flat = sim.positions("sheet")
        for gap in (0.004, -0.002):
            x, upper = folded(flat, gap)
            sim.set_state(positions=x, body="sheet")
            c = sim.detect_contacts()
            assert set(c.body_a) == set(c.body_b) == {"sheet"} and (upper[c.nodes[:, 0]] != upper[c.nodes[:, 3]]).all()
            end = np.flatnonzero(flat[:, 0] > 1 - 1e-9)
            end = end[x[end, 1] < x[end, 1].mean()]
            assert len(end) == 5 and c.gap.min() == pytest.approx(gap, abs=1e-9) and c.gap.max() <= 0.03
            # all of them where the upper layer is less than the margin above the lower
            assert c.point[:, 0].min() > x[end, 0].min() - 1e-9 and c.point[:, 0].max() < x[end, 0].max() + 0.15
            for i in end:  # each has its contact, whichever side it is; at the borders two edges may tell of it
                mine = np.flatnonzero(np.abs(c.point - (x[i, 0], 0.01 + 0.5 * gap, x[i, 2])).max(axis=1) < 1e-9)
                assert len(mine) == 1 and np.abs(c.gap[mine] - gap).max() < 1e-9
                assert np.abs(c.normal[mine] - (0, 1 if upper[c.nodes[mine, 0]] else -1, 0)).max() < 1e-9
            assert bool(sim.intersecting_triangles()) == (gap < 0)


def collision_kernels() -> set[str]:
    """Names of all kernels of the package's folder for collisions."""
    names = set()
    for module in pkgutil.iter_modules(collision.__path__):
        members = vars(importlib.import_module(f"taisoft.collision.{module.name}"))
        names |= {name for name, value in members.items() if hasattr(value, "__wrapped__") and callable(value)}
    return names


def two_bodies() -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    mesh = ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0))
    for k in range(2):
        scene.add_body(mesh, ts.Material(**SOFT), position=(0.2 * k, 1.02 * k, 0.1 * k))
    return scene


@pytest.fixture(scope="module")
def earlier() -> list:
    """Lists of contacts that other simulators found."""
    return []


@pytest.mark.parametrize("time", ["first", "again"])
def test_the_life_of_a_simulator(earlier, time):
    """What a step found is at hand, a reset and another simulator find the same, and memory comes back."""
    kernels = collision_kernels()
    assert {"find_proximity", "update_surface", "find_analytic", "begin_reduction"} <= kernels
    with simulator(two_bodies()) as sim:
        before, fields = runtime.launches.copy(), set(sim.field_bytes)
        assert {"contacts", "problem_gap", "problem_normal"} <= fields
        sim.step()
        launched = runtime.launches - before
        assert set(launched) & kernels >= {"find_proximity", "update_surface", "begin_reduction"}
        assert set(sim.field_bytes) == fields
        assert not set(launched) & {"find_analytic", "find_in_fields"}
        assert len(sim.detect_contacts()) and set(runtime.launches - before - launched) == {"gather_contacts"}
        sim.reset()
        c = sim.detect_contacts()
        assert len(c) and "find_proximity" in runtime.launches - before - launched
        sim.set_state(positions=sim.positions("body1") + 2.0, body="body1")
        assert len(sim.detect_contacts()) == 0
        sim.reset()
        earlier += [c, sim.detect_contacts()]
        detection, contact = sim._dynamics.detection, sim._dynamics.contact
        arenas = [detection._arena, detection._reduction_arena, detection.buffer._arena]
        arenas += [contact._arena, contact._path_arena, contact._numbers_arena]
        assert all(arena.bytes for arena in arenas)
    assert not any(arena.bytes or arena._lanes or arena._arrays for arena in arenas) and not sim._dynamics._owned
    with pytest.raises(SimulationError, match="closed"):
        sim.detect_contacts()
    assert all(identical(c, other) for other in earlier)


def test_a_body_alone():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(ts.ball_mesh(0.5, 4), ts.Material(**SOFT))
    with simulator(scene, "f32") as sim:
        before, fields = runtime.launches.copy(), set(sim.field_bytes)
        sim.step()
        assert not set(runtime.launches - before) & collision_kernels() and set(sim.field_bytes) == fields
        assert sim._dynamics.detection is None and sim._dynamics.contact is None
        assert len(sim.detect_contacts()) == 0 and sim.intersecting_triangles() == []
        used = set(runtime.launches - before) & collision_kernels()
        assert not used & {"refit", "count_cells", "find_proximity", "find_in_fields", "find_analytic"}
        assert sim._dynamics.detection.broad is None
