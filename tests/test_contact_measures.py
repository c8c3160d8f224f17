"""A shot at a thin sheet is stopped or refused, never lost:

* slow shots take whole steps, fast ones are cut into parts, few while they are far: after every step no two triangles
  intersect, no shot has passed;
* a shot too fast for that is refused with its speed, the sheet's thickness and a step that would do, and the state stays as it
  was; with such a step it is stopped; explicit steps refuse likewise;
* a half-space is thick enough for any speed, and every vertex that comes to lie below it has a contact, whatever its surface;
* a vertex over the rim of a body that mirrors its own has a contact, whatever the rounding;
* the next part of a step: as long as it may be, no longer than twice the one before, and the parts fill the step.
"""

import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.contact_measures import next_length

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


@pytest.mark.parametrize("speed", [1.0, 5.0, 20.0])
def test_a_shot_is_stopped(sim, speed):
    """In implicit steps of 1/60 s: 0.017, 0.083 and 0.33 m a step, 3, 17 and 67 times what half the thickness allows."""
    shoot(sim, speed)
    time = 0.1 / speed + (0.06 if speed < 10.0 else 0.03)
    assert fly(sim, min(round(time / sim.dt), 400)) >= (2 if speed < 10.0 else 1)
    assert sim.velocities("shot")[:, 1].mean() > -0.8 * speed


def test_only_what_is_near_is_cut(sim):
    """A shot that comes within reach takes few parts: one up to the sheet, short ones for the impact, longer ones again."""
    if sim.settings.explicit:
        pytest.skip("explicit steps have no parts")
    shoot(sim, 20.0)
    substeps = [sim.step().substeps for _ in range(2)]
    assert 2 < max(substeps) < 20 < 20.0 * sim.dt / (0.5 * THICK)
    shoot(sim, 20.0)
    sim.set_state(positions=sim.positions("shot") + (0, 1.0, 0), body="shot")
    assert sim.step().substeps == 1


def test_a_shot_too_fast_is_refused(sim):
    explicit = sim.settings.explicit
    speed = (0.75 if explicit else 300.0) * THICK / sim.dt
    shoot(sim, speed)
    gap = 1e-3 if explicit else 0.015  # [m]; explicit steps look at it once before the impact
    sim.set_state(positions=sim.positions("shot") - (0, 0.1 - 0.025 - 0.5 * THICK - gap, 0), body="shot")
    x, v = sim.positions(), sim.velocities()
    with pytest.raises(ts.SimulationError) as closing:
        sim.step()
    text = str(closing.value)
    number = r"([0-9.e+-]+)"
    found = re.search(
        rf"^step 1: 'sheet' and 'shot' close at {number} m/s, {number} m in a step of {number} s, and the thinner of them is "
        rf"{number} m thick, so {'' if explicit else 'even in 256 substeps '}they could pass each other unseen: "
        rf"take dt <= {number} s$",
        text,
    )
    assert found, text
    told_speed, way, dt, thick, wanted = map(float, found.groups())
    assert told_speed == pytest.approx(speed, rel=1e-2) and way == pytest.approx(speed * sim.dt, rel=1e-2)
    assert dt == pytest.approx(sim.dt, rel=1e-2) and thick >= THICK
    assert wanted == pytest.approx((1 if explicit else 256) * 0.5 * thick / speed, rel=2e-2)
    assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), v)
    assert sim.step_count == 0 and sim.time == 0.0
    if not explicit:
        return
    sim.dt = 0.9 * wanted
    assert fly(sim, 60) >= 2


def test_a_plane_is_thick_enough(sim):
    explicit = sim.settings.explicit
    speed = 150.0 if explicit else 60.0  # [m/s], ways of 0.03 and 1 m a step, to a cube of 0.05 m
    shoot(sim, speed, "faller")
    borne, lowest, closing = [], np.inf, []
    for _ in range(round(3.2 / speed / sim.dt) if explicit else 6):
        closing += sim.step().problems
        lowest = min(lowest, sim.positions("faller")[:, 1].min())
        borne.append(sim.contact_force("plane")[1])
    assert min(borne) < (-1000.0 if explicit else -400.0)  # [N]; 450 N stop the cube within an implicit step
    if explicit:  # at four times the speed of its waves it is crushed, and a little of it may sink in, which is told
        assert -1.05 < lowest < -0.9 and (lowest > -1.0 or any("deep in each other" in text for text in closing))
    else:
        assert -1.0 < lowest < -0.99 and closing == []


def test_every_vertex_that_comes_below_a_plane_has_a_contact(sim):
    """The upper corners of a cube are pressed down through the lower ones, and below the plane."""
    x = sim.positions("faller") - (0, 2.97, 0)
    top = x[:, 1] > x[:, 1].mean()
    v = np.where(top[:, None], [0.0, -0.1 / sim.dt, 0.0], 0.0)
    sim.set_state(x, 0.01 * v, body="faller")
    assert (sim.detect_contacts().body_b == "plane").sum() == 4  # on their way they do not come so far
    sim.set_state(x, v, body="faller")
    c = sim.detect_contacts()
    assert (c.body_b == "plane").sum() == 8 and c.gap.max() == pytest.approx(0.055)
    x[top, 1] -= 0.1
    sim.set_state(x, 0.0 * v, body="faller")
    c = sim.detect_contacts()
    assert c.gap.min() == pytest.approx(-0.045) and (c.gap < 0).sum() == 4


def test_a_vertex_over_the_rim_of_its_mirror_image_has_a_contact(sim):
    """Two cubes exactly over each other, moved by less than rounding: each corner meets its own image."""
    x, dice = sim.positions("shot") - SHOT, np.random.default_rng(0)
    for size in (0.0, *[10.0**k for k in range(-20, -13)]):
        for _ in range(8):
            for name, up in (("shot", 5.0), ("faller", 5.0504)):
                aside = size * dice.standard_normal(x.shape)
                sim.set_state(x + (0, up, 0) + aside, np.zeros_like(x), body=name)
            c = sim.detect_contacts()
            both = (c.body_a == "shot") & (c.body_b == "faller")
            assert c.gap[both] == pytest.approx(np.full(4, 4e-4)), size


def test_the_next_part_of_a_step():
    """As long as needed: the ratio of a part grows with its length."""
    assert next_length(lambda part: part, 1.0, 1.0, 1.0, False) == 1.0
    assert next_length(lambda part: 3.0 * part, 1.0, 1.0, 1.0, False) == pytest.approx(1 / 3)
    assert next_length(lambda part: 2.5 * part, 1.0, 1.0, 1.0, False) == pytest.approx(1 / 3)  # the rest in equal parts
    assert next_length(lambda part: 0.0, 0.9, 0.1, 1.0, False) == pytest.approx(0.1)
    assert next_length(lambda part: 0.0, 0.9, 0.1, 1.0, True) == pytest.approx(0.18)
    assert next_length(lambda part: 0.0, 0.9, 0.1, 0.15, True) == pytest.approx(0.15)
    assert next_length(lambda part: 0.0, 0.05, 0.1, 1.0, True) == pytest.approx(0.05)
    assert next_length(lambda part: 8.0 * part, 0.8, 0.1, 1.0, True) == pytest.approx(0.1)
    far = next_length(lambda part: 40.0 * part if part > 0.1 else 0.0, 0.8, 0.1, 1.0, True)
    assert far == pytest.approx(0.025)
