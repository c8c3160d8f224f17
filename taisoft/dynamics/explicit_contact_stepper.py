"""Explicit sub-steps with contacts: a search, a contact problem and a solve in each."""

from dataclasses import replace

import numpy as np

from taisoft.contact.build import end_contacts
from taisoft.contact.colouring import colour_contacts
from taisoft.contact.solve import SolveResult, solve, sweeps_per_launch, team_of
from taisoft.dynamics.contact import TOLERANCE, ContactStep
from taisoft.dynamics.explicit_batch import (
    ALL_SWEEPS,
    DEEPEST,
    DEEPEST_RELATIVE,
    DONE,
    FAULT,
    MOST,
    N_TALLY,
    NOT_FOUND,
    NOT_SOLVED,
    NOTHING,
    OUTDATED,
    UNSOLVED,
    WORST,
    Batch,
    begin_advance,
    run_on,
)
from taisoft.dynamics.explicit_contact import begin_solve, finish_verlet, move, predict
from taisoft.dynamics.explicit_stepper import ExplicitStepper
from taisoft.dynamics.part_check import BLOCKED, FREE, MAX_PASSAGES
from taisoft.dynamics.results import StepResult
from taisoft.dynamics.rigid_contacts import RigidContacts
from taisoft.dynamics.search_ahead import MOST as SEARCHED_ONCE
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
        self.batch = Batch(simulation, contact, self.work, self.method, self.contact_tolerance)

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
        simulation, model, tally, done = self.simulation, self.simulation.model, np.zeros(N_TALLY), 0
        begin_advance(model, self.contact.detection.surface)
        n, start, check = min(n, self.max_batch), simulation.time, self.contact.check
        self.good.copy_from(simulation.now)
        releases, targets = simulation.releases, None
        if self.work.n_prescribed:
            n = min(n, self.rows)
            targets = simulation.next_targets(start + dt * np.arange(1, n + 1))
            self.acceleration_stale = self.acceleration_stale or simulation.releases != releases
            n = len(targets)
        self.contact.start_step(start, dt)
        try:
            while done < n:
                if targets is not None:
                    self._upload_targets(targets[done : done + 1])
                event, is_far = NOTHING, self.batch.is_far(start + done * dt, dt)
                if not is_far and self.batch.suits():
                    event = self._take_batch(min(n - done, MOST), start + done * dt, dt, tally)
                    done = int(tally[DONE])
                    if event in (NOTHING, OUTDATED):
                        continue
                result = self._substep(simulation.step_count + done + 1, start + done * dt, dt, is_far, event)
                if result:
                    tally[ALL_SWEEPS] += result.iterations
                    tally[UNSOLVED] += not result.converged
                    tally[WORST] = max(tally[WORST], result.residual)
                check.end(start + (done + 1) * dt, dt)
                self._deepen(tally, check.penetration, check.relative_penetration)
                if done + 1 == n:  # once per batch: it costs about as much as a search
                    self._deepen(tally, *check.measure_crossings())
                done += 1
                tally[DONE] = done
                self.contact.end_substep(self.good.x)
                if done < n:
                    self.good.copy_from(simulation.now)
        except BaseException:  # Ctrl-C, too
            self._return_to_good()
            self.contact.discard()
            done = int(tally[DONE])
            simulation.step_count += done
            simulation.time = start + done * dt
            raise
        check.penetration, check.relative_penetration = map(float, tally[[DEEPEST, DEEPEST_RELATIVE]])
        lowest, most_inverted = model.state.scalars.to_numpy()[[LOWEST_J, MOST_INVERTED]].tolist()
        result = StepResult(
            steps=n,
            min_volume_ratio=lowest,
            n_inverted=int(most_inverted),
            contact_iterations=int(tally[ALL_SWEEPS]),
            contact_residual=float(tally[WORST]),
            converged=not tally[UNSOLVED] and not self.contact.paths.held_back,
        )
        if self.contact.paths.held_back:
            result.problems.append(self.contact.paths.held_back)
        elif not result.converged:
            result.problems.append(f"the contact solver stopped at a residual of {result.contact_residual:.2e}")
        return result

    def warm_up(self, time: float, dt: float) -> None:
        """Launch the kernels that only sub-steps of dt with contacts need, after one that has ended at a time; the state is then
        invalid."""
        contact, model, work = self.contact, self.simulation.model, self.work
        contact.begin(time, dt)
        problem, surface, limits = contact.problem, contact.detection.surface, (self.method, self.contact_tolerance)
        predict(model, work, problem, surface, dt, *contact.gap_targets)
        begin_solve(problem, team_of(problem, self.method, 0)[0], surface, *limits, sweeps_per_launch(0), MAX_SWEEPS, NOTHING)
        solve(problem, *limits, MAX_SWEEPS)
        move(model, work, problem, surface, dt, NOTHING)
        contact.detection.warm_up()
        contact.paths.keep_path(self.good.x)
        end_contacts(problem, model, self.good.x, self.simulation.now.slip, dt)
        if self.batch.suits():
            self._take_batch(SEARCHED_ONCE, time, dt, np.zeros(N_TALLY))
            run_on(surface)

    def _take_batch(self, n: int, time: float, dt: float, tally: np.ndarray) -> int:
        """Take a batch of up to n sub-steps from a time, and add it to the tally. Return the event that ended it early."""
        batch = self.batch
        batch.tally[:] = 0.0
        self._prepare(time)
        n = batch.search(n, time, dt)
        try:
            batch.run(n, time, dt, self.good, MAX_SWEEPS)
        finally:  # Ctrl-C, too
            if batch.event != NOTHING:
                run_on(self.contact.detection.surface)
            tally[[DONE, ALL_SWEEPS, UNSOLVED]] += batch.tally[[DONE, ALL_SWEEPS, UNSOLVED]]
            tally[WORST] = max(tally[WORST], batch.tally[WORST])
            self._deepen(tally, *batch.tally[[DEEPEST, DEEPEST_RELATIVE]])
        return batch.event

    def _deepen(self, tally: np.ndarray, depth: float, relative: float) -> None:
        """Add penetrations to the tally."""
        tally[DEEPEST], tally[DEEPEST_RELATIVE] = max(tally[DEEPEST], depth), max(tally[DEEPEST_RELATIVE], relative)

    def _prepare(self, time: float) -> None:
        """Set the loads of a time, and Verlet's acceleration if it is stale."""
        model, work = self.simulation.model, self.work
        self.simulation.set_load_time(time)
        if work.verlet and self.acceleration_stale:
            finish_verlet(model, work, self.contact.problem, self.contact.detection.surface, 0.0, NOTHING)
        self.acceleration_stale = False

    def _substep(self, step: int, time: float, dt: float, is_far: bool, event: int) -> SolveResult | None:
        """Take sub-step number `step` from a time, and repeat it while surfaces pass through each other on its paths.

        is_far: whether nothing can touch. event: where a batch has left it, or NOTHING.
        Return the contact solver's result, None without contacts.
        """
        simulation, contact, good = self.simulation, self.contact, self.good
        if not is_far and event == NOTHING:
            contact.search.find(time, dt)
        if not contact.paths.none_cross and contact.search.measures.closing_ratio > 1.0:
            raise SimulationError(f"step {step}: {contact.search.measures.describe_fast_closing(dt)}")
        contact.start_substep(dt)
        for tries in range(MAX_PASSAGES + 1):
            result = self._solve_and_move(step, time, dt, is_far, event)
            if event == NOT_FOUND or (is_far and contact.search.far.stays()):
                break
            is_far, event = False, NOTHING
            way = contact.check.certify(time, dt, good)
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
            contact.paths.search_along(time, dt)
        return result

    def _move_branches(self, dt: float) -> None:
        """Move Maxwell branches from the start of the sub-step, dt before, to the present positions."""
        self.simulation.now.copy_history_from(self.good)
        self.simulation.move_branches(dt)

    def _solve_and_move(self, step: int, time: float, dt: float, is_far: bool, event: int) -> SolveResult | None:
        """Solve for the impulses of the contacts found, and move, as far as a batch has not done so; the arguments are those of
        `_substep`. Return the contact solver's result, None without contacts."""
        model, work, contact = self.simulation.model, self.work, self.contact
        if event < NOT_SOLVED:
            self._prepare(time)
            if is_far:
                contact.take_over(dt, 0, 0)
            else:
                contact.begin(time, dt)
            predict(model, work, contact.problem, contact.detection.surface, dt, *contact.gap_targets)
        result = self._solve(contact.n_contacts, event) if contact.n_contacts else None
        if event < FAULT:
            surface = contact.detection.surface
            move(model, work, contact.problem, surface, dt, NOTHING)
            self.simulation.move_branches(dt)
            if work.verlet:
                self.simulation.set_load_time(time + dt)
                finish_verlet(model, work, contact.problem, surface, dt, NOTHING)
        if model.state.scalars[FAILED] != 0.0:
            raise SimulationError(f"step {step}: {self._describe_fault()}")
        return result

    def _solve(self, n: int, event: int) -> SolveResult:
        """Solve for the impulses of n contacts, as far as a batch has not done so."""
        problem, method, tolerance = self.contact.problem, self.method, self.contact_tolerance
        if self._rigid is not None:
            return self._rigid.solve(problem, method, tolerance, MAX_SWEEPS)
        team, is_parallel = team_of(problem, method, n)
        if is_parallel:
            colour_contacts(problem)
            return solve(problem, method, tolerance, MAX_SWEEPS)
        if event < NOT_SOLVED:
            sweeps = min(MAX_SWEEPS, sweeps_per_launch(n))
            begin_solve(problem, team, self.contact.detection.surface, method, tolerance, sweeps, MAX_SWEEPS, NOTHING)
        return solve(problem, method, tolerance, MAX_SWEEPS, is_begun=True)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of the contact problem of rigid bodies."""
        return super().field_bytes | self.batch.field_bytes | (self._rigid.field_bytes if self._rigid else {})

    def release(self) -> None:
        """Free its memory."""
        super().release()
        self.batch.release()
        if self._rigid:
            self._rigid.release()
