"""`run` with a stand-in whose steps cost nothing, and with two real simulators:

* frames come at fps or after every step, frame 0 first, and the run ends at `seconds` to the nearest step;
* dt is lowered once, to the next divisor of the frame time, or rounded to one within 1e-6 of it, and that is reported; a dt that
  divides the frame time stays;
* on_step gets the report of every implicit step and every explicit batch, with its wall time without compilation;
* explicit batches are merged into one report per frame, with the extremes of their sub-steps; implicit steps have one each;
* stop and Ctrl-C end a run as interrupted, at the last whole step; a failure ends it as failed; neither raises;
* inverted tets and steps that did not converge make the status degraded; the problems say how many and when.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.explicit_stepper import ExplicitStepper
from taisoft.dynamics.stage_system import StageSystem
from taisoft.frames import first_frame
from taisoft.records import Energies, StepReport
from taisoft.running import run
from tests.dynamics.scenes import cube, element, rubber


class StandIn:
    """A simulator that only counts steps; `events` maps a step to an exception or to fields of its report."""

    def __init__(self, explicit: bool, dt: float = 0.01, events=None, largest_batch: int = 4):
        self.settings, self.touches = SimpleNamespace(explicit=explicit, integrator="symplectic_euler", tolerance=None), False
        self.dt, self.step_count, self.time, self.compile_seconds = dt, 0, 0.0, 0.0
        self.events, self.largest_batch = events or {}, largest_batch
        self.scene, self.stable_dt, self.is_driven, self.changes = ts.Scene(), 1.0, False, 0

    def _host(self) -> "StandIn":
        return self

    def energies(self) -> Energies:
        return Energies(0.0, 0.0, 0.0)

    def _take_compile_seconds(self) -> float:
        return self.compile_seconds

    def advance(self, n: int) -> StepReport:
        n = min(n, self.largest_batch) if self.settings.explicit else 1
        report = StepReport(time=0.0, steps=0)
        for _ in range(n):
            event = self.events.get(self.step_count + 1, {})
            if isinstance(event, BaseException):
                raise event
            self.step_count += 1
            self.time += self.dt
            report.steps += 1
            report.time = self.time
            report.n_inverted = max(report.n_inverted, event.get("n_inverted", 0))
            report.min_volume_ratio = min(report.min_volume_ratio, event.get("min_volume_ratio", 1.0))
            report.converged = event.get("converged", True)
            report.residual = event.get("residual", 0.0)
        return report


def frames(sim, seconds, fps=60, **arguments):
    """The run's report, and (index, time, steps of the report) of every frame."""
    seen = []

    def on_frame(s, index, report):
        assert s is sim
        seen.append((index, round(s.time, 9), None if report is None else report.steps))

    return run(sim, seconds, on_frame, fps, **arguments), seen


@pytest.mark.parametrize("explicit", [True, False])
def test_frames_come_at_fps(explicit):
    result, seen = frames(StandIn(explicit, dt=0.01), 0.3, fps=10)
    steps = 10 if explicit else 1  # per report: of an explicit frame, or of an implicit frame's last step
    assert seen == [(0, 0.0, None), (1, 0.1, steps), (2, 0.2, steps), (3, 0.3, steps)]
    assert result.status == "ok" and result.problems == [] and not result.interrupted
    assert result.steps == 30 and result.sim_seconds == pytest.approx(0.3)
    assert len(result.step_reports) == (3 if explicit else 30) and result.wall_seconds >= 0.0


@pytest.mark.parametrize("explicit", [True, False])
def test_without_fps_every_step_is_a_frame(explicit):
    sim = StandIn(explicit, dt=0.03)
    result, seen = frames(sim, 0.1, fps=None)
    assert sim.dt == 0.03 and [time for _, time, _ in seen] == [0.0, 0.03, 0.06, 0.09]
    assert result.steps == 3 and len(result.step_reports) == 3 and result.problems == []


@pytest.mark.parametrize("seconds, steps", [(0.104, 10), (0.106, 11), (0.001, 1)])
def test_a_run_ends_at_the_nearest_step(seconds, steps):
    result, seen = frames(StandIn(True, dt=0.01), seconds, fps=20)
    assert result.steps == steps and seen[-1][1] == pytest.approx(steps * 0.01)
    note = ["note: 0.001 s are less than half a step: one step of 0.01 s is taken"] if seconds < 0.005 else []
    assert result.problems == note


@pytest.mark.parametrize(
    "dt, lowered, per_frame", [(0.03, 1 / 60, 1), (0.01, 1 / 120, 2), (1 / 60, 1 / 60, 1), (1 / 180, 1 / 180, 3)]
)
def test_dt_is_lowered_to_a_divisor_of_the_frame(dt, lowered, per_frame):
    sim = StandIn(True, dt=dt)
    result, seen = frames(sim, 0.1)
    assert sim.dt == pytest.approx(lowered, rel=1e-12) and (sim.dt == dt) == (dt == lowered)
    assert [steps for *_, steps in seen[1:]] == [per_frame] * 6
    expected = [] if dt == lowered else [f"note: dt lowered from {dt:g} s to {lowered:.6g} s, so that "]
    assert len(result.problems) == len(expected) and result.status == "ok"
    assert all(problem.startswith(start) for problem, start in zip(result.problems, expected))


@pytest.mark.parametrize(
    "dt, per_frame, change",
    [
        (0.00833333, 2, "rounded from 0.00833333 s to 0.00833333333 s"),
        (0.0083332, 3, "lowered from 0.0083332 s to 0.00555556 s"),
        (0.01666666, 1, "rounded from 0.01666666 s to 0.0166666667 s"),
        (0.01666667, 1, "rounded from 0.01666667 s to 0.0166666667 s"),
        (0.0166668, 1, "lowered from 0.0166668 s to 0.0166667 s"),
        (0.0166667, 1, "lowered from 0.0166667 s to 0.0166666667 s"),
        (1 / 120, 2, None),
    ],
)
@pytest.mark.parametrize("explicit", [False, True])
def test_a_dt_of_few_digits_is_rounded_to_a_divisor_of_the_frame(dt, per_frame, change, explicit):
    sim = StandIn(explicit, dt=dt)
    sim.settings.allow_unstable, sim.stable_dt = False, 1.0
    result, seen = frames(sim, 0.1)
    assert sim.dt == result.dt == pytest.approx(1 / 60 / per_frame, rel=1e-15) and len(seen) == 7 and result.status == "ok"
    assert result.dt_requested == (None if change is None else dt)
    assert result.problems == ([] if change is None else [f"note: dt {change}, so that {per_frame} steps make a frame of 1/60 s"])


def test_rounding_does_not_make_a_step_unstable():
    """A dt that an explicit integrator would refuse is lowered instead; with allow_unstable it is rounded."""
    for allowed, per_frame in ((False, 3), (True, 2)):
        sim = StandIn(True, dt=0.00833333)
        sim.settings.allow_unstable, sim.stable_dt = allowed, 0.00833333
        frames(sim, 0.1)
        assert sim.dt == pytest.approx(1 / 60 / per_frame, rel=1e-15)
        assert first_frame(sim, 60) == 6


def test_a_second_run_continues():
    sim = StandIn(True, dt=0.01)
    frames(sim, 0.2, fps=10)
    result, seen = frames(sim, 0.1, fps=10)
    assert seen == [(0, 0.2, None), (1, 0.3, 10)] and result.steps == 10 and result.sim_seconds == pytest.approx(0.1)


def test_explicit_batches_are_merged():
    """Ten sub-steps in batches of four: the frame's report has the extremes of all."""
    events = {2: {"n_inverted": 3, "min_volume_ratio": -0.5}, 6: {"n_inverted": 1, "min_volume_ratio": 0.1}}
    result, _ = frames(StandIn(True, events=events), 0.2, fps=10)
    first, second = result.step_reports
    assert (first.steps, first.n_inverted, first.min_volume_ratio) == (10, 3, -0.5)
    assert (second.steps, second.n_inverted, second.min_volume_ratio) == (10, 0, 1.0)
    assert first.time == pytest.approx(0.1)
    assert result.status == "degraded"
    assert result.problems == ["tets were inverted in 1 reported steps; at most 3, at t = 0.1 s"]


@pytest.mark.parametrize("explicit", [True, False])
def test_on_step_gets_every_report_and_its_time(explicit, monkeypatch):
    sim, now, calls = StandIn(explicit, dt=0.01), [0.0], []
    advance = sim.advance

    def slow(n):
        now[0] += 3.0
        sim.compile_seconds += 1.0
        return advance(n)

    sim.advance = slow
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    result = run(sim, 0.3, fps=10, on_step=lambda report, seconds: calls.append((report.time, report.steps, seconds)))
    steps = [4, 4, 2] * 3 if explicit else [1] * 30
    assert [(n, seconds) for _, n, seconds in calls] == [(n, 2.0) for n in steps]
    assert [time for time, _, _ in calls] == pytest.approx(0.01 * np.cumsum(steps))
    assert result.wall_seconds == pytest.approx(2.0 * len(steps))


def test_steps_that_did_not_converge_degrade_a_run():
    events = {3: {"converged": False, "residual": 1e-3}, 5: {"converged": False, "residual": 2e-2}}
    result, _ = frames(StandIn(False, events=events), 0.1, fps=None)
    assert result.status == "degraded"
    assert result.problems == [
        "2 of 10 steps did not converge; the worst, at t = 0.05 s, reached a relative residual of 2.00e-02"
    ]


@pytest.mark.parametrize("explicit", [True, False])
def test_stop_interrupts_a_run(explicit):
    sim = StandIn(explicit)
    result, seen = frames(sim, 1.0, fps=10, stop=lambda: sim.step_count >= 23)
    assert (result.status, result.interrupted) == ("degraded", True)
    assert 23 <= result.steps < 28 and [index for index, *_ in seen] == [0, 1, 2]
    assert result.problems == ["the run was interrupted before its end"]
    assert sum(report.steps for report in result.step_reports) == result.steps


def test_stop_before_the_first_step():
    result, seen = frames(StandIn(True), 1.0, stop=lambda: True)
    assert result.interrupted and result.steps == 0 and result.step_reports == [] and len(seen) == 1


@pytest.mark.parametrize("where", ["step", "frame"])
def test_ctrl_c_interrupts_a_run(where):
    sim = StandIn(False, events={8: KeyboardInterrupt()} if where == "step" else {})

    def on_frame(s, index, report):
        if where == "frame" and s.step_count == 7:
            raise KeyboardInterrupt

    result = run(sim, 1.0, on_frame, None)
    assert (result.status, result.interrupted, result.steps) == ("degraded", True, 7)
    assert len(result.step_reports) == 7


@pytest.mark.parametrize("explicit", [True, False])
def test_a_failed_step_ends_a_run(explicit):
    sim = StandIn(explicit, events={8: ts.SimulationError("step 8: body 'beam', vertex 3: gone")}, largest_batch=1)
    result, seen = frames(sim, 1.0, fps=20)
    assert result.status == "failed" and result.problems == ["step 8: body 'beam', vertex 3: gone"]
    assert result.steps == 7 and [index for index, *_ in seen] == [0, 1]


def test_errors_of_on_frame_are_raised():
    def on_frame(s, index, report):
        if index == 1:
            raise ts.OutputError("the disk is full")

    with pytest.raises(ts.OutputError, match="the disk is full"):
        run(StandIn(True), 1.0, on_frame, 10)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((0.0,), "seconds must be greater than 0 s, not 0.0"),
        ((-1,), "seconds must be greater than 0 s, not -1"),
        ((np.inf,), "seconds must be finite, not inf"),
        (("1",), "seconds must be a number, not '1'"),
        ((1.0, None, 0), "fps must be greater than 0 1/s, not 0"),
        ((1.0, None, np.nan), "fps must be finite, not nan"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    sim = StandIn(True)
    with pytest.raises(ts.SimulationError, match=message):
        run(sim, *arguments)
    assert sim.step_count == 0


@pytest.fixture(scope="module", params=["symplectic_euler-2", "implicit_euler-1"])
def block(request):
    integrator, order = request.param.split("-")
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="block", velocity=(1.0, 0.0, 0.0), **element(int(order))).fix([0, 1, 2])
    with ts.Simulator(scene, 0.004, integrator, precision="f64") as sim:
        yield sim


def test_a_run_takes_the_same_steps_as_step_by_step(block):
    block.reset()
    block.dt = 0.004
    result, seen = frames(block, 0.1, fps=20)
    assert result.status == "ok" and block.dt == pytest.approx(0.05 / 13) and result.steps == 26
    assert seen[-1][0] == 2 and block.time == pytest.approx(0.1)
    x = block.positions()
    block.reset()
    for _ in range(26):
        block.step()
    assert np.array_equal(block.positions(), x)


def test_a_diverged_step_fails_a_run_and_leaves_the_last_good_state(block):
    block.reset()
    block.dt = 0.004
    if not block.settings.explicit:
        block.set_state(positions=1e200 * block.positions())
    block.set_gravity((0.0, 1e36, 0.0))  # [m/s^2]
    try:
        result = block.run(0.4, fps=None)
    finally:
        block.set_gravity((0.0, -9.81, 0.0))
    assert result.status == "failed"
    assert f"step {result.steps + 1}: body 'block', node" in result.problems[0]
    assert np.isfinite(block.positions()).all() and np.isfinite(block.velocities()).all()
    assert result.sim_seconds == pytest.approx(0.004 * result.steps) and block.step_count == result.steps


def test_ctrl_c_within_a_step_abandons_it(block, monkeypatch):
    """The next step starts from the last good state."""
    block.reset()
    block.dt = 0.004
    block.advance(1)
    before = block.positions(), block.velocities()
    owner, name = (ExplicitStepper, "_launch") if block.settings.explicit else (StageSystem, "form_matrix")
    original = getattr(owner, name)

    def interrupted(*arguments, **named):
        original(*arguments, **named)
        raise KeyboardInterrupt

    monkeypatch.setattr(owner, name, interrupted)
    result = block.run(0.4, fps=None)
    assert (result.status, result.interrupted, result.steps, block.step_count) == ("degraded", True, 0, 1)
    assert np.array_equal(block.positions(), before[0]) and np.array_equal(block.velocities(), before[1])
    monkeypatch.undo()
    block.step()
    after = block.positions()
    block.reset()
    for _ in range(2):
        block.step()
    assert np.abs(after - block.positions()).max() < 1e-9  # [m]


@pytest.mark.parametrize(
    "end, status",
    [
        (None, "ok"),
        (0.005, "ok"),
        (0.02, "degraded"),
        (KeyboardInterrupt(), "degraded"),
        (ts.SimulationError("lost"), "failed"),
        (MemoryError("lost"), "failed"),
    ],
)
def test_the_final_overlap_sets_the_status(end, status):
    """end: the deepest overlap [m], or an exception of the overlap check."""
    sim = StandIn(True)
    sim.touches, sim.contact_limit = True, lambda a, b: 0.01 if a == "left" else 1.0

    def overlaps():
        if isinstance(end, BaseException):
            raise end
        large = SimpleNamespace(name_a="coarse", name_b="right", depth=0.5)  # within its own limit
        return [] if end is None else [large, SimpleNamespace(name_a="left", name_b="right", depth=end)]

    sim.overlaps = overlaps
    result = run(sim, 0.1)
    assert result.status == status and result.interrupted == isinstance(end, KeyboardInterrupt)
    problem = {"ok": "", "degraded": "the run was interrupted" if result.interrupted else "'left' and 'right' overlap by 0.02 m"}
    assert problem.get(status, "lost") in " ".join(result.problems)


@pytest.mark.parametrize("change", ["dt", "steps"])
def test_a_run_that_on_frame_ends_at_another_time_is_degraded(change):
    """on_frame changes dt or takes steps itself."""

    def on_frame(sim, index, report):
        if change == "dt" and index == 2:
            sim.dt = sim.dt / 4
        if change == "steps" and index == 2:
            sim.step()
            sim.step()

    scene = ts.Scene(gravity=(0, -9.81, 0))
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), name="cube")
    with ts.Simulator(scene, dt=1 / 60, precision="f64") as sim:
        result = sim.run(0.2, on_frame)
    assert result.status == "degraded" and any("instead of t = 0.2 s" in problem for problem in result.problems)
