"""Linearly implicit Euler: implicit Euler with f linearised at x0, one linear solve a step.

Source: Baraff, Witkin, "Large Steps in Cloth Simulation", SIGGRAPH 1998, eq. 6. First order. Cheap, but large steps of
strongly bent bodies lose accuracy, and angular momentum is not kept.
"""

from taisoft.dynamics.implicit import Scheme

SCHEME = Scheme(share=1.0, one_iteration=True)
