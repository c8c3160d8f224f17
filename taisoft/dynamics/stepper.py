"""The stepper of an integrator. Modules are imported only when needed, since decorating kernels takes time.

A stepper has `advance(n, dt) -> StepResult`; `forget`, `numbers_changed` and `loads_changed` to follow changes between steps;
`held_steps(dt)`, the steps over which a drag force is held; `reactions`; `snapshot` and `restore`; `field_bytes` and `release`.
"""

from typing import TYPE_CHECKING

from taisoft.dynamics.schemes import IMPLICIT
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.settings import Settings

if TYPE_CHECKING:
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.explicit_stepper import ExplicitStepper
    from taisoft.dynamics.implicit import ImplicitStepper
    from taisoft.dynamics.no_contacts import NoContacts


def make_stepper(
    simulation: SimulationState, settings: Settings, contact: "ContactStep | NoContacts"
) -> "ExplicitStepper | ImplicitStepper":
    """Return the stepper of checked settings."""
    if settings.integrator in IMPLICIT:
        from taisoft.dynamics.implicit import ImplicitStepper

        return ImplicitStepper(simulation, settings, contact)
    if contact.idle:
        from taisoft.dynamics.explicit_stepper import ExplicitStepper

        return ExplicitStepper(simulation, settings)
    from taisoft.dynamics.explicit_contact import ContactExplicitStepper

    return ContactExplicitStepper(simulation, settings, contact)
