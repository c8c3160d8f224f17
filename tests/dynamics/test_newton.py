"""Newton's method of the implicit steps:

* it converges quadratically to the given tolerance, and the linear tolerance controls the number of CG iterations;
* a step that stops early returns converged=False and a message; a linearly implicit step takes one iteration;
* wild states (inverted, crushed, flat) are left along directions of negative curvature: the energy falls and steps converge;
* statics stops at the rounding of the forces.

Its start is the extrapolated motion, or v = 0 if |r| is smaller there:

* calm steps and fast flight keep the extrapolated motion;
* a step with wild velocities starts at v = 0, and the stored direction leads back to the extrapolated motion;
* with contacts, where that direction is searched first, the solution is the same as from the other start, in fewer iterations.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_newton, implicit
from taisoft.dynamics.contact_newton import solve
from taisoft.dynamics.newton import choose_start
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage import AGAIN, STEP
from taisoft.dynamics.stage_system import Stage, StageSystem
from tests.dynamics.contact_scenes import ground, material
from tests.dynamics.scenes import cube, dynamics

SETTINGS = {"integrator": "implicit_euler", "precision": "f64", "newton_tolerance": 1e-9}


@pytest.fixture(scope="module")
def shared_dynamics():
    scene = ts.Scene()
    scene.add_body(cube(cells=(2, 1, 1)), material(), name="beam").fix(lambda X: X[:, 0] < -0.49)
    with dynamics(scene, **SETTINGS) as d:
        assert d.stepper.tolerance == 1e-9
        yield d


@pytest.fixture
def d(shared_dynamics, monkeypatch):
    """The beam in its initial state; tests may change dt, tolerances and the scheme."""
    for name in ("tolerance", "linear_tolerance", "scheme"):
        monkeypatch.setattr(shared_dynamics.stepper, name, getattr(shared_dynamics.stepper, name))
    shared_dynamics.set_dt(1 / 60)
    shared_dynamics.reset()
    return shared_dynamics


def set_state(d, x=None, v=None) -> None:
    """Set positions [m] or velocities [m/s] of free nodes; the rest is unchanged, and constrained nodes rest."""
    now = d.state.state()
    held = d.state.dirichlet.constrained()
    d.state.set_state(now[0] if x is None else np.where(held, now[0], x), now[1] if v is None else np.where(held, 0.0, v))
    d.state_changed()


def random_velocities(d) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((d.model.n_nodes, 3))


def test_tolerances_control_the_iterations(d):
    counts = []
    for tolerance in (1e-1, 1e-4, 1e-12):
        d.reset()
        d.stepper.tolerance = tolerance
        report = d.advance(1)
        assert report.converged and report.residual <= tolerance and not report.problems
        counts.append(report.newton_iterations)
    assert counts == sorted(set(counts)) and 2 <= counts[-1] <= 6 and report.linear_iterations >= counts[-1]
    d.reset()
    d.stepper.linear_tolerance = 1e-12
    exact = d.advance(1)
    assert exact.newton_iterations <= counts[-1] and exact.linear_iterations > 4 * exact.newton_iterations


def test_a_step_that_does_not_converge_is_reported(d, monkeypatch):
    monkeypatch.setattr(implicit, "solve", lambda system, stage: solve(system, replace(stage, max_newton=2)))
    set_state(d, v=3.0 * random_velocities(d))
    report = d.advance(1)
    assert not report.converged and report.newton_iterations == 2 * (1 + 2 + 4 + 1) and report.residual > 1e-9
    message = f"Newton stopped after 16 iterations at a relative residual of {report.residual:.2e}"
    assert [problem.removeprefix("step 1: ") for problem in report.problems] == [message]


def test_linearly_implicit_steps_take_one_iteration(d):
    d.stepper.scheme = SCHEMES["linearly_implicit_euler"]
    set_state(d, v=random_velocities(d))
    report = d.advance(1)
    assert report.newton_iterations == 1 and report.converged and report.residual > 1e-6


@pytest.mark.parametrize("kind", ["crushed", "inside out", "flat", "random"])
def test_wild_states_are_left_along_negative_curvature(d, kind, monkeypatch):
    """No matrix is projected."""
    solver, indefinite = d.stepper.solver, []

    def direction(tolerance):
        answer = StageSystem.direction(solver, tolerance)
        indefinite.append(answer.negative)
        return answer

    monkeypatch.setattr(solver, "direction", direction)
    rest, rng = d.state.state()[0], np.random.default_rng(1)
    x = {
        "crushed": rest * [0.2, 1.0, 0.3],
        "inside out": rest * [-1.0, 1.0, 1.0],
        "flat": rest * [1.0, 0.0, 1.0],
        "random": rest + 0.7 * rng.standard_normal(rest.shape),
    }[kind]
    set_state(d, x=x)
    d.set_dt(0.2)
    start = d.energies()
    for _ in range(20):
        report = d.advance(1)
        assert report.converged and report.newton_iterations < 50
    assert 0 < sum(indefinite) < len(indefinite)
    end = d.energies()
    assert end.total < start.total and end.elastic < 0.03 * start.elastic
    assert report.min_volume_ratio > 0.0  # no tet is left inverted


def test_statics_stop_at_the_rounding_of_the_forces(d):
    """With a tolerance below the rounding the solve does not converge, and the result gives the reason."""
    solver, model = d.stepper.solver, d.model
    solver.work.x_hat.from_numpy(model.state.x.to_numpy())
    model.state.v.fill(0.0)
    result = solve(solver, Stage(0.0, 1.0, 1.0, 1e-18, max_newton=100))
    assert not result.converged and result.at_rounding and 1e-18 < result.residual < 1e-11
    assert result.newton_iterations < 20


# --- the start ---


def beam_simulator(fixed: bool = True, on_ground: bool = False) -> ts.Simulator:
    scene = ts.Scene()
    body = scene.add_body(cube(cells=(3, 3, 3)), material(), name="beam", position=(0.0, 0.501, 0.0))
    if fixed:
        body.fix(lambda X: X[:, 0] < -0.49)
    if on_ground:
        scene.add_obstacle(ground(), name="ground", friction=0.5)
    return ts.Simulator(scene, dt=0.01, **SETTINGS)


@pytest.fixture
def starts(monkeypatch):
    """A record of each call of `choose_start`: |r|, its scale and x before and after; and after a step back, if it moved."""
    records = []

    def spy(system, r, scale):
        s = SimpleNamespace(r=r, scale=scale, x=system.model.state.x.to_numpy(), n_contacts=system.n_contacts)
        result = choose_start(system, r, scale)
        s.r_after, _, s.moved = result
        s.x_after = system.model.state.x.to_numpy()
        if s.moved:
            s.r_back, _ = system.evaluate(STEP)
            s.x_back = system.model.state.x.to_numpy()
            system.evaluate(AGAIN, 0.0)
        records.append(s)
        return result

    monkeypatch.setattr(contact_newton, "choose_start", spy)
    return records


def wild_velocities(sim, size: float = 100.0) -> np.ndarray:
    """Velocities [m/s] that turn tets inside out in a step."""
    return size * np.random.default_rng(3).standard_normal(sim.positions().shape)


@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_calm_steps_and_fast_flight_keep_the_extrapolated_motion(starts, speed):
    """In flight v = 0 is evaluated."""
    with beam_simulator(fixed=not speed) as sim:
        sim.set_state(velocities=np.tile((speed, 0.0, 0.0), (len(sim.positions()), 1)))
        for _ in range(3):
            assert sim.step().converged
    assert starts[0].r > 0.5 * starts[0].scale if speed else starts[-1].r <= 0.5 * starts[-1].scale
    for s in starts:
        assert not s.moved and s.r_after == pytest.approx(s.r, rel=1e-12) and np.array_equal(s.x, s.x_after)


@pytest.mark.parametrize("on_ground", [False, True])
def test_a_step_with_wild_velocities_starts_at_rest(starts, on_ground):
    with beam_simulator(on_ground=on_ground) as sim:
        rest = sim.positions()
        sim.set_state(velocities=wild_velocities(sim))
        sim.step()
    s, fixed = starts[0], rest[:, 0] < -0.49
    assert (s.n_contacts > 0) == on_ground
    assert s.moved and s.r > 0.5 * s.scale and s.r_after < s.r
    assert np.abs(s.x_after - rest).max() < 1e-12 and np.array_equal(s.x_after[fixed], rest[fixed])
    assert np.abs(s.x - rest)[~fixed].max() > 0.1
    assert np.abs(s.x_back - s.x).max() < 1e-10 and s.r_back == pytest.approx(s.r, rel=1e-6)


@pytest.mark.parametrize("root", [True, False])
def test_both_starts_lead_to_the_same_solution_with_contacts(starts, monkeypatch, root):
    """root: whether the search along the stored direction finds a root; without one the direction is dropped."""
    searches, search, spy = [], StageSystem.advance, contact_newton.choose_start
    monkeypatch.setattr(StageSystem, "advance", lambda system: searches.append(search(system)) or searches[-1])
    if not root:
        monkeypatch.setattr(StageSystem, "found_zero_slope", False)
    found = []
    for chosen in (spy, lambda system, r, scale: (r, scale, False)):
        monkeypatch.setattr(contact_newton, "choose_start", chosen)
        starts.clear()
        with beam_simulator(fixed=False, on_ground=True) as sim:
            sim.set_state(velocities=wild_velocities(sim, 20.0) - (0.0, 3.0, 0.0))
            reports = [sim.step() for _ in range(2)]
        assert all(report.converged for report in reports) and reports[-1].n_contacts > 0
        found.append((reports[-1].elastic, reports[0].newton_iterations, sum(s.moved and s.n_contacts > 0 for s in starts)))
    (elastic, iterations, moved), (expected, most, none) = found  # iterations of the step that begins with wild velocities
    assert moved > 0 and none == 0 and len(searches) == moved
    assert elastic == pytest.approx(expected, rel=1e-6) and (iterations < most or not root)
