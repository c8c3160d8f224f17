"""Carrying out one variant of a case: simulators by its settings, runs that are watched, and what came of them.

A reference is the same in f64 with an eighth of the step, looked at at the same times.
"""

import time
import warnings
from collections.abc import Callable

import numpy as np

import taisoft as ts
from taisoft.errors import TaisoftError
from taisoft.output.report import peak_memory
from taisoft.records import RunReport, StepReport

from .record import (
    DEGRADED,
    DROPPED,
    FAILED,
    INTERRUPTED,
    INVERTED,
    OK,
    OVERLAP,
    PENETRATION,
    REFUSED,
    STOPPED,
    UNCONVERGED,
    Case,
    Variant,
)

FINER = 8  # steps of a reference for one of the run
FRAMES = 20  # of a run that are kept, at most about
WORST = (OK, DEGRADED, REFUSED, STOPPED)

Look = Callable[[ts.Simulator, int, StepReport | None], None]


class Session:
    """One variant being run. finer: 1, or FINER for its reference.

    reports: of all steps so far. path: lists of points (n,3) [m] of the run, at its start, at FRAMES times and at its end.
    """

    def __init__(self, case: Case, variant: Variant, arch: str, finer: int = 1):
        self.case, self.variant, self.arch, self.finer = case, variant, arch, finer
        self.status = OK
        self.causes: set[str] = set()  # what degraded its runs
        self.problems: list[str] = []
        self._warned: list[warnings.WarningMessage] = []
        self.steps = 0
        self.seconds = 0.0  # wall time of steps without compiling
        self.step_seconds: list[float] = []  # of a step, of each advance
        self.reports: list[StepReport] = []
        self.path: list[np.ndarray] = []

    def simulator(self, scene: ts.Scene, **changes) -> ts.Simulator:
        """A simulator of the scene by the variant's settings, with changes; finer where this is a reference."""
        settings = self.variant.settings | changes
        settings["dt"] = settings["dt"] / self.finer
        if self.finer > 1:
            settings["precision"] = "f64"
        return ts.Simulator(scene, arch=self.arch, **settings)

    def go(self, sim: ts.Simulator, steps: int, look: Look | None = None, every: int = 1, follow: bool = True) -> RunReport:
        """Run so many steps of the variant's length; look(sim, number, report) before them and after every `every` of them.

        follow: keep some of its states for the comparison with the reference. A run that fails is told in the result.
        """
        dt, total = sim.dt * self.finer, steps // every
        kept = max(1, total // FRAMES)

        def frame(sim, number, report):
            if look is not None:
                look(sim, number, report)
            if follow and (number % kept == 0 or number == total):
                self.path.append(sim.positions())

        def step(report, seconds):
            self.seconds += seconds
            self.step_seconds.append(seconds / report.steps)

        result = sim.run(steps * dt, frame, fps=1.0 / (every * dt), on_step=step)
        self.steps += result.steps
        self.reports += result.step_reports
        self.causes |= causes_of(sim, result)
        failed = STOPPED if sim.step_count else REFUSED  # the simulator's first step is done, or not
        self.tell(failed if result.status == FAILED else result.status, result.problems)
        return result

    def refuse(self, sentence: str) -> None:
        """What was asked of a simulator was refused."""
        self.tell(REFUSED, [sentence])

    def tell(self, status: str, problems: list[str]) -> None:
        """How something ended; the worst counts."""
        self.status = max(self.status, status, key=WORST.index)
        self.problems += problems

    @property
    def warnings(self) -> list[str]:
        """What was warned of so far."""
        return [str(one.message) for one in self._warned if issubclass(one.category, UserWarning)]

    @property
    def deepest(self) -> float:
        """The deepest penetration after any step [m]."""
        return max((report.max_penetration for report in self.reports), default=0.0)

    @property
    def unconverged(self) -> int:
        """Reports of steps that did not converge."""
        return sum(not report.converged for report in self.reports)

    def record(self) -> dict:
        """Run the variant. Returns plain data: its end, its numbers, its cost, its path."""
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as self._warned:
            warnings.simplefilter("always", UserWarning)
            try:
                numbers = self.case.run(self, **self.variant.parameters)
            except TaisoftError as error:
                numbers = {}
                self.refuse(str(error))
        return {
            "status": self.status,
            "causes": sorted(self.causes),
            "problems": list(dict.fromkeys(self.problems)),
            "warnings": list(dict.fromkeys(self.warnings)),
            "numbers": {name: float(value) for name, value in numbers.items()},
            "steps": self.steps,
            "seconds": self.seconds,
            "total_seconds": time.perf_counter() - start,
            "step_seconds": float(np.median(self.step_seconds)) if self.step_seconds else None,
            "newton_iterations": sum(report.newton_iterations for report in self.reports),
            "linear_iterations": sum(report.linear_iterations for report in self.reports),
            "contact_iterations": sum(report.contact_iterations for report in self.reports),
            "inverted": max((report.n_inverted for report in self.reports), default=0),
            "unconverged": self.unconverged,
            "peak_memory_bytes": peak_memory(),
            "points": np.concatenate(self.path) if self.path else np.empty((0, 3)),
        }


def causes_of(sim: ts.Simulator, result: RunReport) -> set[str]:
    """What degraded a run."""
    steps = result.step_reports
    found = {
        UNCONVERGED: any(not step.converged for step in steps),
        INVERTED: any(step.n_inverted for step in steps),
        DROPPED: any(step.dropped_contacts for step in steps),
        PENETRATION: any(step.deep for step in steps),
        INTERRUPTED: result.interrupted,
        OVERLAP: result.status == DEGRADED and sim.touches and overlapping(sim),
    }
    return {cause for cause, so in found.items() if so}


def overlapping(sim: ts.Simulator) -> bool:
    """Whether two bodies overlap by more than a run may end with."""
    return any(found.depth > sim.contact_limit(found.name_a, found.name_b) for found in sim.overlaps())


def refusal(make: Callable[[], ts.Simulator]) -> str:
    """The sentence with which a simulator refuses to be made; empty where it is made after all."""
    try:
        make().close()
    except TaisoftError as error:
        return str(error)
    return ""
