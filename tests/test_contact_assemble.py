"""From found contacts to the contact problem, judged by NumPy:

* nodes, signed weights, normals, right-handed frames, friction and restitution of each pair, the latter also when they change;
* the way of an obstacle at a contact: of a mesh, and of a body that turns; the speed of approach;
* how far a contact is from its goal: far, within the contact offset, penetrating, thrown back;
* impulses of the step before come back where two features meet again, in the world, in proportion to the step, once.
"""

import numpy as np
import pytest
import taichi as ti
from rotations import rotation

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel, open_runtime
from taisoft.contact.build import SELF_CONTACT, _warm_impulse, gap_minus_target, keep_impulses
from taisoft.contact.problem import build_node_problem, fill_field
from taisoft.contact.restitution import explicit_opening

DT = 1e-3  # [s]
SPIN = np.array([0.3, 2.0, -0.4])  # [rad/s]


def turning(t: float):
    """A path that turns and shifts."""
    return np.array([0.5 * t, 0.0, 0.2 * t]), rotation(SPIN, np.linalg.norm(SPIN) * t)


def rising(t: float):
    """A path that shifts and turns a little."""
    return np.array([0.1 * t, 1.5 * t, 0.0]), rotation((1, 0, 0), 0.3 * t)


def scene() -> ts.Scene:
    """A block on a turning box, a brick on the block, another brick on a rising mesh."""
    made = ts.Scene()
    soft = {"young": 1e5, "density": 1000.0}
    made.add_body(
        ts.box_mesh((2, 1, 2), (1.0, 0.5, 1.0)),
        ts.Material(friction=0.4, restitution=0.2, **soft),
        name="block",
        position=(0, 0.2502, 0),
        velocity=(0.2, -0.3, 0.1),
    )
    brick = ts.Material(friction=0.9, restitution=0.1, **soft)
    mesh = ts.box_mesh((1, 1, 1), (0.3, 0.2, 0.35))
    made.add_body(mesh, brick, name="brick", position=(0.13, 0.6004, 0.08), velocity=(0, -1, 0))
    made.add_body(mesh, brick, name="other", position=(4.0, 0.1002, 0.03))
    made.add_obstacle(ts.Box((0, -0.2, 0), (0.6, 0.2, 0.7)), name="table", friction=0.6, path=turning)
    corners = [(3, 0, -1), (3, 0, 1), (5, 0, 1), (5, 0, -1)]
    made.add_obstacle(ts.MeshObstacle(corners, [(0, 1, 2), (0, 2, 3)]), name="lift", friction=0.1, restitution=0.5, path=rising)
    made.set_contact("block", "brick", friction=0.25)
    return made


@pytest.fixture(scope="module")
def sim():
    with ts.Simulator(scene(), dt=DT, integrator="symplectic_euler", precision="f64") as made:
        yield made


@pytest.fixture
def begun(sim):
    """The simulator after a step, with the problem of the next one at hand, and its number of contacts."""
    sim.reset()
    sim.step()
    return sim, sim._dynamics.contact.begin(sim.time, DT)


def rows(field, n: int) -> np.ndarray:
    return field.to_numpy()[:n]


def test_frames_and_pairs(begun):
    sim, n = begun
    p, names = sim._dynamics.contact.problem, [c.name for c in sim.scene.colliders]
    normal, t1, body = rows(p.normal, n), rows(p.tangent, n), rows(p.body, n)
    pairs = {tuple(names[k] for k in row) for row in body}
    assert pairs == {("block", "brick"), ("block", "table"), ("other", "lift")} and n >= 12
    for a, b in ((normal, t1), (t1, np.cross(normal, t1))):
        assert np.abs(np.linalg.norm(a, axis=1) - 1).max() < 1e-14 and np.abs((a * b).sum(axis=1)).max() < 1e-14
    expected = np.array([sim.scene.contact_numbers(names[a], names[b]) for a, b in body])
    assert np.allclose(rows(p.friction, n), expected[:, 0], rtol=1e-15) and len(set(expected[:, 0])) == 3
    assert np.allclose(rows(p.restitution, n), expected[:, 1], rtol=1e-15) and len(set(expected[:, 1])) == 2
    assert np.array_equal(rows(p.order, n), np.arange(n))


def test_numbers_that_change(begun):
    sim, n = begun
    before = sim.scene.contact_numbers("block", "table")
    sim.set_contact("table", "block", friction=0.05, restitution=0.9)
    sim._dynamics.contact.begin(sim.time, DT)
    on = (rows(sim._dynamics.contact.problem.body, n) == [0, 3]).all(axis=1)
    friction, restitution = rows(sim._dynamics.contact.problem.friction, n), rows(sim._dynamics.contact.problem.restitution, n)
    assert (friction[on] == 0.05).all() and (restitution[on] == 0.9).all()
    assert 0 < on.sum() < n and (friction[~on] != 0.05).all()
    sim.set_contact("block", "table", *before)


def test_nodes_and_weights(begun):
    """Weighted nodes of a side, and what they are told to be: the two points of a contact."""
    sim, n = begun
    p, x = sim._dynamics.contact.problem, sim.positions()
    node, weight, arity = rows(p.node, n), rows(p.weight, n), rows(p.arity, n)
    used = np.arange(6) < arity[:, None]
    assert (weight[used] != 0).all() and arity.min() >= 1 and all(len(set(r[u])) == u.sum() for r, u in zip(node, used))
    start = np.cumsum([0] + [b.n_nodes for b in sim.scene.bodies])
    owner = np.searchsorted(start, node, side="right") - 1
    body, half = rows(p.body, n), 0.5 * rows(p.gap, n)[:, None] * rows(p.normal, n)
    for side, sign in ((0, 1.0), (1, -1.0)):
        mine = used & (sign * weight > 0)
        soft = body[:, side] < len(sim.scene.bodies)
        assert (owner[mine] == np.broadcast_to(body[:, side : side + 1], mine.shape)[mine]).all() and not mine[~soft].any()
        share = np.where(mine, np.abs(weight), 0.0)
        assert np.abs(share.sum(axis=1)[soft] - 1).max() < 1e-12
        points = np.einsum("kj,kjx->kx", share, x[np.where(mine, node, 0)])
        assert np.abs(points - (rows(p.point, n) + sign * half))[soft].max() < 1e-9


def test_ways_of_obstacles(begun):
    """Where the obstacle's point of a contact is a step later."""
    sim, n = begun
    p, t = sim._dynamics.contact.problem, sim.time
    point = rows(p.point, n) - 0.5 * rows(p.gap, n)[:, None] * rows(p.normal, n)
    expected = np.zeros((n, 3))
    for k, obstacle in enumerate(sim.scene.obstacles):
        on = rows(p.body, n)[:, 1] == len(sim.scene.bodies) + k
        shift, turn = obstacle.pose(t)
        material = (point[on] - obstacle.shape.pivot - shift) @ turn + obstacle.shape.pivot
        expected[on] = obstacle.points_at(t + DT, material) - point[on]
        assert on.sum() >= 2 and np.abs(expected[on]).max() > 1e-4
    assert np.abs(rows(p.obstacle_displacement, n) - expected).max() < 1e-12
    v = sim.velocities()
    relative = np.einsum("kj,kjx->kx", rows(p.weight, n) * (np.arange(6) < rows(p.arity, n)[:, None]), v[rows(p.node, n)])
    approach = ((relative - expected / DT) * rows(p.normal, n)).sum(axis=1)
    assert np.abs(rows(p.approach, n) - approach).max() < 1e-9 and np.abs(approach).max() > 0.1


def test_warm_start(begun):
    """Halved with the step; nothing is left after another state was set."""
    sim, _ = begun
    sim.reset()
    sim.step()
    before, dt = sim.contacts(), 0.5 * DT
    assert (np.linalg.norm(before.impulse, axis=1) > 0).sum() >= 8
    n = sim._dynamics.contact.begin(sim.time, dt)
    p = sim._dynamics.contact.problem
    key = {(a, b, tuple(ids)): k for k, (a, b, ids) in enumerate(zip(before.body_a, before.body_b, before.feature.tolist()))}
    names, feature, r = [c.name for c in sim.scene.colliders], rows(p.feature, n), rows(p.r, n)
    frame = np.stack([rows(p.normal, n), rows(p.tangent, n), np.cross(rows(p.normal, n), rows(p.tangent, n))], axis=1)
    met = 0
    for c, (a, b) in enumerate(rows(p.body, n)):
        k = key.get((names[a], names[b], tuple(feature[c, 1:])))
        z = np.zeros(3) if k is None else 0.5 * frame[c] @ before.impulse[k]
        wanted = np.array([max(z[0], 0), *z[1:]])
        slide, hold = np.linalg.norm(wanted[1:]), rows(p.friction, n)[c] * wanted[0]
        wanted[1:] *= min(1.0, hold / slide) if slide > 0 else 1.0
        assert np.abs(r[c] - wanted).max() < 1e-12 * np.abs(before.impulse).max()
        met += k is not None and bool(z.any())
    assert met >= 8
    sim.set_state(velocities=sim.velocities())
    assert len(sim.contacts()) == 0
    n = sim._dynamics.contact.begin(sim.time, DT)
    assert n and not rows(sim._dynamics.contact.problem.r, n).any()


# --- goal and warm start on made up numbers ---------------------------------------------------------------------------


@kernel
def find_goals(
    f: ti.template(),
    dt: ti.f64,
    contact_offset: ti.f64,
    fast: ti.f64,
    slow: ti.f64,
    fastest: ti.f64,
    force: ti.f64,
    kicked: ti.f64,
    out: ti.types.ndarray(),
):
    """force: what the explicit step's forces change the velocity by [m/s], a share `kicked` of it before the impact."""
    for c in range(f.count[0]):
        opening = explicit_opening(f, c, dt, contact_offset, f.approach[c] + force, kicked)
        out[c] = gap_minus_target(f, c, dt, contact_offset, fast, slow, fastest, opening)


@kernel
def find_warm(f: ti.template(), out: ti.types.ndarray()):
    for c in range(f.count[0]):
        r = _warm_impulse(f, c)
        for k in ti.static(range(3)):
            out[c, k] = r[k]


@pytest.fixture(scope="module")
def found():
    machine, arena = open_runtime("cpu", "f64", "a test"), FieldArena()
    yield build_node_problem(arena, 64, 4, True)
    arena.release()
    machine.close()


@pytest.mark.parametrize("fast, slow", [(1.0, 0.02), (0.05, 0.005)])
def test_how_far_a_contact_is_from_its_goal(found, fast, slow):
    h, dt, fastest = 2e-3, 0.01, 2.0
    cases = [  # gap, restitution, approach, gap - goal
        (5 * h, 0.0, -9.0, 4 * h),  # may close down to the contact offset
        (h, 0.0, -9.0, 0.0),
        (0.25 * h, 0.0, -9.0, -slow * 0.75 * h),  # opens slowly
        (0.0, 0.0, -9.0, -slow * h),
        (-4 * h, 0.0, 0.0, -4 * h * fast - slow * h),  # a penetration opens faster
        (5 * h, 0.5, -1.0, -0.5 * 1.0 * dt),  # meets within the step: thrown back with half of its speed
        (5 * h, 0.5, -0.7, 4 * h),  # does not meet
        (5 * h, 0.5, 1.0, 4 * h),  # parts
        (h, 1.0, -3.0, -3.0 * dt),
        (-4 * h, 0.5, -1e-3, -4 * h * fast - slow * h),  # the penetration asks for more than the bounce
        (-4 * h, 0.5, -90.0, -45.0 * dt),
        (-3.0 * fastest * dt / fast, 0.0, 0.0, -fastest * dt),  # no faster than that
    ]
    gap, restitution, approach, expected = np.array(cases).T
    for field, values in ((found.gap, gap), (found.restitution, restitution), (found.approach, approach)):
        fill_field(field, values)
    found.count[0] = len(cases)
    out = np.zeros(len(cases))
    fill_field(found.body, np.tile([0, 1], (len(cases), 1)))
    find_goals(found, dt, h, fast, slow, fastest, 0.0, 0.0, out)
    assert np.abs(out - expected).max() < 1e-15
    find_goals(found, dt, h, fast, slow, fastest, -0.2, 0.0, out)  # pressed on: what the forces take is not given back
    less = np.where((restitution > 0) & (expected == -dt * restitution * np.abs(approach)), 0.2 * dt, 0.0)
    later = np.array([k == 6 for k in range(len(cases))])  # these forces make it meet
    assert np.abs(out - np.where(later, -(0.35 - 0.2) * dt, expected + less)).max() < 1e-15 and (less > 0).sum() == 3
    find_goals(found, dt, h, fast, slow, fastest, -0.2, 0.5, out)  # half of it comes before the impact, and is thrown back, too
    back = np.where(less > 0, (0.1 - 0.1 * restitution) * dt, 0.0)
    assert np.abs(out - np.where(later, -(0.4 - 0.1) * dt, expected + back)).max() < 1e-15
    fill_field(found.body, np.ones((len(cases), 2), dtype=int))  # of a body with itself: the same with other numbers
    find_goals(found, dt, h / SELF_CONTACT, fast / SELF_CONTACT, slow / SELF_CONTACT, fastest, 0.0, 0.0, out)
    assert np.abs(out - expected).max() < 1e-15


def test_the_nearest_contact_of_the_same_feature(found):
    """Some features more than once, all of them in a table that is half full."""
    rng, n, p = np.random.default_rng(0), 60, found
    feature = np.stack([rng.integers(0, 2, n), rng.integers(0, 6, n), rng.integers(0, 3, n)], axis=1)
    point, impulse = rng.standard_normal((n, 3)), rng.standard_normal((n, 3))
    normal = rng.standard_normal((n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    t1 = np.cross(normal, rng.standard_normal((n, 3)))
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    for field, values in ((found.feature, feature), (found.point, point), (p.normal, normal), (p.tangent, t1), (p.r, impulse)):
        fill_field(field, values)
    p.count[0] = n
    keep_impulses(found)
    simulation = impulse[:, :1] * normal + impulse[:, 1:2] * t1 + impulse[:, 2:] * np.cross(normal, t1)
    asked = np.stack([rng.integers(0, 2, n), rng.integers(0, 7, n), rng.integers(0, 3, n)], axis=1)
    at = rng.standard_normal((n, 3))
    fill_field(found.feature, asked)
    fill_field(found.point, at)
    out = np.zeros((n, 3))
    find_warm(found, out)
    several = 0
    for c in range(n):
        same = np.flatnonzero((feature == asked[c]).all(axis=1))
        several += len(same) > 1
        wanted = simulation[same[np.argmin(np.linalg.norm(point[same] - at[c], axis=1))]] if len(same) else np.zeros(3)
        assert np.abs(out[c] - wanted).max() < 1e-14
    assert several > 10 and (~out.any(axis=1)).sum() > 3
