"""Loops in chunks: each runs serially and has its own partial sums, so that results do not depend on threads.

The number of chunks follows from the size of a scene alone. On the CPU one thread runs them in turn, or several share them.
"""

import taichi as ti

# Taichi gives each CPU thread at least 512 iterations of a loop: each chunk takes that many, and only the first does the work
SPREAD = {"cpu": 512, "cuda": 1}


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
