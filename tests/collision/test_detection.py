"""Contact detection, from the state to the list of contacts, on a scene with contacts of every kind:

* contacts rotate, translate and scale with the scene;
* one thread with trees and many with the spatial hash find the same, repeatably, and so do a reset and another simulation; all
  memory is released; features persist while bodies slide;
* nodes and weights give the two surface points of a contact, its point lies midway, its gap is their distance along the normal;
* a body is in contact with itself where it is folded, and nowhere at rest, however thin it is;
* states that are not finite are refused, extreme ones are not; empty lists have the right shapes.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.contacts import KINDS
from taisoft.collision.detector import Detection
from taisoft.errors import SimulationError
from tests.collision.detection_scenes import DT, compare, folded, identical, keys, sheets, simulator, zoo
from tests.collision.rotations import rotation
from tests.dynamics.scenes import dynamics, rows_of, set_state


@pytest.fixture(scope="module")
def made(taken_path):
    scene, place = zoo()
    with simulator(scene) as sim:
        yield sim, place


@pytest.fixture
def still(made):
    """The simulator with all bodies at their start, the place of the obstacles, and start positions."""
    sim, place = made
    place.Q, place.T = np.eye(3), np.zeros(3)
    sim.reset()
    return sim, place, sim.positions()


@pytest.mark.gpu_path
def test_all_kinds_of_contacts_are_found(still):
    c = still[0].detect_contacts()
    touching = [("block", "ball"), ("block", "brick"), ("ball", "egg"), ("block", "ground"), ("block", "sphere")]
    touching += [("brick", "capsule"), ("ball", "box"), ("egg", "sheet")]
    assert set(map(frozenset, zip(c.body_a, c.body_b))) == set(map(frozenset, touching))
    assert set(c.kind) == set(KINDS) - {"face_face", "mortar"} and c.found >= len(c) >= 12 and c.unmapped == 0
    assert (c.gap < 0).any() and (c.gap > 0).any() and c.gap.max() <= 0.02 and c.gap.min() > -0.05
    assert np.abs(np.linalg.norm(c.normal, axis=1) - 1).max() < 1e-12 and (c.impulse == 0).all()
    table = c.to_dict()  # as pandas takes it
    assert {column.shape for column in table.values()} == {(len(c),)} and table["body_a"] is c.body_a
    assert np.array_equal(np.stack([table[f"point_{axis}"] for axis in "xyz"], axis=1), c.point)


def test_contacts_rotate_translate_and_scale_with_the_scene(still):
    sim, place, start = still
    c, rng = sim.detect_contacts(), np.random.default_rng(0)
    for far in (0.0, 1.0, 1e3):
        place.Q, place.T = rotation(rng.standard_normal(3), rng.uniform(0.1, np.pi)), far * rng.standard_normal(3)
        sim.set_state(positions=start @ place.Q.T + place.T)
        compare(c, sim.detect_contacts(), place.Q, place.T)
    with simulator(zoo(1e-3)[0]) as small:
        compare(c, small.detect_contacts(), scale=1e-3, size=1e-3)


def test_weighted_nodes_give_the_contact_points(still):
    sim, _, x = still
    c, colliders = sim.detect_contacts(), [one.name for one in sim.scene.colliders]
    owner = np.repeat(np.arange(4), [body.n_nodes for body in sim.scene.bodies])
    # the point on a field's body, the second id, is where a ray meets its triangles: as exact as its grid is fine
    with_field = np.where(np.char.endswith(c.kind.astype(str), "_field"), c.feature[:, 1], -1)
    for names, side, sign in ((c.body_a, slice(0, 3), -1), (c.body_b, slice(3, 6), 1)):
        nodes, weights, body = c.nodes[:, side], c.weights[:, side], np.array([colliders.index(name) for name in names])
        used, soft, exact = nodes >= 0, body < 4, with_field != body
        assert (owner[nodes] == body[:, None])[used].all() and not used[~soft].any() and (weights[~used] == 0).all()
        assert weights.min() >= 0 and np.abs(weights.sum(axis=1) - 1)[soft].max() < 1e-12
        points = np.einsum("kn,knx->kx", weights, x[nodes])
        off = np.abs(points + sign * 0.5 * c.gap[:, None] * c.normal - c.point).max(axis=1)
        assert (soft & exact).sum() > 5 and (soft & ~exact).any()
        assert off[soft & exact].max() < 1e-9 and off[soft].max() < 5e-3


def test_features_persist_while_a_body_slides(still):
    sim, _, _ = still
    c, ball = sim.detect_contacts(), sim.positions("ball")
    for k in range(1, 4):
        sim.set_state(positions=ball + 1e-5 * k * np.array([0.6, 0.0, 0.8]), body="ball")
        other = sim.detect_contacts()
        assert keys(other) == keys(c) and np.abs(other.gap - c.gap).max() < 5e-5 * k


def test_lists_without_contacts_have_their_shapes(still):
    sim, place, start = still
    place.T = np.array([0.0, -10.0, 0.0])
    for k, body in enumerate(sim.scene.bodies):
        sim.set_state(positions=start[rows_of(sim, body.name)] + (3.0 * k, 0, 0), body=body.name)
    c = sim.detect_contacts()
    assert (len(c), c.found, sim.intersecting_triangles()) == (0, 0, [])
    shapes = [(0, 3), (0, 3), (0,), (0, 3), (0,), (0,), (0, 6), (0, 6), (0,), (0, 2)]
    arrays = (c.point, c.normal, c.gap, c.impulse, c.body_a, c.body_b, c.nodes, c.weights, c.kind, c.feature)
    assert [array.shape for array in arrays] == shapes


def test_one_thread_and_many_find_the_same_again_and_again(still):
    scene, expected = zoo()[0], still[0].detect_contacts()
    scene.collision = ts.CollisionSettings(margin=0.02, broad_phase="spatial_hash")
    with dynamics(zoo()[0], dt=DT, integrator="symplectic_euler", precision="f64") as made:
        one = made.find_contacts(DT)
        many = Detection(scene, made.model, made.state.layout, made.runtime, serial=False)
        many.find(0.0, DT)
        first = many.contacts()
        compare(expected, first, close=0.0)  # in another order
        assert np.array_equal(one.intersections(), many.intersections()) and len(one.intersections()) > 5
        assert np.array_equal(one.crossings(), many.crossings()) and one.crossings()[2] > 5
        for _ in range(3):
            many.find(0.0, DT)
            one.find(0.0, DT)
            assert identical(first, many.contacts()) and identical(expected, one.contacts())
        many.release()
        set_state(made, 2.0 * made.state.state()[0])
        assert len(made.find_contacts(DT).contacts()) < len(first)
        made.reset()
        assert identical(expected, made.find_contacts(DT).contacts())
        arenas = made.arena, made.contact, made.stepper
    assert not any((arenas[0].bytes | arenas[1].field_bytes | arenas[2].field_bytes | many.field_bytes).values())


def test_extreme_states_are_no_fault_and_those_that_are_not_finite_are_refused():
    """Bodies are inside out, flat, in one point, as far away and as fast as numbers allow."""
    rng = np.random.default_rng(1)
    with dynamics(zoo()[0], dt=DT, integrator="symplectic_euler", precision="f64", self_collision=True) as made:
        start = x, v = made.state.state()
        states = [x * (1, 0.8, 1), x * (1, 1, -1), x * (1, 0, 1), 0.0 * x, x + (1e30, 0, 0), 1e300 * x]
        for far in (1e3, 1e155, 1e300):
            states.append(x.copy())
            states[-1][rng.integers(0, len(x), 5)] = far * np.array([1.0, -0.7, 0.4])
        for y in states:
            set_state(made, y)
            c = made.find_contacts(DT).contacts()
            assert np.isfinite(c.normal).all() and len(made.find_contacts(DT).crossings()) == 3
            assert c.unmapped or y is not states[1]  # distance fields of inverted tets are of no use
        set_state(made, x, 1e300 * rng.standard_normal(x.shape))
        made.find_contacts(DT)
        for k, where in enumerate(("brick", "egg")):  # a position, a velocity
            node = made.scene.body(where).nodes.surface[0, 1]
            for value in (np.nan, np.inf):
                state = [array.copy() for array in start]
                state[k][rows_of(made, where).start + node, 2] = value
                set_state(made, *state)
                with pytest.raises(SimulationError, match=f"body '{where}', node {node}: position or velocity is not finite"):
                    made.find_contacts(DT)
        set_state(made, x, v)
        assert len(made.find_contacts(DT).contacts())


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
            assert (
                set(c.body_a) == set(c.body_b) == {"sheet"}
                and (upper[c.nodes[:, 0]] != upper[c.nodes[:, c.nodes.shape[1] // 2]]).all()
            )
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
        # a strip folded by 178 degrees penetrates itself at the fold: contacts part the layers
        strip, turn = sim.positions("strip") - (0, 9, 0), np.radians(178.0)
        over = strip[:, 0] > 1e-9
        assert not over[0]
        strip[over, :2] = strip[over, :2] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        sim.set_state(positions=strip + (0, 9, 0), body="strip")
        c = sim.detect_contacts()
        nodes = np.where(c.nodes >= 0, c.nodes - rows_of(sim, "strip").start, 0)[c.body_a == "strip"]
        of_over = over[nodes] * c.weights[c.body_a == "strip"]
        a, b = (part.sum(axis=1) for part in np.split(of_over, 2, axis=1))
        parts = np.sign(a - b) * c.normal[c.body_a == "strip", 1]
        assert len(a) > 10 and (a != b).all() and np.mean(parts > 0.5) > 0.9, parts
