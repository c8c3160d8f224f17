"""The benchmark of crossings:

* a number reproduces a heap exactly, another number gives another one; all kinds of bodies occur, apart at the start;
* a heap is judged after every step, or every sub-step of an explicit integrator;
* a state in which surfaces cross is found, with its step, names and depth, and sets the exit status;
* jittered starts leave prescribed nodes where they are; every run named can be found;
* the page, the JSON file and stored runs.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts

pytest.importorskip("ipctk")
from benchmarks import crossing_runs, crossings
from benchmarks.crossing_heaps import EXPLICIT, KINDS, folded_strip, make_heap, random_block, turned_at_random
from benchmarks.crossing_runs import DEMOS, GROUPS, HARD, HEAPS, JITTERED, JudgedSimulator, Watch, runs_of
from benchmarks.judge import Judge
from taisoft.records import StepReport


@pytest.fixture(scope="module")
def heaps():
    with pytest.warns(UserWarning):  # of the thin plates
        return [make_heap(k) for k in range(12) if k % 5 != 4]


def content(heap) -> list:
    """All numbers of a heap."""
    bodies = [(b.name, b.position, b.velocity, b.mesh.vertices, b.mesh.tets, b.material) for b in heap.scene.bodies]
    obstacles = [(o.name, o.friction, o.shape.size(), o.shape.pivot) for o in heap.scene.obstacles]
    return [heap.settings, heap.steps, heap.kinds, repr(bodies), repr(obstacles)]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_number_reproduces_a_heap(heaps):
    assert content(make_heap(0)) == content(heaps[0]) and content(make_heap(11)) == content(heaps[-1])
    assert len({repr(content(heap)) for heap in heaps}) == len(heaps)
    assert {kind for heap in heaps for kind in heap.kinds} == set(KINDS)
    assert {heap.settings["precision"] for heap in heaps} == {"f32", "f64"}
    assert len({heap.settings["integrator"] for heap in heaps}) > 1
    for heap in heaps:
        assert 5 <= len(heap.scene.bodies) <= 20 and 60 <= heap.steps <= 240
        assert all(20 <= body.mesh.n_tets <= 150 for body in heap.scene.bodies)
        assert max(np.linalg.norm(body.velocity) for body in heap.scene.bodies) <= 5.0
        x = np.concatenate([body.rest_positions + body.position for body in heap.scene.bodies])
        assert Judge(SimpleNamespace(scene=heap.scene, time=0.0, positions=lambda x=x: x), True).crossings() == 0


def test_random_rotations_keep_the_shape():
    rng = np.random.default_rng(1)
    mesh = random_block(rng)
    moved = turned_at_random(mesh, rng)
    assert np.allclose(moved.volumes, mesh.volumes) and np.allclose(moved.vertices.mean(axis=0), 0.0)


def test_a_heap_is_judged_after_every_step():
    one = crossing_runs.run(HEAPS, "heap 001", "cpu", steps=3)
    assert (one["states"], one["starts_crossing"], one["simulators"]) == (3, 0, 1)
    assert one["status"] == "ok" and len(one["kinds"]) == 6 and one["settings"].endswith("1/240 s, f64")


def two_boxes() -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    for k in range(2):
        mesh = ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0))
        scene.add_body(mesh, ts.Material(young=1e4), name=f"box {k}", position=(0.2 * k, 1.5 * k, 0.1 * k))
    return scene


class Passing(JudgedSimulator):
    """Its second box is moved into the first one after the third step."""

    def positions(self, body=None):
        x = super().positions(body)
        if self.step_count >= 3 and body is None:
            x[-8:] -= (0.0, 0.51, 0.0)
        return x


@pytest.mark.parametrize("integrator", ["implicit_euler", EXPLICIT[0]])
def test_crossing_states_are_found(integrator):
    watch = Watch()
    with Passing(two_boxes(), dt=1e-3, integrator=integrator, watch=watch) as sim:
        result = sim.run(8e-3, fps=250.0)
    assert result.steps == watch.states == 8 and watch.crossing == 6 and watch.starts_crossing == 0
    first = watch.first
    assert (first["step"], first["names"]) == (3, ["box 0 and box 1"]) and watch.names == {"box 0 and box 1": 6}
    assert watch.deepest == pytest.approx(0.01, abs=1e-3) and first["count"] == watch.most > 1


def test_nothing_is_judged_where_nothing_can_touch():
    watch, scene = Watch(), ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), ts.Material(), name="box")
    with JudgedSimulator(scene, dt=1e-3, integrator=EXPLICIT[0], watch=watch) as sim:
        assert sim.advance(5).steps == 5 and watch.states == 0


def test_least_distances_are_measured():
    judge = SimpleNamespace(find=lambda: SimpleNamespace(count=0), least_distance=lambda within: min(within, 5e-4))
    watch = Watch()
    for _ in range(9):
        watch.look(None, judge, StepReport(0.0, converged=False))
    assert watch.least == crossing_runs.NEAR
    watch.look(None, judge, StepReport(0.0, n_inverted=2))
    assert (watch.least, watch.unconverged, watch.inverted) == (5e-4, 9, 2)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_jittered_starts_leave_prescribed_nodes():
    scene = folded_strip()
    with ts.Simulator(scene, self_collision=True) as sim:
        before = sim.positions()
        starts = []
        for number in (0, 0, 1):
            sim.reset()
            crossing_runs.jitter_start(sim, number)
            starts.append(sim.positions() - before)
    moved = np.abs(starts[0]).max(axis=1) > 0.0
    assert 0.9 < moved.mean() < 1.0 and not moved[np.abs(before[:, 0]) > 0.499].any()
    assert np.abs(starts[0]).max() <= 1e-4 and np.array_equal(*starts[:2]) and not np.array_equal(*starts[1:])


def test_all_runs_are_named_and_found():
    names = {group: runs_of(group) for group in GROUPS}
    assert len(names[HEAPS]) == 200 and len(runs_of(HEAPS, 3)) == 3 and len(names[JITTERED]) == 40
    assert all(crossing_runs.find(*name.split(": ", 1)) for name in names[HARD]) and len(names[HARD]) > 60
    for group, quick in crossings.QUICK.items():
        assert set(quick) <= set(names[group])
    assert "cube_on_box" in names[DEMOS]
    asked = crossings.chosen([HEAPS], "heap 01", None, False, "cpu")
    assert [one["name"] for one in asked] == [f"heap 01{k}" for k in range(10)]


ROW = {"group": HEAPS, "status": "ok", "problems": [], "settings": "bdf2, 1/60 s, f32", "kinds": ["plate", "jack"]}
CLEAN = ROW | vars(Watch(states=60)) | {"name": "heap 000", "seconds": 1.0}
FIRST = {"step": 7, "time": 0.1, "count": 4, "depth": 1e-5, "names": ["a and b"], "converged": False, "substeps": 1}
CROSSED = CLEAN | {"name": "heap 001", "crossing": 5, "first": FIRST, "most": 6, "deepest": 2e-4, "problems": ["deep"]}


def test_the_page_and_the_exit_status(monkeypatch, capsys, tmp_path):
    def fill(requests, *_, **__):
        return rows

    monkeypatch.setattr(crossings, "carry_out_all", fill)
    rows = [CLEAN]
    assert crossings.main(["--what", HEAPS]) == 0
    assert "**In all: 60 states judged, 0 cross**, in 0 of 1 runs" in capsys.readouterr().out
    rows = [CLEAN, CROSSED, {"group": HEAPS, "name": "heap 002", "left_out": "the budget was spent", "crashed": False}]
    out = tmp_path / "found.json"
    assert crossings.main(["--what", HEAPS, "--out", str(out)]) == 1
    text = capsys.readouterr().out
    assert (
        "**In all: 120 states judged, 5 cross**, in 1 of 2 runs" in text and "heap 002 was not run: the budget was spent" in text
    )
    assert "heap 001 (bdf2, 1/60 s, f32): step 7, t = 0.1 s, not converged: a and b, 4 in all, 0.01 mm deep" in text
    assert "* heap 001: deep" in text and json.loads(out.read_text())["rows"][1]["first"] == FIRST
    assert out.with_suffix(".md").read_text().startswith("# Crossings")
    rows = [CLEAN, {"group": HEAPS, "name": "heap 002", "left_out": "its process ended", "crashed": True}]
    assert crossings.main(["--what", HEAPS]) == 1
    with pytest.raises(SystemExit):
        crossings.main(["--only", "no such run"])


def test_a_command_runs_children_and_reuses_their_records(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(crossings, "QUICK", {HEAPS: ("heap 001",)})
    monkeypatch.setattr(crossings, "QUICK_STEPS", 2)
    command = ["--what", HEAPS, "--quick", "--keep", str(tmp_path / "kept"), "--out", str(tmp_path / "out.json")]
    assert crossings.main(command) == 0
    (row,) = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert row["states"] == 2 and row["name"] == "heap 001"

    def start(*_):
        raise AssertionError("a stored run was repeated")

    monkeypatch.setattr(crossing_runs.LocalPlace, "start", start)
    assert crossings.main(command) == 0 and json.loads((tmp_path / "out.json").read_text())["rows"] == [row]
