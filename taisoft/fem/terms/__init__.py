"""Force terms, one per file.

A term is a module with
    SWITCH            the plan's switch that turns it on; None: always on
    LOAD              whether it is an applied load, which static residuals are relative to
    ACCELERATION      whether explicit steps use `acceleration(m, i)` [m/s^2] instead of `force`
    force(m, i)       on node i at the present x [N]; for elasticity, after its elements have been summed
    energy(m, i)      node i's part of its potential [J], in f64; elasticity and springs have energies of elements instead
    STIFFNESS         whether it depends on x and has add_stiffness(m, A, i, beta, projected), which adds node i's row of its
                      beta^2 K to the matrix A of implicit steps, and beta times its damping; elasticity's blocks are assembled
                      by `linear.block_csr` itself
    PREPARED          whether forces need prepare(m, k) for k < count(m), after every change of x or v and before `force`
and is listed in TERMS, which explicit steps, Newton's method, statics and reports iterate over. Dampers have no potential, and
integrators treat them differently: `rayleigh_damping` holds their rates and forces, and `rigid_damping` is a term of implicit
steps. The drag spring of the window is constant over a step and is therefore applied as a dead load (`dynamics.drag_spring`).
"""

from taisoft.fem.terms import dead_loads, elasticity, gravity, pressure, rigid_damping, springs

TERMS = (elasticity, springs, rigid_damping, gravity, dead_loads, pressure)


def terms_of(on: dict[str, bool]) -> tuple:
    """The active terms of a scene. on: the plan's switches."""
    return tuple(term for term in TERMS if term.SWITCH is None or on[term.SWITCH])
