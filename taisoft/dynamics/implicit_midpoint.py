"""Implicit midpoint rule: a stage of dt/2 by implicit Euler, then x1 = 2 xm - x0, v1 = 2 vm - v0.

Second order, symplectic, no numerical damping; stiff modes ring rather than die out.
"""

from taisoft.dynamics.implicit import Scheme

SCHEME = Scheme(beta_over_dt=0.5, midpoint=True)
