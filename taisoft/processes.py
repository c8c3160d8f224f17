"""Python processes that run this version of taisoft, and how a process ended."""

import os
import signal
from pathlib import Path


def own_environment() -> dict[str, str]:
    """Return the environment for a child process that imports this version of taisoft."""
    folder = str(Path(__file__).resolve().parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (folder, os.environ.get("PYTHONPATH"))))}


def how_it_ended(status: int) -> str:
    """Return a sentence on a process with this return code, negative for a signal."""
    how = f"by signal {signal.Signals(-status).name}" if status < 0 else f"with exit status {status}"
    return f"its process ended {how}"
