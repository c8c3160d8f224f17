"""`run` with a stand-in whose steps cost nothing, and with a real one: frames, the dt that makes them, reports of
steps and batches, and the status and problems of runs that are interrupted, fail or take bad steps.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.dynamics.stage_system import StageSystem
from taisoft.frame_steps import dt_sentence, first_frame
from taisoft.records import Energies, StepReport
from taisoft.running import run
from tests.simulator.scenes import simulator

BOTH = pytest.mark.parametrize("explicit", [True, False])


class StandIn:
    """A simulator that only counts steps; `events` maps a step to an exception or to fields of its report."""

    def __init__(self, explicit: bool, dt: float = 0.01, events=None, largest_batch: int = 4):
        self.settings = SimpleNamespace(explicit=explicit, static=False, integrator="symplectic_euler", tolerance=None)
        self.touches = False
        self.dt, self.step_count, self.time, self.compile_seconds = dt, 0, 0.0, 0.0
        self.events, self.largest_batch = events or {}, largest_batch
        self.contact = SimpleNamespace(contact_offset=0.01)
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
            for name, value in event.items():
                setattr(report, name, value)
        return report


def frames(sim, seconds, fps=60, **arguments):
    """The run's report, and (index, time, steps of the report) of every frame."""
    seen = []

    def on_frame(s, index, report):
        assert s is sim
        seen.append((index, round(s.time, 9), None if report is None else report.steps))

    return run(sim, seconds, on_frame, fps, **arguments), seen


@BOTH
def test_frames_come_at_fps(explicit):
    sim = StandIn(explicit, dt=0.01)
    result, seen = frames(sim, 0.3, fps=10)
    steps = 10 if explicit else 1  # per report: of an explicit frame, or of an implicit frame's last step
    assert seen == [(0, 0.0, None), (1, 0.1, steps), (2, 0.2, steps), (3, 0.3, steps)]
    assert result.status == "ok" and result.problems == [] and not result.interrupted
    assert result.steps == 30 and result.sim_seconds == pytest.approx(0.3)
    assert len(result.step_reports) == (3 if explicit else 30) and result.wall_seconds >= 0.0
    result, seen = frames(sim, 0.5, fps=10, resumed=True)  # counts from time 0
    assert seen == [(3, 0.3, None), (4, 0.4, steps), (5, 0.5, steps)] and result.steps == 20
    every = StandIn(explicit, dt=0.03)
    result, seen = frames(every, 0.1, fps=None)
    assert every.dt == 0.03 and [time for _, time, _ in seen] == [0.0, 0.03, 0.06, 0.09] and len(result.step_reports) == 3


@pytest.mark.parametrize(
    "dt, per_frame, change",
    [
        (0.01, 2, "lowered from 0.01 s to 0.00833333 s"),
        (0.00833333, 2, "rounded from 0.00833333 s to 0.00833333333 s"),
        (0.0166667, 1, "lowered from 0.0166667 s to 0.0166666667 s"),
        (1 / 120, 2, None),
    ],
)
def test_dt_becomes_a_divisor_of_the_frame(dt, per_frame, change):
    sim = StandIn(True, dt=dt)
    sim.settings.allow_unstable, sim.stable_dt = False, 1.0
    result, seen = frames(sim, 0.1)
    assert sim.dt == result.dt == pytest.approx(1 / 60 / per_frame, rel=1e-15) and len(seen) == 7 and result.status == "ok"
    assert (sim.dt == dt) == (change is None) and result.dt_requested == (None if change is None else dt)
    assert result.problems == ([] if change is None else [f"note: dt {change}, so that {per_frame} steps make a frame of 1/60 s"])
    assert dt_sentence(result) == ("" if change is None else f"dt {change}")
    if change is not None and change.startswith("rounded"):  # unless the integrator would refuse that as unstable
        sim = StandIn(True, dt=dt)
        sim.settings.allow_unstable, sim.stable_dt = False, dt
        frames(sim, 0.1)
        assert sim.dt == pytest.approx(1 / 180, rel=1e-15) and first_frame(sim, 60) == 6


def test_a_run_ends_at_the_nearest_step():
    for seconds, steps in ((0.104, 10), (0.106, 11), (0.001, 1)):
        result, seen = frames(StandIn(True, dt=0.01), seconds, fps=20)
        assert result.steps == steps and seen[-1][1] == pytest.approx(steps * 0.01)
    assert result.problems == ["note: 0.001 s are less than half a step: one step of 0.01 s is taken"]
    bad = {
        (0.0,): "seconds must be greater than 0 s",
        (1e20,): "the run would never end",
        (1.0, None, np.nan): "fps must be finite",
    }
    for arguments, message in bad.items():
        with pytest.raises(ts.SimulationError, match=message):
            run(StandIn(True), *arguments)


def test_explicit_batches_are_merged():
    """Ten sub-steps in batches of four: the frame's report has the extremes and sums of all."""
    largest = ("n_inverted", "n_contacts", "max_penetration", "contact_residual", "dropped_contacts", "crossings", "deep")
    events = {2: dict.fromkeys(largest, 3) | {"min_volume_ratio": -0.5, "contact_iterations": 5, "problems": ["one"]}}
    events[6] = dict.fromkeys(largest, 1) | {"min_volume_ratio": 0.1, "contact_iterations": 7, "converged": False}
    result, _ = frames(StandIn(True, events=events), 0.2, fps=10)
    first, second = result.step_reports
    assert all(getattr(first, name) == 3 and getattr(second, name) == 0 for name in largest)
    assert (first.steps, first.min_volume_ratio, first.contact_iterations, first.problems) == (10, -0.5, 12, ["one"])
    assert not first.converged and second.converged and (second.steps, second.min_volume_ratio) == (10, 1.0)
    assert first.time == pytest.approx(0.1) and result.status == "degraded"


def test_bad_steps_degrade_a_run():
    for events, problem in (
        (
            {3: {"converged": False, "residual": 1e-3}, 5: {"converged": False, "residual": 2e-2}},
            "2 of 10 steps did not converge; the worst, at t = 0.05 s, reached a relative residual of 2.00e-02",
        ),
        ({4: {"n_inverted": 2}, 6: {"n_inverted": 3}}, "tets were inverted in 2 reported steps; at most 3, at t = 0.06 s"),
        ({4: {"dropped_contacts": 2}}, "in 1 of 10 reported steps contacts of inverted tets were unknown"),
        (
            {4: {"deep": 1, "max_penetration": 0.02, "crossings": 7}, 5: {"deep": 1, "max_penetration": 0.01}},
            "in 2 of 10 reported steps bodies penetrate; the worst, at t = 0.04 s, by 0.02 m, with up to 7 crossing pairs of ",
        ),
    ):
        result, _ = frames(StandIn(False, events=events), 0.1, fps=None)
        assert result.status == "degraded" and result.problems[0].startswith(problem) and len(result.problems) == 1


@BOTH
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


@BOTH
def test_stop_and_ctrl_c_interrupt_a_run(explicit):
    sim = StandIn(explicit)
    result, seen = frames(sim, 1.0, fps=10, stop=lambda: sim.step_count >= 23)
    assert (result.status, result.interrupted) == ("degraded", True)
    assert 23 <= result.steps < 28 and [index for index, *_ in seen] == [0, 1, 2]
    assert result.problems == ["the run was interrupted before its end"]
    assert sum(report.steps for report in result.step_reports) == result.steps
    result, seen = frames(StandIn(explicit), 1.0, stop=lambda: True)
    assert result.interrupted and result.steps == 0 and result.step_reports == [] and len(seen) == 1
    sim = StandIn(explicit, events={8: KeyboardInterrupt()}, largest_batch=1)
    with pytest.raises(KeyboardInterrupt):
        run(sim, 1.0, fps=None)
    assert sim.step_count == 7


def test_a_long_step_shows_that_it_lives_and_can_be_stopped(monkeypatch):
    """An iteration takes 0.4 s: looks begin after 1 s. A step that is stopped does not count."""
    sim, now, seen = StandIn(False), [0.0], []
    monkeypatch.setattr("time.monotonic", lambda: now[0])

    def advance(n):
        budget = NewtonBudget()
        for _ in range(5):
            now[0] += 0.4
            budget.spend()
        return StandIn.advance(sim, n)

    sim.advance = advance
    stop = lambda: sim.step_count == 2 and now[0] > 5.0  # noqa: E731
    result = run(sim, 1.0, fps=None, stop=stop, on_iteration=seen.append)
    assert seen == [3, 4, 5] * 2 and (result.interrupted, result.steps, len(result.step_reports)) == (True, 2, 2)


@BOTH
def test_a_failed_step_ends_a_run(explicit):
    for error in (ts.SimulationError("step 8: body 'beam', vertex 3: gone"), MemoryError("gone")):
        sim = StandIn(explicit, events={8: error}, largest_batch=1)
        result, seen = frames(sim, 1.0, fps=20)
        assert result.status == "failed" and len(result.problems) == 1 and "gone" in result.problems[0]
        assert ("memory" in result.problems[0]) == isinstance(error, MemoryError)
        assert result.steps == 7 and [index for index, *_ in seen] == [0, 1]


@pytest.mark.parametrize("end, status", [(None, "ok"), (0.005, "ok"), (0.02, "degraded"), (MemoryError("lost"), "failed")])
def test_the_final_overlap_sets_the_status(end, status):
    """end: the deepest overlap [m], or an exception of the overlap check."""
    sim = StandIn(True)
    sim.touches, sim.contact_limit = True, lambda a, b: 0.01 if a == "left" else 1.0

    def overlaps():
        if isinstance(end, MemoryError):
            raise end
        large = SimpleNamespace(name_a="coarse", name_b="right", depth=0.5)  # within its own limit
        return [] if end is None else [large, SimpleNamespace(name_a="left", name_b="right", depth=end)]

    sim.overlaps = overlaps
    result = run(sim, 0.1)
    said = {"ok": "", "degraded": "'left' and 'right' overlap by 0.02 m", "failed": "lost"}[status]
    assert result.status == status and said in " ".join(result.problems)


def test_on_frame_may_fail_or_change_the_end():
    """Its errors are raised; a run that ends at another time, since on_frame takes steps, is degraded."""

    def on_frame(sim, index, report):
        if index == 2 and sim.settings.explicit:
            raise ts.OutputError("the disk is full")
        if index == 2:
            sim.advance(1)
            sim.advance(1)

    with pytest.raises(ts.OutputError, match="the disk is full"):
        run(StandIn(True), 1.0, on_frame, 10)
    result = run(StandIn(False, dt=1 / 60), 0.2, on_frame)
    assert result.status == "degraded" and any("instead of t = 0.2 s" in problem for problem in result.problems)


def test_ctrl_c_within_a_step_abandons_it(monkeypatch):
    form_matrix = StageSystem.form_matrix

    def interrupted(*arguments, **named):
        form_matrix(*arguments, **named)
        raise KeyboardInterrupt

    with simulator("implicit_euler") as sim:
        sim.advance(1)
        before = sim.positions(), sim.velocities()
        monkeypatch.setattr(StageSystem, "form_matrix", interrupted)
        for _ in range(2):  # with companions, which the first run must end
            with pytest.raises(KeyboardInterrupt):
                sim.run(0.4, fps=None, error=True)
        assert sim.step_count == 1
        assert np.array_equal(sim.positions(), before[0]) and np.array_equal(sim.velocities(), before[1])
