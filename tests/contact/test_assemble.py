"""Contact problems assembled from detected contacts, compared with NumPy:

* nodes, signed weights, normals, right-handed frames, and friction and restitution of each pair, also after they change;
* displacement of moving obstacles at a contact, and the approach speed;
* gap minus target: far apart, within the contact offset, penetrating, rebounding;
* the speed at which contacts of an implicit step rebound, after energy lost in flight and the way that is left, by the formula;
* warm start: the impulse of the nearest contact of the same feature in the last step, scaled by the ratio of the steps.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import build_node_problem, fill_field, read_entries
from taisoft.contact.restitution import explicit_opening, find_rebounds
from taisoft.contact.targets import gap_minus_target
from tests.collision.rotations import rotation
from tests.contact import contact_oracle as oracle
from tests.dynamics.scenes import dynamics, set_state

DT = 1e-3  # [s]
LIFT = [(3, 0, -1), (3, 0, 1), (5, 0, 1), (5, 0, -1)]


def scene() -> ts.Scene:
    """A block on a rotating box, a brick on the block, another brick on a rising mesh."""
    made, soft = ts.Scene(), {"young": 1e5, "density": 1000.0}
    block, brick = ts.Material(friction=0.4, restitution=0.2, **soft), ts.Material(friction=0.9, restitution=0.1, **soft)
    mesh = ts.box_mesh((1, 1, 1), (0.3, 0.2, 0.35))
    under = ts.box_mesh((2, 1, 2), (1.0, 0.5, 1.0))
    made.add_body(under, block, name="block", position=(0, 0.2502, 0), velocity=(0.2, -0.3, 0.1))
    made.add_body(mesh, brick, name="brick", position=(0.13, 0.6004, 0.08), velocity=(0, -1, 0))
    made.add_body(mesh, brick, name="other", position=(4.0, 0.1002, 0.03))
    table, lift = ts.Box((0, -0.2, 0), (0.6, 0.2, 0.7)), ts.MeshObstacle(LIFT, [(0, 1, 2), (0, 2, 3)])
    made.add_obstacle(table, name="table", friction=0.6, path=lambda t: ((0.5 * t, 0, 0.2 * t), rotation((0.3, 2, -0.4), 2 * t)))
    rising = {"restitution": 0.5, "path": lambda t: ((0.1 * t, 1.5 * t, 0.0), rotation((1, 0, 0), 0.3 * t))}
    made.add_obstacle(lift, name="lift", friction=0.1, **rising)
    made.set_contact("block", "brick", friction=0.25)
    return made


@pytest.fixture(scope="module")
def begun(taken_path):
    """The dynamics with the contact problem of a step; the number of its contacts."""
    with dynamics(scene(), dt=DT, integrator="symplectic_euler", precision="f64") as made:
        yield made, made.contact.begin(made.state.time, DT)


def rows(field, n: int) -> np.ndarray:
    return field.to_numpy()[:n]


@pytest.mark.gpu_path
def test_frames_and_pairs(begun):
    """Also after friction and restitution of a pair change."""
    made, n = begun
    p, names = made.contact.problem, [c.name for c in made.scene.colliders]
    normal, t1, body = rows(p.normal, n), rows(p.tangent, n), rows(p.body, n)
    pairs = {tuple(names[k] for k in row) for row in body}
    assert pairs == {("block", "brick"), ("block", "table"), ("other", "lift")} and n >= 12
    for a, b in ((normal, t1), (t1, np.cross(normal, t1))):
        assert np.abs(np.linalg.norm(a, axis=1) - 1).max() < 1e-14 and np.abs((a * b).sum(axis=1)).max() < 1e-14
    assert np.array_equal(rows(p.sweep.order, n), np.arange(n))
    before = made.scene.contact_numbers("block", "table")
    for numbers in (before, (0.05, 0.9)):
        made.scene.set_contact("table", "block", *numbers)
        made.contact.numbers_changed()
        made.contact.begin(made.state.time, DT)
        expected = np.array([made.scene.contact_numbers(names[a], names[b]) for a, b in body])
        assert len(set(expected[:, 0])) == 3 and (expected[(body == [0, 3]).all(axis=1)] == numbers).all()
        assert np.allclose(np.stack([rows(p.friction, n), rows(p.restitution, n)], axis=1), expected, rtol=1e-15)
    made.scene.set_contact("block", "table", *before)
    made.contact.numbers_changed()


def test_nodes_and_weights(begun):
    """The weighted nodes of each side give the two surface points of a contact."""
    made, n = begun
    p, x, n_bodies = made.contact.problem, made.state.state()[0], len(made.scene.bodies)
    (contact, node, weight), body = read_entries(p), rows(p.body, n)
    assert (weight != 0).all() and set(contact) == set(range(n)) and len(set(zip(contact, node))) == len(node)
    owner = np.repeat(np.arange(n_bodies), [b.n_nodes for b in made.scene.bodies])[node]
    half = 0.5 * rows(p.gap, n)[:, None] * rows(p.normal, n)
    for side, sign in ((0, 1.0), (1, -1.0)):
        mine, soft = sign * weight > 0, body[:, side] < n_bodies
        assert (owner == body[contact, side])[mine].all() and soft[contact[mine]].all()
        points = np.zeros((n, 4))  # and the sum of weights
        np.add.at(points, contact[mine], np.abs(weight[mine])[:, None] * np.column_stack([x, np.ones(len(x))])[node[mine]])
        assert np.abs(points[soft, 3] - 1).max() < 1e-12
        assert np.abs(points[:, :3] - (rows(p.point, n) + sign * half))[soft].max() < 1e-9


def test_obstacle_displacement_and_approach(begun):
    """Displacement of the obstacle's contact point over the next step."""
    made, n = begun
    p, t = made.contact.problem, made.state.time
    point = rows(p.point, n) - 0.5 * rows(p.gap, n)[:, None] * rows(p.normal, n)
    expected = np.zeros((n, 3))
    for k, obstacle in enumerate(made.scene.obstacles):
        on = rows(p.body, n)[:, 1] == len(made.scene.bodies) + k
        shift, turn = obstacle.pose(t)
        material = (point[on] - obstacle.shape.pivot - shift) @ turn + obstacle.shape.pivot
        expected[on] = obstacle.points_at(t + DT, material) - point[on]
        assert on.sum() >= 2 and np.abs(expected[on]).max() > 1e-4
    assert np.abs(rows(p.obstacle_displacement, n) - expected).max() < 1e-12
    v = made.state.state()[1]
    (contact, node, weight), relative = read_entries(p), np.zeros((n, 3))
    np.add.at(relative, contact, weight[:, None] * v[node])
    approach = ((relative - expected / DT) * rows(p.normal, n)).sum(axis=1)
    assert np.abs(rows(p.approach, n) - approach).max() < 1e-9 and np.abs(approach).max() > 0.1


def test_warm_start(begun):
    """Half the step, half the impulses, of which there are one or two for each feature; none after the state was set."""
    made, n = begun
    p, rng = made.contact.problem, np.random.default_rng(0)
    order, names = rng.permutation(2 * n)[: 2 * n - 3], ("feature", "normal", "tangent", "point", "r")
    feature, normal, t1, point, r = (np.concatenate([rows(getattr(p, name), n)] * 2)[order] for name in names)
    point, r = point + 0.01 * rng.standard_normal(point.shape), rng.standard_normal(r.shape)
    for name, values in zip(names, (feature, normal, t1, point, r)):
        fill_field(getattr(p, name), values)
    p.count[0] = len(order)
    world = r[:, :1] * normal + r[:, 1:2] * t1 + r[:, 2:] * np.cross(normal, t1)
    n, met = made.contact.begin(made.state.time, 0.5 * DT), 0
    frame = np.stack([rows(p.normal, n), rows(p.tangent, n), np.cross(rows(p.normal, n), rows(p.tangent, n))], axis=1)
    for c, (own, at) in enumerate(zip(rows(p.feature, n), rows(p.point, n))):
        same = np.flatnonzero((feature == own).all(axis=1))
        z = 0.5 * frame[c] @ world[same[np.argmin(np.linalg.norm(point[same] - at, axis=1))]] if len(same) else np.zeros(3)
        expected = oracle.project(z, rows(p.friction, n)[c])
        assert np.abs(rows(p.r, n)[c] - expected).max() < 1e-12
        met += len(same) > 1 and expected[0] > 0.0
    assert met >= 3
    set_state(made)
    assert len(made.contact.contacts()) == 0
    n = made.contact.begin(made.state.time, DT)
    assert n and not rows(p.r, n).any()


@kernel
def find_gaps_minus_targets(f: ti.template(), n: ti.types.ndarray(), out: ti.types.ndarray()):
    """n: step, contact offset, fast, slow and fastest opening, velocity change by the forces of an explicit step, and the
    fraction of it before the impact."""
    for c in range(f.count[0]):
        opening = explicit_opening(f, c, n[0], n[1], f.approach[c] + n[5], n[6])
        out[c] = gap_minus_target(f, c, n[0], n[1], n[2], n[3], n[4], opening, ti.cast(0.1, ti.f64))


@pytest.mark.gpu_path
@pytest.mark.parametrize("fast, slow", [(1.0, 0.02), (0.05, 0.005)])
def test_gap_minus_target(fast, slow):
    h, dt, fastest, arena = 2e-3, 0.01, 2.0, FieldArena()
    cases = [  # gap, restitution, approach, gap - target
        (5 * h, 0.0, -9.0, 4 * h),  # may close down to the contact offset
        (h, 0.0, -9.0, 0.0),
        (0.25 * h, 0.0, -9.0, -slow * 0.75 * h),  # opens slowly
        (0.0, 0.0, -9.0, -0.1 * h),  # to a tenth of the offset at once
        (0.04 * h, 0.0, -9.0, -max(0.06 * h, slow * 0.96 * h)),
        (-4 * h, 0.0, 0.0, -4 * h * fast - slow * h),  # a penetration opens faster
        (5 * h, 0.5, -1.0, -0.5 * 1.0 * dt),  # meets within the step: rebounds at half the speed
        (5 * h, 0.5, -0.7, 4 * h),  # does not meet
        (5 * h, 0.5, 1.0, 4 * h),  # separates
        (h, 1.0, -3.0, -3.0 * dt),
        (-4 * h, 0.5, -1e-3, -4 * h * fast - slow * h),  # correcting the penetration opens faster than the rebound
        (-4 * h, 0.5, -90.0, -45.0 * dt),
        (-3.0 * fastest * dt / fast, 0.0, 0.0, -fastest * dt),  # maximum opening speed
        (0.25 * h, 0.0, 0.0, 0.0),  # nothing presses them together
        (-0.5 * h, 0.0, 1.0, 0.0),
    ]
    gap, restitution, approach, expected = np.array(cases).T
    problem, n = build_node_problem(arena, 64, 4, True, 64), len(cases)
    for field, values in ((problem.gap, gap), (problem.restitution, restitution), (problem.approach, approach)):
        fill_field(field, values)
    problem.count[0] = n

    def found(h=h, fast=fast, slow=slow, force=0.0, before=0.0, body=(0, 1)) -> np.ndarray:
        out = np.zeros(n)
        fill_field(problem.body, np.tile(body, (n, 1)))
        find_gaps_minus_targets(problem, np.array([dt, h, fast, slow, fastest, force, before]), out)
        return out

    assert np.abs(found() - expected).max() < 1e-15
    fill_field(problem.load, np.full(n, 1e-3 * h / dt))
    assert np.abs(found()[-2:] + 1e-4 * h).max() < 1e-15  # no faster than a tenth of what the load gives
    fill_field(problem.load, np.zeros(n))
    # forces push together: the speed that they add is not restored; the eighth contact meets now
    less = np.where((restitution > 0) & (expected == -dt * restitution * np.abs(approach)), 0.2 * dt, 0.0)
    later = np.arange(n) == 7
    assert np.abs(found(force=-0.2) - np.where(later, -(0.35 - 0.2) * dt, expected + less)).max() < 1e-15
    assert (less > 0).sum() == 3
    # half of it acts before the impact, and rebounds too
    back = np.where(less > 0, (0.1 - 0.1 * restitution) * dt, 0.0)
    assert np.abs(found(force=-0.2, before=0.5) - np.where(later, -(0.4 - 0.1) * dt, expected + back)).max() < 1e-15
    # self-contact scales the numbers
    factor = (gap - found(1e-3 * h, body=(1, 1)))[0] / (1e-3 * h)
    assert factor > 1.5
    assert np.abs(found(h / factor, fast / factor, slow / factor, body=(1, 1)) - expected).max() < 1e-13
    arena.release()


def test_rebounds_of_implicit_steps():
    """w^2 = e^2 (u^2 + L + 2 a d) - 2 a d where surfaces meet within the step; bodies 0 and 1 have flown for 3 and 0 steps."""
    h, dt, g, arena = 2e-3, 0.01, np.array([1.0, -9.0, 2.0]), FieldArena()
    cases = [  # gap, restitution, approach, body a, body b, acceleration that closes the gap
        (6 * h, 0.5, -2.0, 0, 1, 9.0),
        (6 * h, 1.0, -2.0, 0, 1, 9.0),
        (3 * h, 0.5, -2.0, 1, 0, 0.0),  # the lower one has flown
        (0.5 * h, 0.5, -2.0, 0, 1, 9.0),  # within the contact offset
        (3 * h, 0.1, -0.4, 0, 1, 9.0),  # too slow to rise above the surface
        (20 * h, 0.5, -2.0, 0, 1, 9.0),  # does not meet
        (6 * h, 0.0, -2.0, 0, 1, 9.0),
        (h, 0.5, 2.0, 0, 1, 9.0),  # separates
    ]
    gap, e, u, a, b, closing = np.array(cases).T
    problem, gravity, n = build_node_problem(arena, 64, 4, True, 64), arena.vectors("gravity", ti.f64, 1, g[None]), len(cases)
    normals = np.tile([0.0, 1.0, 0.0], (n, 1))
    bodies = np.stack([a, b], axis=1).astype(np.int32)
    for field, values in ((problem.gap, gap), (problem.restitution, e), (problem.approach, u), (problem.normal, normals)):
        fill_field(field, values)
    fill_field(problem.body, bodies)
    problem.count[0] = n
    flight = arena.field("flight", ti.f64, 2, np.array([3.0 * dt**2, 0.0]))
    count = find_rebounds(problem, gravity, flight, dt, h)
    d = np.maximum(0.0, gap - h)
    speed = np.minimum(dt * closing - u, np.sqrt(u**2 + 3.0 * dt**2 * closing**2))
    w = np.sqrt(np.maximum(0.0, e**2 * (speed**2 + 2 * closing * d) - 2 * closing * d))
    rebounds = np.arange(n) < 4
    assert count == 4 and (dt * (w - dt * 9.0) > 0.01 * h)[rebounds].all()
    expected = np.where(rebounds, w, -np.maximum(d / dt, u))
    assert rows(problem.min_velocity, n) == pytest.approx(expected, rel=1e-12)
    assert rows(problem.min_opening, n) == pytest.approx(np.where(rebounds, dt * (w - dt * 9.0), 0.0), rel=1e-12)
    arena.release()
