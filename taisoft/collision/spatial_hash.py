"""Candidates by spatial hashing over a dense grid (report, section 3.1.4; Teschner et al. 2003, Vision, Modeling, Visualization).

Count, prefix scan, scatter: each triangle is entered into the cells that its swept box covers; then each searches its cells.
A pair is accepted only in the cell that holds the lower corner of the boxes' overlap, so it is found once. The grid is periodic:
indices wrap around its size, so distant triangles may share a cell but never leave the memory; the box test keeps the result
exact. A triangle that covers more than LARGE cells, or lies beyond COUNTABLE cells, is compared with every other one instead.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import Buffer, Candidates, entries, sort_row, sum_parts
from taisoft.collision.surface import ACTIVE, Surface, cell_of, ivec, may_touch
from taisoft.fem.chunks import part_first

LARGE = 512  # cells above which a triangle counts as large
COUNTABLE = 2.0**50  # cells from the origin beyond which f64 cannot distinguish neighbouring cells
MAX_CELLS = 2**22
CELLS_PER_TRIANGLE = 2
ENTRIES_PER_TRIANGLE = 24  # row entries, initial capacity
SCAN = 256  # parts of the prefix scan
N_LARGE, N_ENTRIES = 0, 1  # indices into Grid.count


@dataclass(frozen=True, eq=False)
class Grid:
    """Fields of the grid."""

    nx: Count  # cells along each axis
    ny: Count
    nz: Count
    n_cells: Count
    cell_start: Any  # (n_cells) i32: members of each cell
    cell_end: Any
    scan: Any  # (SCAN) i32: sums of the parts of the scan
    first_cell: Any  # (n_triangles) 3-vectors i32: of the cells that a box covers
    cell_count: Any  # (n_triangles) 3-vectors i32: along each axis, 0 for large ones
    large: Any  # i32: large triangles, the first count[N_LARGE] entries
    count: Any  # (2) i32
    start: Any  # (n_triangles) i32: rows
    end: Any

    @property
    def size(self) -> tuple[int, int, int]:
        """Cells along each axis."""
        return self.nx, self.ny, self.nz


def grid_size(extent: np.ndarray, cell: float, n_triangles: int) -> tuple[int, int, int]:
    """Return the cells along each axis, powers of two: enough for the extent (3,) [m], but not many more than triangles."""
    max_cells = min(MAX_CELLS, max(512, CELLS_PER_TRIANGLE * n_triangles))
    bits = [max(0, math.ceil(math.log2(min(max(e / cell, 1.0), 2.0**20)))) for e in extent]
    while sum(bits) > math.log2(max_cells):
        bits[bits.index(max(bits))] -= 1
    return tuple(2**b for b in bits)


@ti.func
def _cells_of(s: ti.template(), g: ti.template(), t, inverse):
    """First wrapped cell of a triangle's box, and the number it covers along each axis; (0, 0, 0) for a large one."""
    lo, hi = s.lo[t], s.hi[t]
    count = ivec(0)
    farthest = ti.cast(0.0, ti.f64)
    cells = ti.cast(1.0, ti.f64)
    for q in ti.static(range(3)):
        farthest = ti.max(farthest, ti.max(ti.abs(lo[q]), ti.abs(hi[q])) * inverse)
        # the same floors as for the corner of an overlap, so that no cell is missed
        cells *= ti.min(ti.floor(hi[q] * inverse) - ti.floor(lo[q] * inverse) + 1.0, ti.cast(g.size[q], ti.f64))
    first = ivec(0)
    if farthest < COUNTABLE and cells <= LARGE:
        first = cell_of(lo, inverse, g.size)
        for q in ti.static(range(3)):
            span = ti.floor(hi[q] * inverse) - ti.floor(lo[q] * inverse) + 1.0
            count[q] = ti.cast(ti.min(span, ti.cast(g.size[q], ti.f64)), ti.i32)
    return first, count


@ti.func
def _index(g: ti.template(), cell):
    return (cell[0] * g.size[1] + cell[1]) * g.size[2] + cell[2]


@ti.func
def _bucket(g: ti.template(), first, count, k):
    """Index in memory of the k-th cell of a box."""
    cell = first + ivec(k // (count[2] * count[1]), (k // count[2]) % count[1], k % count[2])
    return _index(g, cell & ivec(g.size[0] - 1, g.size[1] - 1, g.size[2] - 1))  # sizes are powers of two


@kernel
def count_cells(s: ti.template(), g: ti.template(), inverse: ti.f64):
    """Find the cells of each active triangle, count the entries of each cell, list the large triangles."""
    ti.loop_config(serialize=s.serial)
    for c in range(g.n_cells):
        g.cell_end[c] = 0
    ti.loop_config(serialize=s.serial)
    for i in range(s.count[ACTIVE]):
        t = s.active[i]
        first, count = _cells_of(s, g, t, inverse)
        g.first_cell[t] = first
        g.cell_count[t] = count
        for k in range(count[0] * count[1] * count[2]):
            ti.atomic_add(g.cell_end[_bucket(g, first, count, k)], 1)
    ti.loop_config(serialize=True)
    for _ in range(1):
        n = 0
        for j in range(s.count[ACTIVE]):
            t = s.active[j]
            if g.cell_count[t][0] == 0:
                g.large[n] = t
                n += 1
        g.count[N_LARGE] = n


@kernel
def scan_cells(s: ti.template(), g: ti.template()):
    """Compute cell_start as the prefix sums of the counts in cell_end, and set cell_end to the same."""
    ti.loop_config(serialize=s.serial)
    for task in range(SCAN * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            total = 0
            for k in range(part_first(c, g.n_cells, SCAN), part_first(c + 1, g.n_cells, SCAN)):
                total += g.cell_end[k]
            g.scan[c] = total
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for k in range(SCAN):
            n = g.scan[k]
            g.scan[k] = total
            total += n
        g.count[N_ENTRIES] = total
    ti.loop_config(serialize=s.serial)
    for task in range(SCAN * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            total = g.scan[c]
            for k in range(part_first(c, g.n_cells, SCAN), part_first(c + 1, g.n_cells, SCAN)):
                n = g.cell_end[k]
                g.cell_start[k] = total
                g.cell_end[k] = total
                total += n


@kernel
def scatter_cells(s: ti.template(), g: ti.template(), member: ti.template()):
    """Write the active triangles into their cells; the order within a cell depends on the threads."""
    ti.loop_config(serialize=s.serial)
    for i in range(s.count[ACTIVE]):
        t = s.active[i]
        first, count = g.first_cell[t], g.cell_count[t]
        for k in range(count[0] * count[1] * count[2]):
            member[ti.atomic_add(g.cell_end[_bucket(g, first, count, k)], 1)] = t


@ti.func
def _is_pair(s: ti.template(), t, u):
    """1 if two triangles' boxes overlap and they may touch."""
    found = 0  # axis by axis: the first one separates most boxes
    if u != t and s.lo[t][0] <= s.hi[u][0] and s.lo[u][0] <= s.hi[t][0]:
        if s.lo[t][1] <= s.hi[u][1] and s.lo[u][1] <= s.hi[t][1]:
            if s.lo[t][2] <= s.hi[u][2] and s.lo[u][2] <= s.hi[t][2]:
                found = may_touch(s, t, u)
    return found


@kernel
def find_rows(s: ti.template(), g: ti.template(), member: ti.template(), out: ti.template()):
    """Write each active triangle's row, sorted; each chunk fills its own part of the entries."""
    ti.loop_config(serialize=s.serial)
    for t in range(s.n_triangles):
        g.start[t] = 0
        g.end[t] = 0
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, last = c * out.part, (c + 1) * out.part
            for i in range(part_first(c, s.count[ACTIVE], s.chunks), part_first(c + 1, s.count[ACTIVE], s.chunks)):
                t = s.active[i]
                begin = at
                own = s.body[t]
                self_on = s.self_on[own]
                first, count = g.first_cell[t], g.cell_count[t]
                for k in range(count[0] * count[1] * count[2]):
                    bucket = _bucket(g, first, count, k)
                    for e in range(g.cell_start[bucket], g.cell_end[bucket]):
                        u = member[e]
                        if s.body[u] != own or self_on == 1:
                            if _is_pair(s, t, u) == 1:
                                if _index(g, ti.select(s.lo[t] >= s.lo[u], first, g.first_cell[u])) == bucket:
                                    if at < last:
                                        out.data[at] = u
                                    at += 1
                for j in range(ti.select(count[0] == 0, s.count[ACTIVE], g.count[N_LARGE])):
                    u = ti.select(count[0] == 0, s.active[j], g.large[j])
                    if _is_pair(s, t, u) == 1:
                        if at < last:
                            out.data[at] = u
                        at += 1
                if at <= last:
                    g.start[t] = begin
                    g.end[t] = at
                    sort_row(out.data, begin, at)
            out.used[c] = at - c * out.part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(out)


class SpatialHash:
    """Broad phase by a dense grid. cell: edge length of the cells [m]; may be changed at any time."""

    def __init__(
        self,
        surface: Surface,
        arena: FieldArena,
        cell: float,
        extent: np.ndarray,
        capacity: int | None = None,
        max_capacity: int | None = None,
    ):
        """extent: typical extent (3,) [m]. capacity, max_capacity: initial and maximum entries; None for the default."""
        self.surface, self.cell, n = surface, cell, max(surface.n_triangles, 1)
        size = grid_size(extent, cell, surface.n_triangles)
        cells = size[0] * size[1] * size[2]
        counts = {"cell_start": cells, "cell_end": cells, "scan": SCAN, "large": n, "count": 2, "start": n, "end": n}
        fields = {name: arena.field(f"hash_{name}", ti.i32, count) for name, count in counts.items()}
        fields |= {name: arena.vectors(f"hash_{name}", ti.i32, n) for name in ("first_cell", "cell_count")}
        self.grid = Grid(*size, cells, **fields)
        self.members = Buffer("hash_cells", entries, capacity or 8 * n + 64, max_capacity, 1, arena)
        self.rows = Buffer("hash_rows", entries, capacity or ENTRIES_PER_TRIANGLE * n + 64, max_capacity, surface.chunks, arena)

    def find(self) -> Candidates:
        """Return the candidates of the present boxes. Raise SimulationError if a buffer would outgrow its limit."""
        s, g, inverse = self.surface, self.grid, 1.0 / self.cell
        count_cells(s, g, inverse)
        scan_cells(s, g)
        self.members.count[0] = g.count[N_ENTRIES]
        self.members.grow_if_full()
        scatter_cells(s, g, self.members.data)
        while True:
            find_rows(s, g, self.members.data, self.rows.parts)
            if not self.rows.grow_if_full():
                return Candidates(g.start, g.end, self.rows.data)

    near = find  # queries read the rows

    @property
    def buffers(self) -> tuple[Buffer, ...]:
        """The growing buffers."""
        return self.members, self.rows

    def release(self) -> None:
        """Free the memory of the buffers."""
        for buffer in self.buffers:
            buffer.release()
