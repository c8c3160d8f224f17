"""The live window: its process, of which small programs are stand-ins, how it is lost and ends, and one on a virtual display."""

import time

import numpy as np
import pytest

from taisoft.errors import OutputError
from taisoft.view.drawn import DrawnScene
from taisoft.view.link import Viewer
from taisoft.view.window.window import LiveWindow, WindowProcess, show
from tests.view.desktop import ROOT, TOOLS, Desktop
from tests.view.drawing import body_mask, needs_vulkan, program
from tests.view.fake_simulator import FakeSimulator, beam_scene

START = """
import sys, time
from taisoft.processes import Link
from taisoft.view.link import SharedNodes
link = Link.to_caller()
description = link.receive(None)
nodes = SharedNodes(description["n_nodes"], description["slots"], int(sys.argv[1]))
request = {"number": 0, "commands": [], "confirmed": 0, "colour": "body", "layers": []}
"""
OPEN = START + "link.send({'open': True})\n"
SHOWN = {"status": "", "messages": []}


@pytest.fixture
def simulator(monkeypatch):
    """A simulator to show; nothing that windows need is missing."""
    for name in ("display_missing", "vulkan_missing"):
        monkeypatch.setattr(f"taisoft.view.window.window.{name}", lambda: "")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return FakeSimulator(beam_scene())


def test_states_go_out_while_there_is_room(simulator, tmp_path):
    """The program confirms the first ones late, with requests; then it saves the fourth, in the first one's place, and closes."""
    code = f"""{OPEN}
import numpy as np
link.receive(None)
first = nodes.displacement[1].copy()
time.sleep(0.3)
for number in (4, 5):
    wishes = {{"colour": "speed", "layers": ["contacts"], "commands": [["pause"], ["step"]]}}
    link.send(request | wishes | {{"confirmed": 3 * (number - 4), "number": number}})
state = [link.receive(None) for _ in range(3)][-1]
path = {str(tmp_path / "saved.npz")!r}
np.savez(path, first=first, x=nodes.displacement[1], values=nodes.values[1], answered=state["answered"],
         contacts=state["state"]["contacts"]["point"], time=state["state"]["time"])
link.send({{"closed": True}})
"""
    sim, got, end = simulator, [], time.monotonic() + 30
    window, start = WindowProcess(sim, child=program(code)), sim.positions()
    window.publish(sim, SHOWN)
    for sim.time in np.linspace(0.0, 1.0, 100):
        window.publish(sim, SHOWN)
    assert not window.has_room, "a slow window is not waited for"
    for sim.time, condition in ((2.0, lambda: window.ready), (2.0, lambda: window.closed)):
        while not condition():
            assert time.monotonic() < end
            got += window.receive(0.05)
        window.publish(sim, SHOWN)
    window.close()
    window.close()
    assert got == [(number, [["pause"], ["step"]]) for number in (4, 5)]
    with np.load(tmp_path / "saved.npz", allow_pickle=False) as saved:
        assert not saved["first"].any() and np.allclose(start + saved["x"], sim.positions(), atol=1e-6)
        assert np.allclose(saved["values"], np.linalg.norm(sim.velocities(), axis=1))
        assert np.array_equal(saved["contacts"], sim.contacts().point)
        assert saved["time"] == 2.0 and saved["answered"] == 5


def test_a_window_that_does_not_open_is_an_error(simulator):
    refusing = START + "link.send({'error': 'cannot open a window: no reason'})"
    killed = "import os; os.kill(os.getpid(), 9)"
    for code, reason in ((refusing, "no reason"), (killed, "its process ended by signal SIGKILL")):
        with pytest.raises(OutputError, match=f"^cannot open a window: {reason}$"):
            WindowProcess(simulator, child=program(code))


def test_a_lost_window_is_an_error_but_a_run_goes_on(simulator, monkeypatch):
    sim, lose = simulator, OPEN + "link.receive(None); import os; os.kill(os.getpid(), 11)"
    monkeypatch.setattr("taisoft.view.window.window.CHILD", program(lose))
    sim.advance, sim.warm_up = lambda n: sim.step(), lambda: None
    with pytest.raises(OutputError, match="^the window is lost: its process ended by signal SIGSEGV$"):
        show(sim, fps=None)
    monkeypatch.setattr("taisoft.view.window.window.CHILD", program(OPEN + "link.receive(None); sys.exit(3)"))
    window, index = LiveWindow(sim), 0
    with pytest.warns(UserWarning, match="is lost: its process ended with exit status 3; the run continues without it"):
        while not window.closed and index < 1000:
            window.frame(sim, index)
            index += 1
            time.sleep(0.01)
    window.frame(sim, index)
    assert window.closed
    window.close()


def test_a_window_ends_with_the_process_of_the_simulation():
    """Whose end of the link is closed then."""
    code = """
from types import SimpleNamespace
from taisoft.view.link import serve
serve(lambda link, *_: SimpleNamespace(run=lambda: link.receive(None)))
"""
    viewer = Viewer(program(code), DrawnScene.of(beam_scene()), {}, "no window")
    assert viewer.read(30.0) == {"open": True}
    viewer.link.close()
    assert viewer.how_it_ended() == "its process ended with exit status 0"


WATCH = """
import os, sys
sys.path[:0] = [{root!r}]
os.chdir({folder!r})
from tests.view.fake_simulator import beam_scene
import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.view.window.window import show


class PrintingSimulator(ts.Simulator):
    def advance(self, n):
        report = super().advance(n)
        print("step", self.step_count, self.positions()[-14, 1], self.scene.bodies[0].young, compile_clock(), flush=True)
        return report


scene = beam_scene()
scene.gravity = (0.0, -0.2, 0.0)
with PrintingSimulator(scene, dt=8e-3, integrator="symplectic_euler", draggable=True) as sim:
    show(sim, fps=None)
print("closed")
"""
YOUNG = (262, 325)  # pixel of a stiffer beam on the slider
RIGHT = 430  # of the panel
TIP = (1120, 390)  # initial pixel of the beam's end


@pytest.fixture
def desktop(tmp_path):
    if TOOLS:
        pytest.skip(f"a virtual display needs {', '.join(TOOLS)} (Debian: xvfb, xdotool, imagemagick)")
    desktop = Desktop(tmp_path, WATCH.format(root=str(ROOT), folder=str(tmp_path)))
    yield desktop
    desktop.close()


@needs_vulkan
def test_a_window_on_a_display(desktop):
    """Keys and mouse arrive, and what is drawn is seen; sliders change the run without compiling."""

    def numbers():
        """Steps, y of the beam's end, Young's modulus, seconds of compiling."""
        return [float(word) for word in desktop.last("step")[1:]] or [0.0] * 4

    def is_paused():
        before = numbers()
        time.sleep(0.3)
        return numbers() == before

    def click():
        """For long enough to be noticed between slow pictures."""
        desktop.xdotool("mousemove", *YOUNG, "mousedown", 1, "sleep", 0.3, "mouseup", 1, "sleep", 0.2)

    desktop.wait_for(lambda: numbers()[0] >= 2, "running simulation")
    desktop.xdotool("search", "--sync", "--name", "taisoft", "windowmove", 0, 0, "windowfocus", "--sync", "sleep", 0.5)
    compiled = numbers()[-1]
    desktop.wait_for(lambda: desktop.log.read_text().count("step 1 ") > 1, "restart", lambda: desktop.xdotool("key", "r"))
    desktop.xdotool("key", "h", "sleep", 0.5)  # the camera has moved back from the bent beam
    drag = ("mouseup", 1, "sleep", 0.3, "mousemove", *TIP, "sleep", 0.2, "mousedown", 1, "sleep", 0.5)
    drag += ("mousemove_relative", "--", 0, -120, "sleep", 0.2, "mousemove_relative", "--", 0, -130, "sleep", 0.3)
    desktop.wait_for(lambda: numbers()[1] > 0.3, "dragged beam", lambda: desktop.xdotool(*drag))
    desktop.xdotool("mouseup", 1)
    desktop.wait_for(lambda: numbers()[1] < 0.2, "beam that springs back")
    desktop.wait_for(lambda: numbers()[2] > 1.5e5, "stiffer beam", click)
    assert numbers()[-1] == compiled, "nothing is compiled"
    desktop.wait_for(is_paused, "pause", lambda: desktop.xdotool("key", "space"))
    screen = desktop.picture()
    assert body_mask(screen[:, RIGHT:]).mean() > 0.05, "the beam is visible"
    assert (screen[60:160, 30:300] > 200).any(), "the panel's text is visible"
    for width, height in ((1, 1), (1000, 700)):
        desktop.xdotool("search", "--name", "taisoft", "windowsize", width, height, "sleep", 0.3)
    before = numbers()[0]
    step = "single step in a window of another size"
    desktop.wait_for(lambda: numbers()[0] > before, step, lambda: desktop.xdotool("key", "s"))
    assert is_paused()
    desktop.wait_for(lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() > 0.03, "beam in it")
    desktop.xdotool("mousemove", 640, 650, "mousedown", 1, "key", "Escape")  # closed while a button is pressed
    assert desktop.child.wait(timeout=30) == 0 and desktop.last("closed")
