"""Pictures of a run: drawn in a process of their own where that saves time, else between the steps.

In `taisoft.view.picture_process` drawing, coding and writing overlap with the next steps. The simulation then only hands over its
state, over the link of the live window, and waits only if SLOTS states are not drawn yet. Both ways write the same bytes.
"""

import os
import threading
from dataclasses import asdict, dataclass, field
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.machine import usable_cores
from taisoft.output.folder import make_folder
from taisoft.output.picture_files import FRAMES_NAME, FrameWriter
from taisoft.view.annotations import Annotations
from taisoft.view.choices import IN_PICTURES
from taisoft.view.drawn import DrawnScene, DrawnState
from taisoft.view.link import Viewer
from taisoft.view.offscreen import SIZE, Offscreen
from taisoft.view.plots import PlotChoice, Plots, plain_history

SLOTS = 8  # states that wait to be drawn, besides the pictures that wait to be written
MIN_PICTURES = 30  # fewer take less time than it takes to start a process
CHILD = ("-P", "-m", "taisoft.view.picture_process")
FAILURE = "the drawing of pictures failed"


@dataclass(frozen=True)
class PictureOptions:
    """What pictures show, as plain data.

    size: width and height [pixels]; colour, layers: as for `Offscreen`; plots: names of those drawn; caption: the scene's name,
    or None for no caption; bar: whether there is a colour bar, for a colour other than "body"; kept: what an earlier run kept;
    view: azimuth and elevation [deg], None for those of `Viewpoint`.
    """

    size: tuple[int, int] = SIZE
    colour: str = "body"
    layers: tuple[str, ...] = IN_PICTURES
    plots: tuple[str, ...] = ()
    caption: str | None = None
    bar: bool = False
    kept: dict = field(default_factory=dict)
    view: tuple[float, float] | None = None


def picture_writer(folder: Path, scene: DrawnScene, options: PictureOptions, plots: PlotChoice | None = None) -> FrameWriter:
    """Return a `FrameWriter` that draws in this process. plots: history of options.plots. Raises OutputError."""
    drawing = Offscreen(scene, options.size, colour=options.colour, layers=tuple(options.layers))
    if options.view is not None:
        drawing.look_from(options.size, azimuth=options.view[0], elevation=options.view[1])
    drawing.resume(options.kept)
    annotate = None
    if options.plots or options.caption is not None or options.bar:
        annotate = Annotations(plots if options.plots else None, options.caption, drawing.colouring if options.bar else None).draw
    return FrameWriter(folder, drawing, annotate)


def open_pictures(
    folder: Path, scene: DrawnScene, options: PictureOptions, plots: Plots | None, n_pictures: int
) -> "FrameWriter | PictureProcess":
    """Return what writes about n_pictures of states; with a single core, or few pictures, it draws in this process.

    Both have `frame`, `flush`, `close` and `kept`. Raises OutputError.
    """
    if n_pictures < MIN_PICTURES or len(usable_cores()) < 2:
        return picture_writer(folder, scene, options, plots)
    return PictureProcess(folder, scene, options, plots)


class PictureProcess(Viewer):
    """The caller's side of the process that writes folder/frames/<index>.png of states.

    plots: history of options.plots; child: arguments of Python that start the process, if not CHILD. What fails in the other
    process, and its end, raises OutputError at the next `frame`, `flush` or `close`; later pictures are not written. Raises
    OutputError.
    """

    def __init__(
        self,
        folder: str | Path,
        scene: DrawnScene,
        options: PictureOptions,
        plots: Plots | None = None,
        child: tuple[str, ...] | None = None,
    ):
        self.folder = make_folder(Path(folder) / FRAMES_NAME).absolute()
        self._options, self._plots = options, plots if options.plots else None
        self._sent = self._drawn = 0  # numbers of states
        self._closed, self._flushed = False, True
        self._drawn_at, self._kept = None, [options.kept, options.kept]  # time of the last picture [s]; before it, and after it
        description = {"options": asdict(options), "folder": str(self.folder.parent), "caller": os.getpid()}
        description |= {"enabled": self._plots.enabled if self._plots else {}}
        super().__init__(child or CHILD, scene, description, FAILURE, SLOTS)

    def frame(self, state: DrawnState, index: int) -> None:
        """Hand over a state, to be drawn as picture number index. Raises OutputError."""
        if self._closed:
            raise OutputError(f"picture {index} cannot be written to {self.folder}: its writer is closed")
        while self._take(0.0):
            pass
        while self._sent - self._drawn >= SLOTS:
            self._take(None)
        slot = self._sent % SLOTS
        message = {"state": self.nodes.put(state, self._options.colour, slot), "slot": slot, "index": index}
        if self._plots is not None:
            message |= {"enabled": self._plots.enabled, "history": plain_history(self._plots.history)}
        self._sent += 1
        self.send(message)

    def flush(self) -> None:
        """Wait until all pictures are written. Raises OutputError."""
        if not self._closed:
            self._flushed = False
            self.send({"flush": True})
            while not self._flushed:
                self._take(None)

    def kept(self, time: float) -> dict:
        """Return, after a flush, what pictures from time [s] on depend on, as `Offscreen.kept`."""
        return self._kept[0 if time == self._drawn_at else 1]

    def close(self) -> None:
        """Write the pictures that wait, and end the process; a second call does nothing. Raises OutputError."""
        if not self._closed:
            try:
                self.flush()
            finally:
                self._closed = True
                threading.Thread(target=super().close, name="end of pictures").start()  # which takes a fifth of a second

    def _take(self, timeout: float | None) -> bool:
        """Read the next message and return whether there was one; wait up to a time [s], or without limit for None."""
        message = self.read(timeout)
        if message is None:
            return False
        if "drawn" in message:
            self._drawn += 1
            self._drawn_at, self._kept = message["drawn"], message["kept"]
        self._flushed |= "flushed" in message
        return True
