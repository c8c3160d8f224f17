"""One demo in a live window: `python window_child.py NAME` prints its times; the display is that of the environment.

The result holds: tets; dt [s]; alone, the speed of a run without a window; without a budget of wall time for its steps and, under
"budget", with one: speed, that of the same time in the window; step and longest_step, median and largest wall time of its steps
[s]; intervals, times between its pictures [s]; latencies of the drag [s]; ended, the fraction of steps that ended on budget;
residual, the largest of these. "kinds" holds what a step without a window spends, see `window_kinds.spend`; alone_step, the mean
step of the run without a window [s], checks their sum.
"""

import itertools
import json
import subprocess
import sys
import time
import warnings
from statistics import median

import numpy as np

import taisoft as ts
from benchmarks.window_kinds import spend
from taisoft.cli.scene_file import load_scene
from taisoft.output.viewpoint import Viewpoint
from taisoft.view.sampling import Sampler
from taisoft.view.window.live import LiveRun
from taisoft.view.window.picking import pick
from taisoft.view.window.screen import MESSAGES, PANEL, SIZE, free_part
from taisoft.view.window.window import WindowProcess

LONGEST = 60.0  # wall time of the run in the window [s]
DRAGS, PAUSE, PIXELS = 250, 0.02, 4  # movements of the mouse, time between two [s], size
SEARCH = ("search", "--sync", "--name", "taisoft")
AWAIT = 1.0  # for keys and the last pictures [s]
SIDES = np.linspace(0.2, 0.8, 37)  # of the window, where a body is looked for


class RecordedRun(LiveRun):
    """A run that also keeps the wall times of its steps [s], and the residuals of those that ended on budget, else 0."""

    def __init__(self, sim, window, budget: bool):
        super().__init__(sim, window, budget=budget)
        self.steps: list[float] = []
        self.residuals: list[float] = []

    def _after_step(self, report, seconds) -> None:
        super()._after_step(report, seconds)
        self.steps += [seconds / report.steps] * report.steps
        self.residuals += [report.on_budget * report.residual] * report.steps


def run_for(run: LiveRun, seconds: float) -> None:
    """Follow the clock for a wall time [s]."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        run.turn()


def press(key: str, run: LiveRun) -> None:
    """Press a key and go on until its effect is shown."""
    subprocess.run(["xdotool", "key", key], check=True)
    run_for(run, AWAIT)


def grip(sim: ts.Simulator) -> tuple[int, int]:
    """Return a pixel in the middle of what is visible of a body in the view after framing, beside the panels."""
    camera = Viewpoint.framing(sim.positions(), SIZE, free_part(PANEL, SIZE))
    state = Sampler(sim.scene).state(sim, energies=False)
    hits: dict[int, list[tuple[float, float]]] = {}  # cursors by body
    for x, y in itertools.product(SIDES, SIDES):
        if x > PANEL[0] + PANEL[2] and y > 1.0 - MESSAGES[1] and (hit := pick(state, camera, (x, y), SIZE)) is not None:
            hits.setdefault(hit.body, []).append((x, y))
    if not hits:
        raise ts.SimulationError("no body is visible beside the panels")
    own = np.array(max(hits.values(), key=len))
    x, y = own[np.argmin(np.linalg.norm(own - own.mean(axis=0), axis=1))]
    return round(x * SIZE[0]), round((1.0 - y) * SIZE[1])


def mouse(at: tuple[int, int]) -> subprocess.Popen:
    """Drag a body of a simulation that pauses to and fro from a pixel, and let it run."""
    words: list = ["mousemove", *at, "sleep", 0.3, "mousedown", 1, "sleep", 0.3, "key", "space"]
    for k in range(DRAGS):
        way = PIXELS if k // 10 % 2 == 0 else -PIXELS
        words += ["mousemove_relative", "--", way, -way, "sleep", PAUSE]
    return subprocess.Popen(["xdotool", *map(str, words), "mouseup", "1"])


def measure(name: str) -> dict:
    """Return the results of a demo."""
    scene, settings = load_scene(name)
    seconds, fps = settings.pop("seconds", 1.0), settings.pop("fps", 60.0)
    with ts.Simulator(scene, draggable=True, **settings) as sim:
        sim.run(seconds, fps=fps)  # compiles
        sim.drag(scene.bodies[0].name, [0], [1.0], sim.positions()[0], 1.0)
        sim.step()
        sim.release()
        sim.reset()
        report = sim.run(seconds, fps=fps)
        found = {
            "tets": sum(len(body.mesh.tets) for body in sim.scene.bodies),
            "dt": sim.dt,
            "alone": report.sim_seconds / report.wall_seconds,
            "alone_step": report.wall_seconds / report.steps,
        }
        found |= in_window(sim, seconds, budget=False) | {"budget": in_window(sim, seconds, budget=True)}
        sim.budget = settings.get("budget")  # not that of the window
        return found | {"kinds": spend(sim, seconds, fps)}


def in_window(sim: ts.Simulator, seconds: float, budget: bool) -> dict:
    """Return the results in a window. budget: of its steps."""
    sim.reset()
    window = WindowProcess(sim, controls=True)
    try:
        subprocess.run(["xdotool", *SEARCH, "windowmove", "0", "0", "windowfocus"], check=True, stdout=subprocess.DEVNULL)
        run = RecordedRun(sim, window, budget)
        run.turn()
        begin = time.perf_counter()
        while sim.time < seconds and time.perf_counter() < begin + LONGEST:
            run.turn()
        speed, steps, end = sim.time / (time.perf_counter() - begin), run.steps[1:], time.perf_counter()
        residuals = np.array(run.residuals[1:])
        for key in ("space", "h"):  # bodies that move would be framed otherwise when they are gripped
            press(key, run)
        moving = mouse(grip(sim))
        while moving.poll() is None:
            run.turn()
        press("Escape", run)
    finally:
        window.close()
        sim.release()
    pictures = [t for t in window.timing["pictures"] if begin <= t <= end]
    return {
        "speed": speed,
        "step": median(steps),
        "longest_step": max(steps),
        "intervals": np.diff(pictures).tolist(),
        "latencies": window.timing["latencies"],
        "ended": float((residuals > 0.0).mean()),
        "residual": float(residuals.max()),
    }


if __name__ == "__main__":
    warnings.simplefilter("ignore", UserWarning)
    print("result: " + json.dumps(measure(sys.argv[1])), flush=True)
