"""Messages on stderr while kernels are compiled: whole lines only, so that they do not mix with other output."""

import contextlib
import sys
import time
from collections.abc import Iterator

MESSAGE = "taisoft: compiling kernels for this kind of scene, once (about 20 s)"
COMPILED_ABOVE = 0.1  # [s] in the compiler: loading a kernel from the cache on disk takes at most 0.03 s
COMPILER_FRACTION = 0.5  # of a first launch: at least 0.7 when compiling, at most 0.2 when loading, on any machine
LINE_EVERY = 5.0  # [s] between lines with the number of compiled kernels
last_line: float | None = None  # when the last line was written [s], None before the first
is_silent = False


def show(compiler: float, launch: float, n_compiled: int) -> None:
    """Report a first launch if its kernel was compiled, not loaded from disk.

    compiler: time in the compiler [s]; launch: time of the whole launch [s]; n_compiled: kernels compiled so far.
    """
    global last_line
    if is_silent or compiler < COMPILED_ABOVE or compiler < COMPILER_FRACTION * launch:
        return
    now = time.perf_counter()
    if last_line is None:
        _write(MESSAGE)
    elif now - last_line >= LINE_EVERY:
        _write(f"taisoft: {n_compiled} kernels so far")
    else:
        return
    last_line = now


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress the messages, for a caller that reports the kernels itself."""
    global is_silent
    before, is_silent = is_silent, True
    try:
        yield
    finally:
        is_silent = before


def _write(line: str) -> None:
    """Write to stderr if there is one, ignoring errors."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):  # stderr is closed, or its reader has exited
            print(line, file=sys.stderr, flush=True)
