"""Newton's method of implicit steps with contacts, on a tilted cube that lands on the ground and on another cube:

* the loop on the device and the loop driven by the host find the same step, also with extrapolated multipliers; cut into many
  launches, the loop gives the same bits;
* a step takes few Newton iterations, also with an indefinite matrix, and stops at their limit; impulses satisfy the contact laws,
  also with a tolerance far below that of |r|; a retry starts from the result of the last attempt;
* a linearised step with an indefinite matrix continues with a projected one.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_newton, implicit
from taisoft.dynamics.contact_newton import FrictionalResult, solve
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.newton import Newton
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.linear import pcg
from tests.collision.rotations import rotation
from tests.dynamics.contact_scenes import FRICTION, ground, material
from tests.dynamics.scenes import dynamics, set_state

DT = 0.004  # [s]: nothing passes through anything on the way, so that steps depend smoothly on rounding
SETTINGS = {"dt": DT, "precision": "f64", "newton_tolerance": 1e-10, "contact_tolerance": 1e-9}


def cubes() -> ts.Scene:
    scene = ts.Scene(gravity=(1.0, -9.81, 0.0))
    rubber = material(young=2e5, poisson=0.4)
    mesh = ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1))
    turned = ts.TetMesh(mesh.vertices @ rotation((1.0, 0.2, 0.5), 0.4).T, mesh.tets)
    scene.add_body(mesh, rubber, name="lower", position=(0, 0.0502, 0))
    scene.add_body(turned, rubber, name="upper", position=(0.02, 0.185, 0.01), velocity=(0.3, -1.0, 0.0))
    scene.add_obstacle(ground(), name="ground", friction=FRICTION)
    return scene


@pytest.fixture(scope="module")
def shared_dynamics():
    with dynamics(cubes(), **SETTINGS) as made:
        yield made


@pytest.fixture
def made(shared_dynamics):
    shared_dynamics.reset()
    return shared_dynamics


def steps(made: Dynamics, n: int = 6) -> tuple[np.ndarray, list[ts.StepReport]]:
    """Positions and reports of n steps from the start."""
    made.reset()
    reports = [made.advance(1) for _ in range(n)]
    return positions(made), reports


def positions(made: Dynamics) -> np.ndarray:
    return made.state.state()[0]


def solve_on_host(system, problem, r, scale) -> FrictionalResult:
    """The loop that the host drives, as with parallel kernels."""
    newton = Newton(system, problem)
    result = newton.run(r, scale, fresh=True)
    return FrictionalResult(newton.newton, newton.linear, newton.multipliers, newton.negative, result.converged, newton.r)


def counts(reports: list[ts.StepReport]) -> list[tuple[int, int, int]]:
    """Newton, CG and multiplier iterations of each step."""
    return [(r.newton_iterations, r.linear_iterations, r.contact_iterations) for r in reports]


def test_both_loops_find_the_same_step(made, monkeypatch):
    """In as many iterations; those of extrapolated multipliers find it sooner."""
    x, reports = steps(made)
    whole = [report.newton_iterations for report in reports if report.substeps == 1]
    assert all(report.converged for report in reports) and len(whole) >= 3 and max(whole) <= 12
    assert max(report.n_contacts for report in reports) > 10
    with monkeypatch.context() as patch:
        patch.setattr(implicit, "Stage", partial(Stage, extrapolate_after=0))
        extrapolated, sooner = steps(made)
        assert all(report.converged for report in sooner) and np.abs(extrapolated - x).max() < 1e-8  # [m]
        assert sum(report.contact_iterations for report in sooner) < 0.9 * sum(r.contact_iterations for r in reports)
    monkeypatch.setattr(contact_newton, "solve_linear", solve_on_host)
    host, others = steps(made)
    assert np.abs(host - x).max() < 1e-8 and counts(others) == counts(reports)
    monkeypatch.setattr(implicit, "Stage", partial(Stage, extrapolate_after=0))
    assert counts(steps(made)[1]) == counts(sooner)


def test_many_launches_give_the_same_bits(made, monkeypatch):
    x, reports = steps(made)
    monkeypatch.setattr(pcg, "batch_of", lambda m, A: 1)  # one iteration a launch
    again, others = steps(made)
    assert np.array_equal(again, x) and counts(others) == counts(reports)


def test_a_retry_starts_from_the_result_of_the_last_attempt(made):
    steps(made, 2)
    stepper, time, x_start = made.stepper, made.state.time, positions(made)
    result = stepper.take_substep(time, DT)
    x, v = made.state.state()
    stepper.restore_start()
    assert result.converged and np.array_equal(positions(made), x_start)
    again = stepper.retry_substep(time, DT, v)
    assert again.converged and 2 * again.newton_iterations < result.newton_iterations
    assert np.abs(positions(made) - x).max() < 1e-8  # [m]


def test_a_stage_stops_at_the_iteration_limit(made, monkeypatch):
    steps(made, 2)
    monkeypatch.setattr(implicit, "solve", lambda system, stage: solve(system, replace(stage, max_newton=1)))
    result = made.stepper.take_substep(made.state.time, DT)
    assert not result.converged and 1 <= result.newton_iterations <= 8  # a few of them on the nonlinear stage


def test_contact_laws_converge_to_their_own_tolerance(made, monkeypatch):
    """Here far below that of |r|."""
    monkeypatch.setattr(made.stepper, "tolerance", 1e-3)
    monkeypatch.setattr(made.stepper, "contact_tolerance", 1e-6)
    _, reports = steps(made, 4)
    assert max(report.n_contacts for report in reports) > 10
    assert sum(report.converged and report.contact_residual <= 1e-6 for report in reports) >= 3


@pytest.fixture
def squeezed(made, monkeypatch):
    """The upper cube squeezed flat as it lands: its matrix is indefinite. Returns a list of whether each matrix is projected."""
    x, upper = positions(made), made.state.layout.nodes(1)
    middle = x[upper].mean(axis=0)
    x[upper] = middle + (x[upper] - middle) * (1.0, 0.15, 1.0) - (0, 0.05, 0)
    set_state(made, x)
    solver, projections = made.stepper.solver, []

    def form_matrix(projected=False):
        projections.append(projected)
        StageSystem.form_matrix(solver, projected)

    monkeypatch.setattr(solver, "form_matrix", form_matrix)
    return projections


def test_contact_laws_hold_with_an_indefinite_matrix(made, squeezed):
    report = made.advance(1)
    assert any(squeezed) and not all(squeezed) and report.converged
    c = made.contact.contacts()
    normal = np.einsum("ij,ij->i", c.impulse, c.normal)
    tangential = np.linalg.norm(c.impulse - normal[:, None] * c.normal, axis=1)
    assert (normal >= 0.0).all() and (tangential <= 0.5 * normal + 1e-9 * normal.max()).all() and normal.max() > 0.0


def test_a_linearised_step_projects_an_indefinite_matrix(made, squeezed, monkeypatch):
    monkeypatch.setattr(made.stepper, "scheme", SCHEMES["linearly_implicit_euler"])
    report = made.advance(1)
    assert any(squeezed) and not squeezed[0] and np.isfinite(positions(made)).all()
    assert report.contact_residual <= 1e-9 or not report.converged
