"""A shot at a thin sheet is stopped or refused, never lost:

* slow shots take whole steps, fast ones are cut into parts: after every step no two triangles intersect, no shot has passed;
* a shot too fast for that is refused with its speed, the sheet's thickness and a step that would do, and the state stays as it
  was; with such a step it is stopped; explicit steps refuse likewise;
* a half-space is thick enough for any speed.
"""

import re

import numpy as np
import pytest

import taisoft as ts

THICK = 0.01  # [m] of the sheet
DT = {"implicit_euler": 1 / 60, "symplectic_euler": 2e-4}  # [s]
SHOT = np.array([0.013, 0.1, 0.01])  # [m] its middle at the start


def scene() -> ts.Scene:
    """A shot over a sheet that is held at two sides, off the middle so that nothing is symmetric; a cube over a plane."""
    made = ts.Scene(gravity=(0, 0, 0))
    rubber = ts.Material(young=1e6, poisson=0.3, density=1000.0)
    sheet = made.add_body(ts.box_mesh((4, 1, 4), (0.4, THICK, 0.4)), rubber, name="sheet")
    sheet.fix(lambda X: np.abs(X[:, 0]) > 0.19)
    for name, at in (("shot", SHOT), ("faller", (5.0, 2.0, 0.0))):
        made.add_body(ts.box_mesh((1, 1, 1), (0.05, 0.05, 0.05)), rubber, name=name, position=at)
    made.add_obstacle(ts.HalfSpace((5, -1, 0), (0, 1, 0)), name="plane")
    return made


@pytest.fixture(scope="module", params=DT)
def shared_sim(request):
    with ts.Simulator(scene(), dt=DT[request.param], integrator=request.param, precision="f64") as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.dt = DT[shared_sim.settings.integrator]
    shared_sim.reset()
    return shared_sim


def shoot(sim, speed: float, body: str = "shot") -> None:
    sim.set_state(velocities=np.tile([0.0, -speed, 0.0], (8, 1)), body=body)


def passed(sim) -> bool:
    """Whether the shot's middle is below the sheet where it meets it."""
    x, sheet = sim.positions("shot").mean(axis=0), sim.positions("sheet")
    near = np.argsort(np.linalg.norm(sheet[:, [0, 2]] - x[[0, 2]], axis=1))[:4]
    return x[1] < sheet[near, 1].min()


def fly(sim, steps: int) -> int:
    """Steps, each checked; the number of those in which the sheet bore an impulse."""
    hits = 0
    for _ in range(steps):
        sim.step()
        assert not passed(sim) and sim.intersecting_triangles() == []
        hits += bool(np.abs(sim.contacts().impulse).max(initial=0.0) > 0)
    return hits


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_a_shot_is_stopped(sim, speed):
    """In implicit steps of 1/60 s: 0.017 m and 0.083 m a step, three times and seventeen times what half the thickness allows."""
    shoot(sim, speed)
    time = 0.1 / speed + 0.06
    assert fly(sim, min(round(time / sim.dt), 400)) >= 2
    assert sim.velocities("shot")[:, 1].mean() > -0.8 * speed


def test_a_shot_too_fast_is_refused(sim):
    speed = (0.75 if sim.settings.explicit else 300.0) * THICK / sim.dt
    shoot(sim, speed)
    sim.set_state(positions=sim.positions("shot") - (0, 0.1 - 0.04 - 0.5 * THICK, 0), body="shot")
    x, v = sim.positions(), sim.velocities()
    with pytest.raises(ts.SimulationError) as told:
        sim.step()
    text = str(told.value)
    number = r"([0-9.e+-]+)"
    found = re.search(
        rf"^step 1: 'sheet' and 'shot' close at {number} m/s, {number} m in a step of {number} s, and the thinner of them is "
        rf"{number} m thick, so they could pass each other unseen: take dt <= {number} s$", text,
    )  # fmt: skip
    assert found, text
    told_speed, way, dt, thick, wanted = map(float, found.groups())
    assert told_speed == pytest.approx(speed, rel=1e-2) and way == pytest.approx(speed * sim.dt, rel=1e-2)
    assert dt == pytest.approx(sim.dt, rel=1e-2) and thick >= THICK
    assert wanted == pytest.approx(0.5 * thick / speed, rel=2e-2)
    assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), v)
    assert sim.step_count == 0 and sim.time == 0.0
    if not sim.settings.explicit:
        return
    sim.dt = 0.9 * wanted
    assert fly(sim, 60) >= 2


def test_a_plane_is_thick_enough(sim):
    explicit = sim.settings.explicit
    speed = 150.0 if explicit else 60.0  # [m/s], ways of 0.03 and 1 m a step, to a cube of 0.05 m
    shoot(sim, speed, "faller")
    borne, lowest, told = [], np.inf, []
    for _ in range(round(3.2 / speed / sim.dt) if explicit else 6):
        told += sim.step().problems
        lowest = min(lowest, sim.positions("faller")[:, 1].min())
        borne.append(sim.contact_force("plane")[1])
    assert min(borne) < (-1000.0 if explicit else -400.0)  # [N]; 450 N stop the cube within an implicit step
    if explicit:  # at four times the speed of its waves it is crushed, and a little of it may sink in, which is told
        assert -1.05 < lowest < -0.9 and (lowest > -1.0 or any("deep in each other" in text for text in told))
    else:
        assert -1.0 < lowest < -0.99 and told == []
