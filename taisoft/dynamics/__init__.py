"""The integrators by name. Adding an implicit one: a file with a `SCHEME`, and its name below.

What a simulator does not need is not imported: kernels take time to decorate.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.substeps import ExplicitStepper

if TYPE_CHECKING:
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.implicit import ImplicitStepper, Scheme
    from taisoft.dynamics.no_contacts import NoContacts

EXPLICIT = ("symplectic_euler", "velocity_verlet")
IMPLICIT = ("linearly_implicit_euler", "implicit_euler", "bdf2", "implicit_midpoint")
INTEGRATORS = (*EXPLICIT, *IMPLICIT)


def scheme_of(integrator: str) -> "Scheme":
    """The scheme of an implicit integrator."""
    return import_module(f"taisoft.dynamics.{integrator}").SCHEME


def make_stepper(
    simulation: SimulationState, integrator: str, contact: "ContactStep | NoContacts", method: str
) -> "ExplicitStepper | ImplicitStepper":
    """The stepper of an integrator; the names have been checked.

    method: contact solver of explicit steps; "auto" is serial Gauss-Seidel on the CPU, and the coloured one on CUDA.
    """
    if integrator in IMPLICIT:
        from taisoft.dynamics.implicit import ImplicitStepper

        return ImplicitStepper(simulation, scheme_of(integrator), contact)
    verlet = integrator == "velocity_verlet"
    if contact.idle:
        return ExplicitStepper(simulation, verlet)
    if method == "auto":
        method = "gauss_seidel" if simulation.runtime.arch == "cpu" else "coloured_gauss_seidel"
    from taisoft.dynamics.contact_substeps import ContactExplicitStepper

    return ContactExplicitStepper(simulation, verlet, contact, method)
