"""Places that execute runs: child processes, each on its own cores; and the loop that distributes requests to them.

A place takes one request at a time: `start(request)`, `poll()` -> the answer or None, `stop()`. Requests and answers are
defined in `taisoft/cli/study_child.py`. Places on a cluster are in `taisoft.study.cluster`.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Protocol

from taisoft.errors import SceneError
from taisoft.timing import usable_cores

CHILD = (sys.executable, "-m", "taisoft.cli.study_child")
POLL_INTERVAL = 0.05  # [s]
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


class LocalPlace:
    """Runs child processes on this machine, one at a time. child: their command, with the protocol of `study_child`."""

    def __init__(self, cores: list[int], child: tuple[str, ...] = CHILD):
        self.cores, self._child = cores, child
        self._process: subprocess.Popen | None = None

    def start(self, request: dict) -> None:
        """See Place. A new session shields the child from the terminal's Ctrl-C; it exits when its stdin closes."""
        self._stdout, self._stderr = tempfile.TemporaryFile(), tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            self._child, stdin=subprocess.PIPE, stdout=self._stdout, stderr=self._stderr, start_new_session=True
        )
        try:
            self._process.stdin.write(json.dumps(request | {"cores": self.cores}).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # the child has already ended; `poll` returns the reason

    def poll(self) -> dict | None:
        """See Place."""
        process = self._process
        if process is None or process.poll() is None:
            return None
        self._process = None
        _close_stdin(process)
        stdout, stderr = _content(self._stdout), _content(self._stderr).decode(errors="replace")
        try:
            return json.loads(stdout)
        except ValueError:
            return {"crash": _exit_reason(process.returncode, stderr)}

    def stop(self) -> None:
        """See Place."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            _close_stdin(self._process)
            self._process = None


def _close_stdin(process: subprocess.Popen) -> None:
    with suppress(BrokenPipeError):  # closing flushes what the child did not read before it ended
        process.stdin.close()


def _content(file) -> bytes:
    file.seek(0)
    with file:
        return file.read()


def _exit_reason(code: int, stderr: str) -> str:
    """Return a sentence on how a process without an answer ended."""
    how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
    lines = stderr.strip().splitlines()
    return f"its process ended {how} without an answer" + (f": {lines[-1]}" if lines else "")


def local_places(number: int) -> list[LocalPlace]:
    """Return places that divide this process's cores evenly. Raises SceneError if there are fewer cores than places."""
    cores = usable_cores()
    if not 1 <= number <= len(cores):
        raise SceneError(f"--workers {number}: it must be between 1 and {len(cores)}, the number of cores: timed runs share none")
    if number > 1 and not hasattr(os, "sched_setaffinity"):
        raise SceneError(f"--workers {number}: this system cannot pin processes to cores, so timed runs could share one")
    each = len(cores) // number
    return [LocalPlace(cores[k * each : (k + 1) * each]) for k in range(number)]


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
