"""What the live window does between two pictures: running, stepping, restarting, recording, and how fast it goes.

Steps follow a clock of 1/fps [s] a picture, and a picture comes at the latest when steps have taken that long: what is then
missing is let go, so the picture stays fluid while the simulation falls behind real time.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError, SimulationError, TaisoftError
from taisoft.output.files import make_folder, write_bytes
from taisoft.output.frames import png_bytes
from taisoft.records import StepReport
from taisoft.running import timed_advance
from taisoft.view.plots import Plots

SPEED_OVER = 0.5  # [s] of wall time that steps/s is averaged over
FIRST_PICTURES = 2  # without a step, which compiles for seconds: GGUI shows no panel at first
BEHIND = 1.1  # times real time above which the panel says so
OUT = Path("out")


class Loop:
    """Drives sim at fps pictures a second; `problem` is why it paused, `note` what it did, each a sentence or empty.

    folder: where pictures go while it records, else None; plots: what keeps what steps tell.
    """

    def __init__(self, sim, fps: float, paused: bool, plots: Plots | None = None):
        self.sim, self.fps, self.paused, self._plots = sim, fps, paused, plots
        self.problem = self.note = ""
        self.folder: Path | None = None
        self._begun = False  # a step was taken, so all is compiled
        self._wait = FIRST_PICTURES  # pictures before the next step
        self._asked: Callable[[], bool] | None = None  # what is to be done once a picture has told of it
        self._told = False
        self._frames = 0
        self._owed = 0.0  # [s] of simulated time since the last step
        self._needs = 0.0  # wall time of a simulated second [s]
        self._spent = [0.0, 0.0]  # wall and simulated [s] since the mark
        self._speed = 0.0  # [steps/s]
        self._mark = (time.perf_counter(), sim.step_count)

    def ask(self, build: Callable[[], bool], note: str) -> None:
        """Have a simulator built anew, once a picture has shown the note; build: says whether it was."""
        self._asked, self._told, self.note = build, False, note

    def react(self, pressed: set[str]) -> None:
        """Do what keys and buttons ask for."""
        if self._asked is not None and self._told:
            build, self._asked = self._asked, None
            if build():
                self._begun, self._wait, self._owed, self._needs, self.problem = False, FIRST_PICTURES, 0.0, 0.0, ""
                self._spent, self._mark = [0.0, 0.0], (time.perf_counter(), self.sim.step_count)
        self._told = self._asked is not None
        if "pause" in pressed:
            self.paused = not self.paused
            self.problem = ""
        if "reset" in pressed:
            self.sim.reset()
            if self._plots is not None:
                self._plots.restart()
            self.problem = ""
            self._mark = (time.perf_counter(), self.sim.step_count)
        if "step" in pressed:
            self.paused = True
            self.guarded(lambda: self._advance(1))
        if "record" in pressed:
            self._toggle_recording()

    def advance(self) -> None:
        """One picture's worth of simulated time, or less where that takes longer than a picture may."""
        if self._wait > 0 or self._asked is not None:
            self._wait -= 1
            return
        self._owed += 1.0 / self.fps
        end = time.perf_counter() + 1.0 / self.fps
        while self._owed >= self.sim.dt * (1.0 - 1e-9) and not self.paused:
            before = self.sim.step_count
            n = int(self._owed / self.sim.dt + 1e-9)
            if self._needs > 0.0:  # of many explicit steps in one launch no more than a picture has time for
                n = min(n, int((end - time.perf_counter()) / (self._needs * self.sim.dt) + 0.5))
            self.guarded(lambda n=n: self._advance(max(1, n)))
            self._owed -= (self.sim.step_count - before) * self.sim.dt
            if time.perf_counter() >= end:
                self._owed = min(self._owed, 0.0)

    def _advance(self, n: int) -> None:
        self._wait = 0
        timed_advance(self.sim, n, self._took)
        self._begun = True

    def _took(self, report: StepReport, seconds: float) -> None:
        self._spent[0] += seconds
        self._spent[1] += report.steps * self.sim.dt
        if self._plots is not None:
            self._plots.take(report, seconds)

    def guarded(self, call) -> bool:
        """Whether it went well; else the run pauses and `problem` says why."""
        try:
            call()
        except TaisoftError as error:
            self.problem = f"failed: {error}" if isinstance(error, SimulationError) else str(error)
            self.paused = True
            return False
        return True

    def speed(self) -> str:
        """Steps per second as text."""
        now, steps = time.perf_counter(), self.sim.step_count
        since = now - self._mark[0]
        if since >= SPEED_OVER:
            self._speed = (steps - self._mark[1]) / since
            self._mark = (now, steps)
            if self._spent[1] > 0.0:
                self._needs = self._spent[0] / self._spent[1]
            self._spent = [0.0, 0.0]
        return f"speed    {self._speed:10.1f} steps/s"

    def lines(self) -> list[str]:
        """What there is to tell, in sentences."""
        slow = self._needs > BEHIND and not self.paused
        pace = f"running; the solver needs {self._needs:.1f} times real time" if slow else "running"
        if not self._begun:
            pace = "the next step is compiled, for some seconds"
        return [self.problem or ("paused" if self.paused else pace), *([self.note] if self.note else [])]

    # --- recording ----------------------------------------------------------------------------------------------------

    def record(self, picture: np.ndarray) -> None:
        """Write a picture, uint8 (height, width, 3), as the next one of the folder."""
        try:
            write_bytes(self.folder / f"{self._frames:05d}.png", png_bytes(picture))
        except OutputError as error:
            self.folder, self.note = None, str(error)
            return
        self._frames += 1
        self.note = f"recording: {self._frames} pictures in {self.folder}"

    def _toggle_recording(self) -> None:
        if self.folder is not None:
            self.folder, self.note = None, f"recorded {self._frames} pictures in {self.folder}"
            return
        n = 1
        while (OUT / f"window-{n}").exists():
            n += 1
        try:
            self.folder, self._frames = make_folder(OUT / f"window-{n}"), 0
        except OutputError as error:
            self.note = str(error)
