"""Python processes that run this version of taisoft, and how a process ended."""

import os
import signal
import subprocess
import sys
from pathlib import Path


def start_python(*arguments: str, environment: dict[str, str] | None = None, **options) -> subprocess.Popen:
    """Start Python with this version of taisoft. environment: further variables; options: of Popen. Raises OSError.

    Without a `stdin` it can read nothing, and a session of its own shields it from the terminal's Ctrl-C.
    """
    folders = (str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH"))
    full = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, folders))} | (environment or {})
    options = {"stdin": subprocess.DEVNULL, "start_new_session": True} | options
    return subprocess.Popen([sys.executable, *arguments], env=full, **options)


def how_it_ended(status: int) -> str:
    """Return a sentence on a process with this return code, negative for a signal."""
    how = f"by signal {signal.Signals(-status).name}" if status < 0 else f"with exit status {status}"
    return f"its process ended {how}"
