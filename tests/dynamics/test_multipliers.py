"""Lagrange multipliers: cavities of given pressure and volume, tendons of given tension and length, elastic and inextensible.

* a given pressure acts as `add_pressure` does; volumes and pressures can be asked for; the gradient of a volume;
* a given volume is kept to 1e-6 in statics, also where the pressure falls as the volume grows, and in steps; a given pressure of
  the size found gives back the volume; changes while it runs, checkpoints, refinement, and what is refused;
* tendons (changes and checkpoints: tests/simulator): equilibria in closed form; which tendons slacken; length and tension in
  motion: a fall that ends, contacts, a pulley that moves; energies of elastic ones; signs; what cannot keep a length.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.pressure import cavity_form
from taisoft.linear.bordered import solve_active
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import refined, with_order
from tests.dynamics.companion import LOOSE, add_companion, simulator
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_springs import shape_row
from tests.fem.shells import hold_planes, inside, thick_sphere

MESH = thick_sphere(1.0, 2.0, 2, 1, whole=True)
OUTSIDE = np.setdiff1d(np.arange(len(MESH.surface)), inside(MESH, 1.0))
BALL = 4.0 / 3.0 * np.pi  # [m^3] of the cavity at rest
VOLUME_KEPT = 1e-6  # of the volume


def bare(order: int = 1, held: bool = True, mesh: ts.TetMesh = MESH, **cavity) -> ts.Scene:
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.contact_forces = False
    body = scene.add_body(mesh, rubber(), name="ball", order=order)
    if held:
        hold_planes(body)
    if cavity:
        body.add_cavity(inside(mesh, 1.0), **cavity)
    return scene


def balloon(attached: bool = False, **arguments) -> ts.Scene:
    """attached: whether the companion has attachments, as in all scenes whose steps are tested, or not, as in statics."""
    return add_companion(bare(**arguments), attached)


def test_a_given_pressure_is_add_pressure():
    scene, other = balloon(pressure=8e3, name="air"), balloon()
    other.body("ball").add_pressure(inside(MESH, 1.0), 8e3)
    found, wanted = ts.solve_static(scene), ts.solve_static(other)
    assert found.converged and np.array_equal(found.positions(), wanted.positions())
    assert found.cavity_pressure("air") == 8e3 and found.cavity_volume("air") > 1.1 * BALL
    with simulator(balloon(True, pressure=8e3, name="air"), "velocity_verlet", 1e-3) as sim:
        assert sim.cavity_volume("air") == pytest.approx(BALL, rel=1e-12) and sim.cavity_pressure("air") == 8e3
        for _ in range(5):
            sim.step()
        assert sim.energies().loads == pytest.approx(-8e3 * sim.cavity_volume("air")) and sim.cavity_volume("air") > 1.0002 * BALL
        sim.set_cavity("air", 2e3)
        assert sim.cavity_pressure("air") == 2e3


def test_static_volumes():
    """The pressure rises, and falls beyond its largest value; given as such, it leads to the same volume."""
    pressures = []
    for ratio in (1.0, 1.5, 8.0, 40.0):
        found = ts.solve_static(balloon(volume=ratio * BALL, name="water"))
        assert found.converged and found.load_steps == 1 and found.iterations <= 20
        assert found.cavity_volume("water") == pytest.approx(ratio * BALL, rel=VOLUME_KEPT)
        pressures.append(found.cavity_pressure("water"))
    assert abs(pressures[0]) < 1.0 and 5e3 < pressures[1] < pressures[2] and pressures[3] < pressures[2]
    again = ts.solve_static(balloon(pressure=pressures[1], name="air"), tolerance=1e-8)
    assert again.cavity_volume("air") == pytest.approx(1.5 * BALL, rel=1e-5)


@pytest.mark.parametrize("order", [1, 2])
def test_the_gradient_of_a_volume(order):
    scene = bare(order=order, volume=BALL, name="water")
    body, form, rng = scene.body("ball"), cavity_form(scene, "water"), np.random.default_rng(3)
    assert form.value_and_gradient(body.rest_positions)[0] == pytest.approx(BALL, rel=1e-12)
    x, way = body.rest_positions + 0.05 * rng.standard_normal((body.n_nodes, 3)), rng.standard_normal((body.n_nodes, 3))
    slope = (form.value_and_gradient(x + 1e-4 * way)[0] - form.value_and_gradient(x - 1e-4 * way)[0]) / 2e-4
    assert (form.value_and_gradient(x)[1] * way[form.nodes]).sum() == pytest.approx(slope, rel=1e-6)
    assert np.abs(form.value_and_gradient(x)[1].sum(axis=0)).max() < 1e-10  # a translation changes no volume


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_steps_keep_volumes(integrator):
    scene = balloon(True, held=False, volume=lambda t: BALL * (1.0 + 3.0 * t), name="water")
    scene.gravity = (0.0, -9.81, 0.0)
    with simulator(scene, integrator, 0.01, **LOOSE) as sim:
        for _ in range(6):
            report = sim.step()
            assert report.converged and sim.cavity_volume("water") == pytest.approx(BALL * (1 + 3 * sim.time), rel=VOLUME_KEPT)
        assert sim.cavity_pressure("water") > 1e3
        fall = sim.velocities("ball")[:, 1].mean()
        assert sim.energies().loads == 0.0 and fall == pytest.approx(-9.81 * sim.time, rel=0.05)


def test_changes_and_checkpoints(tmp_path):
    given = {"volume": 1.2 * BALL, "name": "water"}
    with simulator(balloon(True, **given), "implicit_euler", 0.01, **LOOSE) as sim:
        sim.step()
        sim.set_cavity("water", 1.3 * BALL)
        assert sim.step().converged
        assert sim.cavity_volume("water") == pytest.approx(1.3 * BALL, rel=VOLUME_KEPT)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.step()
        wanted = sim.positions(), sim.cavity_pressure("water")
        with pytest.raises(SceneError, match="volume must be above 0, not -1"):
            sim.set_cavity("water", -1.0)
        for integrator in ("velocity_verlet", "linearly_implicit_euler", "implicit_midpoint"):
            with pytest.raises(SimulationError, match="cavity 'water' of given volume needs integrator implicit_euler or bdf2"):
                sim.rebuild(integrator=integrator)
        sim.reset()
        assert sim.cavity_pressure("water") == 0.0
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", balloon(True, **given)) as sim:
        sim.step()
        assert np.array_equal(sim.positions(), wanted[0]) and sim.cavity_pressure("water") == wanted[1]


def test_refinement_and_fingerprints():
    """Scene files: tests/scene/test_toml_round_trips."""
    scene = bare(volume=ts.KeyFrames((0.0, 1.0), values=(BALL, 2 * BALL)), name="water")
    for change in (refined, lambda one: with_order(one, 2)):
        new = change(scene).cavity("water")[1]
        assert new.rest_volume == pytest.approx(BALL) and new.path.frames is scene.cavity("water")[1].path.frames
    assert scene_digest(bare(pressure=1.0)) != scene_digest(bare(volume=1.0))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"pressure": 1.0, "volume": 1.0}, "give either a pressure or a volume"),
        ({"volume": 0.0}, "volume must be above 0, not 0"),
        ({"volume": lambda t: t - 1.0}, "volume must be above 0, not -1"),
        ({"volume": (1.0, 2.0)}, "volume must be a number, not of shape .2,."),
        ({"volume": 1.0, "where": [0, 1]}, "the chosen triangles have a border"),
        ({"volume": 1.0, "where": OUTSIDE}, "the normals of the chosen triangles point outward"),
    ],
)
def test_bad_cavities_are_refused(arguments, message):
    body = bare().bodies[0]
    with pytest.raises(SceneError, match=f"^body 'ball': add_cavity: {message}"):
        body.add_cavity(**{"where": inside(MESH, 1.0), **arguments})
    assert body.cavities == ()


def test_cavities_must_not_overlap_and_have_names_of_their_own():
    scene = bare(volume=BALL, name="water")
    body, triangle = scene.bodies[0], inside(MESH, 1.0).min()
    rule = f"body 'ball': add_cavity: surface triangle {triangle} of cavity 'air' belongs to cavity 'water'"
    with pytest.raises(SceneError, match=rule):
        body.add_cavity(inside(MESH, 1.0), pressure=1.0, name="air")
    assert [cavity.name for cavity in body.cavities] == ["water"]
    other = scene.add_body(MESH, rubber(), name="other", position=(5, 0, 0))
    other.add_cavity(inside(MESH, 1.0), pressure=1.0, name="water")
    with pytest.raises(SceneError, match="body 'other': cavity name 'water' is taken"):
        scene.check()


def test_a_volume_whose_surface_cannot_move_is_refused():
    scene = bare(held=False, volume=BALL, name="water")
    near = np.flatnonzero(np.linalg.norm(scene.bodies[0].rest_positions, axis=1) < 1.1)
    scene.bodies[0].fix(near[::2])
    scene.bodies[0].move(near[1::2], lambda t: (t, 0.0, 0.0))
    for build in (ts.solve_static, lambda one: simulator(one, "implicit_euler", 0.01)):
        with pytest.raises(SceneError, match="cavity 'water': its volume cannot be given, because its surface is fixed"):
            build(scene)


WEIGHT = 990 * 9.81
KEPT = {"inextensible": None, "elastic": 2e4}
ACCURATE = 2e-6  # of the length that an inextensible tendon keeps
TOP = ("load", (0.0, 0.45, 0.0))


def load(*lines, attached: bool = True, **material) -> ts.Scene:
    """A cube that tendons between points of a ceiling hold. lines: arguments of add_tendon, whose points may be a position."""
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(cube(), rubber(**material), name="load")
    scene.add_obstacle(ts.HalfSpace((0, 99, 0), (0, -1, 0)), name="ceiling")
    for points, numbers in lines:
        scene.add_tendon([point if len(point) == 2 else ("ceiling", point) for point in points], **numbers)
    return add_companion(scene, attached)


def held_point(scene: ts.Scene, x: np.ndarray) -> np.ndarray:
    """Where the point TOP is (3,). x: positions of the load."""
    return shape_row(scene.body("load"), np.array(TOP[1])) @ x


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
    scene = load(([left, TOP, right], {"name": "line", **given}), attached=False)
    result = ts.solve_static(scene, tolerance=1e-10)
    first = 0.5 * (total + (left - right)[1] / cosine)
    expected = left + first * np.array([sine, -cosine, 0.0])
    assert result.converged and result.tension("line") == pytest.approx(tension, rel=1e-5)
    assert sum(np.linalg.norm(end - expected) for end in (left, right)) == pytest.approx(total, rel=1e-9)
    assert held_point(scene, result.positions("load")) == pytest.approx(expected, abs=1e-5)
    with pytest.raises(SceneError, match=r"^tension: no spring or tendon is called 'lin' \(did you mean line\?\); there are "):
        result.tension("lin")


@pytest.mark.parametrize("penalised", [False, True])
def test_which_tendons_slacken_is_found(penalised):
    """The solution of random problems min y.A y / 2 + r.y with constraints G y >= c, or G y = c where two-sided, is optimal."""
    rng, found = np.random.default_rng(3), set()
    one_sided = np.array([True, True, False])
    for _ in range(60):
        B, G, missing, r = (rng.standard_normal(shape) for shape in ((7, 7), (3, 7), 3, 7))  # r: residual with the values
        A, values = B @ B.T + 0.1 * np.eye(7), rng.standard_normal(3)
        values[one_sided] = np.maximum(values[one_sided], 0.0)
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
        for _ in range(10):
            report = sim.step()
            assert report.converged, report.problems
            tensions.append(sim.joint_force("line"))
            length = 1.45 - held_point(scene, sim.positions("load"))[1]
            assert length < 1.2 * (1 + ACCURATE) and (tensions[-1] == 0.0 or length > 1.2 * (1 - ACCURATE))
        assert max(tensions) > 1.5 * WEIGHT


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
    scene = load()
    scene.add_spring(("load", 0), ("load", 4), 100.0, rest_length=1.5, damping=2.0, name="s")
    with simulator(scene, "velocity_verlet", 1e-4) as sim:
        x, v = sim.positions("load"), np.zeros((8, 3))
        length = np.linalg.norm(x[0] - x[4])
        v[4] = 3 * (x[4] - x[0]) / length
        sim.set_state(velocities=v, body="load")
        assert sim.joint_force("s") == pytest.approx(100 * (length - 1.5) + 6.0, rel=1e-12) and sim.joint_force("s") < 0
        message = r"joint_force: no spring, tendon or attachment is called 'ss' \(did you mean s\?\)"
        with pytest.raises(SceneError, match=message):
            sim.joint_force("ss")


@pytest.mark.parametrize("stiffness", [None, 1e6])
def test_a_pulley_lifts_a_load(stiffness):
    lift = ts.KeyFrames((0.0, 0.2), translations=[(0, 0, 0), (0, 0.1, 0)], smooth=True)
    scene = load(young=1e6, mass_damping=20.0)
    scene.add_obstacle(ts.Sphere((0, 5, 0), 1.0), name="pulley", path=lift)
    line = [TOP, ("pulley", (0.0, 4.0, 0.0)), ("pulley", (1.0, 4.0, 0.0)), ("ceiling", (1.0, 1.0, 0.0))]
    scene.add_tendon(line, length=3.55 + 1.0 + 3.0, stiffness=stiffness, name="line")
    with simulator(scene, "implicit_euler", 1 / 60, **LOOSE) as sim:
        for _ in range(50):
            report = sim.step()
            assert report.converged, report.problems
        extension = 0.0 if stiffness is None else WEIGHT / stiffness
        # its other side has the same length more
        assert held_point(scene, sim.positions("load"))[1] == pytest.approx(0.45 + 2 * 0.1 - extension, abs=1e-4)
        assert sim.joint_force("line") == pytest.approx(WEIGHT, rel=2e-3)
        if stiffness is None:
            assert sim.energies().loads == 0.0  # a multiplier has no potential
            sim.set_length("line", 7.65)
            sim.run(seconds=0.4, fps=None)
            assert held_point(scene, sim.positions("load"))[1] == pytest.approx(0.55, abs=1e-5)


def test_lengths_that_cannot_be_kept():
    """Other integrators: tests/simulator/test_settings."""
    scene = load(([(0.0, 1.45, 0.0), ("load", 3)], {"length": 1.0, "name": "line"}), attached=False)
    scene.body("load").fix(lambda X: X[:, 1] > 0.4)
    message = "^tendon 'line': its length cannot be given, because its points are fixed or prescribed$"
    with pytest.raises(SceneError, match=message):
        ts.solve_static(scene)
    with pytest.raises(SceneError, match="^modes: tendon 'line' has a given length, but no stiffness: give it one$"):
        ts.modes(scene, 3)
    late = load(([(0.0, 1.45, 0.0), TOP], {"length": lambda t: 1.0 - 100 * t, "name": "line"}))
    message = "'line': its path gave -0.666667 m at t = 0.0166667 s: a le"
    with simulator(late, "implicit_euler", 1 / 60, **LOOSE) as sim, pytest.raises(SimulationError, match=message):
        sim.step()
    apart = load(([(-1.0, 1.0, 0.0), TOP, (1.0, 1.0, 0.0)], {"length": 1.5, "name": "line"}))  # the pins are 2 m apart
    with simulator(apart, "implicit_euler", 0.01, **LOOSE) as sim:
        report = sim.step()
        assert not report.converged and any("tendon 'line' is" in one and "instead of 1.5 m" in one for one in report.problems)
        assert sim.joint_force("line") == 0.0  # the multipliers of a step that failed are not kept
