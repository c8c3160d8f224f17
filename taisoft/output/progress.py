"""Progress of a run: on a terminal a bar with steps/s and the remaining time, elsewhere a line every few seconds."""

import sys
import time
from typing import TextIO

LINE_EVERY = 5.0  # time between lines if the stream is not a terminal [s]


class Progress:
    """Observer that shows the progress of a run of `seconds` [s] of simulated time on a stream (stderr by default)."""

    def __init__(self, seconds: float, label: str = "run", stream: TextIO | None = None):
        self.seconds, self.label = seconds, label
        self.stream = sys.stderr if stream is None else stream
        self._started: float | None = None  # wall time of the first frame; construction and compilation come before
        self._first_time = self._last_line = 0.0
        self._first_step = 0
        self._bar = _bar(seconds, label, self.stream) if self.stream.isatty() else None

    def frame(self, sim, index: int) -> None:
        """Show sim.time and the speed since the first frame."""
        now = time.perf_counter()
        if self._started is None:
            self._started, self._first_time, self._first_step = now, sim.time, sim.step_count
            self._last_line = now
        text = self._speed(sim, now - self._started)
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=min(sim.time, self.seconds), note=text)
        elif now - self._last_line >= LINE_EVERY:
            self._last_line = now
            print(f"{self.label}: {sim.time:.3f} of {self.seconds:g} s, {text}", file=self.stream, flush=True)

    def close(self) -> None:
        """Stop the bar; a second call does nothing."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _speed(self, sim, elapsed: float) -> str:
        done = sim.time - self._first_time
        if elapsed <= 0 or done <= 0:
            return "starting"
        rate = (sim.step_count - self._first_step) / elapsed
        left = max(self.seconds - sim.time, 0.0) * elapsed / done
        return f"{rate:.4g} steps/s, {_clock(left)} left"


def _bar(seconds: float, label: str, stream: TextIO):
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TextColumn("{task.completed:.2f} of {task.total:g} s"),
        TextColumn("{task.fields[note]}"),
    )
    bar = Progress(*columns, console=Console(file=stream), refresh_per_second=5, transient=False)
    bar.add_task(label, total=seconds, note="starting")
    bar.start()
    return bar


def _clock(seconds: float) -> str:
    """Format seconds as h:mm:ss or m:ss."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"
