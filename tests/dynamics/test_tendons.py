"""Tendons of given tension and of given length, elastic and inextensible:

* equilibria in closed form; the small problem of which tendons slacken;
* length and tension in motion: a fall that a tendon ends, winding, contacts; energies of elastic ones;
* a pulley that moves;
* signs of tensions; what cannot keep a length (changes and checkpoints: tests/simulator).
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError, SimulationError
from taisoft.linear.bordered import solve_active
from tests.dynamics.companion import LOOSE, add_companion, simulator
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_springs import shape_row

WEIGHT = 990 * 9.81
KEPT = {"inextensible": None, "elastic": 2e4}
ACCURATE = 2e-6  # of the length that an inextensible tendon keeps
TOP = ("load", (0.0, 0.45, 0.0))


def load(*lines, velocity=(0.0, 0.0, 0.0), gravity=(0.0, -9.81, 0.0), **material) -> ts.Scene:
    """A cube that tendons between points of a ceiling hold. lines: arguments of add_tendon, whose points may be a position."""
    scene = ts.Scene(gravity=gravity)
    scene.contact_forces = False
    scene.add_body(cube(), rubber(**material), name="load", velocity=velocity)
    scene.add_obstacle(ts.HalfSpace((0, 99, 0), (0, -1, 0)), name="ceiling")
    for points, numbers in lines:
        scene.add_tendon([point if len(point) == 2 else ("ceiling", point) for point in points], **numbers)
    return add_companion(scene)


def held_point(scene: ts.Scene, x: np.ndarray) -> np.ndarray:
    """Where the point TOP is (3,). x: positions of the load."""
    return shape_row(scene.body("load"), np.array(TOP[1])) @ x


# --- equilibria -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*KEPT, "tension"])
def test_a_load_slides_to_where_both_segments_are_equally_steep(kind):
    left, right, length = np.array([-1.0, 1.5, 0.0]), np.array([1.3, 1.9, 0.0]), 3.5
    if kind == "tension":
        tension = 0.9 * WEIGHT
        cosine = WEIGHT / (2 * tension)  # of the angle with the vertical, in both segments
        sine = np.sqrt(1 - cosine**2)
        total, given = (right - left)[0] / sine, {"force": tension}
    else:
        given, total = {"length": length, "stiffness": KEPT[kind]}, length
        for _ in range(100):  # the extension depends on the tension
            sine = (right - left)[0] / total
            cosine = np.sqrt(1.0 - sine**2)
            tension = WEIGHT / (2 * cosine)
            total = length + (0.0 if KEPT[kind] is None else tension / KEPT[kind])
    scene = load(([left, TOP, right], {"name": "line", **given}))
    result = ts.solve_static(scene, tolerance=1e-10)
    first = 0.5 * (total + (left - right)[1] / cosine)
    expected = left + first * np.array([sine, -cosine, 0.0])
    assert result.converged and result.tension("line") == pytest.approx(tension, rel=1e-5)
    assert sum(np.linalg.norm(end - expected) for end in (left, right)) == pytest.approx(total, rel=1e-9)
    assert held_point(scene, result.positions("load")) == pytest.approx(expected, abs=1e-5)
    with pytest.raises(SceneError, match=r"^tension: no spring or tendon is called 'lin' \(did you mean line\?\)$"):
        result.tension("lin")


@pytest.mark.parametrize("penalised", [False, True])
def test_which_tendons_slacken_is_found(penalised):
    """The solution of random problems min y.A y / 2 + r.y with constraints G y >= c, or G y = c where two-sided, is optimal."""
    rng, found = np.random.default_rng(3), set()
    one_sided = np.array([True, True, False])
    for _ in range(60):
        B, G, missing, r = (rng.standard_normal(shape) for shape in ((7, 7), (3, 7), 3, 7))  # r: residual with the values
        A, values = (
            B @ B.T + 0.1 * np.eye(7),
            np.where(one_sided, np.maximum(rng.standard_normal(3), 0.0), rng.standard_normal(3)),
        )
        penalty = rng.uniform(0.1, 5.0, 3) if penalised else np.zeros(3)
        shifted = values + penalty * missing
        shift = np.where(one_sided, np.maximum(shifted, 0.0), shifted) - values
        stiffened = A + G.T @ (penalty[:, None] * G)
        y_0, z = np.linalg.solve(stiffened, G.T @ shift - r), np.linalg.solve(stiffened, G.T).T
        s, new = solve_active(G @ z.T, G @ y_0, missing, values, shift, penalty, one_sided)
        y = y_0 + s @ z
        size = 1.0 + np.abs(new).max()
        assert np.abs(A @ y + r - G.T @ (new - values)).max() < 1e-9 * size  # the gradient of the Lagrangian
        slack, beyond = new == 0.0, G @ y - missing
        assert (new[one_sided] >= 0.0).all() and (np.abs(beyond[~slack]) < 1e-8 * size).all()
        assert (beyond[one_sided] > -1e-8 * size).all()
        found.add(tuple(slack))
    assert len(found) == 4  # each of the two slackened and did not


# --- motion ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_a_fall_ends_where_the_tendon_tightens(integrator):
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": 1.2, "name": "line"}))
    dt, n = 1 / 100, 0
    with simulator(scene, integrator, dt, **LOOSE) as sim:
        while sim.joint_force("line") == 0.0:
            before = sim.positions("load")
            assert sim.step().converged
            n += 1
        if integrator == "implicit_euler":
            fallen = 0.5 * 9.81 * dt**2 * (n - 1) * n
            assert before[:, 1] == pytest.approx(cube().vertices[:, 1] - fallen, abs=1e-6)
        assert 18 <= n <= 24  # sqrt(2 * 0.2 / g) is 0.202 s
        tensions = []
        for _ in range(15):
            report = sim.step()
            assert report.converged, report.problems
            tensions.append(sim.joint_force("line"))
            length = 1.45 - held_point(scene, sim.positions("load"))[1]
            assert length < 1.2 * (1 + ACCURATE) and (tensions[-1] == 0.0 or length > 1.2 * (1 - ACCURATE))
        assert max(tensions) > 1.5 * WEIGHT


def test_a_winch_lifts_a_load():
    winding = ts.KeyFrames((0.0, 0.25), values=(1.0, 0.8), smooth=True)
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": winding, "name": "line"}), young=1e6, mass_damping=20.0)
    with simulator(scene, "implicit_euler", 1 / 60, **LOOSE) as sim:
        result = sim.run(seconds=1.0, fps=None)
        assert result.status == "ok", result.problems
        assert held_point(scene, sim.positions("load"))[1] == pytest.approx(1.45 - 0.8, abs=2e-6)
        assert sim.joint_force("line") == pytest.approx(WEIGHT, rel=2e-3)
        assert sim.energies().loads == 0.0  # a multiplier has no potential
        sim.set_length("line", 0.9)
        sim.run(seconds=0.5, fps=None)
        assert held_point(scene, sim.positions("load"))[1] == pytest.approx(1.45 - 0.9, abs=2e-6)


def test_a_tendon_relieves_a_contact():
    """Under a pressure on all sides, and with a spring that does not pull: the ground carries what the tendon does not."""
    scene = ts.Scene()
    body = scene.add_body(cube((0, 0.4501, 0)), rubber(mass_damping=30.0), name="load")
    body.add_pressure(lambda c: np.ones(len(c), dtype=bool), 1e3)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    winding = ts.KeyFrames((0.0, 0.1), values=(1.0, 0.98))
    scene.add_tendon([("ground", (0.0, 1.9, 0.0)), ("load", (0.0, 0.9, 0.0))], length=winding, name="line")
    with simulator(add_companion(scene, attached=True), "implicit_euler", 1 / 60, **LOOSE) as sim:
        for _ in range(45):
            report = sim.step()
            assert report.converged, report.problems
        assert report.n_contacts > 0
        tension, contact = sim.joint_force("line"), sim.contact_force("load")[1]
        assert 0.1 * WEIGHT < tension < 0.9 * WEIGHT and tension + contact == pytest.approx(WEIGHT, rel=5e-3)
        top = shape_row(body, np.array((0.0, 0.9, 0.0))) @ sim.positions("load")
        assert top[1] == pytest.approx(1.9 - 0.98, abs=2e-6)


def test_energies_of_an_elastic_tendon():
    """A load that bounces on it keeps its energy, half the stiffness times its squared extension of it in the tendon."""
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": 1.1, "stiffness": 5e4, "name": "line"}), young=1e6)
    with simulator(scene, "velocity_verlet", 2e-4) as sim:
        start = sim.energies()
        result = sim.run(seconds=0.2, fps=None)
        assert result.status == "ok", result.problems
        extension = 1.45 - held_point(scene, sim.positions("load"))[1] - 1.1
        assert extension > 0.05 and sim.joint_force("line") == pytest.approx(5e4 * extension, rel=1e-9)
        now, own = sim.energies(), 0.5 * 5e4 * extension**2
        assert now.loads == 0.0 and now.total == pytest.approx(start.total, abs=1e-3 * own)
        sim.set_length("line", 9.0)
        assert now.elastic - sim.energies().elastic == pytest.approx(own, rel=1e-9)


def test_tensions_have_a_sign_and_damping():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.add_body(cube(), rubber(), name="a")
    scene.add_spring(("a", 0), ("a", 4), 100.0, rest_length=1.5, damping=2.0, name="s")
    with simulator(add_companion(scene), "symplectic_euler", 1e-4) as sim:
        x, v = sim.positions("a"), np.zeros((8, 3))
        length = np.linalg.norm(x[0] - x[4])
        v[4] = 3 * (x[4] - x[0]) / length
        sim.set_state(velocities=v, body="a")
        assert sim.joint_force("s") == pytest.approx(100 * (length - 1.5) + 6.0, rel=1e-12) and sim.joint_force("s") < 0
        message = r"joint_force: no spring, tendon or attachment is called 'ss' \(did you mean s\?\)"
        with pytest.raises(SceneError, match=message):
            sim.joint_force("ss")


@pytest.mark.parametrize("stiffness", [None, 1e6])
def test_a_pulley_lifts_a_load(stiffness):
    lift = ts.KeyFrames((0.0, 0.2), translations=[(0, 0, 0), (0, 0.1, 0)], smooth=True)
    scene = ts.Scene()
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(young=1e6, mass_damping=20.0), name="load")
    scene.add_obstacle(ts.Sphere((0, 5, 0), 1.0), name="pulley", path=lift)
    scene.add_obstacle(ts.HalfSpace((0, 99, 0), (0, -1, 0)), name="wall")
    line = [TOP, ("pulley", (0.0, 4.0, 0.0)), ("pulley", (1.0, 4.0, 0.0)), ("wall", (1.0, 1.0, 0.0))]
    scene.add_tendon(line, length=3.55 + 1.0 + 3.0, stiffness=stiffness, name="line")
    with simulator(add_companion(scene), "implicit_euler", 1 / 60, **LOOSE) as sim:
        for _ in range(60):
            report = sim.step()
            assert report.converged, report.problems
        extension, weight = (0.0 if stiffness is None else WEIGHT / stiffness), body.mass * 9.81
        # its other side has the same length more
        assert held_point(scene, sim.positions("load"))[1] == pytest.approx(0.45 + 2 * 0.1 - extension, abs=1e-4)
        assert sim.joint_force("line") == pytest.approx(weight, rel=2e-3)


# --- refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["velocity_verlet", "linearly_implicit_euler", "implicit_midpoint"])
def test_integrators_that_cannot_keep_a_length_are_refused(integrator):
    scene = load(([(0.0, 1.45, 0.0), TOP], {"length": 1.0, "name": "line"}))
    rule = "^tendon 'line' of given length without a stiffness needs integrator implicit_euler or bdf2, without a tolerance"
    for call in (lambda: simulator(scene, integrator, 1e-4), lambda: ts.Simulator(scene, tolerance=1e-2)):
        with pytest.raises(SimulationError, match=rule):
            call()
    with pytest.raises(SceneError, match="^modes: tendon 'line' has a given length, but no stiffness: give it one$"):
        ts.modes(scene, 3)


def test_lengths_that_cannot_be_kept():
    scene = load(([(0.0, 1.45, 0.0), ("load", 3)], {"length": 1.0, "name": "line"}))
    scene.body("load").fix(lambda X: X[:, 1] > 0.4)
    message = "^tendon 'line': its length cannot be given, because its points are fixed or prescribed$"
    with pytest.raises(SceneError, match=message):
        ts.solve_static(scene)
    late = load(([(0.0, 1.45, 0.0), TOP], {"length": lambda t: 1.0 - 100 * t, "name": "line"}))
    message = "'line': its path gave -0.666667 m at t = 0.0166667 s: a le"
    with simulator(late, "implicit_euler", 1 / 60, **LOOSE) as sim, pytest.raises(SimulationError, match=message):
        sim.step()
    apart = load(([(-1.0, 1.0, 0.0), TOP, (1.0, 1.0, 0.0)], {"length": 1.5, "name": "line"}))  # the pins are 2 m apart
    with simulator(apart, "implicit_euler", 0.01, **LOOSE) as sim:
        report = sim.step()
        assert not report.converged and any("tendon 'line' is" in one and "instead of 1.5 m" in one for one in report.problems)
        assert sim.joint_force("line") == 0.0  # the multipliers of a step that failed are not kept
