"""How far two triangles can move along straight paths and certainly stay apart.

Corner k moves from x_k to x_k + p_k, in proportion to time. Two convex sets are apart as long as one plane separates them:

* a plane at rest: the height of a corner of one side over a corner of the other is linear in time, so the first of these nine
  heights that falls below the distance to be kept gives the time until which it is kept (conservative advancement: Mirtich
  1996);
* a plane that moves along, that of one triangle or, for two edges, the one parallel to both: the height of a corner above it,
  times the length of its normal, is a cubic polynomial in time, and positive if its Bernstein coefficients are. Bodies that turn
  together need this.

The plane across the shortest connection separates whatever is apart, so an advance repeated with it ends at the end of the motion
or where the triangles almost touch. A triangle may have coinciding corners: an edge, or a point.
"""

import taichi as ti

from taisoft.collision.features import closest_on_triangle
from taisoft.collision.intersections import closest_segments, row_of
from taisoft.collision.surface import dvec

MAX_ADVANCES = 64
LEAST, ROUNDING = 1e-3, 1e-12  # of the floor, and of the largest coordinate: distance below which triangles touch
BELOW_LEAST = 0.999  # of it: what was certified to keep that distance does not touch
N_PLANES = 15  # of `separating_plane`
PROGRESS = 2e-3  # of the remaining motion: an advance below it ends the search


@ti.func
def at_weights(corners, first, w):
    """Point (3,) of the triangle in rows first to first + 2, with weights w (3,)."""
    return w[0] * row_of(corners, first) + w[1] * row_of(corners, first + 1) + w[2] * row_of(corners, first + 2)


@ti.func
def unit_row(k):
    """Weights (3,) of corner k."""
    return dvec(ti.cast(k == 0, ti.f64), ti.cast(k == 1, ti.f64), ti.cast(k == 2, ti.f64))


@ti.func
def nearest_of(corners, k):
    """Nearest points of features k of two triangles in rows 0 to 2 and 3 to 5: weights (3,) of each, and their offset (3,) from
    the second to the first [m]. Features 0 to 5: that corner and the other triangle; 6 to 14: edges (k - 6) // 3 and k % 3."""
    a, b = unit_row(0), unit_row(0)
    if k < 6:
        first = k // 3 * 3
        w, _ = closest_on_triangle(row_of(corners, k), *[row_of(corners, j - first) for j in ti.static((3, 4, 5))])
        own = unit_row(k % 3)
        a, b = ti.select(first == 0, own, w), ti.select(first == 0, w, own)
    else:
        i, j = (k - 6) // 3, (k - 6) % 3
        i1, j1 = (i + 1) % 3, (j + 1) % 3
        s, t, _ = closest_segments(row_of(corners, i), row_of(corners, i1), row_of(corners, 3 + j), row_of(corners, 3 + j1))
        a, b = (1.0 - s) * unit_row(i) + s * unit_row(i1), (1.0 - t) * unit_row(j) + t * unit_row(j1)
    return a, b, at_weights(corners, 0, a) - at_weights(corners, 3, b)


@ti.func
def closest_features(corners):
    """The nearest features of two triangles, see `nearest_of`, and the offset (3,) between them [m]."""
    best, shortest, nearest = 0, dvec(0.0), ti.cast(ti.math.inf, ti.f64)
    for k in range(15):
        _, _, offset = nearest_of(corners, k)
        if offset.dot(offset) < nearest:
            best, shortest, nearest = k, offset, offset.dot(offset)
    return best, shortest


@ti.func
def _separation(corners, n):
    """Smallest height of rows 0 to 2 along n (3,) minus the largest of rows 3 to 5."""
    lowest, highest = ti.cast(ti.math.inf, ti.f64), ti.cast(-ti.math.inf, ti.f64)
    for k in range(3):
        lowest, highest = ti.min(lowest, row_of(corners, k).dot(n)), ti.max(highest, row_of(corners, 3 + k).dot(n))
    return lowest - highest


@ti.func
def _kept_until(y, q, n, need):
    """Fraction of a motion from corners y by q during which the separation along n, at least `need` [m] at first, stays so."""
    until = ti.cast(1.0, ti.f64)
    for i in range(3):
        for j in range(3):
            now = (row_of(y, i) - row_of(y, 3 + j)).dot(n) - need
            then = now + (row_of(q, i) - row_of(q, 3 + j)).dot(n)
            if then < 0.0:
                until = ti.min(until, ti.select(now > 0.0, now / (now - then), 0.0))
    return until


@ti.func
def _moving_plane_separates(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, need):
    """Whether points a, b and c stay at least `need` [m] from the plane through the origin, e and f, on one side; all (3,), at
    the start and at the end of a straight motion."""
    found, n0, n1, n2 = False, e0.cross(f0), 0.5 * (e0.cross(f1) + e1.cross(f0)), e1.cross(f1)
    if n0.dot(n1) > 0.0 and n0.dot(n2) > 0.0:
        longest = ti.max(n0.norm(), n1.norm(), n2.norm())
        low0, high0 = _extent(a0, b0, c0, n0)
        low3, high3 = _extent(a1, b1, c1, n2)
        # inner Bernstein coefficients of the three heights
        ha1, ha2 = a1.dot(n0) + 2.0 * a0.dot(n1), 2.0 * a1.dot(n1) + a0.dot(n2)
        hb1, hb2 = b1.dot(n0) + 2.0 * b0.dot(n1), 2.0 * b1.dot(n1) + b0.dot(n2)
        hc1, hc2 = c1.dot(n0) + 2.0 * c0.dot(n1), 2.0 * c1.dot(n1) + c0.dot(n2)
        lowest = ti.min(low0, low3, ti.min(ha1, ha2, hb1, hb2, hc1, hc2) / 3.0)
        highest = ti.max(high0, high3, ti.max(ha1, ha2, hb1, hb2, hc1, hc2) / 3.0)
        found = lowest >= need * longest or highest <= -need * longest
    return found


@ti.func
def _any_moving_plane_separates(x, p, need, are_edges):
    """Whether the plane of one of the triangles, moving with it, stays at least `need` [m] from all corners of the other; or, for
    two edges, the plane through one of them and parallel to the other from that one."""
    found = False
    for side in range(int(are_edges), 2):
        base, other = ti.select(side == 0, 3, 0), ti.select(side == 0, 0, 3)
        a, b, c = row_of(x, base), row_of(x, base + 1), row_of(x, base + 2)
        a1, b1, c1 = a + row_of(p, base), b + row_of(p, base + 1), c + row_of(p, base + 2)
        f, f1 = c - a, c1 - a1
        if are_edges:
            f = row_of(x, 4) - row_of(x, 3)
            f1 = f + row_of(p, 4) - row_of(p, 3)
        d, e, g = row_of(x, other), row_of(x, other + 1), row_of(x, other + 2)
        d1, e1, g1 = d + row_of(p, other) - a1, e + row_of(p, other + 1) - a1, g + row_of(p, other + 2) - a1
        found = found or _moving_plane_separates(d - a, e - a, g - a, b - a, f, d1, e1, g1, b1 - a1, f1, need)
    return found


@ti.func
def _of_features(corners, k):
    """The corners (6,3) of features k alone, see `nearest_of`, or all of them for k = -1."""
    result = 1.0 * corners
    for q in ti.static(range(6)):
        source = q
        if 0 <= k < 6 and q // 3 == k // 3:
            source = k
        elif k >= 6:
            i, j = (k - 6) // 3, (k - 6) % 3
            first, second = ti.select(q < 3, i, 3 + j), ti.select(q < 3, (i + 1) % 3, 3 + (j + 1) % 3)
            source = ti.select(q % 3 == 0, first, second)
        point = row_of(corners, source)
        for axis in ti.static(range(3)):
            result[q, axis] = point[axis]
    return result


@ti.func
def free_until(x, p, radius, floor, are_apart):
    """Fraction of the motion during which two triangles certainly stay apart, 1 if they do to its end; and the features that
    meet first, see `nearest_of`.

    x, p: (6,3) corners [m], three of each, and their displacements [m]; radius [m]: by which the second one is thicker; floor
    [m]: distance that they keep, or half of their first distance if that is less, but never below LEAST of the floor or
    ROUNDING of the coordinates. are_apart: whether they are known not to cross at first. 0 if they are nearer than that at
    first: they touch. Triangles that no plane separates for long, as they turn, are taken apart into their features, corner
    and triangle or two edges: if these stay apart, triangles that do not cross at first do not later.
    """
    result, features, k = ti.cast(1.0, ti.f64), 0, -1
    least = ti.cast(LEAST, ti.f64) * floor
    for q in range(6):
        least = ti.max(least, ti.cast(ROUNDING, ti.f64) * ti.abs(row_of(x, q)).max())
    while k < 15:
        own_x, own_p = _of_features(x, k), _of_features(p, k)
        time, need, part, n = ti.cast(0.0, ti.f64), floor, ti.cast(-1.0, ti.f64), 0
        while part < 0.0:
            y, q = own_x + time * own_p, (1.0 - time) * own_p
            middle = at_weights(y, 0, dvec(1.0)) - at_weights(y, 3, dvec(1.0))
            size = (need + radius) * middle.norm()
            if _separation(y, middle) >= size and _separation(y + q, middle) >= size and size > 0.0:
                part = 1.0
            elif _any_moving_plane_separates(y, q, need + radius, k >= 6):
                part = 1.0
            else:
                _, offset = closest_features(y)
                length = offset.norm()
                if length - radius < ti.cast(BELOW_LEAST, ti.f64) * least:  # they touch, on an unknown side
                    part = time
                elif n == 0 and 0.5 * (length - radius) < need:
                    need = ti.min(floor, ti.max(0.5 * (length - radius), least))  # the planes are then tried once more
                else:
                    later = time
                    if length - radius > need:
                        kept = _kept_until(y, q, offset / length, need + radius)
                        later += (1.0 - time) * kept
                        if kept >= 1.0:
                            part = 1.0
                    if part < 0.0 and (later - time < ti.cast(PROGRESS, ti.f64) * (1.0 - time) or n >= MAX_ADVANCES):
                        part = later
                    time = later
            n += 1
        if k == -1 and not are_apart:
            result = part
        if k == -1 and (part >= 1.0 or not are_apart):
            k = 15
        elif k >= 0 and part < result:
            result, features = part, k
        k += 1
    return result, features


@ti.func
def _extent(a, b, c, n):
    """Least and largest height of three points over the origin along n (3,)."""
    p, q, r = a.dot(n), b.dot(n), c.dot(n)
    return ti.min(p, q, r), ti.max(p, q, r)


@ti.func
def _axis_separates(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, need):
    """Whether a plane across a coordinate axis does, see `_plane_separates`."""
    zero = dvec(0.0)
    low_a0, high_a0, low_e0, high_e0 = ti.min(a0, b0, c0), ti.max(a0, b0, c0), ti.min(zero, e0, f0), ti.max(zero, e0, f0)
    low_a1, high_a1, low_e1, high_e1 = ti.min(a1, b1, c1), ti.max(a1, b1, c1), ti.min(zero, e1, f1), ti.max(zero, e1, f1)
    above, below = ti.min(low_a0 - high_e0, low_a1 - high_e1), ti.min(low_e0 - high_a0, low_e1 - high_a1)
    return ti.max(above, below).max() >= need


@ti.func
def _plane_separates(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, n, need):
    """Whether a plane at rest across n (3,) keeps points a, b and c at least `need` [m] from the origin, e and f; all (3,), at
    the start and at the end of a straight motion."""
    low_a0, high_a0 = _extent(a0, b0, c0, n)
    low_a1, high_a1 = _extent(a1, b1, c1, n)
    low_e0, high_e0 = _extent(dvec(0.0), e0, f0, n)
    low_e1, high_e1 = _extent(dvec(0.0), e1, f1, n)
    size = need * n.norm()
    above, below = ti.min(low_a0 - high_e0, low_a1 - high_e1), ti.min(low_e0 - high_a0, low_e1 - high_a1)
    return size > 0.0 and ti.max(above, below) >= size


@ti.func
def _edge(k, a, b, c):
    """Edge k of a triangle."""
    return ti.select(k == 0, b - a, ti.select(k == 1, c - b, a - c))


@ti.func
def separating_plane(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, need, first, tried):
    """Number of a plane that keeps triangles abc and def at least `need` [m] apart on straight paths, -1 if none of a few that
    are cheap to test does. All (3,): corners at the start and at the end, relative to corner d.

    0: across an axis; 1: between their middles; 2, 3: that of def, of abc, at the start; 4, 5: the same, moving along; 6 to 14:
    along an edge of each at the start, numbered as in `nearest_of`. first: the number to be tried first, since one plane mostly
    serves for many steps; whether there is one does not depend on it. tried: 1 to skip 0, which is then known to fail.
    """
    found, k = -1, 0
    while k < N_PLANES and found < 0:
        plane = ti.select(k == 0, first, ti.select(k > first, k, k - 1))
        separates = False
        if tried == 1 and plane == 0:
            pass
        elif plane == 0:
            separates = _axis_separates(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, need)
        elif plane < 4 or plane > 5:
            n = (a0 + b0 + c0) - (e0 + f0)
            if plane == 2:
                n = e0.cross(f0)
            elif plane == 3:
                n = (b0 - a0).cross(c0 - a0)
            elif plane > 5:
                n = _edge((plane - 6) // 3, a0, b0, c0).cross(_edge(plane % 3, dvec(0.0), e0, f0))
            separates = _plane_separates(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, n, need)
        else:
            p0, q0, r0, u0, v0 = a0, b0, c0, e0, f0
            p1, q1, r1, u1, v1 = a1, b1, c1, e1, f1
            if plane == 5:
                p0, q0, r0, u0, v0 = -a0, e0 - a0, f0 - a0, b0 - a0, c0 - a0
                p1, q1, r1, u1, v1 = -a1, e1 - a1, f1 - a1, b1 - a1, c1 - a1
            separates = _moving_plane_separates(p0, q0, r0, u0, v0, p1, q1, r1, u1, v1, need)
        if separates:
            found = plane
        k += 1
    return found
