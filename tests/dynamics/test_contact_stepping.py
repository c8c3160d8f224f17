"""Steps with contacts, by every integrator that supports them:

* a cube comes to rest on a belt, which bears its weight across the contact offset; a fixed shelf bears its load;
* a moving belt carries the cube to its own speed, in translation and rotation; with less friction the cube slides as by Coulomb;
* a stiff cube rebounds with its coefficient of restitution;
* two colliding bodies conserve momentum, and angular momentum but for friction acting across a gap;
* impulses and velocities of a step obey Signorini's and Coulomb's laws, recomputed from public queries;
* two runs agree to the last bit; rotation, translation and the order of bodies do not change the motion;
* all contact solvers of explicit steps find the same motion.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact
from taisoft.fem.reference import lumped_masses
from taisoft.mesh.quality import mean_surface_edge
from taisoft.settings import EXPLICIT_CONTACT
from tests.collision.rotations import rotation
from tests.contact import contact_oracle as oracle
from tests.dynamics.contact_scenes import FRICTION, GRAVITY, MASS, Stage, scene, sliding, still, turning
from tests.dynamics.scenes import rows_of

EXPLICIT, IMPLICIT = ("symplectic_euler", "velocity_verlet"), ("implicit_euler", "linearly_implicit_euler", "bdf2")
DT = dict.fromkeys(EXPLICIT, 1e-3) | dict.fromkeys(IMPLICIT, 0.01)  # [s]
G = -GRAVITY[1]


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
    shared_sim.reset()
    return shared_sim


def contact_offset(sim) -> float:
    """Gap that contacts keep [m]."""
    return contact.CONTACT_OFFSET * min(mean_surface_edge([(b.nodes.positions, b.nodes.surface)]) for b in sim.scene.bodies)


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


def test_contact_forces_balance_weight_at_rest(damped):
    """Weight plus damping: with Verlet, nodes in contact keep the velocity of half a step's impulse.

    Means over several steps, since the contact forces of explicit steps fluctuate.
    """
    sim, mass = damped, lumped_masses(damped.scene)[:, None]
    run(sim, 0.3)
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


def test_belt_carries_the_cube(sim):
    sim.place.motion = sliding(0.3)
    run(sim, 0.25)
    assert np.abs(sim.velocities("cube").mean(axis=0) - (0.3, 0, 0))[[0, 2]].max() < 0.04 * 0.3  # it bobs a little
    # friction accelerated it at friction * g, against a damping of 4 / s
    lost = 0.3**2 / (2 * FRICTION * G)
    assert sim.positions("cube")[:, 0].mean() - 0.1 == pytest.approx(0.25 * 0.3 - lost, rel=0.05)


def test_turntable_carries_the_cube(sim):
    sim.place.motion = turning(2.0)
    run(sim, 0.4)
    x = sim.positions("cube").mean(axis=0)
    v = sim.velocities("cube").mean(axis=0)
    assert np.abs(v - np.cross((0, 2.0, 0), x))[[0, 2]].max() < 0.05 * 0.2
    assert np.hypot(x[0], x[2]) == pytest.approx(0.1, rel=0.04)
    assert np.arctan2(-x[2], x[0]) == pytest.approx(2.0 * 0.4 - 0.04, abs=0.03)


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


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_restitution(sim, restitution):
    """A cube so stiff that it moves as a rigid body; 2 m/s, in implicit steps of 1 ms."""
    if sim.settings.integrator != "implicit_euler":
        pytest.skip("rebounds are the same in all implicit steps; explicit ones need far shorter steps")
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
        sim.dt = DT["implicit_euler"]
        sim.set_contact("cube", "belt", restitution=0.0)
        sim.set_material("cube", young=1e5, mass_damping=4.0)


def momenta(sim) -> tuple[np.ndarray, np.ndarray]:
    """Momentum and angular momentum about the origin (3,) of the two flying bodies."""
    own = slice(rows_of(sim, "left").start, rows_of(sim, "right").stop)
    p = lumped_masses(sim.scene)[own, None] * sim.velocities()[own]
    return p.sum(axis=0), np.cross(sim.positions()[own], p).sum(axis=0)


def test_momentum_is_conserved(sim):
    sim.set_gravity((0, 0, 0))
    (linear, angular), added, met = momenta(sim), np.zeros(3), 0
    for _ in range(40 if sim.settings.explicit else 6):
        assert sim.step().converged
        c = sim.contacts()
        on = np.isin(c.body_a.astype(str), ("left", "right"))
        added += (c.gap[on, None] * np.cross(c.normal[on], c.impulse[on])).sum(axis=0)
        met += bool((c.impulse[on] != 0).any())
    assert met >= 2 and sim.velocities("left")[:, 0].mean() < 0.3  # of 1 m/s
    now, angular_now = momenta(sim)
    if sim.settings.explicit:
        assert np.abs(now - linear).max() < 1e-12 and np.abs(angular_now - angular - added).max() < 1e-12
        assert np.abs(added).max() > 1e-6
    else:
        assert np.abs(now - linear).max() < 1e-8


def test_contact_laws(sim):
    """On a belt that drags the cube, and in a collision; target gaps by the formula of `gap_minus_target`."""
    speed, dt, explicit, bdf2 = 0.3, sim.dt, sim.settings.explicit, sim.settings.integrator == "bdf2"
    sim.place.motion = sliding(speed)
    states, offset = np.zeros(3, dtype=int), contact_offset(sim)
    fast, slow = contact.PENETRATION_CORRECTION[explicit], contact.OFFSET_CORRECTION[explicit]
    fastest = contact.MAX_OPENING_SPEED * np.sqrt(1e5 / 1000.0)
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


def state(sim) -> tuple[np.ndarray, ...]:
    return sim.positions(), sim.velocities(), sim.reactions(), sim.contacts().impulse


def drag_and_collide(sim) -> tuple[np.ndarray, ...]:
    """Step while the belt drags the cube and two bodies collide; return the state."""
    for _ in range(30 if sim.settings.explicit else 6):
        sim.step()
    return state(sim)


def test_two_runs_agree_to_the_last_bit(sim):
    sim.place.motion = sliding(0.3)
    first = drag_and_collide(sim)
    sim.reset()
    assert all(np.array_equal(a, b) for a, b in zip(first, drag_and_collide(sim))) and np.abs(first[3]).max() > 1e-3


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


def test_order_of_bodies_does_not_change_the_motion(sim):
    if sim.settings.integrator != "symplectic_euler":
        pytest.skip("the order of bodies affects only the sweeps over contacts, which symplectic Euler does too")
    sim.place.motion, twins, rest = sliding(0.3), ("cube", "load"), ("shelf", "left", "right")  # twins lie beside the shelf
    start = [sim.positions(name) for name in twins]
    drag_and_collide(sim)
    ends = [(sim.positions(name), sim.velocities(name)) for name in (*twins, *rest)]
    sim.reset()
    for name, x in zip(twins, start[::-1]):
        sim.set_state(positions=x, body=name)
    drag_and_collide(sim)
    for name, (x, v) in zip((*twins[::-1], *rest), ends):
        assert np.abs(sim.positions(name) - x).max() < 1e-9 and np.abs(sim.velocities(name) - v).max() < 1e-7


@pytest.mark.parametrize("integrator", EXPLICIT)
def test_contact_solvers_of_explicit_steps_agree(integrator):
    found = {}
    for method in EXPLICIT_CONTACT:
        with simulator(integrator, contact_solver=method) as sim:
            sim.place.motion = sliding(0.3)
            report = sim.advance(30)
            assert report.steps == 30 and report.converged
            found[method] = sim.velocities()
    for method in EXPLICIT_CONTACT[1:]:
        assert np.abs(found[method] - found["gauss_seidel"]).max() < 1e-6


# --- forces of pairs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["implicit_euler", "velocity_verlet"])
def test_forces_of_pairs_add_up_to_those_of_bodies(integrator):
    """A cube falls on one that lies on the ground; the first implicit step is cut into substeps."""
    fallen, speed = ts.Scene(gravity=GRAVITY), -30 if integrator in IMPLICIT else -4
    rubber = ts.Material(young=1e5, density=1000.0, friction=0.5)
    for name, height, velocity in (("low", 0.5, (0, 0, 0)), ("high", 1.52, (0.5, speed, 0))):
        fallen.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber, name=name, position=(0, height, 0), velocity=velocity)
    fallen.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    dt, cut, whole = (5e-4 if integrator in EXPLICIT else 0.02), 0, 0
    with ts.Simulator(fallen, dt=dt, integrator=integrator, precision="f64") as sim:
        for _ in range(3 if integrator in IMPLICIT else 40):
            report = sim.step()
            pairs = {pair: sim.contact_force(*pair) for pair in (("low", "high"), ("low", "ground"), ("high", "ground"))}
            size = 1e-12 + 1e-9 * max(np.abs(force).max() for force in pairs.values())
            assert np.abs(pairs["low", "high"] + pairs["low", "ground"] - sim.contact_force("low")).max() < size
            assert np.array_equal(sim.contact_force("high", "low"), -pairs["low", "high"]) and not pairs["high", "ground"].any()
            assert np.abs(sim.contact_force("ground", "low") - sim.contact_force("ground")).max() < size
            found = sim.contacts()
            if report.substeps > 1:
                cut += pairs["low", "high"].any() and found.duration < dt
            elif found.impulse.any():
                between = (found.body_a == "low") & (found.body_b == "high")
                mean = found.impulse[between].sum(axis=0) / found.duration
                assert found.duration == dt and np.abs(mean - pairs["low", "high"]).max() < size
                whole += between.any()
        assert (cut > 0) == (integrator in IMPLICIT) and whole > 0
        with pytest.raises(ts.SceneError, match="no net force on itself"):
            sim.contact_force("low", "low")
        with pytest.raises(ts.SceneError, match="nothing"):
            sim.contact_force("low", "nothing")
