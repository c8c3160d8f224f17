"""Deepest point of a triangle in a signed distance field: min phi over its barycentric coordinates (report, section 2.3.2).

Frank-Wolfe with pairwise steps, starting at the corner of smallest phi. Each step moves weight from the corner of largest slope
among those with weight to the corner of smallest slope, until the gap (x - s) . grad phi is closed. Every third step follows the
sum of the last two, because steps between corners alone zigzag. The plain step 2 / (i + 2) of Macklin et al. 2020 converges like
1 / i; pairwise steps with a line search converge linearly (Lacoste-Julien, Jaggi 2015, NIPS). The line search is the Illinois
method (a bracketed secant on the slope), so phi needs a gradient but no curvature. Weak: finds a local minimum if phi is not
convex; may stop early at a kink of phi inside the triangle, but never at a higher phi than it started with.

`field.sample(k, p)` gives phi [m] and its gradient (3,) of field k at p (3,) [m].
"""

import taichi as ti

from taisoft.collision.features import choose, corner, opposite, unit
from taisoft.collision.surface import dvec

MAX_STEPS, MAX_TRIALS = 24, 6  # maximum steps, and maximum trials per line search
GAP_TOLERANCE = 1e-7  # of the triangle's size: Frank-Wolfe gap at convergence
ALIGNMENT_SINE = 0.26  # sine of 15 degrees: tolerance of grad phi in the conditions of a minimum
MIN_EXTRA_DEPTH = 1e-5  # of a triangle's size: depth below its corners from which its deepest point is a contact


@ti.func
def _argmin(slope):
    """Index of the smallest entry."""
    k = 0
    if slope[1] < slope[0]:
        k = 1
    if slope[2] < ti.min(slope[0], slope[1]):
        k = 2
    return k


@ti.func
def _argmax_weighted(slope, w):
    """Index of the largest slope among corners with positive weight."""
    k, largest = 0, -ti.cast(ti.math.inf, ti.f64)
    for j in ti.static(range(3)):
        if w[j] > 0.0 and slope[j] > largest:
            k, largest = j, slope[j]
    return k


@ti.func
def _line_search(field: ti.template(), k, x, d, max_step, phi, slope, tiny):
    """Best step in (0, max_step] from x along d, where phi falls with `slope`, or 0 if none lowers phi; and phi there."""
    lo, hi, f_lo, f_hi = ti.cast(0.0, ti.f64), max_step, slope, ti.cast(0.0, ti.f64)
    best, best_phi = ti.cast(0.0, ti.f64), phi
    alpha = max_step
    trial = 0
    while trial < MAX_TRIALS:
        p, q = field.sample(k, x + alpha * d)
        f = q.dot(d)
        if p < best_phi:
            best, best_phi = alpha, p
        if trial == 0 and f <= 0.0:  # still falling at the end
            trial = MAX_TRIALS
        elif f > 0.0:
            if trial > 0:
                f_lo *= 0.5
            hi, f_hi = alpha, f
        else:
            lo, f_lo = alpha, f
            f_hi *= 0.5
        if ti.abs(f) <= tiny:
            trial = MAX_TRIALS
        alpha = lo + (hi - lo) * f_lo / ti.min(f_lo - f_hi, -1e-30)
        trial += 1
    return best, best_phi


@ti.func
def _max_step(w, d):
    """Largest step from weights w (3,) along d (3,) that keeps all non-negative, and the corner whose weight becomes 0."""
    max_step, last = ti.cast(ti.math.inf, ti.f64), 0
    for j in ti.static(range(3)):
        if d[j] < 0.0 and -w[j] / d[j] < max_step:
            max_step, last = -w[j] / d[j], j
    return max_step, last


@ti.func
def deepest_point(field: ti.template(), k, A, B, C, phi_corner):
    """Barycentric coordinates (3,) and phi of the deepest point of triangle A B C (3,) [m]. phi_corner: (3,) at its corners."""
    at = _argmin(phi_corner)
    w = dvec(ti.cast(at == 0, ti.f64), ti.cast(at == 1, ti.f64), ti.cast(at == 2, ti.f64))
    before, last = 1.0 * w, 1.0 * w  # weights two steps and one step ago
    size = ti.max((A - B).norm(), (B - C).norm(), (C - A).norm())
    tiny = ti.cast(GAP_TOLERANCE, ti.f64) * size
    x = choose(at, A, B, C)
    phi = phi_corner.min()
    step = 0
    while step < MAX_STEPS:
        _, g = field.sample(k, x)
        slope = dvec(A.dot(g), B.dot(g), C.dot(g))
        if w.dot(slope) - slope.min() <= tiny:
            step = MAX_STEPS
        else:
            best, value, max_step, end = ti.cast(0.0, ti.f64), phi, ti.cast(0.0, ti.f64), 0
            direction = dvec(0.0)
            for trial in range(2):  # along the sum of the last two steps, else from one corner to another
                if trial == 1:
                    if best == 0.0:
                        target, source = _argmin(slope), _argmax_weighted(slope, w)
                        for j in ti.static(range(3)):
                            direction[j] = ti.cast(j == target, ti.f64) - ti.cast(j == source, ti.f64)
                elif step % 3 == 2:
                    direction = w - before
                if best == 0.0 and direction.dot(slope) < 0.0:
                    max_step, end = _max_step(w, direction)
                    d = direction[0] * A + direction[1] * B + direction[2] * C
                    best, value = _line_search(field, k, x, d, max_step, phi, d.dot(g), tiny)
            if best == 0.0:
                step = MAX_STEPS
            else:
                for j in ti.static(range(3)):
                    before[j] = last[j]
                    last[j] = w[j]
                    w[j] = ti.max(w[j] + best * direction[j], 0.0)
                    if j == end and best >= max_step:
                        w[j] = 0.0
                w /= w.sum()
                x = w[0] * A + w[1] * B + w[2] * C
                phi = value
        step += 1
    return w, phi


@ti.func
def is_surface_minimum(s: ti.template(), t, w, n, x):
    """1 if the deepest point x of triangle t, weights w, is also a local minimum of the whole surface that faces n.

    To within ALIGNMENT_SINE, n must oppose the triangle's normal at an interior point and be perpendicular to the edge at a point
    on an edge: at a kink of phi, as in the middle of a box, no gradient gives the exit direction. On an edge, the neighbour must
    not lie deeper, and only the triangle that owns the edge accepts.
    """
    facing = s.normal[t]
    valid = 1
    zero_corner = -1
    for j in ti.static(range(3)):
        if w[j] <= 0.0:
            zero_corner = j
    if zero_corner >= 0:
        k = (zero_corner + 1) % 3  # the edge opposite the corner of zero weight
        valid = (s.owns[t] >> (3 + k)) & 1
        along = unit(corner(s, t, k + 1) - corner(s, t, k))
        if ti.abs(along.dot(n)) > ALIGNMENT_SINE:
            valid = 0
        v = s.neighbour[t, k]
        if v >= 0:
            facing += s.normal[v]
            e = s.x[opposite(s, v, s.triangle[t, k], s.triangle[t, (k + 1) % 3])] - x
            if e.dot(n) < -0.05 * e.norm():
                valid = 0
        if facing.dot(n) >= 0.0:
            valid = 0
    elif facing.cross(n).norm() > ALIGNMENT_SINE or facing.dot(n) > 0.0:
        valid = 0
    return valid
