"""To what the frictional problems of a stage's Newton iterations are solved, and what each learns from the last."""

from taisoft.dynamics.friction import FIRST_R, MAX_R_FRICTIONLESS, PLAIN, Friction, Goal, Solution
from taisoft.dynamics.stage import Stage
from taisoft.dynamics.stage_system import StageSystem


class FrictionalProblems:
    """The frictional problems of one stage."""

    # maximum linear solves, their tolerance, and its minimum after the first solve: later ones change no rigid motion
    SOLVES, FORCING, LATER_FORCING = 60, 0.3, 0.01
    # fractions of the stage's |r| and laws' residual to which a problem is solved, or these fractions of the tolerances, which
    # survive a full nonlinear step
    REDUCTION, LAW_REDUCTION, TOLERANCE_FRACTION, LAW_TOLERANCE_FRACTION = 0.1, 0.1, 0.6, 0.8
    STATIC_FRACTION = 0.3  # that of the tolerance in statics, where loose problems lead from one equilibrium to others
    LAW_BALANCE = 0.03  # laws' residual over the required relative |r|; the next matrix would undo more accuracy
    MULTIPLIER_FRACTION = 0.3  # of the required |r|, ends the steps under one multiplier: updates at a large |r| overshoot
    NEAR_FLOOR = 6.0  # times the floor of |r|: below it, |r| may be mostly rigid motion
    # problems in a row that are solved directly before a stage tries iterations again; twice as many after each trial in vain
    TRIAL, RAREST = 16, 256
    R_STALLED, MAX_R_STALLED = 1000.0, 1e5  # smallest first R and upper bound without friction, where the laws stalled before

    def __init__(self, system: StageSystem, stage: Stage):
        self._system, self._stage = system, stage
        self.tight = False  # whether the last problem was near the floor
        self._was_direct = False  # whether it was solved directly
        # whether the stage's first problem is one
        self._is_trial = system.n_direct >= min(self.TRIAL << system.n_in_vain, self.RAREST)
        self._law_aim = stage.law_aim
        self._r_scale, self._max_r_scale = FIRST_R, MAX_R_FRICTIONLESS

    def goal(self, r: float, scale: float, is_balanced: bool) -> Goal:
        """Return to what the next problem is solved. r, scale: of the stage; is_balanced: whether |r| has converged."""
        stage, fraction = self._stage, self.STATIC_FRACTION if self._system.is_static else self.TOLERANCE_FRACTION
        norm = max(self.REDUCTION * r, fraction * stage.tolerance * scale)
        # if rounding of stiff stress hides the rigid motion in |r|, only a tight first solve gets that motion right, and impulses
        # converge only if |r| decreases with them
        self.tight = r <= self.NEAR_FLOOR * self._system.floor
        law = self.LAW_TOLERANCE_FRACTION * self._law_aim
        if not is_balanced and scale > 0.0:
            law = max(law, self.LAW_BALANCE * norm / scale)
        has_stalled = self._r_scale > FIRST_R
        return Goal(
            norm=norm,
            law=max(self.LAW_REDUCTION * self._system.contact_residual, law),
            inner=0.0 if self.tight else self.MULTIPLIER_FRACTION * norm,
            forcing=stage.linear_tolerance or (min(stage.tolerance, self.FORCING) if self.tight else self.FORCING),
            later=0.0 if stage.linear_tolerance else self.LATER_FORCING,
            plain=Friction.MAX_UPDATES if has_stalled else 0 if self.tight else PLAIN,
            max_solves=self.SOLVES,
            r_scale=self._r_scale,
            max_r_scale=self._max_r_scale,
        )

    @property
    def is_direct(self) -> bool:
        """Whether the next problem is to be solved directly at once: as the stage's last one was, or as those of steps before
        were, whose iterations took too long, but for a trial now and then."""
        return self._was_direct or (self._system.n_direct > 0 and not self._is_trial)

    def count(self, goal: Goal, found: Solution) -> None:
        """Count the problems in a row that were solved directly since iterations took too long."""
        system, was_trial, self._was_direct, self._is_trial = self._system, self._is_trial, found.direct, False
        n = 0 if was_trial else system.n_direct
        took_long = n > 0 or 1 < found.solves <= goal.max_solves
        system.n_direct = n + 1 if found.direct and took_long else 0
        system.n_in_vain = system.n_in_vain + was_trial if system.n_direct else 0

    def learn(self, goal: Goal, found: Solution) -> None:
        """Take account of a problem's solution."""
        self.count(goal, found)
        if not (found.converged or found.negative):
            self._law_aim = self._stage.contact_tolerance
        if self._system.frictionless and not (found.negative or found.direct):
            if found.converged or self._system.contact_residual <= goal.law:
                self._r_scale = FIRST_R
            else:
                self._r_scale, self._max_r_scale = max(self.R_STALLED, found.r_scale), self.MAX_R_STALLED
