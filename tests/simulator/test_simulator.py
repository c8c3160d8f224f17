"""The public interface of Simulator, explicit and implicit, with a quadratic and a linear body:

* state is returned as copies, in the order of the bodies; invalid state is refused; reports and stresses are the oracle's; a
  reset and a second simulator repeat results bit for bit;
* gravity, dt and material numbers take effect with the next step and compile nothing;
* invalid step counts are refused, and nothing changes;
* a step that fails names body and node and leaves the last good state, from which the next step starts;
* compression beyond the range of a softening law is warned of once, with the first tet;
* rotating, translating and scaling a scene does the same to its result, and the order of the bodies does not matter.
"""

import re
import warnings

import numpy as np
import pytest

import taisoft as ts
from tests.dynamics.scenes import SNH, SVK, cube, element, rubber
from tests.fem import oracle_laws as exact
from tests.fem.oracle import Oracle

DT = 0.002  # [s]
UPRIGHT = np.eye(3)


def pair(second_law: str = SVK, order: int = 1, degree: int | None = None) -> ts.Scene:
    """Two bodies: the first, of that order, is fixed at one end; the second is free. Damping is there to be changed."""
    scene = ts.Scene()
    scene.contact_forces = False  # they would take long to compile
    material, elements = rubber(SNH, mass_damping=0.5), element(order, degree)
    beam = scene.add_body(cube(cells=(2, 1, 1)), material, name="beam", position=(1, 2, 0), **elements)
    beam.fix(lambda X: X[:, 0] < -0.49)
    spin = np.random.default_rng(4).standard_normal((8, 3))
    scene.add_body(cube((4, 0, 0)), rubber(second_law, density=1200.0), name="flyer", velocity=spin)
    return scene


# integrator, order and quadrature of the first body
KINDS = [
    pytest.param((name, order, degree), id=f"{name}-{order}")
    for name, order, degree in (("symplectic_euler", 2, 4), ("implicit_euler", 2, 2))
]


@pytest.fixture(scope="module", params=KINDS)
def shared_sim(request):
    """Explicit with two laws, implicit with one, since that takes long to compile."""
    integrator, order, degree = request.param
    explicit = integrator == "symplectic_euler"
    tolerances = {} if explicit else {"newton_tolerance": 1e-12, "linear_tolerance": 1e-12}
    scene = pair(SVK if explicit else SNH, order, degree)
    with ts.Simulator(scene, DT, integrator, precision="f64", **tolerances) as made:
        made.advance(3)
        yield made


any_integrator = pytest.mark.parametrize("shared_sim", KINDS[:1], indirect=True)  # for tests that do not depend on it


@pytest.fixture
def beam(shared_sim) -> int:
    """Number of the beam's nodes, which come before the flyer's."""
    return shared_sim.scene.body("beam").n_nodes


@pytest.fixture
def sim(shared_sim):
    """In the initial state with the initial numbers, which are restored after the test."""

    def restore():
        shared_sim.set_gravity((0.0, -9.81, 0.0))
        shared_sim.set_material("beam", young=1e5, poisson=0.3, density=1000.0, mass_damping=0.5)
        shared_sim.dt = DT
        shared_sim.reset()

    restore()
    yield shared_sim
    restore()


def assert_steps_like(sim, oracle, steps: int = 3, dt: float = DT) -> None:
    """Step both and compare."""
    for _ in range(steps):
        sim.step()
        getattr(oracle, sim.settings.integrator)(dt)
    assert np.abs(sim.positions() - oracle.x).max() < 1e-11  # [m]
    assert np.abs(sim.velocities() - oracle.v).max() < 1e-9  # [m/s]


def test_the_initial_state_is_the_scenes(sim, beam):
    oracle, explicit = Oracle(sim.scene), sim.settings.explicit
    assert (sim.time, sim.step_count, sim.dt) == (0.0, 0, DT)
    assert np.array_equal(sim.positions(), oracle.rest) and np.array_equal(sim.velocities(), oracle.v)
    assert np.array_equal(sim.positions("flyer"), oracle.rest[beam:]) and sim.positions("beam").shape == (beam, 3)
    assert np.array_equal(sim.velocities("flyer"), oracle.v[beam:]) and sim.velocities().dtype == np.float64
    energies = sim.energies()
    assert energies.elastic == pytest.approx(0.0, abs=1e-9)
    assert energies.kinetic == pytest.approx(oracle.kinetic(oracle.v, explicit))
    assert energies.gravity == pytest.approx(oracle.weight(oracle.rest, explicit))
    assert not sim.reactions().any() or explicit


@any_integrator
def test_state_is_returned_as_copies(sim):
    x, v = sim.positions(), sim.velocities("flyer")
    x += 1.0
    v += 1.0
    assert np.abs(sim.positions() - x).min() > 0.9 and np.abs(sim.velocities("flyer") - v).min() > 0.9


def test_set_state_sets_all_but_constrained_velocities(sim, beam):
    before, rng = sim.positions(), np.random.default_rng(0)
    x, v = before[beam:] + 0.01, rng.standard_normal(before.shape)
    sim.set_state(positions=x, body="flyer")
    assert np.array_equal(sim.positions("flyer"), x) and np.array_equal(sim.positions("beam"), before[:beam])
    sim.set_state(velocities=v)
    fixed = np.zeros(len(v), dtype=bool)
    fixed[:beam] = sim.scene.body("beam").rest_positions[:, 0] < -0.49
    assert fixed.any() and np.array_equal(sim.velocities(), np.where(fixed[:, None], 0.0, v))
    oracle = Oracle(sim.scene)
    oracle.x, oracle.v = sim.positions(), sim.velocities()
    assert_steps_like(sim, oracle)


@any_integrator
@pytest.mark.parametrize(
    "state, message",
    [
        ({"positions": np.zeros((12, 3)), "body": "flyer"}, r"positions have shape \(12, 3\) .*: they must be \(8, 3\) numbers"),
        ({"positions": np.zeros(60)}, r"positions have shape \(60,\)"),
        ({"velocities": [["a"] * 3] * 51}, "velocities have shape .* type <U1: they must be"),
        ({"positions": np.zeros((51, 3)), "velocities": np.eye(51, 3) * np.nan}, "velocities: node 0 is not finite"),
        ({"positions": np.r_[np.zeros((7, 3)), [[0, np.inf, 0]]], "body": "flyer"}, "positions: node 7 is not finite"),
        ({"positions": np.zeros((51, 3)), "body": "flier"}, "no body is called 'flier'; did you mean 'flyer'"),
    ],
)
def test_invalid_states_are_refused(sim, state, message):
    x, v = sim.positions(), sim.velocities()
    with pytest.raises(ts.SceneError, match=message):
        sim.set_state(**state)
    assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), v)


def test_a_report_holds_the_oracles_energies_and_volume_ratios(sim, beam):
    x = sim.positions()
    x[beam:] = x[beam:] * [-0.9, 1.0, 1.0]  # the flyer is inverted
    sim.set_state(positions=x)
    report = sim.step()
    oracle, explicit = Oracle(sim.scene), sim.settings.explicit
    J, J_start = (oracle.volume_ratios(state)[0] for state in (sim.positions(), x))
    assert report.time == sim.time == pytest.approx(DT) and report.steps == sim.step_count == 1
    # the report of an explicit step covers the state at its start, too
    lowest = min(J, J_start) if explicit else J
    assert report.min_volume_ratio == pytest.approx(lowest) and report.n_inverted == 5
    assert report.problems == ["step 1: 5 tets are inverted"]
    assert report.elastic == pytest.approx(oracle.energy(sim.positions()))
    assert report.kinetic == pytest.approx(oracle.kinetic(sim.velocities(), explicit))
    assert report.gravity == pytest.approx(oracle.weight(sim.positions(), explicit))
    energies = sim.energies()
    assert energies.total == pytest.approx(report.elastic + report.kinetic + report.gravity)


@any_integrator
def test_the_report_of_a_batch_holds_its_extremes(sim, beam):
    x = sim.positions()
    x[beam:] = x[beam:] * [0.5, 1.0, 1.0]
    sim.set_state(positions=x)
    single = [sim.step().min_volume_ratio for _ in range(60)]
    sim.reset()
    sim.set_state(positions=x)
    report = sim.advance(60)
    assert report.steps == 60 and report.min_volume_ratio == min(single) < single[-1] - 0.1


@any_integrator
def test_stress_is_the_mean_cauchy_stress_of_a_tet(sim):
    """The mean over the deformed tet is that of P F^T over the tet at rest, divided by the volume ratio."""
    rng = np.random.default_rng(1)
    x = sim.positions() + 0.05 * rng.standard_normal(sim.positions().shape)
    sim.set_state(positions=x)
    oracle = Oracle(sim.scene)
    for part, name in zip(oracle.parts, ("beam", "flyer")):
        F, m, by_tet = oracle.gradients(x, part), part.material, (-1, part.points, 3, 3)
        w = part.weights[:, None, None]
        force = (w * (exact.pk1(m.law, F, m.young, m.poisson) @ exact.transposed(F))).reshape(by_tet).sum(axis=1)
        volume = (w[:, 0, 0] * np.linalg.det(F)).reshape(-1, part.points).sum(axis=1)
        sigma = force / volume[:, None, None]
        assert np.abs(sim.stress(name) - sigma).max() < 1e-11 * np.abs(sigma).max()
        assert np.abs(sim.stress(name) - exact.transposed(sim.stress(name))).max() < 1e-11 * np.abs(sigma).max()


@any_integrator
def test_force_differential_is_the_oracles(sim):
    rng = np.random.default_rng(1)
    rest = sim.positions()
    x, dx = rest + 0.05 * rng.standard_normal(rest.shape), rng.standard_normal(rest.shape)
    sim.set_state(positions=x)
    expected = -(Oracle(sim.scene).stiffness(x) @ dx.reshape(-1)).reshape(-1, 3)
    assert np.abs(sim.force_differential(dx) - expected).max() < 1e-11 * np.abs(expected).max()
    with pytest.raises(ts.SceneError, match="displacement have shape"):
        sim.force_differential(dx[:5])


def test_a_repeated_run_is_bitwise_the_same(sim):
    def run():
        sim.reset()
        for _ in range(5):
            sim.step()
        return sim.positions(), sim.velocities(), sim.reactions()

    assert all(np.array_equal(a, b) for a, b in zip(run(), run()))


@pytest.mark.parametrize("change", ["gravity", "dt", "young", "poisson", "density", "mass_damping"])
def test_changes_take_effect_without_compiling(sim, change):
    """Compared with an oracle of the changed scene; only the first upload of material numbers compiles."""
    beam = sim.scene.body("beam").material
    sim.set_material("beam", young=beam.young)
    sim.set_material("beam", density=beam.density)
    for _ in range(2):
        sim.step()
    unchanged = sim.positions() + sim.velocities() * DT
    compiled, numbers, dt = sim.compile_seconds, {}, DT
    if change == "gravity":
        sim.set_gravity((5.0, 0.0, -20.0))
    elif change == "dt":
        sim.dt = dt = 0.6 * DT
    else:
        numbers = {change: {"young": 2e5, "poisson": 0.1, "density": 1500.0, "mass_damping": 40.0}[change]}
        sim.set_material("beam", **numbers)
        assert getattr(sim.scene.body("beam").material, change) == numbers[change]
    oracle = Oracle(sim.scene)  # with the new numbers
    oracle.x, oracle.v = sim.positions(), sim.velocities()
    assert_steps_like(sim, oracle, 3, dt)
    assert sim.compile_seconds == compiled and sim.time == pytest.approx(2 * DT + 3 * dt)
    assert np.abs(sim.positions() - unchanged).max() > 1e-4


@any_integrator
def test_refused_changes_have_no_effect(sim):
    for bad, message in ((0.0, "dt must be greater than 0 s, not 0.0"), (np.nan, "dt must be finite, not nan")):
        with pytest.raises(ts.SimulationError, match=message):
            sim.dt = bad
    with pytest.raises(ts.SceneError, match="gravity must have shape"):
        sim.set_gravity((0, 1))
    with pytest.raises(ts.SceneError, match="body 'flyer': stiffness_damping was 0 everywhere"):
        sim.set_material("flyer", stiffness_damping=0.1)
    with pytest.raises(ts.SceneError, match="no body is called 'wing'"):
        sim.set_material("wing", young=1.0)
    beam = sim.scene.body("beam")
    assert_steps_like(sim, Oracle(pair(order=beam.order, degree=beam.quadrature_degree)))


@any_integrator
def test_changes_do_not_reach_the_users_scene(sim):
    """That the user's scene cannot change either is tested by test_frozen."""
    scene = pair()
    with ts.Simulator(scene, DT, "symplectic_euler", precision="f64") as other:
        other.set_gravity((0, 0, 0))
        other.set_material("beam", young=2e4)
        assert scene.gravity[1] == -9.81 and scene.body("beam").material.young == 1e5
        assert not other.scene.gravity.any() and other.scene.body("beam").material.young == 2e4


def test_invalid_step_counts_are_refused(sim):
    before = sim.positions(), sim.velocities(), sim.time, sim.step_count
    for n in (-1, 0, 2.5, True, np.True_, "3", float("nan"), None):
        with pytest.raises(ts.SimulationError, match=f"^n must be an integer of at least 1, not {re.escape(repr(n))}$"):
            sim.advance(n)
    assert all(np.array_equal(a, b) for a, b in zip(before, (sim.positions(), sim.velocities(), sim.time, sim.step_count)))
    assert sim.advance(np.int32(2)).steps == sim.step_count == (2 if sim.settings.explicit else 1)


def test_a_failed_step_leaves_the_last_good_state(sim, beam):
    sim.advance(1)
    x, v = sim.positions(), sim.velocities()
    wild = v.copy()
    wild[beam + 3] = 1e200
    sim.set_state(velocities=wild)
    named = "body 'flyer', node 3" if sim.settings.explicit else "body '"
    with pytest.raises(ts.SimulationError, match=f"^step 2: {named}.* no longer finite"):
        sim.step()
    assert sim.step_count == 1 and sim.time == pytest.approx(DT)
    assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), wild)
    sim.set_state(velocities=v)
    oracle = Oracle(sim.scene)
    oracle.x, oracle.v = x, v
    assert_steps_like(sim, oracle)


def add_pair(scene: ts.Scene, name: str, Q=UPRIGHT, shift=(0.0, 0.0, 0.0), size: float = 1.0, reverse: bool = False) -> None:
    """A loaded pair, quadratic and linear, rotated, translated and scaled at constant time: lengths, velocities and
    accelerations scale with the size and stresses stay, so the density scales with 1/size^2.
    """
    for body in pair(order=2).bodies[:: -1 if reverse else 1]:
        mesh = ts.TetMesh(size * (body.mesh.vertices + body.position) @ Q.T + shift, body.mesh.tets)
        material = rubber(SNH, density=body.material.density / size**2)  # one law, and no damping, which would set a time scale
        velocity = size * body.velocity @ Q.T
        made = scene.add_body(mesh, material, name=f"{name} {body.name}", velocity=velocity, order=body.order)
        if body.name == "beam":
            made.fix(body.rest_positions[:, 0] < -0.49)
            end = body.mesh.vertices[body.mesh.surface].mean(axis=1)[:, 0] > 0.49
            made.add_traction(end, Q @ [0.0, 900.0, 500.0])
            made.add_force([5, 6], Q @ [40.0, 0.0, 0.0] * size**2)


def test_rotation_translation_and_scaling_carry_over_to_the_result():
    """Of 30 explicit steps; the order of the bodies does not change a bit."""
    Q = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    Q, shift, scene = Q * np.linalg.det(Q), np.array([30.0, -20.0, 10.0]), ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    add_pair(scene, "plain")
    add_pair(scene, "moved", Q, shift)
    add_pair(scene, "large", size=2.0)
    add_pair(scene, "again", reverse=True)
    with ts.Simulator(scene, DT, "symplectic_euler", precision="f64") as sim:
        sim.advance(30)
        found = {body.name: (sim.positions(body.name), sim.velocities(body.name)) for body in scene.bodies}
    assert np.abs(found["plain beam"][0] - scene.body("plain beam").rest_positions).max() > 0.001  # [m] it bends
    for body in ("beam", "flyer"):
        x, v = found[f"plain {body}"]
        for name, expected in (("moved", (x @ Q.T + shift, v @ Q.T)), ("large", (2 * x, 2 * v))):
            assert all(np.abs(a - b).max() < 1e-11 for a, b in zip(found[f"{name} {body}"], expected))
        assert all(np.array_equal(a, b) for a, b in zip(found[f"again {body}"], (x, v)))


def test_a_rotated_state_gives_a_rotated_result(sim):
    """Objectivity: the rest shape stays; positions, velocities and gravity are rotated about the origin."""
    Q = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    Q = Q * np.linalg.det(Q)
    x, v = sim.positions(), sim.velocities()
    for _ in range(5):
        sim.step()
    expected = sim.positions() @ Q.T, sim.velocities() @ Q.T, sim.reactions() @ Q.T
    sim.reset()
    sim.set_gravity(Q @ [0.0, -9.81, 0.0])
    sim.set_state(x @ Q.T, v @ Q.T)
    for _ in range(5):
        sim.step()
    assert np.abs(sim.positions() - expected[0]).max() < 1e-10  # [m]
    assert np.abs(sim.velocities() - expected[1]).max() < 1e-8  # [m/s]
    assert np.abs(sim.reactions() - expected[2]).max() < 1e-6 * np.abs(expected[2]).max()


@pytest.mark.parametrize("integrator", ["implicit_euler", "symplectic_euler"])
def test_softening_is_warned_of_once(integrator):
    scene = ts.Scene(gravity=(0, 0, 0))
    for law, x in ((SNH, 0.0), (SVK, 3.0)):
        scene.add_body(cube(cells=(2, 1, 1)), rubber(law), name=law, position=(x, 0, 0))
    scene.contact_forces = False
    with ts.Simulator(scene, 1e-5, integrator, precision="f64") as sim:
        rest = sim.positions()
        messages = []
        for stretch in (0.65, 0.55, 0.5):
            sim.set_state(rest * (1.0, stretch, 1.0))
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always", UserWarning)
                sim.step()
            messages.append([str(one.message) for one in found])
    assert [len(texts) for texts in messages] == [0, 1, 0]
    assert messages[1][0].startswith(f"step 2: tet 0 of body '{SVK}' is compressed below 0.6 of its length")
