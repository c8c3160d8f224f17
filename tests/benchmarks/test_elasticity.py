"""The elasticity benchmark, on the smallest mesh and over a few steps. No test here checks speed:

* its scene, path and errors agree with the exact path, and step sizes that diverge are reported and skipped;
* costs, ratios, limits and tables follow from the measured numbers;
* the benchmark writes what it prints, with MuJoCo or with a note that it is missing.
"""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from benchmarks import document, elasticity, elasticity_runs
from benchmarks.document import Limit, slug
from benchmarks.elasticity_runs import (
    Row,
    beam_scene,
    follow_tip,
    lasting_steps,
    make_rows,
    measure_rows,
    steps_within_limit,
    time_ratio,
)
from benchmarks.elasticity_steps import (
    Cost,
    Frames,
    cost_limits,
    cost_table,
    frame_limits,
    frame_table,
    measure_costs,
    measure_frames,
)
from benchmarks.exact_path import SAMPLE, FallingBeam, load_exact
from taisoft.errors import SimulationError
from taisoft.fem.reference import lumped_masses
from taisoft.output.tables import markdown
from taisoft.study.measure import TimedRun, advance

CELLS = (12, 3, 3)
TINY = elasticity.Extent(meshes=(CELLS,), precisions=("f32",), repeats=2, rounds=(2,), seconds=0.02)


@pytest.fixture(scope="module")
def verlet():
    """A simulator of the beam at its largest stable step."""
    with ts.Simulator(beam_scene(CELLS), dt=SAMPLE / steps_within_limit(CELLS), integrator="velocity_verlet") as sim:
        yield sim


@pytest.fixture
def shared_simulator(verlet, monkeypatch):
    """Every new simulator is that one, reset: compiling many would take as long as all other tests."""

    def reuse(scene, *, dt, integrator, precision, arch):
        assert (integrator, precision, arch) == ("velocity_verlet", "f32", "cpu")
        verlet.reset()
        verlet.dt = dt
        return nullcontext(verlet)

    monkeypatch.setattr(ts, "Simulator", reuse)


def test_the_scene_is_the_beam_of_the_exact_path(verlet):
    beam = FallingBeam(CELLS)
    body = verlet.scene.body("beam")
    assert np.array_equal(body.mesh.vertices, beam.vertices)
    assert np.allclose(lumped_masses(verlet.scene), beam.mass, rtol=1e-14)
    assert np.array_equal(body.constraints[0].nodes, np.flatnonzero(~beam.free))
    assert (body.material.mu, body.material.lam) == pytest.approx((beam.mu, beam.lam))
    assert tuple(verlet.scene.gravity) == (0.0, -9.8, 0.0)


def test_the_path_is_close_to_the_exact_one(verlet):
    steps = steps_within_limit(CELLS)
    verlet.reset()
    verlet.dt = SAMPLE / steps
    assert verlet.dt <= 0.9 * verlet.stable_dt < SAMPLE / (steps - 1)
    path, timed = follow_tip(verlet, steps, 100)
    assert timed.steps == 100 * steps == verlet.step_count and timed.seconds > 0
    row = Row(540, "taisoft", "velocity_verlet", steps)
    row.set_errors(CELLS, path)
    assert row.error_unfolded <= row.error < 1e-4  # 2.9e-5 measured
    assert row.error == load_exact(CELLS).error(np.arange(101) * SAMPLE, path)


def test_timed_runs_add_up():
    total = TimedRun(3, 0.1, 1, 5, 2, 7) + TimedRun(4, 0.2, 0, 2, 1, 1)
    assert total == TimedRun(7, pytest.approx(0.3), 1, 5, 3, 8)


def test_step_sizes_that_diverge_are_skipped(shared_simulator, monkeypatch):
    """With a simulator that diverges at its first two step sizes."""
    tried = []

    def diverge_twice(sim, steps):
        tried.append(sim.dt)
        if len(tried) < 3:
            raise SimulationError("step 1: gone")
        return advance(sim, steps)

    monkeypatch.setattr(elasticity_runs, "advance", diverge_twice)
    first = steps_within_limit(CELLS)
    steps, note = lasting_steps(beam_scene(CELLS), "velocity_verlet", "cpu", 0.02)
    assert steps == first + 2 and tried == [SAMPLE / n for n in (first, first + 1, first + 2)]
    assert "3.333 ms (at t = 0.00 s), 2.500 ms (at t = 0.00 s) diverged" in note


def costs(**samples) -> list[Cost]:
    """Return costs in f32 on the smallest mesh; samples: law -> times [s]."""
    return [Cost(540, law, "velocity_verlet", "f32", 0.5, values) for law, values in samples.items()]


def test_costs_are_compared_sample_by_sample():
    found = costs(SNH=[6e-6, 12e-6, 6e-6], SVK=[5e-6, 10e-6, 5e-6], COR=[24e-6, 48e-6, 24e-6])
    limits = {limit.what: limit for limit in cost_limits(found)}
    assert limits["SNH step, velocity_verlet, 540 tets [us/step]"].value == pytest.approx(6)
    svk, cor = (limits[f"{law} / SNH, velocity_verlet, 540 tets"] for law in ("SVK", "COR"))
    assert (svk.value, cor.value) == pytest.approx((5 / 6, 4)) and svk.met and not cor.met
    assert cor.spread == pytest.approx(0)  # the slow sample is slow for all laws
    row = [cell.strip() for cell in cost_table(found).splitlines()[-1].split("|")]
    assert row[1:6] == ["540", "f32", "velocity_verlet", "COR", "24.00"] and row[9] == "4.00"


def test_steps_in_a_run_are_compared_with_single_ones():
    rows = [
        Frames(540, "velocity_verlet", 84, [11e-6, 22e-6, 5.5e-6], [10e-6, 20e-6, 5e-6]),
        Frames(540, "implicit_euler", 1, [2e-3], [1e-3]),
    ]
    row = [cell.strip() for cell in frame_table(rows).splitlines()[2].split("|")]
    assert row[1:9] == ["540", "velocity_verlet", "84", "10.00", "11.00", "1.100", "0.0%", "84"]
    (limit,) = frame_limits(rows)  # the median of the rounds' ratios: a slow round is slow for both
    assert limit.value == pytest.approx(1.1) and limit.spread == pytest.approx(0) and not limit.met


def test_limits_by_tets_and_precision():
    large = [Cost(34_560, "SNH", "velocity_verlet", precision, 0.5, [345.6e-6]) for precision in ("f32", "f64")]
    (limit,) = cost_limits(large)
    assert (limit.value, limit.limit) == pytest.approx((10, 11)) and "ns/tet" in limit.what


@pytest.mark.parametrize(
    "limit, met, close",
    [
        (Limit("a", 3.0, 3.0, at_least=True), True, False),
        (Limit("a", 2.9, 3.0, 0.01, at_least=True), False, False),
        (Limit("a", 2.9, 3.0, 0.1, at_least=True), False, True),
        (Limit("a", 2.9, 3.0, 0.1), True, True),
        (Limit("a", float("nan"), 3.0), False, False),
    ],
)
def test_limits_are_met_or_not(limit, met, close):
    assert (limit.met, limit.close) == (met, close)
    assert ("NOT met" in limit.row()[-1]) != met and ("within the spread" in limit.row()[-1]) == close


def test_time_ratios_are_per_round():
    ours = Row(540, "taisoft", "bdf2", 1, rounds=[[1.0, 1.0], [3.0]])
    theirs = Row(540, "MuJoCo", "discrete", 1, rounds=[[4.0], [12.0]])
    ratio = time_ratio(theirs, ours)
    assert (ratio.median, ratio.spread) == (4, 0)
    assert time_ratio(Row(540, "MuJoCo", "discrete", 1), ours) is None


def test_limits_of_implicit_runs():
    def row(program, integrator, seconds, error=0.01):
        return Row(34_560, program, integrator, 1, rounds=[[seconds]], error=error, error_unfolded=error / 10)

    limits = elasticity.run_limits([row("taisoft", "bdf2", 2.0), row("MuJoCo", "discrete", 8.0)])
    assert [(x.value, x.met) for x in limits] == [(4.0, True), (pytest.approx(1.0), False), (pytest.approx(0.1), True)]
    assert elasticity.run_limits([Row(540, "taisoft", "bdf2", 1, error=0.1)]) == []


def test_markdown_and_file_names():
    assert markdown(("a", "name"), [("12", "b"), ("345", "cd")], left=(1,)).splitlines() == [
        "|   a | name |",
        "| --: | ---- |",
        "|  12 | b    |",
        "| 345 | cd   |",
    ]
    assert slug("Intel(R) Xeon(R) CPU @ 2.60GHz") == "intel-xeon-cpu-2-60ghz"


def test_each_row_of_taisoft_has_one_of_mujoco(monkeypatch):
    monkeypatch.setattr(
        elasticity_runs, "lasting_steps", lambda cells, name, *rest: ({"velocity_verlet": 3}.get(name, 4), "note")
    )
    rows = [(r.program, r.integrator, r.steps, r.note) for r in make_rows(CELLS, "cpu", True, 1.0)]
    assert rows[:6] == [
        ("taisoft", "velocity_verlet", 3, "note"),
        ("MuJoCo", "euler_staggered", 2, ""),
        ("taisoft", "velocity_verlet", 6, ""),
        ("MuJoCo", "euler_staggered", 4, ""),
        ("taisoft", "symplectic_euler", 4, "note"),
        ("MuJoCo", "euler", 2, ""),
    ]
    implicit = ("bdf2", "implicit_midpoint", "implicit_euler", "linearly_implicit_euler")
    assert {(r[1], r[2]) for r in rows[6:]} == {*((name, 1) for name in implicit), ("discrete", 1), ("discrete", 4)}
    assert {r.program for r in make_rows(CELLS, "cpu", False, 1.0)} == {"taisoft"}


@pytest.fixture
def tiny(monkeypatch):
    """The benchmark with one law, one integrator and three points of the path."""
    rows = (("taisoft", "velocity_verlet", 4), ("MuJoCo", "euler", 2))
    monkeypatch.setattr(elasticity, "QUICK", TINY)
    monkeypatch.setattr(elasticity, "measure_costs", lambda *a: measure_costs(*a, ("SVK",), ("velocity_verlet",)))
    monkeypatch.setattr(elasticity, "measure_frames", lambda *a: measure_frames(*a, ("velocity_verlet",)))
    monkeypatch.setattr(
        elasticity, "make_rows", lambda cells, arch, peers, seconds: [Row(540, *r) for r in rows if peers or r[0] == "taisoft"]
    )


def test_command_with_mujoco(tiny, shared_simulator, tmp_path, monkeypatch, capsys):
    calls = []

    def peer(cells, integrator, dt, seconds):
        calls.append((cells, integrator, dt, seconds))
        return {"compile_seconds": 0.25, "error": 0.02, "error_unfolded": 0.01, "seconds_per_simulated_second": 4.0}

    monkeypatch.setattr(elasticity, "run_mujoco", peer)
    monkeypatch.setattr(elasticity_runs, "run_mujoco", peer)
    assert elasticity.main(["--quick", "--out", str(tmp_path / "new" / "e.json")]) == 0
    assert set(calls[1:]) == {(CELLS, "euler", 0.005, 0.02)}
    numbers = json.loads((tmp_path / "new" / "e.json").read_text())
    ours, theirs = numbers["runs"]
    assert ours["error"] < 1e-3 and ours["first_run"]["steps"] == 8 and len(ours["rounds"]) == 2 and not ours["failure"]
    assert theirs["rounds"] == [[4.0], [4.0]] and theirs["error"] == 0.02 and theirs["build_seconds"] == [0.25, 0.25]
    (cost,) = numbers["cost"]
    assert cost["tets"] == 540 and len(cost["samples"]) == 2 and cost["step_seconds"]["minimum"] > 0
    (frames,) = numbers["frames"]
    assert (frames["tets"], frames["steps"], len(frames["run"]), len(frames["alone"])) == (540, 84, 2, 2)
    assert frames["ratio"]["minimum"] > 0
    assert numbers["arch"] == "cpu" and numbers["quick"] is True and numbers["mujoco_left_out"] is None
    shown, kept = capsys.readouterr().out, (tmp_path / "new" / "e.md").read_text()
    assert kept.strip() in shown
    for part in ("| MuJoCo ", "2.0000% | (1.0000%)", "cores, load"):
        assert part in kept


def test_command_without_mujoco(tiny, monkeypatch, capsys):
    def absent(*a, **b):
        raise SimulationError("the comparison needs the package mujoco")

    monkeypatch.setattr(elasticity, "run_mujoco", absent)
    monkeypatch.setattr(elasticity, "QUICK", replace(TINY, precisions=()))
    monkeypatch.setattr(elasticity, "measure_frames", lambda *a: [])
    assert elasticity.main(["--quick"]) == 0
    shown = capsys.readouterr().out
    assert "MuJoCo is not compared with: the comparison needs the package mujoco.\n" in shown
    assert "| taisoft | velocity_verlet" in shown and "| MuJoCo " not in shown


def test_a_divergence_is_shown_in_its_row(capsys):
    row = Row(540, "MuJoCo", "euler", 1)

    def diverge(*a):
        raise SimulationError("it diverges")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(elasticity_runs, "run_mujoco", diverge)
        measure_rows([row], CELLS, "cpu", 3, 0.02)
    assert row.failure == "it diverges" and row.timing is None
    assert capsys.readouterr().err.count("MuJoCo euler") == 1
    assert "* MuJoCo euler, dt = 10.000 ms: it diverges" in elasticity.run_table([row])


def test_results_are_named_after_the_machine(monkeypatch):
    monkeypatch.setattr(document, "machine", lambda: {"processor": "AMD EPYC", "cores": 2})
    assert document.default_out("cpu", "elasticity").name == "elasticity-amd-epyc-2-cores.json"
    assert document.default_out("cuda", "elasticity").name == "elasticity-amd-epyc-2-cores-cuda.json"
