"""A process beside the simulation that shows or draws it: both ends of its life.

The caller starts `python -m MODULE SOCKET MEMORY`, two descriptors that the process inherits. So a script that starts one needs
no `if __name__ == "__main__"`, and nothing but what travels over the link (`taisoft.view.link`) is shared. The process ends when
it is asked to, and when its caller ends, however that ends.
"""

import subprocess
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection

from taisoft.errors import OutputError, TaisoftError, no_memory
from taisoft.output.files import output_errors
from taisoft.processes import how_it_ended, start_python
from taisoft.view.link import Link, LinkClosed, SharedNodes

END_SECONDS = 5.0  # in which a process must end


class ChildProcess:
    """A process at the other end of a link.

    command: arguments of Python, to which the descriptors are appended; description: sent first; it gets `n_nodes`, of all
    bodies, and `slots` for their data; failure: what cannot be done without the process, for messages. link: this end of the
    link. Raises OutputError if the process cannot be started.
    """

    def __init__(self, command: tuple[str, ...], description: dict, failure: str, n_nodes: int, slots: int = 1):
        self._process: subprocess.Popen | None = None
        with output_errors(f"{failure}: no memory can be shared with its process"):
            self.link, other = Link.pair(n_nodes, slots)
        try:
            descriptors = (other.fileno(), self.link.nodes.descriptor)
            self._process = start_python(*command, *map(str, descriptors), pass_fds=descriptors)
        except OSError as error:
            self.link.close()
            raise OutputError(f"{failure}: its process cannot be started: {error.strerror or error}") from error
        finally:
            other.close()
        with suppress(LinkClosed):  # the next call that reads says why
            self.link.send(description | {"n_nodes": n_nodes, "slots": slots})

    @property
    def pid(self) -> int | None:
        """Number of the process, None once it is closed."""
        return None if self._process is None else self._process.pid

    def how_it_ended(self) -> str:
        """Return, after the link was found closed, how the process ended, as a sentence."""
        try:
            status = self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            return "its process does not answer"
        return how_it_ended(status)

    def close(self) -> None:
        """Ask the process to end and wait for that; a second call does nothing."""
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(LinkClosed):
            self.link.send({"end": True})
        self.link.close()
        try:
            process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def serve(make: Callable[[Link, dict], object], socket: int, memory: int) -> None:
    """Run what `make` returns for the link and the caller's description, an object with `run()`, until it or the caller ends.

    An error of `make` is sent as `error`; else `open` is. socket, memory: the descriptors.
    """
    link = Link(Connection(socket))
    with suppress(LinkClosed):
        description = link.receive(None)
        link.nodes = SharedNodes(description["n_nodes"], description["slots"], memory)
        try:
            served = make(link, description)
        except (TaisoftError, MemoryError) as error:
            error = no_memory("a scene to show", error) if isinstance(error, MemoryError) else error
            link.send({"error": str(error)})
            return
        link.send({"open": True})
        served.run()
