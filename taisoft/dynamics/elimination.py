"""Nonlinear elimination: solve separately on the few nodes that keep Newton's method from converging.

Tets that invert, fold or snap are few and strongly nonlinear: each Newton step of the whole stage changes them so much that the
next one makes no progress. If a step reduces |r| little, and nearly all of it is on few nodes, the stage is solved on these and
their neighbours while all others are fixed. The remaining residual is smooth and suits the next full step.
Source: Lanzkron, Rose and Wilkes, "An analysis of approximate nonlinear elimination", SIAM J. Sci. Comput. 17(2), 1996.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taisoft.backend.arrays import download
from taisoft.dynamics.newton import Newton
from taisoft.dynamics.stage import STAY, Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.ranges import entries_of

CONCENTRATED, FEW = 0.99, 0.35  # minimum fraction of |r|^2 on the chosen nodes, and maximum fraction of nodes
STEPS, REDUCTION = 32, 0.1  # maximum Newton steps of an elimination, and target fraction of |r|


@dataclass(frozen=True)
class Eliminated:
    """Newton and CG iterations of an elimination, each times the fraction of nodes."""

    newton: float
    linear: float


def choose_nodes(residual: np.ndarray, start: np.ndarray, column: np.ndarray) -> np.ndarray | None:
    """Return the fewest nodes with nearly all of |r|^2, and their neighbours, ascending; None if they are many.

    residual: (n, 3) on the free axes, 0 on others. start (n + 1), column: each node's neighbours.
    """
    rounding, rings = 1e-9, 2  # of a sum of squares; of neighbours that are added
    squares = (residual.astype(np.float64) ** 2).sum(axis=1)
    first = len(squares) - int(FEW * len(squares))
    if np.partition(squares, min(first, len(squares) - 1))[first:].sum() < (1.0 - rounding) * CONCENTRATED * squares.sum():
        return None  # without sorting all
    largest = np.argsort(-squares, kind="stable")
    cumulative = np.cumsum(squares[largest])
    if not 0.0 < cumulative[-1] < math.inf:
        return None
    n = int(np.searchsorted(cumulative, CONCENTRATED * cumulative[-1])) + 1
    if n > FEW * len(squares):
        return None
    nodes = largest[:n]
    for _ in range(rings):
        nodes = np.unique(np.concatenate([nodes, column[entries_of(start, nodes)]]))
    return nodes


def eliminate(system: StageSystem, stage: Stage, r: float, nodes: np.ndarray | None = None) -> Eliminated | None:
    """Solve a stage on the few nodes with nearly all of |r|, under the current multipliers, until their |r| is a tenth of that.

    None if they are many or nodes depend on others. nodes: solve on these instead, ascending.
    This updates the state and the elastic forces; the residual must be evaluated again, and the matrix is invalid.
    """
    if system.model.has_dependents:  # whose tets act on nodes that may not be among the few
        return None
    if nodes is None:
        residual, free = download([system.work.residual, system.model.free])
        lists = system.lists
        nodes = choose_nodes(free * residual * system.pieces.node_weights()[:, None], lists.start, lists.column)
    if nodes is None:
        return None
    target = REDUCTION * r
    system.restrict(nodes)
    fraction = len(nodes) / system.model.n_nodes
    steps = min(STEPS, int(system.budget.left / fraction))
    try:
        substage = replace(stage, absolute_tolerance=target, contact_tolerance=math.inf, keeps_multipliers=True, max_newton=steps)
        newton = Newton(system, substage)
        newton.run(*system.evaluate(STAY), fresh=False)
    finally:
        system.restrict(None)
    system.budget.spend(fraction * newton.newton)
    return Eliminated(fraction * newton.newton, fraction * newton.linear)
