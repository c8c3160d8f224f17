"""Where Newton's method starts: at the motion carried on, or at v = 0 where |r| is less there.

* a calm step and one in fast flight keep their first iterate;
* a wild one starts at v = 0, and the direction that is left leads back;
* with contacts too, where that direction comes first: the step is the one that another start comes to, in fewer iterations
  where it leads somewhere.
"""

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


def beam(fixed: bool = True, ground: bool = False) -> ts.Simulator:
    scene = ts.Scene()
    body = scene.add_body(cube(cells=(3, 3, 3)), rubber(friction=0.5), name="beam", position=(0.0, 0.501, 0.0))
    if fixed:
        body.fix(lambda X: X[:, 0] < -0.49)
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return ts.Simulator(scene, dt=0.01, integrator="implicit_euler", precision="f64", newton_tolerance=1e-9)


@pytest.fixture
def seen(monkeypatch):
    """What each start did: |r| and scale of before, of after, whether it moved, and positions before, after and back."""
    starts = []

    def spy(system, r, scale):
        x = system.model.state.x.to_numpy()
        found = choose_start(system, r, scale)
        after = system.model.state.x.to_numpy()
        back = None
        if found[2]:
            r_back, _ = system.evaluate(STEP)
            back = system.model.state.x.to_numpy(), r_back
            system.evaluate(AGAIN, 0.0)
        starts.append(((r, scale), found, x, after, back, system.n_contacts))
        return found

    monkeypatch.setattr(contact_newton, "choose_start", spy)
    return starts


def wild(sim, size: float = 100.0) -> np.ndarray:
    """Velocities [m/s] that turn tets inside out in a step."""
    return size * np.random.default_rng(3).standard_normal(sim.positions().shape)


def test_calm_steps_keep_their_start(seen):
    with beam() as sim:
        for _ in range(4):
            assert sim.step().converged
    for _, (_, _, moved), x, after, *_ in seen:
        assert not moved and np.array_equal(x, after)
    r, scale = seen[-1][0]
    assert r <= FAR * scale  # not even looked at


def test_flight_keeps_its_start(seen):
    with beam(fixed=False) as sim:
        sim.set_state(velocities=np.tile((30.0, 0.0, 0.0), (len(sim.positions()), 1)))
        assert sim.step().converged
    (r, scale), (r_after, _, moved), x, after, *_ = seen[0]
    assert r > FAR * scale and not moved and r_after == pytest.approx(r, rel=1e-12)  # it was looked at
    assert np.array_equal(x, after)


@pytest.mark.parametrize("ground", [False, True])
def test_a_wild_step_starts_at_rest(seen, ground):
    with beam(ground=ground) as sim:
        start, velocities = sim.positions(), wild(sim)
        sim.set_state(velocities=velocities)
        sim.step()
        fixed = start[:, 0] < -0.49
    (r, scale), (r_after, _, moved), x, after, (back, r_back), n_contacts = seen[0]
    assert (n_contacts > 0) == ground
    assert moved and r > FAR * scale and r_after < r
    assert np.abs(after - start).max() < 1e-12 and np.array_equal(after[fixed], start[fixed])
    assert np.abs(x - start)[~fixed].max() > 0.1
    assert np.abs(back - x).max() < 1e-10 and r_back == pytest.approx(r, rel=1e-6)


@pytest.mark.parametrize("root", [True, False])
def test_contacts_end_where_another_start_does(seen, monkeypatch, root):
    """root: whether the direction back has one; else it is dropped."""
    advanced = []

    def advance(system):
        advanced.append(ADVANCE(system))
        if not root:
            system.model.state.scalars[STEP_LENGTH] = LONGEST
        return advanced[-1]

    monkeypatch.setattr(StageSystem, "advance", advance)
    found, iterations, starts = [], [], []
    for far in (FAR, np.inf):
        monkeypatch.setattr(newton, "FAR", far)
        seen.clear()
        with beam(fixed=False, ground=True) as sim:
            sim.set_state(velocities=wild(sim, 20.0) - (0.0, 3.0, 0.0))
            reports = [sim.step() for _ in range(2)]
        assert all(report.converged for report in reports) and reports[-1].n_contacts > 0
        found.append(reports[-1].elastic)
        iterations.append(reports[0].newton_iterations)  # the second step has no wild velocities to leave behind
        starts.append(sum(one[1][2] and one[-1] > 0 for one in seen))
    assert starts[0] > 0 and starts[1] == 0 and len(advanced) == starts[0]
    assert found[0] == pytest.approx(found[1], rel=1e-6)
    assert iterations[0] < iterations[1] or not root
