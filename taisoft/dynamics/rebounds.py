"""Contacts that rebound in a step, see `contact.restitution`; `impact` and the explicit steps then solve for the jump."""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download
from taisoft.contact.problem import ContactProblem
from taisoft.contact.restitution import find_rebounds
from taisoft.dynamics.simulation_state import SimulationState


class Rebounds:
    """Finds contacts that rebound. `StepState.flight`: sum of dt^2 over the steps since each collider's last contact.

    Free flight in dissipative steps loses energy, which a rebound may give back, see `contact.restitution`.
    """

    def __init__(self, simulation: SimulationState, arena: FieldArena):
        self._simulation = simulation
        self._flight = arena.field("flight", ti.f64, len(simulation.scene.colliders))  # for kernels
        self.numbers_changed()

    def numbers_changed(self) -> None:
        """Update for changed coefficients of restitution."""
        self._any = self._simulation.scene.bounces

    def detect(self, problem: ContactProblem, dt: float, contact_offset: float) -> bool:
        """Return whether surfaces rebound in the step of dt [s] that has begun."""
        now, gravity = self._simulation.now, self._simulation.scene.gravity
        if not self._any:
            return False
        if (now.gravity != gravity).any():  # energy lost under another gravity is unknown
            now.gravity[:], now.flight[:] = gravity, 0.0
        self._flight.from_numpy(now.flight)
        return find_rebounds(problem, self._simulation.model.gravity, self._flight, dt, contact_offset) > 0

    def count_flight(self, problem: ContactProblem, n: int, dt: float, dissipative: bool) -> None:
        """Update `flight` after a substep of dt with n contacts. dissipative: whether free flight loses energy, as with
        implicit Euler."""
        if not self._any:
            return
        simulation, flight = self._simulation, self._simulation.now.flight
        flight += np.where(flight > 0.0, dt**2 if dissipative else 0.0, dt**2)
        r, struck, collider = download([problem.r, problem.impact_impulse, problem.body], n)
        flight[collider[(r != 0.0).any(axis=1)]] = 0.0
        flight[collider[(struck != 0.0).any(axis=1)]] = dt**2
        starts = simulation.layout.node_start[:-1]
        constrained = np.logical_or.reduceat(simulation.dirichlet.constrained().any(axis=1), starts)
        flight[: len(starts)][constrained] = flight[len(starts) :] = 0.0
