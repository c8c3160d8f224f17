"""The contact problem of implicit steps, on a cube that lands aslant on the ground and on another cube, in f64:

* the loop in one launch and the one that the host drives find the same step, as do all loops on threads; cut into many launches
  it is the same bit by bit;
* a step takes few Newton iterations, also where the matrix is indefinite, and ends at its limit of them; impulses keep the laws,
  also where these are asked for much more tightly than |r|; a retry begins where the last try ended;
* a linearised step of an indefinite matrix goes on with a projected one.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from rotations import rotation

import taisoft as ts
from taisoft.dynamics import contact_newton, implicit
from taisoft.dynamics.contact_newton import FALLBACK_STEPS, FrictionalResult
from taisoft.dynamics.newton import Newton
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.fem import model
from taisoft.linear import pcg

DT = 0.01  # [s]


def cubes() -> ts.Scene:
    scene = ts.Scene(gravity=(1.0, -9.81, 0.0))
    rubber = ts.Material(young=2e5, poisson=0.4, density=1000.0, friction=0.5)
    mesh = ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1))
    turned = ts.TetMesh(mesh.vertices @ rotation((1.0, 0.2, 0.5), 0.4).T, mesh.tets)
    scene.add_body(mesh, rubber, name="lower", position=(0, 0.0502, 0))
    scene.add_body(turned, rubber, name="upper", position=(0.02, 0.185, 0.01), velocity=(0.3, -1.0, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return scene


def simulator() -> ts.Simulator:
    return ts.Simulator(cubes(), dt=DT, precision="f64", newton_tolerance=1e-10, contact_tolerance=1e-9)


@pytest.fixture(scope="module")
def shared_sim():
    with simulator() as sim:
        yield sim


@pytest.fixture
def sim(shared_sim, monkeypatch):
    monkeypatch.setattr(shared_sim._dynamics.stepper, "scheme", SCHEMES["implicit_euler"])
    shared_sim.reset()
    return shared_sim


def steps(sim, n: int = 6) -> tuple[np.ndarray, list[ts.StepReport]]:
    sim.reset()
    reports = [sim.step() for _ in range(n)]
    return sim.positions(), reports


def from_the_host(system, problem, r, scale) -> FrictionalResult:
    """The loop as it is where loops run on threads."""
    newton = Newton(system, problem)
    result = newton.run(r, scale, fresh=True)
    return FrictionalResult(newton.newton, newton.linear, newton.multipliers, newton.negative, result.converged, newton.r)


def counts(reports: list[ts.StepReport]) -> list[tuple[int, int, int]]:
    """Of Newton, CG and multipliers, step by step."""
    return [(r.newton_iterations, r.linear_iterations, r.contact_iterations) for r in reports]


def test_steps_that_count_keep_the_laws_of_light_bodies_too():
    """A light cube slides on a stiff block, beside whose rounding all its impulses are small. First, before one in f64 opens."""
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


def test_impulses_beside_the_rounding_of_a_stiff_body():
    """A soft slab on one ten thousand times as stiff, in f32: |r| is mostly the rounding of the stiff one's stress."""
    scene, mesh = ts.Scene(gravity=(0.0, -9.81, 0.0)), ts.box_mesh((8, 1, 8), (1.0, 0.05, 1.0))
    turned = ts.TetMesh(mesh.vertices @ rotation((0.0, 1.0, 0.0), 0.8).T, mesh.tets)
    for name, one, young, height in (("lower", mesh, 1e8, 0.0255), ("upper", turned, 1e4, 0.077)):
        material = ts.Material(young=young, poisson=0.4, density=1500.0, friction=0.1)
        scene.add_body(one, material, name=name, position=(0, height, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.1)
    with ts.Simulator(scene, dt=1 / 120, integrator="implicit_euler", precision="f32") as sim:
        reports = [sim.step() for _ in range(30)]
    assert all(report.converged and report.contact_residual <= 1e-4 for report in reports)
    assert sum(report.newton_iterations for report in reports) <= 10 * len(reports) and reports[-1].n_contacts > 50


def test_both_loops_find_the_same_step(sim, monkeypatch):
    x, reports = steps(sim)
    whole = [report.newton_iterations for report in reports if report.substeps == 1]
    assert all(report.converged for report in reports) and len(whole) >= 3 and max(whole) <= 10
    assert max(report.n_contacts for report in reports) > 10
    monkeypatch.setattr(contact_newton, "solve_linear", from_the_host)
    host, others = steps(sim)
    assert all(report.converged for report in others) and np.abs(host - x).max() < 1e-8  # [m]
    assert counts(others) == counts(reports)


def test_extrapolated_multipliers_end_where_others_do(sim, monkeypatch):
    """And sooner; both loops alike."""
    x, reports = steps(sim)
    monkeypatch.setattr(implicit, "Stage", partial(Stage, extrapolate_after=0))
    other, others = steps(sim)
    assert all(report.converged for report in others) and np.abs(other - x).max() < 1e-8  # [m]
    assert sum(report.contact_iterations for report in others) < 0.9 * sum(report.contact_iterations for report in reports)
    monkeypatch.setattr(contact_newton, "solve_linear", from_the_host)
    assert counts(steps(sim)[1]) == counts(others)


def test_solves_after_the_first_are_looser(sim):
    """Unless their tolerance is the user's."""
    steps(sim, 2)
    solver, stage = sim._dynamics.stepper.solver, Stage(1.0, DT, DT, 1e-6, linear_tolerance=1e-4, later_tolerance=1e-2)
    newton = Newton(solver, stage)
    assert newton._linear_tolerance() == 1e-4
    newton.newton = 1
    assert newton._linear_tolerance() == 1e-2
    newton.stage = replace(stage, later_tolerance=0.0)
    assert newton._linear_tolerance() == 1e-4


@pytest.mark.parametrize("given", [None, 1e-5])
def test_tight_problems_extrapolate_at_once(sim, monkeypatch, given):
    """And loosen all solves but the first; not where the user says how well they are solved."""
    problems = []

    def solve(system, problem, r, scale):
        problems.append((system.stage, problem))
        return from_the_host(system, problem, r, scale)

    monkeypatch.setattr(contact_newton, "NEAR_FLOOR", np.inf)  # only rounding, as it were
    monkeypatch.setattr(contact_newton, "solve_linear", solve)
    monkeypatch.setattr(sim._dynamics.stepper, "linear_tolerance", given)
    steps(sim, 2)
    assert problems
    for stage, problem in problems:
        assert problem.extrapolate_after == 0
        assert (problem.linear_tolerance, problem.later_tolerance) == ((given, 0.0) if given else (stage.tolerance, 1e-2))


def test_on_threads_it_is_the_same_step(sim, monkeypatch):
    x, _ = steps(sim)
    monkeypatch.setattr(model, "PARALLEL_FROM", 0)
    monkeypatch.setattr(model, "PARALLEL_THREADS", 1)
    with simulator() as parallel:
        assert not parallel._dynamics.state.model.serial
        other, reports = steps(parallel)
    assert all(report.converged for report in reports) and np.abs(other - x).max() < 1e-8  # [m]


def test_many_launches_are_one(sim, monkeypatch):
    x, reports = steps(sim)
    monkeypatch.setattr(pcg, "SERIAL_WORK", 1)  # one iteration a launch
    again, others = steps(sim)
    assert np.array_equal(again, x) and [r.linear_iterations for r in others] == [r.linear_iterations for r in reports]


def test_a_retry_begins_where_the_last_try_ended(sim):
    steps(sim, 2)
    stepper, x_start = sim._dynamics.stepper, sim.positions()
    result = stepper.take_substep(sim.time, DT)
    x, v = sim.positions(), sim.velocities()
    stepper.restore_start()
    assert result.converged and np.array_equal(sim.positions(), x_start)
    again = stepper.retry_substep(sim.time, DT, v)
    assert again.converged and 2 * again.newton_iterations < result.newton_iterations
    assert np.abs(sim.positions() - x).max() < 1e-8  # [m]


def test_a_stage_ends_at_its_limit(sim, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON_WITH_CONTACTS", 1)
    steps(sim, 2)
    result = sim._dynamics.stepper.take_substep(sim.time, DT)
    assert not result.converged and 1 <= result.newton_iterations <= 1 + FALLBACK_STEPS


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_laws_are_solved_to_their_own_tolerance(tolerance):
    """Also where that is much below that of |r|."""
    with ts.Simulator(cubes(), dt=DT, precision="f64", newton_tolerance=tolerance, contact_tolerance=1e-3 * tolerance) as sim:
        reports = [sim.step() for _ in range(4)]
    assert max(report.n_contacts for report in reports) > 10
    assert sum(report.converged for report in reports) >= 3


def test_laws_hold_where_tets_are_inverted(sim):
    """The upper cube squeezed flat as it lands: its matrix is indefinite."""
    x = sim.positions("upper")
    middle = x.mean(axis=0)
    sim.set_state(positions=middle + (x - middle) * (1.0, 0.15, 1.0) - (0, 0.05, 0), body="upper")
    solver, formed = sim._dynamics.stepper.solver, []

    def form_matrix(projected=False):
        formed.append(projected)
        StageSystem.form_matrix(solver, projected)

    solver.form_matrix = form_matrix
    try:
        report = sim.step()
    finally:
        del solver.form_matrix
    assert any(formed) and not all(formed) and report.converged
    c = sim.contacts()
    normal = np.einsum("ij,ij->i", c.impulse, c.normal)
    along = np.linalg.norm(c.impulse - normal[:, None] * c.normal, axis=1)
    assert (normal >= 0.0).all() and (along <= 0.5 * normal + 1e-9 * normal.max()).all() and normal.max() > 0.0


def test_a_linearised_step_of_an_indefinite_matrix(sim, monkeypatch):
    monkeypatch.setattr(sim._dynamics.stepper, "scheme", SCHEMES["linearly_implicit_euler"])
    x = sim.positions("upper")
    middle = x.mean(axis=0)
    sim.set_state(positions=middle + (x - middle) * (1.0, 0.15, 1.0) - (0, 0.05, 0), body="upper")
    solver, formed = sim._dynamics.stepper.solver, []

    def form_matrix(projected=False):
        formed.append(projected)
        StageSystem.form_matrix(solver, projected)

    monkeypatch.setattr(solver, "form_matrix", form_matrix)
    report = sim.step()
    assert any(formed) and not formed[0] and np.isfinite(sim.positions()).all()
    assert report.contact_residual <= 1e-9 or not report.converged
