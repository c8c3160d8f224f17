"""Integrators by name. To add an implicit one, add a file with a `SCHEME` and its name below.

Modules are imported only when needed, since decorating kernels takes time.
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
    """Return the scheme of an implicit integrator."""
    return import_module(f"taisoft.dynamics.{integrator}").SCHEME


def make_stepper(
    simulation: SimulationState, integrator: str, contact: "ContactStep | NoContacts", method: str
) -> "ExplicitStepper | ImplicitStepper":
    """Return the stepper of an integrator, whose name has been checked.

    method: contact solver of explicit steps; "auto" is serial Gauss-Seidel on the CPU and coloured Gauss-Seidel on CUDA.
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
