"""Loops in chunks: each runs serially and has its own partial sums, so that results do not depend on threads.

The number of chunks follows from the size of a scene alone. On the CPU one thread runs them in turn, or several share them.
A Gauss-Seidel sweep, whose chunks depend on each other, has chunks of its own: see `SweepOrder`.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

# Taichi gives each CPU thread at least 512 iterations of a loop: each chunk takes that many, and only the first does the work
SPREAD = {"cpu": 512, "cuda": 1}
# Most chunks of a sweep, and 2^this is the least number of their nodes: the more chunks, the more rows couple them
SWEEP_CHUNKS, MIN_SHIFT = 16, 11
WHOLE = 30  # shift of a sweep that is not divided


@dataclass(frozen=True)
class SweepOrder:
    """Order in which a Gauss-Seidel sweep passes nodes: chunks of 2^shift nodes by number, the even ones, then the odd ones.

    Chunks of one parity are passed at the same time, so they must not depend on each other.
    """

    shift: int = WHOLE

    @classmethod
    def of(cls, n_nodes: int) -> "SweepOrder":
        """Divide nodes into chunks of a power of two, whose parity a kernel finds at little cost."""
        return cls(max(MIN_SHIFT, ((n_nodes - 1) // SWEEP_CHUNKS).bit_length()))

    def rank(self, node: np.ndarray) -> np.ndarray:
        """Numbers (k,) that ascend in the order of the sweep."""
        return (((node >> self.shift) & 1) << WHOLE) + node

    def apart(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Whether nodes i and j (k,) are in different chunks of one parity."""
        distance = (i >> self.shift) - (j >> self.shift)
        return (distance != 0) & (distance % 2 == 0)


@ti.func
def part_first(c, n, parts: ti.template()):
    """Return the start of part c of a list of n entries divided into equal parts."""
    return c * (n // parts) + ti.min(c, n % parts)


@ti.func
def block_first(g: ti.template(), c, chunks: ti.template()):
    """Return the first block of chunk c of a group's blocks."""
    return g.first + part_first(c, g.last - g.first, chunks)


@ti.func
def total(m: ti.template(), column: ti.template()):
    """Sum of a column of the model's partial sums, in a fixed order."""
    s = ti.cast(0.0, ti.f64)
    for c in range(m.chunks):
        s += m.state.partial[c, column]
    return s
