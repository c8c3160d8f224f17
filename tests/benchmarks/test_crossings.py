"""The benchmark of crossings:

* a number reproduces a heap exactly, another number gives another one; all kinds of bodies occur, apart at the start;
* a state in which surfaces cross is found, with its step, names and depth; nothing is judged where nothing can touch;
* the page, the exit status and stored runs.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts

pytest.importorskip("ipctk")
from benchmarks import crossing_runs, crossings
from benchmarks.crossing_heaps import KINDS, make_heap
from benchmarks.crossing_runs import HEAPS, JudgedSimulator, Watch
from benchmarks.judge import Judge
from tests.benchmarks.stand_ins import answered


def content(heap) -> list:
    """All numbers of a heap."""
    bodies = [(b.name, b.position, b.velocity, b.mesh.vertices, b.mesh.tets, b.material) for b in heap.scene.bodies]
    obstacles = [(o.name, o.friction, o.shape.size(), o.shape.pivot) for o in heap.scene.obstacles]
    return [heap.settings, heap.steps, heap.kinds, repr(bodies), repr(obstacles)]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_number_reproduces_a_heap():
    heaps = [make_heap(k) for k in (1, 2, 3)]
    assert content(make_heap(1)) == content(heaps[0]) and len({repr(content(heap)) for heap in heaps}) == 3
    assert {kind for heap in heaps for kind in heap.kinds} == set(KINDS)
    assert {heap.settings["precision"] for heap in heaps} == {"f32", "f64"}
    for heap in heaps:
        assert 5 <= len(heap.scene.bodies) <= 20 and 60 <= heap.steps <= 240
        assert all(20 <= body.mesh.n_tets <= 150 and np.linalg.norm(body.velocity) <= 5.0 for body in heap.scene.bodies)
        x = np.concatenate([body.rest_positions + body.position for body in heap.scene.bodies])
        assert Judge(SimpleNamespace(scene=heap.scene, time=0.0, positions=lambda x=x: x), True).crossings() == 0


class Passing(JudgedSimulator):
    """Its second box is moved into the first one after the third step."""

    def positions(self, body=None):
        x = super().positions(body)
        if self.step_count >= 3 and body is None:
            x[-8:] -= (0.0, 0.51, 0.0)
        return x


def boxes(n: int) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    for k in range(n):
        mesh = ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0))
        scene.add_body(mesh, ts.Material(young=1e4), name=f"box {k}", position=(0.2 * k, 1.5 * k, 0.1 * k))
    return scene


def test_crossing_states_are_found():
    watch = Watch()
    with Passing(boxes(2), dt=1e-3, integrator="symplectic_euler", watch=watch) as sim:
        result = sim.run(8e-3, fps=250.0)
    assert result.steps == watch.states == 8 and watch.crossing == 6 and watch.starts_crossing == 0
    first = watch.first
    assert (first["step"], first["names"]) == (3, ["box 0 and box 1"]) and watch.names == {"box 0 and box 1": 6}
    assert watch.deepest == pytest.approx(0.01, abs=1e-3) and first["count"] == watch.most > 1
    alone = Watch()
    with JudgedSimulator(boxes(1), dt=1e-3, integrator="symplectic_euler", watch=alone) as sim:
        assert sim.advance(5).steps == 5 and alone.states == 0  # nothing can touch


def test_stored_runs_are_reused(monkeypatch, tmp_path, capsys):
    """The exit status tells of a state that crosses."""

    def run(group, name, arch, steps):
        first = {"step": 7, "time": 0.1, "count": 4, "depth": 1e-5, "names": ["a and b"], "converged": False, "substeps": 1}
        crossed = vars(Watch(states=60, crossing=5, first=first, most=6, deepest=2e-4))
        more = {"problems": ["deep"], "settings": "bdf2, 1/60 s, f32", "kinds": ["plate", "jack"], "seconds": 1.0}
        return {"group": group, "name": name, "status": "ok"} | crossed | more

    monkeypatch.setattr(crossings, "QUICK", {HEAPS: ("heap 001",)})
    monkeypatch.setattr(crossing_runs, "run", run)
    monkeypatch.setattr(crossing_runs, "carry_out", answered(crossing_runs))
    command = ["--what", HEAPS, "--quick", "--keep", str(tmp_path / "kept"), "--out", str(tmp_path / "out.json")]
    assert crossings.main(command) == 1
    text, rows = capsys.readouterr().out, json.loads((tmp_path / "out.json").read_text())["rows"]
    assert "**In all: 60 states judged, 5 cross**, in 1 of 1 runs" in text and "* heap 001: deep" in text
    assert "heap 001 (bdf2, 1/60 s, f32): step 7, t = 0.1 s, not converged: a and b, 4 in all, 0.01 mm deep" in text
    monkeypatch.setattr(crossing_runs, "run", lambda *_: pytest.fail("a stored run was repeated"))
    assert crossings.main(command) == 1 and json.loads((tmp_path / "out.json").read_text())["rows"] == rows
