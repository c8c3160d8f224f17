"""What SIGINT and SIGTERM mean: the first ends the run after its current batch, a second leaves at once."""

import os
import signal

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(BaseException):
    """A signal came while there was nothing to save, so the command just leaves."""

    def __init__(self, signal_number: int):
        super().__init__(signal_number)
        self.signal_number = signal_number


class Signals:
    """Handles SIGINT and SIGTERM while a command runs; restores the old handlers afterwards.

    `number` is the first signal's number, or None. Until `run_began()` a signal raises Left: there is nothing
    to save yet. After it, `asked()` turns true and the run is expected to end by itself and save what it has.
    ending: what the first signal is answered with.
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
        """From now on the first signal only asks the run to end."""
        self._running = True

    def requested(self) -> bool:
        """True once a signal has asked the run to end."""
        return self.number is not None

    def _handle(self, number: int, _frame) -> None:
        if not self._running:
            raise Interrupted(number)
        if self.number is not None:
            os._exit(128 + number)  # files are published by rename, so leaving here tears none of them
        self.number = number
        # os.write, since print could be interrupted in the middle of its own buffer
        os.write(2, f"\ntaisoft: {self._ending}; a second signal leaves at once\n".encode())
