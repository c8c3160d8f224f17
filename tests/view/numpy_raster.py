"""A z-buffer rasteriser in NumPy, the reference of that by kernels.

Triangles are cut into spans of pixel rows, and spans into pixels whose centre is inside. The nearest triangle of each pixel is
drawn, with its corner colours interpolated in perspective. The z-buffer holds 1/depth, which is linear in the picture.
"""

import numpy as np

from taisoft.view.raster import MAX_COORDINATE
from taisoft.view.shading import SAMPLES

PIXELS_AT_ONCE = 2_000_000  # bounds the memory, about 100 bytes per pixel


def rasterise(projected: np.ndarray, triangles: np.ndarray, colours: np.ndarray, near: float, image: np.ndarray) -> np.ndarray:
    """Draw triangles over image (height, width, 3), uint8 and contiguous; return the mask of the pixels drawn.

    projected: (n,3) pixel coordinates and depth; triangles: (t,3); colours: (n,3) in [0, 1]. Triangles that reach
    nearer than `near`, or are not finite, are skipped; both sides of a triangle are drawn.
    """
    height, width = image.shape[:2]
    corners = projected[triangles]
    with np.errstate(invalid="ignore"):
        visible = (corners[:, :, 2] > near).all(axis=1) & (np.abs(corners[:, :, :2]) < MAX_COORDINATE).all(axis=(1, 2))
    triangles, corners = triangles[visible], corners[visible]
    planes, area = _edge_functions(corners[:, :, :2])
    triangles, corners, planes = triangles[area > 0], corners[area > 0], planes[area > 0]
    inverse = 1.0 / corners[:, :, 2]
    depth_plane = np.einsum("tk,tkm->tm", inverse, planes)  # 1/depth = a x + b y + c

    nearest = np.zeros(height * width)  # 1/depth
    owner = np.full(height * width, -1)
    for triangle, row, first, count in _spans(corners, planes, width, height):
        span, pixels = _expand(row * width + first, count)
        slope = depth_plane[triangle, 0]
        start = slope * 0.5 + depth_plane[triangle, 1] * (row + 0.5) + depth_plane[triangle, 2] - slope * (row * width)
        depth = start[span] + slope[span] * pixels
        np.maximum.at(nearest, pixels, depth)
        in_front = np.flatnonzero(depth >= nearest[pixels])
        owner[pixels[in_front]] = triangle[span[in_front]]

    drawn = np.flatnonzero(owner >= 0)
    owners = owner[drawn]
    # colour / depth is linear in the picture too
    colour_planes = np.einsum("tk,tkc,tkm->tcm", inverse, colours[triangles], planes)[owners]
    x, y = drawn % width + 0.5, drawn // width + 0.5
    pixel_colours = colour_planes[..., 0] * x[:, None] + colour_planes[..., 1] * y[:, None] + colour_planes[..., 2]
    pixel_colours /= nearest[drawn, None]
    image.reshape(-1, 3)[drawn] = (255 * np.clip(pixel_colours, 0.0, 1.0) + 0.5).astype(np.uint8)
    return (owner >= 0).reshape(height, width)


def averaged(image: np.ndarray) -> np.ndarray:
    """Return an image with every block of SAMPLES x SAMPLES pixels averaged into one."""
    total = np.zeros((image.shape[0] // SAMPLES, image.shape[1] // SAMPLES, 3), dtype=np.uint16)
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            total += image[i::SAMPLES, j::SAMPLES]
    return ((total + SAMPLES**2 // 2) // SAMPLES**2).astype(np.uint8)


def _edge_functions(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric weights of triangles (t,3,2) as planes (t,3,3), weight k = a x + b y + c, and twice |area| (t,)."""
    q, r = np.roll(p, -1, axis=1), np.roll(p, -2, axis=1)  # weight k vanishes on the edge from q to r
    a, b = q[..., 1] - r[..., 1], r[..., 0] - q[..., 0]
    planes = np.stack([a, b, -(a * q[..., 0] + b * q[..., 1])], axis=2)
    area = (a[:, 0] * p[:, 0, 0] + b[:, 0] * p[:, 0, 1]) + planes[:, 0, 2]
    planes /= np.where(area != 0, area, 1.0)[:, None, None]  # signed, so that inside is positive for either orientation
    return planes, np.abs(area)


def _spans(corners: np.ndarray, planes: np.ndarray, width: int, height: int):
    """Yield (triangle, row, first pixel, number of pixels) arrays of the covered spans, about PIXELS_AT_ONCE pixels at a time."""
    low = np.clip(np.ceil(corners[:, :, 1].min(axis=1) - 0.5), 0, height).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, 1].max(axis=1) - 0.5), -1, height - 1).astype(np.int64)
    owner, row = _expand(low, np.maximum(high - low + 1, 0))
    a, b, c = np.moveaxis(planes[owner], 2, 0)
    rest = b * (row + 0.5)[:, None] + c  # weight k = a x + rest >= 0 inside
    with np.errstate(divide="ignore", invalid="ignore"):
        root = -rest / a
    left = np.where(a > 0, root, -np.inf).max(axis=1)
    right = np.where(a < 0, root, np.inf).min(axis=1)
    outside = ((a == 0) & (rest < 0)).any(axis=1)
    first = np.clip(np.ceil(left - 0.5), 0, width).astype(np.int64)
    last = np.clip(np.floor(right - 0.5), -1, width - 1).astype(np.int64)
    count = np.where(outside, 0, np.maximum(last - first + 1, 0))
    kept = np.flatnonzero(count)
    owner, row, first, count = owner[kept], row[kept], first[kept], count[kept]
    total = np.cumsum(count)
    cuts = np.searchsorted(total, np.arange(PIXELS_AT_ONCE, total[-1] if len(total) else 0, PIXELS_AT_ONCE))
    for part in np.split(np.arange(len(count)), cuts):
        yield owner[part], row[part], first[part], count[part]


def _expand(start: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Expand ranges start, start+1, ... of count items: return the range that each item belongs to, and the item."""
    index = np.repeat(np.arange(len(count)), count)
    offset = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
    return index, start[index] + offset
