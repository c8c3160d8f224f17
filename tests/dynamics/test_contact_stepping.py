"""Steps with contacts, by every integrator that supports them:

* a cube comes to rest on a belt, which bears its weight across the contact offset; a fixed shelf bears its load;
* a turning belt carries the cube with it; forces of pairs add up to those of bodies;
* contact forces and weight are the rate of momentum; two colliding bodies conserve momentum, and angular momentum but for
  friction acting across a gap;
* what touches, or overlaps by less than the contact offset, is pushed apart by a load alone;
* impulses and velocities of a step obey Signorini's and Coulomb's laws, recomputed from public queries.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.contacts import Contacts
from taisoft.dynamics.part_check import BLOCKED, PartCheck
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.reference import lumped_masses
from taisoft.mesh.quality import mean_surface_edge
from tests.collision.rotations import rotation
from tests.contact import contact_oracle as oracle
from tests.dynamics.contact_scenes import FRICTION, SIDE, cube, ground, material
from tests.dynamics.scenes import rows_of

IMPLICIT = ("implicit_euler", "linearly_implicit_euler", "bdf2")
DT = dict.fromkeys(EXPLICIT, 1e-3) | dict.fromkeys(IMPLICIT, 0.01)  # [s]
G, GRAVITY, MASS = 9.81, np.array([0.0, -9.81, 0.0]), 1.0  # [m/s^2]; [kg] of a cube
# fractions of a penetration and of a missing contact offset that an explicit (True) or implicit step corrects
CORRECTIONS = {True: (0.05, 0.005), False: (0.2, 0.02)}
OPENING_SPEED = 0.01 * np.sqrt(1e5 / 1000.0)  # [m/s] the fastest of both


class Belt:
    """Path of a belt that runs along x [m/s] and turns about y [rad/s]."""

    speed = rate = 0.0

    def __call__(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([self.speed * t, 0.0, 0.0]), rotation((0, 1, 0), self.rate * t)


def scene() -> ts.Scene:
    """cube on the belt at 0.1 m from its axis; load on shelf, which is held below; left and right, about to meet."""
    made, damped, undamped, gap = ts.Scene(gravity=GRAVITY), material(mass_damping=4.0), material(mass_damping=0.0), 3e-4
    bodies = [
        ("cube", cube(2), damped, (0.1, gap, 0.0), (0, 0, 0)),
        ("shelf", ts.box_mesh((3, 1, 3), (0.3, 0.1, 0.3)), damped, (2.0, 0.45, 0.0), (0, 0, 0)),
        ("load", cube(2), damped, (2.02, 0.5 + gap, 0.01), (0, 0, 0)),
        ("left", cube(1, 1), undamped, (-4.0, 3.0, 0.0), (1.0, 0.2, 0.0)),
        ("right", cube(1, 2), undamped, (-3.87, 3.03, 0.02), (-1.0, 0.0, 0.1)),
    ]
    for name, mesh, rubber, at, v in bodies:
        body = made.add_body(mesh, rubber, name=name, position=at, velocity=v)
        if name == "shelf":
            body.fix(lambda X: X[:, 1] < -0.04)
    made.add_obstacle(ground(), name="belt", friction=FRICTION, path=Belt())
    return made


@pytest.fixture(scope="module", params=DT)
def shared_sim(request, taken_path):
    tight = {"newton_tolerance": 1e-10} if request.param in IMPLICIT else {}
    with ts.Simulator(scene(), DT[request.param], request.param, precision="f64", contact_tolerance=1e-8, **tight) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    """The simulator at its start, the belt at rest."""
    belt = shared_sim.scene.obstacle("belt").path
    belt.speed = belt.rate = 0.0
    shared_sim.set_gravity(GRAVITY)
    for name in ("cube", "shelf", "load"):
        shared_sim.set_material(name, mass_damping=4.0)
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


def test_what_touches_is_pushed_apart_by_a_load_alone(sim):
    """The cube touches the belt, and the load overlaps with the shelf by half of the contact offset."""
    offset = contact_offset(sim)
    for name, shift in (("cube", 3e-4), ("load", 3e-4 + 0.5 * offset)):
        sim.set_state(sim.positions(name) - [0.0, shift, 0.0], body=name)
    sim.set_state(velocities=np.zeros_like(sim.positions()))
    sim.set_gravity((0, 0, 0))
    for _ in range(30):
        sim.step()
        assert np.abs(sim.velocities()).max() < 1e-9 and abs(sim.contacts().gap.min() + 0.5 * offset) < 1e-9
    sim.set_gravity(GRAVITY)
    for _ in range(30):
        sim.advance(round(0.01 / sim.dt))
    assert sim.contacts().gap.min() > 0.0


@by("symplectic_euler", "bdf2")
def test_a_belt_that_jumps_between_two_steps_is_refused(sim):
    sim.step()
    sim.scene.obstacle("belt").path.speed = 0.1
    with pytest.raises(ts.SimulationError, match="step 2: obstacle 'belt': the path gives another value at t = .* than before"):
        sim.step()
    sim.reset()
    sim.step()


@by("symplectic_euler", "bdf2")
def test_contact_forces_balance_weight(sim):
    """Weight plus damping. Means over several steps, since the contact forces of explicit steps fluctuate."""
    mass = lumped_masses(sim.scene)[:, None]
    for name in ("cube", "shelf", "load"):
        sim.set_material(name, mass_damping=60.0)
    run(sim, 0.2)
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


@pytest.mark.gpu_path
@by("symplectic_euler")
def test_an_explicit_step_rebounds_with_the_speed_of_its_middle(sim):
    """A cube at its contact offset that falls at u, and faster by k after the step: restitution of u + k/2, then k/2."""
    u, k, restitution = -0.1, -0.1, 0.5  # [m/s]
    sim.dt = 1e-4
    sim.set_gravity((0, k / sim.dt, 0))
    sim.set_material("cube", mass_damping=0.0)
    sim.set_contact("cube", "belt", restitution=restitution)
    x = sim.positions("cube")
    lower = x[:, 1] < x[:, 1].min() + 1e-9
    sim.set_state(x + (0, contact_offset(sim) - x[:, 1].min(), 0), np.tile([0, u, 0], (len(x), 1)), body="cube")
    sim.step()
    sim.set_contact("cube", "belt", restitution=0.0)
    assert sim.velocities("cube")[:, 1] == pytest.approx(np.where(lower, -restitution * (u + k / 2) + k / 2, u + k), rel=1e-6)


@by("implicit_euler")
def test_turntable_carries_the_cube(sim):
    sim.scene.obstacle("belt").path.rate = 2.0
    run(sim, 0.4)
    x = sim.positions("cube").mean(axis=0)
    v = sim.velocities("cube").mean(axis=0)
    assert np.abs(v - np.cross((0, 2.0, 0), x))[[0, 2]].max() < 0.05 * 0.2
    assert np.hypot(x[0], x[2]) == pytest.approx(0.1, rel=0.04)
    assert np.arctan2(-x[2], x[0]) == pytest.approx(2.0 * 0.4 - 0.04, abs=0.03)


@pytest.mark.gpu_path("symplectic_euler")
def test_momentum(sim):
    """Of the two flying bodies, which meet: the impulse law of each, and what both conserve."""
    own, names = slice(rows_of(sim, "left").start, rows_of(sim, "right").stop), ("left", "right")
    mass, explicit, gap_moment, hits = lumped_masses(sim.scene)[own, None], sim.settings.explicit, np.zeros(3), 0
    sim.set_gravity((0, 0, 0))

    def angular():
        return np.cross(sim.positions()[own], mass * sim.velocities()[own]).sum(axis=0)

    angular_start = angular()
    for _ in range(40 if explicit else 6):
        before, x = {name: sim.momentum(name) for name in names}, sim.positions()
        assert sim.step().converged
        changes = np.array([sim.momentum(name) - before[name] for name in names])
        forces = np.array([sim.contact_force(name) for name in names])
        if sim.settings.integrator != "bdf2":  # whose velocities are differences of two steps
            assert np.abs(changes - sim.dt * forces).max() < (1e-12 if explicit else 1e-8)
        assert np.abs(changes.sum(axis=0)).max() < 1e-8 and np.abs(forces.sum(axis=0)).max() < 1e-9
        c = sim.contacts()
        on = np.isin(c.body_a.astype(str), names)
        signed = np.where(c.nodes >= 0, c.weights, 0.0) * np.repeat([1, -1], c.nodes.shape[1] // 2)
        apart = np.einsum("kj,kjx->kx", signed, x[c.nodes])  # of the two points, which an impulse turns: along the normal
        start = (apart * c.normal).sum(axis=1, keepdims=True)
        if explicit:  # whose normals are those of x; means are not quite along them
            assert (np.linalg.norm(apart - start * c.normal, axis=1)[on] <= 0.01 * np.abs(start[on, 0]) + 1e-15).all()
        gap_moment += np.cross(apart[on], c.impulse[on]).sum(axis=0)
        hits += bool((c.impulse[on] != 0).any())
    assert hits >= 2 and sim.velocities("left")[:, 0].mean() < 0.3  # of 1 m/s
    if explicit:
        assert np.abs(angular() - angular_start - gap_moment).max() < 1e-12 and np.abs(gap_moment).max() > 1e-6
    total = sum(sim.momentum(body.name) for body in sim.scene.bodies)
    assert np.abs(sim.momentum() - total).max() < 1e-12


def test_contact_laws(sim):
    """On a belt that drags the cube, and in a collision; target gaps by the formula of `gap_minus_target`."""
    speed, dt, explicit, bdf2 = 0.3, sim.dt, sim.settings.explicit, sim.settings.integrator == "bdf2"
    sim.scene.obstacle("belt").path.speed = speed
    states, offset = np.zeros(3, dtype=int), contact_offset(sim)
    (fast, slow), fastest = CORRECTIONS[explicit], OPENING_SPEED
    for k in range(40 if explicit else 8):
        x, found = sim.positions(), sim.detect_contacts()
        rows = zip(found.kind, found.feature.tolist(), found.gap, found.guard)
        at_start = {(kind, *ids): (gap, guard) for kind, ids, gap, guard in rows}
        sim.step()
        c, moved = sim.contacts(), sim.positions() - x
        known = [(kind, *ids) in at_start for kind, ids in zip(c.kind, c.feature.tolist())]
        assert np.mean(known) > 0.8
        c = Contacts(**{name: values[known] if isinstance(values, np.ndarray) else values for name, values in vars(c).items()})
        gap, guard = np.array([at_start[kind, *ids] for kind, ids in zip(c.kind, c.feature.tolist())]).T
        on = c.nodes >= 0
        signed = np.where(on, c.weights, 0.0) * np.repeat([1, -1], c.nodes.shape[1] // 2)
        obstacle_displacement = np.where((c.body_b == "belt")[:, None], [speed * dt, 0, 0], 0.0)
        v = sim.velocities() if bdf2 else moved / dt
        slip = np.einsum("kj,kjx->kx", signed, v[c.nodes]) - obstacle_displacement / dt
        above, own = np.maximum(gap, 0.0), np.where(c.guard | (guard == 1), 0.5, 1.0) * offset  # at the start or the end
        opening = np.minimum(slow * (own - above) + fast * (above - gap), fastest * dt)
        target_gap = np.where(gap < own, gap + opening, own)
        impulse_fraction = 2.0 / 3.0 if bdf2 and k > 0 else 1.0  # of a step, in which impulses act: beta / dt
        u_n = (c.gap - target_gap) / (impulse_fraction * dt)
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


@by("implicit_euler", "velocity_verlet")
def test_forces_of_pairs_add_up_to_those_of_bodies(sim, monkeypatch):
    """The load falls on the cube; the first implicit step is halved, as if its way were blocked."""
    explicit, cut, whole, ways, certify = sim.settings.explicit, 0, 0, [], PartCheck.certify

    def blocked_once(*given):
        ways.append(certify(*given))
        return BLOCKED if len(ways) == 1 else ways[-1]

    if not explicit:
        monkeypatch.setattr(PartCheck, "certify", blocked_once)
    sim.dt = 0.001 if explicit else 0.002
    x = sim.positions("load") + (0.1 - 2.02, SIDE + 4e-4 - 0.5, 0.0)
    sim.set_state(x, np.tile([0.5, -3.0, 0.0], (len(x), 1)), body="load")
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
