"""The public interface of Simulator, explicit and implicit: state, reports and stresses are the oracle's; changes act with the
next step and compile nothing, refused ones change nothing; a failed step leaves the last good state; a closed simulator refuses
calls.
"""

import gc
import re
import tracemalloc
import warnings

import numpy as np
import pytest

import taisoft as ts
from taisoft.attributes import SimulationAttributeError
from tests.dynamics.scenes import SVK, block_scene, rubber
from tests.fem import oracle_laws as exact
from tests.fem.oracle import Oracle
from tests.simulator.scenes import DT, pair, simulator

BEAM = 12  # nodes of the beam, which come before the flyer's
VERLET, EULER = "velocity_verlet", "implicit_euler"


@pytest.fixture(scope="module", params=[VERLET, EULER])
def shared_sim(request):
    with simulator(request.param) as made:
        made.advance(3)
        yield made


@pytest.fixture
def sim(shared_sim):
    """In the initial state with the initial numbers, which are restored after the test."""

    def restore():
        shared_sim.set_gravity((0.0, -9.81, 0.0))
        damping = {"mass_damping": 0.5} if shared_sim.settings.explicit else {}
        shared_sim.set_material("beam", young=1e5, poisson=0.3, density=1000.0, **damping)
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


def test_the_initial_state_is_the_scenes(sim):
    oracle, explicit = Oracle(sim.scene), sim.settings.explicit
    assert (sim.time, sim.step_count, sim.dt) == (0.0, 0, DT)
    assert np.array_equal(sim.positions(), oracle.rest) and np.array_equal(sim.velocities(), oracle.v)
    assert np.array_equal(sim.positions("flyer"), oracle.rest[BEAM:]) and sim.positions("beam").shape == (BEAM, 3)
    assert np.array_equal(sim.velocities("flyer"), oracle.v[BEAM:]) and sim.velocities().dtype == np.float64
    energies = sim.energies()
    assert energies.elastic == pytest.approx(0.0, abs=1e-9)
    assert energies.kinetic == pytest.approx(oracle.kinetic(oracle.v, explicit))
    assert energies.gravity == pytest.approx(oracle.weight(oracle.rest, explicit))
    for query in (sim.positions, sim.velocities):
        query()[:] = 9.0  # a copy
    assert np.array_equal(sim.positions(), oracle.rest) and np.array_equal(sim.velocities(), oracle.v)


def test_set_state_sets_all_but_constrained_velocities(sim):
    before, rng = sim.positions(), np.random.default_rng(0)
    x, v = before[BEAM:] + 0.01, rng.standard_normal(before.shape)
    sim.set_state(positions=x, body="flyer")
    assert np.array_equal(sim.positions("flyer"), x) and np.array_equal(sim.positions("beam"), before[:BEAM])
    sim.set_state(velocities=v)
    fixed = np.zeros(len(v), dtype=bool)
    fixed[:BEAM] = sim.scene.body("beam").rest_positions[:, 0] < -0.49
    assert fixed.any() and np.array_equal(sim.velocities(), np.where(fixed[:, None], 0.0, v))
    oracle = Oracle(sim.scene)
    oracle.x, oracle.v = sim.positions(), sim.velocities()
    for state, message in (
        ({"positions": np.zeros((12, 3)), "body": "flyer"}, r"positions have shape \(12, 3\) .*: they must be \(8, 3\) numbers"),
        ({"velocities": [["a"] * 3] * 20}, "velocities have shape .* type <U1: they must be"),
        ({"positions": np.zeros((20, 3)), "velocities": np.eye(20, 3) * np.nan}, "velocities: node 0 is not finite"),
        ({"positions": np.r_[np.zeros((7, 3)), [[0, np.inf, 0]]], "body": "flyer"}, "positions: node 7 is not finite"),
        ({"positions": np.zeros((20, 3)), "body": "flier"}, "no body is called 'flier' .did you mean flyer"),
    ):
        with pytest.raises(ts.SceneError, match=message):
            sim.set_state(**state)
    assert_steps_like(sim, oracle)


def assert_stress(sim) -> None:
    """The mean Cauchy stress of a deformed tet is that of P F^T over the tet at rest, divided by the volume ratio."""
    rng = np.random.default_rng(1)
    x = sim.positions() + 0.05 * rng.standard_normal(sim.positions().shape)
    sim.set_state(positions=x)
    oracle = Oracle(sim.scene)
    for part, name in zip(oracle.parts, ("beam", "flyer"), strict=True):
        F, m, by_tet = oracle.gradients(x, part), part.material, (-1, part.points, 3, 3)
        w = part.weights[:, None, None]
        force = (w * (exact.pk1(m.law, F, m.young, m.poisson) @ exact.transposed(F))).reshape(by_tet).sum(axis=1)
        volume = (w[:, 0, 0] * np.linalg.det(F)).reshape(-1, part.points).sum(axis=1)
        sigma = force / volume[:, None, None]
        assert np.abs(sim.stress(name) - sigma).max() < 1e-11 * np.abs(sigma).max()


def test_reports_stresses_and_differentials_are_the_oracles(sim):
    x = sim.positions()
    x[BEAM:] = x[BEAM:] * [-0.9, 1.0, 1.0]  # the flyer is inverted
    sim.set_state(positions=x)
    report, oracle, explicit = sim.step(), Oracle(sim.scene), sim.settings.explicit
    assert report.time == sim.time == pytest.approx(sim.dt) and report.steps == sim.step_count == 1
    assert report.min_volume_ratio == pytest.approx(oracle.volume_ratios(sim.positions())[0]) and report.n_inverted == 5
    assert report.problems == ["step 1: 5 tets are inverted"]
    assert report.elastic == pytest.approx(oracle.energy(sim.positions()))
    assert report.kinetic == pytest.approx(oracle.kinetic(sim.velocities(), explicit))
    assert report.gravity == pytest.approx(oracle.weight(sim.positions(), explicit))
    assert sim.energies().total == pytest.approx(report.elastic + report.kinetic + report.gravity)
    sim.reset()
    assert_stress(sim)
    oracle, x, dx = Oracle(sim.scene), sim.positions(), np.random.default_rng(2).standard_normal(x.shape)
    expected = -(oracle.stiffness(x) @ dx.reshape(-1)).reshape(-1, 3)
    assert np.abs(sim.force_differential(dx) - expected).max() < 1e-11 * np.abs(expected).max()
    assert np.abs(sim.elastic_forces() - oracle.force(x)).max() < 1e-11 * np.abs(oracle.force(x)).max()
    with pytest.raises(ts.SceneError, match="displacement have shape"):
        sim.force_differential(x[:5])


@pytest.mark.parametrize("change", ["gravity", "dt", "young", "poisson", "density", "mass_damping"])
def test_changes_take_effect_without_compiling(sim, change):
    """Compared with an oracle of the changed scene; only the first upload of material numbers compiles."""
    if change == "mass_damping" and not sim.settings.explicit:
        pytest.skip("the implicit scene has none")
    sim.set_material("beam", young=1e5, density=1000.0)
    for _ in range(2):
        sim.step()
    compiled, dt = sim.compile_seconds, DT
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


def test_refused_changes_have_no_effect_and_others_do_not_reach_the_users_scene(sim):
    state = sim.positions(), sim.velocities(), sim.time, sim.step_count
    with pytest.raises(ts.SimulationError, match="dt must be finite, not nan"):
        sim.dt = np.nan
    with pytest.raises(ts.SceneError, match="gravity must have shape"):
        sim.set_gravity((0, 1))
    with pytest.raises(ts.SceneError, match="body 'flyer': stiffness_damping was 0 everywhere"):
        sim.set_material("flyer", stiffness_damping=0.1)
    with pytest.raises(ts.SceneError, match="no body is called 'wing'"):
        sim.set_material("wing", young=1.0)
    for name, instead in (("gravity", "set_gravity"), ("stable_dt", "set sim.dt"), ("integrator", "rebuild"), ("time", "reset")):
        with pytest.raises(SimulationAttributeError, match=instead):
            setattr(sim, name, 1.0)
    for n in (0, 2.5, True, "3"):
        with pytest.raises(ts.SimulationError, match=f"^n must be a whole number of at least 1, not {re.escape(repr(n))}$"):
            sim.advance(n)
    assert all(np.array_equal(a, b) for a, b in zip(state, (sim.positions(), sim.velocities(), sim.time, sim.step_count)))
    explicit = sim.settings.explicit
    assert_steps_like(sim, Oracle(pair(SVK, 0.5) if explicit else pair()))
    sim.reset()
    assert sim.advance(np.int32(2)).steps == sim.step_count == (2 if explicit else 1)
    scene = pair()
    with ts.Simulator(scene, DT, VERLET, precision="f64") as other:
        other.set_gravity((0, 0, 0))
        other.set_material("beam", young=2e4)
        assert scene.gravity[1] == -9.81 and scene.body("beam").material.young == 1e5


def test_a_failed_step_leaves_the_last_good_state(sim):
    sim.advance(1)
    x, v = sim.positions(), sim.velocities()
    wild = v.copy()
    wild[BEAM + 3] = 1e200
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


def test_softening_is_warned_of_once():
    messages = []
    with simulator(VERLET) as sim:
        rest = sim.positions()
        for stretch in (0.65, 0.55, 0.5):
            sim.set_state(rest * (1.0, stretch, 1.0))
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always", UserWarning)
                sim.step()
            messages.append([str(one.message) for one in found])
    assert [len(texts) for texts in messages] == [0, 1, 0]
    assert messages[1][0].startswith("step 2: tet 0 of body 'flyer' is compressed below 0.6 of its length")


def test_runs_repeat_bitwise_also_beside_other_simulators(sim):
    """Which share compiled kernels and the pool of lane buffers."""

    def ends(*others) -> list[np.ndarray]:
        sim.reset()
        for _ in range(5):
            for one in (sim, *others):
                one.step()
        return [sim.positions(), sim.velocities(), sim.reactions()]

    alone, again = ends(), ends()
    with simulator(sim.settings.integrator) as other:
        other.set_gravity((3.0, 0.0, 0.0))
        beside = ends(other)
        assert not np.array_equal(other.positions(), beside[0])
    assert all(np.array_equal(a, b) and np.array_equal(a, c) for a, b, c in zip(alone, again, beside))


def test_a_closed_simulator_refuses_calls():
    sim = ts.Simulator(block_scene(), 1e-3, VERLET, precision="f64")
    sim.close()
    sim.close()
    assert not sim.is_open
    calls = (
        *(sim.step, sim.reset, sim.positions, sim.energies, sim.reactions, sim.contacts, lambda: sim.advance(3)),
        *(lambda: sim.time, lambda: sim.run(1.0), lambda: sim.stress("block"), lambda: sim.rebuild(dt=1e-4)),
        *(lambda: sim.set_material("block", young=1e4), lambda: setattr(sim, "dt", 1e-4), lambda: sim.set_gravity((0, 0, 0))),
    )
    for call in calls:
        with pytest.raises(ts.SimulationError, match="^the simulator is closed$"):
            call()


def test_a_closed_simulator_has_released_its_memory():
    scene, memory = pair(), []
    scene.add_body(ts.box_mesh((8, 8, 8), (1, 1, 1)), rubber(), position=(0, 9, 0))
    for _ in range(2):  # the first fills the caches, which stay
        tracemalloc.start()
        with ts.Simulator(scene, 1e-3, EULER, precision="f64") as sim:
            sim.step()
            memory.append(tracemalloc.get_traced_memory()[0])
        gc.collect()
        memory.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert memory[3] < 0.2 * memory[2] and memory[2] > 1e6
