"""Candidates by spatial hashing over a dense grid (report, section 3.1.4; Teschner et al. 2003, Vision, Modeling, Visualization).

Each triangle is entered into the cells that its swept box covers; then each searches its cells.
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
from taisoft.backend.lists import (
    Lists,
    add_up_counts,
    clear_counts,
    count_entry,
    make_lists,
    part_first,
    place_of_entry,
    sort_range,
)
from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import NEEDED, Buffer, Candidates, entries, fill, sum_parts
from taisoft.collision.surface import ACTIVE, Surface, cell_of, ivec, may_touch

LARGE = 512  # cells above which a triangle counts as large
COUNTABLE = 2.0**50  # cells from the origin beyond which f64 cannot distinguish neighbouring cells
MAX_CELLS = 2**22
CELLS_PER_TRIANGLE = 2
ENTRIES_PER_TRIANGLE = 24  # row entries, initial capacity
N_LARGE = 0  # index into Grid.count


@dataclass(frozen=True, eq=False)
class Grid:
    """Fields of the grid."""

    nx: Count  # cells along each axis
    ny: Count
    nz: Count
    n_cells: Count
    cells: Lists  # members of each cell
    first_cell: Any  # (n_triangles) 3-vectors i32: of the cells that a box covers
    cell_count: Any  # (n_triangles) 3-vectors i32: along each axis, 0 for large ones
    large: Any  # i32: large triangles, the first count[N_LARGE] entries
    count: Any  # (1) i32
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
def _cells_of(surface: ti.template(), grid: ti.template(), t, inverse):
    """First wrapped cell of a triangle's box, and the number it covers along each axis; (0, 0, 0) for a large one."""
    lo, hi = surface.lo[t], surface.hi[t]
    count = ivec(0)
    farthest = ti.cast(0.0, ti.f64)
    cells = ti.cast(1.0, ti.f64)
    for q in ti.static(range(3)):
        farthest = ti.max(farthest, ti.max(ti.abs(lo[q]), ti.abs(hi[q])) * inverse)
        # the same floors as for the corner of an overlap, so that no cell is missed
        cells *= ti.min(ti.floor(hi[q] * inverse) - ti.floor(lo[q] * inverse) + 1.0, ti.cast(grid.size[q], ti.f64))
    first = ivec(0)
    if farthest < COUNTABLE and cells <= LARGE:
        first = cell_of(lo, inverse, grid.size)
        for q in ti.static(range(3)):
            span = ti.floor(hi[q] * inverse) - ti.floor(lo[q] * inverse) + 1.0
            count[q] = ti.cast(ti.min(span, ti.cast(grid.size[q], ti.f64)), ti.i32)
    return first, count


@ti.func
def _index(grid: ti.template(), cell):
    return (cell[0] * grid.size[1] + cell[1]) * grid.size[2] + cell[2]


@ti.func
def _bucket(grid: ti.template(), first, count, k):
    """Index in memory of the k-th cell of a box."""
    cell = first + ivec(k // (count[2] * count[1]), (k // count[2]) % count[1], k % count[2])
    return _index(grid, cell & ivec(grid.size[0] - 1, grid.size[1] - 1, grid.size[2] - 1))  # sizes are powers of two


@kernel
def list_cells(surface: ti.template(), grid: ti.template(), members: ti.template(), inverse: ti.f64):
    """Find the cells of each active triangle and where the list of each cell starts; list the large triangles, in
    any order.

    members: buffer of the triangles by cell, whose needed size is set.
    """
    clear_counts(grid.cells, grid.n_cells)
    grid.count[N_LARGE] = 0
    ti.loop_config(serialize=surface.serial)
    for i in range(surface.count[ACTIVE]):
        t = surface.active[i]
        first, count = _cells_of(surface, grid, t, inverse)
        grid.first_cell[t] = first
        grid.cell_count[t] = count
        for k in range(count[0] * count[1] * count[2]):
            count_entry(grid.cells, _bucket(grid, first, count, k))
        if count[0] == 0:
            grid.large[ti.atomic_add(grid.count[N_LARGE], 1)] = t
    add_up_counts(grid.cells, grid.n_cells)
    ti.loop_config(serialize=True)
    for _ in range(1):
        members.count[NEEDED] = grid.cells.start[grid.n_cells + 1]


@ti.func
def _n_active(surface: ti.template(), members: ti.template()):
    """The number of active triangles; 0 if they do not fit into their cells, so that the search is repeated."""
    return ti.select(members.count[NEEDED] <= members.part, surface.count[ACTIVE], 0)


@kernel
def fill_cells(surface: ti.template(), grid: ti.template(), members: ti.template()):
    """Write the active triangles into their cells; the order within a cell depends on the threads."""
    ti.loop_config(serialize=surface.serial)
    for i in range(_n_active(surface, members)):
        t = surface.active[i]
        first, count = grid.first_cell[t], grid.cell_count[t]
        for k in range(count[0] * count[1] * count[2]):
            members.data[place_of_entry(grid.cells, _bucket(grid, first, count, k))] = t


@ti.func
def _is_pair(surface: ti.template(), t, u):
    """1 if two triangles' boxes overlap and they may touch."""
    found = 0  # axis by axis: the first one separates most boxes
    if u != t and surface.lo[t][0] <= surface.hi[u][0] and surface.lo[u][0] <= surface.hi[t][0]:
        if surface.lo[t][1] <= surface.hi[u][1] and surface.lo[u][1] <= surface.hi[t][1]:
            if surface.lo[t][2] <= surface.hi[u][2] and surface.lo[u][2] <= surface.hi[t][2]:
                found = may_touch(surface, t, u)
    return found


@kernel
def find_rows(surface: ti.template(), grid: ti.template(), members: ti.template(), out: ti.template()):
    """Write each active triangle's row, sorted; each chunk fills its own part of the entries."""
    ti.loop_config(serialize=surface.serial)
    for t in range(surface.n_triangles):
        grid.start[t] = 0
        grid.end[t] = 0
    ti.loop_config(serialize=surface.serial)
    for task in range(surface.chunks * surface.spread):
        if task % surface.spread == 0:
            c = task // surface.spread
            at, last, n = c * out.part, (c + 1) * out.part, _n_active(surface, members)
            for i in range(part_first(c, n, surface.chunks), part_first(c + 1, n, surface.chunks)):
                t = surface.active[i]
                begin = at
                own = surface.body[t]
                self_on = surface.self_on[own]
                first, count = grid.first_cell[t], grid.cell_count[t]
                for k in range(count[0] * count[1] * count[2]):
                    bucket = _bucket(grid, first, count, k)
                    for e in range(grid.cells.start[bucket], grid.cells.start[bucket + 1]):
                        u = members.data[e]
                        if surface.body[u] != own or self_on == 1:
                            if _is_pair(surface, t, u) == 1:
                                if _index(grid, ti.select(surface.lo[t] >= surface.lo[u], first, grid.first_cell[u])) == bucket:
                                    if at < last:
                                        out.data[at] = u
                                    at += 1
                for j in range(ti.select(count[0] == 0, surface.count[ACTIVE], grid.count[N_LARGE])):
                    u = ti.select(count[0] == 0, surface.active[j], grid.large[j])
                    if _is_pair(surface, t, u) == 1:
                        if at < last:
                            out.data[at] = u
                        at += 1
                if at <= last:
                    grid.start[t] = begin
                    grid.end[t] = at
                    sort_range(out.data, begin, at)
            out.used[c] = at - c * out.part
    sum_parts(surface.team, out)


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
        n_cells = size[0] * size[1] * size[2]
        counts = {"large": n, "count": 1, "start": n, "end": n}
        fields = {name: arena.field(f"hash_{name}", ti.i32, count) for name, count in counts.items()}
        fields |= {name: arena.vectors(f"hash_{name}", ti.i32, n) for name in ("first_cell", "cell_count")}
        self.grid = Grid(*size, n_cells, make_lists(arena, "hash_cell", n_cells, surface.serial), **fields)
        self.members = Buffer("hash_cells", entries, capacity or 8 * n + 64, max_capacity, 1, arena)
        self.rows = Buffer("hash_rows", entries, capacity or ENTRIES_PER_TRIANGLE * n + 64, max_capacity, surface.chunks, arena)

    def search(self) -> Candidates:
        """Return the candidates of the present boxes, for queries; they are some of them only if a buffer is full."""
        surface, grid = self.surface, self.grid
        list_cells(surface, grid, self.members.parts, 1.0 / self.cell)
        fill_cells(surface, grid, self.members.parts)
        find_rows(surface, grid, self.members.parts, self.rows.parts)
        return Candidates(grid.start, grid.end, self.rows.data)

    def near(self) -> Candidates:
        """Do as `search`, until they fit. Raise SimulationError if a buffer would outgrow its limit."""
        fill(self.search, *self.buffers)
        return Candidates(self.grid.start, self.grid.end, self.rows.data)

    @property
    def buffers(self) -> tuple[Buffer, ...]:
        """The growing buffers."""
        return self.members, self.rows

    def release(self) -> None:
        """Free the memory of the buffers."""
        for buffer in self.buffers:
            buffer.release()
