"""Steps with contacts, by every integrator that takes them; one simulator serves all implicit ones:

* a cube comes to rest on a plane: the belt bears its weight, the gap is what contacts keep; a shelf's nodes bear its load too;
* a belt carries it to its own speed, along a line and round; friction that changes while it runs lets it slide, as Coulomb says;
* a stiff cube is thrown back with its restitution's share of the speed at which it came;
* two bodies that meet keep their momentum, and their angular momentum but for what friction across a gap adds;
* impulses and velocities of a step obey Signorini's and Coulomb's laws, recomputed from what a simulator shows;
* two runs are the same to the last bit; turning, shifting the scene and the order of its bodies leave the motion as it is;
* all solvers of explicit steps find the same motion.
"""

import contact_oracle as oracle
import numpy as np
import pytest
from contact_scenes import FRICTION, GRAVITY, MASS, Stage, scene, sliding, still, turning
from rotations import rotation
from scenes import rows_of

import taisoft as ts
from taisoft.dynamics.schemes import SCHEMES
from taisoft.settings import EXPLICIT_CONTACT

DT = {"bdf2": 0.01, "symplectic_euler": 1e-3, "velocity_verlet": 1e-3}  # [s]; one for all implicit schemes
IMPLICIT = ("implicit_euler", "linearly_implicit_euler", "bdf2")
G = -GRAVITY[1]


class OnStage(ts.Simulator):
    place: Stage | None = None


def opened(integrator: str, place: Stage) -> OnStage:
    tight = {"newton_tolerance": 1e-10} if integrator == "bdf2" else {}
    settings = {"precision": "f64", "contact_tolerance": 1e-8, **tight}
    return OnStage(scene(place), dt=DT[integrator], integrator=integrator, **settings)


@pytest.fixture(scope="module", params=DT)
def shared_sim(request):
    place = Stage()
    with opened(request.param, place) as sim:
        sim.place = place
        yield sim


@pytest.fixture
def sim(shared_sim, monkeypatch):
    """The simulator at its start, the belt at rest."""
    place = shared_sim.place
    place.Q, place.T, place.motion = np.eye(3), np.zeros(3), still
    shared_sim.set_gravity(GRAVITY)
    if not shared_sim.settings.explicit:
        monkeypatch.setattr(shared_sim._dynamics.stepper, "scheme", SCHEMES["implicit_euler"])
    shared_sim.reset()
    return shared_sim


@pytest.fixture(params=IMPLICIT)
def each(sim, request, monkeypatch):
    """The simulator with one of the implicit schemes; explicit ones once."""
    if sim.settings.explicit:
        if request.param != IMPLICIT[0]:
            pytest.skip("an explicit integrator is what it is")
    else:
        monkeypatch.setattr(sim._dynamics.stepper, "scheme", SCHEMES[request.param])
    return sim


def go(sim, seconds: float) -> None:
    """Run; every step must converge, and nothing may penetrate."""
    end = round(seconds / sim.dt) + sim.step_count
    while sim.step_count < end:
        report = sim.advance(end - sim.step_count)
        assert report.converged and report.problems == [], report
        assert report.max_penetration < sim._dynamics.contact.contact_offset


@pytest.fixture
def damped(each):
    """Bodies that rest soon."""
    for name in ("cube", "shelf", "load"):
        each.set_material(name, mass_damping=60.0)
    yield each
    for name in ("cube", "shelf", "load"):
        each.set_material(name, mass_damping=4.0)


def test_rest(damped):
    """What bears a weight, and the drag: with Verlet nodes that touch keep the velocity of half a step's push.

    Means over a while, since explicit steps push a little more and a little less.
    """
    sim, mass = damped, damped._dynamics.state.model.mass.to_numpy()[:, None]
    go(sim, 0.3)
    held = np.isin(np.arange(len(mass)), np.r_[rows_of(sim, "shelf"), rows_of(sim, "load")])
    missing, gaps = {"cube": [], "load": [], "reactions": []}, []
    for _ in range(20 if sim.settings.explicit else 2):
        drag = -60.0 * mass * sim.velocities()
        sim.step()
        for name in ("cube", "load"):
            rows = rows_of(sim, name)
            missing[name].append(sim.contact_force(name) + drag[rows].sum(axis=0) + MASS * GRAVITY)
        missing["reactions"].append((sim.reactions().sum(axis=0) + drag[held].sum(axis=0)) / 10 + MASS * GRAVITY)
        assert np.abs(sim.contact_force("cube") + sim.contact_force("belt")).max() < 1e-9
        gaps.append(sim.positions("cube")[:, 1].min())
    for name, forces in missing.items():
        assert np.abs(np.mean(forces, axis=0)).max() < (0.01 if sim.settings.explicit else 2e-3) * MASS * G, name
    assert 0 < min(gaps) and max(gaps) < 0.01 * 0.05  # of the smallest edge
    assert np.abs(sim.velocities("cube")).max() < 0.05


def test_belt(each):
    each.place.motion = sliding(0.3)
    go(each, 0.25)
    assert np.abs(each.velocities("cube").mean(axis=0) - (0.3, 0, 0))[[0, 2]].max() < 0.04 * 0.3  # it bobs a little
    # where it got to: friction sped it up at friction * g, against a drag of 4 / s
    lost = 0.3**2 / (2 * FRICTION * G)
    assert each.positions("cube")[:, 0].mean() - 0.1 == pytest.approx(0.25 * 0.3 - lost, rel=0.05)


def test_turntable(each):
    each.place.motion = turning(2.0)
    go(each, 0.4)
    x = each.positions("cube").mean(axis=0)
    v = each.velocities("cube").mean(axis=0)
    assert np.abs(v - np.cross((0, 2.0, 0), x))[[0, 2]].max() < 0.05 * 0.2
    assert np.hypot(x[0], x[2]) == pytest.approx(0.1, rel=0.04)
    assert np.arctan2(-x[2], x[0]) == pytest.approx(2.0 * 0.4 - 0.04, abs=0.03)


def test_friction_that_changes(each):
    each.set_gravity((3.0, *GRAVITY[1:]))
    go(each, 0.2)
    start = each.velocities("cube").mean(axis=0)
    assert np.abs(start[0]) < 0.02
    if not each.settings.explicit:  # there the cube still trembles
        assert each.contact_force("cube")[0] == pytest.approx(-3.0 * MASS, rel=0.1)
    each.set_contact("belt", "cube", friction=0.1)
    try:
        go(each, 0.2)
        assert (each.contacts().friction == np.where(each.contacts().body_a == "cube", 0.1, FRICTION)).all()
    finally:
        each.set_contact("cube", "belt", friction=FRICTION)
    speed = (3.0 - 0.1 * G) / 4.0 * (1 - np.exp(-4.0 * 0.2))
    assert each.velocities("cube").mean(axis=0)[0] - start[0] == pytest.approx(speed, rel=0.03)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_restitution(sim, restitution):
    """Of a cube so stiff that it moves as a whole; 2 m/s, in implicit steps of 1 ms."""
    if sim.settings.explicit:
        return  # they would need far shorter steps
    sim.set_material("cube", young=1e9, mass_damping=0.0)
    sim.set_contact("cube", "belt", restitution=restitution)
    try:
        sim.dt = 1e-3
        sim.set_gravity((0, 0, 0))
        x = sim.positions("cube")
        sim.set_state(x + (0, 0.01, 0), np.tile([0.0, -2.0, 0.0], (len(x), 1)), body="cube")
        for _ in range(15):
            assert sim.step().converged
        v = sim.velocities("cube")
        assert v[:, 1].mean() == pytest.approx(2.0 * restitution, abs=0.02) and np.abs(v[:, [0, 2]]).max() < 1e-3
        assert sim.positions("cube")[:, 1].min() > 0
    finally:
        sim.dt = DT["bdf2"]
        sim.set_contact("cube", "belt", restitution=0.0)
        sim.set_material("cube", young=1e5, mass_damping=4.0)


def momenta(sim) -> tuple[np.ndarray, np.ndarray]:
    """Of the two that fly, (3,) each, the angular one about the origin."""
    own = slice(rows_of(sim, "left").start, rows_of(sim, "right").stop)
    p = sim._dynamics.state.model.mass.to_numpy()[own, None] * sim.velocities()[own]
    return p.sum(axis=0), np.cross(sim.positions()[own], p).sum(axis=0)


def test_momentum(each):
    each.set_gravity((0, 0, 0))
    (linear, angular), added, met = momenta(each), np.zeros(3), 0
    for _ in range(40 if each.settings.explicit else 6):
        assert each.step().converged
        c = each.contacts()
        on = np.isin(c.body_a.astype(str), ("left", "right"))
        added += (c.gap[on, None] * np.cross(c.normal[on], c.impulse[on])).sum(axis=0)
        met += bool((c.impulse[on] != 0).any())
    assert met >= 2 and each.velocities("left")[:, 0].mean() < 0.3  # of 1 m/s
    now, angular_now = momenta(each)
    if each.settings.explicit:
        assert np.abs(now - linear).max() < 1e-12 and np.abs(angular_now - angular - added).max() < 1e-12
        assert np.abs(added).max() > 1e-6
    else:
        assert np.abs(now - linear).max() < 1e-8


def test_laws(each):
    """Of a belt that drags a block, and of a meeting; the goal of a gap as the text of the package says."""
    contact, speed = each._dynamics.contact, 0.3
    each.place.motion = sliding(speed)
    states = np.zeros(3, dtype=int)
    for k in range(40 if each.settings.explicit else 8):
        x, v = each.positions(), each.velocities()
        each.step()
        c, moved = each.contacts(), each.positions() - x
        on, bdf2 = c.nodes >= 0, not each.settings.explicit and each._dynamics.stepper.scheme.before > 0
        signed = np.where(on, c.weights, 0.0) * [1, 1, 1, -1, -1, -1]
        obstacle_displacement_at = np.where((c.body_b == "belt")[:, None], [speed * each.dt, 0, 0], 0.0)
        way = np.einsum("kj,kjx->kx", signed, moved[c.nodes]) - obstacle_displacement_at
        v = each.velocities() if bdf2 else moved / each.dt
        slip = np.einsum("kj,kjx->kx", signed, v[c.nodes]) - obstacle_displacement_at / each.dt
        above = np.maximum(c.gap, 0.0)
        contact_offset, fast, slow, fastest = contact.gap_targets
        opening = np.minimum(slow * (contact_offset - above) + fast * (above - c.gap), fastest * each.dt)
        gap_targets = np.where(c.gap < contact_offset, c.gap + opening, contact_offset)
        u_n = (c.gap - gap_targets + (c.normal * way).sum(axis=1)) / (contact._impulse_fraction * each.dt)
        t1 = np.cross(c.normal, np.eye(3)[np.argmin(np.abs(c.normal), axis=1)])
        t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
        frame = np.stack([c.normal, t1, np.cross(c.normal, t1)], axis=1)
        r, u = np.einsum("kij,kj->ki", frame, c.impulse), np.einsum("kij,kj->ki", frame, slip)
        u[:, 0] = u_n
        held = r[:, 0] > 1e-6 * r[:, 0].max()
        slides = held & (np.linalg.norm(u[:, 1:], axis=1) > 1e-4)
        states += [(~held).sum(), (held & ~slides).sum(), slides.sum()]
        broken = oracle.breaks(np.zeros((u.size, u.size)), u.ravel(), c.friction, r)
        assert max(broken.values()) < 1e-5, (k, broken)
    assert states.min() > 10, states


def state(sim) -> tuple[np.ndarray, ...]:
    return sim.positions(), sim.velocities(), sim.reactions(), sim.contacts().impulse


def walk(sim) -> tuple[np.ndarray, ...]:
    """A belt that drags, two that meet."""
    for _ in range(30 if sim.settings.explicit else 6):
        sim.step()
    return state(sim)


def test_two_runs_are_the_same(each):
    each.place.motion = sliding(0.3)
    first = walk(each)
    each.reset()
    assert all(np.array_equal(a, b) for a, b in zip(first, walk(each))) and np.abs(first[3]).max() > 1e-3


def test_turned_and_shifted(sim):
    place, close = sim.place, 1e-9 if sim.settings.explicit else 1e-6
    place.motion = sliding(0.3)
    start, speed = sim.positions(), sim.velocities()
    x, v, *_ = walk(sim)
    place.Q, place.T = rotation((1, -2, 0.5), 2.0), np.array([3.0, -1.0, 2.0])
    sim.set_gravity(place.Q @ GRAVITY)
    sim.reset()
    sim.set_state(start @ place.Q.T + place.T, speed @ place.Q.T)
    turned, turned_v, *_ = walk(sim)
    assert np.abs(turned - (x @ place.Q.T + place.T)).max() < 0.1 * close
    assert np.abs(turned_v - v @ place.Q.T).max() < 10 * close


def test_order_of_bodies(sim):
    if sim.settings.integrator != "symplectic_euler":
        pytest.skip("what the order could change, sweeps over contacts, is in symplectic Euler's steps, too")
    sim.place.motion, twins, rest = sliding(0.3), ("cube", "load"), ("shelf", "left", "right")  # twins lie beside the shelf
    start = [sim.positions(name) for name in twins]
    walk(sim)
    ends = [(sim.positions(name), sim.velocities(name)) for name in (*twins, *rest)]
    sim.reset()
    for name, x in zip(twins, start[::-1]):
        sim.set_state(positions=x, body=name)
    walk(sim)
    for name, (x, v) in zip((*twins[::-1], *rest), ends):
        assert np.abs(sim.positions(name) - x).max() < 1e-9 and np.abs(sim.velocities(name) - v).max() < 1e-7


def test_all_solvers_of_explicit_steps(sim, monkeypatch):
    if not sim.settings.explicit:
        return
    sim.place.motion = sliding(0.3)
    found = {}
    for method in EXPLICIT_CONTACT:
        monkeypatch.setattr(sim._dynamics.stepper, "method", method)
        sim.reset()
        report = sim.advance(30)
        assert report.steps == 30 and report.converged
        found[method] = sim.velocities()
    for method in EXPLICIT_CONTACT[1:]:
        assert np.abs(found[method] - found["gauss_seidel"]).max() < 1e-6
