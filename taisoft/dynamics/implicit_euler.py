"""Implicit Euler: x1 = x0 + dt v1, M (v1 - v0) = dt f(x1, v1), solved by Newton's method.

First order; stable for every dt; damps a mode of frequency w by 1/sqrt(1 + (w dt)^2) a step.
"""

from taisoft.dynamics.implicit import Scheme

SCHEME = Scheme(beta_over_dt=1.0)
