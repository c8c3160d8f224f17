"""Springs, tendons and attachments: node j gets -c_j (T + damping) e / |e| of each element; psi = sum k (l - L)^2 / 2 + T_0 l.

`fem.spring_table` defines the elements and their lines. Before forces are gathered, `prepare` computes for each line its
elements' directions and pulls from x and v; given tensions, which Newton's method may change without moving nodes, act when
forces are gathered. Blocks of the stiffness are
    c_i c_j (k d d'^T + [same element] T H),   H = q / m I - d d^T / (|e| q^2),
    m = max(|e|, s),   q = 2 - min(1, |e| / s),   d = q e / m,
d' of any element of the line, or k I for an element of rest length 0. d and H are the derivatives of the smoothed length; from
|e| = s on, they are e / |e| and (I - d d^T) / |e|. At |e| = 0 an element that has a rest length does not pull.
"""

import taichi as ti

from taisoft.fem.lanes import add_entry
from taisoft.fem.spring_table import LENGTH, MULTIPLIER, PLAIN

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = "springs", False, False, True, True
TINY = 1e-30  # [m]; avoids a division by 0, and is no smaller since literals may be f32


@ti.func
def count(m: ti.template()):
    """Number of lines."""
    return m.springs.n_lines


@ti.func
def _vector(m: ti.template(), s):
    """e of element s [m]."""
    e = m.springs.offset[s]
    if ti.static(m.springs.has_moving):
        at = m.springs.moving[s]
        if at >= 0:
            e = ti.Vector([m.amplitudes[at], m.amplitudes[at + 1], m.amplitudes[at + 2]], ti.f64)
    for k in range(m.springs.start[s], m.springs.start[s + 1]):
        e += m.springs.weight[k] * m.state.x[m.springs.node[k]]
    return e


@ti.func
def _given_tension(m: ti.template(), s):
    """T_0 of element s [N]."""
    tension = ti.cast(0.0, ti.f64)
    if ti.static(m.springs.has_tensions):
        if m.springs.slot[s] >= 0 and m.springs.kind[s] != LENGTH:
            tension = m.amplitudes[m.springs.slot[s]]
    return tension


@ti.func
def _stretching(m: ti.template(), s, length):
    """k (l - L) [N] of a line with first element s and length l."""
    stretch = length - m.springs.numbers[s, 1]
    if ti.static(m.springs.has_lengths):
        if m.springs.kind[s] == LENGTH:
            stretch = ti.max(length - m.amplitudes[m.springs.slot[s]], 0.0)
    return m.springs.numbers[s, 0] * stretch


@ti.func
def _is_isotropic(m: ti.template(), s):
    """Whether element s has neither a rest length nor an amplitude."""
    return m.springs.numbers[s, 1] == 0.0 and m.springs.kind[s] == PLAIN


@ti.func
def _shape(m: ti.template(), s, length):
    """q of element s with |e| = length."""
    return 2.0 - ti.min(1.0, length / ti.max(m.springs.numbers[s, 3], TINY))


@ti.func
def _smoothed(m: ti.template(), s, length):
    """Smoothed length [m] of element s with |e| = length."""
    smoothing, smoothed = m.springs.numbers[s, 3], length
    if length < smoothing:
        ratio = length / smoothing
        smoothed = smoothing * (1.0 + ratio * ratio * (3.0 - ratio)) / 3.0
    return smoothed


@ti.func
def _length(m: ti.template(), line):
    """l of a line [m]."""
    total = ti.cast(0.0, ti.f64)
    for s in range(m.springs.line_start[line], m.springs.line_start[line + 1]):
        total += _smoothed(m, s, _vector(m, s).norm())
    return total


@ti.func
def prepare(m: ti.template(), line):
    """Compute directions, tension and pulls of a line from the present x and v."""
    first = m.springs.line_start[line]
    elastic = _stretching(m, first, _length(m, line))
    m.springs.elastic[line] = elastic
    for s in range(first, m.springs.line_start[line + 1]):
        e = _vector(m, s)
        length = e.norm()
        d = _shape(m, s, length) * e / ti.max(length, m.springs.numbers[s, 3], TINY)
        pull = elastic * d
        if _is_isotropic(m, s):
            pull = m.springs.numbers[s, 0] * e
        if ti.static(m.spring_damping):
            rate = ti.Vector([0.0, 0.0, 0.0], ti.f64)
            if ti.static(m.springs.has_moving):
                at = m.springs.moving[s]
                if at >= 0:
                    at += m.springs.rate_after
                    rate = ti.Vector([m.amplitudes[at], m.amplitudes[at + 1], m.amplitudes[at + 2]], ti.f64)
            for k in range(m.springs.start[s], m.springs.start[s + 1]):
                rate += m.springs.weight[k] * m.state.v[m.springs.node[k]]
            if not _is_isotropic(m, s):
                rate = rate.dot(d) * d
            pull += m.springs.numbers[s, 2] * rate
        m.springs.direction[s], m.springs.length[s], m.springs.pull[s] = d, length, pull


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N], after `prepare`."""
    f = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for q in range(m.springs.node_start[i], m.springs.node_start[i + 1]):
        k = m.springs.node_entry[q]
        s = m.springs.element[k]
        pull = m.springs.pull[s]
        if ti.static(m.springs.has_tensions):
            pull += _given_tension(m, s) * m.springs.direction[s]
        f -= m.springs.weight[k] * pull
    return ti.cast(f, m.real)


@ti.func
def elastic_energy(m: ti.template(), line):
    """Energy of the stretch of a line [J]."""
    s, energy = m.springs.line_start[line], ti.cast(0.0, ti.f64)
    if m.springs.numbers[s, 0] > 0.0:
        tension = _stretching(m, s, _length(m, line))
        energy = 0.5 * tension * tension / m.springs.numbers[s, 0]
    return energy


@ti.func
def load_energy(m: ti.template(), line):
    """Potential of the given tension of a line [J]; a multiplier does no work at constant length."""
    s, energy = m.springs.line_start[line], ti.cast(0.0, ti.f64)
    if m.springs.kind[s] != MULTIPLIER:
        energy = _given_tension(m, s) * _length(m, line)
    return energy


@ti.func
def add_stiffness(m: ti.template(), A: ti.template(), i, beta, projected):
    """Add row i of beta^2 K and of beta times the damping to A, after `prepare`. projected: without the negative part of K."""
    for q in range(m.springs.node_start[i], m.springs.node_start[i + 1]):
        k = m.springs.node_entry[q]
        s = m.springs.element[k]
        d, length, elastic = m.springs.direction[s], m.springs.length[s], m.springs.elastic[m.springs.line[s]]
        along, t = m.springs.numbers[s, 0], elastic + _given_tension(m, s)
        if m.springs.kind[s] == LENGTH and elastic == 0.0:
            along = 0.0
        if projected != 0:
            t = ti.max(t, 0.0)
        shape = _shape(m, s, length)
        across, outer = t * shape / ti.max(length, m.springs.numbers[s, 3], TINY), t / (ti.max(length, TINY) * shape * shape)
        if _is_isotropic(m, s):
            across, outer = along, along
        across, outer, along = beta * beta * across, beta * beta * outer, beta * beta * along
        if ti.static(m.spring_damping):
            along += beta * m.springs.numbers[s, 2]
            if _is_isotropic(m, s):
                across += beta * m.springs.numbers[s, 2]
                outer += beta * m.springs.numbers[s, 2]
        first = m.springs.coupled[s, 0]
        for other in range(first, m.springs.coupled[s, 1]):
            at = m.springs.pair_at[m.springs.pair_start[k] + other - first]
            scale = m.springs.weight[k] * m.springs.weight[other]
            with_self = 1.0 if m.springs.element[other] == s else 0.0
            across_other, outer_other = with_self * across, with_self * outer
            along_other = m.springs.direction[m.springs.element[other]]
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    block = along * d[r] * along_other[c] - outer_other * d[r] * d[c]
                    if ti.static(r == c):
                        block += across_other
                    add_entry(m, A, i, at, 4 * c + r, scale * block)
