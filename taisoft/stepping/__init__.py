"""The integrators by name. Adding an implicit one: a file with a `Scheme`, and its line below."""

from taisoft.stepping import bdf2, implicit_euler, implicit_midpoint, linearly_implicit_euler
from taisoft.stepping.contact import ContactStep
from taisoft.stepping.implicit import ImplicitStepper
from taisoft.stepping.substeps import ExplicitStepper
from taisoft.stepping.world import World

EXPLICIT = ("symplectic_euler", "velocity_verlet")
SCHEMES = {
    "linearly_implicit_euler": linearly_implicit_euler.SCHEME,
    "implicit_euler": implicit_euler.SCHEME,
    "bdf2": bdf2.SCHEME,
    "implicit_midpoint": implicit_midpoint.SCHEME,
}
INTEGRATORS = (*EXPLICIT, *SCHEMES)


def make_stepper(world: World, integrator: str, contact: ContactStep | None) -> ExplicitStepper | ImplicitStepper:
    """The stepper of an integrator; the name has been checked. contact: None where nothing can touch."""
    if integrator in EXPLICIT:
        return ExplicitStepper(world, verlet=integrator == "velocity_verlet")
    return ImplicitStepper(world, SCHEMES[integrator], contact)
