"""A simulation that follows the clock and the window's commands, without a window: never faster than asked, and as by `run`."""

import math
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.frame_steps import fit_dt
from taisoft.records import RunReport, StepReport
from taisoft.settings import Settings
from taisoft.view.window.live import LiveRun
from tests.view.drawing import cubes_scene
from tests.view.fake_simulator import FakeSimulator, beam_scene


class Clock(FakeSimulator):
    """A simulator whose steps take a given time of its own clock. calls: steps and commands in their order; warm_ups: their
    number, each of which takes seconds_to_warm_up."""

    draggable, warm_ups, seconds_to_warm_up = True, 0, 0.0

    def __init__(self, dt=0.01, seconds_per_step=1e-3, integrator="symplectic_euler"):
        super().__init__(beam_scene(), dt)
        self.seconds_per_step, self.now, self.calls = seconds_per_step, 100.0, []
        self.settings = Settings(integrator=integrator)

    def advance(self, n):
        n = n if self.settings.explicit else 1
        self.calls.append(("steps", n))
        self.time, self.step_count, self.now = self.time + n * self.dt, self.step_count + n, self.now + n * self.seconds_per_step
        return StepReport(time=self.time, steps=n)

    def warm_up(self):
        self.warm_ups, self.now = self.warm_ups + 1, self.now + self.seconds_to_warm_up

    def drag(self, body, nodes, weights, target, stiffness):
        self.calls.append(("drag", body, tuple(target), stiffness))

    def release(self):
        self.calls.append("release")

    def set_gravity(self, gravity):
        self.calls.append(("gravity", gravity[1]))

    def rebuild(self, **settings):
        self.calls.append(("rebuild", settings["integrator"]))


class Window:
    """A window that gives requests by the simulator's step count; waiting takes time of its clock. states: what it has got."""

    ready = has_room = True

    def __init__(self, sim, requests=(), steps=None):
        self.sim, self.requests, self.steps, self.states, self.waits = sim, dict(requests), steps, [], []

    @property
    def closed(self):
        return self.steps is not None and self.sim.step_count >= self.steps

    def receive(self, timeout):
        due = [number for number in self.requests if self.sim.step_count >= number]
        if due:
            return [(number, self.requests.pop(number)) for number in due]
        if hasattr(self.sim, "now"):
            self.sim.now += timeout
        self.waits.append(timeout)
        return []

    def publish(self, sim, shown, patience=0.0):
        self.states.append(shown | {"time": sim.time, "step_count": sim.step_count, "patience": patience})


@pytest.fixture
def live(monkeypatch):
    """A function that makes a run of a Clock simulator on its clock."""

    def make(sim, requests=(), **options):
        monkeypatch.setattr("time.perf_counter", lambda: sim.now)
        window = Window(sim, requests)
        return LiveRun(sim, window, **options), window

    return make


@pytest.mark.parametrize(
    "dt, seconds_per_step, speed, integrator",
    [(1 / 60, 1e-3, 1.0, "symplectic_euler"), (1 / 600, 1e-4, 4.0, "symplectic_euler"), (0.05, 1e-3, 0.25, "implicit_euler")],
)
def test_a_fast_simulation_follows_the_clock(live, dt, seconds_per_step, speed, integrator):
    sim = Clock(dt, seconds_per_step, integrator)
    run, window = live(sim, speed=speed)
    while sim.now < 102.0:
        run.turn()
        assert sim.time <= speed * (sim.now - 100.0) + 1e-9, "never ahead of the clock"
    assert sim.time >= speed * (sim.now - 100.0) - 2 * dt - speed * 0.05
    state = window.states[-1]
    assert state["speed"] == pytest.approx(speed, rel=0.15) and state["status"] == "running"


@pytest.mark.parametrize(
    "dt, seconds_per_step, slowdown, integrator", [(1e-4, 1e-3, 10.0, "symplectic_euler"), (1 / 60, 0.5, 30.0, "implicit_euler")]
)
def test_a_slow_simulation_says_so_and_makes_up_nothing(live, dt, seconds_per_step, slowdown, integrator):
    sim = Clock(dt, seconds_per_step, integrator)
    run, window = live(sim)
    while sim.now < 104.0:
        before = sim.now
        run.turn()
        assert sim.now - before <= max(0.02, 1.01 * seconds_per_step) + dt, "commands and states come in between"
    assert f"needs {slowdown:.1f} times as long" in window.states[-1]["status"]
    assert window.states[-1]["speed"] == pytest.approx(1.0 / slowdown, rel=0.1)
    sim.seconds_per_step, time, now = 0.1 * dt, sim.time, sim.now  # now it could catch up
    while sim.now < now + 0.3:
        run.turn()
    assert sim.time - time <= 0.3 + 0.05 + 3 * dt + seconds_per_step


def test_as_fast_as_possible_and_the_keys_of_speed(live):
    sim = Clock(0.01, 1e-4)
    run, window = live(sim, {5: [["unbound"]], 12000: [["unbound"], ["faster"], ["faster"]], 12800: [["slower"]] * 9})

    def turn_until(n):
        while sim.step_count < n:
            run.turn()
        return window.states[-1]

    assert turn_until(12000)["asked_speed"] is None and window.states[-1]["speed"] == pytest.approx(100.0, rel=0.1)
    assert max(n for _, n in sim.calls) <= 200
    assert turn_until(12800)["asked_speed"] == 4.0 and window.states[-1]["speed"] == pytest.approx(4.0, rel=0.2)
    run.turn()
    run.turn()
    assert window.states[-1]["asked_speed"] == 1 / 16, "the least"
    run, window = live(Clock(), speed=math.inf)
    for _ in range(3):
        run.turn()
    assert window.states[-1]["asked_speed"] is None


def test_what_steps_need_is_compiled_before_the_first_one(live):
    """Once, after the first state was shown; and again for another solver. Its time is not made up."""
    sim = Clock(0.01)
    sim.seconds_to_warm_up = 3.0
    run, window = live(sim, {50: [["rebuild", "bdf2", "auto"]]})
    while sim.time < 0.4:
        run.turn()
    first = window.states[0]
    assert first["step_count"] == 0 and first["status"] == "compiling the next step, for some seconds" and sim.warm_ups == 1
    assert sim.time <= sim.now - 103.0 + 2 * sim.dt
    while sim.time < 1.0:
        run.turn()
    assert sim.warm_ups == 2


def test_an_implicit_step_gets_a_budget_of_the_time_in_which_it_is_due(live):
    sim = Clock(0.01, 1e-3, "implicit_euler")
    run, window = live(sim, {10: [["slower"]], 20: [["faster"]], 30: [["budget"]], 40: [["budget"]], 50: [["unbound"]]})
    budgets, publish, advance = {}, window.publish, sim.advance

    def slow_publish(*arguments):
        sim.now += 1e-3
        publish(*arguments)

    def on_budget(n):
        budgets[sim.step_count], report = sim.budget, advance(n)
        sim.dragged = SimpleNamespace(force=1.0, max_force=2.0) if sim.step_count > 46 else None
        if sim.step_count % 2:
            report.on_budget, report.residual, report.problems = 1, 0.02, ["step 1: on budget: Newton stopped"]
        return report

    window.publish, sim.advance, window.steps = slow_publish, on_budget, 60
    run.run()
    assert budgets[5] == pytest.approx(0.8 * 0.01 - 0.6 * 1e-3), (
        "four fifths of dt, less a state's time for dt of a 60th of a second"
    )
    assert budgets[48] == pytest.approx(0.4 * 0.01 - 0.6 * 1e-3), "half while a body is dragged, which shows sooner"
    assert budgets[15] == pytest.approx(0.8 * 0.02 - 1e-3) and budgets[25] == budgets[45] == pytest.approx(budgets[5])
    assert budgets[35] is None and budgets[55] is None and sim.budget is None
    assert [state["budget"] for state in window.states if state["step_count"] == 35] == [False]
    found = {state["on_budget"] for state in window.states}
    assert any(text.startswith("on budget: ") and text.endswith(" steps, residual 0.02") for text in found)
    assert not any(state["messages"] for state in window.states), "the panel says so"
    sim = Clock(0.01, 1e-3, "implicit_euler")
    run, _ = live(sim, {0: [["step"]]}, paused=True)
    run.turn()
    assert sim.budget is None, "single steps are solved to their end"
    own = Clock(0.01, 1e-3, "implicit_euler")
    own.settings = Settings(budget=0.5)
    run, window = live(own, {1: [["budget"]], 2: [["budget"]]})
    for turn in range(3):
        own.now += 0.02
        run.turn()
        assert own.budget == (None if turn == 1 else 0.5) and run.panel_state()["budget"] == (turn != 1)
    run, _ = live(Clock(0.01, 1e-3, "implicit_euler"), budget=False)
    run.sim.now += 0.02
    run.turn()
    assert run.sim.budget is None and not run.panel_state()["budget"]


def test_commands_are_carried_out_between_steps(live):
    sim = Clock(integrator="implicit_euler")
    begin = ["begin_drag", "beam", np.array([1, 2]), np.array([0.5, 0.5])]
    requests = {3: [begin, ["drag", [1.0, 2.0, 3.0], 10.0]], 6: [["release"], ["set_gravity", 1.5]], 8: [["pause"]]}
    run, window = live(sim, requests)
    while sim.step_count < 8 or not run.paused:
        run.turn()
    stiffness = 10.0 * 4000.0 * 9.81 / np.sqrt(18.0)
    expected = [*[("steps", 1)] * 3, ("drag", "beam", (1.0, 2.0, 3.0), pytest.approx(stiffness)), *[("steps", 1)] * 3]
    assert sim.calls == [*expected, "release", ("gravity", -1.5), *[("steps", 1)] * 2]
    assert {state["step_count"] for state in window.states if state["drag_done"] == 3} == {4, 5, 6, 7, 8}, "a step has used it"
    assert [state["drag_done"] for state in window.states if state["step_count"] == 3] == [0], "none between a drag and its step"
    time = sim.time
    for _ in range(20):
        run.turn()
    assert sim.time == time and window.states[-1]["status"] == "paused" and max(window.waits) <= 0.25
    for commands, steps, paused in (([["step"], ["step"]], 10, True), ([["reset"], ["pause"]], 0, False)):
        window.requests = {0: commands}
        run.turn()
        assert sim.step_count == steps and run.paused == paused


def test_a_state_that_answers_a_drag_waits_for_none_before_it(live):
    sim = Clock(integrator="implicit_euler")
    begin = ["begin_drag", "beam", np.array([1]), np.array([1.0])]
    run, window = live(sim, {3: [begin, ["drag", [1.0, 2.0, 3.0], 10.0]], 6: [["drag", [1.0, 2.0, 4.0], 10.0]]})
    while sim.step_count < 8:
        window.ready = sim.step_count < 2
        window.has_room = sim.step_count < 6
        run.turn()
    assert [(state["step_count"], state["drag_done"]) for state in window.states][-1] == (4, 3), "one, and none without room"
    assert window.states[-2]["step_count"] < 3
    window.has_room = True
    run.turn()
    assert window.states[-1]["drag_done"] == 6


def test_failures_pause_and_warnings_are_shown(live):
    sim = Clock()
    run, window = live(sim)
    advance, given = sim.advance, []

    def warn(n):
        warnings.warn("the body is soft", UserWarning, stacklevel=1)
        return advance(n)

    def diverge(n):
        report = advance(n)
        report.problems = ["the step did not converge"]
        return report

    def fail(_n):
        raise SimulationError("node 3 is not finite")

    window.steps, sim.advance = 3, warn
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_, **__: given.append(str(message))
        run.run()
        assert warnings.showwarning("x") is None, "it is put back"
    assert given[0] == "the body is soft" and window.states[-1]["messages"] == ["warning: the body is soft"]
    window.steps = None
    for change, messages, paused in (
        (diverge, "the step did not converge", False),
        (fail, "failed: node 3 is not finite", True),
        (advance, "", False),
    ):
        sim.advance, window.requests = change, {0: [["pause"]]} if run.paused else {}
        for _ in range(60):
            run.turn()
        assert [*window.states[-1]["messages"], ""][0] == messages and run.paused == paused
        assert (window.states[-1]["status"] == "paused") == paused


def test_another_solver_is_announced_before_it_compiles(live):
    sim = Clock()
    run, window = live(sim, {3: [["rebuild", "bdf2", "auto"]]})
    while ("rebuild", "bdf2") not in sim.calls:
        run.turn()
    before, state = window.states[-2:]
    assert before["messages"] == ["compiling bdf2, for some seconds"] and before["patience"] > 0.0
    assert state["status"] == "compiling the next step, for some seconds"
    assert state["messages"][-1].startswith("bdf2 is in use")

    def refuse(**_settings):
        raise SimulationError("that is impossible")

    sim.rebuild, window.requests = refuse, {0: [["rebuild", "bdf2", "auto"]]}
    run.turn()
    assert run.panel_state()["messages"] == ["that is impossible"] and not run.paused


def test_without_a_drag_the_states_are_those_of_run():
    settings = {"integrator": "symplectic_euler", "dt": 2e-3, "draggable": True}
    with ts.Simulator(cubes_scene(), **settings) as sim:
        fit_dt(sim, 60.0, RunReport())
        LiveRun(sim, Window(sim, steps=round(0.1 / sim.dt))).run()
        n, found = sim.step_count, (sim.time, sim.positions(), sim.velocities())  # a last batch may exceed 0.1 s
    with ts.Simulator(cubes_scene(), **settings) as sim:
        sim.run(0.1, fps=60)
        assert sim.contacts().impulse.any() and sim.step_count <= n
        while sim.step_count < n:
            sim.step()
        assert all(np.array_equal(a, b) for a, b in zip(found, (sim.time, sim.positions(), sim.velocities())))
