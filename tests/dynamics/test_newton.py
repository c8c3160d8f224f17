"""Newton's method of the implicit steps, on a beam of ten tets, linear and quadratic:

* it converges quadratically to the given tolerance, and the linear tolerance controls the number of CG iterations;
* a step that stops early returns converged=False and a message; a linearly implicit step takes one iteration;
* wild states (inverted, crushed, flat) are left along directions of negative curvature: the energy falls and steps converge.

Its start is the extrapolated motion, or v = 0 if |r| is smaller there:

* calm steps and fast flight keep the extrapolated motion;
* a step with wild velocities starts at v = 0, and the stored direction leads back to the extrapolated motion;
* with contacts, where that direction is searched first, the solution is the same as from the other start, in fewer iterations.
"""

from dataclasses import dataclass

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_newton, implicit, newton
from taisoft.dynamics.contact_newton import solve
from taisoft.dynamics.linearised import LONGEST
from taisoft.dynamics.newton import FAR, choose_start
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage import AGAIN, STEP
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.fem.state import STEP_LENGTH
from tests.dynamics.scenes import cube, dynamics, element, rubber

SETTINGS = {"integrator": "implicit_euler", "precision": "f64"}


def beam(order: int) -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="beam", **element(order)).fix(lambda X: X[:, 0] < -0.49)
    return scene


@pytest.fixture(scope="module", params=[1, 2])
def shared_dynamics(request):
    with dynamics(beam(request.param), newton_tolerance=1e-9, **SETTINGS) as d:
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


def test_it_converges_in_a_few_iterations(d):
    d.stepper.tolerance = 1e-12
    report = d.advance(1)
    assert report.converged and report.residual < 1e-12 and 2 <= report.newton_iterations <= 6
    assert report.linear_iterations >= report.newton_iterations and not report.problems


def test_tolerances_control_the_iterations(d):
    counts = []
    for tolerance in (1e-1, 1e-4, 1e-12):
        d.reset()
        d.stepper.tolerance = tolerance
        report = d.advance(1)
        assert report.converged and report.residual <= tolerance
        counts.append(report.newton_iterations)
    assert counts == sorted(set(counts))
    d.reset()
    d.stepper.linear_tolerance = 1e-12
    exact = d.advance(1)
    assert exact.newton_iterations <= counts[-1] and exact.linear_iterations > 4 * exact.newton_iterations


@pytest.mark.parametrize("order", [1, 2])
def test_a_step_that_does_not_converge_is_reported(order, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    with ts.Simulator(beam(order), newton_tolerance=1e-12, **SETTINGS) as sim:
        sim.set_state(velocities=3.0 * np.random.default_rng(0).standard_normal(sim.positions().shape))
        report = sim.step()
        assert not report.converged and report.newton_iterations == 2 * (1 + 2 + 4 + 1) and report.residual > 1e-12
        message = f"step 1: Newton stopped after 16 iterations at a relative residual of {report.residual:.2e}"
        assert report.problems == [message]
        result = sim.run(2 / 60, fps=None)
    assert result.status == "degraded" and "2 of 2 steps did not converge" in result.problems[-1]


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
    spacing = 1.0 / d.scene.bodies[0].order  # [m] between nodes, approximately
    x = {
        "crushed": rest * [0.2, 1.0, 0.3],
        "inside out": rest * [-1.0, 1.0, 1.0],
        "flat": rest * [1.0, 0.0, 1.0],
        "random": rest + 0.7 * spacing * rng.standard_normal(rest.shape),
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


@dataclass
class Start:
    """|r|, its scale and positions before and after `choose_start`, and after stepping back along the stored direction."""

    r: float
    scale: float
    r_after: float
    moved: bool
    x: np.ndarray
    x_after: np.ndarray
    r_back: float = np.nan
    x_back: np.ndarray | None = None
    n_contacts: int = 0


def beam_simulator(fixed: bool = True, ground: bool = False) -> ts.Simulator:
    scene = ts.Scene()
    body = scene.add_body(cube(cells=(3, 3, 3)), rubber(friction=0.5), name="beam", position=(0.0, 0.501, 0.0))
    if fixed:
        body.fix(lambda X: X[:, 0] < -0.49)
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return ts.Simulator(scene, dt=0.01, newton_tolerance=1e-9, **SETTINGS)


@pytest.fixture
def starts(monkeypatch):
    """A record of each call of `choose_start`."""
    records = []

    def spy(system, r, scale):
        x = system.model.state.x.to_numpy()
        result = choose_start(system, r, scale)
        record = Start(
            r,
            scale,
            r_after=result[0],
            moved=result[2],
            x=x,
            x_after=system.model.state.x.to_numpy(),
            n_contacts=system.n_contacts,
        )
        if record.moved:
            record.r_back, _ = system.evaluate(STEP)
            record.x_back = system.model.state.x.to_numpy()
            system.evaluate(AGAIN, 0.0)
        records.append(record)
        return result

    monkeypatch.setattr(contact_newton, "choose_start", spy)
    return records


def wild_velocities(sim, size: float = 100.0) -> np.ndarray:
    """Velocities [m/s] that turn tets inside out in a step."""
    return size * np.random.default_rng(3).standard_normal(sim.positions().shape)


def test_calm_steps_keep_the_extrapolated_motion(starts):
    with beam_simulator() as sim:
        for _ in range(4):
            assert sim.step().converged
    assert starts and not any(s.moved for s in starts)
    assert all(np.array_equal(s.x, s.x_after) for s in starts)
    assert starts[-1].r <= FAR * starts[-1].scale  # so v = 0 was not evaluated


def test_fast_flight_keeps_the_extrapolated_motion(starts):
    with beam_simulator(fixed=False) as sim:
        sim.set_state(velocities=np.tile((30.0, 0.0, 0.0), (len(sim.positions()), 1)))
        assert sim.step().converged
    s = starts[0]
    assert s.r > FAR * s.scale  # so v = 0 was evaluated
    assert not s.moved and s.r_after == pytest.approx(s.r, rel=1e-12) and np.array_equal(s.x, s.x_after)


@pytest.mark.parametrize("ground", [False, True])
def test_a_step_with_wild_velocities_starts_at_rest(starts, ground):
    with beam_simulator(ground=ground) as sim:
        rest = sim.positions()
        sim.set_state(velocities=wild_velocities(sim))
        sim.step()
    s, fixed = starts[0], rest[:, 0] < -0.49
    assert (s.n_contacts > 0) == ground
    assert s.moved and s.r > FAR * s.scale and s.r_after < s.r
    assert np.abs(s.x_after - rest).max() < 1e-12 and np.array_equal(s.x_after[fixed], rest[fixed])
    assert np.abs(s.x - rest)[~fixed].max() > 0.1
    assert np.abs(s.x_back - s.x).max() < 1e-10 and s.r_back == pytest.approx(s.r, rel=1e-6)


@pytest.mark.parametrize("root", [True, False])
def test_both_starts_lead_to_the_same_solution_with_contacts(starts, monkeypatch, root):
    """root: whether the search along the stored direction finds a root; without one the direction is dropped."""
    searches, search = [], StageSystem.advance

    def advance(system):
        searches.append(search(system))
        if not root:
            system.model.state.scalars[STEP_LENGTH] = LONGEST
        return searches[-1]

    monkeypatch.setattr(StageSystem, "advance", advance)
    elastic, iterations, moved = [], [], []
    for far in (FAR, np.inf):
        monkeypatch.setattr(newton, "FAR", far)
        starts.clear()
        with beam_simulator(fixed=False, ground=True) as sim:
            sim.set_state(velocities=wild_velocities(sim, 20.0) - (0.0, 3.0, 0.0))
            reports = [sim.step() for _ in range(2)]
        assert all(report.converged for report in reports) and reports[-1].n_contacts > 0
        elastic.append(reports[-1].elastic)
        iterations.append(reports[0].newton_iterations)  # of the step that begins with wild velocities
        moved.append(sum(s.moved and s.n_contacts > 0 for s in starts))
    assert moved[0] > 0 and moved[1] == 0 and len(searches) == moved[0]
    assert elastic[0] == pytest.approx(elastic[1], rel=1e-6)
    assert iterations[0] < iterations[1] or not root
