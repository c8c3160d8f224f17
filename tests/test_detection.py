"""The whole detection, from a simulator's state to its list of contacts:

* turning, shifting and scaling a scene turns, shifts and scales its contacts; the order of the bodies only swaps sides;
* one thread and many give the same list to the last bit, and so does every repetition; features stay while bodies slide;
* nodes and weights give the two surface points of a contact, its point lies midway, its gap is their distance along the normal;
* what arrives within the step is found before it does, what leaves is not, whoever moves;
* a body meets itself where it is folded, and nowhere at rest, however thin it is;
* what is not finite is refused by name; empty lists have their shapes; what is not asked for costs nothing; memory comes back.
"""

import importlib
import pkgutil

import numpy as np
import pytest
from detection_scenes import SOFT, compare, folded, identical, keys, sheets, sweeping, zoo
from rotations import rotation

import taisoft as ts
from taisoft import collision, runtime
from taisoft.collision.contacts import KINDS
from taisoft.collision.pipeline import Detection
from taisoft.errors import SimulationError

DT = 1e-3  # [s]


def simulator(scene: ts.Scene, precision: str = "f64", **settings) -> ts.Simulator:
    # nothing is stepped, and the explicit integrator is built fastest
    return ts.Simulator(scene, dt=DT, integrator="symplectic_euler", precision=precision, allow_unstable=True, **settings)


def pairs_of(c) -> set:
    return {frozenset(pair) for pair in zip(c.body_a, c.body_b)}


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

    def test_the_same_on_one_thread_and_on_many(self, still):
        sim, _, start, close = still
        if close > 1e-9:
            return  # once is enough
        one, world = sim.detect_contacts(), sim._world
        many = Detection(sim.scene, world.model, world.layout, sim._runtime, serial=False)
        many.find(0.0, DT)
        first = many.contacts()
        compare(one, first, close=0.0)  # the parts of the work lie in another order
        assert sim._detections[0].surface.serial and not many.surface.serial and many.surface.chunks > 1
        for _ in range(10):
            many.find(0.0, DT)
            assert identical(first, many.contacts())
            assert identical(one, sim.detect_contacts())
        many.release()

    def test_what_is_not_finite_is_refused(self, still):
        sim, _, start, _ = still
        for field, where in ((sim._world.model.x, "brick"), (sim._world.model.v, "egg")):
            for value in (np.nan, np.inf):
                before = field.to_numpy()
                whole, rows = before.copy(), sim._slice(where)
                node = sim.scene.body(where).nodes.surface[0, 1]
                whole[rows.start + node, 2] = value
                field.from_numpy(whole)
                with pytest.raises(SimulationError, match=f"body '{where}', node {node}: position or velocity is not finite"):
                    sim.detect_contacts()
                field.from_numpy(before)
        assert len(sim.detect_contacts())

    def test_bodies_apart(self, still):
        sim, place, start, _ = still
        place.T = np.array([0.0, -10.0, 0.0])
        for k, body in enumerate(sim.scene.bodies):
            sim.set_state(positions=start[sim._slice(body.name)] + (3.0 * k, 0, 0), body=body.name)
        c = sim.detect_contacts()
        assert (len(c), c.found, sim.intersecting_triangles()) == (0, 0, [])
        shapes = [(0, 3), (0, 3), (0,), (0, 3), (0,), (0,), (0, 6), (0, 6), (0,), (0, 2)]
        arrays = (c.point, c.normal, c.gap, c.impulse, c.body_a, c.body_b, c.nodes, c.weights, c.kind, c.feature)
        assert [array.shape for array in arrays] == shapes


@pytest.fixture(scope="module")
def reference():
    """The zoo's contacts in double precision."""
    with simulator(zoo()[0]) as sim:
        return sim.detect_contacts()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scaled(reference, scale):
    with simulator(zoo(scale)[0]) as sim:
        compare(reference, sim.detect_contacts(), scale=scale)


def test_the_order_of_bodies(reference):
    """Sides are swapped between two bodies; an obstacle stays b."""
    with simulator(zoo(swapped=True)[0]) as sim:
        c = sim.detect_contacts()
    assert len(c) == len(reference)
    soft = ("block", "ball", "brick", "egg")
    for a, b, point, normal, gap, kind in zip(c.body_a, c.body_b, c.point, c.normal, c.gap, c.kind):
        swap = b in soft
        k = np.argmin(np.linalg.norm(reference.point - point, axis=1) + np.abs(reference.gap - gap))
        assert (reference.body_a[k], reference.body_b[k]) == ((b, a) if swap else (a, b)) and reference.kind[k] == kind
        assert np.abs(reference.point[k] - point).max() < 1e-9 and reference.gap[k] == pytest.approx(gap, abs=1e-9)
        assert np.abs(reference.normal[k] - (-normal if swap else normal)).max() < 1e-9


def test_sweeps():
    """Cubes 0.1 m over what is below them, with a margin of 0.01 m: found where 0.09 m or more of that are closed in a step."""
    rising = [0.0]
    with simulator(sweeping(rising)) as sim:
        moving = {"over_block": "block", "over_field": "field", "over_ground": "ground"}
        led = {"over_led": "led", "over_box": "box", "over_mesh": "mesh"}
        assert len(sim.detect_contacts()) == 0
        for way, met in ((0.095, True), (0.085, False), (-0.095, False)):
            rising[0] = way / DT
            assert pairs_of(sim.detect_contacts()) == {frozenset(pair) for pair in (led.items() if met else ())}
            rising[0] = 0.0
            for name in (*moving, *led):
                sim.set_state(velocities=np.tile([0.0, -way / DT, 0.0], (8, 1)), body=name)
            c = sim.detect_contacts()
            assert pairs_of(c) == {frozenset(pair) for pair in ((moving | led).items() if met else ())}
            if met:
                assert c.gap == pytest.approx(0.1, abs=1e-6) and np.abs(c.normal[:, 1]) == pytest.approx(1, abs=1e-6)
            sim.set_state(velocities=np.zeros((sim.positions().shape)))
        # what is near already is told even while it leaves
        sim.set_state(positions=sim.positions("over_block") - (0, 0.095, 0), body="over_block")
        sim.set_state(velocities=np.tile([0.0, 90.0, 0.0], (8, 1)), body="over_block")
        c = sim.detect_contacts()
        assert pairs_of(c) == {frozenset(("over_block", "block"))} and c.gap == pytest.approx(0.005, abs=1e-9)
        with pytest.raises(SimulationError, match="obstacle 'box'"):
            sim.step()


def test_a_body_meets_itself_only_where_it_is_folded():
    with simulator(sheets(), self_collision=True) as sim:
        assert len(sim.detect_contacts()) == 0 and sim.intersecting_triangles() == []
        rest = sim.positions()
        for stretch in ((1.3, 0.9, 1.3), (0.8, 0.7, 0.8)):  # thinner, and shorter
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
            for i in end:  # each has its contact, whichever side it is
                sides = [(c.nodes[:, k : k + 3] == (i, -1, -1)).all(axis=1) for k in (0, 3)]
                mine = np.flatnonzero(sides[0] | sides[1])
                assert len(mine) == 1 and np.abs(c.point[mine] - (x[i, 0], 0.01 + 0.5 * gap, x[i, 2])).max() < 1e-9
                assert np.abs(c.normal[mine] - (0, 1 if sides[0][mine] else -1, 0)).max() < 1e-9
                assert np.abs(c.gap[mine] - gap).max() < 1e-9
            assert bool(sim.intersecting_triangles()) == (gap < 0)
        with pytest.raises(SimulationError, match="self_collision=True"):
            sim.step()


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


def test_nothing_is_paid_before_it_is_asked_for():
    kernels = collision_kernels()
    assert {"find_proximity", "update_boxes", "find_analytic", "decide"} <= kernels
    with simulator(two_bodies()) as sim:
        before, fields = runtime.launches.copy(), set(sim.field_bytes)
        sim.step()
        assert not set(runtime.launches - before) & kernels and set(sim.field_bytes) == fields and not sim._detections
        c = sim.detect_contacts()
        assert len(c) and set(runtime.launches - before) & kernels >= {"find_proximity", "update_boxes", "decide"}
        assert not set(runtime.launches - before) & {"find_analytic", "find_in_fields"}


def test_reset_close_and_reopen():
    found = []
    for _ in range(2):
        with simulator(two_bodies()) as sim:
            found.append(sim.detect_contacts())
            sim.set_state(positions=sim.positions("body1") + 2.0, body="body1")
            assert len(sim.detect_contacts()) == 0
            sim.reset()
            found.append(sim.detect_contacts())
            detection = sim._detections[0]
            arenas = [detection._arena, detection._reduction_arena, detection.buffer._arena]
            assert all(arena.bytes for arena in arenas)
        assert not any(arena.bytes or arena._trees for arena in arenas) and not sim._detections
        with pytest.raises(SimulationError, match="closed"):
            sim.detect_contacts()
    assert len(found[0]) and all(identical(found[0], other) for other in found[1:])


def test_a_body_alone():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(ts.ball_mesh(0.5, 4), ts.Material(**SOFT))
    with simulator(scene, "f32") as sim:
        before = runtime.launches.copy()
        assert len(sim.detect_contacts()) == 0 and sim.intersecting_triangles() == []
        used = set(runtime.launches - before) & collision_kernels()
        assert not used & {"find_active", "count_cells", "find_proximity", "find_in_fields", "find_analytic"}
        assert sim._detections[0].broad is None
