"""What `taisoft run` shows and writes: display options, observers of the frames, the folder of the results."""

import shlex
import sys
import time
from argparse import Namespace
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from taisoft.cli.pictures import names_of, picture_options, slowness
from taisoft.details import DETAILS, QUANTITIES
from taisoft.errors import OutputError, SceneError
from taisoft.nested import to_json
from taisoft.output.folder import CHECKPOINT_NAME, RESULT_FILES, RESULT_FOLDERS, Observer, OutputFolder
from taisoft.output.frame_table import FrameTable
from taisoft.output.nodal_fields import NodalValues
from taisoft.output.picture_files import FRAMES_NAME, VIDEO_NAME, ffmpeg_command, find_ffmpeg, picture_numbers, write_video
from taisoft.output.report import body_records, write_report
from taisoft.output.usd import UsdWriter
from taisoft.output.vtu_files import VTU_NAME, VtuWriter, cut_pvd
from taisoft.records import RunReport
from taisoft.scene.fingerprint import digest
from taisoft.view.annotations import text_missing
from taisoft.view.choices import IN_WINDOW, LAYERS, PLOTS, nodal
from taisoft.view.pictures import PictureOptions, open_pictures
from taisoft.view.plots import Plots
from taisoft.view.sampling import Sampler
from taisoft.view.states import KEPT, STATES_NAME, StateWriter

NO_BALLS = "; nodes that follow a path have no balls, since it may release them"


@dataclass(frozen=True)
class DisplayOptions:
    """window, pictures, usd, vtu: whether there is a window, and what is written to the folder; layers: names, or None for the
    defaults; picture: what pictures show; errors: whether they are estimated. details: names, of steps.csv. slow: film time over
    simulated time. keep: quantities of the states that are kept, none of which means no states; None for those of the run that is
    resumed, else KEPT.
    """

    window: bool
    pictures: bool
    usd: bool
    vtu: bool
    layers: tuple[str, ...] | None
    picture: PictureOptions
    errors: bool
    details: tuple[str, ...]
    slow: float
    keep: tuple[str, ...] | None

    @property
    def in_window(self) -> tuple[str, ...]:
        """Layers of the window."""
        return IN_WINDOW if self.layers is None else self.layers


def display_options(arguments: Namespace, has_window: bool) -> DisplayOptions:
    """Return the requested display options. Raises SceneError for unknown names and for options that nothing would show."""
    pictures = arguments.out is not None and not arguments.no_frames
    layers, plots = names_of("layers", arguments.layers, LAYERS), names_of("plots", arguments.plots, PLOTS) or ()
    details = names_of("details", arguments.details, (*DETAILS, QUANTITIES)) or ()
    keep = names_of("keep", arguments.keep, nodal())
    requested = {"video": arguments.video, "caption": arguments.caption, "plots": bool(plots)}
    requested |= {"size": arguments.size is not None, "view": arguments.view is not None}
    if not has_window:
        requested |= {"layers": layers is not None}
    for option, given in requested.items():
        if given and not pictures:
            raise SceneError(f"--{option} needs --out, the folder to write to, and pictures, so it excludes --no-frames")
    if arguments.about is not None and "pairs" not in details:
        raise SceneError("--about is the point of torques, so it needs --details pairs")
    for option, given in {"vtu": arguments.vtu, "details": details, "keep": keep is not None}.items():
        if given and arguments.out is None:
            raise SceneError(f"--{option} needs --out, the folder to write to")
    errors = arguments.error or arguments.error_mesh is not None
    of_error = {"colour": arguments.colour == "error", "plots": "error" in plots, "keep": "error" in (keep or ())}
    for option, given in of_error.items():
        if given and not errors:
            raise SceneError(f"--{option} error needs --error")
    files, slow, picture = (pictures, not arguments.no_usd, arguments.vtu), slowness(arguments), picture_options(arguments, plots)
    return DisplayOptions(has_window, *files, layers, picture, errors, details, slow, keep)


def check_modelled(shown: DisplayOptions, sim) -> None:
    """Raise SceneError for a layer, plot or detail of a feature that sim does not model."""
    asked = {"layers contacts": "contacts" in (shown.layers or ()), "details pairs": "pairs" in shown.details}
    for option, given in asked.items():
        if given and not sim.plan.on["contact_forces"]:
            raise SceneError(f"--{option}: contact forces are not modelled ({sim.plan.why('contact_forces')})")
    Plots(sim, shown.picture.plots, shown.errors)
    if "fixed_nodes" in (shown.layers or ()) and not sim.plan.on["fixed_nodes"]:
        print(f"taisoft: --layers fixed_nodes: no node is fixed{NO_BALLS * sim.plan.on['moving_nodes']}", file=sys.stderr)


class Observers:
    """Passes every frame to its members; after the first write error the run should end.

    errors: the distinct messages of all OutputErrors; seconds, picture_seconds: wall time spent in the members, and in writers
    of pictures [s], without compiling, as in the wall time of a run.
    """

    def __init__(self) -> None:
        self.members: list[Observer] = []
        self.errors: list[str] = []
        self.seconds = self.picture_seconds = 0.0

    def on_frame(self, sim, index: int, _report) -> None:
        """Pass to Simulator.run. Never raises OutputError, because computed results must still be reported."""
        for member in self.members:
            start, compiled = time.perf_counter(), sim.compile_seconds
            if not self.errors:
                self.guard(member.frame, sim, index)
            seconds = time.perf_counter() - start - (sim.compile_seconds - compiled)
            self.seconds += seconds
            self.picture_seconds += seconds if isinstance(member, StateWriter) and member.members else 0.0

    def flush(self) -> None:
        """Write what waits in the members. Raises OutputError."""
        for member in self.members:
            member.flush()

    def close(self) -> None:
        """Close all members, last first, even if some fail."""
        with ExitStack() as stack:  # closes the others even if one raises another error
            for member in self.members:
                stack.callback(self.guard, member.close)
            self.members = []

    def guard(self, write, *arguments) -> bool:
        """Call write(*arguments) and return whether it succeeded; an OutputError is recorded, not raised."""
        try:
            write(*arguments)
        except OutputError as error:
            if str(error) not in self.errors:
                self.errors.append(str(error))
            return False
        return True


class Recording(Observer):
    """Results of a run in one folder: report.json, steps.csv, checkpoint.npz and, if requested, states, pictures, USD and .vtu.

    resumed: for a resumed run, the `checkpoint`, its `time` [s] and the first `frame`; earlier results in the folder are
    continued. every: simulated time between two checkpoints, which are written at frames [s]; None for one at the end. notes:
    those of the checkpoint of a resumed run. Raises OutputError if the folder cannot be written, or holds results and neither
    overwrite nor resumed is given.
    """

    def __init__(
        self, path: str, overwrite: bool, resumed: dict | None = None, every: float | None = None, notes: dict | None = None
    ):
        self._first = None if resumed is None else resumed["frame"]
        self._folder = OutputFolder(path, overwrite, self._first)
        self.path, self._resumed, self._notes, self._every = Path(path), resumed, notes or {}, every
        self._saved: float | None = None  # simulated time of the last checkpoint, or of the start

    def add_writers(
        self, observers: Observers, sim, name: str, fps: float | None, seconds: float, shown: DisplayOptions, plots: Plots | None
    ) -> None:
        """Add the writers of pictures, USD, .vtu and checkpoints to the observers of a run that ends at `seconds`; name: of its
        scene.

        A resumed run that does not match the earlier files is refused before anything is removed.
        """
        folder, kept, first = self._folder.path, tuple(self._notes.get("keep", KEPT)), self._first or 0
        keep, values = kept if shown.keep is None else shown.keep, NodalValues(sim.scene.bodies, by_step=True)
        if "keep" in self._notes and keep != kept:
            given, before = (",".join(one) or "none" for one in (keep, kept))
            raise OutputError(f"--keep {given}: the run that is resumed keeps {before}, so that all its states are alike")
        if shown.usd:
            numbers = {"fps": fps or 1.0 / sim.dt, "self_collision": sim.settings.self_collision}
            observers.members.append(UsdWriter(folder, sim.scene, **numbers, first=first, errors=shown.errors, values=values))
        if FrameTable.needed(sim.scene):
            observers.members.append(FrameTable(folder, sim.scene, first))
        if self._first is not None:
            cut_pvd(folder, first)
            self._folder.clear(first)
        if shown.vtu:
            observers.members.append(VtuWriter(folder, sim.scene, first, shown.errors))
        sampler, pictures = Sampler(sim.scene, values), []
        look = digest([to_json([asdict(shown.picture), sampler.drawn.looks()])])
        if shown.pictures:
            if self._first is not None and look != self._notes.get("look", look):
                again = f"`taisoft draw {self.path}` draws all of them alike"
                print(f"taisoft: pictures differ in size or look from those before frame {first}: {again}", file=sys.stderr)
            n_pictures = round((seconds - (0.0 if self._resumed is None else self._resumed["time"])) * (fps or 1.0 / sim.dt))
            options = replace(shown.picture, bar=has_bar(shown.picture.colour), kept=self._notes)
            pictures = [open_pictures(folder, sampler.drawn, options, plots, n_pictures)]
        if pictures or keep:
            looks = shown.picture.layers, shown.picture.colour
            observers.members.append(StateWriter(folder, sampler, keep, pictures, looks, name))
        noted = {"fps": fps, "look": look, "keep": list(keep)}
        self._notes_of = lambda: noted | (pictures[0].kept(sim.time) if pictures else {})
        self._flush_others = observers.flush
        observers.members.append(self)

    def frame(self, sim, _index: int) -> None:
        """Write a checkpoint if one is due."""
        if self._saved is None:
            self._saved = sim.time
        elif self._every is not None and sim.time - self._saved >= self._every * (1.0 - 1e-9):
            self._flush_others()  # no file may be older
            self.checkpoint(sim)

    def checkpoint(self, sim) -> None:
        """Write checkpoint.npz. Raises OutputError; the existing one then remains."""
        sim.save_checkpoint(self._folder.path / CHECKPOINT_NAME, self._notes_of())
        self._saved = sim.time

    def video(self, fps: float) -> None:
        """Write video.mp4 from the pictures, as `make_video`. Raises OutputError."""
        make_video(self._folder.path, fps)

    def report(self, result: RunReport, sim, settings: dict) -> None:
        """Write report.json and steps.csv. Raises OutputError."""
        write_report(
            self._folder.path,
            result,
            arch=settings["arch"],
            precision=settings["precision"],
            settings=settings | sim._arguments(),
            plan=sim.plan.entries,
            contact_offset=sim.contact_offset,
            resumed=self._resumed,
            bodies=body_records(sim.scene),
            buffer_growths=sim.buffer_growths,
        )

    def files(self) -> list[str]:
        """Return the contents of the folder: one text per file, and one for each folder of frames."""
        paths = [path for path in (self.path / name for name in RESULT_FILES) if path.is_file()]
        found = [f"{path} ({_size([path])})" for path in paths]
        for name, what in ((FRAMES_NAME, "pictures"), (VTU_NAME, "files"), (STATES_NAME, "files")):
            if files := list((self.path / name).glob(RESULT_FOLDERS[name])):
                found.append(f"{self.path / name}/ ({len(files)} {what}, {_size(files)})")
        return found

    def release(self) -> None:
        """Let others write to the folder."""
        self._folder.close()


def has_bar(colour: str) -> bool:
    """Return whether pictures have a colour bar; print why not if text cannot be drawn."""
    missing = colour != "body" and text_missing()
    if missing:
        print(f"taisoft: pictures have no colour bar: {missing}", file=sys.stderr)
    return colour != "body" and not missing


def make_video(folder: Path, fps: float) -> None:
    """Write folder/video.mp4 from the pictures, or print the command if ffmpeg is missing. Raises OutputError."""
    if not (numbers := picture_numbers(folder)):
        return
    if len(numbers) <= max(numbers) - min(numbers):
        raise OutputError(f"{folder / VIDEO_NAME} cannot be made: pictures are missing between {min(numbers)} and {max(numbers)}")
    if find_ffmpeg() is None:
        line = shlex.join(ffmpeg_command(folder, fps))
        print(f"taisoft: no video without ffmpeg (pip install 'taisoft[video]'); the command is: {line}", file=sys.stderr)
        return
    write_video(folder, fps)


def _size(paths: list[Path]) -> str:
    n_bytes = sum(path.stat().st_size for path in paths)
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e5 else f"{n_bytes / 1e3:.1f} kB"
