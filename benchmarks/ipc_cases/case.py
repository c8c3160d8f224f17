"""A case of the benchmark: a scene, its steps and what was published about it."""

from collections.abc import Callable
from dataclasses import dataclass

import taisoft as ts

SIZES = SMALL, FULL = ("small", "full")


@dataclass(frozen=True)
class Case:
    """A scene of the paper.

    build: size ("small" or "full") -> scene; raises MeshError for a mesh that is absent. dt: step [s]. seconds: simulated time
    wanted [s]. published_nodes, published_seconds: number of nodes and seconds a step in the paper. stop_at_crossing: whether a
    run ends at the first step after which surfaces cross.
    """

    name: str
    title: str
    build: Callable[[str], ts.Scene]
    dt: float
    seconds: float
    published_nodes: int
    published_seconds: float
    stop_at_crossing: bool = False

    @property
    def steps(self) -> int:
        """Number of steps wanted."""
        return round(self.seconds / self.dt)
