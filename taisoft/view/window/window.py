"""The live window, seen from the simulation: a process that shows it, and the calls that open one.

The window runs in a process of its own, `taisoft.view.window.window_process`, so that it draws and answers the mouse while a step
is computed. The simulation stays in the caller's process, whatever its scene holds, and only states and commands travel
(`taisoft.view.link`). So any arch and precision can be shown, a crash of the window does not end the simulation, and the window
ends with its caller, however that ends.
"""

import time
import warnings

from taisoft.errors import OutputError
from taisoft.frame_steps import dt_sentence, fit_dt
from taisoft.output.folder import Observer
from taisoft.records import RunReport, StepReport
from taisoft.view.choices import IN_WINDOW
from taisoft.view.link import Viewer
from taisoft.view.sampling import Sampler
from taisoft.view.window.controls import touching_pairs
from taisoft.view.window.ggui import display_missing, vulkan_missing
from taisoft.view.window.live import LiveRun

FAILURE = "cannot open a window"
START_SECONDS = 60.0  # in which the window must open
FPS = 60.0  # of the window's pictures, at most
SLOTS = 3  # states that the window need not have taken yet: it shows the last
CHILD = ("-P", "-m", "taisoft.view.window.window_process")


class WindowProcess(Viewer):
    """The caller's side of a window in a child process, which shows a simulation.

    sim: a Simulator; controls: whether the window changes it, or only shows it; colour, layers: those shown initially;
    child: arguments of Python that start the process, if not CHILD.
    timing: once its user has closed it, times of its pictures and latencies of drags, see `taisoft.view.window.timing`. Raises
    OutputError if a display or a Vulkan driver is missing or the window does not open.
    """

    def __init__(
        self,
        sim,
        controls: bool = False,
        colour: str = "body",
        layers: tuple[str, ...] = IN_WINDOW,
        child: tuple[str, ...] | None = None,
    ):
        missing = display_missing() or vulkan_missing()
        if missing:
            raise OutputError(f"{FAILURE}: {missing}")
        self._sampler, self._colour, self._layers = Sampler(sim.scene), colour, set(layers)
        self._sent = self._confirmed = self._answered = 0  # numbers of states, and of the last request
        self._requests: list[tuple[int, list]] = []  # not yet returned
        self._closed, self.timing = False, {}
        description = {"fps": FPS, "colour": colour, "layers": list(layers)}
        description |= {"controls": controls, "pairs": touching_pairs(sim) if controls else []}
        super().__init__(child or CHILD, self._sampler.drawn, description, FAILURE, SLOTS)
        try:
            if self.read(START_SECONDS) is None:
                raise OutputError(f"{FAILURE}: its process does not answer within {START_SECONDS:g} s")
        except BaseException:
            self.close()
            raise
        self.failure = "the window is lost"

    @property
    def closed(self) -> bool:
        """Whether the window is closed or lost."""
        return self._closed or self.error is not None

    @property
    def ready(self) -> bool:
        """Whether the window has taken the last state."""
        return self._confirmed >= self._sent

    @property
    def has_room(self) -> bool:
        """Whether one more state can be sent."""
        return self._sent - self._confirmed < SLOTS

    def receive(self, timeout: float = 0.0) -> list[tuple[int, list]]:
        """Return the requests since the last call, each a number and its commands; wait up to a time [s] for the first message.

        Raises OutputError if the window's process has ended otherwise than by being closed.
        """
        while self._take(timeout):
            timeout = 0.0
        found, self._requests = self._requests, []
        if found:
            self._answered = found[-1][0]
        return found

    def _take(self, timeout: float) -> bool:
        """Read the next message; return whether there was one."""
        if self.closed or (message := self.read(timeout)) is None:
            return False
        if "closed" in message:
            self._closed, self.timing = True, message
            return False
        self._confirmed = message["confirmed"]
        self._colour, self._layers = message["colour"], set(message["layers"])
        if message["commands"]:
            self._requests.append((message["number"], message["commands"]))
        return True

    def publish(self, sim, shown: dict, patience: float = 0.0) -> None:
        """Send sim's present state, unless there is no room for it within a time [s].

        shown: what else the window shows, see `LiveRun.panel_state`.
        Raises OutputError as `receive`, and if a path fails.
        """
        end = time.perf_counter() + patience
        while not self.has_room and not self.closed and (left := end - time.perf_counter()) > 0.0:
            self._take(left)
        if not self.has_room or self.closed:
            return
        self._sent += 1
        state = self.nodes.put(self._sampler.state(sim, self._layers, [self._colour]), self._colour, self._sent % SLOTS)
        if not self.send({"state": state, "number": self._sent, "answered": self._answered} | shown):
            while self._take(0.0):  # it may have been closed by its user
                pass

    def close(self) -> None:
        """Close the window and wait for its process; a second call does nothing."""
        self._closed = True
        super().close()


class LiveWindow(Observer):
    """A window that shows a simulation while a loop of the caller steps it: call it with the simulator for each picture.

    `sim.run(seconds, on_frame=window)` does so for each frame. colour and layers: as for `show`. A window that is closed or lost
    does not end the run; the latter is a warning. Raises OutputError if a display or a Vulkan driver is missing.
    """

    def __init__(self, sim, colour: str = "body", layers: tuple[str, ...] = IN_WINDOW):
        self._window = WindowProcess(sim, colour=colour, layers=layers)

    def __enter__(self) -> "LiveWindow":
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        """Whether the window is closed."""
        return self._window.closed

    def __call__(self, sim, index: int | None = None, _report: StepReport | None = None) -> None:
        """Show sim's present state if the window has shown the previous one."""
        try:
            self._window.receive()
            if self._window.ready:
                self._window.publish(sim, {"status": f"frame {sim.step_count if index is None else index}", "messages": []})
        except OutputError as error:
            warnings.warn(f"{error}; the run continues without it", UserWarning, stacklevel=2)

    frame = __call__  # as an observer of a run

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        self._window.close()


def show(
    sim,
    fps: float | None = 60.0,
    paused: bool = False,
    colour: str = "body",
    layers: tuple[str, ...] = IN_WINDOW,
    speed: float = 1.0,
    budget: bool = True,
) -> None:
    """Run a simulation in a window until it is closed, following the clock.

    sim: an open Simulator; if made with draggable=True, its bodies can be dragged with the mouse. fps: dt is lowered to a
    divisor of 1/fps as by `run`; None keeps dt. speed: simulated over wall time, `math.inf` for as fast as possible. budget:
    end implicit steps before they are solved where they would fall behind the clock, or delay a drag (`Simulator.budget`); a
    simulator's own budget counts instead. If no step ends so, and without a drag, the states are those of `run`, bit by bit. A
    failed step pauses the run and the reason is shown; R restarts. colour, layers: initial ones. Raises OutputError, before
    anything is opened, if a display or a Vulkan driver is missing, and if the window's process is lost.
    """
    if fps is not None and not fps > 0:
        raise OutputError(f"the window's fps is {fps}; it must be positive")
    if not speed > 0:
        raise OutputError(f"the window's speed is {speed}; it must be positive")
    report = RunReport()
    window = WindowProcess(sim, controls=True, colour=colour, layers=layers)
    try:
        fit_dt(sim, fps, report)
        LiveRun(sim, window, paused, speed, dt_sentence(report), budget).run()
    finally:
        window.close()
        if sim.dragged is not None:
            sim.release()
