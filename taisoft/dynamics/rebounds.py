"""Contacts that rebound in a step, see `contact.restitution`; `impact` and the explicit steps then solve for the jump."""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download
from taisoft.contact.problem import ContactProblem
from taisoft.contact.restitution import find_rebounds
from taisoft.dynamics.simulation_state import SimulationState


class Rebounds:
    """Finds contacts that rebound. flight (n_colliders,): sum of dt^2 over the steps since each collider's last contact [s^2].

    Free flight in dissipative steps loses energy, which a rebound may give back, see `contact.restitution`.
    """

    def __init__(self, simulation: SimulationState, arena: FieldArena):
        self._simulation = simulation
        self.flight = np.zeros(len(simulation.scene.colliders))
        self._flight = arena.field("flight", ti.f64, len(self.flight))  # for kernels
        self._gravity = simulation.scene.gravity.copy()  # during the flight
        self.numbers_changed()

    def numbers_changed(self) -> None:
        """Update for changed coefficients of restitution."""
        self._any = self._simulation.scene.bounces

    def detect(self, problem: ContactProblem, dt: float, contact_offset: float) -> bool:
        """Return whether surfaces rebound in the step of dt [s] that has begun."""
        scene = self._simulation.scene
        if not self._any:
            return False
        if (self._gravity != scene.gravity).any():  # energy lost under another gravity is unknown
            self._gravity = scene.gravity.copy()
            self.flight[:] = 0.0
        self._flight.from_numpy(self.flight)
        return find_rebounds(problem, self._simulation.model.gravity, self._flight, dt, contact_offset) > 0

    def count_flight(self, problem: ContactProblem, n: int, dt: float, dissipative: bool) -> None:
        """Update `flight` after a substep of dt with n contacts. dissipative: whether free flight loses energy, as with
        implicit Euler."""
        if not self._any:
            return
        scene, layout, dirichlet = self._simulation.scene, self._simulation.layout, self._simulation.dirichlet
        self.flight += np.where(self.flight > 0.0, dt**2 if dissipative else 0.0, dt**2)
        r, struck, body = download([problem.r, problem.impact_impulse, problem.body], n)
        self.flight[body[(r != 0.0).any(axis=1)]] = 0.0
        self.flight[body[(struck != 0.0).any(axis=1)]] = dt**2
        constrained = np.logical_or.reduceat(dirichlet.constrained().any(axis=1), layout.node_start[:-1])
        self.flight[: len(scene.bodies)][constrained] = 0.0
        self.flight[len(scene.bodies) :] = 0.0
