"""Wrapper of Taichi's renderer (GGUI): its requirements on this machine, and a canvas that draws the scene's surfaces.

Taichi ends the process, past any `except`, when it opens a window without a display, holds two windows, or is
initialised again while a window is open. So requirements are checked first, a process holds one window at a time, and an open
window holds a claim on the runtime. A closing window also writes `imgui.ini`, the position of its panel, in the working folder;
that file is removed unless it existed before.

The methods of `ti.ui` take Taichi fields and copy them into the renderer's array by kernels. Taichi compiles those for every size
of a field and stores them on disk, so every mesh would cost compile time at its first picture and fill the cache. `VertexBuffer`
fills the array in NumPy and passes it to the same renderer, so nothing is compiled. This relies on internals of Taichi 1.7.4, the
version that taisoft requires.
"""

import contextlib
import ctypes
import functools
import os
import sys
from pathlib import Path

import numpy as np
import taichi as ti

from taisoft.backend.private import core, get_field_info
from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.errors import OutputError
from taisoft.mesh.placing import UP
from taisoft.output.viewpoint import Viewpoint
from taisoft.view.scene_view import Surfaces

LINE_WIDTH = 2.0  # pixels

POSITION, NORMAL, COLOUR, ALPHA = slice(0, 3), slice(3, 6), slice(8, 11), 11  # columns of vertices; 6 and 7 are for textures
WIDTH = 12
GREY = (0.5, 0.5, 0.5)  # replaced by vertex colours

_holder: list[str] = []  # name of the holder of the process's one window


@functools.cache  # the check loads drivers, and the loader prints every failure
def vulkan_missing() -> str:
    """Return what to install for Taichi's renderer, as a sentence; empty if there is a Vulkan driver."""
    if core.with_vulkan():
        return ""
    return "there is no Vulkan driver (Debian and Ubuntu: apt install mesa-vulkan-drivers)"


def display_missing() -> str:
    """Return why no window can be shown, as a sentence; empty if a display answers. Windows need X11 (Wayland provides it)."""
    if not sys.platform.startswith("linux"):
        return ""
    name = os.environ.get("DISPLAY", "")
    if not name:
        return "there is no display: the variable DISPLAY is not set (without a screen: xvfb-run, package xvfb)"
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return "the library libX11.so.6 is missing (Debian and Ubuntu: apt install libx11-6)"
    x11.XOpenDisplay.restype = ctypes.c_void_p
    connection = x11.XOpenDisplay(None)
    if not connection:
        return f"the display '{name}' does not answer (variable DISPLAY)"
    x11.XCloseDisplay(ctypes.c_void_p(connection))
    return ""


def _future_panel_file() -> Path | None:
    """Return the path of the file that a closing window will write; None if it exists already or cannot be written."""
    try:
        path = Path.cwd() / "imgui.ini"
    except FileNotFoundError:  # the working folder is gone
        return None
    return None if path.exists() else path


class VertexBuffer:
    """Vertices in the layout of Taichi's renderer, with x, normals and colours (n,3), initially zero, and opacities (n,), 1.

    The renderer gets the address of the array, which lives as long as the buffer.
    """

    def __init__(self, n: int) -> None:
        self._data = np.zeros((n, WIDTH), dtype=np.float32)
        self._data[:, ALPHA] = 1.0
        self.x, self.normals, self.colours = self._data[:, POSITION], self._data[:, NORMAL], self._data[:, COLOUR]
        self.opacities = self._data[:, ALPHA]

    def __len__(self) -> int:
        return len(self._data)

    @property
    def info(self):
        """Address and type of the array, for Taichi's renderer."""
        return get_field_info(self._data)


class Canvas:
    """The process's one Taichi window, on the screen or only in memory, which draws the scene's surfaces.

    size: (width, height) in pixels; visible: on the screen; n_segments: largest number of lines; n_decals:
    largest numbers of vertices and triangles of what is drawn on the surfaces.
    Raises OutputError, before anything is opened, if a Vulkan driver or a display is missing or a window is open already.
    """

    def __init__(
        self, surfaces: Surfaces, size: tuple[int, int], visible: bool, n_segments: int = 0, n_decals: tuple[int, int] = (0, 0)
    ):
        missing = (visible and display_missing()) or vulkan_missing()
        if missing:
            raise OutputError(f"cannot open a window: {missing}")
        if _holder:
            raise OutputError(f"cannot open a window: {_holder[0]} holds the only one a process can have; close it first")
        arch, precision = open_kind() or ("cpu", "f32")
        if arch != "cpu":
            raise OutputError(f"cannot open a window: arch is '{arch}', and windows need arch cpu")
        self._runtime = open_runtime(arch, precision, owner="a window")
        _holder.append("a window")
        self._surfaces = surfaces
        self._n = len(surfaces.colours)  # drawn vertices of the surfaces; those of decals follow in the same mesh
        self._vertices = VertexBuffer(self._n + n_decals[0])
        self._vertices.normals[:] = 0.0, 1.0, 0.0  # no effect: the colours are lit already
        self._indices = np.zeros((len(surfaces.triangles) + n_decals[1], 3), dtype=np.int32)
        self._vertices.opacities[: self._n] = surfaces.opacities
        transparent = self._vertices.opacities[surfaces.triangles[:, 0]] < 1.0
        opaque, self._transparent = surfaces.triangles[~transparent], surfaces.triangles[transparent]
        self._indices[: len(opaque)] = opaque
        self._decals, self._last = np.split(self._indices[len(opaque) :], [n_decals[1]])  # unused triangles have no area
        self._ends = VertexBuffer(2 * n_segments)
        self._most = 0  # ends of lines drawn at once so far
        self.window = self._canvas = self._scene = None
        self._panel_file = _future_panel_file()
        try:
            self.window = ti.ui.Window("taisoft", size, show_window=visible)
            self._canvas = self.window.get_canvas()
            self._scene = self.window.get_scene()
        except RuntimeError as error:
            self.close()
            raise OutputError(f"cannot open a window: Taichi says: {error}") from error

    def draw(
        self,
        x: np.ndarray,
        colours: np.ndarray,
        camera: Viewpoint,
        background: tuple,
        lines: tuple,
        decals: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> None:
        """Draw the surfaces with vertices x [m] and lit colours, (n,3) each; background: RGB in [0, 1].

        lines: ends (2k,3) [m] and colours (2k,3), of which the first n_segments lines are drawn; decals: x, colours and
        triangles (t,3) of what is drawn on the surfaces.
        """
        # relative to the target, since single precision is too coarse for a scene far from the origin
        self._vertices.x[: self._n], self._vertices.colours[: self._n] = x - camera.target, colours
        self._decals[:] = 0
        if decals is not None:
            rows = slice(self._n, self._n + len(decals[0]))
            self._vertices.x[rows], self._vertices.colours[rows] = decals[0] - camera.target, decals[1]
            self._decals[: len(decals[2])] = self._n + decals[2]
        depths = (x[self._transparent] - camera.position).mean(axis=1) @ camera.forward
        self._last[:] = self._transparent[np.argsort(-depths)]
        eye = ti.ui.Camera()
        eye.position(*(camera.position - camera.target))
        eye.lookat(*(camera.position - camera.target + camera.distance * camera.forward))
        eye.up(*UP[camera.up].tolist())
        eye.fov(camera.fov)
        eye.z_near(camera.clipping[0])
        eye.z_far(camera.clipping[1])
        self._canvas.set_background_color(background)
        self._scene.set_camera(eye)
        self._scene.ambient_light((1.0, 1.0, 1.0))  # the colours are lit already
        vertices, indices = self._vertices.info, get_field_info(self._indices.reshape(-1))  # two-sided, with vertex colours
        self._scene.scene.mesh(vertices, True, indices, GREY, True, self._indices.size, 0, len(self._vertices), 0, False)
        ends, line_colours = lines
        n = min(len(ends), len(self._ends))
        if n > 0:
            self._ends.x[:n], self._ends.colours[:n] = ends[:n] - camera.target, line_colours[:n]
            most = self._most = max(n, self._most)  # the renderer goes on drawing as many as there were once
            self._ends.x[n:most] = 0.0
            self._scene.scene.lines(self._ends.info, get_field_info(None), True, GREY, LINE_WIDTH, most, 0, most, 0)
        self._canvas.scene(self._scene)

    def pixels(self, left: int, top: int, right: int, bottom: int) -> np.ndarray:
        """Return a part of the drawn picture, uint8 (bottom - top, right - left, 3), first row on top."""
        buffer = self.window.get_image_buffer_as_numpy()  # float32 (width, height, 4) in [0, 1], first row below
        height = buffer.shape[1]
        part = 255 * buffer[left:right, height - bottom : height - top, :3] + 0.5
        return part.astype(np.uint8).transpose(1, 0, 2)[::-1]

    def close(self) -> None:
        """Destroy the window and release the runtime; a second call does nothing."""
        if self._runtime is None:
            return
        if self.window is not None:
            self.window.destroy()
        if self._panel_file is not None:
            with contextlib.suppress(OSError):  # in a folder that has become read-only the file stays, which is harmless
                self._panel_file.unlink(missing_ok=True)
        self.window = self._canvas = self._scene = None
        self._runtime.close()
        self._runtime = None
        _holder.clear()
