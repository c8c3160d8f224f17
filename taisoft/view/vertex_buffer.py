"""Vertices in the layout that Taichi's renderer reads: 12 single-precision numbers each, in one NumPy array.

The methods of `ti.ui` take Taichi fields and copy them into such an array by kernels. Taichi compiles those for every size of a
field and keeps them on disk, so every mesh would cost compile time at its first picture and fill the cache. The functions here
fill the array in NumPy and pass it to the same renderer, for which nothing is compiled. This rests on 1.7.4, the version that
taisoft asks for.
"""

import numpy as np
from taichi.ui.utils import get_field_info

POSITION, NORMAL, COLOUR, ALPHA = slice(0, 3), slice(3, 6), slice(8, 11), 11  # columns; 6 and 7 are for textures
WIDTH = 12


class VertexBuffer:
    """Vertices with x, normals and colours, each (n,3); zero at first. Plane drawings use the first two columns of x.

    The array stays as long as the buffer: the renderer gets its address.
    """

    def __init__(self, n: int) -> None:
        self._data = np.zeros((n, WIDTH), dtype=np.float32)
        self._data[:, ALPHA] = 1.0
        self.x, self.normals, self.colours = self._data[:, POSITION], self._data[:, NORMAL], self._data[:, COLOUR]

    def __len__(self) -> int:
        return len(self._data)

    @property
    def info(self):
        """Where and what the array is, for Taichi's renderer."""
        return get_field_info(self._data)


def draw_mesh(scene, vertices: VertexBuffer, indices: np.ndarray) -> None:
    """As `mesh` of a `ti.ui` scene: triangles with colours by vertex, seen from both sides. indices: int32 (3 t,)."""
    n, uniform = len(vertices), (0.5, 0.5, 0.5)
    scene.scene.mesh(vertices.info, True, get_field_info(indices), uniform, True, len(indices), 0, n, 0, False)


def draw_lines(scene, vertices: VertexBuffer, width: float, count: int) -> None:
    """As `lines` of a `ti.ui` scene: lines between each two of the first count vertices, colours by vertex; width [pixels]."""
    scene.scene.lines(vertices.info, get_field_info(None), True, (0.5, 0.5, 0.5), width, count, 0, count, 0)


def draw_flat_triangles(canvas, vertices: VertexBuffer, colour: tuple) -> None:
    """As `triangles` of a `ti.ui` canvas: each three vertices, in one colour."""
    canvas.canvas.triangles(vertices.info, get_field_info(None), False, colour)


def draw_flat_lines(canvas, vertices: VertexBuffer, width: float) -> None:
    """As `lines` of a `ti.ui` canvas: each two vertices, colours by vertex; width in units of the window's height."""
    canvas.canvas.lines(vertices.info, get_field_info(None), True, (0.5, 0.5, 0.5), width)
