"""The grid of a study: its product, what is refused or the same, and the frames at which runs meet."""

import itertools

import pytest

from taisoft.cli.study import values_of
from taisoft.errors import SceneError
from taisoft.study import AXES, Setting
from taisoft.study.plan import MAX_FRAMES, cases, complete, expand, frame_time
from taisoft.study.runner import Task, steps_in, tasks_of

EXPLICIT = ("symplectic_euler", "velocity_verlet")


def test_the_product_of_all_axes():
    axes = complete({"dt": [0.01, 0.02], "precision": ["f32", "f64"], "refine": [0, 1]}, {"integrator": "bdf2"})
    settings = expand(axes)
    assert len(settings) == len(set(settings)) == 2 * 2 * 2 * 2  # bdf2 and implicit_euler
    assert [s.dt for s in settings[:2]] == [0.02, 0.01] and {s.precision for s in settings} == {"f32", "f64"}
    found = {(s.dt, s.precision, s.refine, s.integrator) for s in settings}
    assert found == set(itertools.product([0.01, 0.02], ["f32", "f64"], [0, 1], ["bdf2", "implicit_euler"]))


def test_what_is_not_given_is_the_scenes():
    solver = {"dt": 0.01, "integrator": "velocity_verlet", "contact_tolerance": 1e-3, "seconds": 2.0, "self_collision": True}
    axes = complete({}, solver)
    assert set(axes) == set(AXES) and axes["contact_tolerance"] == [1e-3] and axes["precision"] == ["f32"]
    assert axes["integrator"] == ["velocity_verlet", "implicit_euler", "bdf2"]
    assert min(axes["dt"]) == 0.005 and max(axes["dt"]) == 0.16  # implicit steps are larger
    assert max(complete({}, {})["dt"]) == 1 / 30
    assert complete({"integrator": ["bdf2"]}, solver)["integrator"] == ["bdf2"]


def test_refused_and_equal_ones_stay_in_the_list():
    given = {"dt": [0.02, 0.01], "integrator": ["velocity_verlet", "bdf2"], "newton_tolerance": [None, 1e-3]}
    settings = expand(complete(given, {}))
    explicit = [s for s in settings if s.integrator in EXPLICIT]

    def refusal(setting: Setting) -> str:
        return "too large" if setting in explicit and setting.dt == 0.02 else ""

    def unused(setting: Setting) -> dict:
        return {"newton_tolerance": "it solves no equations"} if setting in explicit else {}

    found = cases(settings, refusal, unused)
    assert [case.setting for case in found] == settings
    told = {(c.setting.integrator, c.setting.dt, c.setting.newton_tolerance): c.refused for c in found}
    assert told["velocity_verlet", 0.02, None] == told["velocity_verlet", 0.02, 1e-3] == "too large"
    assert told["velocity_verlet", 0.01, None] == ""
    assert told["velocity_verlet", 0.01, 1e-3] == "the same run as one above: it solves no equations"
    assert not any(reason for (name, _, _), reason in told.items() if name == "bdf2")


@pytest.mark.parametrize(
    "steps, seconds, frame, frames",
    [
        ([0.01, 0.005], 1.0, 0.04, 25),  # 0.03, of 33 frames, would not end at 1 s
        ([1 / 60, 0.01], 1.0, 0.05, 20),
        ([1 / 960, 1 / 60, 1 / 7680], 2.0, 0.05, 40),
        ([0.1], 1.0, 0.1, 10),
        ([0.1], 0.97, 0.1, 10),
    ],
)
def test_frames_are_multiples_of_every_step(steps, seconds, frame, frames):
    found = frame_time(steps, seconds)
    assert found == (pytest.approx(frame), frames) and frames <= MAX_FRAMES
    for dt in steps:
        assert steps_in(found[0], dt) * dt == pytest.approx(found[0], rel=1e-9)


def test_steps_that_never_meet_are_refused():
    with pytest.raises(SceneError, match="coincide only every 0.7 s.*multiples of one another"):
        frame_time([0.1, 0.07], 2.0)
    with pytest.raises(SceneError, match="no common multiple"):
        frame_time([2**0.5 / 100, 0.01], 2.0)
    assert frame_time([2**0.5 / 100], 2.0)[0] == pytest.approx(3 * 2**0.5 / 100)


def test_a_reference_is_two_runs():
    one, refused = ({"setting": {"dt": dt}, "refused": why} for dt, why in ((0.05, ""), (0.1, "too large")))
    plan = {"frame": 0.1, "references": [{"setting": {"dt": 0.01}, "steps": 10}], "cases": [refused, one]}
    references, settings = tasks_of(plan)
    assert [(t.steps, t.setting["dt"], t.timed) for t in references] == [(10, 0.01, False), (5, 0.02, False)]
    assert settings == [Task({"dt": 0.05}, steps=2, timed=True)]


@pytest.mark.parametrize(
    "key, text, values",
    [
        ("dt", "0.01,1", [0.01, 1.0]),
        ("integrator", "bdf2, implicit_euler", ["bdf2", "implicit_euler"]),
        ("newton_tolerance", "none,1e-3", [None, 1e-3]),
        ("order", "1,2", [1, 2]),
    ],
)
def test_comma_lists(key, text, values):
    assert values_of(key, text) == values


@pytest.mark.parametrize(
    "key, text, told",
    [
        ("dt", "0.01,0", "--dt 0.01,0: dt must be greater than 0"),
        ("dt", "0.01,", "is not a number"),
        ("dt", "0.01,0.01", "given twice"),
        ("order", "3", "--order must be 1 or 2, not 3"),
        ("refine", "0.5", "--refine must be 0 or 1"),
        ("precision", "f16", "precision must be one of f32, f64"),
        ("newton_tolerance", "2", "must be below 0.1"),
    ],
)
def test_lists_that_are_refused(key, text, told):
    with pytest.raises(SceneError, match=told.replace("(", r"\(")):
        values_of(key, text)
