"""Newton's method of implicit steps with contacts, on a tilted cube that lands on the ground and on another cube:

* linear solves cut into many launches give the same bits, and extrapolated multipliers the same step in fewer updates;
* a step takes few Newton iterations, also with an indefinite matrix; impulses satisfy the contact laws, also with a tolerance
  far below that of |r|, and where |r| is mostly rounding; a problem that stalls, as between flush blocks, is solved directly.

Nonlinear elimination: steps that are first solved on the fewest nodes that hold nearly all of the residual, and two rings around
them, move only these, lower the residual, and find the same result in fewer iterations, with and without contacts.
"""

from functools import partial

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_newton, implicit
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.elimination import CONCENTRATED, FEW, choose_nodes, eliminate
from taisoft.dynamics.friction import Friction
from taisoft.dynamics.renewal import Renewal
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage import STAY, Stage
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
        patch.setattr(implicit, "Stage", partial(Stage, extrapolate_after=0))
        extrapolated, sooner = steps(made)
        assert np.abs(extrapolated - x).max() < 1e-8  # [m]
        assert sum(report.contact_iterations for report in sooner) < 0.9 * sum(r.contact_iterations for r in reports)
    monkeypatch.setattr(gauss_seidel, "SERIAL_WORK", 1)  # one iteration a launch
    again, others = steps(made)
    assert np.array_equal(again, x) and counts(others) == counts(reports)


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
    monkeypatch.setattr(Friction, "MAX_MULTIPLIERS", 2)
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


def beam(on_ground: bool) -> ts.Scene:
    """A beam fixed at its left end, optionally with a ground just below it."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((10, 3, 3), (1.0, 0.3, 0.3)), material(), name="beam", position=(0.0, 0.1501, 0.0))
    body.fix(lambda X: X[:, 0] < -0.49)
    if on_ground:
        scene.add_obstacle(ground(), name="ground", friction=0.5)
    return scene


def pinched(scene: ts.Scene) -> np.ndarray:
    """Positions with one node pushed through its tets, far from the fixed end."""
    x = scene.bodies[0].rest_positions + scene.bodies[0].position
    x[np.argmin(np.abs(x - [0.2, 0.25, 0.0]).sum(axis=1))] -= [0.0, 0.25, 0.0]
    return x


def test_nodes_are_chosen_as_by_sorting_all():
    """Also where a cheaper bound refuses them: residuals from smooth to all on one node, and none."""
    rng, n, found = np.random.default_rng(5), 40, set()
    start, column = np.arange(0, 2 * n + 1, 2), np.clip(np.arange(n)[:, None] + (-1, 1), 0, n - 1)  # a chain
    for power in (0.0, 1.0, 2.0, 3.0, 5.0, 9.0, 40.0, np.inf):
        residual = rng.standard_normal((n, 3)) * np.maximum(np.arange(1, n + 1.0), 1.0)[rng.permutation(n), None] ** -power
        squares = np.sort((residual**2).sum(axis=1))[::-1].cumsum()
        few = squares[-1] > 0.0 and squares[int(FEW * n) - 1] >= CONCENTRATED * squares[-1]
        nodes = choose_nodes(residual, start, column.reshape(-1))
        assert (nodes is not None) == few
        found.add(few)
    assert found == {False, True} and choose_nodes(np.full((n, 3), np.nan), start, column.reshape(-1)) is None


def check_elimination(system: StageSystem, stage, r: float):
    """Eliminate, and check what changes."""
    lists, free, state = system.lists, system.model.free.to_numpy(), system.model.state
    nodes = choose_nodes(free * system.work.residual.to_numpy(), lists.start, lists.column)
    before = state.x.to_numpy()
    found = eliminate(system, stage, r)
    assert (found is None) == (nodes is None) and not system.work.pcg.subset.restricted
    if found is not None:
        moved = (state.x.to_numpy() != before).any(axis=1)
        assert 0 < moved.sum() <= len(nodes) < len(before) and not moved[np.setdiff1d(np.arange(len(before)), nodes)].any()
        left, _ = system.evaluate(None)  # with the same multipliers
        inside = (free * system.work.residual.to_numpy())[nodes]
        assert left < 0.9 * r and np.linalg.norm(inside) < 0.11 * r
        assert system.evaluate(STAY)[0] == pytest.approx(left, rel=1e-9)  # forces were up to date
    return found


@pytest.mark.parametrize("on_ground", [False, True])
def test_steps_with_and_without_eliminations_agree(monkeypatch, on_ground):
    """With eliminations, they take fewer Newton and CG iterations; with contacts, three quarters of the CG iterations.

    Direct solves, which help as much there, are left out.
    """
    monkeypatch.setattr(StageSystem, "solve_directly", lambda *_: None)
    results, found = [], []

    def checked(system, stage, r):
        found.append(check_elimination(system, stage, r))
        return found[-1]

    for function in (checked, lambda system, stage, r: None):
        monkeypatch.setattr(contact_newton, "eliminate", function)
        with ts.Simulator(beam(on_ground), dt=0.01, precision="f64", newton_tolerance=1e-9, contact_tolerance=1e-8) as sim:
            sim.set_state(positions=pinched(sim.scene))
            results.append((sim.step(), sim.positions()))
    (report, x), (without, x_without) = results
    assert any(one is not None for one in found) and report.converged and without.converged
    assert (report.n_contacts > 0) == on_ground
    assert np.abs(x - x_without).max() < 1e-7
    assert report.linear_iterations < (0.8 if on_ground else 1.0) * without.linear_iterations
    assert report.newton_iterations < without.newton_iterations or on_ground
