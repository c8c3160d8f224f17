"""Forces as terms, one a file.

A term is a module with
    SWITCH            the plan's switch that turns it on; None: every scene has it
    LOAD              whether it acts from outside, as what a residual in statics is measured by
    ACCELERATION      whether explicit steps take it as an acceleration, `acceleration(m, i)` [m/s^2], not as a force
    force(m, i)       on node i at the present x [N]; that of elasticity once its elements have been summed
    energy(m, i)      node i's part of its potential [J], in f64; that of elasticity is summed over elements: `element_energy`
and is listed in TERMS: explicit steps, Newton, statics and reports then ask it. Dampers have no potential, and integrators differ
in how they take them; their files hold their forces, their work, and what they add to a system's matrix. The drag spring of the
window is held over a step, so it is one of the dead loads then (`dynamics.pull`).
"""

from taisoft.fem.terms import dead_loads, elasticity, gravity

TERMS = (elasticity, gravity, dead_loads)


def terms_of(on: dict[str, bool]) -> tuple:
    """The terms of a scene. on: the plan's switches."""
    return tuple(term for term in TERMS if term.SWITCH is None or on[term.SWITCH])
