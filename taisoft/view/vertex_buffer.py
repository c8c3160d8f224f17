"""Vertices in the layout of Taichi's renderer: 12 single-precision numbers each, in one NumPy array.

The methods of `ti.ui` take Taichi fields and copy them into such an array by kernels. Taichi compiles those for every size of a
field and stores them on disk, so every mesh would cost compile time at its first picture and fill the cache. The functions here
fill the array in NumPy and pass it to the same renderer, so nothing is compiled. This relies on internals of Taichi 1.7.4, the
version that taisoft requires.
"""

import numpy as np

from taisoft.backend.private import get_field_info

POSITION, NORMAL, COLOUR, ALPHA = slice(0, 3), slice(3, 6), slice(8, 11), 11  # columns; 6 and 7 are for textures
WIDTH = 12


class VertexBuffer:
    """Vertices with x, normals and colours, each (n,3), initially zero. 2D drawings use the first two columns of x.

    The array lives as long as the buffer, since the renderer gets its address.
    """

    def __init__(self, n: int) -> None:
        self._data = np.zeros((n, WIDTH), dtype=np.float32)
        self._data[:, ALPHA] = 1.0
        self.x, self.normals, self.colours = self._data[:, POSITION], self._data[:, NORMAL], self._data[:, COLOUR]

    def __len__(self) -> int:
        return len(self._data)

    @property
    def info(self):
        """Address and type of the array, for Taichi's renderer."""
        return get_field_info(self._data)


def draw_mesh(scene, vertices: VertexBuffer, indices: np.ndarray) -> None:
    """Draw two-sided triangles with vertex colours, like `mesh` of a `ti.ui` scene. indices: int32 (3 t,)."""
    n, uniform = len(vertices), (0.5, 0.5, 0.5)
    scene.scene.mesh(vertices.info, True, get_field_info(indices), uniform, True, len(indices), 0, n, 0, False)


def draw_lines(scene, vertices: VertexBuffer, width: float, count: int) -> None:
    """Draw lines between pairs of the first count vertices, with vertex colours, like `lines` of a `ti.ui` scene.

    width: in pixels.
    """
    scene.scene.lines(vertices.info, get_field_info(None), True, (0.5, 0.5, 0.5), width, count, 0, count, 0)


def draw_flat_triangles(canvas, vertices: VertexBuffer, colour: tuple) -> None:
    """Draw triangles of three vertices each, in one colour, like `triangles` of a `ti.ui` canvas."""
    canvas.canvas.triangles(vertices.info, get_field_info(None), False, colour)


def draw_flat_lines(canvas, vertices: VertexBuffer, width: float) -> None:
    """Draw lines between pairs of vertices, with vertex colours, like `lines` of a `ti.ui` canvas.

    width: in units of the window's height.
    """
    canvas.canvas.lines(vertices.info, get_field_info(None), True, (0.5, 0.5, 0.5), width)
