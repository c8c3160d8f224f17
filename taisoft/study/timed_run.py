"""A stretch of steps timed without compiling, the way of every timing of whole runs: warm up, reset, advance."""

import time
from dataclasses import dataclass

from taisoft.simulator import Simulator

WARM_STEPS = 3  # a multistep integrator has met all its kernels by then


@dataclass
class TimedRun:
    """What some steps did. seconds: wall time without compiling [s]; inverted: the most tets in one report."""

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
    """Take `steps` steps in the largest batches that sim.advance takes, as sim.run does between two frames."""
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


def warm_up(sim: Simulator) -> None:
    """Compile what steps need, and go back to the start."""
    for _ in range(WARM_STEPS):
        sim.step()
    sim.reset()
