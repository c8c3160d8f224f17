"""Further numbers of a step report on request, by their headings in steps.csv: of the pairs that press on each other, and of
each body."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from taisoft.errors import SceneError
from taisoft.estimation.quantities import Definition, columns
from taisoft.records import StepReport
from taisoft.scene import checks

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

DETAILS, QUANTITIES = ("pairs", "bodies"), "quantities"  # the latter only of runs
OF_PAIRS = {  # heading of an axis, the first and the second of a pair -> query
    "force {} on {} by {} [N]": "contact_force",
    "torque {} on {} by {} [N m]": "contact_torque",
    "slip velocity {} of {} on {} [m/s]": "slip_velocity",
}
OF_BODIES = ("kinetic", "elastic")  # [J]


def details(self: "Simulator", wanted: str | tuple[str, ...] = DETAILS, about=None) -> dict[str, float]:
    """Return numbers of the last step and the present state, by their headings in steps.csv, as `run` adds them to its reports.

    wanted: "pairs", "bodies" or both; about: a point (3,) [m] of torques, else the first body's centre of mass, or an obstacle's
    pivot. Raises SceneError.
    """
    wanted, found = (wanted,) if isinstance(wanted, str) else tuple(wanted), {}
    for name in wanted:
        checks.choice(name, "details", DETAILS)
    if "pairs" in wanted and not self.touches:
        raise SceneError("details: pairs need contact forces, which are not simulated here")
    at = {} if about is None else {"about": checks.array(about, "details: about", ((3,),)).tolist()}
    for a, b in self.pairs_in_contact() if "pairs" in wanted else ():
        for heading, query in OF_PAIRS.items():
            given = at if query == "contact_torque" else {}
            point = " about ({:g}, {:g}, {:g}) [".format(*given["about"]) if given else " ["
            values = getattr(self, query)(a, b, **given).tolist()
            found |= {heading.replace(" [", point).format(axis, a, b): value for axis, value in zip("xyz", values)}
    for body, energies in zip(self.scene.bodies, self._open().body_energies()) if "bodies" in wanted else ():
        found |= {f"{name} of {body.name} [J]": getattr(energies, name) for name in OF_BODIES}
    return found


def detailed(
    sim: "Simulator", wanted: str | tuple[str, ...], about, measured: dict[str, Definition], on_step: Callable | None
) -> Callable[[StepReport, float], None]:
    """Return an `on_step` of `run` that fills the details of each report, then calls the given one. measured: the quantities of
    the run. Raises SceneError."""
    wanted = (wanted,) if isinstance(wanted, str) else tuple(wanted)
    own = tuple(name for name in wanted if name != QUANTITIES)
    if own != wanted and not measured:
        raise SceneError("details: the run has no quantities")
    sim.details(own, about)  # refuses invalid arguments before the run

    def fill(report: StepReport, seconds: float) -> None:
        report.details = sim.details(own, about) | (columns(sim, measured) if own != wanted else {})
        if on_step is not None:
            on_step(report, seconds)

    return fill
