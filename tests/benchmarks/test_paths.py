"""The benchmark of the check of paths:

* where nothing can touch, the check has no launches and no fields; elsewhere both ways end in the same state;
* captured substeps follow each other, and least distances are those of the geometry, without a body's own surface;
* a hard case stops after the captured steps;
* the command prints and writes both tables, and fails if the beam pays for the check.
"""

import importlib.util
import json

import numpy as np
import pytest

import taisoft as ts
from benchmarks import path_runs, paths
from benchmarks.path_runs import BEAM, CHECK, COST, LIST, WAYS, Bounds, Cost, Ways, capture, measure_cost, measure_ways
from benchmarks.runner import RESULT
from taisoft.errors import OutputError
from tests.dynamics.scenes import dynamics, rows_of

BALL = np.tile([0.0, 0.41, 0.0], (2, 1))  # its axis
needs_ipctk = pytest.mark.skipif(not importlib.util.find_spec("ipctk"), reason="ipctk is not installed")


def cost(name: str, **more) -> Cost:
    """A row with made-up numbers."""
    numbers = {"launches": {CHECK: 30, LIST: 5}, "relisting": 5, "with_check": [2.2e-3, 2.0e-3], "without": [2.0e-3, 2.0e-3]}
    return Cost(name, 0.01, 20, **numbers | more)


def ways(name: str, **more) -> Ways:
    """A row with made-up numbers."""
    numbers = {"dt": 0.01, "substeps": 4, "passing": 3, "passages": 2, "near": 50, "over": 5, "ratios": [0.5, 0.5, 2.0, 4.0]}
    numbers |= {"checks": 5, "pairs": 5000, "seconds": 1e-2, "bound_pairs": 800, "search_seconds": 4e-3, "bound_seconds": 2e-3}
    return Ways(name, 4, **numbers | more)


# --- runs ---------------------------------------------------------------------------------------------------------------


def test_a_beam_that_nothing_can_touch_does_not_pay():
    found = measure_cost(BEAM, "cpu", 1, 4, 0.01)
    assert found.launches == {CHECK: 0, LIST: 0} and found.field_bytes == 0 and found.same
    assert len(found.with_check) == len(found.without) == 1


def test_both_ways_end_in_the_same_state(monkeypatch):
    monkeypatch.setitem(COST, "cubes", (lambda: path_runs.demo("two_cubes_two_boxes"), 1.0, 4))
    found = measure_cost("cubes", "cpu", 2)
    assert found.same and not found.passages and found.launches[CHECK] >= found.steps == 4
    assert found.relisting <= found.launches[LIST] and found.near > 0.0 and found.contacts > 0 and found.field_bytes > 0
    assert len(found.with_check) == len(found.without) == 2 and min(found.with_check + found.without) > 0.0


def test_without_the_check_nothing_is_launched(monkeypatch):
    launched = []
    monkeypatch.setattr(path_runs.ContactPaths, "find", lambda *_, **__: launched.append(1))
    with path_runs.unchecked():
        assert path_runs.ContactPaths.find(None) is False
    path_runs.ContactPaths.find(None)
    assert launched == [1]


def test_captured_substeps_follow_each_other():
    scene, settings = path_runs.demo("two_cubes_two_boxes")
    row = Ways("two_cubes_two_boxes", 10)
    with path_runs.without_warnings(), ts.Simulator(scene, **settings) as sim:
        taken = capture(sim, row, row.steps)
        nodes = [np.unique(body.nodes.surface) for body in sim.scene.bodies]
        nodes = np.concatenate([n + rows_of(sim, body.name).start for n, body in zip(nodes, sim.scene.bodies)])
        assert sim.positions()[nodes] == pytest.approx(taken[-1][0] + taken[-1][1], abs=1e-12)
    assert len(taken) >= 10 and row.passages > 0 and row.held_back == 0 and row.passing < len(taken) < row.checks
    for (x, path), (following, _) in zip(taken, taken[1:]):
        assert following == pytest.approx(x + path, abs=1e-12)


@needs_ipctk
def test_least_distances_are_those_of_the_geometry():
    from benchmarks.judge import axis_distance, triangle_distance  # needs ipctk

    scene = ts.Scene()
    foam = ts.Material(young=1e5, poisson=0.3, density=1000.0)
    for name, y in (("lower", 0.12), ("upper", 0.25)):
        scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), foam, name=name, position=(0.0, y, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    scene.add_obstacle(ts.Sphere(tuple(BALL[0]), 0.1), name="ball")
    with dynamics(scene, dt=0.01) as made:
        detection = made.contact.detection
        detection.find(0.0, 0.01)
        bounds, x = Bounds(detection, self_collision=False), detection.surface.x.to_numpy()
        t = detection.topology
        for within in (0.5, 0.025):
            found = bounds.of(bounds.search(x, within), x, within)
            for i, least in enumerate(found):
                own = np.flatnonzero((t.triangle == i).any(axis=1))
                others = np.flatnonzero(t.body != t.body[own[0]])
                far = [triangle_distance(x, t.triangle[a], t.triangle[b]) for a in own for b in others]
                far += [axis_distance(*BALL, x[t.triangle[a]]) - 0.1 for a in own] + [x[i, 1], within]
                assert least == pytest.approx(min(far), abs=1e-9)
        assert len(found) == len(x) == 16 and found.min() == pytest.approx(0.01) and found.max() == 0.025


@needs_ipctk
def test_steps_are_compared_with_the_bound():
    found = measure_ways("two_cubes_two_boxes", "cpu", 8)
    assert found.substeps == len(found.ratios) + found.held_back >= 8
    assert 0 < found.over <= found.near and max(found.ratios) > 1.0
    assert found.pairs > 0 and found.bound_pairs > 0 and min(found.seconds, found.search_seconds, found.bound_seconds) > 0.0


def test_a_hard_case_stops_after_the_captured_steps(monkeypatch, capsys):
    monkeypatch.setattr(
        path_runs, "compare", lambda sim, row, steps: setattr(row, "substeps", steps * sim.settings.self_collision)
    )
    monkeypatch.setattr(paths, "QUICK_STEPS", 3)
    assert paths.main(["--child", json.dumps({"what": "ways", "scene": "S1 B, start 0", "arch": "cpu", "quick": True})]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith(RESULT))
    found = Ways(**json.loads(line.removeprefix(RESULT)))
    assert (found.name, found.substeps) == ("S1 B, start 0", 3)


# --- the command --------------------------------------------------------------------------------------------------------


def test_cells_of_both_tables():
    text = paths.cost_table([cost("cube_pile")])
    cells = [cell.strip() for cell in text.splitlines()[2].split("|")]
    assert "1.050" in cells and "1.50" in cells and "0.25" in cells and "1.00 to 1.10" in text and "15 of 20" in text
    text = paths.ways_table([ways("cube_pile", held_back=1)])
    cells = [cell.strip() for cell in text.splitlines()[2].split("|")[1:-1]]
    expected = ["cube_pile", "10", "4", "75.0%", "2", "1", "50.0%", "50", "10.0%"]
    assert cells == [*expected, "1.25, 3.4, 4", "1,000", "2.000", "0.500", "1.500", "200"]
    assert " - |" in paths.ways_table([ways("cube_pile", near=0, over=0)])


def test_the_command_writes_both_tables(monkeypatch, tmp_path, capsys):
    beam = {"launches": {CHECK: 0, LIST: 0}}

    def made(what, name, arch, quick):
        return ways(name) if what == "ways" else cost(name, **beam if name == BEAM else {})

    monkeypatch.setattr(paths, "run_child", made)
    monkeypatch.setattr(paths.importlib.util, "find_spec", lambda name: object())
    out = tmp_path / "paths.json"
    assert paths.main(["--quick", "--out", str(out)]) == 0
    stored, page = json.loads(out.read_text()), out.with_suffix(".md").read_text()
    assert [row["name"] for row in stored["cost"]] == list(COST) and [row["name"] for row in stored["ways"]] == list(WAYS)
    assert "## Cost" in page and "## Two ways" in page and page.count("| met ") == 3
    beam["field_bytes"] = 8
    assert paths.main(["--what", "cost", "--scene", BEAM]) == 1 and "NOT met" in capsys.readouterr().out


def test_the_bound_needs_ipctk(monkeypatch):
    monkeypatch.setattr(paths.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(paths, "run_child", lambda what, name, arch, quick: cost(name))
    with pytest.raises(OutputError, match="needs ipctk"):
        paths.main([])
    assert paths.main(["--what", "cost", "--scene", "cube_pile"]) == 0
