"""Trials, the errors that they show, and what steps cost, as arithmetic: a refinement gives the error and the order of its last
trial; one explicit trial has an error by its velocities and by its fastest part; trials restore the state.
"""

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.estimation.costs import explicit_step, implicit_step
from taisoft.estimation.first_choice import settings_for, stable_steps
from taisoft.estimation.refinement import Refinement, implicit_sizes
from taisoft.estimation.trials import Frames, Part, Trial, distances, make_frames
from taisoft.records import RunReport
from taisoft.running import RunRequest, run_steps
from taisoft.settings import Settings
from tests.dynamics.scenes import cube, rubber
from tests.estimation.stand_in import BDF2, VERLET, block, motion

FRAMES = Frames(1.0, 20.0, slice(None), np.zeros(1, dtype=int), 0.0)


def trial_of(integrator: str, steps, error: float, frames=range(21), **more) -> Trial:
    """A trial that moves by 1 m in 20 s, too far by an error that grows with time."""
    positions = {k: np.array([[k / 20.0 * (1.0 + error), 0.0, 0.0]]) for k in frames}
    return Trial(integrator, Fraction(steps), positions, **more)


def refinement_of(
    integrator: str, sudden: bool, sizes, impacts: bool = False, error: float = 0.001, order: float = 1.0
) -> Refinement:
    """A refinement of trials, from coarse to fine; error: of one step a frame."""
    refinement = Refinement(integrator, sudden, 1 if sudden else 2, FRAMES, impacts)
    for steps in sizes:
        refinement.add(trial_of(integrator, steps, error * float(Fraction(steps)) ** -order))
    return refinement


@pytest.mark.parametrize(
    "integrator, sudden, impacts, order, counted",
    [
        (VERLET, False, False, 2.0, 2.0),
        (VERLET, True, False, 1.8, 1.0),
        (VERLET, True, True, 1.2, 1.2),
        (VERLET, True, True, 1.8, 1.25),
        (VERLET, True, True, 2.2, 1.0),
        (BDF2, True, True, 1.8, 1.0),
    ],
)
def test_impacts_count_as_of_low_order(integrator, sudden, impacts, order, counted):
    """Where nothing but contacts lowers the order it may be 1.25; where it seems to be above 2 that is chance."""
    refinement = refinement_of(integrator, sudden, (4, 8, 16), impacts, 1.0, order)
    expected = (8**-order - 16**-order) / (2**counted - 1) / (1.0 + 16**-order)  # over the excursion
    assert refinement.error == pytest.approx(expected) and refinement.order == pytest.approx(counted)
    assert refinement.meets(1.1 * expected) == (sudden and counted <= 1.0) and refinement.meets(1.3 * expected)


def test_too_few_trials_must_seem_far_better_than_needed():
    """By a factor of ten; a third implicit trial shows the order, whatever the ratios of steps."""
    few, all_three = refinement_of(BDF2, True, ("1/4", 1)), refinement_of(BDF2, True, ("1/4", 1, 2))
    assert few.error == pytest.approx(0.001, rel=0.01) and all_three.error == pytest.approx(0.0005, rel=0.01)
    assert few.order is None and all_three.order == pytest.approx(1.0)
    assert [few.steps_needed(tolerance) for tolerance in (0.011, 0.009)] == [1, None]
    assert [all_three.steps_needed(tolerance) for tolerance in (0.0051, 0.00026)] == [2, 5]


def test_trials_have_two_or_four_times_the_steps():
    """Four where three times as many seem too few, until an order shows or a trial fails."""
    first = refinement_of(VERLET, True, (4, 8), impacts=True)
    assert [first.next_steps(0.8 * first.error / more * 1.5625, Fraction(8)) for more in (2.9, 5.1)] == [16, 32]
    assert refinement_of(VERLET, True, (4, 8, 16)).next_steps(1e-9, Fraction(16)) == 32
    first.add(trial_of(VERLET, 32, 0.0, report=RunReport(status="failed")))
    assert first.next_steps(1e-9, Fraction(32)) == 64
    for count, expected in ((100, ["1/4", 1, 2, 4]), (20, ["1/2", 1, 2, 4]), (3, [4, 8, 16, 32])):
        assert list(itertools.islice(implicit_sizes(count), 4)) == [Fraction(steps) for steps in expected]


def test_trials_that_fail_stall_or_are_degraded():
    refinement = refinement_of(VERLET, False, (4, 8, 16), order=2.0)
    before = refinement.error
    failed = trial_of(VERLET, 32, 0.0, report=RunReport(status="failed"))
    refinement.add(failed)
    assert refinement.tried == 4 and len(refinement.trials) == 3 and refinement.error == before and not refinement.is_over
    while refinement.tried < 8:
        refinement.add(failed)
    assert refinement.is_over and not refinement.diverges
    stalled = refinement_of(VERLET, False, (4, 8, 16, 32), order=-0.5)
    assert stalled.diverges and stalled.is_over and not refinement_of(VERLET, False, (4, 8, 16), order=-0.5).diverges
    assert not refinement_of(BDF2, False, ("1/4", "1/2", 1), order=-0.5).stalled  # so coarse that it does not count
    for trial in (degraded := refinement_of(VERLET, False, (4, 8, 16), order=2.0)).trials:
        trial.report.status = "degraded"
    assert [degraded.steps_needed(1.0) for _ in range(3)] == [None, None, 16]


def test_velocities_show_an_error():
    """Smooth motion lags by the variation of its acceleration, with dt^2; an impact may be late by a step."""

    def expected(sudden: bool, steps: int, variations: float, jump: float) -> Refinement:
        refinement = Refinement(VERLET, sudden, 1 if sudden else 2, FRAMES)
        refinement.add(trial_of(VERLET, steps, 0.0, variations=np.array([0.0, variations]), jump=jump))
        return refinement

    smooth = expected(False, 4, 6.0, 0.0)
    assert 1.0 / 16 / 24 * 6.0 <= smooth.error < 0.1 and smooth.meets(1.3 * smooth.error)
    assert expected(False, 4, 4.0, 1.0).error == pytest.approx(smooth.error)
    assert expected(False, 8, 6.0, 0.0).error == pytest.approx(smooth.error / 4)
    late = expected(True, 4, 0.0, 2.0)
    assert 0.25 * 2.0 <= late.error == pytest.approx(2.0 * expected(True, 8, 0.0, 2.0).error)
    assert late.error == pytest.approx(2.0 * expected(True, 4, 0.0, 1.0).error)
    assert expected(True, 4, 6.0, 0.0).error == pytest.approx(1.0 / 16 / 24 * 6.0)
    assert not late.meets(5.0 * late.error) and late.meets(12.0 * late.error)  # it is unsure


def test_the_fastest_part_shows_errors_of_damping():
    """At its end the paths with 4 and 5 steps differ by their errors, which add up as velocities do; a part may fail."""
    refinement = Refinement(VERLET, False, 1, FRAMES)
    refinement.add(trial_of(VERLET, 4, 1 / 4, variations=1e-9, fastest=Part(19, {}, 2.0), velocities=6.0))
    assert refinement.is_damped and refinement.meets(1e-6)
    refinement.confirm(trial_of(VERLET, 5, 1 / 5, (19, 20)))
    assert refinement.error * (1 + 1 / 4) == pytest.approx(3.0 / 5)
    refinement.confirm(trial_of(VERLET, 5, 1 / 4, (19, 20)))
    assert refinement.error * (1 + 1 / 4) == pytest.approx(3.0 / 5)  # the larger of all
    refinement.confirm(trial_of(VERLET, 5, 0.0, (19, 20), report=RunReport(status="failed")))
    assert refinement.error is None and not refinement.meets(1.0) and refinement.steps_over_last(0.01) == 1.0


def test_the_fastest_part_is_kept():
    """The block falls for 27 frames. The same steps repeat the part bitwise. Trials leave the state as it was."""
    sim = motion(frequency=0.0, floor=-1.5)(block(touching=True), 1e-3, VERLET)
    sim.advance(3)
    before = sim.snapshot()
    frames = make_frames(sim, 0.6, 1 / 60)
    trial = frames.trial(sim, Fraction(17), None, keeps=True)
    fastest = trial.fastest
    part = frames.trial(sim, Fraction(17), None, part=fastest)
    assert all(np.array_equal(before[name], sim.snapshot()[name]) for name in before if before[name] is not None)
    assert fastest.first >= 25 and trial.times > 3.0 and part.fastest is None
    assert trial.jump > 2.0
    assert list(part.positions) == list(range(fastest.first, fastest.first + frames.part + 1))
    assert all(np.array_equal(x, trial.positions[frame]) for frame, x in part.positions.items())
    assert trial.end["step_count"] == 3 + 36 * 17 and trial.touches and not part.counts_per_step()[0]
    coarser = frames.trial(sim, Fraction(1, 4), None)
    assert list(coarser.positions) == list(range(0, 37, 4)) and coarser.report.steps == 9
    found, ends = distances(trial, coarser), trial.positions[36] - coarser.positions[36]
    assert found.shape == (10, 8) and np.allclose(found[-1], np.linalg.norm(ends, axis=1), rtol=1e-15)
    trial, seen, sim.dt = make_frames(sim, 0.6, 1 / 250).trial(sim, Fraction(4), None), [], 1 / 1000
    run_steps(sim, RunRequest(0.6, 250.0, on_frame=lambda sim, *_: seen.append(sim.v)))
    assert list(trial.positions) == [*range(0, 150, 4), 150]  # fewer than 48, and the last
    changes = np.diff(seen, axis=0)
    assert trial.jump == pytest.approx(np.linalg.norm(changes, axis=2).max()) and len(seen) == 151
    assert trial.variations == pytest.approx(np.linalg.norm(np.diff(changes, axis=0), axis=2).sum(axis=0))


def test_costs_add_up():
    """Over tets, of which quadratic ones cost more, iterations, bodies that touch and paths."""
    two, quadratic, prescribed, belt = block(), block(), block(), block(touching=True)
    two.add_body(cube((9, 0, 0)), rubber(), name="second")
    vars(quadratic.bodies[0])["order"] = 2
    prescribed.bodies[0].move([0], lambda t: (0, t, 0))
    belt.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="mill", path=lambda t: (np.zeros(3), np.eye(3)))
    for cost in (explicit_step, implicit_step):
        one, touching = cost(block(), False), cost(block(), True)
        per_body = cost(two, True) - cost(two, False) - (touching - one)
        assert 0.0 < per_body < touching - one < cost(belt, True) - one and cost(belt, False) == one
        assert cost(quadratic, False) - one == pytest.approx(3.0 * (cost(two, False) - one))
        assert cost(prescribed, False) > one
    base, more = ([implicit_step(scene, False, [n, 0, 0]) for scene in (block(), two)] for n in (1.0, 2.0))
    assert all(implicit_step(block(), False, [1.0, *np.eye(2)[k]]) > base[0] for k in (0, 1))
    assert more[1] - base[1] > more[0] - base[0] > 0.0


def test_a_tolerance_gives_likely_settings():
    soft, limit = settings_for(block(), Settings(tolerance=0.01))
    per_frame = 1 / 60 / soft.dt
    assert soft.integrator == VERLET and soft.dt <= 0.9 * limit * (1.0 + 1e-9) and per_frame == pytest.approx(round(per_frame))
    stiff, none = settings_for(block(young=1e10), Settings(tolerance=1e-3, newton_tolerance=1e-6))
    assert (stiff.integrator, stiff.dt, stiff.newton_tolerance, none) == (BDF2, 1 / 60, 1e-6, None)
    assert 0.0 < stiff.contact_tolerance < soft.contact_tolerance and 1e-6 < soft.newton_tolerance < 0.01
    given = settings_for(block(), Settings(tolerance=0.01, integrator="symplectic_euler", dt=1e-4))[0]
    assert (given.integrator, given.dt) == ("symplectic_euler", 1e-4)
    assert [stable_steps(limit, 1.0) for limit in (0.5, 0.51, 0.01, np.inf)] == [3, 3, 112, 1]
    for bad, message in (
        ({"newton_tolerance": 0.01}, "newton_tolerance = 0.01: with tolerance = 0.01 it must be at most 0.0005"),
        ({"tolerance": 1e-5}, "tolerance = 1e-05: in f32 it must be at least 0.0001, or precision='f64'"),
        ({"tolerance": 1e-9, "precision": "f64"}, "in f64 it must be at least 1e-07$"),
        ({"contact_solver": "jacobi"}, "contact_solver 'jacobi': with a tolerance it must be 'auto'"),
    ):
        with pytest.raises(SimulationError, match=message):
            settings_for(block(), replace(Settings(tolerance=0.01), **bad))
