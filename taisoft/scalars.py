"""Single numbers that kernels leave for the host: places in `State.scalars`, and columns of the sums in `State.partial`."""

(
    ELASTIC, MIN_J, N_INVERTED, KINETIC, GRAVITY,  # of a state: energies [J], smallest J = det F, inverted tets
    FIRST_SOFTENED,  # of a state: the first tet, by blocks and lanes, that is squeezed so far that its law softens
    LOADS,  # of a state: potential of its dead loads [J]
    STEPS_DONE, LOWEST_J, MOST_INVERTED, INVERTED_NOW,  # of a batch of sub-steps, and of the present one
    FAILED,  # of a batch of sub-steps: 1 where a velocity is not finite or a tet has exploded
    START_SLOPE, END_SLOPE,  # r.y where a Newton step begins and where it ends: negative is downhill
    STEP_LENGTH,  # that a linearised stage's step has taken
) = range(15)  # fmt: skip
N_SCALARS = 15

N_NORMS = 5  # first columns: what a residual is measured by
SUM, OTHER_SUM, N_COLUMNS = 5, 6, 8  # further columns; `measure` uses those of its scalars
