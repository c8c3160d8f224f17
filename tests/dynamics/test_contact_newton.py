"""Newton's method of implicit steps with contacts, on a tilted cube that lands on the ground and on another cube, in f64:

* the loop on the device, the loop driven by the host and parallel loops find the same step; cut into many launches, the loop
  gives the same bits;
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
from taisoft.dynamics.contact_newton import FALLBACK_STEPS, FrictionalResult
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.newton import Newton
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.linear import pcg
from tests.collision.rotations import rotation
from tests.dynamics.scenes import dynamics, set_state, use_threads

DT = 0.004  # [s]: nothing passes through anything on the way, so that steps depend smoothly on rounding


def cubes() -> ts.Scene:
    scene = ts.Scene(gravity=(1.0, -9.81, 0.0))
    rubber = ts.Material(young=2e5, poisson=0.4, density=1000.0, friction=0.5)
    mesh = ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1))
    turned = ts.TetMesh(mesh.vertices @ rotation((1.0, 0.2, 0.5), 0.4).T, mesh.tets)
    scene.add_body(mesh, rubber, name="lower", position=(0, 0.0502, 0))
    scene.add_body(turned, rubber, name="upper", position=(0.02, 0.185, 0.01), velocity=(0.3, -1.0, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return scene


SETTINGS = {"dt": DT, "precision": "f64", "newton_tolerance": 1e-10, "contact_tolerance": 1e-9}


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


def test_converged_steps_satisfy_the_laws_of_light_bodies():
    """A light cube slides on a stiff block; its impulses are small compared with the block's rounding errors.

    In f32, so it comes before the fixture in f64.
    """
    scene = ts.Scene()
    block = scene.add_body(
        ts.box_mesh((2, 2, 2), (1.0, 0.5, 1.0)), ts.Material(young=1e8, density=1000.0, friction=0.5), name="block"
    )
    block.fix(lambda X: X[:, 1] < 0.0)
    light = ts.Material(young=1e4, poisson=0.3, density=100.0, friction=0.5)
    scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), light, name="light", position=(0, 0.3005, 0), velocity=(0.5, 0, 0))
    with ts.Simulator(scene, dt=DT, precision="f32") as sim:
        reports = [sim.step() for _ in range(15)]
    assert all(report.contact_residual <= 1e-4 for report in reports if report.converged)
    assert any(report.n_contacts for report in reports)


def test_impulses_below_the_rounding_of_a_stiff_body():
    """A soft slab on one ten thousand times as stiff, in f32: |r| is mostly the rounding of the stiff slab's stress."""
    scene, mesh = ts.Scene(gravity=(0.0, -9.81, 0.0)), ts.box_mesh((8, 1, 8), (1.0, 0.05, 1.0))
    turned = ts.TetMesh(mesh.vertices @ rotation((0.0, 1.0, 0.0), 0.8).T, mesh.tets)
    for name, slab, young, height in (("lower", mesh, 1e8, 0.0255), ("upper", turned, 1e4, 0.077)):
        material = ts.Material(young=young, poisson=0.4, density=1500.0, friction=0.1)
        scene.add_body(slab, material, name=name, position=(0, height, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.1)
    with ts.Simulator(scene, dt=1 / 120, integrator="implicit_euler", precision="f32") as sim:
        reports = [sim.step() for _ in range(30)]
    assert all(report.converged and report.contact_residual <= 1e-4 for report in reports)
    assert sum(report.newton_iterations for report in reports) <= 10 * len(reports) and reports[-1].n_contacts > 50


def test_both_loops_find_the_same_step(made, monkeypatch):
    x, reports = steps(made)
    whole = [report.newton_iterations for report in reports if report.substeps == 1]
    assert all(report.converged for report in reports) and len(whole) >= 3 and max(whole) <= 12
    assert max(report.n_contacts for report in reports) > 10
    monkeypatch.setattr(contact_newton, "solve_linear", solve_on_host)
    host, others = steps(made)
    assert all(report.converged for report in others) and np.abs(host - x).max() < 1e-8  # [m]
    assert counts(others) == counts(reports)


def test_extrapolated_multipliers_find_the_same_step_sooner(made, monkeypatch):
    """In both loops."""
    x, reports = steps(made)
    monkeypatch.setattr(implicit, "Stage", partial(Stage, extrapolate_after=0))
    other, others = steps(made)
    assert all(report.converged for report in others) and np.abs(other - x).max() < 1e-8  # [m]
    assert sum(report.contact_iterations for report in others) < 0.9 * sum(report.contact_iterations for report in reports)
    monkeypatch.setattr(contact_newton, "solve_linear", solve_on_host)
    assert counts(steps(made)[1]) == counts(others)


def test_solves_after_the_first_are_looser(made):
    """Unless the user set their tolerance."""
    steps(made, 2)
    solver, stage = made.stepper.solver, Stage(1.0, DT, DT, 1e-6, linear_tolerance=1e-4, later_tolerance=1e-2)
    newton = Newton(solver, stage)
    assert newton._linear_tolerance() == 1e-4
    newton.newton = 1
    assert newton._linear_tolerance() == 1e-2
    newton.stage = replace(stage, later_tolerance=0.0)
    assert newton._linear_tolerance() == 1e-4


@pytest.mark.parametrize("given", [None, 1e-5])
def test_problems_near_the_rounding_floor_extrapolate_at_once(made, monkeypatch, given):
    """All solves but the first are looser, unless the user set their tolerance."""
    problems = []

    def solve(system, problem, r, scale):
        problems.append((system.stage, problem))
        return solve_on_host(system, problem, r, scale)

    monkeypatch.setattr(contact_newton, "NEAR_FLOOR", np.inf)  # every problem counts as near the floor
    monkeypatch.setattr(contact_newton, "solve_linear", solve)
    monkeypatch.setattr(made.stepper, "linear_tolerance", given)
    steps(made, 2)
    assert problems
    for stage, problem in problems:
        assert problem.extrapolate_after == 0
        assert (problem.linear_tolerance, problem.later_tolerance) == ((given, 0.0) if given else (stage.tolerance, 1e-2))


def test_parallel_loops_find_the_same_step(made, monkeypatch):
    x, _ = steps(made)
    use_threads(monkeypatch)
    with dynamics(cubes(), **SETTINGS) as parallel:
        assert not parallel.model.serial
        other, reports = steps(parallel)
    assert all(report.converged for report in reports) and np.abs(other - x).max() < 1e-8  # [m]


def test_many_launches_give_the_same_bits(made, monkeypatch):
    x, reports = steps(made)
    monkeypatch.setattr(pcg, "SERIAL_WORK", 1)  # one iteration a launch
    again, others = steps(made)
    assert np.array_equal(again, x) and [r.linear_iterations for r in others] == [r.linear_iterations for r in reports]


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
    monkeypatch.setattr(implicit, "MAX_NEWTON_WITH_CONTACTS", 1)
    steps(made, 2)
    result = made.stepper.take_substep(made.state.time, DT)
    assert not result.converged and 1 <= result.newton_iterations <= 1 + FALLBACK_STEPS


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_contact_laws_converge_to_their_own_tolerance(tolerance):
    """Here far below that of |r|."""
    with ts.Simulator(cubes(), dt=DT, precision="f64", newton_tolerance=tolerance, contact_tolerance=1e-3 * tolerance) as sim:
        reports = [sim.step() for _ in range(4)]
    assert max(report.n_contacts for report in reports) > 10
    assert sum(report.converged for report in reports) >= 3


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
