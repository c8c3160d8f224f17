"""State: positions, velocities and the scratch of kernels over one model. All other model arrays are constant."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import Runtime
from taisoft.fem.scalars import N_COLUMNS, N_SCALARS


@dataclass(frozen=True, eq=False)
class State:
    """Positions and velocities of all nodes, and scratch."""

    x: Any  # (n_nodes) 3-vectors f64: positions [m]
    v: Any  # (n_nodes) 3-vectors: velocities [m/s]
    element_force: Any  # forces of each tet on its nodes [N], per block (node, axis, lane): a `Lanes` buffer
    element_force_at: Count  # first entry of that buffer
    element_force_mask: int  # index mask of that buffer
    scalars: Any  # (N_SCALARS) f64: results for the host, indexed by `scalars`
    partial: Any  # (chunks, N_COLUMNS) f64: partial sums, added in a fixed order


def build_state(arena: FieldArena, runtime: Runtime, x: np.ndarray, v: np.ndarray, n_force_entries: int, chunks: int) -> State:
    """Allocate a state and fill it with x and v (n_nodes, 3). n_force_entries: size of `element_force`."""
    force = arena.lanes("element_force", runtime.real, n_force_entries)
    return State(
        x=arena.vectors("x", ti.f64, len(x), x),
        v=arena.vectors("v", runtime.real, len(v), v.astype(runtime.np_real)),
        element_force=force.memory,
        element_force_at=force.at,
        element_force_mask=force.mask,
        scalars=arena.field("scalars", ti.f64, N_SCALARS),
        partial=arena.field("partial", ti.f64, (chunks, N_COLUMNS)),
    )
