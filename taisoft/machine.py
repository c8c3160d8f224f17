"""The machine: its processor and load, times measured on it, and memory.

Times are medians with minimum and spread, since others share the machine. Requests for more memory than this process can get are
refused before allocation.
"""

import os
import platform
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path

import numpy as np

from taisoft import __version__
from taisoft.errors import OutputError, SimulationError, TaisoftError

THREADS, MAX_THREADS = "TAISOFT_THREADS", 1024
PACKAGES = ("taichi", "numpy", "scipy", "usd-core")  # that results depend on


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


def load_average() -> float | None:
    """Mean number of running processes over the last minute, None if the system does not report it."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def machine(named: bool = False) -> dict:
    """Name of the processor, number of cores this process may use, operating system; named: and the machine's name in its net."""
    found = {"processor": processor(), "cores": len(usable_cores()), "system": platform.platform()}
    return found | ({"name": platform.node()} if named else {})


def versions(*packages: str) -> dict[str, str | None]:
    """Version of Python, of taisoft and of each package; None if a package is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version(), "taisoft": __version__}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def usable_cores() -> list[int]:
    """Numbers of the cores that this process may use, ascending; all of them if the system has no CPU affinity."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def thread_count(cores: int) -> int:
    """Number of threads of parallel loops: the environment variable TAISOFT_THREADS, else the number of usable cores.

    Raises SimulationError unless the variable is a whole number from 1 to 1024.
    """
    text = os.environ.get(THREADS, "").strip() or str(cores)
    if not text.isdecimal() or not 1 <= int(text) <= MAX_THREADS:
        raise SimulationError(f"{THREADS} must be the number of threads, a whole number from 1 to {MAX_THREADS}, not {text!r}")
    return int(text)


def processor() -> str:
    """Name of the processor, as reported by the system."""
    info = Path("/proc/cpuinfo")  # platform.processor() is empty on many Linux systems
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


# Files with a container's limit, use and statistics, and the statistics' entry of reclaimable cache: cgroups 2 and 1.
_CGROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)


def peak_memory() -> int | None:
    """Largest resident size of this process so far [bytes]; None if the system does not report it."""
    try:
        import resource
    except ImportError:  # not a POSIX system
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def available_memory() -> int | None:
    """Bytes of main memory that this process can still allocate: free on the machine, and within the limits of the process
    (`ulimit -v`) and its container; None if unknown."""
    mappable = address_space()
    found = [*_machine_available(), *_container_available(), *([] if mappable is None else [mappable])]
    return max(0, min(found)) if found else None


def address_space() -> int | None:
    """Bytes of address space that this process can still map, used or not (`ulimit -v`); None if there is no such limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            return max(0, limit - pages * os.sysconf("SC_PAGE_SIZE"))
    return None


def _machine_available() -> list[int]:
    with suppress(OSError, ValueError):
        rows = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        return [sum(1024 * int(rows.get(name, "0").split()[0]) for name in ("MemAvailable", "SwapFree"))]
    return []


def _container_available(root: Path = Path("/sys/fs/cgroup")) -> list[int]:
    found = []
    for limit, used, statistics, cached in _CGROUPS:
        with suppress(OSError, ValueError):  # "max" if there is no limit
            maximum = int((root / limit).read_text())
            rows = dict(line.split(None, 1) for line in (root / statistics).read_text().splitlines())
            found.append(maximum - int((root / used).read_text()) + int(rows.get(cached, "0")))
    return found


def format_bytes(n_bytes: int | None) -> str:
    """Format a number of bytes for a message, such as "2000000000 bytes (2.00 GB)"."""
    return "unknown" if n_bytes is None else f"{n_bytes} bytes ({n_bytes / 1e9:.2f} GB)"


def require(package: str, what: str, extra: str, error: type[TaisoftError] = OutputError):
    """Return an optional package. what: what needs it. extra: brings it. Raises the error if it is missing."""
    try:
        return import_module(package)
    except ImportError:
        raise error(f"{what} needs the package {package}, which is missing: pip install 'taisoft[{extra}]'") from None
