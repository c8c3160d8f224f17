"""Linear solves of stages with given volumes and lengths: for y and the change of the multipliers together, see `multipliers`."""

from dataclasses import replace

import numpy as np

from taisoft.backend.arrays import upload
from taisoft.dynamics.stage_system import StageSystem
from taisoft.linear import pcg
from taisoft.linear.bordered import products
from taisoft.linear.jacobi import JACOBI
from taisoft.linear.pcg_work import LinearResult

MAX_TOLERANCE = 3e-2  # of the linear solves for z without contacts, which the size of r says nothing about
SLOPE_TOLERANCE = 1e-3  # of those with contacts


def solve_constrained(system: StageSystem, tolerance: float) -> LinearResult:
    """Solve the bordered system for y of pcg from -r, and change the multipliers.

    Where it is singular, or A indefinite even when projected, y is y_0 and they stay; where A is not finite, y is 0.
    """
    system.multipliers.slope_change = 0.0
    if not len(system.multipliers.candidates):
        return system.solve_linear(tolerance)
    solution = _solve_bordered(system, tolerance)
    if not solution.negative:
        return solution
    system.form_matrix(projected=True)
    again = _solve_bordered(system, tolerance)
    return replace(again, iterations=solution.iterations + again.iterations, negative=False)


def _solve_bordered(system: StageSystem, tolerance: float) -> LinearResult:
    model, work, A, multipliers = system.model, system.work.pcg, system.matrix, system.multipliers
    system.pieces.forget_factors()
    chosen = multipliers.candidates
    G, right, penalty = multipliers.rows(system.stage.beta, chosen), work.rhs.host.copy(), multipliers.penalty[chosen]
    if not np.isfinite(A.diagonal.host).all():
        work.y.host[...] = 0.0
        return LinearResult(0, False, False)
    border, found, solutions = multipliers.border(G, penalty), [], []
    for k, rhs in enumerate((right, *G)):
        work.rhs.host[...] = rhs.reshape(-1, 3)
        accuracy = tolerance if k == 0 else min(tolerance, MAX_TOLERANCE)
        found.append(pcg.solve(model, A, JACOBI, work, accuracy, pcg.iteration_limit(model), border=border))
        solutions.append(work.y.host.astype(np.float64).reshape(-1))
    work.rhs.host[...] = right
    system.linear_solver.matrix_changed()  # its preconditioner may share the inverses of blocks with Jacobi's
    y, z = solutions[0], np.array(solutions[1:])
    negative = any(one.negative for one in found)
    shift = multipliers.effective[chosen] - multipliers.values[chosen]
    change = None if negative else multipliers.change(G, y, z, shift, penalty)
    if change is not None:
        factors, changed = change
        y = y + np.einsum("k,kn->n", factors, z)
        multipliers.slope_change = -float(changed @ products(G, y[None])[:, 0])
    work.y.host[...] = y.reshape(-1, 3)
    converged = change is not None and all(one.converged for one in found)
    return LinearResult(sum(one.iterations for one in found), converged, negative)


def correct(system: StageSystem) -> tuple[int, bool]:
    """Change the multipliers, and v along with them, to reach the volumes and lengths to first order.

    Return the linear iterations, and whether it was possible; if not, nothing is changed.
    """
    state, work, multipliers = system.model.state, system.work.pcg, system.multipliers
    G, z, n = multipliers.rows(system.stage.beta, multipliers.candidates), [], 0
    system.form_matrix(projected=True)
    for row in G:
        upload([(work.rhs, row.reshape(-1, 3))])
        n += system.solve_linear(SLOPE_TOLERANCE).iterations
        z.append(work.y.to_numpy().astype(np.float64).reshape(-1))
    zero = np.zeros(len(G))
    change = multipliers.change(G, np.zeros(G.shape[1]), np.array(z), zero, zero)
    if change is None:
        return n, False
    upload([(state.v, state.v.to_numpy() + np.einsum("k,kn->n", change[0], np.array(z)).reshape(-1, 3))])
    multipliers.upload(multipliers.values)
    return n, True
