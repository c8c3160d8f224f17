"""Further numbers of a step report on request, by their headings in steps.csv: of the pairs that press on each other, and of
each body."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from taisoft.errors import SceneError
from taisoft.records import StepReport
from taisoft.scene import checks

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

DETAILS = ("pairs", "bodies")
OF_PAIRS = {  # heading of an axis, the first and the second of a pair -> query
    "force {} on {} by {} [N]": "contact_force",
    "torque {} on {} by {} [N m]": "contact_torque",
    "slip velocity {} of {} on {} [m/s]": "slip_velocity",
}
OF_BODIES = ("kinetic", "elastic")  # [J]


def details_of(sim: "Simulator", wanted: tuple[str, ...]) -> dict[str, float]:
    """Return numbers of sim's last step and present state, by heading. wanted: some of DETAILS."""
    found = {}
    for a, b in sim.pairs_in_contact() if "pairs" in wanted else ():
        for heading, query in OF_PAIRS.items():
            values = getattr(sim, query)(a, b).tolist()
            found |= {heading.format(axis, a, b): value for axis, value in zip("xyz", values)}
    for body, energies in zip(sim.scene.bodies, sim._open().body_energies()) if "bodies" in wanted else ():
        found |= {f"{name} of {body.name} [J]": getattr(energies, name) for name in OF_BODIES}
    return found


def detailed(sim: "Simulator", wanted: tuple[str, ...], on_step: Callable | None) -> Callable[[StepReport, float], None]:
    """Return an `on_step` of `run` that fills the details of each report, then calls the given one. Raises SceneError."""
    wanted = (wanted,) if isinstance(wanted, str) else tuple(wanted)
    for name in wanted:
        checks.choice(name, "details", DETAILS)
    if "pairs" in wanted and not sim.touches:
        raise SceneError("details: pairs need contact forces, which are not simulated here")

    def fill(report: StepReport, seconds: float) -> None:
        report.details = details_of(sim, wanted)
        if on_step is not None:
            on_step(report, seconds)

    return fill
