"""Places that execute runs, and the loop that distributes requests to them.

A place takes one request at a time: `start(request)`, `poll()` -> the answer or None, `stop()`. LocalPlace runs a child process
on its own cores; ClusterPlace does so on a worker of a Dask cluster. Requests and answers are defined in `taisoft/cli/study.py`.

The cores of a machine are divided evenly among its places, so that timed runs do not share cores. On a cluster every worker uses
as many cores as the smallest one has, and needs this taisoft and the scene under the same name, which is checked before every
run. Dask sends Python objects unencrypted: use only a cluster on a trusted network.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

from taisoft.errors import SceneError
from taisoft.machine import usable_cores
from taisoft.output.report import json_text, machine

CHILD = (sys.executable, "-m", "taisoft.cli.study")
POLL_INTERVAL = 0.05  # [s]
CONNECT_SECONDS = 10  # to a cluster's scheduler
ALIVE_CHECK_INTERVAL = 2.0  # [s]
BUDGET_SPENT, CUT_BY_BUDGET = "the budget was spent", "the budget was spent while it ran"


class Place(Protocol):
    """Executes one run at a time, on `cores`."""

    cores: list[int]

    def start(self, request: dict) -> None:
        """Start a request."""

    def poll(self) -> dict | None:
        """Return {"answer": ...}, {"error": ...}, {"crash": ...} or, for a lost place, {"lost": sentence}; None until then."""

    def stop(self) -> None:
        """Stop the current run, if any."""


def carry_out(
    requests: Iterable[tuple[str, dict]],
    places: list,
    done: Callable[[str, dict], None],
    *,
    seconds_left: Callable[[], float],
    stop_requested: Callable[[], bool],
) -> dict[str, str]:
    """Execute requests (key, request) in order and call done(key, answer) for each.

    seconds_left: of the budget; stop_requested: whether to end. Return the keys of unfinished requests, and why.
    """
    waiting = list(requests)
    busy: dict[int, tuple[str, dict]] = {}
    lost: dict[int, str] = {}
    try:
        while waiting or busy:
            why = "the study was interrupted" if stop_requested() else BUDGET_SPENT if seconds_left() <= 0.0 else ""
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
        for place in places:
            place.stop()


class LocalPlace:
    """Runs child processes on this machine, one at a time. child: their command, which calls `serve`."""

    def __init__(self, cores: list[int], child: tuple[str, ...] = CHILD):
        self.cores, self._child = cores, child
        self._process: subprocess.Popen | None = None

    def start(self, request: dict) -> None:
        """See Place. A new session shields the child from the terminal's Ctrl-C; it exits when its stdin closes."""
        self._stdout, self._stderr = tempfile.TemporaryFile(), tempfile.TemporaryFile()
        streams = {"stdin": subprocess.PIPE, "stdout": self._stdout, "stderr": self._stderr}
        with _pinned(self.cores):  # the child inherits the cores, which count when NumPy and Taichi start
            self._process = subprocess.Popen(self._child, **streams, start_new_session=True)
        with suppress(BrokenPipeError):  # the child has already ended; `poll` returns the reason
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()

    def poll(self) -> dict | None:
        """See Place."""
        if self._process is None or self._process.poll() is None:
            return None
        code = self._process.returncode
        self._close()
        stdout, stderr = _content(self._stdout), _content(self._stderr).decode(errors="replace")
        try:
            return json.loads(stdout)
        except ValueError:
            how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
            lines = stderr.strip().splitlines()
            return {"crash": f"its process ended {how} without an answer" + (f": {lines[-1]}" if lines else "")}

    def stop(self) -> None:
        """See Place."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._close()

    def _close(self) -> None:
        with suppress(BrokenPipeError):  # closing flushes what the child did not read before it ended
            self._process.stdin.close()
        self._process = None


@contextmanager
def _pinned(cores: list[int]) -> Iterator[None]:
    """Keep this thread on the cores meanwhile, where the system has CPU affinity."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _content(file) -> bytes:
    file.seek(0)
    with file:
        return file.read()


def local_places(number: int) -> list[LocalPlace]:
    """Return places that divide this process's cores evenly. Raises SceneError if there are fewer cores than places."""
    cores = usable_cores()
    if not 1 <= number <= len(cores):
        raise SceneError(f"--workers {number}: it must be between 1 and {len(cores)}, the number of cores: timed runs share none")
    if number > 1 and not hasattr(os, "sched_setaffinity"):
        raise SceneError(f"--workers {number}: this system cannot pin processes to cores, so timed runs could share one")
    each = len(cores) // number
    return [LocalPlace(cores[k * each : (k + 1) * each]) for k in range(number)]


def serve(answer: Callable[[dict], dict]) -> None:
    """Be the child of a LocalPlace: read a request as a line of JSON on stdin, write answer(request) on stdout, and exit.

    The process also exits when stdin closes, so that it does not outlive the command. What a scene prints goes to stderr.
    """
    line = b""
    while not line.endswith(b"\n"):
        part = os.read(0, 65536)
        if not part:
            os._exit(1)
        line += part
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    out.write(json_text(answer(json.loads(line))).encode())
    out.flush()
    sys.stderr.flush()
    os._exit(0)  # skips Taichi's slow shutdown


def _exit_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


class ClusterPlace:
    """One worker of a Dask cluster."""

    def __init__(self, client, address: str, cores: list[int]):
        self.cores, self._client, self._address = cores, client, address
        self._future, self._name, self._last_check = None, "", 0.0

    def start(self, request: dict) -> None:
        """See Place."""
        self._name = uuid.uuid4().hex
        there = {"workers": [self._address], "allow_other_workers": False, "pure": False, "retries": 0}
        self._future = self._client.submit(run_on_worker, request, self.cores, self._name, **there)

    def poll(self) -> dict | None:
        """See Place."""
        if self._future is None:
            return None
        if not self._future.done():
            return self._check_alive()
        future, self._future = self._future, None
        if future.status == "finished":
            return future.result()
        if future.status == "error":
            return {"crash": f"the worker {self._address}: {type(future.exception()).__name__}: {future.exception()}"}
        return {"lost": f"the worker {self._address} is gone"}

    def stop(self) -> None:
        """See Place. Dask cannot stop a running task, so a second task stops it on the worker."""
        if self._future is not None:
            with suppress(Exception):  # Dask may raise anything if worker or scheduler are gone; nothing is then left to stop
                self._client.run(stop_on_worker, self._name, workers=[self._address], on_error="ignore")
                self._future.cancel()
            self._future = None

    def _check_alive(self) -> dict | None:
        """Check periodically that the worker is alive, because Dask keeps a task waiting for a lost worker."""
        if time.monotonic() - self._last_check < ALIVE_CHECK_INTERVAL:
            return None
        self._last_check = time.monotonic()
        try:
            alive = self._address in self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception as error:  # Dask and Tornado have their own exception types
            return {"lost": f"the scheduler does not answer ({type(error).__name__})"}
        if alive:
            return None
        self._future = None
        return {"lost": f"the worker {self._address} is gone"}


_running: dict[str, LocalPlace] = {}  # on a worker: its current runs, by name
_lock = threading.Lock()


def run_on_worker(request: dict, cores: list[int], name: str) -> dict:
    """Execute a request in a child process of a cluster's worker, under a name."""
    place = LocalPlace(cores)
    with _lock:
        _running[name] = place
        place.start(request)
    while True:
        with _lock:
            answer = place.poll() if name in _running else {"crash": "it was stopped"}
            if answer is not None:
                _running.pop(name, None)
                return answer
        time.sleep(POLL_INTERVAL)


def stop_on_worker(name: str) -> None:
    """Stop the run of that name."""
    with _lock:
        if place := _running.pop(name, None):
            place.stop()


def _worker_info() -> dict:
    return {"machine": machine(), "cores": usable_cores()}


def connect(address: str):
    """Return a client of the scheduler at this address. Raises SceneError if there is none."""
    try:
        from distributed import Client
    except ImportError:
        raise SceneError("--scheduler needs the package distributed, which is missing: pip install 'taisoft[cluster]'") from None
    try:
        return Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise SceneError(f"--scheduler {address}: no Dask scheduler answers there ({type(error).__name__})") from None


def cluster_places(client) -> tuple[list[ClusterPlace], list[dict]]:
    """Return one place per worker, and their machines. Raises SceneError without workers or with fewer cores than workers."""
    try:
        workers = client.run(_worker_info)
    except Exception as error:  # exceptions of the workers are re-raised here unchanged
        raise SceneError(f"the cluster's workers cannot run taisoft: {type(error).__name__}: {error}") from None
    if not workers:
        raise SceneError("the cluster has no worker")
    machines = {info["machine"]["name"]: info["machine"] for info in workers.values()}
    places = []
    for name in machines:
        own = {address: info["cores"] for address, info in workers.items() if info["machine"]["name"] == name}
        cores = sorted(set().union(*own.values()))
        each = len(cores) // len(own)
        if each == 0:
            raise SceneError(f"{len(own)} workers on {name} share {len(cores)} cores: each timed run needs its own")
        places += [(address, cores[k * each : (k + 1) * each]) for k, address in enumerate(own)]
    n_cores = min(len(cores) for _, cores in places)
    return [ClusterPlace(client, address, cores[:n_cores]) for address, cores in places], list(machines.values())
