"""Tendons of given length, elastic and inextensible:

* equilibria in closed form; slack ones do not act; the small problem of which tendons slacken against all subsets;
* length and tension in motion: a fall that a tendon ends, winding, contacts; momentum; energies of elastic ones;
* changes at run time, checkpoints, files, and what cannot keep a length.
"""

from itertools import product

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.multipliers import TOLERANCE
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.reference import lumped_masses
from taisoft.fem.springs import spring_table
from taisoft.linear.bordered import solve_active
from taisoft.scene.fingerprint import scene_digest
from taisoft.stability import hooke_stiffness, spring_stiffness, stable_dt
from tests.dynamics.scenes import connected_scene, cube, rubber
from tests.fem.oracle_springs import OracleSprings, shape_row

WEIGHT = 990 * 9.81
KEPT = {"inextensible": None, "elastic": 2e4}


def load(*lines, velocity=(0.0, 0.0, 0.0), gravity=(0.0, -9.81, 0.0), **material) -> ts.Scene:
    """A cube that tendons between points of a ceiling hold. lines: arguments of add_tendon, whose points may be a position."""
    scene = ts.Scene(gravity=gravity)
    scene.contact_forces = False
    scene.add_body(cube(), rubber(**material), name="load", velocity=velocity)
    scene.add_obstacle(ts.HalfSpace((0, 99, 0), (0, -1, 0)), name="ceiling")
    for points, numbers in lines:
        scene.add_tendon([point if len(point) == 2 else ("ceiling", point) for point in points], **numbers)
    return scene


TOP = ("load", (0.0, 0.45, 0.0))


def simulator(scene: ts.Scene, integrator: str = "implicit_euler", dt: float = 1 / 120, **settings) -> ts.Simulator:
    return ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64", **settings)


def held_point(scene: ts.Scene, x: np.ndarray) -> np.ndarray:
    """Where the point TOP is (3,)."""
    return shape_row(scene.bodies[0], np.array(TOP[1])) @ x


# --- equilibria -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KEPT)
@pytest.mark.parametrize("heights, length", [((1.5, 1.5), 2.6), ((1.5, 1.9), 3.5)])
def test_a_load_slides_to_where_both_segments_are_equally_steep(kind, heights, length):
    left, right, stiffness = np.array([-1.0, heights[0], 0.0]), np.array([1.3, heights[1], 0.0]), KEPT[kind]
    scene = load(([left, TOP, right], {"length": length, "stiffness": stiffness, "name": "line"}))
    result = ts.solve_static(scene, tolerance=1e-10)
    total = length
    for _ in range(100):  # the extension depends on the tension
        sine = (right - left)[0] / total
        cosine = np.sqrt(1.0 - sine**2)
        tension = WEIGHT / (2 * cosine)
        total = length + (0.0 if stiffness is None else tension / stiffness)
    first = 0.5 * (total + (left - right)[1] / cosine)
    expected = left + first * np.array([sine, -cosine, 0.0])
    assert result.converged and result.tension("line") == pytest.approx(tension, rel=1e-5)
    ends = [np.linalg.norm(end - expected) for end in (left, right)]
    assert sum(ends) == pytest.approx(total, rel=1e-9)
    assert held_point(scene, result.positions()) == pytest.approx(expected, abs=1e-5)
    with pytest.raises(SceneError, match=r"^tension: no spring or tendon is called 'lin' \(did you mean line\?\)$"):
        result.tension("lin")


@pytest.mark.parametrize("kind", KEPT)
def test_the_longer_of_two_tendons_is_slack(kind):
    pin, numbers = (0.0, 1.45, 0.0), {"stiffness": KEPT[kind]}
    scene = load(
        ([pin, TOP], {"length": 2.5, "name": "long", **numbers}), ([pin, TOP], {"length": 1.1, "name": "short", **numbers})
    )
    result = ts.solve_static(scene, tolerance=1e-10)
    assert result.converged and result.tension("long") == 0.0 and result.tension("short") == pytest.approx(WEIGHT, rel=1e-9)
    extension = 0.0 if KEPT[kind] is None else WEIGHT / KEPT[kind]
    assert held_point(scene, result.positions())[1] == pytest.approx(1.45 - 1.1 - extension, abs=2e-6)


def test_load_steps_lead_from_the_length_at_rest():
    """A beam that a tendon bends far is solved in steps of the load, and of the length."""
    scene = ts.Scene(gravity=(0, 0, 0))
    beam = scene.add_body(ts.box_mesh((10, 1, 1), (1.0, 0.1, 0.1)), rubber(), name="beam", order=2)
    beam.fix(lambda X: X[:, 0] < -0.499)
    line = [("beam", (x, 0.05, 0.0)) for x in np.linspace(-0.5, 0.5, 7)]
    results = {}
    for stiffness in (None, 1e5):
        scene.tendons.clear()
        scene.add_tendon(line, length=0.93, stiffness=stiffness, name="line")
        results[stiffness] = ts.solve_static(scene)
        assert results[stiffness].converged and results[stiffness].tension("line") > 0.1
    stretched = results[1e5].tension("line") / 1e5
    assert results[None].tension("line") == pytest.approx(results[1e5].tension("line"), rel=3 * stretched / 0.07)
    assert np.abs(results[None].positions()[:, 1].max()) > 0.2


@pytest.mark.parametrize("penalised", [False, True])
def test_which_tendons_slacken_is_found(penalised):
    """Against every subset of a quadratic problem with constraints G y >= c or, where two-sided, G y = c."""
    rng, found = np.random.default_rng(3), set()
    for _ in range(60):
        n, k = 7, 3
        A, G = (lambda B: B @ B.T + 0.1 * np.eye(n))(rng.standard_normal((n, n))), rng.standard_normal((k, n))
        one_sided = np.array([True, True, False])
        values = np.where(one_sided, np.maximum(rng.standard_normal(k), 0.0), rng.standard_normal(k))
        missing, r = 0.5 * rng.standard_normal(k), rng.standard_normal(n)  # r: residual with the values
        penalty = rng.uniform(0.1, 5.0, k) if penalised else np.zeros(k)
        shifted = values + penalty * missing
        shift = np.where(one_sided, np.maximum(shifted, 0.0), shifted) - values
        stiffened = A + G.T @ (penalty[:, None] * G)
        y_0, z = np.linalg.solve(stiffened, G.T @ shift - r), np.linalg.solve(stiffened, G.T).T
        s, new = solve_active(G @ z.T, G @ y_0, missing, values, shift, penalty, one_sided)
        y = y_0 + s @ z
        assert np.abs(A @ y + r - G.T @ (new - values)).max() < 1e-9 * (1.0 + np.abs(new).max())
        solutions = []
        for active in product((False, True), repeat=k):
            active = np.array(active) | ~one_sided
            N = G[active] @ np.linalg.solve(A, G[active].T)
            base = np.linalg.solve(A, -r - G.T @ np.where(active, 0.0, values))  # of a change of the active ones alone
            change = np.linalg.solve(N, missing[active] - G[active] @ base)
            trial = base + np.linalg.solve(A, G[active].T @ change)
            wanted = np.zeros(k)
            wanted[active] = values[active] + change
            if (wanted[one_sided] >= 0.0).all() and (G @ trial >= missing - 1e-9)[one_sided].all():
                solutions.append((active, trial, wanted))
        active, trial, wanted = solutions[0]
        assert np.abs(y - trial).max() < 1e-7 * (1 + np.abs(trial).max()) and np.abs(new - wanted).max() < 1e-7 * (
            1 + np.abs(wanted).max()
        )
        found.add(tuple(active))
    assert len(found) == 4  # each of the two slackened and did not


# --- motion ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_fall_ends_where_the_tendon_tightens(integrator, precision):
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": 1.2, "name": "line"}), mass_damping=0.0)
    dt, n = 1 / 100, 0
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision=precision) as sim:
        while sim.joint_force("line") == 0.0:
            before = sim.positions()
            assert sim.step().converged
            n += 1
        if integrator == "implicit_euler":
            fallen = 0.5 * 9.81 * dt**2 * (n - 1) * n
            assert before[:, 1] == pytest.approx(cube().vertices[:, 1] - fallen, abs=2e-6 if precision == "f32" else 1e-9)
        assert 18 <= n <= 24  # sqrt(2 * 0.2 / g) is 0.202 s
        tensions = []
        for _ in range(30):
            report = sim.step()
            assert report.converged, report.problems
            tensions.append(sim.joint_force("line"))
            length = 1.45 - held_point(scene, sim.positions())[1]
            assert length < 1.2 * (1 + 2 * TOLERANCE) and (tensions[-1] == 0.0 or length > 1.2 * (1 - 2 * TOLERANCE))
        assert max(tensions) > 1.5 * WEIGHT


def test_a_winch_lifts_a_load():
    winding = ts.KeyFrames((0.0, 0.5), values=(1.0, 0.7), smooth=True)
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": winding, "name": "line"}), young=1e6, mass_damping=4.0)
    with simulator(scene) as sim:
        result = sim.run(seconds=1.5, fps=None)
        assert result.status == "ok", result.problems
        assert held_point(scene, sim.positions())[1] == pytest.approx(1.45 - 0.7, abs=2e-6)
        assert sim.joint_force("line") == pytest.approx(WEIGHT, rel=2e-3)
        assert sim.energies().loads == 0.0  # a multiplier has no potential
        sim.set_length("line", 0.9)
        sim.run(seconds=1.5, fps=None)
        assert held_point(scene, sim.positions())[1] == pytest.approx(1.45 - 0.9, abs=2e-6)


def test_a_tendon_relieves_a_contact():
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": lambda t: 1.0 - 0.02 * min(1.0, 4 * t), "name": "line"}), mass_damping=10.0)
    scene.contact_forces = True
    scene.add_obstacle(ts.HalfSpace((0, -0.45, 0), (0, 1, 0)), name="ground")
    with simulator(scene) as sim:
        for _ in range(150):
            report = sim.step()
            assert report.converged, report.problems
        assert report.n_contacts > 0
        tension, contact = sim.joint_force("line"), sim.contact_force("load")[1]
        assert 0.1 * WEIGHT < tension < 0.9 * WEIGHT and tension + contact == pytest.approx(WEIGHT, rel=1e-3)
        assert held_point(scene, sim.positions())[1] == pytest.approx(1.45 - 0.98, abs=2e-6)


@pytest.mark.parametrize("kind", KEPT)
def test_free_bodies_keep_their_momentum(kind):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.add_body(cube(), rubber(), name="a", velocity=(-1.0, 0.3, 0.0))
    scene.add_body(cube(), rubber(density=400.0), name="b", position=(2.0, 0.0, 0.0), velocity=(1.0, 0.0, -0.4))
    line = [("a", (0.4, 0.3, 0.1)), ("b", (-0.3, 0.1, 0.0)), ("a", (0.2, -0.4, 0.2))]
    scene.add_tendon(line, length=3.6, stiffness=KEPT[kind], name="line")
    mass = lumped_masses(scene)
    with simulator(scene, dt=1 / 200, newton_tolerance=1e-12, linear_tolerance=1e-12) as sim:
        before, tensions = mass @ sim.velocities(), []
        for _ in range(80):
            assert sim.step().converged
            tensions.append(sim.joint_force("line"))
        assert min(tensions) == 0.0 and max(tensions) > 100.0
        assert mass @ sim.velocities() == pytest.approx(before, abs=1e-8 * np.abs(before).max())


# --- elastic tendons ------------------------------------------------------------------------------------------------------


def test_energies_of_an_elastic_tendon():
    """A load that bounces on it keeps its energy, half the stiffness times its squared extension of it in the tendon."""
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": 1.1, "stiffness": 5e4, "name": "line"}), young=1e6)
    with simulator(scene, "velocity_verlet", 2e-4) as sim:
        start, lowest = sum(vars(sim.energies()).values()), 0.0
        result = sim.run(seconds=0.3, fps=None)
        assert result.status == "ok", result.problems
        extension = 1.45 - held_point(scene, sim.positions())[1] - 1.1
        assert extension > 0.05 and sim.joint_force("line") == pytest.approx(5e4 * extension, rel=1e-9)
        own = 0.5 * 5e4 * extension**2
        with simulator(load(young=1e6), "velocity_verlet", 2e-4) as bare:
            bare.set_state(positions=sim.positions(), velocities=sim.velocities(), body="load")
            assert sim.energies().elastic - bare.energies().elastic == pytest.approx(own, rel=1e-9)
        lowest = sum(vars(sim.energies()).values())
        assert lowest == pytest.approx(start, abs=1e-3 * own)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "linearly_implicit_euler", "implicit_midpoint", "bdf2"])
def test_every_integrator_follows_a_length_along_a_path(integrator):
    path = ts.KeyFrames((0.0, 0.05), values=(1.0, 0.9))
    ends = []
    for other in (integrator, "velocity_verlet"):
        scene = load(([(0.0, 1.45, 0.0), TOP], {"length": path, "stiffness": 2e4, "name": "line"}))
        with simulator(scene, other, 2e-4) as sim:
            for _ in range(400):
                sim.step()
            ends.append(sim.positions())
    assert np.abs(ends[1] - cube().vertices).max() > 0.01
    assert np.abs(ends[0] - ends[1]).max() < 0.02 * np.abs(ends[1] - cube().vertices).max()


@pytest.mark.parametrize("order", [1, 2])
def test_linear_vibration_knows_elastic_tendons(order):
    scene = connected_scene(order)
    rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    expected = OracleSprings(scene).stiffness(rest)
    assert np.abs(spring_stiffness(scene, spring_table(scene)).toarray() - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("stiffness", [1e4, 1e7])
def test_stable_dt_is_below_the_limit(stiffness):
    scene = load(([(-1.0, 1.0, 0.0), TOP, ("load", (0.3, -0.3, 0.2))], {"length": 1.0, "stiffness": stiffness}))
    body, mass = scene.bodies[0], np.repeat(lumped_masses(scene), 3)
    K = (hooke_stiffness(body) + spring_stiffness(scene, spring_table(scene))).toarray() / np.sqrt(np.outer(mass, mass))
    limit = 2.0 / np.sqrt(np.linalg.eigvalsh(K)[-1])
    assert 0.4 * limit < stable_dt(scene, verlet=True) <= limit


# --- changes, checkpoints, refusals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KEPT)
@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_checkpoints_resume_bitwise(tmp_path, kind, integrator):
    def make(length=1.0) -> ts.Scene:
        own = {"length": length, "stiffness": KEPT[kind], "name": "line"}
        return load(([(0.3, 1.45, 0.0), TOP], own), ([(1.0, 1.0, 0.0), ("load", 7)], {"force": 5.0, "name": "other"}))

    with simulator(make(), integrator) as sim:
        for k in range(8):
            if k == 2:
                sim.set_length("line", 0.97)
            if k == 4:
                sim.save_checkpoint(tmp_path / "c.npz")
            sim.step()
        wanted = sim.positions(), sim.joint_force("line")
        with pytest.raises(SceneError, match=r"^set_length: no tendon is called 'lin' \(did you mean line\?\)$"):
            sim.set_length("lin", 1.0)
        with pytest.raises(SceneError, match="^set_length: tendon 'other' has a given force: call set_tension$"):
            sim.set_length("other", 1.0)
        with pytest.raises(SceneError, match="^set_tension: tendon 'line' has a given length: call set_length$"):
            sim.set_tension("line", 1.0)
        with pytest.raises(SceneError, match="^tendon 'line': length must be above 0 m, not -1$"):
            sim.set_length("line", -1.0)
        sim.reset()
        assert sim.joint_force("line") == (0.0 if KEPT[kind] is None else pytest.approx(2e4 * (np.hypot(0.3, 1.0) - 0.97)))
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", make()) as sim:
        for _ in range(4):
            sim.step()
        assert np.array_equal(sim.positions(), wanted[0]) and sim.joint_force("line") == wanted[1]
    with pytest.raises(SceneError, match="tendon 'line': length is 1.1 in this scene and was 1.0 at the start"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", make(1.1))
    with pytest.raises(SceneError, match="differs in tendon 'line'"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", make(ts.KeyFrames((0.0, 1.0), values=(1.0, 2.0))))


@pytest.mark.parametrize("kind", KEPT)
def test_scene_files_hold_lengths(tmp_path, kind):
    for length in (1.0, ts.KeyFrames((0.0, 1.0), values=(1.0, 2.0), smooth=True)):
        scene = load(([(0.3, 1.45, 0.0), TOP], {"length": length, "stiffness": KEPT[kind], "name": "line"}))
        ts.write_scene(tmp_path / "a.toml", scene, overwrite=True)
        assert scene_digest(ts.read_scene(tmp_path / "a.toml")[0]) == scene_digest(scene)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "linearly_implicit_euler", "implicit_midpoint"])
def test_integrators_that_cannot_keep_a_length_are_refused(integrator):
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": 1.0, "name": "line"}))
    rule = "^tendon 'line' of given length without a stiffness needs integrator implicit_euler or bdf2, without a tolerance"
    with pytest.raises(SimulationError, match=rule):
        simulator(scene, integrator)
    with pytest.raises(SimulationError, match=rule):
        ts.Simulator(scene, tolerance=1e-2)
    with pytest.raises(SceneError, match="^modes: tendon 'line' has a given length, but no stiffness: give it one$"):
        ts.modes(scene, 3)


def test_lengths_that_cannot_be_kept():
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": lambda t: 1.0 - 100 * t, "name": "line"}))
    with (
        simulator(scene) as sim,
        pytest.raises(SimulationError, match="'line': its path gave -0.666667 m at t = 0.0166667 s: a le"),
    ):
        sim.step()
        sim.step()
    scene = load(([(0.0, 1.45, 0.0), ("load", 3)], {"length": 1.0, "name": "line"}))
    scene.bodies[0].fix(lambda X: X[:, 1] > 0.4)
    with pytest.raises(
        SceneError, match="^tendon 'line': its length cannot be given, because its points are fixed or prescribed$"
    ):
        ts.solve_static(scene)
    apart = load(([(-1.0, 1.0, 0.0), TOP, (1.0, 1.0, 0.0)], {"length": 1.5, "name": "line"}))  # the pins are 2 m apart
    with simulator(apart, dt=0.01) as sim:
        report = sim.step()
        assert not report.converged and any("tendon 'line' is" in one and "instead of 1.5 m" in one for one in report.problems)
