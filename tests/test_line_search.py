"""The start of Newton's method: the extrapolated motion, or v = 0 if |r| is smaller there.

* calm steps and fast flight keep the extrapolated motion;
* a step with wild velocities starts at v = 0, and the stored direction leads back to the extrapolated motion;
* with contacts, where that direction is searched first, the solution is the same as from the other start, in fewer iterations.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from scenes import cube, rubber

import taisoft as ts
from taisoft.dynamics import contact_newton, newton
from taisoft.dynamics.linearised import LONGEST
from taisoft.dynamics.newton import FAR, choose_start
from taisoft.dynamics.stage import AGAIN, STEP
from taisoft.dynamics.stage_system import StageSystem
from taisoft.fem.state import STEP_LENGTH

ADVANCE = StageSystem.advance


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


def beam(fixed: bool = True, ground: bool = False) -> ts.Simulator:
    scene = ts.Scene()
    body = scene.add_body(cube(cells=(3, 3, 3)), rubber(friction=0.5), name="beam", position=(0.0, 0.501, 0.0))
    if fixed:
        body.fix(lambda X: X[:, 0] < -0.49)
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return ts.Simulator(scene, dt=0.01, integrator="implicit_euler", precision="f64", newton_tolerance=1e-9)


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
    with beam() as sim:
        for _ in range(4):
            assert sim.step().converged
    assert starts and not any(s.moved for s in starts)
    assert all(np.array_equal(s.x, s.x_after) for s in starts)
    assert starts[-1].r <= FAR * starts[-1].scale  # so v = 0 was not evaluated


def test_fast_flight_keeps_the_extrapolated_motion(starts):
    with beam(fixed=False) as sim:
        sim.set_state(velocities=np.tile((30.0, 0.0, 0.0), (len(sim.positions()), 1)))
        assert sim.step().converged
    s = starts[0]
    assert s.r > FAR * s.scale  # so v = 0 was evaluated
    assert not s.moved and s.r_after == pytest.approx(s.r, rel=1e-12) and np.array_equal(s.x, s.x_after)


@pytest.mark.parametrize("ground", [False, True])
def test_a_step_with_wild_velocities_starts_at_rest(starts, ground):
    with beam(ground=ground) as sim:
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
    searches = []

    def advance(system):
        searches.append(ADVANCE(system))
        if not root:
            system.model.state.scalars[STEP_LENGTH] = LONGEST
        return searches[-1]

    monkeypatch.setattr(StageSystem, "advance", advance)
    elastic, iterations, moved = [], [], []
    for far in (FAR, np.inf):
        monkeypatch.setattr(newton, "FAR", far)
        starts.clear()
        with beam(fixed=False, ground=True) as sim:
            sim.set_state(velocities=wild_velocities(sim, 20.0) - (0.0, 3.0, 0.0))
            reports = [sim.step() for _ in range(2)]
        assert all(report.converged for report in reports) and reports[-1].n_contacts > 0
        elastic.append(reports[-1].elastic)
        iterations.append(reports[0].newton_iterations)  # of the step that begins with wild velocities
        moved.append(sum(s.moved and s.n_contacts > 0 for s in starts))
    assert moved[0] > 0 and moved[1] == 0 and len(searches) == moved[0]
    assert elastic[0] == pytest.approx(elastic[1], rel=1e-6)
    assert iterations[0] < iterations[1] or not root
