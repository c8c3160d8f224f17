"""Springs, tendons and attachments: node j gets -c_j (T + damping) e / l of each element, psi = sum k (l - L)^2 / 2 + T_0 l.

`fem.springs` defines the elements. Before forces are gathered, `prepare` computes the pull of each element from x and v. Blocks
of the stiffness are c_i c_j S, S = t I + (k - t) d d^T with d = e / l and t = T / l, or k I for an element of rest length 0. At
l = 0 the direction of an element that has a rest length is undefined: it does not pull there.
"""

import taichi as ti

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = "springs", False, False, True, True
TINY = 1e-30  # [m]; avoids a division by 0, and is no smaller since literals may be f32


@ti.func
def count(m: ti.template()):
    """Number of elements."""
    return m.springs.n


@ti.func
def _vector(m: ti.template(), s):
    """e of element s [m]."""
    e = m.springs.offset[s]
    for k in range(m.springs.start[s], m.springs.start[s + 1]):
        e += m.springs.weight[k] * m.state.x[m.springs.node[k]]
    return e


@ti.func
def _given_tension(m: ti.template(), s):
    """T_0 of element s [N]."""
    tension = ti.cast(0.0, ti.f64)
    if ti.static(m.springs.has_tendons):
        slot = m.springs.slot[s]
        if slot >= 0:
            tension = m.amplitudes[slot]
    return tension


@ti.func
def _is_isotropic(m: ti.template(), s):
    """Whether element s has neither a rest length nor a given tension."""
    return m.springs.numbers[s, 1] == 0.0 and m.springs.slot[s] < 0


@ti.func
def _tension_over_length(m: ti.template(), s, length):
    """t = T / l of element s [N/m]."""
    k = m.springs.numbers[s, 0]
    t = k
    if not _is_isotropic(m, s) and length > TINY:
        t += (_given_tension(m, s) - k * m.springs.numbers[s, 1]) / length
    return t


@ti.func
def prepare(m: ti.template(), s):
    """Compute the pull of element s from the present x and v."""
    e = _vector(m, s)
    length = e.norm()
    pull = _tension_over_length(m, s, length) * e
    if ti.static(m.spring_damping):
        rate = ti.Vector([0.0, 0.0, 0.0], ti.f64)
        for k in range(m.springs.start[s], m.springs.start[s + 1]):
            rate += m.springs.weight[k] * ti.cast(m.state.v[m.springs.node[k]], ti.f64)
        if not _is_isotropic(m, s):
            d = e / ti.max(length, TINY)
            rate = rate.dot(d) * d
        pull += m.springs.numbers[s, 2] * rate
    m.springs.pull[s] = pull


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N], after `prepare`."""
    f = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for q in range(m.springs.node_start[i], m.springs.node_start[i + 1]):
        k = m.springs.node_entry[q]
        f -= m.springs.weight[k] * m.springs.pull[m.springs.element[k]]
    return ti.cast(f, m.real)


@ti.func
def elastic_energy(m: ti.template(), s):
    """Energy of the stretch of element s [J]."""
    stretch = _vector(m, s).norm() - m.springs.numbers[s, 1]
    return 0.5 * m.springs.numbers[s, 0] * stretch * stretch


@ti.func
def load_energy(m: ti.template(), s):
    """Potential of the given tension of element s [J]."""
    return _given_tension(m, s) * _vector(m, s).norm()


@ti.func
def add_stiffness(m: ti.template(), A: ti.template(), i, beta, projected):
    """Add row i of beta^2 K and of beta times the damping to A. projected: without the negative part of K."""
    for q in range(m.springs.node_start[i], m.springs.node_start[i + 1]):
        k = m.springs.node_entry[q]
        s = m.springs.element[k]
        e = _vector(m, s)
        length = e.norm()
        d = e / ti.max(length, TINY)
        t = _tension_over_length(m, s, length)
        along = m.springs.numbers[s, 0]
        if _is_isotropic(m, s) or length <= TINY:
            along = t
        elif projected != 0:
            t = ti.max(t, 0.0)
        across, along = beta * beta * t, beta * beta * along
        if ti.static(m.spring_damping):
            along += beta * m.springs.numbers[s, 2]
            if _is_isotropic(m, s):
                across += beta * m.springs.numbers[s, 2]
        first = m.springs.start[s]
        for other in range(first, m.springs.start[s + 1]):
            at = m.springs.pair_at[m.springs.pair_start[k] + other - first]
            scale = m.springs.weight[k] * m.springs.weight[other]
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    block = scale * ((along - across) * d[r] * d[c] + (across if ti.static(r == c) else 0.0))
                    if at < 0:
                        A.diagonal[i][4 * c + r] += ti.cast(block, m.real)
                    else:
                        A.value[at][4 * c + r] += ti.cast(block, m.real)
