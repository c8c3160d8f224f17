"""Files of frames written in a thread, so that the simulation goes on meanwhile."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from taisoft.errors import OutputError, reason

WAITING = 8  # files that are not written yet, such as pictures of 2.8 MB each at 1280 x 720


class BackgroundWriter:
    """Writes files one after the other in a thread; where WAITING wait, `write` waits too.

    What fails, for whatever reason, raises OutputError at the next call; later files are not written.
    """

    def __init__(self) -> None:
        self._pool, self._pending = ThreadPoolExecutor(1, "frames"), deque[Future]()
        self._error: OutputError | None = None
        self.closed = False

    def write(self, path: Path, write: Callable, *arguments) -> None:
        """Call write(path, *arguments) in the thread. Raises OutputError for an earlier file."""
        self._wait(WAITING)
        self._pending.append(self._pool.submit(self._written, path, write, arguments))

    def _written(self, path: Path, write: Callable, arguments: tuple) -> None:
        try:
            if self._error is None:
                write(path, *arguments)
        except OutputError as error:  # raised by the caller of the next method
            self._error = error
        except Exception as error:
            self._error = OutputError(f"cannot write {path}: {reason(error)}")
            self._error.__cause__ = error

    def _wait(self, most: int) -> None:
        while len(self._pending) > most:
            self._pending.popleft().result()
        if self._error is not None:
            raise self._error

    def flush(self) -> None:
        """Wait until all files are written. Raises OutputError."""
        self._wait(0)

    def close(self) -> None:
        """Write the files that wait, and end the thread; a second call does nothing. Raises OutputError."""
        if not self.closed:
            self.closed = True
            self._pool.shutdown()
            self.flush()
