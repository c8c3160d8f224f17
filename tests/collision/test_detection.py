"""Contact detection, from the state to the list of contacts, on a scene with contacts of every kind:

* contacts rotate, translate and scale with the scene; the order of the bodies only swaps sides;
* one thread and many find the same contacts to the last bit, repeatably; features persist while bodies slide;
* nodes and weights give the two surface points of a contact, its point lies midway, its gap is their distance along the normal;
* states that are not finite are refused; empty lists have the right shapes.
"""

import numpy as np
import pytest

from taisoft.collision import surface
from taisoft.collision.contacts import KINDS
from taisoft.collision.detector import Detection
from taisoft.errors import SimulationError
from tests.collision.detection_scenes import DT, compare, identical, keys, pairs_of, simulator, zoo
from tests.collision.rotations import rotation
from tests.dynamics.scenes import dynamics, rows_of, set_state


@pytest.fixture(scope="class", params=["f64", "f32"])
def made(request):
    scene, place = zoo()
    with simulator(scene, request.param) as sim:
        yield sim, place, sim.positions(), 1e-9 if request.param == "f64" else 1e-4


@pytest.fixture
def still(made):
    """The simulator with all bodies at their start, the place of the obstacles, start positions, and tolerance of two lists."""
    sim, place, start, close = made
    place.Q, place.T = np.eye(3), np.zeros(3)
    sim.set_state(positions=start, velocities=np.zeros_like(start))
    return sim, place, start, close


class TestZoo:
    """One simulator for each precision."""

    def test_all_kinds_of_contacts_are_found(self, still):
        c = still[0].detect_contacts()
        touching = [("block", "ball"), ("block", "brick"), ("ball", "egg"), ("block", "ground"), ("block", "sphere")]
        touching += [("brick", "capsule"), ("ball", "box"), ("egg", "sheet")]
        assert pairs_of(c) == {frozenset(pair) for pair in touching}
        assert set(c.kind) == set(KINDS) - {"face_face"} and c.found >= len(c) >= 12 and c.unmapped == 0
        assert (c.gap < 0).any() and (c.gap > 0).any() and c.gap.max() <= 0.02 and c.gap.min() > -0.05
        assert np.abs(np.linalg.norm(c.normal, axis=1) - 1).max() < 1e-12 and (c.impulse == 0).all()

    def test_contacts_rotate_and_translate_with_the_scene(self, still):
        sim, place, start, close = still
        c, rng = sim.detect_contacts(), np.random.default_rng(0)
        for far in (0.0, 1.0, 1e3, 1e3):
            place.Q, place.T = rotation(rng.standard_normal(3), rng.uniform(0.1, np.pi)), far * rng.standard_normal(3)
            sim.set_state(positions=start @ place.Q.T + place.T)
            compare(c, sim.detect_contacts(), place.Q, place.T, close=close)

    def test_weighted_nodes_give_the_contact_points(self, still):
        sim, _, x, _ = still
        c, start = sim.detect_contacts(), {}
        for body in sim.scene.bodies:
            start[body.name] = (sum(n for _, n in start.values()), body.n_nodes)
        on = c.nodes >= 0
        assert (c.weights[~on] == 0).all() and (c.weights >= 0).all() and c.weights.max() <= 1 + 1e-12
        for names, side in ((c.body_a, slice(0, 3)), (c.body_b, slice(3, 6))):
            for name, nodes, weights in zip(names, c.nodes[:, side], c.weights[:, side]):
                if name not in start:
                    assert (nodes == -1).all() and names is c.body_b
                    continue
                first, count = start[name]
                used = nodes[nodes >= 0]
                assert len(used) and ((used >= first) & (used < first + count)).all()
                assert weights.sum() == pytest.approx(1, abs=1e-12)
        a, b = (np.einsum("kn,knx->kx", c.weights[:, s], x[c.nodes[:, s]]) for s in (slice(0, 3), slice(3, 6)))
        half = 0.5 * c.gap[:, None] * c.normal
        names = [one.name for one in sim.scene.colliders]
        # the point on a field's body, the second id, is where a ray meets its triangles: as exact as its grid is fine
        with_field = np.where(np.char.endswith(c.kind.astype(str), "_field"), c.feature[:, 1], -1)
        for points, sign, owner in ((a, -1, c.body_a), (b, 1, c.body_b)):
            off = np.abs(points + sign * half - c.point).max(axis=1)
            exact = with_field != [names.index(name) for name in owner]
            soft = np.isin(owner.astype(str), list(start))
            assert (soft & exact).sum() > 5 and (soft & ~exact).any()
            assert off[soft & exact].max() < 1e-9 and off[soft].max() < 5e-3

    def test_features_persist_while_a_body_slides(self, still):
        sim, _, start, _ = still
        c = sim.detect_contacts()
        ball = sim.positions("ball")
        for k in range(1, 6):
            sim.set_state(positions=ball + 1e-5 * k * np.array([0.6, 0.0, 0.8]), body="ball")
            other = sim.detect_contacts()
            assert keys(other) == keys(c)
            assert np.abs(other.gap - c.gap).max() < 5e-5 * k
            at_vertices = c.kind != "face_field"  # the deepest point between two balls runs ahead
            assert np.abs(other.point - c.point)[at_vertices].max() < 3e-5 * k

    def test_lists_without_contacts_have_their_shapes(self, still):
        sim, place, start, _ = still
        place.T = np.array([0.0, -10.0, 0.0])
        for k, body in enumerate(sim.scene.bodies):
            sim.set_state(positions=start[rows_of(sim, body.name)] + (3.0 * k, 0, 0), body=body.name)
        c = sim.detect_contacts()
        assert (len(c), c.found, sim.intersecting_triangles()) == (0, 0, [])
        shapes = [(0, 3), (0, 3), (0,), (0, 3), (0,), (0,), (0, 6), (0, 6), (0,), (0, 2)]
        arrays = (c.point, c.normal, c.gap, c.impulse, c.body_a, c.body_b, c.nodes, c.weights, c.kind, c.feature)
        assert [array.shape for array in arrays] == shapes


def open_zoo(precision: str = "f64"):
    """The dynamics of the zoo."""
    return dynamics(zoo()[0], dt=DT, integrator="symplectic_euler", precision=precision)


@pytest.mark.parametrize("serial_cheap", [False, True])
def test_one_thread_and_many_find_the_same(monkeypatch, serial_cheap):
    """serial_cheap: cheap loops run on one thread and the others on many, as for surfaces of medium size."""
    with open_zoo() as made:
        one = made.find_contacts(DT)
        contacts = one.contacts()
        monkeypatch.setattr(surface, "SERIAL_BELOW", 0)
        monkeypatch.setattr(surface, "CHEAP_SECONDS", 0.0)
        monkeypatch.setattr("taisoft.backend.parallel.pays", lambda seconds: seconds > 0.0)
        many = Detection(made.scene, made.model, made.state.layout, made.runtime, serial=None if serial_cheap else False)
        assert many.surface.serial_cheap == serial_cheap
        many.find(0.0, DT)
        first = many.contacts()
        compare(contacts, first, close=0.0)  # in another order
        assert one.surface.serial and not many.surface.serial and many.surface.chunks > 1
        for _ in range(5):
            many.find(0.0, DT)
            one.find(0.0, DT)
            assert identical(first, many.contacts()) and identical(contacts, one.contacts())
        many.release()


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_states_that_are_not_finite_are_refused(precision):
    with open_zoo(precision) as made:
        start = made.state.state()
        for k, where in enumerate(("brick", "egg")):  # a position, a velocity
            node = made.scene.body(where).nodes.surface[0, 1]
            for value in (np.nan, np.inf):
                state = [array.copy() for array in start]
                state[k][rows_of(made, where).start + node, 2] = value
                set_state(made, *state)
                with pytest.raises(SimulationError, match=f"body '{where}', node {node}: position or velocity is not finite"):
                    made.find_contacts(DT)
        set_state(made, *start)
        assert len(made.find_contacts(DT).contacts())


@pytest.fixture(scope="module")
def small():
    """The contacts of the zoo at a thousandth of its size."""
    with simulator(zoo(1e-3)[0]) as sim:
        found = sim.detect_contacts()
    assert len(found) >= 12 and np.abs(found.point).max() < 2e-3
    return found


def test_contacts_scale_with_the_scene(small):
    with simulator(zoo(1e3)[0]) as sim:
        compare(small, sim.detect_contacts(), scale=1e6, size=1e3)


def test_order_of_bodies_swaps_sides(small):
    """Between two bodies; an obstacle stays b."""
    with simulator(zoo(1.0, swapped=True)[0]) as sim:
        c = sim.detect_contacts()
    assert len(c) == len(small)
    for a, b, point, normal, gap, kind in zip(c.body_a, c.body_b, c.point, c.normal, c.gap, c.kind):
        swap = b in ("block", "ball", "brick", "egg")
        k = np.argmin(np.linalg.norm(1e3 * small.point - point, axis=1) + np.abs(1e3 * small.gap - gap))
        assert (small.body_a[k], small.body_b[k]) == ((b, a) if swap else (a, b)) and small.kind[k] == kind
        assert np.abs(1e3 * small.point[k] - point).max() < 1e-9 and 1e3 * small.gap[k] == pytest.approx(gap, abs=1e-9)
        assert np.abs(small.normal[k] - (-normal if swap else normal)).max() < 1e-9
