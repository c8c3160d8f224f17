"""Steps with contacts, by every integrator that supports them:

* a cube comes to rest on a belt, which bears its weight across the contact offset; a fixed shelf bears its load;
* a moving belt carries the cube to its own speed, in translation and rotation; with less friction the cube slides as by Coulomb;
* contact forces and weight are the rate of momentum; two colliding bodies conserve momentum, and angular momentum but for
  friction acting across a gap;
* impulses and velocities of a step obey Signorini's and Coulomb's laws, recomputed from public queries;
* the forces of pairs add up to those of bodies;
* two runs agree to the last bit; rotation and translation do not change the motion.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.reference import lumped_masses
from taisoft.mesh.quality import mean_surface_edge
from tests.collision.rotations import rotation
from tests.contact import contact_oracle as oracle
from tests.dynamics.contact_scenes import FRICTION, GRAVITY, MASS, SIDE, Stage, scene, sliding, still, turning
from tests.dynamics.scenes import rows_of

IMPLICIT = ("implicit_euler", "linearly_implicit_euler", "bdf2")
DT = dict.fromkeys(EXPLICIT, 1e-3) | dict.fromkeys(IMPLICIT, 0.01)  # [s]
G = -GRAVITY[1]
# fractions of a penetration and of a missing contact offset that an explicit (True) or implicit step corrects
CORRECTIONS = {True: (0.05, 0.005), False: (0.2, 0.02)}
OPENING_SPEED = 0.01 * np.sqrt(1e5 / 1000.0)  # [m/s] the fastest of both


class StageSimulator(ts.Simulator):
    place: Stage | None = None


def simulator(integrator: str, **settings) -> StageSimulator:
    """A simulator of the scene on its stage."""
    place = Stage()
    tight = {"newton_tolerance": 1e-10} if integrator in IMPLICIT else {}
    settings = {"precision": "f64", "contact_tolerance": 1e-8, **tight, **settings}
    sim = StageSimulator(scene(place), dt=DT[integrator], integrator=integrator, **settings)
    sim.place = place
    return sim


@pytest.fixture(scope="module", params=DT)
def shared_sim(request):
    with simulator(request.param) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    """The simulator at its start, the belt at rest."""
    place = shared_sim.place
    place.Q, place.T, place.motion = np.eye(3), np.zeros(3), still
    shared_sim.set_gravity(GRAVITY)
    shared_sim.dt = DT[shared_sim.settings.integrator]
    shared_sim.reset()
    return shared_sim


def by(*integrators: str):
    """Run a test with these integrators only."""
    return pytest.mark.parametrize("shared_sim", integrators, indirect=True)


def contact_offset(sim) -> float:
    """Gap that contacts keep [m], of the finest body."""
    nodes = sim.scene.body("cube").nodes
    return 2e-3 * mean_surface_edge([(nodes.positions, nodes.surface)])


def run(sim, seconds: float) -> None:
    """Run; every step must converge, and nothing may penetrate."""
    end = round(seconds / sim.dt) + sim.step_count
    while sim.step_count < end:
        report = sim.advance(end - sim.step_count)
        assert report.converged and report.problems == [], report
        assert report.max_penetration < contact_offset(sim)


@pytest.fixture
def damped(sim):
    """Bodies that come to rest soon."""
    for name in ("cube", "shelf", "load"):
        sim.set_material(name, mass_damping=60.0)
    yield sim
    for name in ("cube", "shelf", "load"):
        sim.set_material(name, mass_damping=4.0)


@by("symplectic_euler", "bdf2")
def test_contact_forces_balance_weight(damped):
    """Weight plus damping. Means over several steps, since the contact forces of explicit steps fluctuate."""
    sim, mass = damped, lumped_masses(damped.scene)[:, None]
    run(sim, 0.3)
    held = np.isin(np.arange(len(mass)), np.r_[rows_of(sim, "shelf"), rows_of(sim, "load")])
    missing, gaps = {"cube": [], "load": [], "reactions": []}, []
    shelf_mass = sim.scene.body("shelf").mass
    for _ in range(20 if sim.settings.explicit else 2):
        drag = -60.0 * mass * sim.velocities()
        sim.step()
        for name in ("cube", "load"):
            missing[name].append(sim.contact_force(name) + drag[rows_of(sim, name)].sum(axis=0) + MASS * GRAVITY)
        weights = (MASS + shelf_mass) * GRAVITY + drag[held].sum(axis=0)
        missing["reactions"].append(0.1 * (sim.reactions().sum(axis=0) + weights))
        assert np.abs(sim.contact_force("cube") + sim.contact_force("belt")).max() < 1e-9
        gaps.append(sim.positions("cube")[:, 1].min())
    for name, forces in missing.items():
        assert np.abs(np.mean(forces, axis=0)).max() < (0.01 if sim.settings.explicit else 2e-3) * MASS * G, name
    assert 0 < min(gaps) and max(gaps) < 0.01 * 0.05  # of the smallest edge
    assert np.abs(sim.velocities("cube")).max() < 0.05


@by("velocity_verlet", "bdf2")
def test_belt_carries_the_cube(sim):
    sim.place.motion = sliding(0.3)
    run(sim, 0.25)
    assert np.abs(sim.velocities("cube").mean(axis=0) - (0.3, 0, 0))[[0, 2]].max() < 0.04 * 0.3  # it bobs a little
    # friction accelerated it at friction * g, against a damping of 4 / s
    lost = 0.3**2 / (2 * FRICTION * G)
    assert sim.positions("cube")[:, 0].mean() - 0.1 == pytest.approx(0.25 * 0.3 - lost, rel=0.05)


@by("symplectic_euler", "implicit_euler")
def test_turntable_carries_the_cube(sim):
    sim.place.motion = turning(2.0)
    run(sim, 0.4)
    x = sim.positions("cube").mean(axis=0)
    v = sim.velocities("cube").mean(axis=0)
    assert np.abs(v - np.cross((0, 2.0, 0), x))[[0, 2]].max() < 0.05 * 0.2
    assert np.hypot(x[0], x[2]) == pytest.approx(0.1, rel=0.04)
    assert np.arctan2(-x[2], x[0]) == pytest.approx(2.0 * 0.4 - 0.04, abs=0.03)


@by("velocity_verlet", "linearly_implicit_euler")
def test_cube_slides_after_friction_is_lowered(sim):
    sim.set_gravity((3.0, *GRAVITY[1:]))
    run(sim, 0.2)
    start = sim.velocities("cube").mean(axis=0)
    assert np.abs(start[0]) < 0.02
    if not sim.settings.explicit:  # the cube still vibrates in explicit steps
        assert sim.contact_force("cube")[0] == pytest.approx(-3.0 * MASS, rel=0.1)
    sim.set_contact("belt", "cube", friction=0.1)
    try:
        run(sim, 0.2)
        assert (sim.contacts().friction == np.where(sim.contacts().body_a == "cube", 0.1, FRICTION)).all()
    finally:
        sim.set_contact("cube", "belt", friction=FRICTION)
    speed = (3.0 - 0.1 * G) / 4.0 * (1 - np.exp(-4.0 * 0.2))
    assert sim.velocities("cube").mean(axis=0)[0] - start[0] == pytest.approx(speed, rel=0.03)


def test_momentum(sim):
    """Of the two flying bodies, which meet: the impulse law of each, and what both conserve."""
    own, names = slice(rows_of(sim, "left").start, rows_of(sim, "right").stop), ("left", "right")
    mass, explicit, gap_moment, hits = lumped_masses(sim.scene)[own, None], sim.settings.explicit, np.zeros(3), 0
    sim.set_gravity((0, 0, 0))

    def angular():
        return np.cross(sim.positions()[own], mass * sim.velocities()[own]).sum(axis=0)

    angular_start = angular()
    for _ in range(40 if explicit else 6):
        before = {name: sim.momentum(name) for name in names}
        assert sim.step().converged
        changes = np.array([sim.momentum(name) - before[name] for name in names])
        forces = np.array([sim.contact_force(name) for name in names])
        if sim.settings.integrator != "bdf2":  # whose velocities are differences of two steps
            assert np.abs(changes - sim.dt * forces).max() < (1e-12 if explicit else 1e-8)
        assert np.abs(changes.sum(axis=0)).max() < 1e-8 and np.abs(forces.sum(axis=0)).max() < 1e-9
        c = sim.contacts()
        on = np.isin(c.body_a.astype(str), names)
        gap_moment += (c.gap[on, None] * np.cross(c.normal[on], c.impulse[on])).sum(axis=0)
        hits += bool((c.impulse[on] != 0).any())
    assert hits >= 2 and sim.velocities("left")[:, 0].mean() < 0.3  # of 1 m/s
    if explicit:
        assert np.abs(angular() - angular_start - gap_moment).max() < 1e-12 and np.abs(gap_moment).max() > 1e-6
    total = sum(sim.momentum(body.name) for body in sim.scene.bodies)
    assert np.abs(sim.momentum() - total).max() < 1e-12
    with pytest.raises(ts.SceneError, match="nobody"):
        sim.momentum("nobody")


def test_contact_laws(sim):
    """On a belt that drags the cube, and in a collision; target gaps by the formula of `gap_minus_target`."""
    speed, dt, explicit, bdf2 = 0.3, sim.dt, sim.settings.explicit, sim.settings.integrator == "bdf2"
    sim.place.motion = sliding(speed)
    states, offset = np.zeros(3, dtype=int), contact_offset(sim)
    (fast, slow), fastest = CORRECTIONS[explicit], OPENING_SPEED
    for k in range(40 if explicit else 8):
        x = sim.positions()
        sim.step()
        c, moved = sim.contacts(), sim.positions() - x
        on = c.nodes >= 0
        signed = np.where(on, c.weights, 0.0) * [1, 1, 1, -1, -1, -1]
        obstacle_displacement = np.where((c.body_b == "belt")[:, None], [speed * dt, 0, 0], 0.0)
        relative = np.einsum("kj,kjx->kx", signed, moved[c.nodes]) - obstacle_displacement
        v = sim.velocities() if bdf2 else moved / dt
        slip = np.einsum("kj,kjx->kx", signed, v[c.nodes]) - obstacle_displacement / dt
        above = np.maximum(c.gap, 0.0)
        opening = np.minimum(slow * (offset - above) + fast * (above - c.gap), fastest * dt)
        target_gap = np.where(c.gap < offset, c.gap + opening, offset)
        impulse_fraction = 2.0 / 3.0 if bdf2 and k > 0 else 1.0  # of a step, in which impulses act: beta / dt
        u_n = (c.gap - target_gap + (c.normal * relative).sum(axis=1)) / (impulse_fraction * dt)
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


def drag_and_collide(sim) -> tuple[np.ndarray, ...]:
    """Step while the belt drags the cube and two bodies collide; return the state."""
    for _ in range(30 if sim.settings.explicit else 6):
        sim.step()
    return sim.positions(), sim.velocities(), sim.reactions(), sim.contacts().impulse


@by("symplectic_euler", "bdf2")
def test_two_runs_agree_to_the_last_bit(sim):
    sim.place.motion = sliding(0.3)
    first = drag_and_collide(sim)
    sim.reset()
    assert all(np.array_equal(a, b) for a, b in zip(first, drag_and_collide(sim))) and np.abs(first[3]).max() > 1e-3


@by("velocity_verlet", "implicit_euler")
def test_rotation_and_translation_do_not_change_the_motion(sim):
    place, close = sim.place, 1e-9 if sim.settings.explicit else 1e-6
    place.motion = sliding(0.3)
    start, speed = sim.positions(), sim.velocities()
    x, v, *_ = drag_and_collide(sim)
    place.Q, place.T = rotation((1, -2, 0.5), 2.0), np.array([3.0, -1.0, 2.0])
    sim.set_gravity(place.Q @ GRAVITY)
    sim.reset()
    sim.set_state(start @ place.Q.T + place.T, speed @ place.Q.T)
    turned, turned_v, *_ = drag_and_collide(sim)
    assert np.abs(turned - (x @ place.Q.T + place.T)).max() < 0.1 * close
    assert np.abs(turned_v - v @ place.Q.T).max() < 10 * close


@by("implicit_euler", "velocity_verlet")
def test_forces_of_pairs_add_up_to_those_of_bodies(sim, monkeypatch):
    """The load falls on the cube; the first implicit step is cut into substeps, as if it had ended too deep."""
    explicit, cut, whole, ends, end = sim.settings.explicit, 0, 0, [], ContactStep.end

    def too_deep_once(contact, time, dt):
        ends.append(end(contact, time, dt))
        if len(ends) == 1:
            contact.relative_penetration = 1.0
        return ends[-1]

    if not explicit:
        monkeypatch.setattr(ContactStep, "end", too_deep_once)
    sim.dt = 0.001 if explicit else 0.002
    x = sim.positions("load") + (0.1 - 2.02, SIDE + 4e-4 - 0.5, 0.0)
    sim.set_state(x, np.tile([0.5, -4.0, 0.0], (len(x), 1)), body="load")
    for _ in range(40 if explicit else 3):
        report = sim.step()
        pairs = {pair: sim.contact_force(*pair) for pair in (("cube", "load"), ("cube", "belt"), ("load", "belt"))}
        size = 1e-12 + 1e-9 * max(np.abs(force).max() for force in pairs.values())
        assert np.abs(pairs["cube", "load"] + pairs["cube", "belt"] - sim.contact_force("cube")).max() < size
        assert np.array_equal(sim.contact_force("load", "cube"), -pairs["cube", "load"]) and not pairs["load", "belt"].any()
        assert np.abs(sim.contact_force("belt", "cube") - sim.contact_force("belt")).max() < size
        found = sim.contacts()
        if report.substeps > 1:
            cut += pairs["cube", "load"].any() and found.duration < sim.dt
        elif found.impulse.any():
            between = (found.body_a == "cube") & (found.body_b == "load")
            mean = found.impulse[between].sum(axis=0) / found.duration
            assert found.duration == sim.dt and np.abs(mean - pairs["cube", "load"]).max() < size
            whole += between.any()
    assert (cut > 0) == (not explicit) and whole > 0
    with pytest.raises(ts.SceneError, match="no net force on itself"):
        sim.contact_force("cube", "cube")
    with pytest.raises(ts.SceneError, match="nothing"):
        sim.contact_force("cube", "nothing")
