"""The integrators by name. Adding an implicit one: a file with a `Scheme`, and its line below."""

from taisoft.stepping import bdf2, implicit_euler, implicit_midpoint, linearly_implicit_euler
from taisoft.stepping.contact import ContactStep
from taisoft.stepping.contact_substeps import ContactExplicitStepper
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


def make_stepper(
    world: World, integrator: str, contact: ContactStep | None, method: str
) -> ExplicitStepper | ImplicitStepper:
    """The stepper of an integrator; the names have been checked. contact: None where nothing can touch.

    method: contact solver of explicit steps; "auto" is serial Gauss-Seidel on the CPU, and the coloured one on CUDA.
    """
    if integrator in EXPLICIT:
        verlet = integrator == "velocity_verlet"
        if contact is None:
            return ExplicitStepper(world, verlet)
        if method == "auto":
            method = "gauss_seidel" if world.runtime.arch == "cpu" else "coloured_gauss_seidel"
        return ContactExplicitStepper(world, verlet, contact, method)
    return ImplicitStepper(world, SCHEMES[integrator], contact)
