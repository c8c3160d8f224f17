"""The live window: shows a running simulation, with mouse, keys and a panel to view and change it.

The left button drags the body under the cursor, and orbits elsewhere or with Ctrl; the right one zooms, the middle one pans.
Space: pause or continue. S or right arrow: one step. R: back to the initial state. V: other colours. W, C, T, F: wires, contacts,
tractions, fixed nodes. G: plots over time. P: record pictures. Escape or the close button: quit. Sliders and buttons are in the
panel, see `taisoft.view.controls`.

Each picture advances simulated time by 1/fps [s]. Steps stop once they have taken that much wall time, and the remaining
simulated time is dropped. So the picture stays fluid while the simulation falls behind real time.
"""

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import taichi as ti

from taisoft.errors import OutputError, SimulationError, TaisoftError
from taisoft.files import write_bytes
from taisoft.output.files import make_folder
from taisoft.output.frames import png_bytes
from taisoft.records import StepReport
from taisoft.running import timed_advance
from taisoft.view.annotations import PlotOverlay
from taisoft.view.colouring import BACKGROUND_TOP
from taisoft.view.controls import MouseDrag, Panel, pick
from taisoft.view.ggui import Canvas
from taisoft.view.plots import ENERGIES, Plots
from taisoft.view.scene_view import IN_FRONT, IN_WINDOW, SceneView

SIZE = (1280, 720)
PANEL = (0.012, 0.02, 0.27, 0.94)  # left, top, width, height as fractions of the window's initial size
SHORT_PANEL = (0.012, 0.02, 0.27, 0.24)  # of a window without sliders
ORBIT = 240.0  # angle for a drag over the whole window [deg]
ZOOM = 16.0  # factor on the distance for a drag over the whole window
DRAG_COLOUR = np.array([0.85, 0.10, 0.35])  # sRGB
SPEED_WINDOW = 0.5  # wall time over which steps/s is averaged [s]
FIRST_PICTURES = 2  # before the first step, which compiles for seconds; GGUI shows no panel at first
SLOW = 1.1  # wall time over simulated time above which the panel reports a slow solver
OUT = Path("out")
KEYS = {ti.ui.SPACE: "pause", "s": "step", ti.ui.RIGHT: "step", "r": "reset", "p": "record", "v": "colour", ti.ui.ESCAPE: "close"}
KEYS |= {"w": "wires", "c": "contacts", "t": "tractions", "f": "fixed_nodes", "g": "plots"}


class LiveWindow(SceneView):
    """A window that shows a scene; also an observer, with `frame` and `close`, for `Simulator.run`.

    scene, colour, layers: as for `SceneView`; the user may change colours and layers, and move the camera, which then follows the
    bodies no more. tall: make room for sliders in the panel; plots: those that can be shown. `pressed` holds the actions, values
    of KEYS, requested by keys up to the last draw. Raises OutputError, before anything is opened, if a display or a Vulkan driver
    is missing or the process has a window already.
    """

    def __init__(self, scene, plots: Plots, tall: bool = False, colour: str = "body", layers: tuple[str, ...] = IN_WINDOW):
        super().__init__(scene, SIZE, None, colour, layers)
        self._overlay = PlotOverlay(plots, SIZE)
        self._canvas = Canvas(self.surfaces, SIZE, visible=True, n_segments=self.layers.n_segments + 1)
        self._panel_rectangle = PANEL if tall else SHORT_PANEL
        # GGUI positions the panel once, by the window's size at that time, and does not report where the user moves it
        self._panel_pixels = tuple(f * n for f, n in zip(self._panel_rectangle, (*SIZE, *SIZE)))
        self._cursor: tuple[float, float] | None = None  # at the last picture
        self._mode = ""  # of the present mouse drag: "turn", "zoom", "shift", "drag", or "panel", which GGUI handles
        self._recorded_size: tuple[int, int] | None = None  # of the last recorded picture
        self._close_requested = False
        self.drag: MouseDrag | None = None
        self.pressed: set[str] = set()

    @property
    def closed(self) -> bool:
        """Whether the user has closed the window, or `close` was called."""
        return self._close_requested or self._canvas.window is None or not self._canvas.window.running

    def draw(self, sim, lines: list[str], panel: Panel | None = None, record=None) -> None:
        """Draw sim's present state with a panel of text lines, show it, and process keys and mouse.

        panel: sliders and buttons below the lines; record: called with the picture, uint8 (height, width, 3), without the panel.
        """
        window = self._canvas.window
        size = window.get_window_shape()
        x, colours, (ends, line_colours) = self._drawn(sim, size)
        if self.drag is not None:
            dragged = self.camera.nearer(self.drag.line(sim), IN_FRONT)
            ends = np.concatenate([dragged, ends])
            line_colours = np.concatenate([np.tile(DRAG_COLOUR, (2, 1)), line_colours])
        self._canvas.draw(x, colours, self.camera, tuple(BACKGROUND_TOP), (ends, line_colours))
        # GGUI shows an empty window after a picture was taken of it at another size than the present one
        if record is not None or self._recorded_size not in (None, size):
            picture = self._canvas.pixels(0, 0, *size)  # before the panel is declared, which would else be in the picture
            self._recorded_size = size
            if record is not None:
                record(picture)
        self._overlay.draw(self._canvas, window.get_gui(), size)
        # lines above the sliders must be constant in number: a transient line would move the sliders under the cursor
        with window.get_gui().sub_window("taisoft", *self._panel_rectangle) as gui:
            for line in lines:
                gui.text(line)
            if panel is not None:
                panel.draw(gui)
        window.show()
        self._read_keys()
        self._read_mouse(sim, panel)

    def frame(self, sim, index: int) -> None:
        """Show a frame of a run; does nothing once closed."""
        if not self.closed:
            self.draw(sim, [f"frame {index}", *state_lines(sim)])

    def close(self) -> None:
        """Destroy the window; a second call does nothing."""
        self._canvas.close()

    def _read_keys(self) -> None:
        events = self._canvas.window.get_events(ti.ui.PRESS)
        self.pressed = {KEYS[event.key] for event in events if event.key in KEYS}
        for name in self.pressed & set(self.layers.shown):
            self.layers.shown[name] = not self.layers.shown[name]
        if "plots" in self.pressed:
            self._overlay.plots.toggle()
        if "colour" in self.pressed:
            self.colouring.choose_next()
        self._close_requested |= "close" in self.pressed

    def _read_mouse(self, sim, panel: Panel | None) -> None:
        window = self._canvas.window
        size = window.get_window_shape()
        button = next((b for b in (ti.ui.LMB, ti.ui.RMB, ti.ui.MMB) if window.is_pressed(b)), None)
        cursor = window.get_cursor_pos()  # from the lower left corner, in [0, 1]
        if button is None or min(size) < 1:  # a window of zero size has no cursor
            if self.drag is not None:
                self.drag = None
                sim.release()
            self._mode = ""
        elif not self._mode:
            self._mode = self._begin_drag(sim, panel, button, cursor, size)
        else:
            self._move_camera(cursor[0] - self._cursor[0], cursor[1] - self._cursor[1], size)
        if self.drag is not None:
            self.drag.drag(sim, self.camera, cursor, size, panel.strength)
        self._cursor = cursor

    def _begin_drag(self, sim, panel: Panel | None, button, cursor, size) -> str:
        """Start a mouse drag at the cursor and return its mode."""
        left, top, width, height = self._panel_pixels
        x, y = cursor[0] * size[0], (1.0 - cursor[1]) * size[1]
        if left <= x <= left + width and top <= y <= top + height or self._overlay.contains(x, y):
            return "panel"
        if button != ti.ui.LMB:
            return "zoom" if button == ti.ui.RMB else "shift"
        if panel is not None and panel.strength > 0.0 and not self._canvas.window.is_pressed(ti.ui.CTRL):
            hit = pick(sim, self.camera, cursor, size)
            if hit is not None:
                self._widest = 0.0  # a camera that moves back would move the drag's target
                self.drag = MouseDrag(sim, hit)
                panel.chosen = self.drag.body
                return "drag"
        return "turn"

    def _move_camera(self, right: float, up: float, size) -> None:
        """Move the camera by a displacement of the cursor."""
        if self._mode in ("turn", "zoom", "shift"):
            self._widest = 0.0
        if self._mode == "turn":
            self.camera = self.camera.orbit(-ORBIT * right, -ORBIT * up)
        elif self._mode == "zoom":
            self.camera = self.camera.zoom(ZOOM**-up)
        elif self._mode == "shift":
            self.camera = self.camera.pan(-right * size[0] / size[1], -up)


class Loop:
    """Drives sim at fps pictures per second.

    problem: why the run paused; note: the last action; each a sentence or empty. folder: of the pictures while recording, else
    None; plots: records the steps.
    """

    def __init__(self, sim, fps: float, paused: bool, plots: Plots | None = None):
        self.sim, self.fps, self.paused, self._plots = sim, fps, paused, plots
        self.problem = self.note = ""
        self.folder: Path | None = None
        self._rebuild: Callable[[], bool] | None = None  # requested; called once a picture has shown the note
        self._note_shown = False
        self._frames = 0
        self._speed = 0.0  # [steps/s]
        self._start()

    def _start(self) -> None:
        """Begin with a simulator that has not compiled its steps."""
        self._compiled = False  # True after a step, since that compiles everything
        self._wait = FIRST_PICTURES  # pictures before the next step
        self._time_due = 0.0  # simulated time that steps still have to cover [s]
        self._cost = 0.0  # wall time over simulated time of the steps
        self._spent = [0.0, 0.0]  # wall and simulated time of the steps since the mark [s]
        self._mark = (time.perf_counter(), self.sim.step_count)  # start of the present speed measurement

    def request_rebuild(self, build: Callable[[], bool], note: str) -> None:
        """Call build once a picture has shown the note. build: rebuilds the simulator and returns whether it succeeded."""
        self._rebuild, self._note_shown, self.note = build, False, note

    def react(self, pressed: set[str]) -> None:
        """Carry out the actions of keys and buttons."""
        if self._rebuild is not None and self._note_shown:
            build, self._rebuild = self._rebuild, None
            if build():
                self._start()
                self.problem = ""
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
        folder = next(path for n in itertools.count(1) if not (path := OUT / f"window-{n}").exists())
        try:
            self.folder, self._frames = make_folder(folder), 0
        except OutputError as error:
            self.note = str(error)


def show(
    sim,
    fps: float = 60.0,
    paused: bool = False,
    colour: str = "body",
    layers: tuple[str, ...] = IN_WINDOW,
    plots: tuple[str, ...] = (),
) -> None:
    """Run a simulation in a window until it is closed.

    sim: an open Simulator, advanced by 1/fps [s] of simulated time per picture, never faster than real time; if made with
    draggable=True, its bodies can be dragged with the mouse. A failed step pauses the run and the reason is shown; R restarts.
    colour, layers, plots: initial ones. Raises OutputError, before anything is opened, if a display or a Vulkan driver is missing
    or the process has a window already; SceneError for a plot of a quantity that is not simulated.
    """
    if not fps > 0:
        raise OutputError(f"the window's fps is {fps}; it must be positive")
    history = Plots(sim, plots)
    window = LiveWindow(sim.scene, history, tall=True, colour=colour, layers=layers)
    try:
        loop = Loop(sim, fps, paused, history)
        panel = Panel(sim, loop, window.colouring, window.layers, history)
        while not window.closed:
            started = time.perf_counter()
            window.draw(sim, [*state_lines(sim), loop.speed()], panel, loop.record if loop.folder is not None else None)
            loop.react(window.pressed | panel.pressed)
            if not loop.paused:
                loop.advance()
            time.sleep(max(0.0, 1.0 / fps - (time.perf_counter() - started)))
    finally:
        window.close()
        if sim.dragged is not None:
            sim.release()


def state_lines(sim) -> list[str]:
    """Return time and energies of sim as lines of text."""
    energies = sim.energies()
    return [f"time     {sim.time:10.4f} s", *(f"{name:8} {getattr(energies, name):10.4g} J" for name in ENERGIES)]
