"""The plan of a study, made without running the scene:

* the grid is the product of the axes; combinations that are invalid stay in the list with the reason;
* frames are common multiples of all steps;
* references are of second order, respect the explicit limit, and there is one for each mesh and, with quadratic tets, for each
  kind of mass; the finest mesh's reference is that for errors in space.
"""

import functools
import itertools

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.cli.study import values_of
from taisoft.errors import SceneError
from taisoft.scene.refine import refined, with_order
from taisoft.study import AXES, Setting
from taisoft.study.runner import Task, steps_in, tasks_of
from taisoft.study.tasks import Planner, complete, expand, frame_time
from tests.cli.command import write
from tests.fem.shells import inside, thick_sphere


def test_grid_is_the_product_of_all_axes():
    axes = complete({"dt": [0.01, 0.02], "precision": ["f32", "f64"], "refine": [0, 1]}, {"integrator": "bdf2"})
    settings = expand(axes)
    assert len(settings) == len(set(settings)) == 2**4  # implicit_euler is added to the scene's bdf2
    assert [s.dt for s in settings[:2]] == [0.02, 0.01] and {s.precision for s in settings} == {"f32", "f64"}
    found = {(s.dt, s.precision, s.refine, s.integrator) for s in settings}
    assert found == set(itertools.product([0.01, 0.02], ["f32", "f64"], [0, 1], ["bdf2", "implicit_euler"]))


def test_axes_default_to_the_scenes_solver():
    solver = {"dt": 0.01, "integrator": "velocity_verlet", "contact_tolerance": 1e-3, "seconds": 2.0, "self_collision": True}
    axes = complete({}, solver)
    assert set(axes) == set(AXES) and axes["contact_tolerance"] == [1e-3] and axes["precision"] == ["f32"]
    assert axes["integrator"] == ["velocity_verlet", "implicit_euler", "bdf2"]
    assert min(axes["dt"]) == 0.005 and max(axes["dt"]) == 0.16  # implicit steps are larger
    assert max(complete({}, {})["dt"]) == 1 / 30
    assert complete({"integrator": ["bdf2"]}, solver)["integrator"] == ["bdf2"]


def test_frames_are_multiples_of_every_step():
    for steps, seconds, frame, frames in (
        ([0.01, 0.005], 1.0, 0.04, 25),  # 0.03, of 33 frames, would not end at 1 s
        ([1 / 60, 0.01], 1.0, 0.05, 20),
        ([1 / 960, 1 / 60, 1 / 7680], 2.0, 0.05, 40),
        ([0.1], 0.97, 0.1, 10),
    ):
        found = frame_time(steps, seconds)
        assert found == (pytest.approx(frame), frames)
        for dt in steps:
            assert steps_in(found[0], dt) * dt == pytest.approx(found[0], rel=1e-9)


def test_steps_without_common_multiples_are_rejected():
    with pytest.raises(SceneError, match="coincide only every 0.7 s.*multiples of one another"):
        frame_time([0.1, 0.07], 2.0)
    with pytest.raises(SceneError, match="no common multiple"):
        frame_time([2**0.5 / 100, 0.01], 2.0)
    assert frame_time([2**0.5 / 100], 2.0)[0] == pytest.approx(3 * 2**0.5 / 100)


def test_each_reference_is_two_runs():
    valid, refused = ({"setting": {"dt": dt}, "refused": why} for dt, why in ((0.05, ""), (0.1, "too large")))
    plan = {"frame": 0.1, "references": [{"setting": {"dt": 0.01}, "steps": 10}], "cases": [refused, valid]}
    references, settings = tasks_of(plan)
    assert [(t.steps, t.setting["dt"], t.timed) for t in references] == [(10, 0.01, False), (5, 0.02, False)]
    assert settings == [Task({"dt": 0.05}, steps=2, timed=True)]


def test_comma_separated_values():
    for key, text, expected in (
        ("dt", "0.01,1", [0.01, 1.0]),
        ("integrator", "bdf2, implicit_euler", ["bdf2", "implicit_euler"]),
        ("newton_tolerance", "none,1e-3", [None, 1e-3]),
        ("order", "1,2", [1, 2]),
    ):
        assert values_of(key, text) == expected
    for key, text, message in (
        ("dt", "0.01,0", "--dt 0.01,0: dt must be greater than 0"),
        ("dt", "0.01,", "is not a number"),
        ("dt", "0.01,0.01", "given twice"),
        ("order", "3", "--order must be 1 or 2, not 3"),
        ("newton_tolerance", "2", "must be below 0.1"),
    ):
        with pytest.raises(SceneError, match=message):
            values_of(key, text)


REQUEST = {"axes": {}, "seconds": 0.4, "reference_dt": None, "reference_integrator": None, "reference_refine": 0}


def bar_scene(ground: bool = False, fixed_by_ids: bool = False, **numbers) -> ts.Scene:
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)), ts.Material(young=1e5, **numbers), name="bar")
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    elif fixed_by_ids:
        bar.fix(np.flatnonzero((bar.rest_positions[:, 1] > 0) & (bar.rest_positions[:, 2] > 0)))
    else:
        bar.fix(lambda X: X[:, 0] < -0.99)
    return scene


def plan_of(scene: ts.Scene, axes: dict, solver: dict | None = None, **request) -> dict:
    @functools.cache
    def variant(refine: int, order: int | None) -> ts.Scene:
        made = scene
        for _ in range(refine):
            made = refined(made)
        return made if order is None else with_order(made, order)

    return Planner(variant, solver or {}, REQUEST | {"axes": axes} | request).plan()


def test_settings_that_cannot_be_run_stay_in_the_list_with_the_reason():
    axes = {"dt": [0.1, 0.01], "integrator": ["velocity_verlet", "bdf2"], "newton_tolerance": [None, 1e-3], "refine": [0, 1]}
    plan = plan_of(bar_scene(fixed_by_ids=True), axes)
    settings = [Setting(**case["setting"]) for case in plan["cases"]]
    assert settings == expand(complete(axes, {})) and len(settings) == 16 and plan["space"] is None
    reasons = {(s.refine, s.integrator, s.dt, s.newton_tolerance): c["refused"] for s, c in zip(settings, plan["cases"])}
    large = reasons[0, "velocity_verlet", 0.1, None]
    assert large.startswith("dt = 0.1 s is above the stability limit of velocity_verlet, 0.0")
    assert reasons[0, "velocity_verlet", 0.1, 1e-3] == large
    assert reasons[0, "velocity_verlet", 0.01, None] == reasons[0, "velocity_verlet", 0.01, 1e-3] == ""
    assert not any(reason for (refine, name, *_), reason in reasons.items() if (refine, name) == (0, "bdf2"))
    assert all("choose by a function" in reason for (refine, *_), reason in reasons.items() if refine)
    with pytest.raises(SceneError, match=r"^the reference \(refine 1\): body 'bar'"):
        plan_of(bar_scene(fixed_by_ids=True), {"dt": [0.01], "integrator": ["bdf2"]}, reference_refine=1)


def test_settings_unfit_for_contacts_are_refused():
    axes = {"dt": [0.01], "integrator": ["implicit_euler", "implicit_midpoint"], "contact_solver": ["auto", "jacobi"]}
    plan = plan_of(bar_scene(ground=True), axes)
    reasons = [case["refused"] for case in plan["cases"]]
    assert sum("jacobi' does not fit implicit_euler" in r for r in reasons) == 1
    assert sum("implicit_midpoint does not support contacts" in r for r in reasons) == 2 and reasons.count("") == 1
    assert plan["touching"] and plan["references"][0]["setting"]["integrator"] == "bdf2"
    assert plan["references"][0]["order_in_time"] == 1


@pytest.mark.parametrize("dt, density, integrator", [(0.01, 1000.0, "velocity_verlet"), (1.6, 1.0, "implicit_midpoint")])
def test_references_are_of_second_order_and_below_the_limit(dt, density, integrator):
    plan = plan_of(bar_scene(density=density), {"dt": [dt, dt / 2], "integrator": ["bdf2"]}, seconds=8.0)
    (reference,) = plan["references"]
    setting = reference["setting"]
    assert (setting["integrator"], setting["precision"], reference["order_in_time"]) == (integrator, "f64", 2)
    assert reference["steps"] % 2 == 0 and reference["steps"] * setting["dt"] == pytest.approx(plan["frame"])
    assert setting["dt"] <= dt / 16 * (1 + 1e-9)


def test_damping_motion_or_integrator_reduce_the_reference_to_first_order():
    moved = bar_scene()
    moved.bodies[0].move(lambda X: X[:, 0] > 0.99, lambda t: (0, t, 0))
    euler = {"reference_integrator": "implicit_euler"}
    for scene, request in ((bar_scene(mass_damping=1.0), {}), (moved, {}), (bar_scene(), euler)):
        assert plan_of(scene, {"dt": [0.01]}, **request)["references"][0]["order_in_time"] == 1


def test_references_can_keep_given_volumes():
    """Also where an explicit reference would be cheap; the grid lists the integrators that cannot."""
    mesh, rule = thick_sphere(1.0, 2.0, 2, 1, whole=True), "cavity 'water' of given volume needs"
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(mesh, ts.Material(young=1e5), name="ball").add_cavity(inside(mesh, 1.0), volume=4.2, name="water")
    plan = plan_of(scene, {"dt": [0.01], "integrator": ["implicit_midpoint", "bdf2"]})
    assert [one["setting"]["integrator"] for one in plan["references"]] == ["bdf2"]
    refused = {case["setting"]["integrator"]: case["refused"] for case in plan["cases"]}
    assert rule in refused["implicit_midpoint"] and refused["bdf2"] == ""
    message = f"^the reference .refine 0.: --reference-integrator implicit_midpoint: {rule} implicit_euler or bdf2$"
    with pytest.raises(SceneError, match=message):
        plan_of(scene, {"dt": [0.01], "integrator": ["bdf2"]}, reference_integrator="implicit_midpoint")


def test_quadratic_tets_have_a_reference_for_each_kind_of_mass():
    axes = {"dt": [0.005], "integrator": ["velocity_verlet", "bdf2"], "order": [1, 2]}
    plan = plan_of(bar_scene(), axes)
    found = [(r["setting"]["order"], r["kind"], r["setting"]["integrator"]) for r in plan["references"]]
    assert sorted(found) == [(1, "", "velocity_verlet"), (2, "explicit", "velocity_verlet"), (2, "implicit", "implicit_midpoint")]
    assert found[plan["space"]][:2] == (2, "implicit")
    plan = plan_of(bar_scene(), axes | {"order": [2]}, reference_integrator="implicit_midpoint")
    kinds = {r["kind"]: r["setting"]["integrator"] for r in plan["references"]}
    assert kinds == {"explicit": "velocity_verlet", "implicit": "implicit_midpoint"}
    assert "because implicit_midpoint has another mass matrix" in plan["notes"][0]


def test_finest_mesh_is_the_reference_in_space():
    axes = {"dt": [0.005], "integrator": ["velocity_verlet"]}
    assert plan_of(bar_scene(), axes)["space"] is None
    for plan in (plan_of(bar_scene(), axes | {"refine": [0, 1]}), plan_of(bar_scene(), axes, reference_refine=1)):
        assert plan["references"][plan["space"]]["setting"]["refine"] == 1 and len(plan["references"]) == 2


def test_impossible_references_are_rejected():
    for changes, message in (
        ({"reference_dt": 1.0, "reference_integrator": "velocity_verlet"}, "reference-dt 1.*allows at most"),
        ({"reference_integrator": "rk4"}, "reference-integrator must be one of"),
        ({"seconds": 0.01}, "coincide only every"),
    ):
        with pytest.raises(SceneError, match=message):
            plan_of(bar_scene(), {"dt": [0.01], "integrator": ["bdf2"]}, **{"seconds": 16.0} | changes)


def test_scene_file_may_refine_itself(tmp_path):
    text = (
        "import taisoft as ts\n\n\ndef build(refine=1):\n    scene = ts.Scene()\n"
        "    scene.add_body(ts.box_mesh((1 + refine,) * 3, (1, 1, 1)), ts.Material())\n    return scene\n"
    )
    path = str(write(tmp_path / "cube.py", text))
    assert [load_scene(path, refine=k)[0].bodies[0].mesh.n_tets for k in (None, 0)] == [40, 5]
    quadratic = load_scene(path, refine=1, order=2)[0].bodies[0]
    assert quadratic.order == 2 and quadratic.mesh.n_tets == 40
