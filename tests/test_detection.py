"""The whole detection, from a simulator's state to its list of contacts, on a scene with contacts of every kind:

* turning, shifting and scaling the scene turns, shifts and scales its contacts; the order of the bodies only swaps sides;
* one thread and many give the same contacts to the last bit, and so does every repetition; features stay while bodies slide;
* nodes and weights give the two surface points of a contact, its point lies midway, its gap is their distance along the normal;
* what is not finite is refused by name; lists without a contact have their shapes.
"""

import numpy as np
import pytest
from detection_scenes import DT, compare, identical, keys, pairs_of, simulator, zoo
from rotations import rotation
from scenes import rows_of

from taisoft.collision import surface
from taisoft.collision.contacts import KINDS
from taisoft.collision.detector import Detection
from taisoft.errors import SimulationError


@pytest.fixture(scope="class", params=["f64", "f32"])
def made(request):
    scene, place = zoo()
    with simulator(scene, request.param) as sim:
        yield sim, place, sim.positions(), 1e-9 if request.param == "f64" else 1e-4


@pytest.fixture
def still(made):
    """The simulator with all bodies where they start, the place of the obstacles, how close two lists must be."""
    sim, place, start, close = made
    place.Q, place.T = np.eye(3), np.zeros(3)
    sim.set_state(positions=start, velocities=np.zeros_like(start))
    return sim, place, start, close


class TestZoo:
    """All in one simulator for each precision."""

    def test_all_kinds_are_there(self, still):
        c = still[0].detect_contacts()
        touching = [("block", "ball"), ("block", "brick"), ("ball", "egg"), ("block", "ground"), ("block", "sphere")]
        touching += [("brick", "capsule"), ("ball", "box"), ("egg", "sheet")]
        assert pairs_of(c) == {frozenset(pair) for pair in touching}
        assert set(c.kind) == set(KINDS) and c.found >= len(c) >= 12 and c.unmapped == 0
        assert (c.gap < 0).any() and (c.gap > 0).any() and c.gap.max() <= 0.02 and c.gap.min() > -0.05
        assert np.abs(np.linalg.norm(c.normal, axis=1) - 1).max() < 1e-12 and (c.impulse == 0).all()

    def test_turned_and_shifted(self, still):
        sim, place, start, close = still
        c, rng = sim.detect_contacts(), np.random.default_rng(0)
        for far in (0.0, 1.0, 1e3, 1e3):
            place.Q, place.T = rotation(rng.standard_normal(3), rng.uniform(0.1, np.pi)), far * rng.standard_normal(3)
            sim.set_state(positions=start @ place.Q.T + place.T)
            compare(c, sim.detect_contacts(), place.Q, place.T, close=close)

    def test_points_of_the_nodes(self, still):
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
        # a field's body, the second id, has its point where a ray meets its triangles, as near as its grid's cells are small
        with_field = np.where(np.char.endswith(c.kind.astype(str), "_field"), c.feature[:, 1], -1)
        for points, sign, owner in ((a, -1, c.body_a), (b, 1, c.body_b)):
            off = np.abs(points + sign * half - c.point).max(axis=1)
            exact = with_field != [names.index(name) for name in owner]
            soft = np.isin(owner.astype(str), list(start))
            assert (soft & exact).sum() > 5 and (soft & ~exact).any()
            assert off[soft & exact].max() < 1e-9 and off[soft].max() < 5e-3

    def test_features_stay_while_a_body_slides(self, still):
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

    @pytest.mark.parametrize("serial_cheap", [False, True])
    def test_the_same_on_one_thread_and_on_many(self, still, monkeypatch, serial_cheap):
        """light: loops that do little at a turn on one thread, the others on many, as of surfaces of middling size."""
        sim, _, start, close = still
        if close > 1e-9:
            return  # once is enough
        one, simulation = sim.detect_contacts(), sim._dynamics.state
        monkeypatch.setattr(surface, "SERIAL_BELOW", 0)
        many = Detection(
            sim.scene, simulation.model, simulation.layout, sim._dynamics.runtime, serial=None if serial_cheap else False
        )
        assert many.surface.serial_cheap == serial_cheap
        many.find(0.0, DT)
        first = many.contacts()
        compare(one, first, close=0.0)  # the parts of the work lie in another order
        assert sim._dynamics.detection.surface.serial and not many.surface.serial and many.surface.chunks > 1
        for _ in range(5):
            many.find(0.0, DT)
            assert identical(first, many.contacts())
            assert identical(one, sim.detect_contacts())
        many.release()

    def test_what_is_not_finite_is_refused(self, still):
        sim, _, start, _ = still
        for field, where in ((sim._dynamics.state.model.state.x, "brick"), (sim._dynamics.state.model.state.v, "egg")):
            for value in (np.nan, np.inf):
                before = field.to_numpy()
                whole, rows = before.copy(), rows_of(sim, where)
                node = sim.scene.body(where).nodes.surface[0, 1]
                whole[rows.start + node, 2] = value
                field.from_numpy(whole)
                sim._dynamics.contact.forget()
                with pytest.raises(SimulationError, match=f"body '{where}', node {node}: position or velocity is not finite"):
                    sim.detect_contacts()
                field.from_numpy(before)
                sim._dynamics.contact.forget()
        assert len(sim.detect_contacts())

    def test_bodies_apart(self, still):
        sim, place, start, _ = still
        place.T = np.array([0.0, -10.0, 0.0])
        for k, body in enumerate(sim.scene.bodies):
            sim.set_state(positions=start[rows_of(sim, body.name)] + (3.0 * k, 0, 0), body=body.name)
        c = sim.detect_contacts()
        assert (len(c), c.found, sim.intersecting_triangles()) == (0, 0, [])
        shapes = [(0, 3), (0, 3), (0,), (0, 3), (0,), (0,), (0, 6), (0, 6), (0,), (0, 2)]
        arrays = (c.point, c.normal, c.gap, c.impulse, c.body_a, c.body_b, c.nodes, c.weights, c.kind, c.feature)
        assert [array.shape for array in arrays] == shapes


@pytest.fixture(scope="module")
def small():
    """The contacts of the zoo at a thousandth of its size."""
    with simulator(zoo(1e-3)[0]) as sim:
        return sim.detect_contacts()


def test_a_thousandth_of_the_size(small):
    """On its own, so that kernels of the next tests have the same keys as these and are not compiled again."""
    assert len(small) >= 12 and np.abs(small.point).max() < 2e-3


def test_a_thousand_times_the_size(small):
    with simulator(zoo(1e3)[0]) as sim:
        compare(small, sim.detect_contacts(), scale=1e6, size=1e3)


def test_the_order_of_bodies(small):
    """Sides are swapped between two bodies; an obstacle stays b."""
    with simulator(zoo(1.0, swapped=True)[0]) as sim:
        c = sim.detect_contacts()
    assert len(c) == len(small)
    for a, b, point, normal, gap, kind in zip(c.body_a, c.body_b, c.point, c.normal, c.gap, c.kind):
        swap = b in ("block", "ball", "brick", "egg")
        k = np.argmin(np.linalg.norm(1e3 * small.point - point, axis=1) + np.abs(1e3 * small.gap - gap))
        assert (small.body_a[k], small.body_b[k]) == ((b, a) if swap else (a, b)) and small.kind[k] == kind
        assert np.abs(1e3 * small.point[k] - point).max() < 1e-9 and 1e3 * small.gap[k] == pytest.approx(gap, abs=1e-9)
        assert np.abs(small.normal[k] - (-normal if swap else normal)).max() < 1e-9
