"""The deepest point of a triangle in a signed distance: min phi over its barycentric coordinates (report, section 2.3.2).

Frank-Wolfe with pairwise steps: from the corner of least phi, weight goes from the corner of largest slope that has any to the
corner of least slope, until the gap (x - s) . grad phi closes; every third step goes along the last two together, because steps
between corners alone zigzag. The plain step 2 / (i + 2) of Macklin et al. 2020 converges like
1 / i; pairwise steps with a line search converge linearly (Lacoste-Julien, Jaggi 2015, NIPS). The line search is that of
Illinois (a bracketed secant on the slope), so phi needs a gradient and no curvature. Weak: a local minimum, where phi
is not convex; at a kink of phi inside the triangle it may stop early, never at a higher phi than it began with.

`field.sample(k, p)` gives phi [m] and its gradient (3,) of field k at p (3,) [m].
"""

import taichi as ti

from taisoft.collision.surface import dvec
from taisoft.collision.triangles import choose

STEPS, SEARCH = 24, 6  # at most
CLOSED = 1e-7  # Frank-Wolfe gap, in lengths of the triangle, at which the point counts as found


@ti.func
def _least(slope):
    """Number of the least entry."""
    k = 0
    if slope[1] < slope[0]:
        k = 1
    if slope[2] < ti.min(slope[0], slope[1]):
        k = 2
    return k


@ti.func
def _steepest(slope, w):
    """Number of the largest entry among those with weight."""
    k, most = 0, -ti.cast(ti.math.inf, ti.f64)
    for j in ti.static(range(3)):
        if w[j] > 0.0 and slope[j] > most:
            k, most = j, slope[j]
    return k


@ti.func
def _line_search(field: ti.template(), k, x, d, most, phi, slope, tiny):
    """Best step in (0, most] from x along d, where phi falls with `slope`; 0 where none lowers phi. Also phi there."""
    lo, hi, f_lo, f_hi = ti.cast(0.0, ti.f64), most, slope, ti.cast(0.0, ti.f64)
    best, best_phi = ti.cast(0.0, ti.f64), phi
    alpha = most
    trial = 0
    while trial < SEARCH:
        p, q = field.sample(k, x + alpha * d)
        f = q.dot(d)
        if p < best_phi:
            best, best_phi = alpha, p
        if trial == 0 and f <= 0.0:  # still falling at the end
            trial = SEARCH
        elif f > 0.0:
            if trial > 0:
                f_lo *= 0.5
            hi, f_hi = alpha, f
        else:
            lo, f_lo = alpha, f
            f_hi *= 0.5
        if ti.abs(f) <= tiny:
            trial = SEARCH
        alpha = lo + (hi - lo) * f_lo / ti.min(f_lo - f_hi, -1e-30)
        trial += 1
    return best, best_phi


@ti.func
def _room(w, d):
    """Longest step from weights w (3,) along d (3,) that leaves none negative, and the corner whose weight it takes."""
    most, last = ti.cast(ti.math.inf, ti.f64), 0
    for j in ti.static(range(3)):
        if d[j] < 0.0 and -w[j] / d[j] < most:
            most, last = -w[j] / d[j], j
    return most, last


@ti.func
def deepest_point(field: ti.template(), k, A, B, C, phi_corner):
    """Barycentric coordinates (3,) and phi of the deepest point of triangle A B C (3,) [m]. phi_corner: (3,) at its corners."""
    at = _least(phi_corner)
    w = dvec(ti.cast(at == 0, ti.f64), ti.cast(at == 1, ti.f64), ti.cast(at == 2, ti.f64))
    before, last = dvec(0.0), dvec(0.0)  # weights two steps and one step before
    for j in ti.static(range(3)):
        before[j] = w[j]
        last[j] = w[j]
    size = ti.max((A - B).norm(), (B - C).norm(), (C - A).norm())
    tiny = ti.cast(CLOSED, ti.f64) * size
    x = choose(at, A, B, C)
    phi = phi_corner.min()
    step = 0
    while step < STEPS:
        _, g = field.sample(k, x)
        slope = dvec(A.dot(g), B.dot(g), C.dot(g))
        if w.dot(slope) - slope.min() <= tiny:
            step = STEPS
        else:
            best, value, room, end = ti.cast(0.0, ti.f64), phi, ti.cast(0.0, ti.f64), 0
            turn = dvec(0.0)
            for trial in range(2):  # along the last two steps taken together, else from one corner to another
                if trial == 1:
                    if best == 0.0:
                        to, back = _least(slope), _steepest(slope, w)
                        for j in ti.static(range(3)):
                            turn[j] = ti.cast(j == to, ti.f64) - ti.cast(j == back, ti.f64)
                elif step % 3 == 2:
                    for j in ti.static(range(3)):
                        turn[j] = w[j] - before[j]
                if best == 0.0 and turn.dot(slope) < 0.0:
                    room, end = _room(w, turn)
                    d = turn[0] * A + turn[1] * B + turn[2] * C
                    best, value = _line_search(field, k, x, d, room, phi, d.dot(g), tiny)
            if best == 0.0:
                step = STEPS
            else:
                for j in ti.static(range(3)):
                    before[j] = last[j]
                    last[j] = w[j]
                    w[j] = ti.max(w[j] + best * turn[j], 0.0)
                    if j == end and best >= room:
                        w[j] = 0.0
                total = w.sum()
                for j in ti.static(range(3)):
                    w[j] /= total
                x = w[0] * A + w[1] * B + w[2] * C
                phi = value
        step += 1
    return w, phi
