"""The live window:

* its process, of which small programs are stand-ins: what the window shows decides what is sent, nothing before the last state is
  confirmed; its errors and its end are reported with their reason; a run goes on without a lost window, which is a warning; the
  window ends with the simulation's process;
* on a virtual display keys pause, step, restart, colour, frame and quit; dragging beside bodies turns the view, dragging a body
  moves it; plots can be shown, and a drag over them turns the view;
* sliders change the run at once without compiling; a stiffer body lowers dt of explicit steps;
* pictures are written and recorded; the window can be resized, made tiny, and closed in the middle of a drag.
"""

import signal
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

from taisoft.errors import OutputError
from taisoft.scene.plan import Plan
from taisoft.settings import Settings
from taisoft.view.plots import Plots
from taisoft.view.window import LiveWindow, WindowProcess, show
from tests.view.desktop import ROOT, TOOLS, Desktop
from tests.view.drawing import body_mask, is_alive, needs_vulkan, program
from tests.view.fake_simulator import FakeSimulator, beam_scene

# --- the process of the window, without a display ---

START = """
import sys, time
from multiprocessing.connection import Connection
from taisoft.view.link import Link, LinkClosed, SharedNodes, receive
connection = Connection(int(sys.argv[1]))
description = receive(connection, None)
link = Link(connection, SharedNodes(description["n_nodes"], description["slots"], int(sys.argv[2])))
request = {"number": 0, "commands": [], "confirmed": 0, "colour": "body", "layers": [], "plots": False}
"""
OPEN = START + "link.send({'open': True})\n"
SHOWN = {"status": "", "messages": []}


@pytest.fixture
def simulator(monkeypatch):
    """A simulator to show; nothing that windows need is missing."""
    for name in ("display_missing", "vulkan_missing"):
        monkeypatch.setattr(f"taisoft.view.window.{name}", lambda: "")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    sim = FakeSimulator(beam_scene())
    sim.settings, sim.plan = Settings(), Plan()
    sim.plan.add("contact_forces", False, "", "one body")
    return sim


def wait_for(condition, window):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        window.receive(0.05)


def test_states_go_out_when_the_last_one_is_confirmed(simulator, tmp_path):
    """The program confirms the first state late, with wishes; then it saves the second one and closes."""
    code = f"""{OPEN}
import numpy as np
link.receive(None)
first = link.nodes.x[0].copy()
time.sleep(0.5)
link.send(request | {{"confirmed": 1, "colour": "speed", "layers": ["contacts"], "number": 4, "commands": [["pause"]]}})
state = link.receive(None)
np.savez({str(tmp_path / "saved.npz")!r}, first=first, x=link.nodes.x[0], values=link.nodes.values[0], answered=state["answered"],
         contacts=state["contacts"]["point"], time=state["time"])
link.send({{"closed": True}})
"""
    sim, plots = simulator, Plots(simulator)
    found = sim.contacts()
    found.point = found.normal = np.array([[0.0, 1, 2]])
    sim.contacts, sim.velocities = lambda: found, lambda: np.full(sim.positions().shape, 3.0)
    window = WindowProcess(sim, child=program(code))
    start = sim.positions()
    try:
        window.publish(sim, plots, SHOWN)
        sim.time, begin = 1.0, time.perf_counter()
        for _ in range(100):
            window.publish(sim, plots, SHOWN)
        assert time.perf_counter() - begin < 0.4 and not window.ready, "a slow window is not waited for"
        wait_for(lambda: window.ready, window)
    finally:
        sim.time = 2.0
        window.publish(sim, plots, SHOWN)
        wait_for(lambda: window.closed, window)
        window.close()
        window.close()
    with np.load(tmp_path / "saved.npz", allow_pickle=False) as saved:
        assert np.array_equal(saved["first"], start) and np.array_equal(saved["x"], sim.positions())
        assert np.allclose(saved["values"], 3.0 * np.sqrt(3)) and saved["contacts"].tolist() == [[0.0, 1, 2]]
        assert saved["time"] == 2.0


def test_requests_come_once_and_in_order(simulator):
    code = f"""{OPEN}
for k in range(1, 4):
    link.send(request | {{"number": k, "commands": [["pause"], ["step"]]}})
link.send({{"closed": True}})
link.receive(None)
"""
    window, got = WindowProcess(simulator, child=program(code)), []
    try:
        while not window.closed:
            got += window.receive(1.0)
        assert got == [(k, [["pause"], ["step"]]) for k in (1, 2, 3)] and window.receive() == []
    finally:
        window.close()


@pytest.mark.parametrize(
    "code, reason",
    [
        (START + "link.send({'error': 'cannot open a window: no reason'})", "^cannot open a window: no reason$"),
        (START + "sys.exit(7)", "^cannot open a window: its process ended with exit status 7$"),
        ("import os; os.kill(os.getpid(), 9)", "^cannot open a window: its process ended by signal SIGKILL$"),
    ],
)
def test_a_window_that_does_not_open_is_an_error(code, reason, simulator):
    with pytest.raises(OutputError, match=reason):
        WindowProcess(simulator, child=program(code))


def test_a_lost_window_is_an_error(simulator, monkeypatch):
    monkeypatch.setattr("taisoft.view.window.CHILD", program(OPEN + "link.receive(None); import os; os.kill(os.getpid(), 11)"))
    sim = simulator
    sim.draggable, sim.dragged, sim.stable_dt, sim.compile_seconds = False, None, 1.0, 0.0
    sim.advance = lambda n: sim.step()
    with pytest.raises(OutputError, match="^the window is lost: its process ended by signal SIGSEGV$"):
        show(sim, fps=None)


def test_a_run_goes_on_without_a_lost_window(simulator, monkeypatch):
    monkeypatch.setattr("taisoft.view.window.CHILD", program(OPEN + "link.receive(None); sys.exit(3)"))
    window = LiveWindow(simulator, Plots(simulator))
    with pytest.warns(UserWarning, match="is lost: its process ended with exit status 3; the run continues without it"):
        for index in range(100):
            window.frame(simulator, index)
            if window.closed:
                break
            time.sleep(0.05)
    window.frame(simulator, 101)
    assert window.closed
    window.close()


def test_a_window_ends_with_the_process_of_the_simulation(tmp_path):
    """Here the real window's program waits for its first state, so it needs no display; the parent is killed."""
    parent = f"""
import os, sys, time
from taisoft.view.child_process import ChildProcess
child = ChildProcess((sys.executable, "-c", {OPEN + "link.receive(None)"!r}), {{}}, "no window", n_nodes=3)
assert child.link.receive(30.0) == {{"open": True}}
print(child.pid, flush=True)
time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=ROOT)
    child = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    end = time.monotonic() + 20
    while is_alive(child):
        assert time.monotonic() < end
        time.sleep(0.05)


# --- on a virtual display ---

WATCH = """
import os, sys
sys.path[:0] = [{root!r}]
os.chdir({folder!r})
from tests.view.fake_simulator import beam_scene
import numpy as np
import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.view.window import show


class PrintingSimulator(ts.Simulator):
    def advance(self, n):
        report = super().advance(n)
        x, body = self.positions()[-14], self.scene.bodies[0]
        numbers = self.dt, body.material.young, -self.scene.gravity[1], compile_clock()
        print("step", self.step_count, *x.round(4), *numbers, flush=True)
        return report

    def reset(self):
        super().reset()
        print("reset", flush=True)


with PrintingSimulator(beam_scene(), dt={dt}, integrator={integrator!r}, draggable=True) as sim:
    show(sim, fps=None)
    print("ended", np.isfinite(sim.energies().total))
print("closed")
"""
SLIDERS = {"dt": 285, "gravity": 308, "young": 331}  # pixels from the top, with one body
RIGHT = 430  # of the panel
TIP = (965, 350)  # initial pixel of the beam's end


@pytest.fixture
def opened(tmp_path):
    if TOOLS:
        pytest.skip(f"a virtual display needs {', '.join(TOOLS)} (Debian: xvfb, xdotool, imagemagick)")
    made = []

    def start(dt=1 / 60, integrator="implicit_euler"):
        code = WATCH.format(root=str(ROOT), folder=str(tmp_path), dt=dt, integrator=integrator)
        desktop = Desktop(tmp_path, code)
        made.append(desktop)
        desktop.wait_for(lambda: steps(desktop) >= 2, "running simulation")
        desktop.tool("xdotool", "search", "--sync", "--name", "taisoft", "windowmove", "0", "0", "windowfocus")
        return desktop

    yield start
    for desktop in made:
        desktop.close()


def steps(desktop):
    return int((desktop.last("step") or [0, 0])[1])


def press(desktop, key, condition, what):
    desktop.tool("xdotool", "key", key)
    desktop.wait_for(condition, what)


def is_paused(desktop):
    before = steps(desktop)
    desktop.pause(0.4)
    return steps(desktop) == before


def quit_window(desktop):
    desktop.tool("xdotool", "key", "Escape")
    assert desktop.child.wait(timeout=30) == 0
    assert desktop.printed()[-1] == "closed"


@needs_vulkan
def test_keys_and_mouse(opened, tmp_path):
    desktop = opened()
    press(desktop, "space", lambda: is_paused(desktop), "pause")
    for k, key in enumerate(("s", "Right")):
        before = steps(desktop)
        press(desktop, key, lambda at=before: steps(desktop) == at + 1, f"single step {k}")
    screen = desktop.picture()
    mask = body_mask(screen[:, RIGHT:])  # right of the panel
    assert mask.mean() > 0.05, "the beam is visible"
    assert (screen[60:160, 30:300] > 200).any(), "the panel's text is visible"
    desktop.tool("xdotool", "key", "v")
    desktop.wait_for(lambda: np.abs(desktop.picture()[:, RIGHT:].astype(int) - screen[:, RIGHT:]).max() > 60, "change of colours")

    def turn():
        desktop.drag((1000, 650), (-150, 50), 0.3)
        desktop.tool("xdotool", "mouseup", "1")

    desktop.repeat(turn, lambda: np.mean(body_mask(desktop.picture()[:, RIGHT:]) != mask) > 0.02, "turned view")
    assert is_paused(desktop)
    plain = desktop.picture()
    desktop.tool("xdotool", "key", "w")
    desktop.wait_for(
        lambda: np.mean((plain[:, RIGHT:] > desktop.picture()[:, RIGHT:].astype(int) + 40).any(axis=2)) > 0.003, "wires"
    )
    press(desktop, "i", lambda: (tmp_path / "out/window-1.png").is_file(), "picture")
    press(desktop, "p", lambda: len(list(tmp_path.glob("out/window-2/*.png"))) > 1, "recorded pictures")
    desktop.tool("xdotool", "key", "p")
    assert struct.unpack(">II", (tmp_path / "out/window-2/00000.png").read_bytes()[16:24]) == (1280, 720)
    press(desktop, "g", lambda: n_plots(desktop) == 4, "plots")
    view = desktop.picture()[400:, RIGHT:1000]
    desktop.drag((1150, 100), (-100, 50), 0.3)
    desktop.wait_for(lambda: n_plots(desktop) == 0, "view without plots while it is turned over them")
    assert np.mean(body_mask(desktop.picture()[400:, RIGHT:1000]) != body_mask(view)) > 0.01, "the view turned"
    desktop.tool("xdotool", "mouseup", "1")
    desktop.wait_for(lambda: n_plots(desktop) == 4, "plots again")
    press(desktop, "g", lambda: n_plots(desktop) == 0, "no plots")
    near = body_mask(desktop.picture()[:, RIGHT:]).mean()

    def zoom_out():
        desktop.drag((1000, 400), (0, 200), 0.3, button=3)
        desktop.tool("xdotool", "mouseup", "3")

    desktop.repeat(zoom_out, lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() < 0.1 * near, "distant beam")
    press(desktop, "h", lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() > 0.25 * near, "framed beam")
    press(desktop, "r", lambda: desktop.printed().count("reset") == 1, "restart")
    press(desktop, "space", lambda: not is_paused(desktop), "resumed run")
    for width, height in ((800, 600), (1, 1), (1000, 700)):
        desktop.tool("xdotool", "search", "--name", "taisoft", "windowsize", str(width), str(height))
        before = steps(desktop)
        desktop.wait_for(lambda at=before: steps(desktop) > at + 2, f"steps in a window of {width} x {height}")
    desktop.wait_for(lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() > 0.03, "beam in a resized window")
    quit_window(desktop)
    assert desktop.last("ended")[1] == "True"


def n_plots(desktop):
    """Number of plots at the right: dark text windows at least three lines high, beside light boxes."""
    screen = desktop.picture()[:720]
    dark = np.flatnonzero((screen[:, 1030:1038] < 60).all(axis=(1, 2)))
    tall = [run for run in np.split(dark, np.flatnonzero(np.diff(dark) > 1) + 1) if len(run) > 40]
    return sum((screen[run, 1046:1260] > 225).all(axis=2).mean() > 0.5 for run in tall)


def numbers(desktop):
    """x, y, z of the beam's end, dt, Young's modulus, gravity, seconds of compiling."""
    return [float(word) for word in desktop.last("step")[2:]]


def click(desktop, across, down):
    """For long enough to be noticed between slow pictures."""
    desktop.tool("xdotool", "mousemove", str(across), str(down), "mousedown", "1")
    desktop.pause(0.4)
    desktop.tool("xdotool", "mouseup", "1")
    desktop.pause(0.4)


@needs_vulkan
def test_dragging_and_sliders(opened):
    desktop = opened(dt=8e-3, integrator="symplectic_euler")
    compiled = numbers(desktop)[-1]
    press(desktop, "r", lambda: desktop.printed().count("reset") == 1, "restart")
    before = numbers(desktop)
    desktop.repeat(lambda: click(desktop, 30, SLIDERS["gravity"]), lambda: numbers(desktop)[5] < 5.0, "less gravity")

    def drag():
        desktop.tool("xdotool", "mouseup", "1")
        desktop.drag(TIP, (0, -250), 0.5)

    desktop.repeat(drag, lambda: numbers(desktop)[1] > before[1] + 0.3, "dragged beam")
    desktop.tool("xdotool", "mouseup", "1")
    desktop.wait_for(lambda: numbers(desktop)[1] < before[1] + 0.2, "beam that springs back")
    desktop.repeat(lambda: click(desktop, 262, SLIDERS["young"]), lambda: numbers(desktop)[4] > 2e6, "stiffer beam")
    stiff = numbers(desktop)
    assert stiff[3] < 4e-3, "below the explicit limit"
    desktop.repeat(lambda: click(desktop, 60, SLIDERS["dt"]), lambda: numbers(desktop)[3] < 0.5 * stiff[3], "shorter steps")
    assert numbers(desktop)[-1] == compiled, "nothing is compiled"
    desktop.drag((640, 650), (0, -20))  # closed while a button is pressed
    quit_window(desktop)
