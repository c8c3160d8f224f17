"""The process of the live window: `python -m taisoft.view.window.window_process MEMORY`, see `taisoft.view.link`.

It gets a description of the scene, then states, and sends what the window shows and which commands the user has given. It ends
when the window is closed, and with the link.
"""

import time

from taisoft.processes import Link
from taisoft.view.drawn import DrawnScene, DrawnState
from taisoft.view.link import SharedNodes, serve
from taisoft.view.window.panel import Requests
from taisoft.view.window.screen import Screen

MAX_UNANSWERED = 64  # requests; later commands wait, so that a long step lets no queue grow
IDLE_SHARE = 1.0  # time without drawing over that of drawing: with software Vulkan, drawing takes cores from the simulation
ANSWER = 0.1  # time for which a picture may wait for the step that uses a drag [s]
STEPS_TO_ANSWER = 1.5  # half of the present one, and the next
LOOK_EVERY = 0.003  # time between two looks at the mouse while a drag waits for its next picture [s]
SLOWEST = 1.0 / 25.0  # time between two pictures above which there is no such pause [s]


class View:
    """The window with the state that it shows. link: to the simulation; nodes: shared with it; description: of the window."""

    def __init__(self, link: Link, nodes: SharedNodes, scene: DrawnScene, description: dict):
        self._link, self._nodes, self._scene, self._requests = link, nodes, scene, Requests()
        self._drawn = DrawnState.at_start(scene)
        self._screen = Screen(scene, description, self._requests)
        self._interval = 1.0 / description["fps"]
        self._state: dict = {}
        self._came = 0.0  # when the state came
        self._confirmed: tuple | None = None  # the last message but for commands

    def run(self) -> None:
        """Draw until the window is closed, or the link, which raises LinkClosed; then close the window."""
        try:
            self._draw()
        finally:
            self._screen.close()

    def _draw(self) -> None:
        self._receive(None)
        while not self._screen.closed:
            begin = time.perf_counter()
            self._screen.draw(self._drawn, self._state, begin - self._came)
            self._send()
            self._wait(begin, time.perf_counter())
        timing = self._screen.timing
        self._link.send({"closed": True, "pictures": list(timing.pictures), "latencies": list(timing.latencies)})

    def _wait(self, begin: float, end: float) -> None:
        """Take over states, and follow a drag, until the next picture is due; begin, end: of the last one [s]."""
        idle = 0.0 if self._screen.dragging else IDLE_SHARE * (end - begin)
        due = max(begin + self._interval, min(end + idle, begin + SLOWEST))
        timing = self._screen.timing
        self._receive(0.0)
        request = timing.awaited(is_fast=self._seconds_to_answer() < end - begin)
        while (left := max(due - time.perf_counter(), timing.seconds_to_answer(request, ANSWER))) > 0.0:
            if self._screen.drags_body:
                self._receive(min(left, LOOK_EVERY))
                self._screen.look(self._drawn)
                self._send()
            else:
                self._receive(left)
        self._receive(0.0)

    def _seconds_to_answer(self) -> float:
        """Return the expected time from a request to the state after a step that uses it [s]; 0 without controls."""
        return STEPS_TO_ANSWER * self._state["cost"] * self._state["controls"]["dt"] if "cost" in self._state else 0.0

    def _receive(self, timeout: float | None) -> None:
        """Take over all states that have come; wait up to a time [s] for the first."""
        while (message := self._link.receive(timeout)) is not None:
            timeout = 0.0
            self._state, self._came = message, time.perf_counter()
            self._drawn = self._nodes.take(self._scene, message["state"], message["number"] % self._nodes.slots)
            self._screen.timing.came(message)
            self._send()  # at once, so that the simulation may send the next one

    def _send(self) -> None:
        """Send commands, and confirm the state, if there is anything new."""
        screen = self._screen
        layers = [name for name, shown in screen.layers.shown.items() if shown]
        shown = (self._state["number"], screen.colouring.kind, layers)
        waits = self._requests.number - self._state["answered"] >= MAX_UNANSWERED
        commands = [] if waits else self._requests.take()
        if commands or shown != self._confirmed:
            names = ("confirmed", "colour", "layers")
            self._link.send(dict(zip(names, shown)) | {"number": self._requests.number, "commands": commands})
            self._confirmed = shown


if __name__ == "__main__":
    serve(View)
