"""Kernels of `pieces`: norms by piece, factors of linear solves, and the correction of rigid motion."""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.dynamics.stage import damping_force, internal_on, loads_on, residual_parts, squares
from taisoft.fem.dependents import is_dependent, place_all
from taisoft.fem.lanes import mass_times
from taisoft.fem.terms import rayleigh_damping

N_SUMS, N_MOMENTS, N_TERMS = 5, 10, 24  # columns of a piece's norms, of a component's first moments, of scratch
SOLVED, LINEARISED, BEFORE, AFTER = range(4)  # modes of `correct_rigid_motion`
FREE, HELD, INERT = range(3)  # states of a component; INERT: free, and turned by inertia alone
LEAST_INERTIA = 0.25  # of a body's inertia that must remain beside the stiffness of its stress, or that is left out
MASS, CENTRE, RESULTANT, FIXED = 0, 1, 4, 7  # columns of these moments; FIXED: constraints by axis


@kernel
def measure_pieces(m: ti.template(), s: ti.template(), p: ti.template(), beta: ti.f64):
    """Set norms: the squares of `form_residual` by piece, of the last residual."""
    ti.loop_config(serialize=m.serial)
    for row in range(p.n_rows):
        sums = ti.Vector.zero(ti.f64, N_SUMS)
        for at in range(p.row_start[row], p.row_start[row + 1]):
            i = p.node[at]
            _r, inertia, internal, loads = residual_parts(m, s, row, i, beta)
            sums += squares(s.residual[i], inertia, internal, loads, m.free[i])
        for j in ti.static(range(N_SUMS)):
            p.sums[row, j] = sums[j]
    ti.loop_config(serialize=m.serial)
    for k in range(p.n):
        for j in ti.static(range(N_SUMS)):
            total = ti.cast(0.0, ti.f64)
            for row in range(p.piece_row[k], p.piece_row[k + 1]):
                total += p.sums[row, j]
            p.norms[k, j] = total


@kernel
def equalise(m: ti.template(), A: ti.template(), w: ti.template(), p: ti.template(), least: ti.f64):
    """Scale rhs of CG work w so that all components have the same energy norm; set the factors.

    least: |rhs|^2 over s_p^2 of a piece below which its component is not scaled up further.
    """
    ti.loop_config(serialize=m.serial)
    for row in range(p.n_rows):
        energy, weighted = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for at in range(p.row_start[row], p.row_start[row + 1]):
            i = p.node[at]
            rhs = ti.cast(w.rhs[i], ti.f64)
            D, square = A.diagonal[i], rhs.dot(rhs)
            trace = ti.cast(D[0] + D[5] + D[10], ti.f64)
            if trace > 0.0:
                energy += 3.0 * square / trace
            weighted += square * p.weight[p.piece[i]]
        p.sums[row, 0], p.sums[row, 1] = energy, weighted
    ti.loop_config(serialize=m.serial)
    for k in range(p.n_components):
        energy, weighted = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for row in range(p.component_row[k], p.component_row[k + 1]):
            energy, weighted = energy + p.sums[row, 0], weighted + p.sums[row, 1]
        p.factor[k] = 1.0
        if energy > 0.0 and weighted > 0.0:
            p.factor[k] = ti.sqrt(ti.min(1.0, weighted / least) / energy)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        w.rhs[i] = ti.cast(p.factor[p.component[i]], m.real) * w.rhs[i]


@kernel
def undo_factors(m: ti.template(), w: ti.template(), p: ti.template()):
    """Divide y and rhs of CG work w by the factors."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        inverse = ti.cast(1.0 / p.factor[p.component[i]], m.real)
        w.y[i], w.rhs[i] = inverse * w.y[i], inverse * w.rhs[i]


@ti.func
def _damping_factor(m: ti.template(), i, beta):
    """Derivative of v - v_hat plus mass damping over a stage by v."""
    factor = ti.cast(1.0, ti.f64)
    if ti.static(m.damped):
        factor += beta * ti.cast(rayleigh_damping.mass_rate(m, i), ti.f64)
    return factor


@ti.func
def _row_sum(m: ti.template(), i):
    """Sum of row i of the mass matrix [kg]."""
    mass = ti.cast(m.mass[i], ti.f64)
    if ti.static(m.consistent):
        mass = ti.cast(m.gravity_mass[i], ti.f64)
    return mass


@ti.func
def _mass_times_arm(m: ti.template(), i, x: ti.template(), c):
    """(M a)_i of the arms a = x - c [kg m]."""
    result = ti.Vector.zero(ti.f64, 3)
    if ti.static(m.consistent):
        result = mass_times(m, i, x) - _row_sum(m, i) * c
    else:
        result = ti.cast(m.mass[i], ti.f64) * (x[i] - c)
    return result


@ti.func
def _is_held(p: ti.template(), row):
    """Whether a row of nodes belongs to a component that is not corrected."""
    return p.held[p.component[p.node[p.row_start[row]]]] == HELD


@ti.func
def _velocity(m: ti.template(), s: ti.template(), i, mode: ti.template()):
    """Velocity of node i that `correct_rigid_motion` corrects."""
    v = m.state.v[i]
    if ti.static(mode == AFTER):
        v += ti.cast(s.pcg.y[i], ti.f64)
    return v


@ti.func
def _turning(p: ti.template(), j):
    """Angular velocity of the correction of component j."""
    return ti.Vector([p.motion[j, 3], p.motion[j, 4], p.motion[j, 5]])


@ti.func
def _centre(p: ti.template(), j):
    """Centre of component j."""
    return ti.Vector([p.moments[j, CENTRE], p.moments[j, CENTRE + 1], p.moments[j, CENTRE + 2]])


@ti.func
def _in_contact(p: ti.template(), k: ti.template()):
    """Mark the components in contact as held, as a top-level loop of a kernel."""
    if ti.static(k.any):
        ti.loop_config(serialize=k.problem.serial)
        for c in range(k.problem.count[0]):
            for j in range(k.problem.arity[c]):
                p.held[p.component[k.problem.node[c, j]]] = HELD


@ti.func
def _resultant(m: ti.template(), s: ti.template(), p: ti.template(), x: ti.template(), row, beta):
    """Add up a row of nodes: mass, its first moment, resultant of inertia and loads (in `moved` by node), constraints by axis."""
    sums = ti.Vector.zero(ti.f64, N_MOMENTS)
    for at in range(p.row_start[row], p.row_start[row + 1]):
        i = p.node[at]
        if not is_dependent(m, i):
            mass, fixed = _damping_factor(m, i, beta) * _row_sum(m, i), 1.0 - ti.cast(m.free[i], ti.f64)
            q = mass_times(m, i, s.change) - beta * ti.cast(loads_on(m, i), ti.f64)
            s.moved[i] = q
            sums[MASS] += mass
            for a in ti.static(range(3)):
                sums[CENTRE + a] += mass * x[i][a]
                sums[RESULTANT + a] += q[a]
                sums[FIXED + a] += fixed[a]
    for j in ti.static(range(N_MOMENTS)):
        p.sums[row, j] = sums[j]


@ti.func
def _find_translation(p: ti.template(), j):
    """Add up the rows of component j, and set the velocity that balances it, along the axes without constraints."""
    for q in ti.static(range(N_MOMENTS)):
        total = ti.cast(0.0, ti.f64)
        for row in range(p.component_row[j], p.component_row[j + 1]):
            total += p.sums[row, q]
        p.moments[j, q] = total
    for a in ti.static(range(3)):
        p.moments[j, CENTRE + a] = p.moments[j, CENTRE + a] / p.moments[j, MASS]
        p.motion[j, a], p.motion[j, 3 + a] = 0.0, 0.0
        if p.moments[j, FIXED + a] == 0.0:
            p.motion[j, a] = -p.moments[j, RESULTANT + a] / p.moments[j, MASS]


@ti.func
def _moment(m: ti.template(), s: ti.template(), p: ti.template(), x: ti.template(), mode: ti.template(), row, beta):
    """Add up a row of nodes: moment of inertia and loads, moments of inertia; linearised, the moment of beta f x v, and its
    derivative by a turning.
    """
    identity = ti.Matrix.identity(ti.f64, 3)
    moment, I = ti.Vector.zero(ti.f64, 3), ti.Matrix.zero(ti.f64, 3, 3)
    geometric, turn = ti.Vector.zero(ti.f64, 3), ti.Matrix.zero(ti.f64, 3, 3)
    for at in range(p.row_start[row], p.row_start[row + 1]):
        i = p.node[at]
        if not is_dependent(m, i):
            j = p.component[i]
            c = _centre(p, j)
            arm, q = x[i] - c, s.moved[i]
            if ti.static(m.stiffness_damping):
                q -= beta * ti.cast(damping_force(m, s, row, i, m.state.v), ti.f64)
                if ti.static(mode == AFTER):
                    q -= beta * ti.cast(damping_force(m, s, row, i, s.pcg.y), ti.f64)
            moment += arm.cross(q)
            mass_arm = _damping_factor(m, i, beta) * _mass_times_arm(m, i, x, c)
            I += arm.dot(mass_arm) * identity - mass_arm.outer_product(arm)
            if ti.static(mode != SOLVED):
                f = ti.cast(internal_on(m, i), ti.f64)
                first = p.node[p.row_start[p.component_row[j]]]  # its velocity has no moment, but that of the forces' rounding
                geometric -= beta * beta * f.cross(_velocity(m, s, i, mode) - _velocity(m, s, first, mode))
                turn -= beta * beta * (f.dot(arm) * identity - arm.outer_product(f))
    for a in ti.static(range(3)):
        p.sums[row, a], p.sums[row, 3 + a] = moment[a], geometric[a]
        for b in ti.static(range(3)):
            p.sums[row, 6 + 3 * a + b], p.sums[row, 15 + 3 * a + b] = I[a, b], turn[a, b]


@ti.func
def _is_definite(A):
    """Whether a symmetric matrix is positive definite."""
    return A[0, 0] > 0.0 and A[0, 0] * A[1, 1] > A[0, 1] * A[1, 0] and A.determinant() > 0.0


@ti.func
def _find_turning(p: ti.template(), j):
    """Set the angular velocity that balances component j, about the axes across which no node is constrained.

    Compression can make a linearised step turn a body without bound; its matrix is then nearly singular, and only inertia counts.
    """
    total = ti.Vector.zero(ti.f64, N_TERMS)
    for row in range(p.component_row[j], p.component_row[j + 1]):
        for q in ti.static(range(N_TERMS)):
            total[q] += p.sums[row, q]
    moment, I = ti.Vector([total[0], total[1], total[2]]), ti.Matrix.zero(ti.f64, 3, 3)
    turn = ti.Matrix.zero(ti.f64, 3, 3)
    for a in ti.static(range(3)):
        for b in ti.static(range(3)):
            I[a, b], turn[a, b] = total[6 + 3 * a + b], total[15 + 3 * a + b]
    if _is_definite((1.0 - LEAST_INERTIA) * I + turn):
        moment += ti.Vector([total[3], total[4], total[5]])
        I += turn
    else:
        p.held[j] = INERT
    fixed = ti.Vector([p.moments[j, FIXED], p.moments[j, FIXED + 1], p.moments[j, FIXED + 2]])
    if fixed.sum() == 0.0:
        w = I.inverse() @ moment
        for a in ti.static(range(3)):
            p.motion[j, 3 + a] = -w[a]
    else:
        for a in ti.static(range(3)):
            if fixed[(a + 1) % 3] + fixed[(a + 2) % 3] == 0.0:
                p.motion[j, 3 + a] = -moment[a] / I[a, a]


@kernel
def correct_rigid_motion(
    m: ti.template(), s: ti.template(), p: ti.template(), k: ti.template(), x: ti.template(), mode: ti.template(), beta: ti.f64
):
    """Add to v the rigid motion that balances each free component, see `pieces`, and beta times it to x.

    x: positions of the arms, at which elements and terms hold the forces. mode: SOLVED, after a nonlinear stage, whose residual
    is corrected, too; LINEARISED, after a linearised one; BEFORE, at the start of one, whose x stays until AFTER adds CG's y.
    """
    ti.loop_config(serialize=m.serial)
    for j in range(p.n_components):
        p.held[j] = p.anchored[j]
        if ti.static(mode != SOLVED):
            p.held[j] = ti.max(p.anchored[j], p.pressed[j])
    _in_contact(p, k)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        if p.held[p.component[i]] != HELD:
            s.change[i] = _damping_factor(m, i, beta) * _velocity(m, s, i, mode) - s.v_hat[i]
    ti.loop_config(serialize=m.serial)
    for row in range(p.n_rows):
        if not _is_held(p, row):
            _resultant(m, s, p, x, row, beta)
    ti.loop_config(serialize=m.serial)
    for j in range(p.n_components):
        if p.held[j] != HELD:
            _find_translation(p, j)
    ti.loop_config(serialize=m.serial)
    for row in range(p.n_rows):
        if not _is_held(p, row):
            _moment(m, s, p, x, mode, row, beta)
    ti.loop_config(serialize=m.serial)
    for j in range(p.n_components):
        if p.held[j] != HELD:
            _find_turning(p, j)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        j, change = p.component[i], ti.Vector.zero(ti.f64, 3)
        if p.held[j] != HELD and not is_dependent(m, i):
            c = _centre(p, j)
            u, w = ti.Vector([p.motion[j, 0], p.motion[j, 1], p.motion[j, 2]]), _turning(p, j)
            free, factor = ti.cast(m.free[i], ti.f64), _damping_factor(m, i, beta)
            if ti.static(mode == SOLVED):
                momentum = _row_sum(m, i) * u + w.cross(_mass_times_arm(m, i, x, c))
                s.residual[i] = s.residual[i] + ti.cast(free * factor * momentum, m.real)
            change = free * (u + w.cross(x[i] - c))
            s.change[i] = s.change[i] + factor * change
        moved = change
        if ti.static(mode == AFTER):
            change += ti.cast(s.pcg.y[i], ti.f64)
            moved = change + ti.cast(m.free[i], ti.f64) * m.state.v[i]
        m.state.v[i] = m.state.v[i] + change
        s.moved[i] = beta * moved
    if ti.static(mode != BEFORE):
        ti.loop_config(serialize=m.serial)
        for i in range(m.n_nodes):
            m.state.x[i] = m.state.x[i] + s.moved[i]
        place_all(m)


@kernel
def turn_forces(m: ti.template(), s: ti.template(), p: ti.template(), beta: ti.f64):
    """Add to residual and rhs the change of internal forces by the turning of `correct_rigid_motion` BEFORE a linearised step."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        if p.held[p.component[i]] == FREE and not is_dependent(m, i):
            f = ti.cast(internal_on(m, i), ti.f64)
            r = s.residual[i] - ti.cast(beta * beta * _turning(p, p.component[i]).cross(f), m.real)
            s.residual[i] = r
            s.pcg.rhs[i] = -m.free[i] * r
