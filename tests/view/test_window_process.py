"""The process of the window, without a display: small programs stand in for it.

* what the window shows decides what is sent; nothing is sent before the last state is confirmed, however slow the window is;
* its errors and its end are reported with their reason, a closed window is no error, and close waits for the process;
* a run goes on without a lost window, which is a warning; the window ends with the simulation's process.
"""

import os
import signal
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
from tests.view.desktop import ROOT
from tests.view.fake_simulator import FakeSimulator, beam_scene

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


def program(code):
    return (sys.executable, "-c", code)


@pytest.fixture(autouse=True)
def display(monkeypatch):
    for name in ("display_missing", "vulkan_missing"):
        monkeypatch.setattr(f"taisoft.view.window.{name}", lambda: "")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.fixture
def simulator():
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
    while _is_alive(child):
        assert time.monotonic() < end
        time.sleep(0.05)


def _is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
    except OSError:
        os.kill(pid, 0)
        return True
