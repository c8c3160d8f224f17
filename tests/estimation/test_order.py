"""Orders, distances of paths and vibrations, as arithmetic: orders and Richardson factors are exact for power laws; what lowers
the order of a scene; vibrations that steps do not resolve raise an error.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.estimation.comparison import distance, largest_excursion, shared_nodes
from taisoft.estimation.order import agreement, error_over_difference, may_jump, nominal_order, observed_order
from taisoft.estimation.vibrations import add_vibrations, are_passed_over, shortest_period
from taisoft.records import ErrorEstimate
from taisoft.scene.refine import refined
from tests.dynamics.scenes import cube, rubber
from tests.estimation.stand_in import block


def test_errors_and_orders_of_a_power_law_are_exact():
    for order in (0.5, 1.7):
        for ratio in (0.5, 3.0):
            one, other = 0.1**order, (0.1 * ratio) ** order
            assert error_over_difference(ratio, order) * abs(other - one) == pytest.approx(one)
        errors = [steps**-order for steps in (2.0, 8.0, 22.0)]
        fine, coarse = errors[1] - errors[2], errors[0] - errors[1]
        assert observed_order(fine, coarse, 2.0, near=22 / 8, far=4.0) == pytest.approx(order)
    assert observed_order(1.0, 4.0, 2.0) == pytest.approx(2.0) and observed_order(1.0, 3.0, 2.0) == pytest.approx(np.log2(3.0))
    assert observed_order(1.0, 4.0, 1.0) == 1.0  # not above the nominal order
    assert observed_order(1.0, 1.3, 2.0) is None and observed_order(0.0, 1.0, 2.0) is None


def test_paths_agree_until_their_differences_show_no_order():
    fine = np.array([1.0, 1.0, 1.0, 1e3, 1e3])
    assert agreement(fine, 16.0 * fine, 0.0) == 5
    assert agreement(fine, np.full(5, 16.0), 0.0) == 3
    assert agreement(fine, fine, 0.0) == 0
    assert agreement(fine, fine, 1e4) == 5  # negligible differences need no order


def changed(method: str, *arguments) -> ts.Scene:
    """A block whose body is moved or pushed."""
    scene = block()
    getattr(scene.bodies[0], method)([0], *arguments)
    return scene


def tied(path=None, **numbers) -> ts.Scene:
    """A block on a spring, or on a tendon of given length."""
    scene = block()
    scene.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name="pin", path=path)
    if "length" in numbers:
        scene.add_tendon([("block", 0), ("block", 1)], stiffness=1.0, **numbers)
    else:
        scene.add_spring(("block", 0), ("pin", (0, 9, 0)), 1.0, **numbers)
    return scene


STILL, RELEASE = (ts.KeyFrames((0.0, 1.0), [(0, 0, 0), (0, 1, 0)], release=release) for release in (False, True))


def test_what_lowers_the_order_of_a_scene_and_may_make_it_jump():
    """Functions of time and releases may jump, key frames do not."""
    damped = (block(mass_damping=1.0), block(stiffness_damping=1.0), tied(damping=1.0))
    driven = (changed("move", STILL), changed("add_force", STILL), tied(path=STILL), tied(length=2.0))
    for scene in (block(), tied(), *damped, *driven):
        order = 2 if scene not in damped + driven else 1
        assert [nominal_order(name, scene, False) for name in ("bdf2", "velocity_verlet", "implicit_euler")] == [order, order, 1]
        assert nominal_order("bdf2", scene, touches=True) == 1
    sudden = (changed("move", RELEASE), changed("add_force", lambda t: (0, t, 0)), changed("move", lambda t: (0, t, 0)))
    assert all(map(may_jump, sudden)) and not any(map(may_jump, (block(), changed("add_force", (0, 1, 0)), *driven[:2])))


def test_distances_are_relative_to_the_largest_excursion():
    path = np.zeros((3, 2, 3))
    path[1, 0] = (3.0, 4.0, 0.0)
    other = path.copy()
    other[2, 1] = (0.0, 0.6, 0.8)
    assert largest_excursion(path) == 5.0 and largest_excursion(path + 7.0) == pytest.approx(5.0)
    error = distance(path, other, 5.0)
    assert error.max == pytest.approx(0.2) and error.rms == pytest.approx(np.sqrt(1.0 / 6.0) / 5.0)


def test_nodes_are_shared_body_by_body():
    """Also where two bodies lie at one place."""
    scene = block()
    scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="other")
    finer = refined(scene)
    starts = [np.concatenate([body.rest_positions for body in one.bodies]) for one in (scene, finer)]
    sizes = [[(body.name, body.n_nodes) for body in one.bodies] for one in (scene, finer)]
    own, theirs = shared_nodes(starts[0], sizes[0], starts[1], sizes[1])
    assert own.tolist() == list(range(20)) and np.array_equal(starts[0][own], starts[1][theirs])
    assert (theirs[:8] < sizes[1][0][1]).all() and (theirs[8:] >= sizes[1][0][1]).all()
    starts[1][sizes[1][0][1] :] += 1e-6
    with pytest.raises(SimulationError, match="body 'other': no node of one mesh is also in the other"):
        shared_nodes(starts[0], sizes[0], starts[1], sizes[1])


def test_vibrations_of_bodies_with_friction():
    """A wave crosses the block, 1.1 m long, twice in a period. Friction of a pair replaces that of the materials."""
    scene, period = block(touching=True, young=4e5, friction=0.3), 2 * 1.1 * np.sqrt(1000.0 / 4e5)
    assert shortest_period(scene) == pytest.approx(period) and shortest_period(block(friction=0.3)) == np.inf  # nothing to rub
    assert are_passed_over(scene, 1.01 * period / 50) and not are_passed_over(scene, 0.99 * period / 50)
    found = [ErrorEstimate(time=time) for time in (0.001, 0.5, None)]
    for one in found:
        add_vibrations(one, scene, period)
    assert 0.001 < found[0].time < 0.1 and found[1].time == 0.5 and found[2].time is None
    assert [len(one.notes) for one in found] == [1, 1, 0] and f"at least {100 * found[0].time:.2g} %" in found[0].notes[0]
    add_vibrations(resolved := ErrorEstimate(time=0.001), scene, 0.001 * period)
    assert resolved.time == 0.001 and not resolved.notes
    scene.set_contact("block", "ground", friction=0.0)
    smooth = block(touching=True, young=4e5, friction=0.0)
    assert shortest_period(scene) == shortest_period(smooth) == np.inf
    smooth.set_contact("block", "ground", friction=0.2)
    assert shortest_period(smooth) == pytest.approx(period)
