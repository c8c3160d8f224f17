"""The cost of output:

* pictures of another mesh compile no kernels, and the window's renderer none at all;
* compilation within an observer counts as compile time, not as output time, which is part of the run's wall time;
* the summary says what pictures cost, and how to save it, if they take most of a run.
"""

from types import SimpleNamespace

import pytest

from taisoft.cli.recording import Observers
from taisoft.cli.summary import print_summary
from taisoft.output.frames import FrameWriter
from taisoft.records import Energies
from taisoft.running import run
from tests.cli.command import BEAM, child, write
from tests.simulator.test_running import StandIn
from tests.view.test_view import PROLOGUE, needs_vulkan, run_child

DRAW = (
    PROLOGUE
    + """
import numpy as np
from taisoft.output.camera import Camera
from taisoft.view.ggui import Canvas
from taisoft.view.scene_view import Surfaces
camera, surfaces = Camera.framing(sim.positions()), Surfaces(scene)
canvas = Canvas(surfaces, (64, 36), visible=False, n_segments=3)
ones = np.ones((2, 3))
canvas.draw(surfaces.of_bodies(sim)[0], surfaces.colours, camera, (1.0, 1.0, 1.0), (sim.positions()[:2], ones))
canvas.draw_over(np.array([[0.1, 0.1, 0.3, 0.2]]), ones[:, :2], ones, (2, 5), (0.9, 0.9, 0.9))
print(canvas.pixels(0, 0, 64, 36).std() > 5)
canvas.close()
"""
)


def kernels(cache) -> set[str]:
    """Names of the compiled kernels in a cache folder."""
    return {path.name for path in cache.glob("taisoft/kernels/*.tic")}


def test_images_of_another_mesh_add_no_kernels_to_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cached = []
    for cells in ("(4, 1, 1)", "(5, 1, 1)", "(9, 3, 2)"):
        scene = write(tmp_path / f"scene{len(cached)}.py", BEAM.replace("(4, 1, 1)", cells))
        process = child("run", scene, "--headless", "--no-usd", "--layers", "wires", "--out", tmp_path / scene.stem)
        _, error = process.communicate(timeout=120)
        assert process.returncode == 0, error
        assert (tmp_path / scene.stem / "frames/00003.png").is_file()
        cached.append(kernels(tmp_path / "cache"))
    assert cached[0] and cached[1] == cached[2] == cached[0]


@needs_vulkan
def test_drawing_compiles_nothing(tmp_path):
    """Surfaces, lines, and boxes and lines in the overlay."""
    out, _ = run_child(DRAW, XDG_CACHE_HOME=str(tmp_path))
    assert out.split()[-1] == "True", "nothing was drawn"
    assert (tmp_path / "taisoft/kernels").is_dir() and kernels(tmp_path) == set()


def test_compilation_in_an_observer_does_not_count_as_output_time(monkeypatch, capsys):
    sim, now, observers = StandIn(explicit=False, dt=0.01), [0.0], Observers()

    def frame(sim, index):
        now[0] += 2.5
        if index == 0:  # as if a kernel were launched for the first time
            now[0] += 10.0
            sim.compile_seconds += 10.0

    observers.members.append(SimpleNamespace(frame=frame, close=lambda: None))
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    result = run(sim, 0.2, observers.on_frame, fps=10)
    assert observers.seconds == pytest.approx(7.5) and result.wall_seconds == pytest.approx(7.5)
    assert result.compile_seconds == pytest.approx(10.0)
    sim.energies = lambda: Energies(0.0, 0.0, 0.0)
    print_summary(result, sim, observers, None)
    assert "7.50 s, 7.50 s of it for output; plus 10.00 s to compile" in capsys.readouterr().out


class SlowWriter(FrameWriter):
    """Spends 2 s of a clock per picture, and writes none."""

    def __init__(self, clock):
        self.clock = clock

    def frame(self, sim, index):
        self.clock[0] += 2.0


@pytest.mark.parametrize("step, said", [(0.1, True), (1.0, False)])
def test_the_summary_says_when_pictures_take_most_of_a_run(step, said, monkeypatch, capsys):
    """Three pictures of 2 s, and 20 steps of 0.1 or 1 s."""
    sim, now, observers = StandIn(explicit=False, dt=0.01), [0.0], Observers()
    observers.members += [SlowWriter(now), SimpleNamespace(frame=lambda sim, index: None, close=lambda: None)]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])

    def on_step(*_):
        now[0] += step

    result = run(sim, 0.2, observers.on_frame, fps=10, on_step=on_step)
    sim.energies = lambda: Energies(0.0, 0.0, 0.0)
    print_summary(result, sim, observers, None)
    line = "6.00 s of it, 75%, for pictures: a lower --fps draws fewer, --no-frames none"
    assert (line in capsys.readouterr().out) == said and observers.picture_seconds == pytest.approx(6.0)
