"""Implicit integrators: a step is one stage (`implicit_stages`), or several if it is cut.

A step is tried whole, or as long as the last parts that were kept allow (`part_length`). What the way of a part meets becomes a
contact, with which its stage is solved on (`_attempt`). A part is rejected, undone and halved if its way is not free all the
same (`PartCheck.certify`), or if Newton's method failed and shorter parts may help. What cannot be halved is kept and reported;
bodies that would still pass through something are held back. Where surfaces cross already, contacts that close fast limit the
length, and motion too fast for the shortest part is refused.

Where the step's Newton iterations or its wall time are used up (`newton_budget`), nothing is tried again: what passes through
something on its way, or inverts tets, is held back. Out of iterations, only what is prescribed moves in the rest of the step; out
of time, the rest is one more part, of one iteration.
"""

import math
from dataclasses import replace

import numpy as np

from taisoft.backend.arrays import download
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.implicit_stages import ImplicitStages
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.part_check import FREE, MAX_PASSAGES, MET
from taisoft.dynamics.part_length import PARTS, PartLength
from taisoft.dynamics.results import StageResult, StepResult, count_all, merge
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.sleeping import Sleep
from taisoft.errors import SimulationError
from taisoft.fem.measure import measure
from taisoft.fem.state import N_INVERTED
from taisoft.settings import Settings

MAX_LATE = 1  # attempts, out of time, after which what they met is held back
RUNAWAY = 1.9  # sizes that a piece has moved in a static part without equilibrium: nothing holds it


class ImplicitStepper(ImplicitStages):
    """Take steps of one scheme, see above."""

    def __init__(self, simulation: SimulationState, settings: Settings, contact: ContactStep | NoContacts):
        super().__init__(simulation, settings, contact)
        self.first = simulation.now.another(simulation.arena, "first")  # state before the step
        self.reached, self.last = 0.0, None  # fraction of the last step until which all parts converged; its result
        self.sleep = None if simulation.asleep is None else Sleep(simulation, contact, self.tolerance)
        self.forget()

    def forget(self) -> None:
        """Discard the history, after the state was set."""
        super().forget()
        self._length = PartLength()
        if self.sleep is not None:
            self.sleep.forget()

    def wake(self, *names: str) -> None:
        """Wake bodies, or without names all that sleep."""
        if self.sleep is not None:
            own = [collider.name for collider in self.simulation.scene.colliders]
            self.sleep.wake(np.isin(own, names or own))

    def numbers_changed(self) -> None:
        """Update for changed gravity or material numbers."""
        super().numbers_changed()
        self.wake()

    def loads_changed(self) -> None:
        """Wake what is dragged: every stage reads the loads."""
        if self.sleep is not None and self.simulation.drag is not None:
            self.sleep.wake(self.sleep.bodies_of(self.simulation.drag[0]))

    def reactions(self) -> np.ndarray:
        """Return the constraint forces of the last step, (n_nodes, 3) [N]."""
        found = super().reactions()
        return found if self.sleep is None else self.sleep.reactions(found)

    def snapshot(self) -> dict:
        """Return the state of the stepper: history, solver, contacts, and the length of the next part."""
        sleep = {} if self.sleep is None else {"sleep": self.sleep.snapshot()}
        return super().snapshot() | {"part_length": self._length.snapshot()} | sleep

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        super().restore(kept)
        self._length.restore(kept["part_length"])
        if self.sleep is not None:
            self.sleep.restore(kept["sleep"])

    def held_steps(self, dt: float) -> int:
        """Return the number of steps of dt over which a drag force is held."""
        return 1

    def advance(self, n: int, dt: float) -> StepResult:
        """Take one step of dt, whatever n. Raise SimulationError if it fails; the state is then the one before."""
        time, sleep = self.simulation.time, self.sleep
        if sleep is not None and sleep.begin_step(time, dt):
            return StepResult()
        self.first.copy_from(self.simulation.now)
        self.solver.budget.begin(None if self.scheme.c == 0.0 else self.simulation.budget)
        dropped: list[StageResult] = []
        length, is_again = self._length.snapshot(), False
        while True:
            try:
                kept, held = self._take_parts(dt, dropped)
            except BaseException as error:  # Ctrl-C, too
                if not self._abandon(error, dropped) or is_again:
                    raise
                is_again = True
                continue
            if self._is_over():
                self._length.give_up()
            if sleep is None or not sleep.is_pressed():
                break
            dropped += kept
            self.simulation.return_to(self.first)
            self.n_previous = 0
            self._length.restore(length)
            self.contact.search.discard()
        self.last = merge(kept)
        return self._report(count_all(self.last, dropped), len(kept), held)

    def settle(self, dt: float, is_solved: bool) -> None:
        """Let what rests fall asleep after a step of dt. is_solved: whether it converged without problems."""
        if self.sleep is not None:
            self.sleep.end_step(self.simulation.time, dt, is_solved, self.reactions)

    def _abandon(self, error: BaseException, dropped: list[StageResult]) -> bool:
        """Return to the start of the step; return whether only convergence was missing, so that it is to be taken without halving
        for that."""
        self.simulation.return_to(self.first)
        was_halved, length = isinstance(error, SimulationError) and any(result.free for result in dropped), self._length
        self.forget()
        if was_halved:
            self._length = length
            length.give_up()
        return was_halved

    def _take_parts(self, dt: float, dropped: list[StageResult]) -> tuple[list[StageResult], float]:
        """Take a step of dt in parts, which are halved while they are rejected, and then in `dropped`. Return the results of the
        others, and the fraction of the step in which motion was held back for lack of iterations."""
        contact, length, time = self.contact, self._length, self.simulation.time
        kept, held, left = [], 0.0, PARTS  # left: in dt / PARTS
        self.reached = 0.0
        contact.start_step(time, dt)
        while left:
            now, is_rest = time + (1.0 - left / PARTS) * dt, self._is_spent()
            longest = left if self._is_over() else min(left, length.units(dt))
            units = left if is_rest else contact.check.most_units(now, dt, longest)
            part = units / PARTS * dt
            result = self._hold(now, part) if is_rest else self._attempt(now, part)
            # linearly implicit stages do not iterate: shorter ones need not converge sooner
            converged = result.converged or self.scheme.one_iteration
            if self.scheme.c == 0.0:  # where tets are inverted, it may be a state that no path leads to
                converged = (converged or result.at_rounding) and self._count_inverted() == 0
            if self.scheme.c == 0.0 and not result.converged:
                self._refuse_runaway()
            is_finite = math.isfinite(result.residual)
            is_last = self._is_over() if is_finite else self._is_spent()
            if not is_last and length.should_halve(result.free, converged, units):
                if not is_finite:
                    self.solver.linear_solver.forget()
                self._undo(discard_impulses=result.free or not is_finite)
                length.halve(units, dt)
                dropped.append(result)
                continue
            if not is_finite:
                raise SimulationError(f"step {self.simulation.step_count + 1}: {result.imbalance}")
            result, part_held = (result, 1.0) if is_rest else self._hold_back(result, dt)
            held += units / PARTS * part_held
            left -= units
            self.simulation.move_branches(part)
            contact.end_part(now + part, part if left else dt, self.start.x, self.dissipative)
            if self.sleep is not None:
                self.sleep.see_part()
            length.keep(units, converged)
            if converged and self.reached == 1.0 - (left + units) / PARTS:
                self.reached = 1.0 - left / PARTS
            kept.append(result)
        return kept, held

    def _attempt(self, time: float, dt: float) -> StageResult:
        """Solve the stage of a part of dt from a time [s]. What its way meets becomes contacts, and the stage is solved on from
        the velocities reached."""
        contact, results, start, n_previous, n_late = self.contact, [], None, self.n_previous + 1, 0
        self.start.copy_rest_from(self.simulation.now)
        contact.start_substep(dt)
        if self.scheme.c == 0.0 and not contact.idle and contact.detection.overlay is None:
            start = self.follow_prescribed(time, dt)
        while True:
            result = self.solve_stage(time, dt, start)
            results.append(result)
            # an impact of the first attempt is none for the next, whose contacts have impulses from the start
            self.n_previous = n_previous = min(n_previous, self.n_previous)
            if not math.isfinite(result.residual):
                return count_all(result, results[:-1])
            way = contact.check.certify(time, dt, self.start)
            is_hopeless = not (result.converged or self.scheme.one_iteration or self.scheme.c == 0.0)
            is_late = self.solver.budget.is_out_of_time()  # an iterate that has not converged may then be near
            n_late += is_late
            is_last = n_late > MAX_LATE or (is_hopeless and not is_late) or self._is_spent()
            if way != MET or len(results) > MAX_PASSAGES or is_last:
                return count_all(replace(result, free=way == FREE), results[:-1])
            if result.converged or self.scheme.c > 0.0:  # else what falls starts again, above what it meets
                start = self.simulation.velocities()
            self.simulation.now.copy_nodes_from(self.start)
            self.n_previous = 0
            contact.paths.search_along(time, dt)

    def _refuse_runaway(self) -> None:
        """Raise SimulationError if a body has left, in a static part that did not converge."""
        if not self.solver.is_loose:
            return
        end, start = download([self.simulation.model.state.x, self.start.x])
        far, name = self.solver.pieces.farthest(end - start)
        if far >= RUNAWAY:
            raise SimulationError(
                f"step {self.simulation.step_count + 1}: nothing holds {name}: it moved by {far:.3g} times its size, and no "
                "equilibrium was found: hold it, start it nearer, take smaller load steps, or simulate its motion in time"
            )

    def _undo(self, discard_impulses: bool) -> None:
        """Return to the start of the part, for a shorter one. discard_impulses: they would not help it."""
        self.simulation.return_to(self.start)
        self.n_previous = 0
        self.contact.search.discard()
        if discard_impulses or self.scheme.before > 0.0:  # BDF2 detects impacts by the contacts without impulse in the last step
            self.contact.discard_impulses()

    def _is_spent(self) -> bool:
        """Whether the step has no Newton iterations left."""
        return not self.solver.budget.left

    def _is_over(self) -> bool:
        """Whether the step has no Newton iterations or no time left, so that nothing is tried again."""
        return self._is_spent() or self.solver.budget.is_out_of_time()

    def _hold(self, time: float, dt: float) -> StageResult:
        """Take a part in which only what is prescribed moves."""
        self.start.copy_rest_from(self.simulation.now)
        self.contact.start_substep(dt)
        result = self.solve_stage(time, dt, None)
        self._return_by(0.0)
        if self.contact.paths.find():
            self.contact.paths.hold_back(self.start.x)
        return StageResult(0.0, 0, 0.0, False, False, imbalance=result.imbalance)

    def _hold_back(self, result: StageResult, dt: float) -> tuple[StageResult, float]:
        """Hold back what passes through something on the way of a part that is kept, and, if the step is over, what inverts
        tets; return the result, and the fraction of the motion that is held back for that.

        Raise SimulationError if contacts close too fast even for the shortest part of a step of dt.
        """
        paths, held, is_over = self.contact.paths, 0.0, self._is_over()
        end = self.simulation.state()[0] if self.solver.budget.ran_out else None
        if not result.free:
            if not is_over:
                self.contact.check.refuse_fast_closing(dt)
            if paths.hold_back(self.start.x):
                self.n_previous, result = 0, replace(result, converged=False)
        if not result.converged and is_over:
            held = 1.0 - self._hold_back_inverted()
            if held and paths.find():
                paths.hold_back(self.start.x)
        if end is not None:
            moved = float(np.linalg.norm(self.simulation.state()[0] - end, axis=1).max())
            result = replace(result, correction=result.correction + moved)
        return result, held

    def _hold_back_inverted(self) -> float:
        """Shorten the motion of the last part until no more tets are inverted than at its start; return what is left of it."""
        n_end, end = self._count_inverted(), self.simulation.state()
        self._return_by(0.0)
        n_start, part = self._count_inverted(), 1.0
        while n_end > n_start and part > 0.0:
            part = 0.5 * part if part > 1e-3 else 0.0
            self.simulation.set_state(*end)
            self._return_by(part)
            n_end = self._count_inverted()
        if part == 1.0:
            self.simulation.set_state(*end)
        else:
            self.n_previous = 0
        return part

    def _count_inverted(self) -> float:
        measure(self.simulation.model)
        return self.simulation.model.state.scalars[N_INVERTED]

    def _return_by(self, left: float) -> None:
        """Leave only a fraction of the last part's change of the free nodes' positions and velocities."""
        free, *start = download([self.simulation.model.free, self.start.x, self.start.v])
        end = self.simulation.state()
        self.simulation.set_state(*(np.where(free > 0, a + left * (b - a), b).astype(b.dtype) for a, b in zip(start, end)))

    def _report(self, result: StageResult, n_parts: int, held: float) -> StepResult:
        """What is reported of a step. held: the fraction of it in which motion was held back for lack of iterations."""
        (worst, name), budget = result.unbalanced, self.solver.budget
        step = StepResult(
            substeps=n_parts,
            newton_iterations=round(result.newton_iterations),
            linear_iterations=result.linear_iterations,
            multigrid_solves=result.multigrid_solves,
            contact_iterations=result.contact_iterations,
            residual=max(result.residual, worst) if name else result.residual,
            contact_residual=result.contact_residual,
            converged=result.converged and not name,
            last_correction=result.correction,
        )
        step.on_budget = int(budget.ran_out and not step.converged)
        is_solved = result.residual <= self.tolerance and result.contact_residual <= self.contact_tolerance
        if not (step.converged or (self.contact.paths.held_back and is_solved)):
            step.problems.append(
                "on budget: " * step.on_budget
                + f"Newton stopped after {step.newton_iterations} iterations at a relative residual of {step.residual:.2e}"
                + (f" and a contact residual of {step.contact_residual:.2e}" if self.contact.n_contacts else "")
                + (f"; its last correction was {step.last_correction:.2g} m" if step.on_budget else "")
                + (f"; {result.imbalance}" if result.imbalance else "")
            )
        if held > 0.0:
            step.problems.append(
                ("the step's time was" if step.on_budget else f"{budget.limit} Newton iterations, the most in a step, were")
                + f" not enough: the motion in the last {100.0 * held:.3g} % of the step was held back"
            )
        if self.contact.paths.held_back:
            step.problems.append(self.contact.paths.held_back)
        if self._multipliers is not None:
            step.problems += self._multipliers.problems()
        if name and not step.on_budget:
            step.problems.append(f"forces on {name} are unbalanced by {worst:.2g} of their size, beside larger forces elsewhere")
        return step
