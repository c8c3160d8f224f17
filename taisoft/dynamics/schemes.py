"""Integrators by name. To add an implicit one, add its `Scheme` to SCHEMES.

A step of an implicit integrator is one stage x = x_hat + beta v, c M (v - v_hat) = beta f(x, v), solved by Newton's method.
"""

from dataclasses import dataclass

EXPLICIT = ("symplectic_euler", "velocity_verlet")


@dataclass(frozen=True)
class Scheme:
    """x_hat = now x_n - before x_(n-1), v_hat likewise, beta = beta_over_dt dt; midpoint: the stage is the step's midpoint."""

    beta_over_dt: float
    now: float = 1.0
    before: float = 0.0
    midpoint: bool = False
    one_iteration: bool = False  # linearised at x_n, one Newton step, no line search
    c: float = 1.0  # 0: without inertia
    start: "Scheme | None" = None  # scheme of the first step, without history


# x1 = x0 + dt v1, M (v1 - v0) = dt f(x1, v1). First order; stable for every dt; damps a mode of angular frequency w by
# 1/sqrt(1 + (w dt)^2) a step.
IMPLICIT_EULER = Scheme(beta_over_dt=1.0)

SCHEMES = {
    # Implicit Euler with f linearised at x0, one linear solve a step. First order. Cheap, but inaccurate in large steps of
    # strongly bent bodies; angular momentum is not conserved.
    # Source: Baraff, Witkin, "Large Steps in Cloth Simulation", SIGGRAPH 1998, eq. 6.
    "linearly_implicit_euler": Scheme(beta_over_dt=1.0, one_iteration=True),
    "implicit_euler": IMPLICIT_EULER,
    # Second-order backward differences: x1 = 4/3 x0 - 1/3 x_(-1) + 2/3 dt v1, v1 likewise with M^-1 f(x1, v1). Stable for every
    # dt; damps slow modes far less than implicit Euler (1 - (w dt)^4/4 a step) and fast ones fully. Needs constant dt. The first
    # step, and the first after a change of dt or state, is implicit Euler's: its single error of dt^2 keeps the order, and it is
    # stable from any state.
    "bdf2": Scheme(beta_over_dt=2.0 / 3.0, now=4.0 / 3.0, before=1.0 / 3.0, start=IMPLICIT_EULER),
    # A stage of dt/2 by implicit Euler, then x1 = 2 xm - x0, v1 = 2 vm - v0. Second order, symplectic, no numerical damping;
    # stiff modes ring rather than die out.
    "implicit_midpoint": Scheme(beta_over_dt=0.5, midpoint=True),
}
IMPLICIT = tuple(SCHEMES)
# Equilibrium at the loads of the step's end: statics in load steps of dt. With friction each is a step of implicit Euler.
STATIC = "static"
SCHEMES[STATIC] = Scheme(beta_over_dt=1.0, c=0.0)
INTEGRATORS = (*EXPLICIT, *IMPLICIT)
CHOICES = (*INTEGRATORS, STATIC)
SECOND_ORDER = ("velocity_verlet", "bdf2", "implicit_midpoint")  # in time, of smooth motion; others are of first order


def takes_contacts(integrator: str) -> bool:
    """Whether an integrator supports contacts: a stage in the middle of the step does not, since its end must hold them."""
    return integrator in EXPLICIT or not SCHEMES[integrator].midpoint


def is_multistep(integrator: str) -> bool:
    """Whether an integrator uses the state before the last one."""
    return integrator in SCHEMES and SCHEMES[integrator].before > 0.0
