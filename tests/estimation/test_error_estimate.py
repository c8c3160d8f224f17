"""Error estimates by twins:

* observed orders and Richardson factors are exact for power laws; too small an order gives none; parting paths are noticed;
* the error of free fall in steps of implicit Euler is estimated as its closed form; estimates of beams meet their true errors;
* the error of the mesh needs a twin on another one, which must start as the run does;
* what twins cannot follow, and twins that fail, leave the error unknown and say why; runs end with all twins released;
* the forecast follows the orders; the command prints a sentence and writes report, pictures and USD with errors.
"""

import dataclasses
import json
import math
import warnings

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli import EXIT_BAD_INPUT
from taisoft.errors import SceneError, SimulationError
from taisoft.estimation.forecast import describe_error, forecast, percent
from taisoft.estimation.order import agreement, error_over_difference, nominal_order, observed_order
from taisoft.records import ErrorEstimate
from taisoft.view.plots import Plots
from tests.cli.command import BEAM, SHORT_OUTPUT, run, write
from tests.dynamics.scenes import cube, rubber


def falling(**body) -> ts.Scene:
    """One free block."""
    scene = ts.Scene(gravity=(0.0, -10.0, 0.0))
    scene.add_body(cube(), rubber(), name="block", **body)
    return scene


def beam(cells=(4, 1, 1), order=1) -> ts.Scene:
    """A beam of 4 x 1 x 1 m, clamped at its left end."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    body = scene.add_body(ts.box_mesh(cells, (4.0, 1.0, 1.0)), rubber(young=1e6), name="beam", order=order)
    body.fix(lambda X: X[:, 0] < -1.99)
    return scene


# --- orders -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("ratio", [0.5, 2.0, 3.0])
def test_errors_of_a_power_law_are_exact(order, ratio):
    one, other = 0.1**order, (0.1 * ratio) ** order
    assert error_over_difference(ratio, order) * abs(other - one) == pytest.approx(one)


def test_orders_are_observed_within_their_bounds():
    assert observed_order(1.0, 4.0, 2.0) == pytest.approx(2.0)
    assert observed_order(1.0, 3.0, 2.0) == pytest.approx(math.log2(3.0))
    assert observed_order(1.0, 4.0, 1.0) == 1.0  # not above the nominal order
    for order in (0.5, 1.0, 1.7):  # of runs with 2, 8 and 22 steps
        errors = [steps**-order for steps in (2.0, 8.0, 22.0)]
        fine, coarse = errors[1] - errors[2], errors[0] - errors[1]
        assert observed_order(fine, coarse, 2.0, near=22 / 8, far=4.0) == pytest.approx(order)
    assert observed_order(1.0, 1.3, 2.0) is None and observed_order(0.0, 1.0, 2.0) is None


def test_paths_agree_until_their_differences_show_no_order():
    fine = np.array([1.0, 1.0, 1.0, 1e3, 1e3])
    assert agreement(fine, 16.0 * fine, 0.0) == 5
    assert agreement(fine, np.array([16.0, 16.0, 16.0, 16.0, 16.0]), 0.0) == 3
    assert agreement(fine, fine, 0.0) == 0
    assert agreement(fine, fine, 1e4) == 5  # negligible differences need no order


def test_contacts_damping_and_paths_lower_the_nominal_order():
    assert nominal_order("bdf2", falling(), touches=False) == 2 and nominal_order("implicit_euler", falling(), touches=False) == 1
    assert nominal_order("bdf2", falling(), touches=True) == 1
    damped = ts.Scene()
    damped.add_body(cube(), rubber(mass_damping=1.0))
    assert nominal_order("bdf2", damped, touches=False) == 1


# --- estimates ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_free_fall_in_steps_of_implicit_euler(precision):
    """x_n = -g dt^2 n (n + 1) / 2: the error at time t is g t dt / 2, and that of a fall of g t (t + dt) / 2 in all."""
    with ts.Simulator(falling(), dt=1 / 64, precision=precision) as sim:
        result = sim.run(1.0, fps=16, error=True)
    e = result.error_estimate
    assert e.excursion == pytest.approx(5.0 * (1.0 + 1 / 64), rel=1e-5) and e.order == pytest.approx(1.0, abs=1e-3)
    assert e.time * e.excursion == pytest.approx(5.0 / 64, rel=1e-3)
    assert e.solver < 1e-4 and e.space is None and e.total == pytest.approx(e.time + e.solver)
    assert e.bodies["block"].time == e.time and len(e.twins) == 3 and not e.notes
    assert e.energies.gravity == pytest.approx(-1000.0 * 0.99 * 10.0 * 5.0 / 64, rel=0.01)  # it falls too far
    assert result.status == "ok" and e.wall_seconds > 0.0 and result.wall_seconds > 0.0


def test_few_steps_are_compared_with_half_the_step():
    with ts.Simulator(falling(), dt=1 / 16) as sim:
        e = sim.run(0.5, fps=16, error=True).error_estimate
    assert e.twins[0] == "dt = 0.03125 s" and len(e.twins) == 2 and e.order == 1.0
    assert e.time * e.excursion == pytest.approx(5.0 * 0.5 / 16, rel=1e-3)


@pytest.mark.parametrize("integrator", ["velocity_verlet", "bdf2"])
def test_a_swinging_beam(integrator):
    """The estimate in time against a run with a sixteenth of the step; the mesh's error is of the known size."""
    paths = []

    def recorded(scene, dt, **more):
        with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
            path = []
            result = sim.run(0.5, fps=30, on_frame=lambda sim, *_: path.append(sim.positions()), **more)
            paths.append(np.array(path))
            return result

    dt = 1 / 480 if integrator == "velocity_verlet" else 1 / 60
    e = recorded(beam(), dt, error=True, error_mesh="refined").error_estimate
    recorded(beam(), dt / 16)
    run_path, exact = paths
    excursion = np.linalg.norm(exact - exact[0], axis=2).max()
    true = np.linalg.norm(run_path - exact, axis=2).max() / excursion
    assert 0.5 < e.time / true < 2.0
    assert 0.05 < e.space < 0.5 and e.excursion == pytest.approx(excursion, rel=0.02)


def test_what_is_explicit_and_does_not_touch_has_no_error_of_solvers():
    with ts.Simulator(falling(), dt=1 / 1024, integrator="velocity_verlet") as sim:
        e = sim.run(0.1, error=True).error_estimate
    assert e.solver == 0.0


def test_errors_are_independent_of_the_place():
    """A run from another place gives the same estimate up to rounding."""
    found = []
    for place in (0.0, 100.0):
        scene = falling(position=(place, 0.0, -place))
        with ts.Simulator(scene, dt=1 / 64, precision="f64") as sim:
            found.append(sim.run(0.5, fps=16, error=True).error_estimate.time)
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_errors_at_the_nodes_and_so_far_during_the_run():
    seen = []

    def look(sim, index, _report):
        seen.append((sim.nodal_errors("beam"), sim.error_so_far.time))

    with ts.Simulator(beam(), dt=1 / 60, integrator="bdf2") as sim:
        e = sim.run(1.0, fps=15, on_frame=look, error=True).error_estimate
        assert sim.error_so_far is None
        with pytest.raises(SimulationError, match="only during"):
            sim.nodal_errors()
        fixed = sim.scene.body("beam").rest_positions[:, 0] < -1.99
    assert np.isnan(seen[0][0]).all() and seen[0][1] is None  # before the first comparison
    errors, last = seen[-1]
    assert last == e.time and (errors[fixed] == 0.0).all() and errors[~fixed].min() > 0.0
    assert errors.max() <= 1.01 * e.excursion * e.total


def test_a_run_goes_on_as_without_twins():
    ends = []
    for error in (False, True):
        with ts.Simulator(beam(), dt=1 / 60, integrator="bdf2") as sim:
            sim.run(0.3, error=error)
            sim.run(0.6, error=error)  # from a state in motion
            ends.append(sim.positions())
    assert np.array_equal(*ends)


# --- meshes -------------------------------------------------------------------------------------------------------------


def test_the_other_order_and_another_mesh():
    with ts.Simulator(beam(), dt=1 / 60) as sim:
        found = []
        for mesh in ("refined", "order", beam((8, 2, 2))):
            found.append(sim.run(0.6, fps=15, error=True, error_mesh=mesh).error_estimate.space)
            sim.reset()
    assert all(0.03 < space < 0.6 for space in found) and found[0] == pytest.approx(found[2], rel=0.3)


def test_meshes_that_cannot_be_compared_are_refused():
    with ts.Simulator(beam(), dt=1 / 60) as sim:
        with pytest.raises(SimulationError, match="error_mesh needs error=True"):
            sim.run(0.1, error_mesh="refined")
        with pytest.raises(SimulationError, match="error_mesh 'fine' is unknown"):
            sim.run(0.1, error=True, error_mesh="fine")
        with pytest.raises(SimulationError, match="body 'beam' has 20 tets there and 20 in the run: the mesh widths must differ"):
            sim.run(0.1, error=True, error_mesh=beam())
        with pytest.raises(SimulationError, match="its bodies are block, and those of the run beam"):
            sim.run(0.1, error=True, error_mesh=falling())
        held = beam((8, 2, 2))
        held.body("beam").fix(lambda X: np.abs(X[:, 0] - np.round(X[:, 0])) < 1e-9)  # all that the meshes share
        with pytest.raises(SimulationError, match="all nodes of both meshes that coincide are constrained"):
            with ts.Simulator(held, dt=1 / 60) as other:
                other.run(0.1, error=True, error_mesh=beam())
        assert sim.step_count == 0
        sim.step()
        with pytest.raises(SimulationError, match=r"the run must start there too: reset\(\)"):
            sim.run(0.1, error=True, error_mesh="refined")
        assert sim.error_so_far is None


# --- what twins cannot follow -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [lambda sim: sim.set_gravity((0, 0, 0)), lambda sim: setattr(sim, "dt", 1 / 120)])
def test_a_change_during_the_run_leaves_the_error_unknown(change):
    with ts.Simulator(beam(), dt=1 / 60) as sim:
        e = sim.run(1.0, fps=15, on_frame=lambda sim, k, _: change(sim) if k == 5 else None, error=True).error_estimate
    assert e.time is e.total is None and "changed meanwhile" in e.notes[0]


def test_a_body_at_rest_has_no_relative_error():
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(cube(), rubber())
    with ts.Simulator(scene, dt=1 / 60) as sim:
        e = sim.run(1.0, error=True).error_estimate
    assert e.time is None and e.notes == ["the errors are unknown: nothing moves"]
    assert describe_error(e, 1.0) == e.notes


def test_frames_need_not_lie_at_common_steps():
    """Six steps a frame, comparisons at multiples of four: those of the last common step of every frame."""
    frames = []
    with ts.Simulator(falling(), dt=1 / 60, precision="f64") as sim:
        result = sim.run(1.0, fps=10, on_frame=lambda sim, k, _: frames.append(sim.step_count), error=True)
        few = sim.run(3 / 60, fps=20, error=True).error_estimate
    assert frames == list(range(0, 61, 6)) and len(result.step_reports) == 60
    e = result.error_estimate
    assert e.order == pytest.approx(1.0, abs=1e-6) and e.time * e.excursion == pytest.approx(5.0 / 60, rel=1e-3) and not e.notes
    assert few.time is not None


def test_an_error_run_within_another_is_refused():
    def nested(sim, k, _report):
        if k == 2:
            sim.run(0.1, error=True)

    with ts.Simulator(falling(), dt=1 / 60) as sim:
        result = sim.run(1.0, fps=15, on_frame=nested, error=True)
        assert result.status == "failed" and "during another one" in result.problems[0]
        assert sim.error_so_far is None


def test_nodal_errors_are_unknown_after_a_change():
    seen = []

    def changes(sim, k, _report):
        if k == 5:
            sim.set_gravity((0.0, 0.0, 0.0))
        seen.append(np.isnan(sim.nodal_errors()).all())

    with ts.Simulator(falling(), dt=1 / 64) as sim:
        sim.run(1.0, fps=8, on_frame=changes, error=True)
    assert seen == [True] + 4 * [False] + 4 * [True]


def test_warnings_of_twins_are_not_given(monkeypatch, recwarn):
    advance = ts.Simulator.advance

    def warns(sim, n):
        if sim.dt > 1 / 50:
            warnings.warn("of a twin", UserWarning, stacklevel=1)
        return advance(sim, n)

    monkeypatch.setattr(ts.Simulator, "advance", warns)
    with ts.Simulator(falling(), dt=1 / 64) as sim:
        assert sim.run(1.0, fps=16, error=True).error_estimate.time is not None
    assert not [one for one in recwarn if "of a twin" in str(one.message)]


def test_a_failed_twin_leaves_its_error_unknown(monkeypatch):
    advance = ts.Simulator.advance

    def fails(sim, n):
        if sim.dt > 1 / 50:
            raise SimulationError("made to fail")
        return advance(sim, n)

    monkeypatch.setattr(ts.Simulator, "advance", fails)
    with ts.Simulator(beam(), dt=1 / 60) as sim:
        result = sim.run(1.0, fps=15, error=True)
    assert result.status == "ok" and result.error_estimate.time is None and result.error_estimate.solver is not None
    assert "failed: made to fail" in result.error_estimate.notes[0]


def test_paths_that_part_are_noticed():
    """Six blocks fall on each other: after the first impacts each step has its own path."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    ground = ts.HalfSpace((0, 0, 0), (0, 1, 0))
    scene.add_obstacle(ground, name="ground", friction=0.5)
    rng = np.random.default_rng(3)
    for k in range(6):
        place, velocity = (0.2 * (k % 2), 0.2 + 0.35 * k, 0.0), rng.uniform(-2.0, 2.0, 3)
        scene.add_body(cube(size=(0.3, 0.3, 0.3)), rubber(), name=f"block {k}", position=place, velocity=velocity)
    with ts.Simulator(scene, dt=1 / 60, integrator="bdf2") as sim:
        result = sim.run(3.0, fps=15, error=True)
    e = result.error_estimate
    assert e.time is None and 0.0 < e.agree_until < 3.0 and 0.0 < e.time_until_then
    assert set(e.spread_after) == {f"block {k}" for k in range(6)} and "part after" in e.notes[0]
    assert describe_error(e, 1.0)[0].endswith("then unknown")
    assert e.solver is None and "the error of solver is unknown, since the paths part" in e.notes


def test_an_interrupted_run_has_an_estimate_and_releases_its_twins():
    def stops(sim, k, _report):
        if k == 8:
            raise KeyboardInterrupt

    with ts.Simulator(beam(), dt=1 / 60) as sim:
        result = sim.run(1.0, fps=15, on_frame=stops, error=True)
        assert result.interrupted and result.error_estimate.time > 0.0 and sim.error_so_far is None
        with pytest.raises(ZeroDivisionError):
            sim.run(1.0, fps=15, on_frame=lambda *_: 1 / 0, error=True)
        assert sim.error_so_far is None


def test_a_rebuild_after_the_last_comparison_leaves_the_error_unknown():
    """The run goes on with the new settings, and keeps its twins until its end."""

    def rebuilds(sim, k, _report):
        if k == 20:
            sim.rebuild(integrator="bdf2")
            assert sim.error_so_far.time is None

    with ts.Simulator(beam(), dt=1 / 60) as sim:
        result = sim.run(21 / 60, on_frame=rebuilds, error=True)
        assert result.steps == 21 and "changed meanwhile" in result.error_estimate.notes[0]
        assert sim.error_so_far is None


# --- reports ------------------------------------------------------------------------------------------------------------


def test_forecasts_follow_the_orders():
    only_time = ErrorEstimate(time=0.04, solver=0.0, order=2.0)
    assert forecast(only_time, 3.0) == (pytest.approx(0.01), pytest.approx(6.0))
    both = dataclasses.replace(only_time, time=0.02, space=0.02)
    target, seconds = forecast(both, 1.0)
    assert (target, seconds) == (pytest.approx(0.01), pytest.approx(4.0**0.5 * 4.0**2))
    (sentence,) = describe_error(both, 1.0)
    assert sentence == "about 4 % of the largest excursion (time 2, space 2, solver 0); 1 % would take about 32 s"
    solver = dataclasses.replace(only_time, solver=0.005)
    assert forecast(solver, 1.0) == (pytest.approx(0.01), pytest.approx(8.0**0.5))
    assert forecast(dataclasses.replace(solver, solver=0.02), 1.0) is None  # steps would not help
    (sentence,) = describe_error(ErrorEstimate(space=0.1, solver=0.001), 1.0)
    assert sentence == "unknown in time; in percent of the largest excursion space 10, solver 0.1"
    assert forecast(ErrorEstimate(), 1.0) is None and forecast(ErrorEstimate(time=0.0), 1.0) is None
    assert [percent(value) for value in (0.0, 1e-9, 0.01234, 2.0)] == ["0", "< 0.0001", "1.2", "200"]


def test_energies_are_drawn_as_bands():
    with ts.Simulator(beam(), dt=1 / 60) as sim:
        plots = Plots(sim, ("energies", "error"), errors=True)
        sim.run(1.0, fps=15, on_step=plots.take, error=True)
    width = plots.history.high[:, :4] - plots.history.low[:, :4]
    assert (width[:4] == 0.0).all() and (width[10:] > 0.0).any(axis=1).all()
    assert {name for name, _, _ in plots.curves("error").legend} == {"time", "space", "solver"}
    with pytest.raises(SceneError, match="does not estimate errors"):
        Plots(sim, ("error",))


def test_the_command_prints_and_writes_errors(tmp_path, capsys):
    scene = write(tmp_path / "beam.py", BEAM)
    options = ("--error-mesh", "refined", "--colour", "error", "--plots", "error", "--out", tmp_path / "out")
    assert run(scene, *options) == 0
    assert "error    about " in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "report.json").read_text())["error_estimate"]
    assert found["time"] > 0.0 and found["space"] > 0.0 and set(found["bodies"]) == {"beam"}
    assert len(list((tmp_path / "out" / "frames").glob("*.png"))) == 4
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "out" / "scene.usdc"))
    values = stage.GetPrimAtPath("/World/beam/tets").GetAttribute("primvars:estimatedError")
    assert max(values.Get(0.0)) == -1.0 and min(values.Get(3.0)) >= 0.0 and max(values.Get(3.0)) > 0.0


BLOCK = "scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), order=2, position=(9, 0, 0))"
BOTH_ORDERS = BEAM.replace("    return scene", f"    {BLOCK}\n    return scene")


@pytest.mark.parametrize("option", ["overwrite", "resume"])
def test_a_mesh_that_is_refused_leaves_earlier_results(option, tmp_path, capsys):
    scene, out = write(tmp_path / "beam.py", BOTH_ORDERS), tmp_path / "out"
    assert run(scene, "--out", out, "--seconds", 0.05, *SHORT_OUTPUT) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    given = {"overwrite": ("--overwrite",), "resume": ("--resume", out / "checkpoint.npz", "--seconds", 0.1)}[option]
    assert run(scene, "--out", out, *given, "--error-mesh", "order", *SHORT_OUTPUT) == EXIT_BAD_INPUT
    message = {"overwrite": "beam.py: error_mesh 'order': the bodies have both orders", "resume": "excludes --resume"}[option]
    assert message in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("options", [("--colour", "error"), ("--plots", "error")])
def test_errors_are_shown_only_where_they_are_estimated(options, tmp_path, capsys):
    scene = write(tmp_path / "beam.py", BEAM)
    assert run(scene, *options, "--out", tmp_path / "out", *SHORT_OUTPUT[:1]) == EXIT_BAD_INPUT
    assert "needs --error" in capsys.readouterr().err and not (tmp_path / "out").exists()
