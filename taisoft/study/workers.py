"""Where runs are carried out: child processes, each on cores of its own, and the loop that hands them out.

A place takes one request at a time: `start(request)`, `poll()` -> the answer or None, `stop()`. The requests and answers are
those of `taisoft/cli/study_child.py`. The places of a cluster are in `taisoft.study.cluster`.
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
LOOK_EVERY = 0.05  # [s]
SPENT, CUT = "the budget was spent", "the budget was spent while it ran"


class Place(Protocol):
    """Where one run at a time is carried out, on `cores`."""

    cores: list[int]

    def start(self, request: dict) -> None:
        """Begin with a request."""

    def poll(self) -> dict | None:
        """{"answer": ...}, {"error": ...}, {"crash": ...} or, where the place is no more, {"lost": sentence}; None until then."""

    def stop(self) -> None:
        """End what is going on, if anything is."""


class LocalPlace:
    """Child processes on this machine, one at a time. child: their command, which speaks as `study_child`."""

    def __init__(self, cores: list[int], child: tuple[str, ...] = CHILD):
        self.cores, self._child = cores, child
        self._process: subprocess.Popen | None = None

    def start(self, request: dict) -> None:
        """See Place. A session of its own keeps the terminal's Ctrl-C from it; it leaves when we do, by its stdin."""
        self._out, self._told = tempfile.TemporaryFile(), tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            self._child, stdin=subprocess.PIPE, stdout=self._out, stderr=self._told, start_new_session=True
        )
        try:
            self._process.stdin.write(json.dumps(request | {"cores": self.cores}).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended already, and `poll` tells

    def poll(self) -> dict | None:
        """See Place."""
        process = self._process
        if process is None or process.poll() is None:
            return None
        self._process = None
        _close_stdin(process)
        out, told = _content(self._out), _content(self._told).decode(errors="replace")
        try:
            return json.loads(out)
        except ValueError:
            return {"crash": _how_it_ended(process.returncode, told)}

    def stop(self) -> None:
        """See Place."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            _close_stdin(self._process)
            self._process = None


def _close_stdin(process: subprocess.Popen) -> None:
    with suppress(BrokenPipeError):  # what it did not read before it ended is still to be written
        process.stdin.close()


def _content(file) -> bytes:
    file.seek(0)
    with file:
        return file.read()


def _how_it_ended(code: int, told: str) -> str:
    """A sentence on a process that gave no answer."""
    how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
    last = told.strip().splitlines()
    return f"its process ended {how} without an answer" + (f": {last[-1]}" if last else "")


def local_places(number: int) -> list[LocalPlace]:
    """Places that share this process's cores evenly, none twice. Raises SceneError where there are fewer cores."""
    cores = usable_cores()
    if not 1 <= number <= len(cores):
        raise SceneError(f"--workers {number}: it must be between 1 and {len(cores)}, the number of cores: timed runs share none")
    if number > 1 and not hasattr(os, "sched_setaffinity"):
        raise SceneError(f"--workers {number}: this system pins no process to cores, so that timed runs could share one")
    each = len(cores) // number
    return [LocalPlace(cores[k * each : (k + 1) * each]) for k in range(number)]


def carry_out(
    requests: Iterable[tuple[str, dict]], places: list, done: Callable[[str, dict], None], *,
    seconds_left: Callable[[], float], requested: Callable[[], bool],
) -> dict[str, str]:  # fmt: skip
    """Hand out requests (key, request) in their order, and each answer to done(key, answer).

    seconds_left: of the budget; asked: whether to end. Returns the keys of what was not finished, and why.
    """
    waiting = list(requests)
    busy: dict[int, tuple[str, dict]] = {}
    lost: dict[int, str] = {}
    try:
        while waiting or busy:
            why = "the study was interrupted" if requested() else SPENT if seconds_left() <= 0.0 else ""
            if len(lost) == len(places):
                why = "; ".join(dict.fromkeys(lost.values()))
            if why:
                cut = dict.fromkeys((key for key, _ in busy.values()), CUT if why == SPENT else why)
                return cut | dict.fromkeys((key for key, _ in waiting), why)
            moved = False
            for k, place in enumerate(places):
                if k in busy and (answer := place.poll()) is not None:
                    moved, (key, request) = True, busy.pop(k)
                    if "lost" in answer:  # another place may still do it
                        lost[k] = answer["lost"]
                        waiting.insert(0, (key, request))
                    else:
                        done(key, answer)
                if k not in busy and k not in lost and waiting:
                    moved, busy[k] = True, waiting.pop(0)
                    place.start(busy[k][1])
            if not moved:
                time.sleep(LOOK_EVERY)
        return {}
    finally:
        for place in places:
            place.stop()
