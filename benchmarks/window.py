"""Live window: speed over real time, pictures per second, and latency of drags, for demos with contacts.

taisoft bench window [--quick] [--only NAME,...] [--out [FILE.json]]

Every demo with contacts and up to 5,000 tets runs in a window on a virtual display (Xvfb), drawn by the Vulkan driver of this
machine, which may be one in software. First a run without a window, which also compiles, is timed; then the same time is run in
the window by the clock, and a body is dragged to and fro by the mouse (xdotool); then both once more, with a budget of wall time
for its implicit steps. Speeds are simulated over wall time: the window's is 1 at most. The latency is the wall time from the last
look at the mouse that did not see a movement to a picture of a state whose step has used it. Run nothing else meanwhile.
Last, the run without a window is repeated with all launches timed, for a table of what its steps spend, see `kinds.py`.
Exit status: 0, or 1 if fewer than 20 pictures per second are shown, or the latency is above 100 ms where the simulation keeps up
with the clock, without a budget.
"""

import itertools
import subprocess
import sys
import time
from statistics import median

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_scene, shipped_files
from taisoft.errors import MissingPackage
from taisoft.output.viewpoint import Viewpoint
from taisoft.view.sampling import Sampler
from taisoft.view.window.live import LiveRun
from taisoft.view.window.picking import pick
from taisoft.view.window.screen import MESSAGES, PANEL, SIZE, free_part
from taisoft.view.window.window import WindowProcess

from .children import in_child
from .document import Limit, begin, table
from .kinds import JOINED, watching
from .runner import make_parser, parse_options, progress, without_warnings
from .virtual_display import VirtualDisplay

MAX_TETS = 5000
QUICK = ("cube_on_box",)
PICTURES, LATENCY = 20.0, 0.1  # required pictures per second; latency [s]
KEEPS_UP = 0.95  # speed from which on a simulation keeps up with the clock
LONGEST = 60.0  # wall time of the run in the window [s]
DRAGS, PAUSE, PIXELS = 250, 0.02, 4  # movements of the mouse, time between two [s], size
SEARCH = ("search", "--sync", "--name", "taisoft")
AWAIT = 1.0  # for keys and the last pictures [s]
SIDES = np.linspace(0.2, 0.8, 37)  # of the window, where a body is looked for


# --- a demo in a window ---------------------------------------------------------------------------------------------------


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


def measure_demo(name: str) -> dict:
    """The results of a demo on the display of the environment, in a process of its own.

    tets; dt [s]; alone, the speed of a run without a window; without a budget of wall time for its steps and, under "budget",
    with one: see `in_window`. "kinds" holds what a step without a window spends, see `kinds.py`; alone_step, the mean step of
    the run without a window [s], checks their sum.
    """
    scene, settings = load_scene(name)
    seconds, fps = settings.pop("seconds", 1.0), settings.pop("fps", 60.0)
    with without_warnings(), ts.Simulator(scene, draggable=True, **settings) as sim:
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
        sim.reset()
        with watching() as spend:
            spent = spend(lambda: sim.run(seconds, fps=fps), report.steps)
        return found | {"kinds": {"seconds": spent.joined(), "launches": spent.launches}}


def in_window(sim: ts.Simulator, seconds: float, budget: bool) -> dict:
    """The results in a window. budget: whether its steps have one.

    speed, over the clock's; step and longest_step, median and largest wall time of its steps [s]; intervals, times between its
    pictures [s]; latencies of the drag [s]; ended, the fraction of steps that ended on budget; residual, the largest of these.
    """
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


def measure(name: str, display: VirtualDisplay) -> dict:
    """Results of a demo. Raises SimulationError if its process fails."""
    return {"demo": name} | in_child(name, measure_demo, name, environment=display.environment)


# --- the page -------------------------------------------------------------------------------------------------------------


def demos() -> list[str]:
    """Names of the demos with contacts and at most MAX_TETS tets, but for those whose extra is not installed."""
    found = []
    with without_warnings():
        for name in shipped_files("demos"):
            try:
                scene, solver = load_scene(name)
            except MissingPackage:
                continue
            tets = sum(len(body.mesh.tets) for body in scene.bodies)
            if tets <= MAX_TETS and scene.pushes(bool(solver.get("self_collision"))):
                found.append(name)
    return found


def pictures_per_second(row: dict) -> float:
    """Pictures per second in the window while it runs by the clock, from the median time between two."""
    return 1.0 / median(row["intervals"])


def latency(row: dict, quantile: float) -> float:
    """A quantile of the latencies of a drag [s]; nan without any."""
    return float(np.quantile(row["latencies"], quantile)) if row["latencies"] else float("nan")


def window_table(rows: list[dict]) -> str:
    """A row per demo."""
    columns = (
        ("<demo", "{[demo]}"),
        ("tets", "{[tets]:,}"),
        ("dt [ms]", lambda row: f"{1e3 * row['dt']:.3g}"),
        ("step [ms]", lambda row: f"{1e3 * row['step']:.3g}"),
        ("longest", lambda row: f"{1e3 * row['longest_step']:.3g}"),
        ("speed without window", lambda row: f"{row['alone']:.2f}"),
        ("in it", lambda row: f"{row['speed']:.2f}"),
        ("pictures/s", lambda row: f"{pictures_per_second(row):.0f}"),
        ("longest [ms]", lambda row: f"{1e3 * max(row['intervals']):.0f}"),
        ("drag after [ms]", lambda row: f"{1e3 * latency(row, 0.5):.0f}"),
        ("95 %", lambda row: f"{1e3 * latency(row, 0.95):.0f}"),
    )
    with_budget = (
        ("speed with budget", lambda row: f"{row['budget']['speed']:.2f}"),
        ("longest step with budget over the median", lambda row: f"{row['budget']['longest_step'] / row['budget']['step']:.1f}"),
        ("steps ended on budget [%]", lambda row: f"{100 * row['budget']['ended']:.0f}"),
        ("largest residual", lambda row: f"{row['budget']['residual']:.1g}"),
        ("95 % of drags with budget [ms]", lambda row: f"{1e3 * latency(row['budget'], 0.95):.0f}"),
    )
    return table(rows, columns + with_budget if all("budget" in row for row in rows) else columns)  # older results have none


def kinds_table(rows: list[dict]) -> str:
    """A row per demo: percent of a mean step by kind."""

    def percent_of(kind: str):
        return lambda row: f"{100 * row['kinds']['seconds'][kind] / sum(row['kinds']['seconds'].values()):.0f}"

    columns = (
        ("<demo", "{[demo]}"),
        ("step without window [ms]", lambda row: f"{1e3 * row['alone_step']:.3g}"),
        ("sum of kinds", lambda row: f"{1e3 * sum(row['kinds']['seconds'].values()):.3g}"),
        *((f"{kind} [%]", percent_of(kind)) for kind in JOINED),
        ("launches", lambda row: f"{sum(row['kinds']['launches'].values()):,.0f}"),
    )
    return table(rows, columns)


def limits_of(rows: list[dict]) -> list[Limit]:
    """Required pictures per second of all demos, and latency of those that keep up with the clock."""
    found = [Limit(f"{row['demo']}: pictures/s", pictures_per_second(row), PICTURES, at_least=True) for row in rows]
    fast = [row for row in rows if row["speed"] >= KEEPS_UP]
    return found + [Limit(f"{row['demo']}: median latency [s]", latency(row, 0.5), LATENCY) for row in fast]


def main(argv=None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written or a tool is missing."""
    parser = make_parser("window", __doc__)
    parser.add_argument("--quick", action="store_true", help="one demo, no limits")
    parser.add_argument("--only", metavar="NAME,...", help="some demos")
    options = parse_options(parser, argv, arch=False)
    display = VirtualDisplay()
    try:
        document, numbers = begin("Live window", "arch cpu", "on a virtual display")
        rows = []
        for name in options.only.split(",") if options.only else QUICK if options.quick else demos():
            progress(name)
            rows.append(measure(name, display))
    finally:
        display.close()
    document.add(window_table(rows))
    document.add("## What a mean step without a window spends\n\n" + kinds_table(rows))
    return document.finish(options, numbers | {"rows": rows}, [] if options.quick else limits_of(rows))


if __name__ == "__main__":
    sys.exit(main())
