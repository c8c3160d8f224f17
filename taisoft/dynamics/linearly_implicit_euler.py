"""Linearly implicit Euler: implicit Euler with f linearised at x0, one linear solve a step.

Source: Baraff, Witkin, "Large Steps in Cloth Simulation", SIGGRAPH 1998, eq. 6. First order. Cheap, but inaccurate in
large steps of strongly bent bodies; angular momentum is not conserved.
"""

from taisoft.dynamics.implicit import Scheme

SCHEME = Scheme(beta_over_dt=1.0, one_iteration=True)
