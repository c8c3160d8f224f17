"""Scalars that kernels return to the host: indices into `State.scalars`, and columns of the sums in `State.partial`."""

(
    ELASTIC,
    MIN_J,
    N_INVERTED,
    KINETIC,
    GRAVITY,  # of a state: energies [J], smallest J = det F, inverted tets
    FIRST_SOFTENED,  # of a state: the first tet, by blocks and lanes, so compressed that its law softens
    LOADS,  # of a state: potential of its dead loads [J]
    STEPS_DONE,
    LOWEST_J,
    MOST_INVERTED,
    INVERTED_NOW,  # of a batch of substeps; INVERTED_NOW of the present one
    FAILED,  # of a batch of substeps: 1 if a velocity is not finite or a tet has exploded
    START_SLOPE,
    END_SLOPE,  # r.y at the start and end of a Newton step: negative is downhill
    STEP_LENGTH,  # of the step taken by a linearised stage
) = range(15)
N_SCALARS = 15

N_NORMS = 5  # first columns: norms of a residual
SUM, OTHER_SUM, N_COLUMNS = 5, 6, 8  # further columns; `measure` uses the columns of its scalars
