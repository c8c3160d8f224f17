"""A light body beside a heavy one moves as it does alone, although its forces are below the tolerance of the whole scene.

A step that cannot achieve that reports it, and does not count as converged.
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import read_checkpoint, write_checkpoint
from taisoft.dynamics import implicit
from tests.dynamics.contact_scenes import material
from tests.dynamics.scenes import dynamics

G, TOLERANCE = 9.81, 1e-4  # [m/s^2]; of Newton's method
SETTINGS = {"precision": "f64", "newton_tolerance": TOLERANCE}


@pytest.fixture
def scene() -> ts.Scene:
    """A cube of 1 m that hangs, and one of 4 cm that falls beside it; they do not touch."""
    made = ts.Scene(gravity=(0, -G, 0))
    made.contact_forces = False
    rubber = material(young=1e6)
    made.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber, name="big").fix(lambda X: X[:, 1] > 0.49)
    made.add_body(ts.box_mesh((1, 1, 1), (0.04,) * 3), rubber, name="small", position=(3, 0, 0))
    return made


def test_a_light_body_falls_beside_a_heavy_one(scene, monkeypatch):
    steps, dt, solve = 15, 1 / 60, implicit.solve
    with ts.Simulator(scene, dt=dt, **SETTINGS) as sim:
        for _ in range(60):  # until the heavy body is nearly at rest
            sim.set_state(velocities=np.zeros_like(sim.velocities("big")), body="big")
            sim.step()
        rest, start = sim.positions("big"), scene.body("small").rest_positions + (3, 0, 0)
        for second_solve in (True, False):
            sim.set_state(positions=rest, velocities=np.zeros_like(rest), body="big")
            sim.set_state(positions=start, velocities=np.zeros_like(start), body="small")
            if not second_solve:
                monkeypatch.setattr(implicit, "solve", lambda system, stage: solve(system, replace(stage, tolerance=TOLERANCE)))
            reports = [sim.step() for _ in range(steps)]
            speed = sim.velocities("small")[:, 1].mean()
            if second_solve:
                assert all(report.converged for report in reports)
                assert speed == pytest.approx(-G * steps * dt, rel=1e-2)
            else:
                assert speed > -0.9 * G * steps * dt
                bad = [report for report in reports if not report.converged]
                assert bad and all(report.residual > 0.01 for report in bad)
                assert any("forces on body 'small' are unbalanced" in text for report in bad for text in report.problems)


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
    with ts.Simulator(made, dt=0.01, integrator=integrator, **SETTINGS) as sim:
        for _ in range(30):
            assert sim.step().converged
        speed = sim.velocities()[-cube.n_verts :].mean(axis=0)
    assert speed == pytest.approx((0.0, -G * 0.3, 0.0), abs=0.015 * G * 0.3)


def test_a_checkpoint_holds_the_rounding_floor(scene, tmp_path):
    """The floor belongs to the state at the last change of numbers, not to the state that is loaded."""

    def floor(made) -> list[float]:
        rounding = made.stepper.solver.rounding
        return [rounding.position, *rounding.force_by_body]

    path = tmp_path / "c.npz"
    with dynamics(scene, **SETTINGS) as made:
        start = floor(made)
        x, v = made.state.state()
        x[-scene.body("small").n_nodes :] += 100.0
        made.state.set_state(x, v)
        made.numbers_changed()
        saved = floor(made)
        write_checkpoint(path, {}, scene, {}, made.snapshot(), {})
    with dynamics(scene, **SETTINGS) as made:
        made.restore(read_checkpoint(path).state)
        assert floor(made) == saved != start
