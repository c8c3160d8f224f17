"""State: positions, velocities and the scratch of kernels over one model. All other model arrays are constant.

Kernels return scalars to the host in `State.scalars`; below are their indices, and the columns of the sums in `State.partial`.
"""

from dataclasses import dataclass
from typing import Any

# Of a state: energies [J], smallest J = det F, number of inverted tets; the first tet, by blocks and lanes, so compressed that
# its law softens; the potential of its dead loads [J]
ELASTIC, MIN_J, N_INVERTED, KINETIC, GRAVITY, FIRST_SOFTENED, LOADS = range(7)
# Of a batch of substeps; INVERTED_NOW of the present one; FAILED: 1 if a velocity is not finite or a tet has exploded
STEPS_DONE, LOWEST_J, MOST_INVERTED, INVERTED_NOW, FAILED = range(7, 12)
# r.y at the start and end of a Newton step (negative is downhill); length of the step taken by a linearised stage
START_SLOPE, END_SLOPE, STEP_LENGTH = range(12, 15)
NORMS, N_NORMS = 15, 5  # of a residual, see `form_residual`; in `State.partial` the first columns
# Of an impact: E'(0) minus the recoverable energy, E''; of a path: largest distance of a vertex from the searched one [m]
IMPACT_SLOPE, IMPACT_CURVATURE, DEVIATION = range(20, 23)
# Of the contacts of a stage: residual of their laws, squared norm of their impulses, largest residual of a gap, 1 if any has
# friction; iterations and status of the last linear solve for them
LAW, IMPULSE_SQUARE, WORST_GAP, HAS_FRICTION, LINEAR_COUNT, LINEAR_STATUS = range(23, 29)
N_SCALARS = 29

GO, EVENT = 0, 1  # indices into the state of a batch of sub-steps, see `Surface.run`
SUM, OTHER_SUM, N_COLUMNS = 5, 6, 8  # further columns; `measure` uses the columns of its scalars


@dataclass(frozen=True, eq=False)
class State:
    """Positions and velocities of all nodes, and scratch."""

    x: Any  # (n_nodes) 3-vectors f64: positions [m]
    v: Any  # (n_nodes) 3-vectors f64: velocities [m/s]; an f32 one would bend small bodies that are fast by its rounding
    element_force: Any  # forces of each tet on its nodes [N], per block (node, axis, lane)
    scalars: Any  # (N_SCALARS) f64: results for the host, indexed by ELASTIC and so on
    partial: Any  # (chunks, N_COLUMNS) f64: partial sums, added in a fixed order
