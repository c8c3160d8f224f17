"""The plan of a study, made of a scene without running it:

* what does not fit is refused with the reason: a dt above the limit, a solver or an integrator, a scene that cannot be refined;
* references are of second order, fit the scene and its explicit limit, one a mesh and, for quadratic tets, a kind of mass;
* the finest mesh's reference is the one for errors in space.
"""

import functools

import numpy as np
import pytest
from command import write

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.errors import SceneError
from taisoft.scene.refine import refined, with_order
from taisoft.study.plan import make_plan

ASK = {"axes": {}, "seconds": 0.4, "reference_dt": None, "reference_integrator": None, "reference_refine": 0}


def scene_of(ground: bool = False, ids: bool = False, **numbers) -> ts.Scene:
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)), ts.Material(young=1e5, **numbers), name="bar")
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    elif ids:
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

    return make_plan(variant, solver or {}, ASK | {"axes": axes} | request)


def told(plan: dict) -> dict:
    return {(c["setting"]["integrator"], c["setting"]["dt"]): c["refused"] for c in plan["cases"]}


def test_a_dt_above_the_explicit_limit_is_refused():
    plan = plan_of(scene_of(), {"dt": [0.1, 0.01], "integrator": ["velocity_verlet", "bdf2"]})
    found = told(plan)
    assert found["velocity_verlet", 0.1].startswith("dt = 0.1 s is above the stability limit of velocity_verlet, 0.0")
    assert [found[key] for key in (("velocity_verlet", 0.01), ("bdf2", 0.1), ("bdf2", 0.01))] == ["", "", ""]


def test_what_does_not_fit_the_contacts_is_refused():
    axes = {"dt": [0.01], "integrator": ["implicit_euler", "implicit_midpoint"], "contact_solver": ["auto", "jacobi"]}
    plan = plan_of(scene_of(ground=True), axes)
    reasons = [case["refused"] for case in plan["cases"]]
    assert sum("jacobi' does not fit implicit_euler" in r for r in reasons) == 1
    assert sum("implicit_midpoint does not support contacts" in r for r in reasons) == 2 and reasons.count("") == 1
    assert plan["touching"] and plan["references"][0]["setting"]["integrator"] == "bdf2"
    assert plan["references"][0]["order_in_time"] == 1


def test_axes_that_do_not_count_are_not_run_twice():
    axes = {"dt": [0.01], "integrator": ["velocity_verlet"], "newton_tolerance": [None, 1e-6], "contact_tolerance": [None, 1e-2]}
    reasons = [case["refused"] for case in plan_of(scene_of(), axes)["cases"]]
    assert reasons.count("") == 1 and len(reasons) == 4
    assert any("velocity_verlet solves no equations" in r for r in reasons)
    assert any("nothing can come into contact in this scene" in r for r in reasons)


def test_a_scene_that_cannot_be_refined_says_why():
    plan = plan_of(scene_of(ids=True), {"dt": [0.01], "integrator": ["bdf2"], "refine": [0, 1]})
    assert [case["refused"][:10] for case in plan["cases"]] == ["", "body 'bar'"]
    assert "choose by a function" in plan["cases"][1]["refused"] and plan["space"] is None


@pytest.mark.parametrize("dt, density, integrator", [(0.01, 1000.0, "velocity_verlet"), (1.6, 1.0, "implicit_midpoint")])
def test_references_are_of_second_order_and_within_the_limit(dt, density, integrator):
    plan = plan_of(scene_of(density=density), {"dt": [dt, dt / 2], "integrator": ["bdf2"]}, seconds=8.0)
    (reference,) = plan["references"]
    setting = reference["setting"]
    assert (setting["integrator"], setting["precision"], reference["order_in_time"]) == (integrator, "f64", 2)
    assert reference["steps"] % 2 == 0 and reference["steps"] * setting["dt"] == pytest.approx(plan["frame"])
    assert setting["dt"] <= dt / 16 * (1 + 1e-9)


def test_what_makes_the_reference_one_of_first_order():
    assert plan_of(scene_of(mass_damping=1.0), {"dt": [0.01]})["references"][0]["order_in_time"] == 1
    moved = scene_of()
    moved.bodies[0].move(lambda X: X[:, 0] > 0.99, lambda t: (0, t, 0))
    assert plan_of(moved, {"dt": [0.01]})["references"][0]["order_in_time"] == 1
    plan = plan_of(scene_of(), {"dt": [0.01]}, reference_integrator="implicit_euler")
    assert plan["references"][0]["order_in_time"] == 1


def test_a_reference_integrator_of_the_other_mass_is_replaced_and_told():
    axes = {"dt": [0.005], "integrator": ["velocity_verlet", "bdf2"], "order": [2]}
    plan = plan_of(scene_of(), axes, reference_integrator="implicit_midpoint")
    assert {r["kind"]: r["setting"]["integrator"] for r in plan["references"]} == {
        "explicit": "velocity_verlet",
        "implicit": "implicit_midpoint",
    }
    assert plan["notes"] == [
        "explicit steps of quadratic tets use the reference velocity_verlet, because implicit_midpoint has another mass matrix"
    ]


def test_quadratic_tets_have_a_reference_for_each_kind_of_mass():
    axes = {"dt": [0.005], "integrator": ["velocity_verlet", "bdf2"], "order": [1, 2]}
    plan = plan_of(scene_of(), axes)
    found = [(r["setting"]["order"], r["kind"], r["setting"]["integrator"]) for r in plan["references"]]
    assert sorted(found) == [(1, "", "velocity_verlet"), (2, "explicit", "velocity_verlet"), (2, "implicit", "implicit_midpoint")]
    assert found[plan["space"]][:2] == (2, "implicit")


def test_the_finest_mesh_is_the_reference_in_space():
    axes = {"dt": [0.005], "integrator": ["velocity_verlet"]}
    assert plan_of(scene_of(), axes)["space"] is None
    plan = plan_of(scene_of(), axes | {"refine": [0, 1]})
    assert plan["references"][plan["space"]]["setting"]["refine"] == 1 and len(plan["references"]) == 2
    plan = plan_of(scene_of(), axes, reference_refine=1)
    assert plan["references"][plan["space"]]["setting"]["refine"] == 1 and len(plan["references"]) == 2


def test_a_reference_that_nobody_asked_for_is_named():
    with pytest.raises(SceneError, match=r"^the reference \(refine 1\): body 'bar'"):
        plan_of(scene_of(ids=True), {"dt": [0.01], "integrator": ["bdf2"]}, reference_refine=1)


@pytest.mark.parametrize(
    "wanted, error",
    [
        ({"reference_dt": 1.0, "reference_integrator": "velocity_verlet"}, "reference-dt 1.*allows at most"),
        ({"reference_integrator": "rk4"}, "reference-integrator rk4: it must be one of"),
        ({"seconds": 0.01}, "coincide only every"),
    ],
)
def test_references_that_cannot_be(wanted, error):
    with pytest.raises(SceneError, match=error):
        plan_of(scene_of(), {"dt": [0.01], "integrator": ["bdf2"]}, **{"seconds": 16.0} | wanted)


def test_a_scene_file_may_refine_itself(tmp_path):
    text = (
        "import taisoft as ts\n\n\ndef build(refine=0):\n    scene = ts.Scene()\n"
        "    scene.add_body(ts.box_mesh((1 + refine,) * 3, (1, 1, 1)), ts.Material())\n    return scene\n"
    )
    path = str(write(tmp_path / "cube.py", text))
    assert load_scene(path)[0].bodies[0].mesh.n_tets == 5
    own = str(write(tmp_path / "own.py", text.replace("refine=0", "refine=1")))
    assert [load_scene(own, refine=k)[0].bodies[0].mesh.n_tets for k in (None, 0)] == [40, 5]
    assert load_scene(path, refine=1)[0].bodies[0].mesh.n_tets == 40
    quadratic = load_scene(path, refine=1, order=2)[0].bodies[0]  # the order it leaves to us
    assert quadratic.order == 2 and quadratic.mesh.n_tets == 40
