"""Handling of SIGINT and SIGTERM: the first ends the run after its current batch, a second exits immediately."""

import os
import signal

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(BaseException):
    """A signal arrived when there was nothing to save, so the command just exits."""

    def __init__(self, signal_number: int):
        super().__init__(signal_number)
        self.signal_number = signal_number


class Signals:
    """Handles SIGINT and SIGTERM while a command runs; restores the old handlers afterwards.

    `number` is the first signal's number, or None. Before `run_began()` a signal raises Interrupted, because there is
    nothing to save yet. After it, a signal makes `requested()` return True, and the run should end and save its results.
    ending: message printed at the first signal.
    """

    def __init__(self, ending: str = "ending after the current step and saving") -> None:
        self._ending = ending
        self.number: int | None = None
        self._running = False
        self._old_handlers: dict = {}

    def __enter__(self) -> "Signals":
        self._old_handlers = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)

    def run_began(self) -> None:
        """Make the first signal only request the run to end."""
        self._running = True

    def requested(self) -> bool:
        """Return whether a signal has requested the run to end."""
        return self.number is not None

    def _handle(self, number: int, _frame) -> None:
        if not self._running:
            raise Interrupted(number)
        if self.number is not None:
            os._exit(128 + number)  # files are written by rename, so exiting here leaves none incomplete
        self.number = number
        # os.write, because print is not reentrant
        os.write(2, f"\ntaisoft: {self._ending}; a second signal exits immediately\n".encode())
