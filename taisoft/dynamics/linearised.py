"""Linearised stage: the contact problem with linear elastic forces on a fixed matrix, which needs no elements.

The residual without contacts is r_lin = r_0 + A s, s the change of v since. Along a direction e the slope of the augmented
Lagrangian is
    e.r_lin + a e.A e - sum_c (J e)_c . prox(lambda - R (u + a J e))_c,
which needs only two sums over nodes; its root is then found from the contacts alone.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.prox import dvec
from taisoft.dynamics.contact_terms import (
    find_residual,
    impulse_on_node,
    projected_impulse,
    set_multiplier,
    unprojected_impulse,
    update_contact,
)
from taisoft.dynamics.stage import norm_weight, place_node
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total_by_team
from taisoft.fem.state import LINEAR_COUNT, LINEAR_STATUS, NORMS, OTHER_SUM, STEP_LENGTH, SUM
from taisoft.linear.block_csr import block_times, off_diagonal_times
from taisoft.linear.pcg_work import COUNT, NEGATIVE, RUNNING, STATUS, dot64

ROOT, TRIES, LONGEST = 0.05, 40, 1e3  # tolerance over the initial slope; maximum trial lengths; longest step length


@kernel
def begin_linearised(m: ti.template(), stage: ti.template(), contacts: ti.template()):
    """Begin the linearised stage: save x, the residual without contacts, and the impulses."""
    rows, work = ti.static((contacts.problem, contacts.work))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        contacts.x_linear[i] = m.state.x[i]
        contacts.residual_linear[i] = stage.residual[i] + ti.cast(impulse_on_node(contacts, i), m.real)
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        work.kept[c] = rows.r[c]


@kernel
def end_linearised(m: ti.template(), stage: ti.template(), contacts: ti.template(), accept: ti.i32, beta: ti.f64):
    """Set y to the velocity change since linearisation, and base to x at that time.

    accept: 0 restores the impulses of that time.
    """
    rows, work = ti.static((contacts.problem, contacts.work))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        stage.pcg.y[i] = ti.cast((m.state.x[i] - contacts.x_linear[i]) / beta, m.real)
        stage.base[i] = contacts.x_linear[i]
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        if accept == 0:
            rows.r[c] = work.kept[c]


@ti.func
def _slope(contacts: ti.template(), linear_slope, curvature, a, r_scale, t):
    """Return the slope of the augmented Lagrangian at step length a, by all threads t of the team. linear_slope: e.r_lin."""
    rows, work = ti.static((contacts.problem, contacts.work))
    slope = linear_slope + a * curvature
    if t > 0:
        slope = 0.0
    for j in range(rows.team.share(t, rows.count[0])):
        c = rows.team.term(t, j)
        z = unprojected_impulse(contacts, c, work.velocity[c] + a * work.rate[c], r_scale)
        slope -= work.rate[c].dot(projected_impulse(contacts, c, z))
    return rows.team.total(t, slope)


@ti.func
def _root(contacts: ti.template(), linear_slope, curvature, start, r_scale, t):
    """Return the root of the slope by the Illinois method; the slope increases if the matrix is positive definite.

    All threads t of the team call it, with the same numbers.
    """
    a, low, at_low, high, at_high = 1.0, 0.0, start, -1.0, 0.0
    slope = _slope(contacts, linear_slope, curvature, a, r_scale, t)
    tries = 0
    while ti.abs(slope) > ROOT * ti.abs(start) and tries < TRIES and a < LONGEST:
        if slope > 0.0:
            high, at_high = a, slope
            at_low *= 0.5 if tries > 1 else 1.0
        else:
            low, at_low = a, slope
            at_high *= 0.5 if tries > 1 else 1.0
        if high < 0.0:
            a *= 2.0
        else:
            a = low + (high - low) * ti.min(ti.max(at_low / (at_low - at_high), 0.01), 0.99)
        slope = _slope(contacts, linear_slope, curvature, a, r_scale, t)
        tries += 1
    return a


@ti.func
def _find_step_length(m: ti.template(), stage: ti.template(), contacts: ti.template(), r_scale, t):
    """Set STEP_LENGTH, by all threads t of the team, from the sums over the nodes and the contacts' rates.

    0 unless a team's linear solve has ended without negative curvature: the host has not looked yet.
    """
    rows, work = ti.static((contacts.problem, contacts.work))
    start = total_by_team(m, t, SUM)
    linear_slope = start
    if t > 0:
        linear_slope = 0.0
    for j in range(rows.team.share(t, rows.count[0])):
        c = rows.team.term(t, j)
        linear_slope += work.rate[c].dot(rows.r[c])
    linear_slope = rows.team.total(t, linear_slope)
    length = _root(contacts, linear_slope, total_by_team(m, t, OTHER_SUM), start, r_scale, t)
    if t == 0:
        m.state.scalars[STEP_LENGTH] = length
        if ti.static(stage.pcg.by_team):
            status = stage.pcg.state[STATUS]
            if status == RUNNING or status == NEGATIVE:
                m.state.scalars[STEP_LENGTH] = 0.0
            m.state.scalars[LINEAR_COUNT], m.state.scalars[LINEAR_STATUS] = stage.pcg.state[COUNT], status


@ti.func
def _node_slope(m: ti.template(), stage: ti.template(), A: ti.template(), contacts: ti.template(), chunk, i):
    """Return (r.y, y.A y) of node i; store its row of A y, and base = x."""
    y = stage.pcg.y[i]
    q = block_times(contacts.coupling.base[i], y) + off_diagonal_times(m, A, chunk, i, stage.pcg.y)
    stage.pcg.q[i] = q
    stage.base[i] = m.state.x[i]
    return dot64(m.free[i] * stage.residual[i], y), dot64(y, q)


@ti.func
def _contact_rate(stage: ti.template(), contacts: ti.template(), c):
    """Compute the rate of u of contact c along y."""
    rows, work = ti.static((contacts.problem, contacts.work))
    d, n, t = dvec(0.0), rows.normal[c], rows.tangent[c]
    for e in range(rows.first[c], rows.first[c] + rows.arity[c]):
        d += rows.weight[e] * ti.cast(stage.pcg.y[rows.node[e]], ti.f64)
    work.rate[c] = dvec(n.dot(d), t.dot(d), n.cross(t).dot(d))


@ti.func
def _move_node_along(m: ti.template(), stage: ti.template(), contacts: ti.template(), i, a, beta):
    """Move node i by a y, and update the residual without contacts."""
    place_node(m, stage, i, a, beta)
    contacts.displacement[i] = m.state.x[i] - contacts.x_start[i]
    contacts.residual_linear[i] += ti.cast(a, m.real) * stage.pcg.q[i]


@ti.func
def _node_residual(m: ti.template(), stage: ti.template(), contacts: ti.template(), i):
    """Compute the residual of node i with impulses, and -r as CG's right side; return |r|^2 on its free axes."""
    r = contacts.residual_linear[i] - ti.cast(impulse_on_node(contacts, i), m.real)
    stage.residual[i] = r
    free_residual = m.free[i] * r
    stage.pcg.rhs[i] = -free_residual
    return norm_weight(stage, i) * dot64(free_residual, free_residual)


@ti.func
def _find_residual(m: ti.template(), stage: ti.template(), contacts: ti.template()):
    """Compute the residual, -r as CG's right side, and the first of NORMS, as top-level loops of a kernel."""
    find_residual(m, contacts)
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            chunk = task // m.spread
            square = ti.cast(0.0, ti.f64)
            for j in range(chunk_size(m, chunk, m.n_nodes)):
                square += _node_residual(m, stage, contacts, chunk_entry(m, chunk, j, m.n_nodes))
            m.state.partial[chunk, SUM] = square
    fold(m, SUM, SUM, ())
    ti.loop_config(serialize=m.team.alone, block_dim=m.team.threads)
    for t in range(m.team.threads):
        norm = total_by_team(m, t, SUM)
        if t == 0:
            m.state.scalars[NORMS] = norm


@kernel
def find_step_length(
    m: ti.template(), stage: ti.template(), A: ti.template(), contacts: ti.template(), beta: ti.f64, r_scale: ti.f64
):
    """Find the zero of the slope along y of stage.pcg. scalars: STEP_LENGTH, LINEAR_COUNT, LINEAR_STATUS."""
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            chunk = task // m.spread
            slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for j in range(chunk_size(m, chunk, m.n_nodes)):
                i = chunk_entry(m, chunk, j, m.n_nodes)
                slope_i, curvature_i = _node_slope(m, stage, A, contacts, chunk, i)
                slope += slope_i
                curvature += curvature_i
            m.state.partial[chunk, SUM], m.state.partial[chunk, OTHER_SUM] = slope, curvature
    fold(m, SUM, OTHER_SUM, ())
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        _contact_rate(stage, contacts, c)
    ti.loop_config(serialize=rows.team.alone, block_dim=rows.team.threads)
    for t in range(rows.team.threads):
        _find_step_length(m, stage, contacts, r_scale, t)


@kernel
def advance(m: ti.template(), stage: ti.template(), contacts: ti.template(), beta: ti.f64, r_scale: ti.f64):
    """Move along y to there; update x, v, impulses, blocks, residual, and -r as CG's right side. scalars: the first of NORMS."""
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        _move_node_along(m, stage, contacts, i, m.state.scalars[STEP_LENGTH], beta)
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        update_contact(m, contacts, c, beta, r_scale)
    _find_residual(m, stage, contacts)


@kernel
def update_multipliers(
    m: ti.template(), stage: ti.template(), contacts: ti.template(), to_impulses: ti.i32, beta: ti.f64, r_scale: ti.f64
):
    """Update impulses, blocks, residual, -r, and the first of NORMS; to_impulses: 1 sets multipliers to the impulses first."""
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        if to_impulses == 1:
            set_multiplier(contacts, c)
        update_contact(m, contacts, c, beta, r_scale)
    _find_residual(m, stage, contacts)
