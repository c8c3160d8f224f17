"""Loop of the live window between pictures: running, stepping, restarting, recording, and measuring the speed.

Each picture advances simulated time by 1/fps [s]. Steps stop once they have taken that much wall time, and the remaining
simulated time is dropped. So the picture stays fluid while the simulation falls behind real time.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError, SimulationError, TaisoftError
from taisoft.files import write_bytes
from taisoft.output.files import make_folder
from taisoft.output.frames import png_bytes
from taisoft.records import StepReport
from taisoft.running import timed_advance
from taisoft.view.plots import Plots

SPEED_WINDOW = 0.5  # wall time over which steps/s is averaged [s]
FIRST_PICTURES = 2  # before the first step, which compiles for seconds; GGUI shows no panel at first
SLOW = 1.1  # wall time over simulated time above which the panel reports a slow solver
OUT = Path("out")


class Loop:
    """Drives sim at fps pictures per second.

    problem: why the run paused; note: the last action; each a sentence or empty. folder: of the pictures while recording, else
    None; plots: records the steps.
    """

    def __init__(self, sim, fps: float, paused: bool, plots: Plots | None = None):
        self.sim, self.fps, self.paused, self._plots = sim, fps, paused, plots
        self.problem = self.note = ""
        self.folder: Path | None = None
        self._compiled = False  # True after a step, since that compiles everything
        self._wait = FIRST_PICTURES  # pictures before the next step
        self._rebuild: Callable[[], bool] | None = None  # requested; called once a picture has shown the note
        self._note_shown = False
        self._frames = 0
        self._time_due = 0.0  # simulated time that steps still have to cover [s]
        self._cost = 0.0  # wall time over simulated time of the steps
        self._spent = [0.0, 0.0]  # wall and simulated time of the steps since the mark [s]
        self._speed = 0.0  # [steps/s]
        self._mark = (time.perf_counter(), sim.step_count)  # start of the present speed measurement

    def request_rebuild(self, build: Callable[[], bool], note: str) -> None:
        """Call build once a picture has shown the note. build: rebuilds the simulator and returns whether it succeeded."""
        self._rebuild, self._note_shown, self.note = build, False, note

    def react(self, pressed: set[str]) -> None:
        """Carry out the actions of keys and buttons."""
        if self._rebuild is not None and self._note_shown:
            build, self._rebuild = self._rebuild, None
            if build():
                self._compiled, self._wait, self._time_due, self._cost, self.problem = False, FIRST_PICTURES, 0.0, 0.0, ""
                self._spent, self._mark = [0.0, 0.0], (time.perf_counter(), self.sim.step_count)
        self._note_shown = self._rebuild is not None
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
        """Advance by one picture's simulated time, or less if that takes more wall time than a picture has."""
        if self._wait > 0 or self._rebuild is not None:
            self._wait -= 1
            return
        self._time_due += 1.0 / self.fps
        end = time.perf_counter() + 1.0 / self.fps
        while self._time_due >= self.sim.dt * (1.0 - 1e-9) and not self.paused:
            before = self.sim.step_count
            n = int(self._time_due / self.sim.dt + 1e-9)
            if self._cost > 0.0:  # in one launch, no more explicit steps than a picture has time for
                n = min(n, int((end - time.perf_counter()) / (self._cost * self.sim.dt) + 0.5))
            self.guarded(lambda n=n: self._advance(max(1, n)))
            self._time_due -= (self.sim.step_count - before) * self.sim.dt
            if time.perf_counter() >= end:
                self._time_due = min(self._time_due, 0.0)

    def _advance(self, n: int) -> None:
        self._wait = 0
        timed_advance(self.sim, n, self._after_step)
        self._compiled = True

    def _after_step(self, report: StepReport, seconds: float) -> None:
        self._spent[0] += seconds
        self._spent[1] += report.steps * self.sim.dt
        if self._plots is not None:
            self._plots.take(report, seconds)

    def guarded(self, call) -> bool:
        """Call a function and return whether it succeeded. If it raises a TaisoftError, pause and set `problem`."""
        try:
            call()
        except TaisoftError as error:
            self.problem = f"failed: {error}" if isinstance(error, SimulationError) else str(error)
            self.paused = True
            return False
        return True

    def speed(self) -> str:
        """Return the steps per second as text."""
        now, steps = time.perf_counter(), self.sim.step_count
        elapsed = now - self._mark[0]
        if elapsed >= SPEED_WINDOW:
            self._speed = (steps - self._mark[1]) / elapsed
            self._mark = (now, steps)
            if self._spent[1] > 0.0:
                self._cost = self._spent[0] / self._spent[1]
            self._spent = [0.0, 0.0]
        return f"speed    {self._speed:10.1f} steps/s"

    def lines(self) -> list[str]:
        """Return the status of the run, and the note if there is one."""
        slow = self._cost > SLOW and not self.paused
        status = f"running; the solver needs {self._cost:.1f} times real time" if slow else "running"
        if not self._compiled:
            status = "compiling the next step, for some seconds"
        return [self.problem or ("paused" if self.paused else status), *([self.note] if self.note else [])]

    # --- recording ----------------------------------------------------------------------------------------------------

    def record(self, picture: np.ndarray) -> None:
        """Write a picture, uint8 (height, width, 3), as the next one in the folder."""
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
