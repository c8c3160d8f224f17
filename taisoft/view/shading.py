"""Colours of pixels from the keys of their samples: attributes interpolated in perspective, shadow maps, and means of samples.

The attributes of a drawn point are its lit colour, its place in a shadow map in texels, and the number of that map, -1 if none.
"""

import taichi as ti

SAMPLES = 2  # per pixel and axis
TILE = 32  # samples per side of a tile
ORDINALS = 2**24 - 1  # bits of a key that number the triangle in its tile's list
MAP = 5  # column of the attributes
N_ATTRIBUTES = 6
WIDTH = TILE // SAMPLES  # of a tile in pixels


@ti.func
def resolve(
    upper: ti.template(),
    lower: ti.template(),
    first,
    row,
    left,
    planes: ti.template(),
    boxes: ti.template(),
    listed: ti.template(),
    shadows: ti.template(),
    picture: ti.template(),
):
    """Average two rows of samples into a row of pixels from `left` on.

    A pixel inside one triangle takes the colour at its centre. The picture is the background of samples that nothing covers.
    """
    lowest, differs = upper[0], ti.i64(0)
    for column in range(TILE):
        lowest = ti.min(lowest, ti.min(upper[column], lower[column]))
        differs = differs | (upper[column] ^ upper[0]) | (lower[column] ^ upper[0])
    width, t = ti.min(WIDTH, picture.shape[1] - left), listed[first + ti.i32(upper[0] & ORDINALS)]
    if lowest > 0 and differs & ORDINALS == 0 and not is_shaded(t, SAMPLES * left, SAMPLES * row + 1, planes, boxes, shadows):
        fill(t, row, left, width, planes, picture)
        width = 0
    for j in range(width):
        at, column = SAMPLES * j, left + j
        a, b, c, d = upper[at], upper[at + 1], lower[at], lower[at + 1]
        alike = ti.min(ti.min(a, b), ti.min(c, d)) > 0 and ((a ^ b) | (a ^ c) | (a ^ d)) & ORDINALS == 0
        if (a | b | c | d) != 0:
            total = ti.Vector([ti.f64(0.0)] * 3)
            count, offset, share = SAMPLES**2, ti.f64(0.5), ti.f64(1.0 / SAMPLES**2)
            if alike:
                count, offset, share = 1, ti.f64(0.5 * SAMPLES), ti.f64(1.0)
            for sample in range(count):
                key = a
                if sample == 1:
                    key = b
                elif sample == 2:
                    key = c
                elif sample == 3:
                    key = d
                if key > 0:
                    x, y = SAMPLES * column + sample % SAMPLES + offset, SAMPLES * row + sample // SAMPLES + offset
                    total += colour_at(listed[first + ti.i32(key & ORDINALS)], x, y, planes, boxes, shadows)
                else:
                    for channel in ti.static(range(3)):
                        total[channel] += ti.f64(picture[row, column, channel])
            for channel in ti.static(range(3)):
                picture[row, column, channel] = ti.u8(ti.i32(total[channel] * share + 0.5))


@ti.func
def fill(t, row, left, width, planes: ti.template(), picture: ti.template()):
    """Draw a row of pixels that triangle t covers, without shadows; the loops of fixed length become SIMD."""
    y = ti.f64(SAMPLES * row + 0.5 * SAMPLES)
    light = ti.Vector([ti.f64(0.0)] * WIDTH)
    value = ti.Vector([ti.f64(0.0)] * WIDTH)
    a, rest = planes[t, 0], planes[t, 1] * y + planes[t, 2]
    for j in range(WIDTH):
        light[j] = 255.0 / (a * ti.f64(SAMPLES * (left + j) + 0.5 * SAMPLES) + rest)
    for channel in range(3):
        a, rest = planes[t, 3 + 3 * channel], planes[t, 4 + 3 * channel] * y + planes[t, 5 + 3 * channel]
        for j in range(WIDTH):
            value[j] = light[j] * (a * ti.f64(SAMPLES * (left + j) + 0.5 * SAMPLES) + rest)
        for j in range(width):
            picture[row, left + j, channel] = ti.u8(ti.i32(ti.min(ti.max(value[j], 0.0), 255.0) + 0.5))


@ti.func
def is_shaded(t, x, y, planes: ti.template(), boxes: ti.template(), shadows: ti.template()):
    """Return whether the row of pixels from sample x on may meet triangle t's shadow map, in which it is a straight line."""
    shaded = boxes[t, 4] >= 0
    if shaded:
        u0, v0 = texel_at(t, ti.f64(x), ti.f64(y), planes)
        u1, v1 = texel_at(t, ti.f64(x + TILE), ti.f64(y), planes)
        aside = ti.max(u0, u1) < 0.5 or ti.max(v0, v1) < 0.5
        shaded = not (aside or ti.min(u0, u1) > shadows.shape[2] - 0.5 or ti.min(v0, v1) > shadows.shape[1] - 0.5)
    return shaded


@ti.func
def texel_at(t, x, y, planes: ti.template()):
    """Return the place of a point of the picture in the shadow map of triangle t."""
    depth = 1.0 / (planes[t, 0] * x + planes[t, 1] * y + planes[t, 2])
    u = depth * (planes[t, 12] * x + planes[t, 13] * y + planes[t, 14])
    return u, depth * (planes[t, 15] * x + planes[t, 16] * y + planes[t, 17])


@ti.func
def colour_at(t, x, y, planes: ti.template(), boxes: ti.template(), shadows: ti.template()):
    """Return the colour (3,) in [0, 255] of triangle t at a point of the picture, in samples."""
    depth = 1.0 / (planes[t, 0] * x + planes[t, 1] * y + planes[t, 2])
    light = 255.0 * depth
    if boxes[t, 4] >= 0:
        u, v = texel_at(t, x, y, planes)
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
