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
def measure_pieces(m: ti.template(), stage: ti.template(), pieces: ti.template(), beta: ti.f64):
    """Set norms: the squares of `form_residual` by piece, of the last residual."""
    ti.loop_config(serialize=m.serial)
    for row in range(pieces.n_rows):
        sums = ti.Vector.zero(ti.f64, N_SUMS)
        for at in range(pieces.row_start[row], pieces.row_start[row + 1]):
            i = pieces.node[at]
            _r, inertia, internal, loads = residual_parts(m, stage, row, i, beta)
            sums += squares(stage.residual[i], inertia, internal, loads, m.free[i])
        for j in ti.static(range(N_SUMS)):
            pieces.sums[row, j] = sums[j]
    ti.loop_config(serialize=m.serial)
    for k in range(pieces.n):
        for j in ti.static(range(N_SUMS)):
            total = ti.cast(0.0, ti.f64)
            for row in range(pieces.piece_row[k], pieces.piece_row[k + 1]):
                total += pieces.sums[row, j]
            pieces.norms[k, j] = total


@kernel
def equalise(m: ti.template(), A: ti.template(), work: ti.template(), pieces: ti.template(), least: ti.f64):
    """Scale rhs of CG work so that all components have the same energy norm; set the factors.

    least: |rhs|^2 over s_p^2 of a piece below which its component is not scaled up further.
    """
    ti.loop_config(serialize=m.serial)
    for row in range(pieces.n_rows):
        energy, weighted = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for at in range(pieces.row_start[row], pieces.row_start[row + 1]):
            i = pieces.node[at]
            rhs = ti.cast(work.rhs[i], ti.f64)
            D, square = A.diagonal[i], rhs.dot(rhs)
            trace = ti.cast(D[0] + D[5] + D[10], ti.f64)
            if trace > 0.0:
                energy += 3.0 * square / trace
            weighted += square * pieces.weight[pieces.piece[i]]
        pieces.sums[row, 0], pieces.sums[row, 1] = energy, weighted
    ti.loop_config(serialize=m.serial)
    for k in range(pieces.n_components):
        energy, weighted = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for row in range(pieces.component_row[k], pieces.component_row[k + 1]):
            energy, weighted = energy + pieces.sums[row, 0], weighted + pieces.sums[row, 1]
        pieces.factor[k] = 1.0
        if energy > 0.0 and weighted > 0.0:
            pieces.factor[k] = ti.sqrt(ti.min(1.0, weighted / least) / energy)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        work.rhs[i] = ti.cast(pieces.factor[pieces.component[i]], m.real) * work.rhs[i]


@kernel
def undo_factors(m: ti.template(), work: ti.template(), pieces: ti.template()):
    """Divide y and rhs of CG work by the factors."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        inverse = ti.cast(1.0 / pieces.factor[pieces.component[i]], m.real)
        work.y[i], work.rhs[i] = inverse * work.y[i], inverse * work.rhs[i]


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
def _is_held(pieces: ti.template(), row):
    """Whether a row of nodes belongs to a component that is not corrected."""
    return pieces.held[pieces.component[pieces.node[pieces.row_start[row]]]] == HELD


@ti.func
def _velocity(m: ti.template(), stage: ti.template(), i, mode: ti.template()):
    """Velocity of node i that `correct_rigid_motion` corrects."""
    v = m.state.v[i]
    if ti.static(mode == AFTER):
        v += ti.cast(stage.pcg.y[i], ti.f64)
    return v


@ti.func
def _turning(pieces: ti.template(), j):
    """Angular velocity of the correction of component j."""
    return ti.Vector([pieces.motion[j, 3], pieces.motion[j, 4], pieces.motion[j, 5]])


@ti.func
def _centre(pieces: ti.template(), j):
    """Centre of component j."""
    return ti.Vector([pieces.moments[j, CENTRE], pieces.moments[j, CENTRE + 1], pieces.moments[j, CENTRE + 2]])


@ti.func
def _in_contact(pieces: ti.template(), contacts: ti.template()):
    """Mark the components in contact as held, as a top-level loop of a kernel."""
    if ti.static(contacts.any):
        ti.loop_config(serialize=contacts.problem.serial)
        for c in range(contacts.problem.count[0]):
            first = contacts.problem.first[c]
            for e in range(first, first + contacts.problem.arity[c]):
                pieces.held[pieces.component[contacts.problem.node[e]]] = HELD


@ti.func
def _resultant(m: ti.template(), stage: ti.template(), pieces: ti.template(), x: ti.template(), row, beta):
    """Add up a row of nodes: mass, its first moment, resultant of inertia and loads (in `moved` by node), constraints by axis."""
    sums = ti.Vector.zero(ti.f64, N_MOMENTS)
    for at in range(pieces.row_start[row], pieces.row_start[row + 1]):
        i = pieces.node[at]
        if not is_dependent(m, i):
            mass, fixed = _damping_factor(m, i, beta) * _row_sum(m, i), 1.0 - ti.cast(m.free[i], ti.f64)
            q = mass_times(m, i, stage.change) - beta * ti.cast(loads_on(m, i), ti.f64)
            stage.moved[i] = q
            sums[MASS] += mass
            for a in ti.static(range(3)):
                sums[CENTRE + a] += mass * x[i][a]
                sums[RESULTANT + a] += q[a]
                sums[FIXED + a] += fixed[a]
    for j in ti.static(range(N_MOMENTS)):
        pieces.sums[row, j] = sums[j]


@ti.func
def _find_translation(pieces: ti.template(), j):
    """Add up the rows of component j, and set the velocity that balances it, along the axes without constraints."""
    for q in ti.static(range(N_MOMENTS)):
        total = ti.cast(0.0, ti.f64)
        for row in range(pieces.component_row[j], pieces.component_row[j + 1]):
            total += pieces.sums[row, q]
        pieces.moments[j, q] = total
    for a in ti.static(range(3)):
        pieces.moments[j, CENTRE + a] = pieces.moments[j, CENTRE + a] / pieces.moments[j, MASS]
        pieces.motion[j, a], pieces.motion[j, 3 + a] = 0.0, 0.0
        if pieces.moments[j, FIXED + a] == 0.0:
            pieces.motion[j, a] = -pieces.moments[j, RESULTANT + a] / pieces.moments[j, MASS]


@ti.func
def _moment(m: ti.template(), stage: ti.template(), pieces: ti.template(), x: ti.template(), mode: ti.template(), row, beta):
    """Add up a row of nodes: moment of inertia and loads, moments of inertia; linearised, the moment of beta f x v, and its
    derivative by a turning.
    """
    identity = ti.Matrix.identity(ti.f64, 3)
    moment, I = ti.Vector.zero(ti.f64, 3), ti.Matrix.zero(ti.f64, 3, 3)
    geometric, turn = ti.Vector.zero(ti.f64, 3), ti.Matrix.zero(ti.f64, 3, 3)
    for at in range(pieces.row_start[row], pieces.row_start[row + 1]):
        i = pieces.node[at]
        if not is_dependent(m, i):
            j = pieces.component[i]
            c = _centre(pieces, j)
            arm, q = x[i] - c, stage.moved[i]
            if ti.static(m.stiffness_damping):
                q -= beta * ti.cast(damping_force(m, stage, row, i, m.state.v), ti.f64)
                if ti.static(mode == AFTER):
                    q -= beta * ti.cast(damping_force(m, stage, row, i, stage.pcg.y), ti.f64)
            moment += arm.cross(q)
            mass_arm = _damping_factor(m, i, beta) * _mass_times_arm(m, i, x, c)
            I += arm.dot(mass_arm) * identity - mass_arm.outer_product(arm)
            if ti.static(mode != SOLVED):
                f = ti.cast(internal_on(m, i), ti.f64)
                # the velocity of the first node has no moment, but that of the forces' rounding
                first = pieces.node[pieces.row_start[pieces.component_row[j]]]
                geometric -= beta * beta * f.cross(_velocity(m, stage, i, mode) - _velocity(m, stage, first, mode))
                turn -= beta * beta * (f.dot(arm) * identity - arm.outer_product(f))
    for a in ti.static(range(3)):
        pieces.sums[row, a], pieces.sums[row, 3 + a] = moment[a], geometric[a]
        for b in ti.static(range(3)):
            pieces.sums[row, 6 + 3 * a + b], pieces.sums[row, 15 + 3 * a + b] = I[a, b], turn[a, b]


@ti.func
def _is_definite(A):
    """Whether a symmetric matrix is positive definite."""
    return A[0, 0] > 0.0 and A[0, 0] * A[1, 1] > A[0, 1] * A[1, 0] and A.determinant() > 0.0


@ti.func
def _find_turning(pieces: ti.template(), j):
    """Set the angular velocity that balances component j, about the axes across which no node is constrained.

    Compression can make a linearised step turn a body without bound; its matrix is then nearly singular, and only inertia counts.
    """
    total = ti.Vector.zero(ti.f64, N_TERMS)
    for row in range(pieces.component_row[j], pieces.component_row[j + 1]):
        for q in ti.static(range(N_TERMS)):
            total[q] += pieces.sums[row, q]
    moment, I = ti.Vector([total[0], total[1], total[2]]), ti.Matrix.zero(ti.f64, 3, 3)
    turn = ti.Matrix.zero(ti.f64, 3, 3)
    for a in ti.static(range(3)):
        for b in ti.static(range(3)):
            I[a, b], turn[a, b] = total[6 + 3 * a + b], total[15 + 3 * a + b]
    if _is_definite((1.0 - LEAST_INERTIA) * I + turn):
        moment += ti.Vector([total[3], total[4], total[5]])
        I += turn
    else:
        pieces.held[j] = INERT
    fixed = ti.Vector([pieces.moments[j, FIXED], pieces.moments[j, FIXED + 1], pieces.moments[j, FIXED + 2]])
    if fixed.sum() == 0.0:
        w = I.inverse() @ moment
        for a in ti.static(range(3)):
            pieces.motion[j, 3 + a] = -w[a]
    else:
        for a in ti.static(range(3)):
            if fixed[(a + 1) % 3] + fixed[(a + 2) % 3] == 0.0:
                pieces.motion[j, 3 + a] = -moment[a] / I[a, a]


@kernel
def correct_rigid_motion(
    m: ti.template(),
    stage: ti.template(),
    pieces: ti.template(),
    contacts: ti.template(),
    x: ti.template(),
    mode: ti.template(),
    beta: ti.f64,
):
    """Add to v the rigid motion that balances each free component, see `pieces`, and beta times it to x.

    x: positions of the arms, at which elements and terms hold the forces. mode: SOLVED, after a nonlinear stage, whose residual
    is corrected, too; LINEARISED, after a linearised one; BEFORE, at the start of one, whose x stays until AFTER adds CG's y.
    """
    ti.loop_config(serialize=m.serial)
    for j in range(pieces.n_components):
        pieces.held[j] = pieces.anchored[j]
        if ti.static(mode != SOLVED):
            pieces.held[j] = ti.max(pieces.anchored[j], pieces.pressed[j])
    _in_contact(pieces, contacts)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        if pieces.held[pieces.component[i]] != HELD:
            stage.change[i] = _damping_factor(m, i, beta) * _velocity(m, stage, i, mode) - stage.v_hat[i]
    ti.loop_config(serialize=m.serial)
    for row in range(pieces.n_rows):
        if not _is_held(pieces, row):
            _resultant(m, stage, pieces, x, row, beta)
    ti.loop_config(serialize=m.serial)
    for j in range(pieces.n_components):
        if pieces.held[j] != HELD:
            _find_translation(pieces, j)
    ti.loop_config(serialize=m.serial)
    for row in range(pieces.n_rows):
        if not _is_held(pieces, row):
            _moment(m, stage, pieces, x, mode, row, beta)
    ti.loop_config(serialize=m.serial)
    for j in range(pieces.n_components):
        if pieces.held[j] != HELD:
            _find_turning(pieces, j)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        j, change = pieces.component[i], ti.Vector.zero(ti.f64, 3)
        if pieces.held[j] != HELD and not is_dependent(m, i):
            c = _centre(pieces, j)
            u, w = ti.Vector([pieces.motion[j, 0], pieces.motion[j, 1], pieces.motion[j, 2]]), _turning(pieces, j)
            free, factor = ti.cast(m.free[i], ti.f64), _damping_factor(m, i, beta)
            if ti.static(mode == SOLVED):
                momentum = _row_sum(m, i) * u + w.cross(_mass_times_arm(m, i, x, c))
                stage.residual[i] = stage.residual[i] + ti.cast(free * factor * momentum, m.real)
            change = free * (u + w.cross(x[i] - c))
            stage.change[i] = stage.change[i] + factor * change
        moved = change
        if ti.static(mode == AFTER):
            change += ti.cast(stage.pcg.y[i], ti.f64)
            moved = change + ti.cast(m.free[i], ti.f64) * m.state.v[i]
        m.state.v[i] = m.state.v[i] + change
        stage.moved[i] = beta * moved
    if ti.static(mode != BEFORE):
        ti.loop_config(serialize=m.serial)
        for i in range(m.n_nodes):
            m.state.x[i] = m.state.x[i] + stage.moved[i]
        place_all(m)


@kernel
def turn_forces(m: ti.template(), stage: ti.template(), pieces: ti.template(), beta: ti.f64):
    """Add to residual and rhs the change of internal forces by the turning of `correct_rigid_motion` BEFORE a linearised step."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        if pieces.held[pieces.component[i]] == FREE and not is_dependent(m, i):
            f = ti.cast(internal_on(m, i), ti.f64)
            r = stage.residual[i] - ti.cast(beta * beta * _turning(pieces, pieces.component[i]).cross(f), m.real)
            stage.residual[i] = r
            stage.pcg.rhs[i] = -m.free[i] * r
