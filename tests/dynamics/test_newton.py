"""Newton's method of the implicit steps:

* it converges quadratically to the given tolerance, and the linear tolerance controls the number of CG iterations;
* a step that stops early returns converged=False and a message; a linearly implicit step takes one iteration;
* wild states (inverted, flat) are left along directions of negative curvature: the energy falls and steps converge;
* statics stops at the rounding of the forces;
* a cube that is free falls beside one under a large load, of the same mesh or not: see also `test_pieces`.
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import read_checkpoint, write_checkpoint
from taisoft.dynamics import implicit_stages
from taisoft.dynamics.newton import solve
from taisoft.dynamics.part_length import PARTS, PartLength
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.stage import Stage
from taisoft.dynamics.stage_system import StageSystem
from tests.dynamics.contact_scenes import material
from tests.dynamics.scenes import cube, dynamics

SETTINGS = {"integrator": "implicit_euler", "precision": "f64", "newton_tolerance": 1e-9}


@pytest.fixture(scope="module")
def shared_dynamics():
    scene = ts.Scene()
    scene.add_body(cube(cells=(2, 1, 1)), material(), name="beam").fix(lambda X: X[:, 0] < -0.49)
    with dynamics(scene, **SETTINGS) as d:
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
    d.stepper.scheme = SCHEMES["linearly_implicit_euler"]
    set_state(d, v=random_velocities(d))
    report = d.advance(1)
    assert report.newton_iterations == 1 and report.converged and report.residual > 1e-6


def test_a_step_that_does_not_converge_is_reported(d, monkeypatch):
    monkeypatch.setattr(implicit_stages, "solve", lambda system, stage: solve(system, replace(stage, max_newton=1)))
    set_state(d, v=3.0 * random_velocities(d))
    d.stepper.tolerance = 1e-13
    report, attempts = (d.advance(1), int(np.log2(PARTS / PartLength.LEAST_UNCONVERGED)) + 2)  # and the rest
    assert not report.converged and report.substeps == 2 and report.newton_iterations == attempts and report.residual > 1e-9
    message = f"step 1: Newton stopped after {attempts} iterations at a relative residual of {report.residual:.2e}; least"
    assert len(report.problems) == 1 and report.problems[0].startswith(message)


@pytest.mark.parametrize("kind", ["inside out", "flat", "random"])
def test_wild_states_are_left_along_negative_curvature(d, kind, monkeypatch):
    """No matrix is projected."""
    solver, indefinite = d.stepper.solver, []

    def solve_linear(tolerance):
        answer = StageSystem.solve_linear(solver, tolerance)
        indefinite.append(answer.negative)
        return answer

    monkeypatch.setattr(solver, "solve_linear", solve_linear)
    rest, rng = d.state.state()[0], np.random.default_rng(1)
    x = {
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


G, TOLERANCE = 9.81, 1e-4  # [m/s^2]; of Newton's method
LOOSE = {"precision": "f64", "newton_tolerance": TOLERANCE}


@pytest.fixture
def scene() -> ts.Scene:
    """A cube of 1 m that hangs, and one of 4 cm that falls beside it; they do not touch."""
    made = ts.Scene(gravity=(0, -G, 0))
    made.contact_forces = False
    rubber = material(young=1e6)
    made.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber, name="big").fix(lambda X: X[:, 1] > 0.49)
    made.add_body(ts.box_mesh((1, 1, 1), (0.04,) * 3), rubber, name="small", position=(3, 0, 0))
    return made


@pytest.mark.parametrize(
    "integrator, young, force, connected",
    [("implicit_euler", 2e11, 2e9, True), ("linearly_implicit_euler", 2e9, 4e8, False)],
    ids=["pieces", "bodies"],
)
def test_a_free_cube_falls_beside_a_loaded_one(integrator, young, force, connected):
    """Two bodies, or two pieces of one mesh; the load is many times the weight."""
    cube, steel = ts.box_mesh((2, 2, 2), (1, 1, 1)), material(young=young)
    made = ts.Scene(gravity=(0, -G, 0))
    if connected:
        apart = np.vstack([cube.vertices, cube.vertices + (5, 0, 0)]), np.vstack([cube.tets, cube.tets + cube.n_verts])
        body = made.add_body(ts.TetMesh(*apart), steel)
    else:
        body = made.add_body(cube, steel)
        made.add_body(cube, steel, position=(5, 0, 0))
        made.contact_forces = False
    body.fix(lambda X: X[:, 0] < -0.49)
    body.add_force(lambda X: (X[:, 0] > 0.49) & (X[:, 0] < 1), (force, 0, 0))
    with ts.Simulator(made, dt=0.01, integrator=integrator, **LOOSE) as sim:
        for _ in range(30):
            assert sim.step().converged
        speed = sim.velocities()[-cube.n_verts :].mean(axis=0)
    assert speed == pytest.approx((0.0, -G * 0.3, 0.0), abs=0.015 * G * 0.3)


def test_a_checkpoint_holds_the_rounding_floor(scene, tmp_path):
    """The floor belongs to the state at the last change of numbers, not to the state that is loaded."""

    def floor(made) -> list[float]:
        rounding = made.stepper.solver.rounding
        return [rounding.position, *rounding.piece_force, *rounding.piece_mass]

    path = tmp_path / "c.npz"
    with dynamics(scene, **LOOSE) as made:
        start = floor(made)
        x, v = made.state.state()
        x[-scene.body("small").n_nodes :] += 100.0
        made.state.set_state(x, v)
        made.numbers_changed()
        saved = floor(made)
        write_checkpoint(path, {}, scene, {}, made.snapshot(), {})
    with dynamics(scene, **LOOSE) as made:
        made.restore(read_checkpoint(path).state)
        assert floor(made) == saved != start
