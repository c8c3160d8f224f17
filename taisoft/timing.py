"""Timing on a shared machine: median with minimum and spread, and the machine's load."""

import os
import platform
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Times of several repeats [s]. `spread` is the interquartile range over the median."""

    median: float
    minimum: float
    maximum: float
    spread: float
    repeats: int


def summarise(seconds: Iterable[float]) -> Timing:
    """Timing of the repeats `seconds` (k,) [s]. Raises ValueError if there are none."""
    seconds = np.asarray(list(seconds), float)
    if len(seconds) == 0:
        raise ValueError("a timing needs at least one repeat")
    low, median, high = np.percentile(seconds, (25, 50, 75))
    return Timing(float(median), float(seconds.min()), float(seconds.max()), float((high - low) / median), len(seconds))


def time_repeats(call: Callable[[], object], repeats: int) -> Timing:
    """Time `call()` the given number of times. Warm-up is left to the caller."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return summarise(seconds)


def load_average() -> float | None:
    """Mean number of running processes over the last minute, None if the system does not report it."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def machine() -> dict:
    """Processor name, number of cores this process may use, operating system and present load."""
    return {"processor": processor(), "cores": len(usable_cores()), "system": platform.platform(), "load": load_average()}


def versions(*packages: str) -> dict[str, str | None]:
    """Version of Python and of each package; None if a package is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def usable_cores() -> list[int]:
    """Numbers of the cores that this process may use, ascending; all of them if the system has no CPU affinity."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def processor() -> str:
    """Name of the processor, as reported by the system."""
    info = Path("/proc/cpuinfo")  # platform.processor() is empty on many Linux systems
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
