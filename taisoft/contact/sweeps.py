"""One relaxation of every contact by each method, and the fraction of its r-factors that a contact may use in it.

gauss_seidel (report, algorithm 2)          one contact after another in `order`, using the impulses already updated;
coloured_gauss_seidel (algorithm 7)         one colour after another, all contacts of a colour in parallel, see `colouring`.
    They share no movable node, so their changes of w are added, as in sequential order. (Line 15 of the report averages them,
    which solves a different problem.) The result is that of Gauss-Seidel in the order of the colours, which is also what runs
    on one thread;
jacobi (algorithm 4)                        all contacts in parallel, using the impulses of the last sweep, in the friction
    disk too;
hybrid (algorithm 5)                        Jacobi, but the friction disk uses the new normal impulse.

The fraction keeps a sweep from overshooting. With B the blocks of F^1/2 W F^1/2, F the r-factors, a step of the fraction s along
the velocity lowers the energy of the impulses if s B <= 1. For contacts relaxed sequentially only the diagonal block counts:
s = 1 / |B_cc|. It is needed only with momentum, which amplifies overshoot. For contacts relaxed in parallel the whole row counts:
s_c = 1 / sum_d |B_cd| (block Gershgorin). This adapts to the local density of contacts; a single number from the largest
eigenvalue of F W would slow all contacts down to the worst one.
The norms are upper bounds: sqrt(|B|_1 |B|_inf) for a matrix, absolute values of the weights over nodes.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.problem import STEP, ContactProblem, add_impulse, own_block, velocity
from taisoft.contact.prox import dvec, into_disk, prox, scaled

SIMULTANEOUS = ("jacobi", "hybrid")  # methods that relax all contacts with the impulses of the last sweep
BATCH = 4  # colours per launch: a launch costs more than a loop in it


# --- sweeps -----------------------------------------------------------------------------------------------------------


@ti.func
def sweep(problem: ti.template(), team: ti.template(), method: ti.template(), t):
    """Relax every contact once, by all threads t of a team, one of them for gauss_seidel; leave the old impulses in
    `sweep_start`."""
    n = problem.count[0]
    if ti.static(method in SIMULTANEOUS):
        for j in range(team.share(t, n)):
            c = team.entry(t, j, n)
            problem.sweep.sweep_start[c] = _relaxed(problem, c, method)
        team.sync()
        for j in range(team.share(t, n)):
            _swap(problem, team.entry(t, j, n))
        team.sync()
    elif ti.static(method == "gauss_seidel"):
        for k in range(n):
            _relax_active(problem, problem.sweep.order[k])
    else:
        for colour in range(problem.count[1]):
            first = problem.sweep.by_colour.start[colour]
            size = problem.sweep.by_colour.start[colour + 1] - first
            for j in range(team.share(t, size)):
                _relax_active(problem, problem.sweep.order[first + team.entry(t, j, size)])
            team.sync()


def sweep_parallel(problem: ContactProblem, method: str, n_colours: int) -> None:
    """As `sweep`, on all threads of the CPU or of a GPU, for any method but gauss_seidel."""
    if method in SIMULTANEOUS:
        _relax_all(problem, method)
    else:
        for first in range(0, n_colours, BATCH):
            _relax_colours(problem, first)


@ti.func
def _relax_active(problem: ti.template(), c):
    """`_relax` contact c, unless it was open at the last residual check."""
    if problem.sweep.idle[c] == 1:
        problem.sweep.sweep_start[c] = problem.r[c]
    else:
        _relax(problem, c)


@ti.func
def _relax(problem: ti.template(), c):
    """Apply one prox step to contact c and add the change of its impulse to its nodes."""
    r = problem.r[c]
    problem.sweep.sweep_start[c] = r
    new = prox(_step(problem, c), problem.friction[c])
    if (new != r).any():
        add_impulse(problem, c, new - r)
        problem.r[c] = new


@ti.func
def _relaxed(problem: ti.template(), c, method: ti.template()):
    """Impulse of contact c after one prox step."""
    z = _step(problem, c)
    new = prox(z, problem.friction[c])
    if ti.static(method == "jacobi"):
        new = into_disk([new[0], z[1], z[2]], problem.friction[c] * problem.r[c][0])
    return new


@ti.func
def _step(problem: ti.template(), c):
    """Impulse of contact c after a step against its velocity, before the projection."""
    return problem.r[c] - scaled(
        problem.sweep.state[STEP] * problem.sweep.relaxation[c] * problem.factor[c], velocity(problem, c)
    )


@ti.func
def _swap(problem: ti.template(), c):
    """Swap the new impulse of contact c, held in sweep_start, with its present one."""
    new = problem.sweep.sweep_start[c]
    problem.sweep.sweep_start[c] = problem.r[c]
    problem.r[c] = new


@kernel
def _relax_all(problem: ti.template(), method: ti.template()):
    for c in range(problem.count[0]):
        problem.sweep.sweep_start[c] = _relaxed(problem, c, method)
    for c in range(problem.count[0]):
        _swap(problem, c)


@kernel
def _relax_colours(problem: ti.template(), first: ti.i32):
    """Relax the contacts of BATCH colours from `first` on, each colour on all threads."""
    for q in ti.static(range(BATCH)):
        for k in range(_colour_start(problem, first + q), _colour_start(problem, first + q + 1)):
            _relax(problem, problem.sweep.order[k])


@ti.func
def _colour_start(problem: ti.template(), colour):
    """Start of a colour in `order`; the end of the last colour for any later one."""
    return problem.sweep.by_colour.start[ti.min(colour, problem.count[1])]


# --- fraction of the r-factors ----------------------------------------------------------------------------------------


@ti.func
def relaxation(problem: ti.template(), c, method: ti.template(), with_momentum):
    """Fraction of its r-factors, in (0, 1], that contact c uses; with_momentum: 0 or 1."""
    total = ti.cast(0.0, ti.f64)
    if ti.static(method in SIMULTANEOUS):
        total = _row_norm(problem, c)
    elif with_momentum == 1:
        a = _roots(problem, c)
        total = _norm(own_block(problem, c), a, a)
    return ti.min(1.0, ti.select(total > 0.0, 1.0 / total, 1.0))


@ti.func
def _row_norm(problem: ti.template(), c):
    """sum_d |B_cd|."""
    total = ti.cast(0.0, ti.f64)
    a = _roots(problem, c)
    if ti.static(problem.matrix):
        for k in range(problem.row_start[c], problem.row_start[c + 1]):
            B = ti.Matrix.zero(ti.f64, 3, 3)
            for i, j in ti.static(ti.ndrange(3, 3)):
                B[i, j] = problem.block[k, 3 * i + j]
            total += _norm(B, a, _roots(problem, problem.column[k]))
    else:
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            i = problem.node[e]
            weights = ti.cast(0.0, ti.f64)
            for at in range(problem.by_node.start[i], problem.by_node.start[i + 1]):
                other = problem.entry[at]
                weights += ti.abs(problem.weight[other]) * _roots(problem, problem.contact[other]).max()
            total += ti.abs(problem.weight[e]) * problem.inverse_mass[i].max() * a.max() * weights
    return total


@ti.func
def _roots(problem: ti.template(), c):
    """Square roots of the r-factors of contact c, by component."""
    n, t = ti.sqrt(problem.factor[c][0]), ti.sqrt(problem.factor[c][1])
    return dvec(n, t, t)


@ti.func
def _norm(B, a, b):
    """Upper bound of the 2-norm of diag(a) B diag(b)."""
    columns, rows = dvec(0.0), dvec(0.0)
    for i, j in ti.static(ti.ndrange(3, 3)):
        size = ti.abs(a[i] * B[i, j] * b[j])
        columns[j] += size
        rows[i] += size
    return ti.sqrt(columns.max() * rows.max())
