"""Runs to a tolerance:

* the true error of beams and of an impact meets tolerances of 10, 1 and 0.1 %, and the estimate is near it;
* integrator and dt are chosen by counts, so reruns are equal bitwise; stiff scenes take implicit steps;
* pilots leave the state as it was, observers see the run alone, and a repeated run equals the pilot that it repeats;
* where paths part, where pilots fail or are interrupted, the report says so;
* checkpoints resume bitwise, without pilots; the command takes --tolerance.
"""

import json

import numpy as np
import pytest
from command import BEAM, SHORT_OUTPUT, run, write
from scenes import cube, rubber

import taisoft as ts
from taisoft.cli import EXIT_BAD_INPUT
from taisoft.errors import SimulationError
from taisoft.estimation.comparison import distance, largest_excursion


def beam(young=1e6, cells=(4, 1, 1)) -> ts.Scene:
    """A beam of 4 x 1 x 1 m, clamped at its left end."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    scene.add_body(ts.box_mesh(cells, (4.0, 1.0, 1.0)), rubber(young=young), name="beam").fix(lambda X: X[:, 0] < -1.99)
    return scene


def stiff() -> ts.Scene:
    """The beam, which explicit steps would have to follow in steps of 0.1 ms, moved slowly at its end."""
    scene = beam(young=1e9)
    move = ts.KeyFrames((0.0, 0.5), [(0.0, 0.0, 0.0), (0.0, 0.3, 0.0)], smooth=True)
    scene.body("beam").move(lambda X: X[:, 0] > 1.99, move)
    return scene


def dropped() -> ts.Scene:
    """A soft cube that falls on the ground."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=0.5)
    scene.add_body(cube(), rubber(young=1e5), name="cube", position=(0.0, 0.8, 0.0))
    return scene


def true_error(build, sim: ts.Simulator, seconds: float) -> float:
    """Error of a run with sim's integrator and dt, against a sixteenth of dt in double precision."""
    paths = []
    for dt, precision in ((sim.dt, "f32"), (sim.dt / 16, "f64")):
        path = []
        with ts.Simulator(build(), dt=dt, integrator=sim.settings.integrator, precision=precision) as other:
            other.run(seconds, on_frame=lambda sim, *_, path=path: path.append(sim.positions()))
        paths.append(np.array(path))
    return distance(*paths, largest_excursion(paths[1])).max


# --- errors -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [0.1, 0.01, 0.001])
@pytest.mark.parametrize("build", [beam, stiff, dropped])
def test_the_true_error_meets_the_tolerance(build, tolerance):
    with ts.Simulator(build(), tolerance=tolerance) as sim:
        result = sim.run(0.5)
        assert sim.settings.integrator == ("bdf2" if build is stiff else "velocity_verlet")
    estimate = result.error_estimate
    assert result.status == "ok" and estimate.time <= tolerance and estimate.space is None
    assert result.problems[0].startswith(f"note: for a tolerance of {100 * tolerance:.3g} %: ")
    true = true_error(build, sim, 0.5)
    assert true <= tolerance
    assert 0.05 * true < estimate.time  # expected errors may be ten times too small


def test_smaller_tolerances_take_smaller_steps():
    steps = []
    for tolerance in (0.1, 0.001, 1e-4):
        with ts.Simulator(stiff(), tolerance=tolerance) as sim:
            steps.append(sim.run(0.5).steps)
    assert steps == sorted(steps) and steps[0] < steps[2]


def test_the_estimate_is_that_of_twins():
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    damped = rubber(young=1e7, stiffness_damping=0.3)  # which explicit steps would have to resolve
    scene.add_body(ts.box_mesh((4, 1, 1), (4.0, 1.0, 1.0)), damped, name="beam").fix(lambda X: X[:, 0] < -1.99)
    with ts.Simulator(scene, tolerance=0.01, precision="f64") as sim:
        own = sim.run(0.5).error_estimate
        sim.reset()
        twins = sim.run(0.5, error=True).error_estimate
        assert sim.settings.integrator == "bdf2"
    assert twins.solver is not None and own.solver is None
    assert 0.3 < own.time / twins.time < 3.0 and own.bodies["beam"].time == own.time


def test_what_does_not_move_meets_no_tolerance():
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(cube(), rubber())
    with ts.Simulator(scene, tolerance=0.01) as sim:
        result = sim.run(0.5)
    assert result.error_estimate.notes == ["the errors are unknown: nothing moves"] and result.status == "degraded"


def test_paths_that_part_meet_no_tolerance():
    """Six blocks fall on each other: after the first impacts each step has its own path."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    rng = np.random.default_rng(3)
    for k in range(6):
        place, velocity = (0.2 * (k % 2), 0.2 + 0.35 * k, 0.0), rng.uniform(-2.0, 2.0, 3)
        scene.add_body(cube(size=(0.3, 0.3, 0.3)), rubber(), name=f"block {k}", position=place, velocity=velocity)
    with ts.Simulator(scene, tolerance=0.01) as sim:
        result = sim.run(3.0)
    assert result.status == "degraded" and "and the tolerance is 1 %" in " ".join(result.problems)


# --- choices ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [stiff, dropped])
def test_reruns_are_equal(build):
    ends = []
    for _ in range(2):
        with ts.Simulator(build(), tolerance=0.01) as sim:
            sim.run(0.3)
            ends.append((sim.dt, sim.settings, sim.positions()))
    assert ends[0][:2] == ends[1][:2] and np.array_equal(ends[0][2], ends[1][2])


def test_before_the_first_run_steps_are_likely_ones():
    with ts.Simulator(beam(), tolerance=0.01) as sim:
        assert sim.settings.integrator == "velocity_verlet" and sim.dt <= 0.9 * sim.stable_dt
        assert sim.settings.newton_tolerance == 1e-4
        sim.step()
    with ts.Simulator(stiff(), tolerance=1e-3, newton_tolerance=1e-6) as sim:
        assert sim.settings.integrator == "bdf2" and sim.dt == 1 / 60
        assert (sim.settings.newton_tolerance, sim.settings.contact_tolerance) == (1e-6, 5e-5)
    with ts.Simulator(beam(), tolerance=0.01, integrator="bdf2", dt=1 / 120) as sim:  # as given, until the run
        assert sim.settings.integrator == "bdf2" and sim.dt == 1 / 120
        sim.run(0.1)
        assert sim.settings.integrator == "velocity_verlet"


@pytest.mark.parametrize("fps", [30, 60, 1000, None])
@pytest.mark.parametrize("build", [stiff, beam])
def test_frames_of_any_rate_lie_at_steps(build, fps):
    frames = []
    with ts.Simulator(build(), tolerance=0.01) as sim:
        result = sim.run(0.2, fps=fps, on_frame=lambda sim, *_: frames.append(sim.time))
    assert result.status == "ok" and frames[0] == 0.0 and frames[-1] == pytest.approx(0.2)
    assert len(frames) == (result.steps if fps is None else round(0.2 * fps)) + 1


def test_bad_tolerances_are_refused():
    for tolerance, message in ((0.0, "tolerance must be"), (1.0, "tolerance must be"), (1e-5, "or precision='f64'")):
        with pytest.raises(SimulationError, match=message):
            ts.Simulator(beam(), tolerance=tolerance)
    with ts.Simulator(beam(), tolerance=1e-5, precision="f64"):
        pass
    with pytest.raises(SimulationError, match="with a tolerance it must be 'auto'"):
        ts.Simulator(dropped(), tolerance=0.01, contact_solver="jacobi", integrator="velocity_verlet")


# --- pilots -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [beam, stiff, dropped])
def test_a_pilot_that_is_the_run_is_repeated_for_observers(build):
    """The same state, reports and status, whether frames are observed or not."""
    found = []
    for observed in (False, True):
        frames = []
        on_frame = (lambda sim, k, _report, frames=frames: frames.append(k)) if observed else None
        with ts.Simulator(build(), tolerance=0.01) as sim:
            result = sim.run(0.5, on_frame=on_frame)
            found.append((sim.positions(), sim.time, sim.step_count, result.status, len(result.step_reports), result.steps))
        assert frames == (list(range(31)) if observed else [])
    assert np.array_equal(found[0][0], found[1][0]) and found[0][1:] == found[1][1:]


def test_pilots_start_from_the_present_state():
    """Two runs of half the time go on as one; the second chooses anew."""
    with ts.Simulator(beam(), tolerance=0.01) as sim:
        sim.run(0.2)
        middle = sim.positions()
        result = sim.run(0.3)
        assert sim.time == pytest.approx(0.5) and result.sim_seconds == pytest.approx(0.3)
        assert not np.array_equal(middle, sim.positions())
        end, dt = sim.positions(), sim.dt
    with ts.Simulator(beam(), dt=dt, integrator="velocity_verlet") as sim:
        sim.run(0.5)
        assert end == pytest.approx(sim.positions(), abs=1e-5)


def test_an_interrupt_during_the_pilots_leaves_the_start():
    calls = []

    def stop():
        calls.append(1)
        return len(calls) > 5

    with ts.Simulator(stiff(), tolerance=0.01) as sim:
        start = sim.positions()
        result = sim.run(0.5, stop=stop)
        assert result.interrupted and result.status == "degraded" and result.steps == 0
        assert "interrupted during its pilots" in result.problems[0]
        assert sim.step_count == 0 and np.array_equal(sim.positions(), start)


def test_pilots_that_fail_end_the_run(monkeypatch):
    advance, start = ts.Simulator.advance, None

    def fails(sim, n):
        raise SimulationError("made to fail")

    with ts.Simulator(beam(), tolerance=0.01) as sim:
        start = sim.positions()
        monkeypatch.setattr(ts.Simulator, "advance", fails)
        result = sim.run(0.5)
        monkeypatch.setattr(ts.Simulator, "advance", advance)
        assert result.status == "failed" and "made to fail" in " ".join(result.problems)
        assert np.array_equal(sim.positions(), start)


def test_changed_numbers_are_those_of_the_pilots():
    with ts.Simulator(beam(), tolerance=0.01) as sim:
        sim.set_gravity((0.0, 0.0, 0.0))
        assert sim.run(0.2).error_estimate.excursion < 1e-5
        sim.set_gravity((0.0, -9.8, 0.0))
        assert sim.run(0.2).error_estimate.excursion > 1e-2


# --- checkpoints and the command ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [stiff, dropped])
def test_checkpoints_resume_bitwise_without_pilots(build, tmp_path):
    path = tmp_path / "checkpoint.npz"

    def save(sim, k, _report):
        if k == 10:
            sim.save_checkpoint(path)

    with ts.Simulator(build(), tolerance=0.01) as sim:
        sim.run(0.4, on_frame=save)
        end = sim.positions()
    with ts.Simulator.load_checkpoint(path, build()) as sim:
        assert sim.settings.tolerance == 0.01 and sim.step_count > 0
        result = sim.run(0.4, resumed=True)
        assert result.pilot_seconds == 0.0 and result.error_estimate is None
        assert np.array_equal(sim.positions(), end)


def test_the_command_chooses_steps(tmp_path, capsys):
    scene = write(tmp_path / "beam.py", BEAM)
    assert run(scene, "--tolerance", 0.01, "--seconds", 0.2, "--out", tmp_path / "out", *SHORT_OUTPUT) == 0
    printed = capsys.readouterr().out
    assert "for a tolerance of 1 %" in printed and "error    about " in printed
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["settings"]["tolerance"] == 0.01 and report["settings"]["integrator"] in printed
    assert report["error_estimate"]["time"] <= 0.01 and report["pilot_seconds"] > 0.0
    assert run(scene, "--tolerance", 2) == EXIT_BAD_INPUT
    assert "tolerance must be below 1" in capsys.readouterr().err


def test_nothing_is_planned_without_a_tolerance():
    with ts.Simulator(beam(), dt=1 / 60) as sim:
        result = sim.run(0.2)
        assert sim.dt == 1 / 60 and sim.settings.newton_tolerance is None
        assert result.pilot_seconds == 0.0 and result.error_estimate is None and not result.problems
