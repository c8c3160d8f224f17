"""The residual of an implicit stage where a Newton step leads: `move` goes there and finds the elastic forces,
`contact_terms.press` the impulses of contacts, `form_residual` adds all up.

A linearised stage moves by `linearised.advance` instead, which keeps its residual without contacts.
"""

import taichi as ti

from taisoft.dynamics.contact_terms import impulse_on_node
from taisoft.dynamics.impact import impact_residual
from taisoft.dynamics.stage import place_node, residual_parts, set_change, squares
from taisoft.fem.terms import elasticity
from taisoft.linear.pcg import dot64, total
from taisoft.runtime import kernel
from taisoft.scalars import END_SLOPE, N_NORMS, OTHER_SUM, START_SLOPE, SUM
from taisoft.subset import n_nodes_of, node_of

STAY, STEP, AGAIN = range(3)  # where `move` goes: nowhere, the whole step, another length of the same step
ELASTIC_STAGE, LINEARISED, IMPACT = range(3)  # kinds of a stage; IMPACT: see `impact`


@kernel
def move(
    m: ti.template(), s: ti.template(), k: ti.template(), kind: ti.template(), how: ti.i32,
    step_length: ti.f64, c: ti.f64, beta: ti.f64,
):  # fmt: skip
    """Go where `how` says, the nodes of s.pcg.subset alone, and find the elastic forces there.

    how: STAY; STEP: base = x, then step_length y, y of s.pcg; AGAIN: base + step_length y. scalars: START_SLOPE of a STEP.
    """
    ti.loop_config(serialize=m.serial)
    for chunk in range(m.chunks):
        n = n_nodes_of(m, s.pcg.subset)
        size = (n + m.chunks - 1) // m.chunks
        slope = ti.cast(0.0, ti.f64)
        for at in range(chunk * size, ti.min(n, (chunk + 1) * size)):
            i = node_of(s.pcg.subset, at)
            if how == STEP:
                slope += dot64(m.free[i] * s.residual[i], s.pcg.y[i])
                s.base[i] = m.state.x[i]
            if how != STAY:
                place_node(m, s, i, step_length, beta)
            if ti.static(k.any):
                k.displacement[i] = m.state.x[i] - k.x_start[i]
            if ti.static(kind == ELASTIC_STAGE):
                set_change(m, s, i, c, beta)
        m.state.partial[chunk, OTHER_SUM] = slope
    if ti.static(kind == ELASTIC_STAGE):
        elasticity.sum_elements(m, s.pcg.subset)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if how == STEP:
            m.state.scalars[START_SLOPE] = total(m, OTHER_SUM)


@kernel
def form_residual(
    m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), kind: ti.template(),
    beta: ti.f64, norms: ti.types.ndarray(),
):  # fmt: skip
    """Residual on the nodes of s.pcg.subset, and -r as CG's right side, from what `move` and `press` have found.

    norms (5,), an array of the host (it is told sooner than by a returned vector): |r|^2, |inertia and mass damping|^2,
    |f_el|^2, |f_ext|^2 on the free axes, and |r|^2 on the others; of another kind than ELASTIC_STAGE only those of r.
    scalars: END_SLOPE.
    """
    ti.loop_config(serialize=m.serial)
    for chunk in range(m.chunks):
        n = n_nodes_of(m, s.pcg.subset)
        size = (n + m.chunks - 1) // m.chunks
        sums, slope = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64), ti.cast(0.0, ti.f64)
        for at in range(chunk * size, ti.min(n, (chunk + 1) * size)):
            i = node_of(s.pcg.subset, at)
            free = m.free[i]
            zero = ti.Vector([0.0, 0.0, 0.0], m.real)
            r, inertia, f, external = zero, zero, zero, zero
            if ti.static(kind == IMPACT):
                r = impact_residual(m, A, k, i, beta)
            elif ti.static(kind == LINEARISED):
                r = k.residual_linear[i]
            else:
                r, inertia, f, external = residual_parts(m, s, i, beta)
            if ti.static(k.any):
                r -= ti.cast(impulse_on_node(k, i), m.real)
            s.residual[i] = r
            s.pcg.rhs[i] = -free * r
            sums += squares(r, inertia, f, external, free)
            slope += dot64(free * r, s.pcg.y[i])
        for j in ti.static(range(N_NORMS)):
            m.state.partial[chunk, j] = sums[j]
        m.state.partial[chunk, SUM] = slope
    ti.loop_config(serialize=True)  # a sum outside of any loop would be a loop of its own over threads, 50 us and more
    for _ in range(1):
        for j in ti.static(range(N_NORMS) if kind == ELASTIC_STAGE else (0, 4)):
            norms[j] = total(m, j)
        m.state.scalars[END_SLOPE] = total(m, SUM)
