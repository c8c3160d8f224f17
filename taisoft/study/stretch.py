"""A stretch of steps timed without compiling, the way of every timing of whole runs: warm up, reset, advance."""

import time
from dataclasses import dataclass

from taisoft.simulator import Simulator

WARM_STEPS = 3  # a multistep integrator has met all its kernels by then


@dataclass
class Stretch:
    """What some steps did. seconds: wall time without compiling [s]; inverted: the most tets in one report."""

    steps: int = 0
    seconds: float = 0.0
    unconverged: int = 0
    inverted: int = 0
    newton_iterations: int = 0
    linear_iterations: int = 0

    def __add__(self, other: "Stretch") -> "Stretch":
        sums = {k: a + b for (k, a), b in zip(vars(self).items(), vars(other).values())}
        return Stretch(**sums | {"inverted": max(self.inverted, other.inverted)})


def advance(sim: Simulator, steps: int) -> Stretch:
    """Take `steps` steps in the largest batches that sim.advance takes, as sim.run does between two frames."""
    stretch = Stretch(steps)
    compiled, start = sim.compile_seconds, time.perf_counter()
    done = 0
    while done < steps:
        report = sim.advance(steps - done)
        done += report.steps
        stretch.unconverged += not report.converged
        stretch.inverted = max(stretch.inverted, report.n_inverted)
        stretch.newton_iterations += report.newton_iterations
        stretch.linear_iterations += report.linear_iterations
    stretch.seconds = time.perf_counter() - start - (sim.compile_seconds - compiled)
    return stretch


def warm_up(sim: Simulator) -> None:
    """Compile what steps need, and go back to the start."""
    for _ in range(WARM_STEPS):
        sim.step()
    sim.reset()
