"""Whether a run creates energy: kinetic and elastic energy and the potential of gravity and dead loads together. Damping and
friction only take from it.

From a state on that nothing feeds, their sum E may not rise. A rise is judged by the energy that the motion can hold: kinetic and
elastic energy at the start, and the most that gravity and loads have given off since. The start is set anew where
something else feeds energy in: nodes on paths, obstacles that move, a pull, a change from outside, an overlap that is mended.
Bodies that touch at the start may open to the contact offset, too.

Explicit steps keep another energy, H, that of a linear motion of frequencies w <= 2 q / dt, q = dt / stable_dt:
    velocity Verlet:   H = E - |f dt/2|^2 / 2m,   between E - q^2 U and E;
    symplectic Euler:  H = E + v.f dt/2,          |E - H| <= 2 q sqrt(K U),
K kinetic and U elastic energy. A rise of E within these bounds creates nothing and is not counted.

Weak: E after the start may have been lost and created again unseen. What one body creates hides behind what others hold.
"""

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from taisoft.records import Energies, RunReport, StepReport
from taisoft.scene.scene import Body, Scene

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

CREATED = 0.1  # of the energy that the motion can hold: a larger rise is reported
STRAIN, LIFT = 1e-4, 1e-2  # bodies at rest hold the energy of this strain, and of a lift by this share of their size: rounding
OPENED = 2.0  # times the contact offset by which contacts squeeze and lift bodies that touch at the start: from two sides


class EnergyCheck:
    """Follows the energy of a run. Call `before_step` and `after_step`, and `judge` at the end."""

    def __init__(self, sim: "Simulator"):
        self._sim, self._worst = sim, (0.0, 0.0, 0.0, 0.0)  # rise over the motion's energy, rise [J], its begin and end [s]
        self._begin()

    def before_step(self) -> None:
        """The state that a step begins with may have been changed since the last one."""
        if self._sim._changes != self._changes:
            self._begin()

    def after_step(self, report: StepReport) -> None:
        """Compare the energies that a step, or a batch, ended with."""
        driven, self._driven = self._driven, self._sim._driven
        mended = self._sim.scene.allow_initial_overlap and report.max_penetration > 0.0
        if driven or self._driven or mended:
            self._start(report)
            return
        if self._first and report.n_contacts:
            self._most += opening_energy(self._sim.scene, OPENED * self._sim._contact.contact_offset) / CREATED
        self._first = False
        given = self._potential - (report.gravity + report.loads)  # by gravity and loads [J]
        self._most = max(self._most, self._held + given)
        rise = report.kinetic + report.elastic - self._bounds(report)[0] - self._highest - given
        if rise > self._worst[0] * self._most:
            self._worst = rise / self._most, rise, self._time, report.time

    def judge(self, report: RunReport) -> None:
        """Report energy that was created; the run is then not ok."""
        if self._worst[0] > CREATED:
            report.problems.append(_sentence(*self._worst))
            if report.status == "ok":
                report.status = "degraded"

    def _begin(self) -> None:
        """Compare with the present state, whatever it and the numbers were before."""
        sim = self._sim
        self._changes, self._negligible = sim._changes, negligible_energy(sim.scene)
        self._q = min(1.0, float(sim.dt / sim.stable_dt)) if sim.settings.explicit else 0.0
        self._start(sim.energies())

    def _start(self, now: Energies | StepReport) -> None:
        """Compare with this state from now on."""
        self._driven, self._time = self._sim._driven, self._sim.time
        self._first = True  # the next step is the first from here
        self._held, self._potential = now.kinetic + now.elastic, now.gravity + now.loads
        self._highest = self._held + self._bounds(now)[1]
        self._most = self._held + self._negligible

    def _bounds(self, now: Energies | StepReport) -> tuple[float, float]:
        """How far H is below E and above it at most [J]."""
        if self._sim.settings.integrator == "velocity_verlet":
            return self._q**2 * now.elastic, 0.0
        bound = 2.0 * self._q * sqrt(max(0.0, now.kinetic * now.elastic))  # rounding may leave -0
        return bound, bound


def _sentence(share: float, rise: float, start: float, end: float) -> str:
    size = f"{share:.3g} times" if share >= 2.0 else f"{100.0 * share:.3g} % of"
    return (
        f"energy was created: it rose by {rise:.3g} J from t = {start:.4g} s to {end:.4g} s, {size} the energy of the motion: "
        "halve dt, or add damping"
    )


def negligible_energy(scene: Scene) -> float:
    """What bodies at rest may hold by rounding [J]."""
    return sum(_energy(scene, body, STRAIN, LIFT * float(np.ptp(body.rest_positions, axis=0).max())) for body in scene.bodies)


def opening_energy(scene: Scene, way: float) -> float:
    """What bodies gain where contacts squeeze and lift them by a way [m] at most [J]."""
    return sum(_energy(scene, body, way / float(np.ptp(body.rest_positions, axis=0).min()), way) for body in scene.bodies)


def _energy(scene: Scene, body: Body, strain: float, lift: float) -> float:
    weight = body.material.density * float(np.linalg.norm(scene.gravity))
    return float(body.mesh.volumes.sum()) * (0.5 * body.material.young * strain**2 + weight * lift)
