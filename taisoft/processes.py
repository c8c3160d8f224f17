"""Child processes that run this version of taisoft, and the links to them.

A link is a socket, the child's stdin. Over it travel messages: dicts of plain data and arrays, as JSON (`taisoft.nested`).
Nothing is pickled, a script that starts a child needs no `if __name__ == "__main__"`, and what a child prints disturbs nothing.
A child ends when its caller closes the link, and so with its caller, however that ends.
"""

import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from taisoft.nested import from_json, to_json

END_SECONDS = 10.0  # in which a child must end once the link is closed
LINE_BYTES = 4096  # of what a child prints, in which its last line is
IDLE_SECONDS = 120.0  # after which a child without a request ends: that of a cluster's worker whose client was killed
serving = False  # whether this process is a child that answers requests


def start_python(*arguments: str, environment: dict[str, str] | None = None, **options) -> subprocess.Popen:
    """Start Python with this version of taisoft. environment: further variables; options: of Popen. Raises OSError.

    Without a `stdin` it can read nothing, and a session of its own shields it from the terminal's Ctrl-C.
    """
    folders = (str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH"))
    full = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, folders))} | (environment or {})
    options = {"stdin": subprocess.DEVNULL, "start_new_session": True} | options
    return subprocess.Popen([sys.executable, *arguments], env=full, **options)


class LinkClosed(Exception):
    """The other process has ended or closed its end."""


class Link:
    """One end of a link."""

    def __init__(self, connection: Connection):
        self._connection = connection

    @classmethod
    def to_caller(cls) -> "Link":
        """Return a child's end; from now on nothing can be read from stdin."""
        link = cls(Connection(os.dup(0)))
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        return link

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
        except (EOFError, OSError, ValueError) as error:  # something else has written to it
            raise LinkClosed from error

    def close(self) -> None:
        """Close this end."""
        self._connection.close()


class Child:
    """A process at the other end of a link.

    command, options: as for `start_python`; is_quiet: whether it prints nothing, and the end of its stderr is kept. Raises
    OSError.
    """

    def __init__(self, *command: str, is_quiet: bool = True, **options):
        self._errors, self._reader = b"", None
        own, other = Pipe()
        self.link = Link(own)
        try:
            streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE} if is_quiet else {}
            self._process = start_python(*command, stdin=other.fileno(), **streams, **options)
        except OSError:
            own.close()
            raise
        finally:
            other.close()
        if is_quiet:
            self._reader = threading.Thread(target=self._keep_errors, args=(self._process.stderr,), daemon=True)
            self._reader.start()

    def _keep_errors(self, stream) -> None:
        """Read what the process prints to stderr, of which only the end is kept."""
        with stream:
            while part := stream.read1():
                self._errors = (self._errors + part)[-LINE_BYTES:]

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    def how_it_ended(self, what: str = "") -> str:
        """Return, after the link was found closed, a sentence on how the process ended, with the last line that it printed.

        what: further words of the sentence.
        """
        try:
            status = self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            return "its process does not answer"
        how = f"by signal {signal.Signals(-status).name}" if status < 0 else f"with exit status {status}"
        return f"its process ended {how}{what}" + (f": {last}" if (last := self._last_line()) else "")

    def _last_line(self) -> str:
        if self._reader is not None:
            self._reader.join(1.0)  # what it has started may still hold the other end
        return self._errors.decode(errors="replace").strip().rpartition("\n")[2]

    def kill(self) -> None:
        """Kill the process and what it has started."""
        _kill(self._process.pid)

    def close(self, seconds: float = END_SECONDS) -> None:
        """Close the link, wait for the end of the process and then kill it; a second call does nothing."""
        self.link.close()
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            self._process.wait()


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


def call(command: tuple[str, ...], request: dict, seconds: float | None = None, **options) -> dict:
    """Return the answer of a child to one request, or {"crash": sentence} if it ends without one or takes more than `seconds`.

    command, options: see `Child`. Raises OSError.
    """
    child = Child(*command, **options)
    try:
        child.link.send(request)
        answer = child.link.receive(seconds)
        return {"crash": f"its process was stopped after {seconds:.0f} s"} if answer is None else answer
    except LinkClosed:
        return {"crash": child.how_it_ended()}
    finally:  # whatever ends the wait, such as a signal
        child.kill()
        child.close()


def serve(answer: Callable[[dict], dict]) -> None:
    """Be a child that sends answer(request) for each request, and exit when the link is closed, even while one is executed."""
    global serving
    serving, link, requests, is_busy = True, Link.to_caller(), queue.SimpleQueue(), threading.Event()
    threading.Thread(target=_read, args=(link, requests, is_busy), daemon=True).start()
    with suppress(LinkClosed, queue.Empty):
        while (request := requests.get(timeout=IDLE_SECONDS)) is not None:
            reply = answer(request)
            is_busy.clear()
            link.send(reply)
    if runtime := sys.modules.get("taisoft.backend.runtime"):
        runtime.end()  # stores kernels
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # skips the rest of Taichi's slow shutdown


def _read(link: Link, requests: queue.SimpleQueue, is_busy: threading.Event) -> None:
    with suppress(LinkClosed):
        while True:
            request = link.receive(None)
            is_busy.set()
            requests.put(request)
    requests.put(None)
    if is_busy.is_set():
        _kill(os.getpid())
        os._exit(1)
