"""What an adapter gives: settings of its program for a work, and a session that carries one of them out.

An adapter is a module with NAME, MODEL (what it solves, of works.references), `problem()` -> why it cannot be had, "" where it
can, `settings(work)` and `start(work, setting)` -> Session. Positions are those of all nodes of a work, body after body.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Protocol

import numpy as np

from taisoft.errors import SimulationError

from ..exact_path import SAMPLE
from ..works.references import Model
from ..works.scenes import Work


@dataclass(frozen=True)
class Setting:
    """method: in the program's own words. steps: within SAMPLE. options: what else decides the result."""

    program: str
    model: Model
    method: str
    steps: int
    options: dict = field(default_factory=dict, hash=False)

    @property
    def dt(self) -> float:
        """Step [s]."""
        return SAMPLE / self.steps

    def __str__(self) -> str:
        told = [f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in self.options.items()]
        return ", ".join([self.method, *told])


class Session(Protocol):
    """A program ready to do a work.

    build_seconds: what that took [s], compiling included. unconverged: steps of the followed run that did not, by its own word.
    """

    build_seconds: float
    unconverged: int

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        """The whole work from its start: positions (k+1,n,3) [m] every SAMPLE, where followed, and wall time of the steps [s].

        Raises SimulationError where it diverges.
        """

    def close(self) -> None: ...


def finite(positions: np.ndarray, start: np.ndarray, name: str, time: float) -> np.ndarray:
    """The positions (n,3), unless they are not finite or 1 km from the start: SimulationError."""
    if not np.isfinite(positions).all() or np.abs(positions - start).max() > 1e3:
        raise SimulationError(f"{name} diverges before t = {time:.2f} s")
    return positions


def sampled(
    work: Work, name: str, follow: bool, step: Callable[[], None], positions: Callable[[], np.ndarray]
) -> tuple[np.ndarray | None, float]:
    """What `Session.run` returns, of a program of that name that stands at the work's start.

    step: takes the steps of one SAMPLE, which alone are timed. positions: of all nodes then (n,3) [m], in an array of their own.
    """
    path, seconds = [work.start], 0.0
    for k in range(round(work.seconds / SAMPLE)):
        begun = perf_counter()
        step()
        seconds += perf_counter() - begun
        now = finite(positions(), work.start, name, (k + 1) * SAMPLE)
        if follow:
            path.append(now)
    return np.array(path) if follow else None, seconds
