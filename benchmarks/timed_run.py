"""What some steps of a simulator did, and their time."""

import time
from dataclasses import dataclass

from taisoft.simulator import Simulator


@dataclass
class TimedRun:
    """Totals of some steps. seconds: wall time without compiling [s]; inverted: maximum inverted tets in one report."""

    steps: int = 0
    seconds: float = 0.0
    unconverged: int = 0
    inverted: int = 0
    newton_iterations: int = 0
    linear_iterations: int = 0

    def __add__(self, other: "TimedRun") -> "TimedRun":
        sums = {k: a + b for (k, a), b in zip(vars(self).items(), vars(other).values())}
        return TimedRun(**sums | {"inverted": max(self.inverted, other.inverted)})


def advance(sim: Simulator, steps: int) -> TimedRun:
    """Take `steps` steps in the largest batches that sim.advance allows, as sim.run does between two frames."""
    timed = TimedRun(steps)
    compiled, start = sim.compile_seconds, time.perf_counter()
    done = 0
    while done < steps:
        report = sim.advance(steps - done)
        done += report.steps
        timed.unconverged += not report.converged
        timed.inverted = max(timed.inverted, report.n_inverted)
        timed.newton_iterations += report.newton_iterations
        timed.linear_iterations += report.linear_iterations
    timed.seconds = time.perf_counter() - start - (sim.compile_seconds - compiled)
    return timed
