"""Runs to a tolerance, mostly of stand-ins: which trials choose the steps; the estimate meets the tolerance, or the report says
why not; trials leave the state as it was; real runs meet the tolerance, repeat bitwise and resume from checkpoints without
trials.
"""

import json

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli import EXIT_BAD_INPUT
from taisoft.errors import SimulationError
from taisoft.estimation.trials import Frames
from taisoft.running import run
from tests.cli.command import BEAM, SHORT_OUTPUT, write
from tests.cli.command import run as call
from tests.dynamics.scenes import cube, rubber
from tests.estimation.stand_in import BDF2, VERLET, StandIn, block, motion

ELASTIC = motion(frequency=20.0)
CREEPING = motion(frequency=10.0, damping=10.0)
IMPACT = motion(frequency=0.0, floor=-1.2)
SLOW = motion(frequency=3.0)


def soft(tolerance=0.01, kind=ELASTIC, **settings) -> StandIn:
    """One that takes explicit steps."""
    scene = block(touching=kind is IMPACT, mass_damping=kind.damping)
    return kind(scene, **{"dt": 1 / 60, "integrator": VERLET, "tolerance": tolerance} | settings)


def stiff(tolerance=0.01, kind=SLOW, **settings) -> StandIn:
    """One whose scene would need very small explicit steps."""
    return kind(block(young=1e10), **{"dt": 1 / 60, "integrator": BDF2, "tolerance": tolerance} | settings)


@pytest.mark.parametrize("seconds, fps", [(0.511, 60), (0.011, 60), (0.5, 4), (0.5, 1000), (0.2, None)])
@pytest.mark.parametrize("make", [soft, stiff])
def test_runs_and_frames_of_any_length(make, seconds, fps):
    """Frames lie at steps; a run has the same steps whether they are observed or not, and the same error."""
    frames, found = [], []
    for on_frame in (lambda sim, *_: frames.append(sim.time), None):
        sim = make(0.02)
        result = run(sim, seconds, on_frame, fps)
        found.append((result.status, result.steps, sim.time, sim.dt, result.error_estimate.time, sim.positions().tolist()))
    assert found[0] == found[1] and found[0][0] == "ok"
    assert sim.time == pytest.approx(seconds, abs=0.5 * sim.dt) and frames[0] == 0.0
    assert len(frames) == 1 + (result.steps if fps is None else np.ceil(seconds * fps - 1e-6))


@pytest.mark.parametrize(
    "make, kind, tolerance, trials, per_frame",
    [
        (soft, ELASTIC, 0.1, "1", 1),  # its velocities show its error
        (soft, ELASTIC, 0.001, "1 4", 6),
        (soft, CREEPING, 0.02, "1 part2", 1),  # its fastest part, run again with a slightly smaller step, too
        (soft, IMPACT, 0.01, "1 4", 4),
        (soft, IMPACT, 0.001, "1 4 16", 16),
        (stiff, SLOW, 0.001, "1/4 implicit 1 implicit 2 implicit", 2),
        (stiff, SLOW, 0.0001, "1/4 implicit 1 implicit 2 implicit 128", 128),  # explicit steps are cheaper
        (stiff, motion(frequency=3.0, newton=50), 0.01, "1/4 implicit 128", 128),
    ],
)
def test_which_trials_choose_the_steps(make, kind, tolerance, trials, per_frame, monkeypatch):
    """Given by their steps in a frame."""
    found, trial = [], Frames.trial

    def spied(frames, sim, steps, stop, part=None, **options):
        found.append(f"{'' if part is None else 'part'}{steps}" + (" implicit" if sim.settings.integrator == BDF2 else ""))
        return trial(frames, sim, steps, stop, part, **options)

    monkeypatch.setattr(Frames, "trial", spied)
    result = run(make(tolerance, kind, integrator="implicit_midpoint"), 0.6)
    assert (" ".join(found), result.steps, result.status) == (trials, 36 * per_frame, "ok")
    assert result.error_estimate.time <= tolerance
    assert result.problems[0].startswith(f"note: for a tolerance of {100 * tolerance:.3g} %: ")


@pytest.mark.parametrize(
    "friction, tolerance, error, integrator",
    [
        (0.3, 0.01, False, BDF2),
        (0.3, 0.01, True, BDF2),
        (0.3, 0.002, False, VERLET),  # steps that resolve them cost not much more than implicit ones of that accuracy
        (0.0, 0.01, False, BDF2),
    ],
)
def test_implicit_steps_pass_over_vibrations_of_contacts(friction, tolerance, error, integrator):
    """Where there is friction, whether trials or companions estimate the error; finer trials would not help."""
    scene = block(young=3e7, friction=friction)
    scene.add_obstacle(ts.HalfSpace((0.0, -9.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=friction)
    sim = motion(frequency=3.0, floor=-0.4499)(scene, 1 / 60, BDF2, tolerance=tolerance)
    sim.pull = np.zeros_like(sim.pull) + (1.0, -1.0, 0.0)
    result = run(sim, 0.3, error=error)
    e = result.error_estimate
    noted = any("pass over vibrations" in note for note in e.notes)
    assert sim.settings.integrator == integrator and noted == (friction > 0.0 and integrator == BDF2)
    assert result.status == ("degraded" if noted and tolerance < e.time else "ok") and (e.time > 0.01) == noted


def test_errors_above_the_tolerance_or_unknown_degrade_a_run():
    """Paths diverge whose nodes are kicked once, each time in another way. The solvers' error counts where it is estimated."""

    def kick(sim):
        if sim.time < 0.09 <= sim.time + sim.dt:
            sim.v = sim.v + np.sin(1e6 * sim.dt)

    result = run(soft(0.01, motion(frequency=3.0, before_step=kick)), 0.3)
    assert result.status == "degraded" and result.problems[-1].endswith("and the tolerance is 1 %")
    result = run(soft(), 0.3, on_frame=lambda sim, k, _: setattr(sim, "changes", 1) if k == 5 else None)
    assert result.error_estimate.time is None and "changed during the run" in result.error_estimate.notes[0]
    assert result.problems[-1] == "the error in time is unknown, and the tolerance is 1 %" and result.status == "degraded"
    kind = motion(frequency=3.0, offset=lambda sim: (44.0 * sim.settings.newton_tolerance * sim.time, 0.0, 0.0))
    result = run(stiff(0.01, kind, newton_tolerance=5e-4), 0.6, error=True)
    e = result.error_estimate
    assert max(e.time, e.solver) < 0.01 < e.total and result.status == "degraded"


def test_bad_runs_are_refused_before_trials():
    counts: list = []
    sim = soft(kind=motion(before_step=counts.append))
    sim.dragged = True
    with pytest.raises(SimulationError, match="being dragged"):
        run(sim, 0.1)
    assert not counts


def test_a_stop_or_ctrl_c_during_the_trials_leaves_the_start():
    calls = iter(range(99))
    sim = stiff(integrator="implicit_midpoint", dt=0.01)
    result = run(sim, 0.5, stop=lambda: next(calls) >= 5)
    assert result.interrupted and result.status == "degraded" and result.steps == 0
    assert "interrupted during its trials" in result.problems[0]
    with pytest.raises(KeyboardInterrupt):
        run(sim, 0.5, stop=lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    assert (sim.settings.integrator, sim.dt, sim.time, sim.step_count) == ("implicit_midpoint", 0.01, 0.0, 0)
    assert np.array_equal(sim.positions(), sim.rest)


def test_steps_that_always_fail_are_tried_twice():
    def fails(sim):
        if sim.time > 0.2:
            failures.append(sim.time)
            raise SimulationError("made to fail")

    failures: list[float] = []
    sim = stiff(kind=motion(frequency=3.0, before_step=fails))
    result = run(sim, 0.5)
    assert result.status == "failed" and result.steps == 0 and result.problems == ["made to fail"] and len(failures) == 2
    assert (sim.dt, sim.step_count) == (1 / 60, 0)


def two(young=1e6) -> ts.Scene:
    """A beam of 2 x 1 x 1 m, clamped at its left end, and a body that is thrown."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    scene.contact_forces = False
    body = scene.add_body(ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)), rubber(young=young), name="beam")
    body.fix(lambda X: X[:, 0] < -0.99)
    scene.add_body(cube(), rubber(), name="thrown", position=(5.0, 0.0, 0.0), velocity=(1.0, 2.0, 0.0))
    return scene


@pytest.mark.parametrize("young, integrator", [(1e6, VERLET), (1e12, BDF2)])
def test_a_real_run_meets_the_tolerance_and_resumes_without_trials(young, integrator, tmp_path):
    """Its true error is that against a sixteenth of its steps; it is bitwise the same whether it is observed or not."""
    path, ends, fine, checkpoint = [], [], [], tmp_path / "c.npz"

    def look(sim, k, _report):
        path.append(sim.positions())
        if k == 5:
            sim.save_checkpoint(checkpoint)

    with ts.Simulator(two(young), tolerance=0.01, precision="f64") as sim:
        for on_frame in (None, look):
            sim.reset()
            result = sim.run(0.2, on_frame=on_frame)
            ends.append(sim.positions())
        assert sim.settings.integrator == integrator and result.trial_seconds > 0.0
        sim.rebuild(tolerance=1e-3)
        assert sim.settings.newton_tolerance == 5e-5
        with pytest.raises(SimulationError, match=r"run\(\) chooses the integrator"):
            sim.rebuild(integrator="implicit_euler")
    assert np.array_equal(*ends) and result.status == "ok"
    with ts.Simulator.load_checkpoint(checkpoint, two(young)) as sim:
        assert sim.settings.tolerance == 0.01 and sim.step_count > 0
        resumed = sim.run(0.2, resumed=True)
        assert resumed.trial_seconds == 0.0 and resumed.error_estimate is None and "is not estimated" in resumed.problems[-1]
        assert np.array_equal(sim.positions(), ends[0])
        sim.rebuild(tolerance=None)
        assert sim.settings.newton_tolerance is None
        sim.reset()
        sim.dt = sim.dt / 16
        sim.run(0.2, on_frame=lambda sim, *_: fine.append(sim.positions()))
    true = np.linalg.norm(np.array(path) - fine, axis=2).max() / np.linalg.norm(np.array(fine) - fine[0], axis=2).max()
    assert true <= 0.01 and 0.1 * true < result.error_estimate.time <= 0.01


def test_the_command_chooses_steps_and_estimates_errors(tmp_path, capsys):
    scene, out = write(tmp_path / "beam.py", BEAM.replace('"fps": 30', '"fps": 30, "precision": "f64"')), tmp_path / "out"
    assert call(scene, "--tolerance", 0.01, "--out", out, *SHORT_OUTPUT) == 0
    printed, report = capsys.readouterr().out, json.loads((out / "report.json").read_text())
    assert "for a tolerance of 1 %" in printed and "error    about " in printed and report["trial_seconds"] > 0.0
    assert report["settings"]["tolerance"] == 0.01 and report["error_estimate"]["time"] <= 0.01
    resumed = ("--resume", out / "checkpoint.npz", "--out", out, "--seconds", 0.2, *SHORT_OUTPUT)
    assert call(scene, *resumed) == 0 and "keeps the steps" in capsys.readouterr().out
    for options, message in (
        (("--tolerance", 0.01, "--set", "solver.fps=none"), "needs frames at a rate"),
        ((*resumed, "--set", "solver.dt=0.001"), "its dt was chosen for a tolerance"),
        (("--colour", "error"), "needs --error"),
        ((*resumed, "--error-mesh", "refined"), "excludes --resume"),
    ):
        assert call(scene, *options) == EXIT_BAD_INPUT and message in capsys.readouterr().err
