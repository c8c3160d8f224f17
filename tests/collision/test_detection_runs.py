"""Contact detection over the life of a simulation:

* contacts that close within the step are found, separating ones are not, whichever side moves;
* a body is in contact with itself where it is folded, and nowhere at rest, however thin it is;
* detection that is not needed costs nothing, and the result of a step is reused; after a reset and in a new simulation the
  same contacts are found; all memory is released.
"""

import importlib
import pkgutil

import numpy as np
import pytest

import taisoft as ts
from taisoft import collision
from taisoft.backend import runtime
from tests.collision.detection_scenes import DT, SOFT, folded, identical, pairs_of, sheets, simulator, sweeping
from tests.dynamics.scenes import dynamics, set_state


def test_sweeps():
    """Cubes 0.1 m above other colliders, with a margin of 0.01 m: contacts if the gap closes by 0.09 m or more in a step."""
    rising = [0.0]
    with simulator(sweeping(rising)) as sim:
        moving = {"over_block": "block", "over_field": "field", "over_ground": "ground"}
        prescribed = {"over_led": "led", "over_box": "box", "over_mesh": "mesh"}
        assert len(sim.detect_contacts()) == 0
        for closing, touches in ((0.095, True), (0.085, False), (-0.095, False)):
            rising[0] = closing / DT
            sim.set_state(velocities=np.zeros(sim.positions().shape))  # discards contacts found with the old paths
            assert pairs_of(sim.detect_contacts()) == {frozenset(pair) for pair in (prescribed.items() if touches else ())}
            rising[0] = 0.0
            for name in (*moving, *prescribed):
                sim.set_state(velocities=np.tile([0.0, -closing / DT, 0.0], (8, 1)), body=name)
            c = sim.detect_contacts()
            assert pairs_of(c) == {frozenset(pair) for pair in ((moving | prescribed).items() if touches else ())}
            if touches:
                assert c.gap == pytest.approx(0.1, abs=1e-6) and np.abs(c.normal[:, 1]) == pytest.approx(1, abs=1e-6)
            sim.set_state(velocities=np.zeros(sim.positions().shape))
        # a pair within the margin is a contact even while it separates
        sim.set_state(positions=sim.positions("over_block") - (0, 0.095, 0), body="over_block")
        sim.set_state(velocities=np.tile([0.0, 90.0, 0.0], (8, 1)), body="over_block")
        c = sim.detect_contacts()
        assert pairs_of(c) == {frozenset(("over_block", "block"))} and c.gap == pytest.approx(0.005, abs=1e-9)


def test_self_contacts_only_where_a_body_is_folded():
    with simulator(sheets(), self_collision=True) as sim:
        assert len(sim.detect_contacts()) == 0 and sim.intersecting_triangles() == []
        rest = sim.positions()
        for factors in ((1.3, 0.9, 1.3), (0.8, 0.7, 0.8), (1.0, 0.2, 1.0)):  # thinner, and shorter
            sim.set_state(positions=rest * factors)
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
            # all contacts lie where the upper layer is less than the margin above the lower one
            assert c.point[:, 0].min() > x[end, 0].min() - 1e-9 and c.point[:, 0].max() < x[end, 0].max() + 0.15
            for i in end:  # each has one contact, on either side
                mine = np.flatnonzero(np.abs(c.point - (x[i, 0], 0.01 + 0.5 * gap, x[i, 2])).max(axis=1) < 1e-9)
                assert len(mine) == 1 and np.abs(c.gap[mine] - gap).max() < 1e-9
                assert np.abs(c.normal[mine] - (0, 1 if upper[c.nodes[mine, 0]] else -1, 0)).max() < 1e-9
            assert bool(sim.intersecting_triangles()) == (gap < 0)


def collision_kernels() -> set[str]:
    """Names of all kernels of taisoft.collision."""
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
    """Lists of contacts found by other simulations."""
    return []


SETTINGS = {"dt": DT, "integrator": "symplectic_euler"}


@pytest.mark.parametrize("time", ["first", "again"])
def test_life_of_a_simulation(earlier, time):
    """The search of a step is reused, a reset and another simulation find the same contacts, and memory is released."""
    kernels = collision_kernels()
    assert {"find_proximity", "update_surface", "find_analytic", "begin_reduction"} <= kernels
    with dynamics(two_bodies(), precision="f64", **SETTINGS) as made:
        made.find_contacts(0.0)  # as in a simulator, which checks for overlaps
        before, fields = runtime.launches.copy(), set(made.field_bytes)
        assert {"contacts", "reduction_kept", "problem_normal"} <= fields
        made.advance(1)
        launched = runtime.launches - before
        assert set(launched) & kernels >= {"find_proximity", "update_surface", "begin_reduction"}
        assert set(made.field_bytes) == fields
        assert not set(launched) & {"find_analytic", "find_in_fields"}
        assert len(made.find_contacts(DT).contacts()) and set(runtime.launches - before - launched) == {"gather_contacts"}
        made.reset()
        c = made.find_contacts(DT).contacts()
        assert len(c) and "find_proximity" in runtime.launches - before - launched
        x = made.state.state()[0]
        x[made.state.layout.nodes(1)] += 2.0
        set_state(made, x)
        assert len(made.find_contacts(DT).contacts()) == 0
        made.reset()
        earlier += [c, made.find_contacts(DT).contacts()]
        arena, contact, stepper = made.arena, made.contact, made.stepper
    assert not any((arena.bytes | contact.field_bytes | stepper.field_bytes).values())
    assert all(identical(c, other) for other in earlier)


def test_a_single_body_needs_no_detection():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(ts.ball_mesh(0.5, 4), ts.Material(**SOFT))
    with dynamics(scene, **SETTINGS) as made:
        before, fields = runtime.launches.copy(), set(made.field_bytes)
        made.advance(1)
        assert not set(runtime.launches - before) & collision_kernels() and set(made.field_bytes) == fields
        assert made.detection is None and made.contact is None
        assert len(made.find_contacts(DT).contacts()) == len(made.find_contacts(0.0).intersections()) == 0
        used = set(runtime.launches - before) & collision_kernels()
        assert not used & {"refit", "count_cells", "find_proximity", "find_in_fields", "find_analytic"}
        assert made.detection.broad is None
