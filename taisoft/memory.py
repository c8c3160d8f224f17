"""Memory available to this process, so that requests that do not fit are refused before allocation."""

import os
from contextlib import suppress
from pathlib import Path

# Files with a container's limit, use and statistics, and the statistics' entry of reclaimable cache: cgroups 2 and 1.
_CGROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)


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
