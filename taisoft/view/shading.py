"""Colours of pixels from the z-buffer of a tile: attributes interpolated in perspective, shadow maps, and the mean of samples.

The attributes of a drawn point are its lit colour, its place in a shadow map in texels, and the number of that map, -1 if none.
"""

import taichi as ti

SAMPLES = 2  # per pixel and axis
TILE = 32  # samples per side of a tile
ORDINALS = 2**24 - 1  # bits of a key that number the triangle in its tile's list
MAP = 5  # column of the attributes
N_ATTRIBUTES = 6


@ti.func
def resolve(
    first,
    top,
    left,
    start,
    planes: ti.template(),
    boxes: ti.template(),
    listed: ti.template(),
    keys: ti.template(),
    shadows: ti.template(),
    picture: ti.template(),
):
    """Average the samples of a tile, keys[start] and the following, into the pixels from (top, left) on.

    A pixel inside one triangle takes the colour at its centre. The picture is the background of samples that nothing covers.
    """
    for pixel in range((TILE // SAMPLES) ** 2):
        i, j = pixel // (TILE // SAMPLES), pixel % (TILE // SAMPLES)
        row, column, at = top + i, left + j, start + SAMPLES * (i * TILE + j)
        a, b, c, d = keys[at], keys[at + 1], keys[at + TILE], keys[at + TILE + 1]
        alike = ti.min(ti.min(a, b), ti.min(c, d)) > 0 and ((a ^ b) | (a ^ c) | (a ^ d)) & ORDINALS == 0
        if a + b + c + d != 0 and row < picture.shape[0] and column < picture.shape[1]:
            total = ti.Vector([ti.f64(0.0)] * 3)
            count, offset = SAMPLES**2, ti.f64(0.5)
            if alike:
                count, offset = 1, ti.f64(0.5 * SAMPLES)
            for sample in range(count):
                below, beside = sample // SAMPLES, sample % SAMPLES
                key = keys[at + below * TILE + beside]
                if key > 0:
                    x, y = SAMPLES * column + beside + offset, SAMPLES * row + below + offset
                    total += colour_at(listed[first + ti.i32(key & ORDINALS)], x, y, planes, boxes, shadows)
                else:
                    for channel in ti.static(range(3)):
                        total[channel] += ti.f64(picture[row, column, channel])
            for channel in ti.static(range(3)):
                picture[row, column, channel] = ti.u8(total[channel] / count + 0.5)


@ti.func
def colour_at(t, x, y, planes: ti.template(), boxes: ti.template(), shadows: ti.template()):
    """Return the colour (3,) in [0, 255] of triangle t at a point of the picture, in samples."""
    depth = 1.0 / (planes[t, 0] * x + planes[t, 1] * y + planes[t, 2])
    light = 255.0 * depth
    if boxes[t, 4] >= 0:
        u = depth * (planes[t, 12] * x + planes[t, 13] * y + planes[t, 14])
        v = depth * (planes[t, 15] * x + planes[t, 16] * y + planes[t, 17])
        light = light * (1.0 - shadow_at(boxes[t, 4], u, v, shadows))
    colour = ti.Vector([ti.f64(0.0)] * 3)
    for channel in ti.static(range(3)):
        k = ti.static(3 + 3 * channel)
        value = light * (planes[t, k] * x + planes[t, k + 1] * y + planes[t, k + 2])
        colour[channel] = ti.min(ti.max(value, 0.0), 255.0)
    return colour


@ti.func
def shadow_at(index, u, v, shadows: ti.template()):
    """Interpolate a shadow map linearly between the centres of its texels; zero outside."""
    value = ti.f64(0.0)
    if u > 0.5 and v > 0.5 and u < shadows.shape[2] - 0.5 and v < shadows.shape[1] - 0.5:
        i, j = ti.min(ti.i32(v - 0.5), shadows.shape[1] - 2), ti.min(ti.i32(u - 0.5), shadows.shape[2] - 2)
        down, along = v - 0.5 - i, u - 0.5 - j
        upper = shadows[index, i, j] * (1.0 - along) + shadows[index, i, j + 1] * along
        lower = shadows[index, i + 1, j] * (1.0 - along) + shadows[index, i + 1, j + 1] * along
        value = upper * (1.0 - down) + lower * down
    return value
