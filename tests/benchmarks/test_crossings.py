"""The benchmark of crossings:

* a number reproduces a heap exactly, another number gives another one; all kinds of bodies occur, apart at the start;
* a number reproduces a shot; shots of all kinds start apart, and their tests of sides tell what has got through;
* a state in which surfaces cross is found, with its step, names and depth; nothing is judged where nothing can touch;
* the page, the exit status, of shots that tunnel too, and stored runs, older ones without sums.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts

pytest.importorskip("ipctk")
from benchmarks import crossing_runs, crossing_shots, crossings
from benchmarks.crossing_heaps import KINDS, make_heap
from benchmarks.crossing_runs import HEAPS, JudgedSimulator, Watch
from benchmarks.judge import Judge
from tests.benchmarks.stand_ins import answer_here


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


def standing(shot, ahead: float = 0.0, time: float = 0.0) -> SimpleNamespace:
    """A simulator of a shot whose flying body has moved ahead [m], or whose strip is mirrored."""
    places = {body.name: body.rest_positions + body.position for body in shot.scene.bodies}
    if ahead and "shot" in places:
        places["shot"] = places["shot"] + (ahead, 0.0, 0.0)
    elif ahead and "strip" in places:
        places["strip"] = places["strip"] * (1.0, -1.0, 1.0)
    every = np.concatenate(list(places.values()))
    return SimpleNamespace(scene=shot.scene, time=time, positions=lambda name=None: every if name is None else places[name])


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_shots_of_each_kind():
    assert crossing_shots.names(3)[3:5] == ["cube through wall 00", "cube through wall 01"] and len(crossing_shots.names()) == 200
    for name in crossing_shots.names(3):
        shot, again = crossing_shots.make_shot(name), crossing_shots.make_shot(name)
        sim = standing(shot)
        assert shot.settings == again.settings and (sim.positions() == standing(again).positions()).all()
        judge = Judge(sim, True)
        assert judge.crossings() == judge.inside() == 0 and not shot.passed(sim)
        if name not in ("sheets edge on 01", "corner over ridge 00", "corner over ridge 01", "corner over ridge 02"):
            assert shot.passed(standing(shot, 0.2, time=1.0)), name
    assert shot.velocities.shape == sim.positions().shape
    assert crossing_shots.make_shot("sheets edge on 01").passed(standing(crossing_shots.make_shot("sheets edge on 01"), 0.9))


def test_sides():
    """A point beside a wall is not behind it. Lines swing around each other, and rings are linked once or not."""
    wall = np.array(
        [[(0.0, -1.0, -1.0), (0.0, -1.0, 1.0), (0.0, 1.0, -1.0)], [(0.0, 1.0, 1.0), (0.0, 1.0, -1.0), (0.0, -1.0, 1.0)]]
    )
    for point, through in (((-0.1, 0.2, 0.1), False), ((0.1, 0.2, 0.1), True), ((0.1, 0.2, 1.1), False)):
        assert crossing_shots.behind(np.array([point]), wall, 1.0) == through
    held = np.array([(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
    for x, found in (
        ([(-0.1, 0.0, -1.0), (-0.1, 0.1, 1.0)], False),
        ([(0.1, 0.0, -1.0), (0.1, 0.1, 1.0)], True),
        ([(0.1, 0.0, -0.1), (0.1, 0.1, 1.0), (-0.1, 0.1, 1.0), (-0.1, 0.0, -1.0), (0.1, 0.0, -1.0), (0.1, 0.1, 0.1)], False),
    ):
        assert crossing_shots.got_behind(held, np.array(x)) == found
    angle = np.linspace(0.0, 2.0 * np.pi, 13) + 0.1
    ring = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(angle)], axis=1)
    for ahead, links in ((0.5, 1), (1.5, 1), (2.5, 0)):
        assert abs(crossing_shots.overlaps(ring, ring[:, [0, 2, 1]] + (ahead, 0.03, 0.01))[0]) == links


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
    assert watch.substeps == 8 and watch.newton_iterations == watch.linear_iterations == 0 and watch.tunnelled is None
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
    answer_here(monkeypatch, crossing_runs.answer)
    command = ["--what", HEAPS, "--quick", "--keep", str(tmp_path / "kept"), "--out", str(tmp_path / "out.json")]
    assert crossings.main(command) == 1
    text, rows = capsys.readouterr().out, json.loads((tmp_path / "out.json").read_text())["rows"]
    assert "**In all: 60 states judged, 5 cross**, in 1 of 1 runs" in text and "* heap 001: deep" in text
    assert "heap 001 (bdf2, 1/60 s, f32): step 7, t = 0.1 s, not converged: a and b, 4 in all, 0.01 mm deep" in text
    monkeypatch.setattr(crossing_runs, "run", lambda *_: pytest.fail("a stored run was repeated"))
    assert crossings.main(command) == 1 and json.loads((tmp_path / "out.json").read_text())["rows"] == rows


def test_a_shot_that_tunnels(monkeypatch):
    """Its first step is stored, and sets the exit status; results without the numbers can still be shown."""
    made = crossing_shots.make_shot("cube through wall 01")
    explicit = {"dt": 1e-4, "integrator": "symplectic_euler"}
    shot = crossing_shots.Shot(made.scene, explicit, lambda sim: sim.step_count >= 2)
    monkeypatch.setattr(crossing_shots, "make_shot", lambda _: shot)
    row = crossing_runs.run("shots", "cube through wall 01", "cpu")
    assert row["tunnelled"] == 2 and row["states"] == row["substeps"] == 4 and row["crossing"] == 0 and crossings.failed([row])
    text = crossings.group_text("shots", [row])
    assert "cube through wall 01 (symplectic_euler, 0.0001 s, f32) has tunnelled in step 2." in text and "**1 tunnelled**" in text
    older = {key: value for key, value in row.items() if key not in ("tunnelled", *crossings.TOTALS.values())}
    assert "tunnelled in step" not in crossings.group_text("shots", [older]) and not crossings.failed([older])
