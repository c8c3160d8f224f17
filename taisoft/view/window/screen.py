"""The live window on the screen: draws the latest state, and turns keys and mouse into actions and commands."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import taichi as ti

from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.folder import make_folder
from taisoft.output.picture_files import png_bytes
from taisoft.output.viewpoint import MAX_WIDENING, Viewpoint
from taisoft.view.colouring import BACKGROUND
from taisoft.view.drawn import DrawnScene, DrawnState
from taisoft.view.layers import IN_FRONT
from taisoft.view.scene_view import SceneView
from taisoft.view.window.ggui import Canvas
from taisoft.view.window.keys import ACTIONS
from taisoft.view.window.panel import Panel, Requests, wrapped
from taisoft.view.window.picking import MouseDrag, pick
from taisoft.view.window.timing import Note, Timing
from taisoft.view.window.window_shadow import ShadowMesh

SIZE = (1280, 720)
PANEL = (0.012, 0.02, 0.31, 0.96)  # left, top, width, height as fractions of the window's initial size
SHORT_PANEL = (0.012, 0.02, 0.31, 0.22)  # of a window without controls
MESSAGES = (0.334, 0.87, 0.4, 0.11)
ABOVE_MESSAGES = 0.04  # fraction of the window kept free below what is framed, beside its border
ORBIT = 240.0  # angle for a drag over the whole window [deg]
ZOOM = 16.0  # factor on the distance for a drag over the whole window
DRAG_COLOUR = np.array([0.85, 0.10, 0.35])  # sRGB
LONG = 1.0  # wall time of a step after which the panel says so [s]
OUT = Path("out")
FOR_SIMULATION = {"pause", "step", "reset", "faster", "slower", "unbound", "budget"}  # actions of the simulation


class Screen(SceneView):
    """The window. The user may change colours and layers and move the camera, which then follows the bodies no more.

    description: what `WindowProcess` sends. requests: gets commands, if the window has controls; timing:
    of pictures and drags. Raises OutputError, before anything is opened, if a display or a Vulkan driver is missing or a name is
    unknown.
    """

    def __init__(self, scene: DrawnScene, description: dict, requests: Requests):
        self._panel_rectangle = PANEL if description["controls"] else SHORT_PANEL
        super().__init__(scene, SIZE, None, description["colour"], tuple(description["layers"]))
        self.timing = Timing()
        self.layers.shown["shadows"] = True
        self._requests = requests
        self._panel: Panel | None = None
        if description["controls"]:
            names = [body.name for body in scene.bodies]
            self._panel = Panel(names, description["pairs"], self.colouring, self.layers, requests)
        self._cursor: tuple[float, float] | None = None  # at the last picture
        self._mode = ""  # of the present mouse drag: "turn", "zoom", "shift", "drag", or "panel", which GGUI handles
        self._follows, self._centre = False, None  # whether the camera follows the bodies; their last centre
        self._picture_size: tuple[int, int] | None = None  # of the last picture taken of the window
        self._close_requested = False
        self._drag: MouseDrag | None = None
        self._screenshot = False  # requested
        self._note = Note()  # about pictures and camera
        self._messages: list[str] = []  # those shown
        self._shadow_mesh = ShadowMesh(scene, self.surfaces)
        self._background = BACKGROUND if scene.background is None else scene.background
        n_segments, n_decals = self.layers.n_segments + 1, self._shadow_mesh.size
        self._canvas = Canvas(self.surfaces, SIZE, visible=True, n_segments=n_segments, n_decals=n_decals)

    @property
    def closed(self) -> bool:
        """Whether the user has closed the window, or `close` was called."""
        return self._close_requested or self._canvas.window is None or not self._canvas.window.running

    @property
    def dragging(self) -> bool:
        """Whether the mouse drags a body or the view."""
        return bool(self._mode)

    @property
    def drags_body(self) -> bool:
        """Whether the mouse drags a body."""
        return self._drag is not None

    def close(self) -> None:
        """Destroy the window; a second call does nothing."""
        self._canvas.close()

    def draw(self, drawn: DrawnState, state: dict, age: float) -> None:
        """Draw a state, show it, and process keys and mouse. age: wall time since it came [s]."""
        window = self._canvas.window
        size = window.get_window_shape()
        self._follow(drawn)
        x, colours, (ends, line_colours) = self._drawn(drawn, size)
        if self._drag is not None:
            dragged = self.camera.nearer(self._drag.line(drawn), IN_FRONT)
            ends = np.concatenate([dragged, ends])
            line_colours = np.concatenate([np.tile(DRAG_COLOUR, (2, 1)), line_colours])
        shadows = self._shadow_mesh.draw(x, drawn.poses, self.camera) if self.layers.shown["shadows"] else None
        self._canvas.draw(x, colours, self.camera, tuple(self._background[0]), (ends, line_colours), shadows)
        self._take_picture(size)
        # lines above the sliders must be constant in number: a transient line would move the sliders under the cursor
        with window.get_gui().sub_window("taisoft", *self._panel_rectangle) as gui:
            for line in [state["status"], *state_lines(drawn), *self.timing.lines(state)]:
                gui.text(line)
            if self._panel is not None:
                self._panel.draw(gui, state, held=self._mode == "panel")
        self._show_messages(window.get_gui(), state, age)
        window.show()
        self.timing.shown(state)
        self._read_keys(drawn, size)
        self._read_mouse(drawn, size)

    def look(self, drawn: DrawnState) -> None:
        """Look at the mouse between two pictures, of which the last one showed a state."""
        self._canvas.window.get_events(ti.ui.RELEASE)  # else buttons stay as they were
        self._read_mouse(drawn, self._canvas.window.get_window_shape())

    def _show_messages(self, gui, state: dict, age: float) -> None:
        """Show what the simulation and this window have to say, in a sub-window that is there only then."""
        late = age > LONG and not state.get("paused")
        long_step = [f"no new state for {age:.0f} s"] if late else []
        self._messages = [*state["messages"], *self._note.shown, *long_step]
        if self._messages:
            with gui.sub_window("messages", *MESSAGES) as page:
                for line in self._messages:
                    wrapped(page, line)

    # --- camera -------------------------------------------------------------------------------------------------------

    def _free(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        return free_part(self._panel_rectangle, size)

    def _follow(self, drawn: DrawnState) -> None:
        """Move the camera's target with the mean position of the nodes, but not while a body is dragged."""
        x = drawn.x
        x = x[np.isfinite(x).all(axis=1)]
        if not self._follows or self._drag is not None or len(x) == 0:
            self._centre = None
            return
        centre = x.mean(axis=0)
        if self._centre is not None:
            self.camera = replace(self.camera, target=self.camera.target + centre - self._centre)
        self._centre = centre

    def _frame(self, drawn: DrawnState, size: tuple[int, int]) -> None:
        """Frame the bodies from the present direction; from then on the camera moves back again if they would leave."""
        x = drawn.x
        x = x[np.isfinite(x).all(axis=1)]
        if len(x):
            kept = {name: getattr(self.camera, name) for name in ("up", "azimuth", "elevation", "fov")}
            self.camera, self._has_own = Viewpoint.framing(x, size, self._free(size), **kept), False
            self._widest = MAX_WIDENING * self.camera.distance

    def _move_camera(self, right: float, up: float, size) -> None:
        """Move the camera by a displacement of the cursor."""
        if self._mode in ("turn", "zoom", "shift"):
            self._widest, self._has_own = 0.0, False
        if self._mode == "turn":
            self.camera = self.camera.orbit(-ORBIT * right, -ORBIT * up)
        elif self._mode == "zoom":
            self.camera = self.camera.zoom(ZOOM**-up)
        elif self._mode == "shift":
            self.camera = self.camera.pan(-right * size[0] / size[1], -up)

    # --- keys and mouse -----------------------------------------------------------------------------------------------

    def _read_keys(self, drawn: DrawnState, size) -> None:
        events = self._canvas.window.get_events(ti.ui.PRESS)
        pressed = {ACTIONS[event.key] for event in events if event.key in ACTIONS}
        self._close_requested |= "close" in pressed
        if self._panel is not None:
            pressed |= self._panel.pressed
            for action in sorted(pressed & FOR_SIMULATION):
                self._requests.add(action)
        for name in pressed & set(self.layers.shown):
            self.layers.shown[name] = not self.layers.shown[name]
        if "colour" in pressed:
            self.colouring.choose_next()
        if "frame" in pressed:
            self._frame(drawn, size)
        if "follow" in pressed:
            self._follows, self._centre, self._widest, self._has_own = not self._follows, None, 0.0, False
            self._note.set("the camera follows the bodies" if self._follows else "the camera stays")
        self._screenshot |= "screenshot" in pressed

    def _read_mouse(self, drawn: DrawnState, size) -> None:
        window = self._canvas.window
        button = next((b for b in (ti.ui.LMB, ti.ui.RMB, ti.ui.MMB) if window.is_pressed(b)), None)
        cursor = window.get_cursor_pos()  # from the lower left corner, in [0, 1]
        if button is None or min(size) < 1:  # a window of zero size has no cursor
            if self._drag is not None:
                self._drag = None
                self._requests.add("release")
            self._mode = ""
        elif not self._mode:
            self._mode = self._begin_drag(drawn, button, cursor, size)
        else:
            self._move_camera(cursor[0] - self._cursor[0], cursor[1] - self._cursor[1], size)
        if self._drag is not None and self._drag.move(self.camera, cursor, size):
            self._requests.add("drag", self._drag.target.tolist(), self._panel.strength, key="drag")
            self.timing.dragged(self._requests.next_number)
        self._cursor = cursor
        self.timing.polled()

    def _begin_drag(self, drawn: DrawnState, button, cursor, size) -> str:
        """Start a mouse drag at the cursor and return its mode."""
        x, y = cursor[0] * size[0], (1.0 - cursor[1]) * size[1]
        rectangles = [self._panel_rectangle, *([MESSAGES] if self._messages else [])]
        if any(_contains(rectangle, x, y) for rectangle in rectangles):
            return "panel"
        if button != ti.ui.LMB:
            return "zoom" if button == ti.ui.RMB else "shift"
        can_drag = self._panel is not None and self._panel.strength > 0.0
        if can_drag and not self._canvas.window.is_pressed(ti.ui.CTRL):
            hit = pick(drawn, self.camera, cursor, size)
            if hit is not None:
                self._widest, self._has_own = 0.0, False  # a camera that moves would move the drag's target
                drag = self._drag = MouseDrag(drawn, hit)
                self._panel.chosen = drag.body
                self._requests.add("begin_drag", drag.body, drag.nodes, drag.weights, key="begin_drag")
                self._requests.add("drag", drag.target.tolist(), self._panel.strength, key="drag")
                return "drag"
        return "turn"

    # --- pictures -----------------------------------------------------------------------------------------------------

    def _take_picture(self, size: tuple[int, int]) -> None:
        """Write the drawn picture if that is requested, before the panel is declared, which would else be in it."""
        # GGUI shows an empty window after a picture was taken of it at another size than the present one
        if not self._screenshot and self._picture_size in (None, size):
            return
        picture = self._canvas.pixels(0, 0, *size)
        self._picture_size = size
        if not self._screenshot:
            return
        self._screenshot = False
        path = next(one for n in itertools.count(1) if not (one := OUT / f"window-{n}.png").exists())
        try:
            make_folder(OUT)
            write_bytes(path, png_bytes(picture))
            self._note.set(f"written: {path}")
        except OutputError as error:
            self._note.set(str(error))


def free_part(panel: tuple[float, float, float, float], size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return the part of a window right of its panel, but at least a quarter, as for `Viewpoint.framing`."""
    left, _, width, _ = panel
    return (min((left + width) * SIZE[0] / max(size[0], 1), 0.75), ABOVE_MESSAGES, 1.0, 1.0)


def _contains(rectangle: tuple[float, float, float, float], x: float, y: float) -> bool:
    """Return whether a pixel lies in a sub-window.

    GGUI positions it once, by the window's size at that time, and does not report where the user moves it.
    """
    left, top, width, height = (f * n for f, n in zip(rectangle, (*SIZE, *SIZE)))
    return left <= x <= left + width and top <= y <= top + height


def state_lines(drawn: DrawnState) -> list[str]:
    """Return time and energies of a state as lines of text."""
    return [f"time     {drawn.time:10.4f} s", *(f"{name:8} {energy:10.4g} J" for name, energy in drawn.energies.items())]
