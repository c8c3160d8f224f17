"""BDF2 (second-order backward differences): x1 = 4/3 x0 - 1/3 x_(-1) + 2/3 dt v1, v1 likewise with M^-1 f(x1, v1).

Second order; stable for every dt; damps slow modes far less than implicit Euler (1 - (w dt)^4/4 a step) and fast ones
fully. Needs constant dt. The first step, and the first after a change of dt or state, is implicit Euler's: its single error
of dt^2 keeps the order, and it is stable from any state.
"""

from taisoft.dynamics import implicit_euler
from taisoft.dynamics.implicit import Scheme

SCHEME = Scheme(beta_over_dt=2.0 / 3.0, now=4.0 / 3.0, before=1.0 / 3.0, start=implicit_euler.SCHEME)
