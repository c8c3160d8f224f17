"""Interface of the compared programs: settings for a work, and a run with one of them.

A program is a module with NAME, MODEL (see works.references), `load()` (its package; raises SimulationError without it),
`settings(work, arch)` (a list of Setting) and `Run`, a Session. Positions are those of all nodes of a work, body after body.
"""

from dataclasses import dataclass, field
from time import perf_counter
from types import ModuleType

import numpy as np

from taisoft.errors import SimulationError

from ..exact_path import SAMPLE
from ..works.references import Model
from ..works.scenes import Work


def problem(program: ModuleType) -> str:
    """Why a program is not available, or "" if it is."""
    try:
        program.load()
    except SimulationError as error:
        return str(error)
    return ""


@dataclass(frozen=True)
class Setting:
    """method: the program's name for it. steps: per SAMPLE. options: other settings that affect the result."""

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
        shown = [f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in self.options.items()]
        return ", ".join([self.method, *shown])


class Session:
    """A program ready to run a work; subclasses define `build`, `reset`, `step` and `positions`.

    build_seconds: time to build [s], including compilation. unconverged: unconverged steps of the recorded run, if the program
    reports them.
    """

    unconverged = 0

    def __init__(self, work: Work, setting: Setting) -> None:
        """Raises SimulationError, or SceneError if the program refuses the setting."""
        self.work, self.setting = work, setting
        self.free = np.concatenate([~body.fixed for body in work.bodies])
        start = perf_counter()
        self.build()
        self.build_seconds = perf_counter() - start

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        """Run the whole work: positions (k+1,n,3) [m] every SAMPLE, if `follow`, and wall time of the steps [s].

        Raises SimulationError if a position is not finite or 1 km from the start.
        """
        self.reset()
        start = self.work.start
        path, seconds = [start], 0.0
        for k in range(round(self.work.seconds / SAMPLE)):
            begun = perf_counter()
            self.step()
            seconds += perf_counter() - begun
            now = self.positions()
            if not np.isfinite(now).all() or np.abs(now - start).max() > 1e3:
                raise SimulationError(f"{self.setting.program} diverges before t = {(k + 1) * SAMPLE:.2f} s")
            if follow:
                path.append(now)
        return np.array(path) if follow else None, seconds

    def build(self) -> None:
        """Build the program's model of the work, and compile."""

    def reset(self) -> None:
        """Return to the initial state."""

    def step(self) -> None:
        """Take the steps of one SAMPLE."""

    def positions(self) -> np.ndarray:
        """Positions of all nodes (n,3) [m], as a copy."""

    def close(self) -> None:
        """Free the program's resources."""
