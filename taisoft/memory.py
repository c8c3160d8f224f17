"""How much memory this process can still have, so that what does not fit is refused before it is asked for."""

import os
from contextlib import suppress
from pathlib import Path

# Files of a container's limit, use, and statistics with the name of what is only cached there: cgroups 2 and 1.
_CGROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)


def available_memory() -> int | None:
    """Bytes of main memory that this process can still have: free on the machine, and within the limits set for the process
    (`ulimit -v`) and its container; None where the system does not tell."""
    room = address_space()
    found = [*_of_machine(), *_of_container(), *([] if room is None else [room])]
    return max(0, min(found)) if found else None


def address_space() -> int | None:
    """Bytes of addresses that this process can still map, used or not (`ulimit -v`); None where there is no such limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            return max(0, limit - pages * os.sysconf("SC_PAGE_SIZE"))
    return None


def _of_machine() -> list[int]:
    with suppress(OSError, ValueError):
        rows = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        return [sum(1024 * int(rows.get(name, "0").split()[0]) for name in ("MemAvailable", "SwapFree"))]
    return []


def _of_container(root: Path = Path("/sys/fs/cgroup")) -> list[int]:
    found = []
    for limit, used, statistics, cached in _CGROUPS:
        with suppress(OSError, ValueError):  # "max" where there is no limit
            most = int((root / limit).read_text())
            rows = dict(line.split(None, 1) for line in (root / statistics).read_text().splitlines())
            found.append(most - int((root / used).read_text()) + int(rows.get(cached, "0")))
    return found


def format_bytes(n_bytes: int | None) -> str:
    """A number of bytes for a message, such as "2000000000 bytes (2.00 GB)"."""
    return "unknown" if n_bytes is None else f"{n_bytes} bytes ({n_bytes / 1e9:.2f} GB)"
