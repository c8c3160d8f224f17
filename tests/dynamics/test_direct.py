"""Direct solves of the frictional problems of implicit stages, on cubes that land on each other and on the ground:

* the state is that of iterations, in no more Newton iterations: with friction, without it, with moved nodes, in linearised
  steps, and for a rigid cube on a soft one, also where only problems whose iterations take long are solved directly;
* where a solve is refused or impossible, iterations go on as if it had not been tried;
* runs are the same bits after a reset and from a checkpoint.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

import taisoft as ts
from taisoft.contact import augmented_lagrangian, semismooth
from taisoft.dynamics.direct import DirectSolver
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.friction import Goal, Solution
from taisoft.dynamics.frictional_problems import FrictionalProblems
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.dynamics.renewal import Renewal
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage import Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.linear.multifrontal import Multifrontal
from tests.collision.rotations import rotation
from tests.dynamics.companion import opened
from tests.dynamics.contact_scenes import FRICTION, SIDE, cube, ground, material
from tests.dynamics.scenes import dynamics

TIGHT = {"newton_tolerance": 1e-10, "contact_tolerance": 1e-10}
SETTINGS = {"dt": 0.004, "precision": "f64", **TIGHT}


@pytest.fixture(autouse=True)
def geometry_of_the_start(monkeypatch):
    """Contacts keep it: where it is looked at again depends on the iterates."""
    monkeypatch.setattr(Renewal, "MAX_LOOKS", 0)


def cubes(friction: float = FRICTION, moved: bool = False) -> ts.Scene:
    """A turned cube lands on another one, which falls on the ground. moved: some nodes of the lower one."""
    scene, mesh = ts.Scene(gravity=(1.0, -9.81, 0.0)), cube(2)
    turned = ts.TetMesh(mesh.vertices @ rotation((1.0, 0.2, 0.5), 0.2).T, mesh.tets)
    rubber = material(young=2e5, poisson=0.4, friction=friction)
    lower = scene.add_body(mesh, rubber, name="lower", position=(0, 2e-4, 0))
    height = SIDE + 0.002 - turned.vertices[:, 1].min()
    scene.add_body(turned, rubber, name="upper", position=(0.02, height, 0.01), velocity=(0.3, -1, 0))
    if moved:
        lower.fix([0, 1], axes="x")
        lower.move(lambda X: (X[:, 1] > 0.99 * SIDE) & (X[:, 0] < -0.49 * SIDE), lambda t: (0.1 * t, -0.2 * t, 0.0))
    scene.add_obstacle(ground(), name="ground", friction=friction)
    return scene


def rigid_on_soft() -> ts.Scene:
    scene, mesh = ts.Scene(), cube(1)
    turned = ts.TetMesh(mesh.vertices @ rotation((1.0, 0.2, 0.5), 0.1).T, mesh.tets)
    scene.add_body(cube(2), material(), name="soft").fix(lambda X: X[:, 1] < 0.01)
    at = (0.01, SIDE + 2e-4 - turned.vertices[:, 1].min(), 0.0)
    scene.add_rigid_body(turned, name="rigid", position=at, velocity=(0.2, -0.5, 0.0), friction=FRICTION)
    return scene


@contextmanager
def iterating() -> Iterator[None]:
    """Solve no problem directly."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StageSystem, "solve_directly", lambda *given: None)
        patch.setattr(StageSystem, "patience", math.inf)
        yield


@contextmanager
def direct(patience: float | None = None) -> Iterator[list]:
    """Solve all problems directly at once, or with that patience [s]; yield their results."""
    solve, found = DirectSolver.solve, []
    with pytest.MonkeyPatch.context() as patch:
        if patience is None:
            patch.setattr(FrictionalProblems, "is_direct", True)
        else:
            patch.setattr(StageSystem, "patience", patience)
        patch.setattr(DirectSolver, "solve", lambda *given: found.append(solve(*given)) or found[-1])
        yield found


def run(made: Dynamics | ts.Simulator, n: int = 5) -> tuple[np.ndarray, list[ts.StepReport]]:
    """Positions and velocities, and reports of n steps from the start."""
    made.reset()
    reports = [made.advance(1) for _ in range(n)]
    state = made.state.state() if isinstance(made, Dynamics) else (made.positions(), made.velocities())
    return np.stack(state[:2]), reports


def assert_same_motion(made: Dynamics | ts.Simulator, patience: float | None = None) -> None:
    with iterating():
        expected, iterated = run(made)
    with direct(patience) as found:
        state, reports = run(made)
    assert len(found) >= 5 and None not in found and all(converged for _, converged, _ in found)
    assert all(report.converged and report.contact_residual <= 1e-10 for report in (*iterated, *reports))
    assert max(report.n_contacts for report in reports) > 3
    assert all(a.newton_iterations <= b.newton_iterations for a, b in zip(reports, iterated))
    assert np.abs(state[0] - expected[0]).max() < 1e-10 and np.abs(state[1] - expected[1]).max() < 1e-8  # [m], [m/s]


@pytest.fixture(scope="module")
def soft() -> Iterator[Dynamics]:
    with dynamics(cubes(), **SETTINGS) as made:
        yield made


@pytest.mark.parametrize("scene", [cubes(), cubes(friction=0.0), cubes(moved=True)], ids=["friction", "none", "moved"])
def test_soft_cubes_move_as_with_iterations(scene):
    with dynamics(scene, **SETTINGS) as made:
        assert_same_motion(made)


def test_linearised_steps_move_as_with_iterations(soft, monkeypatch):
    monkeypatch.setattr(soft.stepper, "scheme", SCHEMES["linearly_implicit_euler"])
    assert_same_motion(soft)


@pytest.mark.parametrize("patience", [None, 0.0], ids=["at once", "after iterations"])
def test_a_rigid_cube_on_a_soft_one_moves_as_with_iterations(patience):
    with opened(rigid_on_soft(), "implicit_euler", 0.004, **TIGHT) as sim:
        assert_same_motion(sim, patience)


def test_patterns_of_large_meshes_are_not_analysed(soft, monkeypatch):
    """Which takes seconds, and memory."""
    monkeypatch.setattr(DirectSolver, "MOST_NODES", 1)
    monkeypatch.setattr(DirectSolver, "_analyse", lambda _self: pytest.fail("it was analysed"))
    with direct() as found:
        run(soft, 2)
    assert not found


def test_iterations_are_tried_again_ever_more_rarely(soft, monkeypatch):
    """By the first problem of a stage, whatever the number of problems in one."""
    goal = Goal(norm=1.0, law=1.0, inner=1.0, forcing=0.1)
    for n_problems in (1, 2, 3):
        monkeypatch.setattr(soft.stepper.solver, "n_direct", 0)
        monkeypatch.setattr(soft.stepper.solver, "n_in_vain", 0)
        tried = 0
        for _ in range(100):
            problems = FrictionalProblems(soft.stepper.solver, Stage(1.0, 0.01, 0.01, 1e-8))
            for _ in range(n_problems):
                tried += not problems.is_direct
                problems.count(goal, Solution(1 if problems.is_direct else 9, 0, 0, False, True, 0.0, direct=True))
        intervals = np.minimum(FrictionalProblems.TRIAL << np.arange(20), FrictionalProblems.RAREST)
        assert abs(tried - np.searchsorted(np.cumsum(intervals), 100 * n_problems)) <= 1 + n_problems // 3


def refuse(patch: pytest.MonkeyPatch) -> None:
    """Refuse whatever leaves a residual of the laws."""
    solve = DirectSolver.solve
    patch.setattr(
        DirectSolver, "solve", lambda self, k, beta, tolerance, _, *given: solve(self, k, beta, tolerance, -1.0, *given)
    )


def find_indefinite(patch: pytest.MonkeyPatch) -> None:
    def factorise(*_):
        raise np.linalg.LinAlgError

    patch.setattr(Multifrontal, "factorise", factorise)


def find_too_large(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(DirectSolver, "LARGEST", 0.0)


@pytest.mark.parametrize("reject", [refuse, find_indefinite, find_too_large])
def test_iterations_go_on_from_where_a_rejected_solve_began(soft, monkeypatch, reject):
    with iterating():
        expected, iterated = run(soft, 3)
    prepare, tried = DirectSolver.prepare, []
    monkeypatch.setattr(DirectSolver, "prepare", lambda *given: tried.append(prepare(*given)) or tried[-1])
    monkeypatch.setattr(StageSystem, "patience", math.inf)
    reject(monkeypatch)
    with direct() as found:
        state, reports = run(soft, 3)
    n_problems = sum(report.newton_iterations for report in reports)
    assert not any(found) and tried == ([True] * n_problems if reject is refuse else [False] * 3)  # once a problem, once a stage
    assert np.array_equal(state, expected) and reports == iterated


def test_runs_are_repeated_bitwise(tmp_path):
    """Some of their problems are solved directly at once, others after iterations: that is part of a checkpoint."""
    path, scene = tmp_path / "c.npz", rigid_on_soft()
    with opened(scene, "implicit_euler", 0.004, **TIGHT) as sim, direct(patience=0.0) as found:
        first, reports = run(sim, 3)
        sim.save_checkpoint(path)
        n_before = len(found)
        reports += [sim.advance(1) for _ in range(3)]
        n_found, last = len(found), np.stack([sim.positions(), sim.velocities()])
        assert None not in found and n_before % FrictionalProblems.TRIAL > 0 and n_found > n_before
        state, again = run(sim, 6)
        assert np.array_equal(state, last) and again == reports and len(found) == 2 * n_found
    with ts.Simulator.load_checkpoint(path, scene) as sim, direct(patience=0.0) as found:
        assert np.array_equal([sim.positions(), sim.velocities()], first)
        assert [sim.advance(1) for _ in range(3)] == reports[3:] and len(found) == n_found - n_before
        assert np.array_equal([sim.positions(), sim.velocities()], last)


@pytest.mark.parametrize("is_late", [False, True])
def test_the_augmented_lagrangian_ends_with_the_time_of_a_step(soft, monkeypatch, is_late):
    """Where Newton's method on W fails; iterations go on then, and end as the rest of the step."""
    counts, solve = [], augmented_lagrangian.solve
    monkeypatch.setattr(semismooth, "solve", lambda *given: None)
    monkeypatch.setattr(augmented_lagrangian, "solve", lambda *given: counts.append((found := solve(*given))[1]) or found)
    monkeypatch.setattr(soft.state, "budget", 1e3)
    monkeypatch.setattr(NewtonBudget, "is_out_of_time", lambda self: is_late)
    with direct():
        run(soft, 3)
    assert counts and all((len(history) == 1) == is_late for history in counts if history[0] > 1e-8)
