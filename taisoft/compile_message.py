"""Says on stderr that kernels are being compiled: whole lines only, so that they mix with no other output."""

import contextlib
import sys
import time
from collections.abc import Iterator

MESSAGE = "taisoft: compiling kernels for this kind of scene, once (about 20 s)"
COMPILED_ABOVE = 0.1  # [s] in the compiler: loading a kernel from the cache on disk takes at most 0.03 s
COMPILER_SHARE = 0.5  # of a first launch: 0.7 and more when compiling, 0.2 at most when loading, however slow the machine is
LINE_EVERY = 5.0  # [s] between lines that tell how many kernels are done
_last_line: float | None = None  # when the last line was written [s], None before the first
_is_silent = False


def show(compiler: float, launch: float, n_compiled: int) -> None:
    """Report a first launch where its kernel was compiled, not loaded from disk.

    compiler: time spent in the compiler [s]; launch: in all of the launch [s]; n_compiled: kernels of this process so far.
    """
    global _last_line
    if _is_silent or compiler < COMPILED_ABOVE or compiler < COMPILER_SHARE * launch:
        return
    now = time.perf_counter()
    if _last_line is None:
        _write(MESSAGE)
    elif now - _last_line >= LINE_EVERY:
        _write(f"taisoft: {n_compiled} kernels so far")
    else:
        return
    _last_line = now


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Nothing is said inside, where the caller tells of the kernels itself."""
    global _is_silent
    _is_silent = True
    try:
        yield
    finally:
        _is_silent = False


def _write(line: str) -> None:
    """To stderr, where there is one: a message is not worth an error."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):  # closed, or its reader has gone
            print(line, file=sys.stderr, flush=True)
