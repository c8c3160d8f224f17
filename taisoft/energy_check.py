"""Check whether a run creates energy: the sum E of kinetic and elastic energy and the potential of gravity and dead loads.

Without external energy input E must not rise; damping and friction only lower it. A rise is compared with the energy of the
motion: kinetic and elastic energy at the start, plus the most that gravity and loads have released since. The start is reset
whenever energy enters otherwise: prescribed nodes, moving obstacles, a drag spring, a change from outside, a resolved initial
overlap. Bodies that touch at the start may also separate to the contact offset.

Explicit steps conserve another energy, H, for a linear motion of frequencies w <= 2 q / dt, q = dt / stable_dt:
    velocity Verlet:   H = E - |f dt/2|^2 / 2m,   between E - q^2 U and E;
    symplectic Euler:  H = E + v.f dt/2,          |E - H| <= 2 q sqrt(K U),
with kinetic energy K and elastic energy U. A rise of E within these bounds is not counted.

Weak: energy that is lost and created again goes unnoticed. Energy created by one body may be hidden by that of others.
"""

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from taisoft.records import Energies, RunReport, StepReport
from taisoft.scene.scene import Body, Scene

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

MAX_RISE = 0.1  # fraction of the energy of the motion: a larger rise is reported
REST_STRAIN, REST_LIFT = 1e-4, 1e-2  # negligible energy: this strain, and a lift by this fraction of the size
OPENING_OFFSETS = 2.0  # [contact offsets] by which contacts squeeze and lift bodies that touch at the start: from two sides


class EnergyCheck:
    """Energy check of a run. Call `before_step` and `after_step` around steps, and `add_problem` at the end."""

    def __init__(self, sim: "Simulator"):
        self._sim, self._worst = sim, (0.0, 0.0, 0.0, 0.0)  # rise / energy of the motion, rise [J], start and end [s]
        self._restart()

    def before_step(self) -> None:
        """Reset the start if the state was changed from outside since the last step."""
        if self._sim._host().changes != self._changes:
            self._restart()

    def after_step(self, report: StepReport) -> None:
        """Check the energies at the end of a step or batch."""
        driven, self._driven = self._driven, self._sim._host().is_driven
        overlap_resolved = self._sim.scene.allow_initial_overlap and report.max_penetration > 0.0
        if driven or self._driven or overlap_resolved or self._sim.settings.static:
            self._start(report)
            return
        if self._first and report.n_contacts:
            self._motion_energy += (
                opening_energy(self._sim.scene, OPENING_OFFSETS * self._sim._host().contact.contact_offset) / MAX_RISE
            )
        self._first = False
        released = self._start_potential - (report.gravity + report.loads)  # released by gravity and loads [J]
        self._motion_energy = max(self._motion_energy, self._start_internal + released)
        rise = report.kinetic + report.elastic - self._bounds(report)[0] - self._upper_bound - released
        if rise > self._worst[0] * self._motion_energy:
            self._worst = rise / self._motion_energy, rise, self._time, report.time

    def add_problem(self, report: RunReport) -> None:
        """Add a problem to the report if energy was created; its status is then no longer ok."""
        if self._worst[0] > MAX_RISE:
            report.degrade(_message(*self._worst))

    def _restart(self) -> None:
        """Restart the check from the present state and parameters."""
        sim = self._sim
        self._changes, self._negligible = sim._host().changes, negligible_energy(sim.scene)
        self._q = min(1.0, float(sim.dt / sim.stable_dt)) if sim.settings.explicit else 0.0
        self._start(sim.energies())

    def _start(self, now: Energies | StepReport) -> None:
        """Use this state as the start of the comparison."""
        self._driven, self._time = self._sim._host().is_driven, self._sim.time
        self._first = True  # the next step is the first since the start
        self._start_internal, self._start_potential = now.kinetic + now.elastic, now.gravity + now.loads
        self._upper_bound = self._start_internal + self._bounds(now)[1]
        self._motion_energy = max(self._start_internal, 0.0) + self._negligible  # of active fibres it may be negative

    def _bounds(self, now: Energies | StepReport) -> tuple[float, float]:
        """Largest amounts by which H can lie below and above E [J]."""
        if self._sim.settings.integrator == "velocity_verlet":
            return self._q**2 * now.elastic, 0.0
        bound = 2.0 * self._q * sqrt(max(0.0, now.kinetic * now.elastic))  # rounding may give -0
        return bound, bound


def _message(ratio: float, rise: float, start: float, end: float) -> str:
    relative = f"{ratio:.3g} times" if ratio >= 2.0 else f"{100.0 * ratio:.3g} % of"
    return (
        f"energy was created: it rose by {rise:.3g} J from t = {start:.4g} s to {end:.4g} s, {relative} the energy of the "
        "motion: halve dt, or add damping"
    )


def negligible_energy(scene: Scene) -> float:
    """Energy that bodies at rest may have through rounding [J]."""
    return sum(
        _energy(scene, body, REST_STRAIN, REST_LIFT * float(np.ptp(body.rest_positions, axis=0).max())) for body in scene.bodies
    )


def opening_energy(scene: Scene, distance: float) -> float:
    """Upper bound of the energy that bodies gain when contacts squeeze and lift them by a distance [m], [J]."""
    return sum(
        _energy(scene, body, distance / float(np.ptp(body.rest_positions, axis=0).min()), distance) for body in scene.bodies
    )


def _energy(scene: Scene, body: Body, strain: float, lift: float) -> float:
    stretched = 0.5 * float(np.sum(body.composition.number("young") * body.volumes)) * strain**2
    return stretched + body.mass * float(np.linalg.norm(scene.gravity)) * lift
