"""A z-buffer rasteriser in kernels: triangles to pixels, with SAMPLES x SAMPLES samples per pixel.

The picture is cut into square tiles (Fuchs et al. 1989). A serial loop lists the triangles of every tile in their order, and a
parallel loop draws tile by tile. No two threads write to one sample, so a picture is the same in every run. A triangle covers the
samples of a row between its edges. Two triangles that share an edge compute its crossing with the row from the same numbers, so
they leave no gap. The z-buffer holds keys: the bits of 1/depth, which like attribute/depth is linear in the picture, with the
triangle's number in the tile's list in the lowest ones. So the larger of two keys, as integers, is that of the nearer triangle.

Transparent triangles are drawn by depth peeling (Everitt 2001) from front to back: the next layer of a sample is its largest key
below the last one's, so that surfaces may intersect, and come in any order.

All numbers are f64 in every runtime: pictures do not depend on the precision of the simulation. Arrays are NumPy's; on CUDA
Taichi copies them for every launch.
"""

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.errors import OutputError
from taisoft.view.shading import MAP, ORDINALS, SAMPLES, TILE, WIDTH, colour_at, resolve

MAX_COORDINATE = 1e10  # samples; triangles beyond are skipped
MIN_AREA = 1e-10  # samples^2; twice that of a triangle that is drawn
FLAT = 1e-12  # samples; an edge that rises less bounds no row
UNBOUNDED = 1e30  # samples, where an edge does not bound a row
MAX_LISTED = 2**31 - 1
NEAREST = 2**63 - 1  # key in front of all others
LEAST_LIGHT = 1.0 / 512.0  # fraction of the light behind a sample's layers below which no further one is drawn
ARRAY = ti.types.ndarray()


class Raster:
    """Draws triangles into images of size (width, height) in samples. Its arrays are reused between images."""

    def __init__(self, size: tuple[int, int]):
        self.size = size
        self._columns, rows = (-(-extent // TILE) for extent in size)
        self._ends = np.zeros(self._columns * rows + 1, dtype=np.int64)
        self._listed = np.zeros(1, dtype=np.int32)
        self._planes = np.zeros((0, 0))

    def draw(
        self,
        points: np.ndarray,
        triangles: np.ndarray,
        attributes: np.ndarray | None,
        near: float,
        shadows: np.ndarray,
        picture: np.ndarray | None,
        opacities: np.ndarray | None = None,
        depths: np.ndarray | None = None,
    ) -> None:
        """Draw triangles over a picture, uint8 (height, width, 3) in pixels of SAMPLES x SAMPLES samples, or into depths.

        points: (n,3), position in samples from the upper left corner, and depth; triangles: (t,3); attributes: (n,N_ATTRIBUTES)
        of the points, see `shading`. Triangles that reach nearer than `near` or beyond MAX_COORDINATE, or are not finite, are
        skipped; both sides are drawn. Of triangles at the same depth the last one is in front. shadows: (maps, v, u), the
        fraction of light that is missing. opacities: (t,), None if all are 1. Raises OutputError for too many triangles.
        """
        n, n_attributes = len(triangles), 0 if attributes is None else attributes.shape[1]
        if n == 0:
            return
        if n > ORDINALS:
            raise OutputError(f"a picture cannot show {n} triangles: at most {ORDINALS} are possible")
        if self._planes.shape[0] < n or self._planes.shape[1] != 3 * (1 + n_attributes):
            self._edges, self._planes = np.empty((n, 9)), np.empty((n, 3 * (1 + n_attributes)))
            self._boxes = np.empty((n, 5), dtype=np.int32)
        self._ends[:] = 0
        of_triangles = self._edges, self._planes, self._boxes, self._ends
        points = np.ascontiguousarray(points, dtype=np.float64)
        attributes = np.zeros((1, 1)) if attributes is None else np.ascontiguousarray(attributes, dtype=np.float64)
        triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        set_up(points, attributes, n_attributes, triangles, near, *self.size, self._columns, *of_triangles)
        if self._ends[-1] > MAX_LISTED:
            raise OutputError(f"a picture cannot show {n} triangles of this size: they cover too many tiles of the picture")
        if self._ends[-1] > len(self._listed):
            self._listed = np.empty(min(int(1.25 * self._ends[-1]), MAX_LISTED), dtype=np.int32)
        enlist(n, self._columns, self._boxes, self._ends, self._listed)
        if opacities is not None:
            peel(self.size[0], self._columns, *of_triangles, self._listed, opacities, shadows, picture)
            return
        has_picture, has_depths = picture is not None, depths is not None
        images = picture if has_picture else np.zeros((1, 1, 3), np.uint8), depths if has_depths else np.zeros((1, 1))
        sizes = self.size[0], self._columns, has_picture, has_depths
        draw(*sizes, *of_triangles, self._listed, shadows, *images)

    def inverse_depths(self, points: np.ndarray, triangles: np.ndarray, near: float = 0.0) -> np.ndarray:
        """Return 1/depth of all samples (height, width), 0 where no triangle is; arguments as for `draw`."""
        depths = np.zeros(self.size[::-1])
        self.draw(points, triangles, None, near, np.zeros((1, 2, 2)), None, depths=depths)
        return depths


@kernel(cse=False)
def set_up(
    points: ARRAY,
    attributes: ARRAY,
    n_attributes: ti.i32,
    triangles: ARRAY,
    near: ti.f64,
    width: ti.i32,
    height: ti.i32,
    columns: ti.i32,
    edges: ARRAY,
    planes: ARRAY,
    boxes: ARRAY,
    ends: ARRAY,
):
    """Compute edges, planes and boxes of triangles, and where the list of every tile begins.

    edges: (t,9): slopes dx/dy of the edges, then x at y = 0 of those that bound the row from the left, then of those from the
    right. planes: (t,3+3k): a, b, c of 1/depth = a x + b y + c, then of every attribute/depth. boxes: (t,5): first and last
    column of tiles, first and last row of samples, shadow map. ends: (tiles + 1,), zero: becomes the beginnings, and the total.
    """
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x0, y0, x1, y1, x2, y2 = points[i, 0], points[i, 1], points[j, 0], points[j, 1], points[k, 0], points[k, 1]
        left, right = ti.min(x0, ti.min(x1, x2)), ti.max(x0, ti.max(x1, x2))
        top, bottom = ti.min(y0, ti.min(y1, y2)), ti.max(y0, ti.max(y1, y2))
        nearest = ti.min(points[i, 2], ti.min(points[j, 2], points[k, 2]))
        size = ti.max(ti.max(ti.abs(left), ti.abs(right)), ti.max(ti.abs(top), ti.abs(bottom)))
        area = x0 * (y1 - y2) + y0 * (x2 - x1) + x1 * y2 - x2 * y1
        total = x0 + y0 + x1 + y1 + x2 + y2 + points[i, 2] + points[j, 2] + points[k, 2]
        boxes[t, 2], boxes[t, 3], boxes[t, 4] = 0, -1, -1
        if total == total and nearest > near and size < MAX_COORDINATE and ti.abs(area) > MIN_AREA:
            low, high = ti.max(ti.ceil(top - 0.5), 0.0), ti.min(ti.floor(bottom - 0.5), height - 1.0)
            begin, end = ti.max(ti.ceil(left - 0.5), 0.0), ti.min(ti.floor(right - 0.5), width - 1.0)
            if low <= high and begin <= end:
                boxes[t, 0], boxes[t, 1] = ti.i32(begin) // TILE, ti.i32(end) // TILE
                boxes[t, 2], boxes[t, 3] = ti.i32(low), ti.i32(high)
        if boxes[t, 2] <= boxes[t, 3]:
            if n_attributes > MAP:
                boxes[t, 4] = ti.i32(ti.floor(attributes[i, MAP] + 0.5))
            for column in range(planes.shape[1]):
                planes[t, column] = 0.0
            for p in range(3):
                point, q, r = triangles[t, p], triangles[t, (p + 1) % 3], triangles[t, (p + 2) % 3]
                a, b = (points[q, 1] - points[r, 1]) / area, (points[r, 0] - points[q, 0]) / area  # of the weight of p
                c = -(a * points[q, 0] + b * points[q, 1])
                # both triangles of an edge compute its line from the same end
                lower, upper = r, q
                if points[q, 1] > points[r, 1] or (points[q, 1] == points[r, 1] and points[q, 0] > points[r, 0]):
                    lower, upper = q, r
                rise = points[lower, 1] - points[upper, 1]
                edges[t, p], edges[t, 3 + p], edges[t, 6 + p] = 0.0, -UNBOUNDED, UNBOUNDED
                if rise > FLAT:
                    slope = (points[lower, 0] - points[upper, 0]) / rise
                    start = points[upper, 0] - slope * points[upper, 1]
                    edges[t, p] = slope
                    if a > 0.0:
                        edges[t, 3 + p] = start
                    else:
                        edges[t, 6 + p] = start
                for m in range(1 + n_attributes):
                    value = 1.0 / points[point, 2]
                    if m > 0:
                        value = value * attributes[point, m - 1]
                    planes[t, 3 * m] = planes[t, 3 * m] + a * value
                    planes[t, 3 * m + 1] = planes[t, 3 * m + 1] + b * value
                    planes[t, 3 * m + 2] = planes[t, 3 * m + 2] + c * value

    ti.loop_config(serialize=True)
    for t in range(triangles.shape[0]):
        if boxes[t, 2] <= boxes[t, 3]:
            for row in range(boxes[t, 2] // TILE, boxes[t, 3] // TILE + 1):
                for column in range(boxes[t, 0], boxes[t, 1] + 1):
                    ends[row * columns + column] = ends[row * columns + column] + 1

    ti.loop_config(serialize=True)
    for _ in range(1):
        total = ti.i64(0)
        for tile in range(ends.shape[0] - 1):
            count = ends[tile]
            ends[tile] = total
            total = total + count
        ends[ends.shape[0] - 1] = total


@kernel(cse=False)
def enlist(n: ti.i32, columns: ti.i32, boxes: ARRAY, ends: ARRAY, listed: ARRAY):
    """List the first n triangles by tile. ends: a list's beginning becomes its end, which is the next one's beginning."""
    ti.loop_config(serialize=True)
    for t in range(n):
        if boxes[t, 2] <= boxes[t, 3]:
            for row in range(boxes[t, 2] // TILE, boxes[t, 3] // TILE + 1):
                for column in range(boxes[t, 0], boxes[t, 1] + 1):
                    tile = row * columns + column
                    listed[ti.i32(ends[tile])] = t
                    ends[tile] = ends[tile] + 1


@kernel(cse=False)
def draw(
    width: ti.i32,
    columns: ti.i32,
    has_picture: ti.i32,
    has_depths: ti.i32,
    edges: ARRAY,
    planes: ARRAY,
    boxes: ARRAY,
    ends: ARRAY,
    listed: ARRAY,
    shadows: ARRAY,
    picture: ARRAY,
    depths: ARRAY,
):
    """Draw tile by tile: colours into picture, and 1/depth into depths.

    A tile is drawn by pairs of rows, whose keys are local vectors: its z-buffer needs no memory.
    """
    for tile in range(ends.shape[0] - 1):
        first, last = 0, ti.i32(ends[tile])
        if tile > 0:
            first = ti.i32(ends[tile - 1])
        if first < last:
            top, left = tile // columns * TILE, tile % columns * TILE
            right = ti.min(left + TILE, width) - 1
            for pair in range(TILE // SAMPLES):
                row = top + SAMPLES * pair
                upper = ti.Vector([ti.i64(0)] * TILE)
                lower = ti.Vector([ti.i64(0)] * TILE)
                for index in range(first, last):
                    t = listed[index]
                    cover(upper, upper, False, t, index - first, row, left, right, edges, planes, boxes)
                    cover(lower, lower, False, t, index - first, row + 1, left, right, edges, planes, boxes)
                if has_picture and row // SAMPLES < picture.shape[0]:
                    resolve(upper, lower, first, row // SAMPLES, left // SAMPLES, planes, boxes, listed, shadows, picture)
                if has_depths:
                    for column in range(TILE):
                        if left + column < depths.shape[1]:
                            if row < depths.shape[0]:
                                depths[row, left + column] = ti.bit_cast(upper[column] & ~ORDINALS, ti.f64)
                            if row + 1 < depths.shape[0]:
                                depths[row + 1, left + column] = ti.bit_cast(lower[column] & ~ORDINALS, ti.f64)


@kernel(cse=False)
def peel(
    width: ti.i32,
    columns: ti.i32,
    edges: ARRAY,
    planes: ARRAY,
    boxes: ARRAY,
    ends: ARRAY,
    listed: ARRAY,
    opacities: ARRAY,
    shadows: ARRAY,
    picture: ARRAY,
):
    """Draw tile by tile as `draw` does, with opacities: the layers of every sample from front to back."""
    for tile in range(ends.shape[0] - 1):
        first, last = 0, ti.i32(ends[tile])
        if tile > 0:
            first = ti.i32(ends[tile - 1])
        left, right = tile % columns * TILE, ti.min(tile % columns * TILE + TILE, width) - 1
        top = tile // columns * WIDTH  # in pixels
        bottom = ti.select(first < last, ti.min(top + WIDTH, picture.shape[0]), top)
        for row in range(top, bottom):
            total = ti.Vector([ti.f64(0.0)] * (3 * WIDTH))
            for line in range(SAMPLES * row, SAMPLES * row + SAMPLES):
                behind = ti.Vector([ti.f64(1.0)] * TILE)  # fraction of the light behind that passes the layers so far
                limits = ti.Vector([ti.i64(NEAREST)] * TILE)
                goes_on = True
                while goes_on:
                    goes_on = False
                    keys = ti.Vector([ti.i64(0)] * TILE)
                    for index in range(first, last):
                        cover(keys, limits, True, listed[index], index - first, line, left, right, edges, planes, boxes)
                    for column in range(TILE):
                        if keys[column] > 0:
                            t = listed[first + ti.i32(keys[column] & ORDINALS)]
                            colour = colour_at(t, left + column + 0.5, line + 0.5, planes, boxes, shadows)
                            share = behind[column] * opacities[t]
                            for channel in ti.static(range(3)):
                                total[column // SAMPLES * 3 + channel] += share * colour[channel]
                            behind[column] -= share
                        limits[column] = ti.select(behind[column] > LEAST_LIGHT, keys[column], ti.i64(0))
                        goes_on = goes_on or limits[column] > 0
                for column in range(right - left + 1):
                    for channel in ti.static(range(3)):
                        under = ti.f64(picture[row, (left + column) // SAMPLES, channel])
                        total[column // SAMPLES * 3 + channel] += behind[column] * under
            for column in range((right - left + 1) // SAMPLES):
                for channel in ti.static(range(3)):
                    mean = total[3 * column + channel] / SAMPLES**2
                    picture[row, left // SAMPLES + column, channel] = ti.u8(ti.i32(mean + 0.5))


@ti.func
def cover(
    keys: ti.template(),
    limits: ti.template(),
    peels: ti.template(),
    t,
    ordinal,
    row,
    left,
    right,
    edges: ti.template(),
    planes: ti.template(),
    boxes: ti.template(),
):
    """Draw triangle t, number `ordinal` of its tile, into the keys of a row of samples; a key of 0 is the background.

    peels: only keys below the limits count, and a sample on an edge between two triangles belongs to one of them.
    """
    if boxes[t, 2] <= row and row <= boxes[t, 3]:
        y = ti.f64(row) + 0.5
        begin = ti.max(edges[t, 3] + edges[t, 0] * y, ti.max(edges[t, 4] + edges[t, 1] * y, edges[t, 5] + edges[t, 2] * y))
        end = ti.min(edges[t, 6] + edges[t, 0] * y, ti.min(edges[t, 7] + edges[t, 1] * y, edges[t, 8] + edges[t, 2] * y))
        if ti.static(peels):
            end = ti.ceil(ti.min(end - 0.5, right + 1.0)) - 0.5
        begin, end = ti.ceil(ti.max(begin - 0.5, ti.f64(left))), ti.floor(ti.min(end - 0.5, ti.f64(right)))
        if begin <= end:
            a, at_row = planes[t, 0], planes[t, 0] * (left + 0.5) + planes[t, 1] * y + planes[t, 2]
            number, first, last = ti.i64(ordinal), ti.i32(begin) - left, ti.i32(end) - left
            for column in range(TILE):  # all of the row: the compiler makes SIMD of a loop of fixed length
                key = ti.bit_cast(a * ti.f64(column) + at_row, ti.i64) & ~ORDINALS | number
                if ti.static(peels):
                    key = ti.select(key < limits[column], key, ti.i64(0))
                key = ti.select(column >= first and column <= last, key, ti.i64(0))
                keys[column] = ti.max(keys[column], key)
