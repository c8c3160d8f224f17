"""Output of `taisoft run`: its observers and the folder of its results."""

import shlex
import sys
import time
from pathlib import Path

from taisoft.cli.pictures import DisplayOptions
from taisoft.cli.settings import RunSettings
from taisoft.errors import OutputError
from taisoft.output.files import RESULT_FILES, CheckpointWriter, OutputFolder
from taisoft.output.frames import FRAMES_NAME, FrameWriter, ffmpeg_command, find_ffmpeg, picture_numbers, write_video
from taisoft.output.report import body_records, write_report
from taisoft.output.usd import UsdWriter
from taisoft.records import RunReport
from taisoft.view.offscreen import Offscreen
from taisoft.view.plots import Plots


class Observers:
    """Passes every frame to its members; after the first write error the run should end.

    errors: the distinct messages of all OutputErrors; seconds: wall time spent in the members [s], without compiling, as in
    the wall time of a run. A member has frame(sim, index) and close().
    """

    def __init__(self) -> None:
        self.members: list = []
        self.errors: list[str] = []
        self.seconds = 0.0

    def on_frame(self, sim, index: int, _report) -> None:
        """Pass to Simulator.run. Never raises OutputError, because computed results must still be reported."""
        start, compiled = time.perf_counter(), sim.compile_seconds
        for member in self.members:
            if not self.errors:
                self.guard(member.frame, sim, index)
        self.seconds += time.perf_counter() - start - (sim.compile_seconds - compiled)

    def failed(self) -> bool:
        """Return whether something could not be written."""
        return bool(self.errors)

    def close(self) -> None:
        """Close all members, last first, even if some fail."""
        while self.members:
            self.guard(self.members.pop().close)

    def guard(self, write, *arguments) -> bool:
        """Call write(*arguments) and return whether it succeeded; an OutputError is recorded, not raised."""
        try:
            write(*arguments)
        except OutputError as error:
            if str(error) not in self.errors:
                self.errors.append(str(error))
            return False
        return True


class Recording:
    """Results of a run in one folder: report.json, steps.csv, checkpoint.npz and, if requested, frames/ and scene.usdc.

    resumed: for a resumed run, the `checkpoint`, its `time` [s] and the first `frame`; earlier results in the folder are
    continued. every: simulated time between two checkpoints [s]; None for one at the end. notes: those of the checkpoint of
    a resumed run. Raises OutputError if the folder cannot be written, or holds results and neither overwrite nor resumed is
    given.
    """

    def __init__(
        self, path: str, overwrite: bool, resumed: dict | None = None, every: float | None = None, notes: dict | None = None
    ):
        self._first = None if resumed is None else resumed["frame"]
        self._folder = OutputFolder(path, overwrite, self._first)
        self.path, self._resumed, self._notes = Path(path), resumed, notes or {}
        self._checkpoints = CheckpointWriter(self._folder.path, every, None if resumed is None else resumed["checkpoint"])

    def add_writers(
        self,
        observers: Observers,
        sim,
        fps: float | None,
        with_usd: bool,
        with_frames: bool,
        shown: DisplayOptions,
        plots: Plots | None,
    ) -> None:
        """Add the writers of frames, USD and checkpoints to the observers.

        A resumed run that does not match the earlier USD file is refused before anything is removed.
        """
        rate = fps or 1.0 / sim.dt
        if with_usd:
            folder, self_collision = self._folder.path, sim.settings.self_collision
            usd = UsdWriter(folder, sim.scene, fps=rate, self_collision=self_collision, first=self._first or 0)
            observers.members.append(usd)
            self._checkpoints.before = usd.flush
        if self._first is not None:
            self._folder.clear(self._first)
        drawing = None
        if with_frames:
            drawing = Offscreen(sim.scene, colour=shown.colour, layers=shown.in_pictures)
            drawing.resume(self._notes.get("camera"))
            observers.members.append(FrameWriter(self._folder.path, drawing, shown.annotate(plots, drawing.colouring)))
        self._checkpoints.notes = lambda: {"fps": fps, "camera": drawing.camera.distance if drawing else None}
        observers.members.append(self._checkpoints)

    def checkpoint(self, sim) -> None:
        """Write checkpoint.npz. Raises OutputError."""
        self._checkpoints.write(sim)

    def video(self, fps: float) -> None:
        """Write video.mp4 from the pictures, or print the command if ffmpeg is missing. Raises OutputError."""
        folder = self._folder.path
        if not picture_numbers(folder):
            return
        if find_ffmpeg() is None:
            line = shlex.join(ffmpeg_command(folder, fps))
            print(f"taisoft: no video without ffmpeg (pip install 'taisoft[video]'); the command is: {line}", file=sys.stderr)
            return
        write_video(folder, fps)

    def report(self, result: RunReport, sim, settings: RunSettings) -> None:
        """Write report.json and steps.csv, and remove files left by an earlier run. Raises OutputError."""
        record = settings.as_dict() | {"dt": sim.dt}
        write_report(
            self._folder.path,
            result,
            arch=record["arch"],
            precision=record["precision"],
            settings=record,
            plan=sim.plan.entries,
            resumed=self._resumed,
            bodies=body_records(sim.scene),
            buffer_growths=sim.buffer_growths,
        )
        self._folder.discard_stale()

    def files(self) -> list[str]:
        """Return the contents of the folder: one text per file and one for all pictures."""
        paths = [path for path in (self.path / name for name in RESULT_FILES) if path.is_file()]
        found = [f"{path} ({_size(path.stat().st_size)})" for path in paths]
        pictures = list((self.path / FRAMES_NAME).glob("*.png"))
        if pictures:
            size = _size(sum(path.stat().st_size for path in pictures))
            found.append(f"{self.path / FRAMES_NAME}/ ({len(pictures)} pictures, {size})")
        return found

    def close(self) -> None:
        """Release the folder."""
        self._folder.close()


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e5 else f"{n_bytes / 1e3:.1f} kB"
