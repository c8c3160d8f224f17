"""The link between a simulation and the process that shows it: small messages over a socket, node data in shared memory.

A message is a dict of plain data and arrays in JSON (`taisoft.nested`); nothing is pickled. Displacements and values at the
nodes, which may be large, lie in memory that both processes map, in one or several slots. The writer fills a slot only after the
reader has confirmed the message about its previous content, so sending rarely waits for the reader.
"""

import mmap
import os
import tempfile
from multiprocessing import Pipe
from multiprocessing.connection import Connection

import numpy as np

from taisoft.nested import from_json, to_json
from taisoft.view.drawn import DrawnScene, DrawnState


class LinkClosed(Exception):
    """The other process has ended or closed its end."""


class SharedNodes:
    """Displacements (slots,n,3) [m] and values (slots,n) at all nodes, float32, in memory shared through a file descriptor."""

    def __init__(self, n_nodes: int, slots: int = 1, descriptor: int | None = None):
        size = max(1, n_nodes) * slots * 4 * 4
        if descriptor is None:
            descriptor = _anonymous_file()
            os.ftruncate(descriptor, size)
        self.descriptor, self._memory = descriptor, mmap.mmap(descriptor, size)
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

    def close(self) -> None:
        """Close the descriptor; the memory goes with its last array."""
        os.close(self.descriptor)


def _anonymous_file() -> int:
    """Return the descriptor of a file without a name, in memory where the system offers that."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("taisoft")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class Link:
    """One end of the link. connection: to the other process; nodes: the shared memory, once its size is known."""

    def __init__(self, connection: Connection, nodes: SharedNodes | None = None):
        self._connection, self.nodes = connection, nodes

    @classmethod
    def pair(cls, n_nodes: int, slots: int = 1) -> tuple["Link", Connection]:
        """Return one end, and the connection of the other one. Raises OSError, for instance without memory."""
        nodes = SharedNodes(n_nodes, slots)
        own, other = Pipe()
        return cls(own, nodes), other

    def send(self, message: dict) -> None:
        """Send a message. Raises LinkClosed."""
        try:
            self._connection.send_bytes(to_json(message, level=0).encode())
        except OSError as error:
            raise LinkClosed from error

    def receive(self, timeout: float | None = 0.0) -> dict | None:
        """Return the next message, or None if there is none within the time [s]; None waits for one. Raises LinkClosed."""
        try:
            return from_json(self._connection.recv_bytes()) if self._connection.poll(timeout) else None
        except (EOFError, OSError) as error:
            raise LinkClosed from error

    def close(self) -> None:
        """Close this end."""
        self._connection.close()
        self.nodes.close()
