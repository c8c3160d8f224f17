"""Loops in chunks: each runs serially and has its own partial sums, so that results do not depend on threads.

The number of chunks follows from the size of a scene alone. On the CPU one thread runs them in turn, or several share them, and
a chunk has consecutive entries. On CUDA a chunk is a thread and takes every CHUNKS-th entry, so that threads that run side by
side read memory side by side; there `fold` adds the partial sums in two stages, since one thread would take long.
A Gauss-Seidel sweep, whose chunks depend on each other, has chunks of its own: see `SweepOrder`.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from taisoft.backend.lists import part_first

FOLDED = 512  # partial sums that `fold` leaves on CUDA; of more chunks than these, a multiple
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
def block_first(g: ti.template(), c, chunks: ti.template()):
    """Return the first block of chunk c of a group's blocks."""
    return g.first + part_first(c, g.last - g.first, chunks)


@ti.func
def chunk_size(m: ti.template(), c, n):
    """Return how many of n entries chunk c of the model's loops has."""
    count = (n - c + m.chunks - 1) // m.chunks
    if ti.static(m.on_cpu):
        count = part_first(c + 1, n, m.chunks) - part_first(c, n, m.chunks)
    return count


@ti.func
def chunk_entry(m: ti.template(), c, k, n):
    """Return the index of the k-th of these entries."""
    at = c + k * m.chunks
    if ti.static(m.on_cpu):
        at = part_first(c, n, m.chunks) + k
    return at


@ti.func
def fold(m: ti.template(), first: ti.template(), last: ti.template(), least: ti.template()):
    """Prepare `total_by_team` of columns first to last, as a top-level loop of a kernel: nothing on the CPU.

    least: columns (tuple) whose least entry is wanted, not the sum.
    """
    if ti.static(not m.on_cpu):
        for k in range(m.sums):
            for column in ti.static(range(first, last + 1)):
                s = m.state.partial[k, column]
                for j in range(1, ti.static(m.chunks // m.sums)):  # a constant number, so that loads overlap
                    entry = m.state.partial[k + m.sums * j, column]
                    if ti.static(column in least):
                        s = ti.min(s, entry)
                    else:
                        s += entry
                m.state.partial[k, column] = s


@ti.func
def total_by_team(m: ti.template(), t, column: ti.template()):
    """Sum of a column of the model's partial sums, in a fixed order, after `fold`: for thread t of its team, the same for all."""
    s = ti.cast(0.0, ti.f64)
    for j in range(m.team.share(t, m.sums)):
        s += m.state.partial[m.team.term(t, j), column]
    return m.team.total(t, s)
