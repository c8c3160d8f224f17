"""Places that execute requests, and the loop that distributes requests to them: what studies and `run_many` run on.

A place executes one request at a time: `execute(request)`, which waits for the answer, and `stop()`. A LocalPlace has a child
process (`taisoft.processes`); a ClusterPlace (`taisoft.many.cluster`) has one on a worker of a Dask cluster.

Timed runs have a new process each, on cores of their own. Other runs share processes, since Taichi takes seconds to start.
"""

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from typing import Protocol

from taisoft.errors import SimulationError
from taisoft.machine import THREADS
from taisoft.processes import Child, LinkClosed

POLL_INTERVAL = 0.01  # [s]
STORE_SECONDS = 60.0  # in which a child must have stored its kernels, and end
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
BUDGET_SPENT, CUT_BY_BUDGET = "the budget was spent", "the budget was spent while it ran"


class Place(Protocol):
    """Executes one request at a time, on `cores`."""

    cores: list[int]

    def execute(self, request: dict) -> dict:
        """Return {"answer": ...}, {"error": ...}, {"crash": ...} or, for a lost place, {"lost": sentence}."""

    def stop(self) -> None:
        """End the place, from another thread also while it executes a request, whose answer then means nothing."""


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
    waiting, free, busy, lost = deque(requests), deque(places), {}, []
    with ThreadPoolExecutor(2 * len(places)) as pool:  # one for each to execute, and to stop it
        try:
            while waiting or busy:
                why = "it was interrupted" if stop_requested() else BUDGET_SPENT if seconds_left() <= 0.0 else ""
                if len(lost) == len(places):
                    why = "; ".join(dict.fromkeys(lost))
                if why:
                    cut = dict.fromkeys((key for _, key, _ in busy.values()), CUT_BY_BUDGET if why == BUDGET_SPENT else why)
                    return cut | dict.fromkeys((key for key, _ in waiting), why)
                while waiting and free:
                    place, (key, request) = free.popleft(), waiting.popleft()
                    busy[pool.submit(place.execute, request)] = place, key, request
                for future in wait(busy, POLL_INTERVAL, FIRST_COMPLETED).done:
                    place, key, request = busy.pop(future)
                    answer = future.result()
                    if "lost" in answer:  # another place may still run it
                        lost.append(answer["lost"])
                        waiting.appendleft((key, request))
                    else:
                        free.append(place)
                        done(key, answer)
            return {}
        finally:
            list(pool.map(lambda place: place.stop(), places))


class LocalPlace:
    """Executes requests in child processes on this machine, one at a time.

    child: arguments of Python that start a process which calls `serve`. threads: None for a new process for each request, kept
    on the cores, of which it uses all; else that of a process for many requests, on any cores. The latter gives BLAS one
    thread, since its last digits depend on that number. A request during which a process that had others before ends without
    an answer is executed once more in a new one, so that what ran before does not count.
    """

    def __init__(self, cores: list[int], child: tuple[str, ...], threads: int | None = None):
        self.cores, self._command, self.threads = cores, child, threads
        self._child: Child | None = None
        self._is_busy = self._stopped = False

    def execute(self, request: dict) -> dict:
        """See Place. Raises SimulationError if no process can be started."""
        self._is_busy = True
        try:
            answer, was_new = self._answer(request)
            if "crash" in answer and not was_new and not self._stopped:
                answer, _ = self._answer(request)
            return answer
        finally:
            self._is_busy = False

    def _answer(self, request: dict) -> tuple[dict, bool]:
        """Return the answer of the process, or of a new one, and whether it is new."""
        if is_new := self._child is None or self._child.ended:
            self._launch()
        child = self._child
        if self._stopped:
            child.kill()
        try:
            child.link.send(request)
            answer = child.link.receive(None)
        except LinkClosed:
            answer = {"crash": child.how_it_ended(" without an answer")}
        if self.threads is None or "crash" in answer or answer.get("last"):
            child.close(STORE_SECONDS)
            self._child = None
        return answer, is_new

    def _launch(self) -> None:
        environment, on_cores = {}, _pinned(self.cores)  # which count when NumPy and Taichi start
        if self.threads is not None:
            environment = {THREADS: str(self.threads), "PYTHONHASHSEED": "0"} | dict.fromkeys(BLAS_THREADS, "1")
            on_cores = nullcontext()
        try:
            with on_cores:
                self._child = Child(*self._command, environment=environment)
        except OSError as error:
            raise SimulationError(f"no further process can be started: {error.strerror or error}") from error

    def stop(self) -> None:
        """See Place."""
        self._stopped, child = True, self._child
        if child is not None and self._is_busy:
            child.kill()  # its end is noticed by what waits for its answer
        elif child is not None:
            child.close(STORE_SECONDS)
            self._child = None


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
