"""The live window: a simulation that runs while it is watched, turned, paused and stepped.

Drag with the left button to orbit, the right one to zoom, the middle one to shift. Space: pause or go on. S or right
arrow: one step. R: back to the initial state. Escape or the close button: end.
"""

import textwrap
import time

import taichi as ti

from taisoft.errors import OutputError, SimulationError, TaisoftError
from taisoft.output.appearance import start_positions
from taisoft.output.camera import MAX_WIDENING, Camera
from taisoft.view.ggui import Canvas
from taisoft.view.shading import BACKGROUND_TOP
from taisoft.view.surfaces import Surfaces

SIZE = (1280, 720)
PANEL = (0.012, 0.02, 0.25, 0.36)  # left, top, width, height as fractions of the window
PANEL_COLUMNS = 42  # characters that fit its width
ORBIT = 240.0  # [deg] for a drag over the whole window
ZOOM = 16.0  # factor on the distance for such a drag
SPEED_OVER = 0.5  # [s] of wall time that steps/s is averaged over
KEYS = ("Space: pause, S or Right: step", "R: restart, Esc: quit", "Drag: left turn, right zoom, middle shift")


class LiveWindow:
    """A window that shows a scene; also an observer, with `frame` and `close`, for `Simulator.run`.

    scene: its bodies and obstacles are read once; size: (width, height) in pixels; camera: where to look from, else it shows all
    bodies and moves back after them until the user moves it. `pressed` holds which of "pause", "step" and "reset" the
    user pressed up to the last draw. Raises OutputError, before anything is opened, when a display or a Vulkan driver
    is missing or the process has a window already.
    """

    def __init__(self, scene, size: tuple[int, int] = SIZE, camera: Camera | None = None):
        self.camera = camera or Camera.framing(start_positions(scene), size)
        self._widest = 0.0 if camera else MAX_WIDENING * self.camera.distance  # [m]; 0 once the user moves the camera
        self._surfaces = Surfaces(scene)
        self._canvas = Canvas(self._surfaces, size, visible=True)
        self._cursor: tuple[float, float] | None = None  # of the drag that is going on
        self._asked_to_close = False
        self.pressed: set[str] = set()

    @property
    def closed(self) -> bool:
        """True once the user asked to close the window, or `close` was called."""
        return self._asked_to_close or self._canvas.window is None or not self._canvas.window.running

    def draw(self, sim, lines: list[str]) -> None:
        """Draw sim's present state with a panel of text lines, show it, and take up keys and mouse."""
        bodies = self._surfaces.of_bodies(sim)
        self.camera = self.camera.widened(bodies[0], self._canvas.window.get_window_shape(), self._widest)
        x, normals = self._surfaces.with_obstacles(bodies, sim.time, self.camera.position)
        self._canvas.draw(x, normals, self.camera, tuple(BACKGROUND_TOP))
        with self._canvas.window.get_gui().sub_window("taisoft", *PANEL) as panel:
            for line in lines:
                for piece in textwrap.wrap(line, PANEL_COLUMNS) or [""]:
                    panel.text(piece)
        self._canvas.window.show()
        self._read_keys()
        self._read_mouse()

    def frame(self, sim, index: int) -> None:
        """Show a frame of a run that is driven from elsewhere; does nothing once closed."""
        if not self.closed:
            self.draw(sim, [f"frame {index}", *state_lines(sim)])

    def close(self) -> None:
        """Destroy the window; a second call does nothing."""
        self._canvas.close()

    def _read_keys(self) -> None:
        actions = {ti.ui.SPACE: "pause", "s": "step", ti.ui.RIGHT: "step", "r": "reset"}
        self.pressed.clear()
        for event in self._canvas.window.get_events(ti.ui.PRESS):
            if event.key == ti.ui.ESCAPE:
                self._asked_to_close = True
            elif event.key in actions:
                self.pressed.add(actions[event.key])

    def _read_mouse(self) -> None:
        window = self._canvas.window
        button = next((b for b in (ti.ui.LMB, ti.ui.RMB, ti.ui.MMB) if window.is_pressed(b)), None)
        cursor = window.get_cursor_pos()  # from the lower left corner, in [0, 1]
        if button is None or (self._cursor is None and _on_panel(cursor)):
            self._cursor = None
            return
        if self._cursor is not None:
            self._widest = 0.0
            right, up = cursor[0] - self._cursor[0], cursor[1] - self._cursor[1]
            if button == ti.ui.LMB:
                self.camera = self.camera.orbit(-ORBIT * right, -ORBIT * up)
            elif button == ti.ui.RMB:
                self.camera = self.camera.zoom(ZOOM**-up)
            else:
                width, height = window.get_window_shape()
                self.camera = self.camera.pan(-right * width / height, -up)
        self._cursor = cursor


def show(sim, fps: float = 60.0, paused: bool = False) -> None:
    """Run a simulation in a window until it is closed.

    sim: an open Simulator, advanced by 1/fps [s] of simulated time a picture, never faster than real time. A step that
    fails pauses the run and its reason is shown; R starts anew. Raises OutputError, before anything is opened, when a
    display or a Vulkan driver is missing or the process has a window already.
    """
    if not fps > 0:
        raise OutputError(f"the window's fps is {fps}, it must be positive")
    window = LiveWindow(sim.scene)
    loop = _Loop(sim, fps, paused)
    try:
        while not window.closed:
            started = time.perf_counter()
            window.draw(sim, loop.lines())
            loop.react(window.pressed)
            if not loop.paused:
                loop.advance()
            time.sleep(max(0.0, 1.0 / fps - (time.perf_counter() - started)))
    finally:
        window.close()


class _Loop:
    """What `show` does between two pictures: running, stepping, restarting, and how fast it goes."""

    def __init__(self, sim, fps: float, paused: bool):
        self.sim, self.fps, self.paused = sim, fps, paused
        self.problem = ""
        self._speed = 0.0  # [steps/s]
        self._mark = (time.perf_counter(), sim.step_count)

    def react(self, pressed: set[str]) -> None:
        if "pause" in pressed:
            self.paused = not self.paused
        if "reset" in pressed:
            self.sim.reset()
            self.problem = ""
            self._mark = (time.perf_counter(), self.sim.step_count)
        if "step" in pressed:
            self.paused = True
            self._guarded(self.sim.step)

    def advance(self) -> None:
        """One picture's worth of simulated time."""
        self._guarded(self._run)

    def _run(self) -> None:
        result = self.sim.run(1.0 / self.fps, fps=self.fps)
        if result.status == "failed":
            raise SimulationError("; ".join(result.problems) or "the run failed")

    def _guarded(self, call) -> None:
        try:
            call()
        except TaisoftError as error:
            self.problem, self.paused = str(error), True

    def lines(self) -> list[str]:
        """The panel's text."""
        now, steps = time.perf_counter(), self.sim.step_count
        since = now - self._mark[0]
        if since >= SPEED_OVER:
            self._speed = (steps - self._mark[1]) / since
            self._mark = (now, steps)
        state = f"failed: {self.problem}" if self.problem else "paused" if self.paused else "running"
        return [*state_lines(self.sim), f"speed    {self._speed:10.1f} steps/s", state, "", *KEYS]


def state_lines(sim) -> list[str]:
    """Time and energies of sim as text."""
    energies = sim.energies()
    values = {"kinetic": energies.kinetic, "elastic": energies.elastic, "gravity": energies.gravity}
    return [f"time     {sim.time:10.4f} s", *(f"{name:8} {value:10.4g} J" for name, value in values.items())]


def _on_panel(cursor: tuple[float, float]) -> bool:
    left, top, width, height = PANEL
    return left <= cursor[0] <= left + width and top <= 1.0 - cursor[1] <= top + height
