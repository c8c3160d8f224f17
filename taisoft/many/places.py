"""Places that execute requests, and the loop that distributes requests to them: what studies and `run_many` run on.

A place takes one request at a time: `start(request)`, `poll()` -> the answer or None, `stop()`. A LocalPlace has a child process;
a ClusterPlace (`taisoft.many.cluster`) has one on a worker of a Dask cluster. A child reads requests from stdin and writes an
answer to each on stdout, both lines of JSON (`taisoft.nested`). It ends when its stdin closes, so it does not outlive its caller,
however that ends.

Timed runs have a new process each, on cores of their own. Other runs share processes, since Taichi takes seconds to start.
"""

import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from typing import Protocol

from taisoft.errors import SimulationError
from taisoft.machine import THREADS
from taisoft.nested import from_json, to_json
from taisoft.processes import how_it_ended, start_python

POLL_INTERVAL = 0.01  # [s]
IDLE_SECONDS = 120.0  # after which a child without a request ends: that of a cluster's worker whose client was killed
END_SECONDS = 10.0  # in which an idle child must end
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
serving = False  # whether this process is the child of a place
BUDGET_SPENT, CUT_BY_BUDGET = "the budget was spent", "the budget was spent while it ran"


class Place(Protocol):
    """Executes one request at a time, on `cores`."""

    cores: list[int]

    def start(self, request: dict) -> None:
        """Start a request."""

    def poll(self) -> dict | None:
        """Return {"answer": ...}, {"error": ...}, {"crash": ...} or, for a lost place, {"lost": sentence}; None until then."""

    def stop(self) -> None:
        """Stop the current request, if any, and end the process."""


def carry_out(
    requests: Iterable[tuple[str, dict]],
    places: list,
    done: Callable[[str, dict], None],
    *,
    seconds_left: Callable[[], float] = lambda: math.inf,
    stop_requested: Callable[[], bool] = bool,
) -> dict[str, str]:
    """Execute requests (key, request) in order and call done(key, answer) for each.

    seconds_left: of the budget; stop_requested: whether to end. Return the keys of unfinished requests, and why.
    """
    waiting = list(requests)
    busy: dict[int, tuple[str, dict]] = {}
    lost: dict[int, str] = {}
    try:
        while waiting or busy:
            why = "it was interrupted" if stop_requested() else BUDGET_SPENT if seconds_left() <= 0.0 else ""
            if len(lost) == len(places):
                why = "; ".join(dict.fromkeys(lost.values()))
            if why:
                cut = dict.fromkeys((key for key, _ in busy.values()), CUT_BY_BUDGET if why == BUDGET_SPENT else why)
                return cut | dict.fromkeys((key for key, _ in waiting), why)
            progressed = False
            for k, place in enumerate(places):
                if k in busy and (answer := place.poll()) is not None:
                    progressed, (key, request) = True, busy.pop(k)
                    if "lost" in answer:  # another place may still run it
                        lost[k] = answer["lost"]
                        waiting.insert(0, (key, request))
                    else:
                        done(key, answer)
                if k not in busy and k not in lost and waiting:
                    progressed, busy[k] = True, waiting.pop(0)
                    place.start(busy[k][1])
            if not progressed:
                time.sleep(POLL_INTERVAL)
        return {}
    finally:
        with ThreadPoolExecutor(max(1, len(places))) as pool:  # ending takes a moment
            list(pool.map(lambda place: place.stop(), places))


class LocalPlace:
    """Executes requests in child processes on this machine, one at a time.

    child: arguments of Python that start a process which calls `serve`. threads: None for a new process for each request, kept
    on the cores, of which it uses all; else that of a process for many requests, on any cores. The latter gives BLAS one
    thread, since its last digits depend on that number. A request during which a process that had others before ends without
    an answer is executed once more in a new one, so that what ran before does not count.
    """

    def __init__(self, cores: list[int], child: tuple[str, ...], threads: int | None = None):
        self.cores, self._child, self.threads = cores, child, threads
        self._process: subprocess.Popen | None = None
        self._request, self._answer, self._n_requests = b"", None, 0

    def start(self, request: dict) -> None:
        """See Place."""
        self._request = to_json(request).encode() + b"\n"
        if self._process is None or self._process.poll() is not None:
            self._launch()
        self._send()

    def poll(self) -> dict | None:
        """See Place."""
        if self._process is None:
            return None
        code = self._process.poll()  # before what it has written is read
        self._answer = self._answer or _answer_in(self._stdout)
        if self._answer is None:
            return None if code is None else self._crash(code)
        if self.threads is None or self._answer.get("last"):  # it stores its kernels and ends
            self._close_stdin()
            if code is None:
                return None
            self._process = None
        self._request = b""
        answer, self._answer = self._answer, None
        return answer

    def stop(self) -> None:
        """See Place. An idle process stores its kernels first."""
        if self._process is None:
            return
        if self._request:
            _kill(self._process.pid)
        self._close_stdin()
        try:
            self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            _kill(self._process.pid)
            self._process.wait()
        self._process, self._request, self._answer = None, b"", None

    def _launch(self) -> None:
        environment, on_cores = {}, _pinned(self.cores)  # which count when NumPy and Taichi start
        if self.threads is not None:
            environment = {THREADS: str(self.threads), "PYTHONHASHSEED": "0"} | dict.fromkeys(BLAS_THREADS, "1")
            on_cores = nullcontext()
        try:
            self._stdout, self._stderr, self._n_requests = tempfile.TemporaryFile(), tempfile.TemporaryFile(), 0
            streams = {"stdin": subprocess.PIPE, "stdout": self._stdout, "stderr": self._stderr}
            with on_cores:
                self._process = start_python(*self._child, environment=environment, **streams)
        except OSError as error:
            raise SimulationError(f"no further process can be started: {error.strerror or error}") from error

    def _send(self) -> None:
        self._n_requests += 1
        for file in (self._stdout, self._stderr):  # the process writes at the same position
            file.seek(0)
            file.truncate()
        with suppress(BrokenPipeError):  # the process has already ended; `poll` returns the reason
            self._process.stdin.write(self._request)
            self._process.stdin.flush()

    def _crash(self, code: int) -> dict | None:
        lines = _content(self._stderr).decode(errors="replace").strip().splitlines()
        self._close_stdin()
        self._process = None
        if self._n_requests > 1:
            self._launch()
            self._send()
            return None
        self._request = b""
        return {"crash": f"{how_it_ended(code)} without an answer" + (f": {lines[-1]}" if lines else "")}

    def _close_stdin(self) -> None:
        with suppress(BrokenPipeError):  # closing flushes what the child did not read before it ended
            self._process.stdin.close()


@contextmanager
def _pinned(cores: list[int]) -> Iterator[None]:
    """Keep this thread on the cores meanwhile, where the system has CPU affinity; a child inherits that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _answer_in(file) -> dict | None:
    """Return the answer in a file if its line is complete. The position, which the writer shares, stays."""
    size = os.fstat(file.fileno()).st_size
    if size == 0 or os.pread(file.fileno(), 1, size - 1) != b"\n":
        return None
    content = _content(file)
    try:
        return from_json(content)
    except ValueError:  # something that runs when Python starts has written it
        return {
            "crash": f"its process printed {content.splitlines()[0].decode(errors='replace')!r} when it started",
            "last": True,
        }


def _kill(pid: int) -> None:
    """Kill the process, which leads a session of its own, and what it has started."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


def _content(file) -> bytes:
    size, content = os.fstat(file.fileno()).st_size, b""
    while len(content) < size:  # the system reads at most 2 GB at a time
        content += os.pread(file.fileno(), size - len(content), len(content))
    return content


def serve(answer: Callable[[dict], dict]) -> None:
    """Be the child of a place: write answer(request) for each request, and exit when stdin closes, even while one is executed.

    What else is printed goes to stderr, and nothing can be read from stdin.
    """
    global serving
    serving, requests, is_idle = True, queue.SimpleQueue(), threading.Event()
    stdin, out = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    threading.Thread(target=_read, args=(stdin, requests, is_idle), daemon=True).start()
    while line := _next(requests):
        is_idle.clear()
        text = to_json(answer(from_json(line))) + "\n"
        sys.stdout.flush()
        sys.stderr.flush()
        is_idle.set()
        out.write(text.encode())
        out.flush()
    if runtime := sys.modules.get("taisoft.backend.runtime"):
        runtime.end()
    os._exit(0)  # skips the rest of Taichi's slow shutdown


def _next(requests: queue.SimpleQueue) -> bytes:
    with suppress(queue.Empty):
        return requests.get(timeout=IDLE_SECONDS)
    return b""


def _read(stdin, requests: queue.SimpleQueue, is_idle: threading.Event) -> None:
    for line in stdin:
        requests.put(line)
    requests.put(b"")
    if not is_idle.is_set():
        _kill(os.getpid())
        os._exit(1)
