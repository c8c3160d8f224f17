"""Explicit sub-steps with contacts: a search, a contact problem and a solve in each."""

from dataclasses import replace

import numpy as np

from taisoft.contact.colouring import colour_contacts
from taisoft.contact.problem import find_factors
from taisoft.contact.solve import SolveResult, solve
from taisoft.dynamics import explicit
from taisoft.dynamics.contact import BLOCKED, FREE, MAX_PASSAGES, TOLERANCE, ContactStep
from taisoft.dynamics.explicit_contact import finish_verlet, move, predict, set_free_velocities
from taisoft.dynamics.explicit_stepper import ExplicitStepper
from taisoft.dynamics.results import StepResult
from taisoft.dynamics.rigid_contacts import RigidContacts
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SimulationError
from taisoft.fem.state import FAILED, LOWEST_J, MOST_INVERTED
from taisoft.settings import Settings

MAX_SWEEPS = 1000  # per contact solve; one that needs more is reported as not converged
MAX_CONTACT_BATCH = 200  # maximum sub-steps per batch, between checks for interruption


class ContactExplicitStepper(ExplicitStepper):
    """Take sub-steps of symplectic Euler or velocity Verlet with contacts."""

    _in_batches = False

    def __init__(self, simulation: SimulationState, settings: Settings, contact: ContactStep):
        super().__init__(simulation, settings)
        self.contact, self.method = contact, settings.contact_solver
        if self.method == "auto":
            self.method = "gauss_seidel" if simulation.model.on_cpu else "coloured_gauss_seidel"
        self.max_batch = min(self.max_batch, MAX_CONTACT_BATCH)
        self.contact_tolerance = settings.contact_tolerance or TOLERANCE[settings.precision]
        self._rigid = RigidContacts(simulation.model) if simulation.model.has_rigid_tets else None

    def forget(self) -> None:
        """Discard the search and impulses, after the state was set."""
        super().forget()
        self.contact.forget()

    def snapshot(self) -> dict:
        """Return the state without contacts, and the contacts of the last sub-step."""
        return super().snapshot() | {"contact": self.contact.snapshot()}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        super().restore(kept)
        self.contact.restore(kept["contact"])

    def advance(self, n: int, dt: float) -> StepResult:
        """Take n sub-steps of dt, or fewer if prescribed nodes are released or the batch is full; at least one.

        If a sub-step fails, the state is the one before it.
        """
        simulation, model, results, depth, done = self.simulation, self.simulation.model, [], 0.0, 0
        explicit.begin_batch(model)
        n, start = min(n, self.max_batch), simulation.time
        self.good.copy_from(simulation.now)
        releases, targets = simulation.releases, None
        if self.work.n_prescribed:
            n = min(n, self.rows)
            targets = simulation.next_targets(start + dt * np.arange(1, n + 1))
            self.acceleration_stale = self.acceleration_stale or simulation.releases != releases
            n = len(targets)
        self.contact.start_step(start, dt)
        relative_penetration = 0.0
        try:
            while done < n:
                if targets is not None:
                    self._upload_targets(targets[done : done + 1])
                results.append(self._substep(simulation.step_count + done + 1, start + done * dt, dt))
                depth = max(depth, self.contact.end(start + (done + 1) * dt, dt))
                relative_penetration = max(relative_penetration, self.contact.relative_penetration)
                if done + 1 == n:  # once per batch: it costs about as much as a search
                    crossing = self.contact.measure_crossings()
                    depth, relative_penetration = max(depth, crossing[0]), max(relative_penetration, crossing[1])
                done += 1
                self.contact.end_substep(self.good.x)
                if done < n:
                    self.good.copy_from(simulation.now)
        except BaseException:  # Ctrl-C, too
            self._return_to_good()
            self.contact.discard()
            simulation.step_count += done
            simulation.time = start + done * dt
            raise
        self.contact.penetration, self.contact.relative_penetration = depth, relative_penetration
        result = StepResult(
            steps=n,
            min_volume_ratio=model.state.scalars[LOWEST_J],
            n_inverted=int(model.state.scalars[MOST_INVERTED]),
            contact_iterations=sum(r.iterations for r in results if r),
            contact_residual=max((r.residual for r in results if r), default=0.0),
            converged=all(r.converged for r in results if r) and not self.contact.paths.held_back,
        )
        if self.contact.paths.held_back:
            result.problems.append(self.contact.paths.held_back)
        elif not result.converged:
            result.problems.append(f"the contact solver stopped at a residual of {result.contact_residual:.2e}")
        return result

    def _substep(self, step: int, time: float, dt: float) -> SolveResult | None:
        """Take sub-step number `step` from a time, and repeat it while surfaces pass through each other on its paths.

        Return the contact solver's result, None without contacts.
        """
        simulation, contact, good = self.simulation, self.contact, self.good
        is_far = contact.is_far(time, dt)
        if not is_far:
            contact.search(time, dt)
        if not contact.paths.none_cross and contact.measures.closing_ratio > 1.0:
            raise SimulationError(f"step {step}: {contact.measures.describe_fast_closing(dt)}")
        contact.start_substep(dt)
        for tries in range(MAX_PASSAGES + 1):
            result = self._solve_and_move(step, time, dt, is_far)
            if is_far and contact.far.stays():
                break
            is_far = False
            way = contact.certify(time, dt, good)
            if way == FREE:
                break
            self.acceleration_stale = True
            if way == BLOCKED or tries == MAX_PASSAGES:
                held = contact.paths.hold_back(good.x)
                self._move_branches(dt)
                return replace(result, converged=result.converged and not held) if result else None
            simulation.now.copy_nodes_from(good)
            simulation.now.copy_history_from(good)
            simulation.begin_branches(0.0)
            contact.search_along(time, dt)
        return result

    def _move_branches(self, dt: float) -> None:
        """Move Maxwell branches from the start of the sub-step, dt before, to the present positions."""
        self.simulation.now.copy_history_from(self.good)
        self.simulation.move_branches(dt)

    def _solve_and_move(self, step: int, time: float, dt: float, is_far: bool) -> SolveResult | None:
        """Solve for the impulses of the contacts found, and move; return the contact solver's result, None without contacts.

        is_far: whether nothing can touch.
        """
        model, work, contact = self.simulation.model, self.work, self.contact
        self.simulation.set_load_time(time)
        if work.verlet and self.acceleration_stale:
            explicit.run_elements(model)
            explicit.find_acceleration(model, work)
        self.acceleration_stale = False
        n = 0 if is_far else contact.begin(time, dt)
        predict(model, work, dt)
        result = None
        if n:
            problem = contact.problem
            set_free_velocities(model, work, problem, dt, *contact.gap_targets)
            find_factors(problem)
            if self._rigid is not None:
                result = self._rigid.solve(problem, self.method, self.contact_tolerance, MAX_SWEEPS)
            else:
                if self.method == "coloured_gauss_seidel":
                    colour_contacts(problem)
                result = solve(problem, self.method, self.contact_tolerance, MAX_SWEEPS)
        move(model, work, contact.problem, dt, int(n > 0))
        self.simulation.move_branches(dt)
        if work.verlet:
            self.simulation.set_load_time(time + dt)
            explicit.run_elements(model)
            finish_verlet(model, work, contact.problem, dt, int(n > 0))
        if model.state.scalars[FAILED] != 0.0:
            raise SimulationError(f"step {step}: {self._describe_fault()}")
        return result

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of the contact problem of rigid bodies."""
        return super().field_bytes | (self._rigid.field_bytes if self._rigid else {})

    def release(self) -> None:
        """Free its memory."""
        super().release()
        if self._rigid:
            self._rigid.release()
