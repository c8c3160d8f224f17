"""Newton's method of the implicit steps, on a beam of ten tets, linear and quadratic:

* it converges in a few iterations, to the tolerance that was asked for, and the linear one decides how much CG does;
* a step that stops early returns converged=False and says so; the linearly implicit step is one iteration;
* wild states (inverted, crushed, flat) are left along directions of negative curvature: Phi falls, the step converges.
"""

import numpy as np
import pytest
from scenes import cube, element, rubber

import taisoft as ts
from taisoft.dynamics import implicit, scheme_of
from taisoft.dynamics.contact_newton import solve
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.fem.state import MIN_J


def beam(order: int, **settings) -> ts.Simulator:
    scene = ts.Scene()
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="beam", **element(order))
    body.fix(lambda X: X[:, 0] < -0.49)
    return ts.Simulator(scene, integrator="implicit_euler", precision="f64", **settings)


@pytest.fixture(scope="module", params=[1, 2])
def shared_sim(request):
    with beam(request.param, newton_tolerance=1e-9) as made:
        assert made._stepper.tolerance == 1e-9
        yield made


@pytest.fixture
def sim(shared_sim, monkeypatch):
    """The beam at its start, with tolerances that a test may change."""
    shared_sim.reset()
    for name in ("tolerance", "linear_tolerance", "scheme"):
        monkeypatch.setattr(shared_sim._stepper, name, getattr(shared_sim._stepper, name))
    return shared_sim


def test_it_converges_as_newton_does(sim):
    sim._stepper.tolerance = 1e-12
    report = sim.step()
    assert report.converged and report.residual < 1e-12 and 2 <= report.newton_iterations <= 6
    assert report.linear_iterations >= report.newton_iterations and not report.problems


def test_tolerances(sim):
    counts = []
    for tolerance in (1e-1, 1e-4, 1e-12):
        sim.reset()
        sim._stepper.tolerance = tolerance
        report = sim.step()
        assert report.converged and report.residual <= tolerance
        counts.append(report.newton_iterations)
    assert counts == sorted(set(counts))
    sim.reset()
    sim._stepper.linear_tolerance = 1e-12
    exact = sim.step()
    assert exact.newton_iterations <= counts[-1] and exact.linear_iterations > 4 * exact.newton_iterations


def test_stopping_early_is_told(sim, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    sim._stepper.tolerance = 1e-12
    sim.set_state(velocities=3.0 * np.random.default_rng(0).standard_normal(sim.positions().shape))
    report = sim.step()
    assert not report.converged and report.newton_iterations == 2 * (1 + 2 + 4 + 1) and report.residual > 1e-12
    assert report.problems == [f"step 1: Newton stopped after 16 iterations at a relative residual of {report.residual:.2e}"]
    result = sim.run(2 / 60, fps=None)
    assert result.status == "degraded" and "2 of 2 steps did not converge" in result.problems[-1]


def test_linearly_implicit_steps_are_one_iteration(sim):
    sim._stepper.scheme = scheme_of("linearly_implicit_euler")
    sim.set_state(velocities=np.random.default_rng(0).standard_normal(sim.positions().shape))
    report = sim.step()
    assert report.newton_iterations == 1 and report.converged and report.residual > 1e-6


def counted(answer, negative: list):
    """A linear solve, and whether it met negative curvature."""
    negative.append(answer.negative)
    return answer


@pytest.mark.parametrize("kind", ["crushed", "inside out", "flat", "random"])
def test_wild_states(sim, kind, monkeypatch):
    """Directions of negative curvature lead out of them: no matrix is projected."""
    solver, indefinite = sim._stepper.solver, []
    monkeypatch.setattr(solver, "direction", lambda tolerance: counted(StageSystem.direction(solver, tolerance), indefinite))
    rest, rng = sim.positions(), np.random.default_rng(1)
    spacing = 1.0 / sim.scene.bodies[0].order  # [m] between nodes, about
    x = {
        "crushed": rest * [0.2, 1.0, 0.3],
        "inside out": rest * [-1.0, 1.0, 1.0],
        "flat": rest * [1.0, 0.0, 1.0],
        "random": rest + 0.7 * spacing * rng.standard_normal(rest.shape),
    }[kind]
    sim.set_state(positions=np.where(sim._simulation.dirichlet.constrained(), rest, x))
    start = sim.energies()
    for _ in range(20):
        result = sim._stepper.step(0.2)
        assert result.converged and result.newton_iterations < 50
    assert 0 < sum(indefinite) < len(indefinite)
    now = sim.energies()
    assert now.total < start.total and now.elastic < 0.03 * start.elastic
    sim._report()
    assert sim._simulation.model.state.scalars[MIN_J] > 0.0  # no tet is left inverted


def test_statics_end_at_the_rounding_of_the_forces(sim):
    """A tolerance that no arithmetic can meet: not converged, and the reason is told."""
    solver, model = sim._stepper.solver, sim._simulation.model
    solver.work.x_hat.from_numpy(model.state.x.to_numpy())
    model.state.v.fill(0.0)
    result = solve(solver, Stage(0.0, 1.0, 1.0, 1e-18, max_newton=100))
    assert not result.converged and result.at_rounding and 1e-18 < result.residual < 1e-11
    assert result.newton_iterations < 20
