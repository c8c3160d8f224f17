"""Teams: threads that take many tiny phases in one launch, where a launch for each phase would take longer than its work.

On CUDA a team is one block of threads. A kernel has one loop over them, whose body is written once:

    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        for j in range(team.share(t, n)):        # a phase: entries in any order
            i = team.entry(t, j, n)              # or team.term(t, j): in a fixed one, for sums
            ...
        team.sync()                              # before a phase that reads what others have written
        total = team.total(t, value)             # the same number for all threads; all must call it
        for j in range(team.rounds(n)):          # entries in ascending order, such as those of a list that keeps its order
            i = t + j * team.threads             # may be n or more
            before, all = team.count(t, flag)

Loops and conditions around phases must be the same for all threads: they depend on arguments, on totals, or on memory that was
written before the last `sync` and is written again after the next one.
On the CPU one thread takes all entries. A phase whose entries depend on each other is wrong on CUDA only, so tests have the
entries taken in the order in which `virtual` threads would take them one after another, or in the reverse of that.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena, on_cuda
from taisoft.backend.lists import part_first
from taisoft.backend.paths import team_order

GPU_THREADS = 1024  # of a block
FOLD = 32  # numbers that a thread adds in each of the two stages of a sum, at most


@dataclass(frozen=True, eq=False)
class Team:
    """Threads of a launch, for kernels. Without `sums` it is one thread, on the CPU."""

    virtual: int = 1  # threads whose order one thread takes
    backwards: bool = False
    threads: int = 1
    sums: Any = None  # (threads + FOLD) f64: each thread's value, and sums of FOLD of them

    @property
    def alone(self) -> bool:
        """Whether it is one thread."""
        return self.threads == 1

    @ti.func
    def share(self, t, n):
        """Return how many of n entries thread t takes."""
        return (n - t + self.threads - 1) // self.threads

    @ti.func
    def term(self, t, j):
        """Return the j-th entry of thread t in a sum."""
        return t + j * self.threads

    @ti.func
    def entry(self, t, j, n):
        """Return the j-th of n entries that thread t takes."""
        at = self.term(t, j)
        if ti.static(self.virtual > 1 or self.backwards):
            at = j
            if ti.static(self.backwards):
                at = n - 1 - j
            q, longer = n // self.virtual, n % self.virtual  # the first ones have an entry more
            if at < longer * (q + 1):
                at = at // (q + 1) + at % (q + 1) * self.virtual
            else:
                at -= longer * (q + 1)
                at = longer + at // q + at % q * self.virtual
        return at

    @ti.func
    def sync(self):
        """Wait for all threads; what they have written can then be read."""
        if ti.static(not self.alone):
            ti.simt.block.sync()

    @ti.func
    def total(self, t, value):
        """Return the sum of an f64 value over all threads, in a fixed order."""
        return self._folded(t, value, False)

    @ti.func
    def largest(self, t, value):
        """Return the largest of an f64 value over all threads."""
        return self._folded(t, value, True)

    @ti.func
    def rounds(self, n):
        """Return how many rounds the threads need for n entries if each takes one in every round."""
        return (n + self.threads - 1) // self.threads

    @ti.func
    def count(self, t, number):
        """Return the sums of an i32 number over the threads before t, and over all threads."""
        before, total = 0, number
        if ti.static(not self.alone):
            self._store(t, ti.cast(number, ti.f64), False)
            size = ti.static(self.threads // FOLD)
            sum_before = ti.cast(0.0, ti.f64)
            for k in range(t // size):
                sum_before += self.sums[self.threads + k]
            for k in range(t - t % size, t):
                sum_before += self.sums[k]
            before, total = ti.cast(sum_before, ti.i32), ti.cast(self._fold(self.threads, FOLD, False), ti.i32)
            self.sync()
        return before, total

    @ti.func
    def add_up(self, t, numbers: ti.template(), n):
        """Replace each of n i32 numbers by the sum of those before it. Return the sum of all."""
        first, last, own = part_first(t, n, self.threads), part_first(t + 1, n, self.threads), 0
        for k in range(first, last):
            own += numbers[k]
        at, total = self.count(t, own)
        for k in range(first, last):
            number = numbers[k]
            numbers[k] = at
            at += number
        return total

    @ti.func
    def list_from(self, t, values: ti.template(), least, n, out: ti.template(), first):
        """List in out[first:end], ascending, which of n i32 values are at least `least`. Return end."""
        end = first
        for j in range(self.rounds(n)):
            i, listed = t + j * self.threads, 0
            if i < n:
                listed = int(values[i] >= least)
            before, total = self.count(t, listed)
            if listed == 1:
                out[end + before] = i
            end += total
        self.sync()
        return end

    @ti.func
    def least(self, t, number):
        """Return the least of an i32 number over all threads."""
        return -ti.cast(self.largest(t, -ti.cast(number, ti.f64)), ti.i32)

    @ti.func
    def _folded(self, t, value, largest: ti.template()):
        result = value
        if ti.static(not self.alone):
            self._store(t, value, largest)
            result = self._fold(self.threads, FOLD, largest)
        return result

    @ti.func
    def _store(self, t, value, largest: ti.template()):
        """Store each thread's value, and what FOLD parts of them give."""
        self.sums[t] = value
        self.sync()
        if t < FOLD:
            self.sums[self.threads + t] = self._fold(t * (self.threads // FOLD), self.threads // FOLD, largest)
        self.sync()

    @ti.func
    def _fold(self, first, n: ti.template(), largest: ti.template()):
        """Sum of n of `sums`, or the largest one."""
        result = self.sums[first]
        for k in range(1, n):
            if ti.static(largest):
                result = ti.max(result, self.sums[first + k])
            else:
                result += self.sums[first + k]
        return result


ALONE = Team()


def make_team(arena: FieldArena, name: str) -> Team:
    """Allocate a team: a block on CUDA, one thread on the CPU."""
    if not on_cuda():
        return Team(*team_order())
    return Team(threads=GPU_THREADS, sums=arena.field(f"{name}_sums", ti.f64, GPU_THREADS + FOLD))
