"""Nonlinear elimination: what keeps Newton's method from converging is solved on its own, where it sits.

Tets that turn inside out, fold or snap are few and far from linear: each Newton step of the whole stage changes them by so much
that the next one starts anew. Where a step leaves much of |r|, and nearly all of that on few nodes, the stage is solved on these
and their neighbours while all others stay. What that leaves is smooth, and the next whole step deals with it.
Source: Lanzkron, Rose and Wilkes, "An analysis of approximate nonlinear elimination", SIAM J. Sci. Comput. 17(2), 1996.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taisoft.dynamics.newton import Newton
from taisoft.dynamics.residual import STAY
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.dynamics.subset_lists import entries_of
from taisoft.transfer import download

CONCENTRATED, FEW = 0.99, 0.35  # share of |r|^2 that at most so large a share of the nodes must hold
RINGS = 2  # of neighbours that are taken with them
STEPS, REDUCTION = 32, 0.1  # Newton steps of an elimination at most, and share of |r| that it is to leave


@dataclass(frozen=True)
class Eliminated:
    """Newton and CG iterations of an elimination, each times the share of the nodes."""

    newton: float
    linear: float


def choose_nodes(residual: np.ndarray, start: np.ndarray, column: np.ndarray) -> np.ndarray | None:
    """The fewest nodes that hold nearly all of |r|^2, and those around them, ascending; None where they are many.

    residual: (n, 3) on the free axes, 0 on others. start (n + 1), column: each node's neighbours.
    """
    squares = (residual.astype(np.float64) ** 2).sum(axis=1)
    largest = np.argsort(-squares, kind="stable")
    held = np.cumsum(squares[largest])
    if not 0.0 < held[-1] < math.inf:
        return None
    n = int(np.searchsorted(held, CONCENTRATED * held[-1])) + 1
    if n > FEW * len(squares):
        return None
    nodes = largest[:n]
    for _ in range(RINGS):
        nodes = np.unique(np.concatenate([nodes, column[entries_of(start, nodes)]]))
    return nodes


def eliminate(system: StageSystem, stage: Stage, r: float) -> Eliminated | None:
    """Solve a stage with |r| on the few nodes that hold nearly all of it, see `solve_on`; None where they are many."""
    residual, free = download([system.work.residual, system.model.free])
    lists = system.lists
    nodes = choose_nodes(free * residual, lists.start, lists.column)
    return None if nodes is None else solve_on(system, stage, nodes, REDUCTION * r)


def solve_on(system: StageSystem, stage: Stage, nodes: np.ndarray, left: float) -> Eliminated:
    """Solve a stage on some nodes, ascending, under the multipliers at hand, until their |r| is no more than `left` [N s].

    The state and the elastic forces are then what that led to, the residual has to be formed anew, and the matrix is void.
    """
    system.restrict(nodes)
    try:
        own = replace(stage, absolute_tolerance=left, contact_tolerance=math.inf, keeps_multipliers=True, max_newton=STEPS)
        newton = Newton(system, own)
        newton.run(*system.evaluate(STAY), fresh=False)
    finally:
        system.restrict(None)
    share = len(nodes) / system.model.n_nodes
    return Eliminated(share * newton.newton, share * newton.linear)
