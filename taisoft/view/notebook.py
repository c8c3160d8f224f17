"""What notebooks show of scenes and simulators, and `Film`, a player of pictures. HTML that needs no network."""

import base64
import html
import json
from pathlib import Path

from taisoft.display import caption
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.picture_files import FRAMES_NAME, png_bytes
from taisoft.output.report import frame_rate
from taisoft.scene.look import Camera
from taisoft.view.colouring import checked_colour
from taisoft.view.drawn import DrawnState
from taisoft.view.offscreen import Offscreen, checked_size

SIZE = (640, 360)  # of pictures in notebooks [pixels]
COMPRESSION = 6  # of their PNGs, which notebooks store
MAX_NODES = 200_000  # of a scene or a simulator that is drawn when it is displayed


def scene_html(scene) -> str | None:
    """Return a picture of a scene at its start, and its repr; None without bodies or above MAX_NODES."""
    return _html(scene, None, "body", scene) if scene.bodies else None


def simulator_html(sim) -> str | None:
    """Return a picture of a simulator's state, coloured by stress, and its repr; None if it is closed, or above MAX_NODES."""
    return _html(sim.scene, sim, "stress", sim) if sim.is_open else None


def _html(scene, sim, colour: str, thing) -> str | None:
    if sum(body.n_nodes for body in scene.bodies) > MAX_NODES:
        return None
    drawing = Offscreen(scene, SIZE, colour=colour)
    png = png_bytes(drawing.image(DrawnState.at_start(drawing.scene) if sim is None else sim), COMPRESSION)
    scale = f"; {drawing.colouring.scale_text}" if colour != "body" else ""
    return f'<img src="{_data_url(png)}" width="{SIZE[0]}" height="{SIZE[1]}"/>{caption(repr(thing) + scale)}'


def _data_url(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def framed(page: str, height: int) -> str:
    """Return a page of HTML in a frame of its own, so that its scripts and styles touch nothing else. height: [pixels]."""
    return f'<iframe srcdoc="{html.escape(page)}" width="100%" height="{height}" style="border: none"></iframe>'


def write_page(path, page: str) -> None:
    """Write a page of HTML, atomically. Raises OutputError for a name without .html, or if it cannot be written."""
    file = Path(path)
    if file.suffix.lower() != ".html":
        raise OutputError(f"{file}: the name of a page must end in .html")
    write_bytes(file, page.encode())


class FramesOnPage:
    """Frames of a run on a page of HTML, which notebooks show and any browser shows without a network.

    colour: as for `Simulator.picture`; height: of the page [pixels]. A subclass has `as_html()`, and is called with a simulator
    to add a frame. Raises OutputError for another colour.
    """

    word = "frames"

    def __init__(self, colour: str, height: int):
        self.colour, self._height = checked_colour(colour), height
        self.times: list[float] = []  #: of the frames [s]
        self.scales: list[str] = []  #: what red means in each of them, empty for own colours and pictures from a disk

    def __len__(self) -> int:
        return len(self.times)

    def __bool__(self) -> bool:
        return True

    def __repr__(self) -> str:
        until = f", t = {self.times[0]:.6g} to {self.times[-1]:.6g} s" if self.times else ""
        return f"{type(self).__name__}({len(self)} {self.word}{until})"

    def save(self, path) -> None:
        """Write the page. Raises OutputError."""
        write_page(path, self.as_html())

    def _repr_html_(self) -> str | None:
        return framed(self.as_html(), self._height) if self.times else None


class Film(FramesOnPage):
    """Pictures of a run, and a player for them in notebooks and static pages.

    `sim.run(seconds, on_frame=film)` adds a picture a frame; `film(sim)` adds one of the present state. size: width and height in
    pixels; colour, camera: as for `Simulator.picture`, on one scale for all pictures. Raises OutputError for another size or
    colour.
    """

    word = "pictures"

    def __init__(self, size: tuple[int, int] = SIZE, colour: str = "stress", camera: Camera | None = None):
        self.size, self._camera = checked_size(size), camera
        super().__init__(colour, self.size[1] + 84)
        self.pngs: list[bytes] = []  #: the pictures
        self._drawing: Offscreen | None = None
        self._scene = None

    @classmethod
    def read(cls, folder, fps: float | None = None) -> "Film":
        """Return the film of the pictures that `taisoft run --out` wrote to a folder.

        fps: frames per simulated second [1/s]; None for that of its report.json. Raises OutputError if there are no pictures.
        """
        folder, film = Path(folder), cls()
        paths = sorted(path for path in (folder / FRAMES_NAME).glob("*.png") if path.stem.isdecimal())
        if not paths:
            raise OutputError(f"{folder / FRAMES_NAME}: there are no pictures of a run")
        try:
            film.pngs = [path.read_bytes() for path in paths]
        except OSError as error:
            raise OutputError(f"{folder}: the run cannot be read: {error}") from None
        fps = fps or frame_rate(folder)
        film.times, film.scales = [int(path.stem) / fps for path in paths], [""] * len(paths)
        return film

    def __call__(self, sim, _index: int = 0, _report=None) -> None:
        """Add a picture of sim's present state."""
        if self._scene is not sim.scene:
            self._drawing, self._scene = Offscreen(sim.scene, self.size, self._camera, self.colour), sim.scene
        self.pngs.append(png_bytes(self._drawing.image(sim), COMPRESSION))
        self.scales.append(self._drawing.colouring.scale_text)
        self.times.append(sim.time)

    def as_html(self) -> str:
        """Return a page with the player. Raises OutputError if there is no picture."""
        if not self.pngs:
            raise OutputError("the film holds no picture: pass it to sim.run(seconds, on_frame=film)")
        numbers = {"times": self.times, "scales": self.scales, "pictures": [_data_url(png) for png in self.pngs]}
        return PLAYER.replace("DATA", json.dumps(numbers))


PLAYER = """<!DOCTYPE html>
<html><head><meta charset="utf-8"><style>
body { margin: 0; font: 13px monospace; } img { display: block; max-width: 100%; }
div { display: flex; gap: 8px; align-items: center; padding: 4px; max-width: 640px; } input { flex: 1; }
</style></head><body><img id="picture" alt="frame of the film">
<div><button id="play" aria-label="play or pause">&#9654;</button>
<input id="at" type="range" min="0" value="0"><span id="time"></span></div><div id="scale"></div>
<script>
const film = DATA, n = film.pictures.length, last = film.times[n - 1], get = id => document.getElementById(id);
const picture = get("picture"), play = get("play"), at = get("at"), time = get("time"), scale = get("scale");
let start = null;  // time of the clock at which the film's first picture was due [ms], null while it stands
at.max = n - 1;
function show(k) {
  at.value = k;
  picture.src = film.pictures[k];
  time.textContent = film.times[k].toFixed(3) + " s";
  scale.textContent = film.scales[k];
}
function stop() { start = null; play.textContent = "\\u25b6"; }
function step(now) {
  if (start === null) return;
  const t = film.times[0] + (now - start) / 1000;
  let k = 0;
  while (k < n - 1 && film.times[k + 1] <= t) k++;
  show(k);
  if (t > last) stop(); else requestAnimationFrame(step);
}
play.onclick = () => {
  if (start !== null) return stop();
  const k = +at.value === n - 1 ? 0 : +at.value;
  start = performance.now() - 1000 * (film.times[k] - film.times[0]);
  play.textContent = "||";
  requestAnimationFrame(step);
};
at.oninput = () => { stop(); show(+at.value); };
show(0);
</script></body></html>
"""
