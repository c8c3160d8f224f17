"""A process beside the simulation that shows or draws its states: both ends of its link, and the memory that they share.

The caller starts `python -m MODULE MEMORY`, a descriptor. Displacements and values at the nodes, which may be large, lie in
memory that both processes map, in one or several slots; all else travels in messages (`taisoft.processes`). The writer fills a
slot only after the reader has confirmed the message about its previous content, so sending rarely waits for the reader.
"""

import mmap
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from taisoft.errors import OutputError, TaisoftError, no_memory
from taisoft.output.folder import output_errors
from taisoft.processes import Child, Link, LinkClosed
from taisoft.view.drawn import DrawnScene, DrawnState


class SharedNodes:
    """Displacements (slots,n,3) [m] and values (slots,n) at all nodes, float32, in memory shared through a file descriptor."""

    def __init__(self, n_nodes: int, slots: int = 1, descriptor: int | None = None):
        size = max(1, n_nodes) * slots * 4 * 4
        if descriptor is None:
            descriptor = _anonymous_file()
            os.ftruncate(descriptor, size)
        self.slots, self.descriptor, self._memory = slots, descriptor, mmap.mmap(descriptor, size)
        parts = np.frombuffer(self._memory, np.float32, 4 * slots * n_nodes).reshape(4, slots, n_nodes)
        self.displacement, self.values = parts[:3].reshape(slots, n_nodes, 3), parts[3]

    def put(self, state: DrawnState, kind: str, slot: int = 0) -> dict:
        """Fill a slot from a state, with the values of one quantity; return the rest as plain data."""
        self.displacement[slot] = state.displacement
        if kind in state.values:
            self.values[slot] = state.values[kind]
        return state.plain() | {"kind": kind}

    def take(self, scene: DrawnScene, rest: dict, slot: int = 0) -> DrawnState:
        """Return a copy of the state that was put into a slot. rest: what `put` returned."""
        kind, rest = rest["kind"], {name: value for name, value in rest.items() if name != "kind"}
        values = {} if kind == "body" else {kind: self.values[slot].copy()}
        return DrawnState(scene, displacement=self.displacement[slot].copy(), values=values, **rest)


def _anonymous_file() -> int:
    """Return the descriptor of a file without a name, in memory where the system offers that."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("taisoft")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class Viewer(Child):
    """The caller's side of a process that shows or draws the states of a scene, and the memory shared with it.

    command: arguments of Python, to which the memory's descriptor is appended; scene, description: sent first; failure: what
    cannot be done without the process, for messages; slots: for the nodes' data. error: what ended it. Raises OutputError if it
    cannot be started.
    """

    def __init__(self, command: tuple[str, ...], scene: DrawnScene, description: dict, failure: str, slots: int = 1):
        n_nodes, self.failure, self.error = len(scene.start), failure, None
        with output_errors(f"{failure}: no memory can be shared with its process"):
            self.nodes = SharedNodes(n_nodes, slots)
        descriptor = self.nodes.descriptor
        try:
            super().__init__(*command, str(descriptor), pass_fds=[descriptor], is_quiet=False)
        except OSError as error:
            raise OutputError(f"{failure}: its process cannot be started: {error.strerror or error}") from error
        finally:
            os.close(descriptor)  # the memory goes with its last array
        self.send({"scene": scene.plain(), "n_nodes": n_nodes, "slots": slots} | description)

    def send(self, message: dict) -> bool:
        """Send a message; return whether the process still takes any. If not, the next `read` says why."""
        try:
            self.link.send(message)
        except LinkClosed:
            return False
        return True

    def read(self, timeout: float | None) -> dict | None:
        """Return the next message, as `Link.receive`. Raises OutputError once the process has reported an error or ended."""
        if self.error is None:
            try:
                message = self.link.receive(timeout)
                if message is None or "error" not in message:
                    return message
                self.error = OutputError(message["error"])
            except LinkClosed:
                self.error = OutputError(f"{self.failure}: {self.how_it_ended()}")
        raise self.error


def serve(make: Callable[[Link, SharedNodes, DrawnScene, dict], object]) -> None:
    """Be such a process: run what `make` returns, an object with `run()`, until it or the caller ends.

    make: gets the link, the memory, the scene and the description. Its error is sent as `error`; else `open` is.
    """
    link = Link.to_caller()
    with suppress(LinkClosed):
        description = link.receive(None)
        try:
            nodes = SharedNodes(description["n_nodes"], description["slots"], int(sys.argv[1]))
            served = make(link, nodes, DrawnScene.from_plain(description["scene"]), description)
        except (TaisoftError, MemoryError) as error:
            error = no_memory("a scene to show", error) if isinstance(error, MemoryError) else error
            link.send({"error": str(error)})
            return
        link.send({"open": True})
        served.run()
