"""Residual of an implicit stage after a Newton step: `move` updates the state and computes elastic forces,
`contact_terms.update_impulses` computes contact impulses, and `form_residual` adds everything.

A linearised stage moves by `linearised.advance` instead, which updates the residual without contacts.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.dynamics.contact_terms import impulse_on_node
from taisoft.dynamics.impact import impact_residual
from taisoft.dynamics.stage import place_node, residual_parts, set_change, squares
from taisoft.fem.node_graph import n_nodes_of, node_of
from taisoft.fem.state import END_SLOPE, N_NORMS, OTHER_SUM, START_SLOPE, SUM
from taisoft.fem.terms import elasticity
from taisoft.linear.pcg import dot64, total

STAY, STEP, AGAIN = range(3)  # modes of `move`: stay, full step, another length of the same step
ELASTIC_STAGE, LINEARISED, IMPACT = range(3)  # kinds of stages; IMPACT: see `impact`


@kernel
def move(
    m: ti.template(),
    s: ti.template(),
    k: ti.template(),
    kind: ti.template(),
    mode: ti.i32,
    step_length: ti.f64,
    c: ti.f64,
    beta: ti.f64,
):
    """Move the nodes of s.pcg.subset and compute the elastic forces there.

    mode: STAY; STEP: base = x, then step_length y, y of s.pcg; AGAIN: base + step_length y. scalars: START_SLOPE of a STEP.
    """
    ti.loop_config(serialize=m.serial)
    for chunk in range(m.chunks):
        n = n_nodes_of(m, s.pcg.subset)
        size = (n + m.chunks - 1) // m.chunks
        slope = ti.cast(0.0, ti.f64)
        for at in range(chunk * size, ti.min(n, (chunk + 1) * size)):
            i = node_of(s.pcg.subset, at)
            if mode == STEP:
                slope += dot64(m.free[i] * s.residual[i], s.pcg.y[i])
                s.base[i] = m.state.x[i]
            if mode != STAY:
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
        if mode == STEP:
            m.state.scalars[START_SLOPE] = total(m, OTHER_SUM)


@kernel
def form_residual(
    m: ti.template(),
    s: ti.template(),
    A: ti.template(),
    k: ti.template(),
    kind: ti.template(),
    beta: ti.f64,
    norms: ti.types.ndarray(),
):
    """Form the residual on the nodes of s.pcg.subset, and -r as CG's right side, after `move` and `update_impulses`.

    norms (5,), a host array, which is faster than a returned vector: |r|^2, |inertia and mass damping|^2, |f_el|^2, |f_ext|^2
    on the free axes, and |r|^2 on the others; only those of r if kind is not ELASTIC_STAGE.
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
    ti.loop_config(serialize=True)  # outside of any loop, the sum would become a parallel loop of its own, 50 us and more
    for _ in range(1):
        for j in ti.static(range(N_NORMS) if kind == ELASTIC_STAGE else (0, 4)):
            norms[j] = total(m, j)
        m.state.scalars[END_SLOPE] = total(m, SUM)
