"""Newton's method of implicit steps with contacts, on a tilted cube that lands on the ground and on another cube:

* linear solves cut into many launches give the same bits, and extrapolated multipliers the same step in fewer updates;
* a step takes few Newton iterations, also with an indefinite matrix; impulses satisfy the contact laws, also with a tolerance
  far below that of |r|, and where |r| is mostly rounding; a problem that stalls, as between flush blocks, is solved directly.
"""

import inspect

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.friction import Friction
from taisoft.dynamics.frictional_problems import FrictionalProblems
from taisoft.dynamics.renewal import Renewal
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage_system import StageSystem
from taisoft.linear import gauss_seidel
from tests.collision.rotations import rotation
from tests.dynamics.contact_scenes import FRICTION, ground, material
from tests.dynamics.scenes import dynamics, set_state

DT = 0.004  # [s]: nothing passes through anything on the way, so that steps depend smoothly on rounding
SETTINGS = {"dt": DT, "precision": "f64", "newton_tolerance": 1e-10, "contact_tolerance": 1e-9}


def cubes(lower_young: float = 2e5) -> ts.Scene:
    scene = ts.Scene(gravity=(1.0, -9.81, 0.0))
    mesh = ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1))
    turned = ts.TetMesh(mesh.vertices @ rotation((1.0, 0.2, 0.5), 0.4).T, mesh.tets)
    scene.add_body(mesh, material(young=lower_young, poisson=0.4), name="lower", position=(0, 0.0502, 0))
    scene.add_body(turned, material(young=2e5, poisson=0.4), name="upper", position=(0.02, 0.185, 0.01), velocity=(0.3, -1, 0))
    scene.add_obstacle(ground(), name="ground", friction=FRICTION)
    return scene


@pytest.fixture(scope="module")
def shared_dynamics(taken_path):
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


def counts(reports: list[ts.StepReport]) -> list[tuple[int, int, int]]:
    return [(r.newton_iterations, r.linear_iterations, r.contact_iterations) for r in reports]


def test_steps_take_few_iterations_and_extrapolated_multipliers_fewer(made, monkeypatch):
    """However many iterations of a linear solve a launch takes; on the geometry of the start, which does not depend on them."""
    monkeypatch.setattr(Renewal, "MAX_LOOKS", 0)
    x, reports = steps(made)
    whole = [report.newton_iterations for report in reports if report.substeps == 1]
    assert all(report.converged for report in reports) and len(whole) >= 3 and max(whole) <= 12
    assert max(report.n_contacts for report in reports) > 10
    with monkeypatch.context() as patch:
        goal = FrictionalProblems.goal
        patch.setattr(FrictionalProblems, "goal", lambda *given: goal(*given)._replace(plain=0))
        extrapolated, sooner = steps(made)
        assert np.abs(extrapolated - x).max() < 1e-8  # [m]
        assert sum(report.contact_iterations for report in sooner) < 0.9 * sum(r.contact_iterations for r in reports)
    monkeypatch.setattr(gauss_seidel, "SERIAL_WORK", 1)  # one iteration a launch
    again, others = steps(made)
    assert np.array_equal(again, x) and counts(others) == counts(reports)


def test_linear_solves_are_at_most_thirteen_calls_deep(made, monkeypatch):
    """Those with contacts. Two of them are those of `Simulator`."""
    solve, depths = gauss_seidel.solve, []

    def counted(*given):
        frame, depth = inspect.currentframe().f_back, 3
        while frame.f_code is not Dynamics.advance.__code__:
            frame, depth = frame.f_back, depth + 1
        depths.append(depth)
        return solve(*given)

    monkeypatch.setattr(gauss_seidel, "solve", counted)
    steps(made, 3)
    assert made.contact.n_contacts > 0 and 0 < max(depths) <= 13 - 1


def test_contact_laws_converge_to_their_own_tolerance(made, monkeypatch):
    """Here far below that of |r|."""
    monkeypatch.setattr(made.stepper, "tolerance", 1e-3)
    monkeypatch.setattr(made.stepper, "contact_tolerance", 1e-6)
    _, reports = steps(made, 4)
    assert max(report.n_contacts for report in reports) > 10
    assert sum(report.converged and report.contact_residual <= 1e-6 for report in reports) >= 3


def test_rounding_of_a_stiff_cube_does_not_hide_what_lands_on_it():
    """|r| is mostly the rounding of its stress, below which only tight solves find the motion and the impulses."""
    with dynamics(cubes(lower_young=1e14), dt=DT, precision="f64") as made:
        _, reports = steps(made, 4)
    assert all(report.converged and report.newton_iterations < 40 for report in reports) and reports[-1].n_contacts > 10


def test_impulses_below_the_rounding_of_momenta_need_not_obey_the_laws(made, monkeypatch):
    """Where bodies drift together without a load, their contacts have nothing but rounding to carry."""
    _, reports = steps(made)
    system = made.stepper.solver
    assert reports[-1].n_contacts > 10 and not system.impulses_are_rounding()
    monkeypatch.setattr(system.rounding, "eps", 1e6)
    assert system.impulses_are_rounding()


def test_flush_blocks_come_to_rest():
    """Their redundant contacts exchange impulses, so that iterations stall in one step of four: those are solved directly."""
    scene = ts.Scene()
    lower = scene.add_body(ts.box_mesh((4, 3, 4), (1.0, 0.5, 1.0)), material(young=2e5, poisson=0.4, density=1000), name="lower")
    lower.fix(lambda X: X[:, 1] < -0.24)
    scene.add_body(ts.box_mesh((3, 3, 3), (0.6, 0.5, 0.6)), lower.material, name="upper", position=(0.03, 0.5005, 0.02))
    scene.add_obstacle(ts.HalfSpace((0, -1, 0), (0, 1, 0)), name="ground", friction=FRICTION)
    with dynamics(scene, dt=0.01, precision="f64") as made:
        _, reports = steps(made, 24)
    assert all(report.converged for report in reports) and reports[-1].n_contacts > 30
    assert sum(report.newton_iterations for report in reports) < 200


def test_a_direct_solve_goes_on_where_iterations_ended(made, monkeypatch):
    """Of the same frictional problem, cut off after two multipliers: the same motion."""
    monkeypatch.setattr(made.stepper, "scheme", SCHEMES["linearly_implicit_euler"])
    expected, _ = steps(made, 4)
    found, solve = [], StageSystem.solve_directly
    monkeypatch.setattr(StageSystem, "solve_directly", lambda self, *given: found.append(solve(self, *given)) or found[-1])
    monkeypatch.setattr(Friction, "MAX_UPDATES", 2)
    x, _ = steps(made, 4)
    assert any(one is not None for one in found) and np.abs(x - expected).max() < 1e-8


@pytest.mark.parametrize("scheme", ["implicit_euler", "linearly_implicit_euler"])
def test_contact_laws_hold_with_an_indefinite_matrix(made, monkeypatch, scheme):
    """The upper cube is squeezed flat as it lands. Where the matrix is indefinite, a projected one is used."""
    x, upper = positions(made), made.state.layout.nodes(1)
    middle = x[upper].mean(axis=0)
    x[upper] = middle + (x[upper] - middle) * (1.0, 0.15, 1.0) - (0, 0.05, 0)
    set_state(made, x)
    solver, projections = made.stepper.solver, []

    def form_matrix(projected=False):
        projections.append(projected)
        StageSystem.form_matrix(solver, projected)

    monkeypatch.setattr(solver, "form_matrix", form_matrix)
    monkeypatch.setattr(made.stepper, "scheme", SCHEMES[scheme])
    report = made.advance(1)
    assert any(projections) and not projections[0] and np.isfinite(positions(made)).all()
    if scheme == "linearly_implicit_euler":
        return
    assert report.converged
    c = made.contact.contacts()
    normal = np.einsum("ij,ij->i", c.impulse, c.normal)
    tangential = np.linalg.norm(c.impulse - normal[:, None] * c.normal, axis=1)
    assert (normal >= 0.0).all() and (tangential <= 0.5 * normal + 1e-9 * normal.max()).all() and normal.max() > 0.0
