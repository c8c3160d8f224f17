"""Sweep until the residual is small: by a team in one launch, or in parallel loops.

On a CPU the team is one thread, which is faster: it takes 0.06 us per contact and sweep. A parallel loop costs some 30 us to
start, a sweep has two to twenty of them, and memory bandwidth limits two threads to little more than the speed of one. On a GPU
it is a block, since a launch for each colour takes longer than its contacts; only large problems use all threads.
A team leaves out, until the next residual check, the contacts that a check after the first finds open.
Momentum and the strategy of the r-factors, see `strategy`, follow any kind of sweep.
"""

from dataclasses import dataclass, field

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.backend.team import ALONE, Team
from taisoft.contact.problem import (
    BEST,
    CHECKS,
    CHUNKS,
    HISTORY,
    RESIDUAL,
    SWEEPS,
    ContactProblem,
    find_velocities,
    set_velocities,
)
from taisoft.contact.strategy import apply_verdict, judge, move_on, residual_terms, restart_test, set_weight
from taisoft.contact.sweeps import SIMULTANEOUS, relaxation, sweep, sweep_parallel

LAUNCH_VISITS = 1_000_000  # contact visits per launch: about 0.1 s, so that Ctrl-C takes effect
MOST_OF_TEAM = 30_000  # contacts from which all threads of a GPU share a sweep
CHECK_EVERY = 5  # sweeps between residual checks, each of which costs as much as a sweep


@dataclass(frozen=True)
class SolveResult:
    """Result of a contact solve. residual: of the final impulses; history: at each check, beginning with the start."""

    iterations: int
    residual: float
    converged: bool
    history: list[float] = field(default_factory=list)


def solve(
    problem: ContactProblem,
    method: str,
    tolerance: float,
    max_iterations: int,
    every: int = CHECK_EVERY,
    history: bool = False,
    momentum: bool = True,
    is_begun: bool = False,
) -> SolveResult:
    """Solve the problem, starting from its impulses and replacing them by the best ones found.

    method: one of SOLVERS; coloured_gauss_seidel requires grouped contacts, see `colouring`. tolerance: bound on the residual.
    max_iterations: sweeps. every: sweeps between residual checks. history: whether to return the residual of each check.
    momentum: False for the plain method. is_begun: whether `sweeps_of_team` has taken some of the sweeps, or
    all that are needed.
    """
    n_contacts = int(problem.count[0])
    team, is_parallel = team_of(problem, method, n_contacts)
    batch, residuals, state, first = sweeps_per_launch(n_contacts, every), [], problem.sweep.state.to_numpy(), int(not is_begun)
    taken = 0 if first else int(state[SWEEPS])
    while first or (taken < max_iterations and not state[RESIDUAL] <= tolerance):
        n = min(batch, max_iterations - taken)
        if is_parallel:
            _run_parallel(problem, method, first, n, every, tolerance, int(momentum))
        else:
            _run(problem, team, method, first, n, every, tolerance, int(momentum))
        state, taken, first = problem.sweep.state.to_numpy(), taken + n, 0
        if history:
            residuals += problem.sweep.history.to_numpy(int(state[CHECKS])).tolist()
    if not state[RESIDUAL] <= state[BEST]:
        _restore_best(problem, team)
        state[RESIDUAL] = state[BEST]
    return SolveResult(int(state[SWEEPS]), float(state[RESIDUAL]), bool(state[RESIDUAL] <= tolerance), residuals)


def sweeps_per_launch(n_contacts: int, every: int = CHECK_EVERY) -> int:
    """Most sweeps in a launch."""
    return max(1, min(HISTORY - 1, LAUNCH_VISITS // max(1, n_contacts) // every)) * every


def team_of(problem: ContactProblem, method: str, n_contacts: int) -> tuple[Team, bool]:
    """Return the team for a problem of so many contacts, and whether all threads share its loops instead."""
    if problem.serial or method == "gauss_seidel":  # which has no parallel form
        return ALONE, False
    return problem.team, problem.on_cpu or n_contacts > MOST_OF_TEAM


# --- by a team ------------------------------------------------------------------------------------------------------------


@ti.func
def sweeps_of_team(
    problem: ti.template(), team: ti.template(), method: ti.template(), t, first, sweeps, every, tolerance, with_momentum
):
    """Run up to `sweeps` sweeps with a residual check after each `every`, by all threads t of a team.

    first: 1 at the start of a solve; with_momentum: 0 or 1.
    """
    if t == 0:
        problem.sweep.state[CHECKS] = 0.0
    if first == 1:
        set_velocities(problem, team, t)
        for j in range(team.share(t, problem.count[0])):
            _prepare(problem, team.entry(t, j, problem.count[0]), method, with_momentum)
        _check(problem, team, t, 1, 0)
    done = 0
    while done < sweeps and not problem.sweep.state[RESIDUAL] <= tolerance:
        n = ti.min(every, sweeps - done)
        for _k in range(n):
            sweep(problem, team, method, t)
            if with_momentum == 1:
                _extrapolate(problem, team, t)
            set_velocities(problem, team, t)
        done += n
        _check(problem, team, t, 0, n)
        if problem.sweep.state[RESIDUAL] == problem.sweep.state[BEST]:
            set_velocities(problem, team, t)


@ti.func
def _check(problem: ti.template(), team: ti.template(), t, first, sweeps):
    """Check the residual and save or restore the impulses; w must be up to date."""
    n, sums = problem.count[0], ti.Vector([0.0, 0.0], ti.f64)
    for j in range(team.share(t, n)):
        sums += residual_terms(problem, team.term(t, j), first)
    for k in ti.static(range(2)):
        sums[k] = team.total(t, sums[k])
    if t == 0:
        judge(problem, sums, first, sweeps)
    team.sync()
    for j in range(team.share(t, n)):
        apply_verdict(problem, team.entry(t, j, n))
    team.sync()


@ti.func
def _extrapolate(problem: ti.template(), team: ti.template(), t):
    """Set the impulses from which the next sweep starts."""
    n, backwards = problem.count[0], ti.cast(0.0, ti.f64)
    for j in range(team.share(t, n)):
        backwards += restart_test(problem, team.term(t, j))
    backwards = team.total(t, backwards)
    if t == 0:
        set_weight(problem, backwards)
    team.sync()
    for j in range(team.share(t, n)):
        move_on(problem, team.entry(t, j, n))
    team.sync()


@ti.func
def restore_best(problem: ti.template(), team: ti.template(), t):
    """Replace the present impulses by the best ones, if these are better, at the end of a solve."""
    residual, best = problem.sweep.state[RESIDUAL], problem.sweep.state[BEST]
    team.sync()
    if best < residual or residual != residual:
        for j in range(team.share(t, problem.count[0])):
            c = team.entry(t, j, problem.count[0])
            problem.r[c] = problem.sweep.best[c]
        if t == 0:
            problem.sweep.state[RESIDUAL] = best
        team.sync()
        set_velocities(problem, team, t)


@kernel
def _run(
    problem: ti.template(),
    team: ti.template(),
    method: ti.template(),
    first: ti.i32,
    sweeps: ti.i32,
    every: ti.i32,
    tolerance: ti.f64,
    with_momentum: ti.i32,
):
    """See `sweeps_of_team`."""
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        sweeps_of_team(problem, team, method, t, first, sweeps, every, tolerance, with_momentum)


@kernel
def _restore_best(problem: ti.template(), team: ti.template()):
    """See `restore_best`."""
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        restore_best(problem, team, t)


# --- on all threads -------------------------------------------------------------------------------------------------------


def _run_parallel(
    problem: ContactProblem, method: str, first: int, sweeps: int, every: int, tolerance: float, with_momentum: int
) -> None:
    """As `_run`; the host reads the residual."""
    state = problem.sweep.state
    state[CHECKS] = 0.0
    if first:
        find_velocities(problem)
        _prepare_all(problem, method, with_momentum)
        _check_all(problem, 1, 0)
    done, n_colours, found = 0, 0 if method in SIMULTANEOUS else int(problem.count[1]), state.to_numpy()
    while done < sweeps and not found[RESIDUAL] <= tolerance:
        n = min(every, sweeps - done)
        for _ in range(n):
            sweep_parallel(problem, method, n_colours)
            if with_momentum:
                _extrapolate_all(problem)
            find_velocities(problem)
        done += n
        _check_all(problem, 0, n)
        found = state.to_numpy()
        if found[RESIDUAL] == found[BEST]:
            find_velocities(problem)


@ti.func
def _sum_chunks(problem: ti.template()):
    """Sum the terms of each chunk, in order."""
    for k in range(CHUNKS):
        n, total = problem.count[0], ti.Vector([0.0, 0.0], ti.f64)
        for c in range(k * n // CHUNKS, (k + 1) * n // CHUNKS):
            total += problem.sweep.term[c]
        problem.sweep.partial[k] = total


@ti.func
def _total(problem: ti.template()):
    total = ti.Vector([0.0, 0.0], ti.f64)
    for k in range(CHUNKS):
        total += problem.sweep.partial[k]
    return total


@kernel
def _prepare_all(problem: ti.template(), method: ti.template(), with_momentum: ti.i32):
    for c in range(problem.count[0]):
        _prepare(problem, c, method, with_momentum)


@kernel
def _check_all(problem: ti.template(), first: ti.i32, sweeps: ti.i32):
    """As `_check`."""
    for c in range(problem.count[0]):
        problem.sweep.term[c] = residual_terms(problem, c, first)
    _sum_chunks(problem)
    ti.loop_config(serialize=True)
    for _ in range(1):
        judge(problem, _total(problem), first, sweeps)
    for c in range(problem.count[0]):
        apply_verdict(problem, c)


@kernel
def _extrapolate_all(problem: ti.template()):
    """As `_extrapolate`."""
    for c in range(problem.count[0]):
        problem.sweep.term[c] = [restart_test(problem, c), 0.0]
    _sum_chunks(problem)
    ti.loop_config(serialize=True)
    for _ in range(1):
        set_weight(problem, _total(problem)[0])
    for c in range(problem.count[0]):
        move_on(problem, c)


@ti.func
def _prepare(problem: ti.template(), c, method: ti.template(), with_momentum):
    """Set the fraction of the r-factors and the impulse of contact c before the first sweep."""
    problem.sweep.relaxation[c] = relaxation(problem, c, method, with_momentum)
    problem.sweep.previous[c] = problem.r[c]
