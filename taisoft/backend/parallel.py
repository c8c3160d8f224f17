"""When loops on several CPU threads pay: measured once on each machine, and kept beside the compiled kernels.

Waking the threads costs tens of microseconds a loop, and more cores may be visible than a process gets to use. Results do not
depend on this choice.
"""

import contextlib
import functools
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import taichi as ti

from taisoft.backend.arrays import Array
from taisoft.backend.runtime import cache_folder, kernel, threads
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.machine import processor

FILE = "threads.json"
ROUNDS = 15  # of each measurement; the shortest counts, since a busy machine hides the gain
KEPT_FROM = 1.3  # speed-up that is kept; less may be due to other programs, so it is measured again, later by the next process
TRIALS = 4
TASKS, WORK = 2**15, 30  # of the loop that measures the gain: about 2 ms on one thread
MARGIN = 1.2  # factor on the time a loop must save: the machine may be busier than when it was measured


@dataclass(frozen=True)
class Gain:
    """wake: seconds that a loop takes to start on all threads; speedup: of a long loop over one thread."""

    wake: float
    speedup: float

    @property
    def shortest_loop(self) -> float:
        """Seconds of one thread from which all threads are faster; infinite if they are not."""
        saved = 1.0 - 1.0 / self.speedup
        return MARGIN * self.wake / saved if saved > 0.05 else float("inf")


def pays(seconds: float) -> bool:
    """Whether loops that take one thread this long are faster on all threads."""
    return threads() > 1 and seconds >= gain().shortest_loop


@functools.cache
def gain() -> Gain:
    """Return the measurement of this machine, made now if there is none. Taichi must run on the CPU."""
    path, name = Path(cache_folder()) / FILE, f"{processor()}, {threads()} threads"
    known = _read(path)
    if name in known:
        return Gain(**known[name])
    measured = measure()
    for _ in range(TRIALS - 1):
        if measured.speedup < KEPT_FROM:
            measured = max(measured, measure(), key=lambda one: one.speedup)
    if measured.speedup >= KEPT_FROM:
        with contextlib.suppress(OutputError):  # it is measured again in the next process
            write_bytes(path, json.dumps(_read(path) | {name: asdict(measured)}, indent=1).encode())
    return measured


def _read(path: Path) -> dict[str, dict[str, float]]:
    """The stored measurements; none if the file is absent or unreadable, since they can be repeated."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        gains = {name: Gain(float(one["wake"]), float(one["speedup"])) for name, one in known.items()}
        return {name: asdict(one) for name, one in gains.items() if one.wake >= 0.0 and one.speedup > 0.0}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}


def measure() -> Gain:
    out = Array(ti.f64, (TASKS,), 0, on_host=True)
    one, all_threads, idle = (functools.partial(_work, out, n, serial) for n, serial in ((WORK, True), (WORK, False), (0, False)))
    times = {run: [] for run in (one, all_threads, idle)}
    for run in times:
        run()  # compiles
    for _ in range(ROUNDS):  # in turn, so that a slow moment of the machine affects all
        for run, taken in times.items():
            begin = time.perf_counter()
            run()
            taken.append(time.perf_counter() - begin)
    serial, parallel, wake = (min(taken) for taken in times.values())
    return Gain(wake, min(serial / max(parallel - wake, 1e-9), float(threads())))


@kernel
def _work(out: ti.template(), n: ti.i32, serial: ti.template()):
    """n dependent operations for each entry."""
    ti.loop_config(serialize=serial)
    for i in range(TASKS):
        x = ti.cast(i, ti.f64)
        for _k in range(n):
            x = 0.5 * x + 1.0
        out[i] = x
