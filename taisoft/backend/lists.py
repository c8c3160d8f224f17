"""Lists of entries by key, made in kernels; prefix sums and parts of ranges; a hash of three integers.

The lists of n keys lie behind one another in an array of entries: that of key k is start[k] to start[k + 1]. They are made in
four passes: `clear_counts`; `count_entry` for each entry; `add_up_counts`; each entry is stored at `place_of_entry`. Entries keep
the order in which one thread stores them. On several threads their order is arbitrary until `sort_lists`.

`clear_counts`, `add_up_counts` and `sort_lists` are top-level loops of a kernel.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.paths import gpu_threads, on_gpu_path

# Taichi gives each CPU thread at least 512 iterations of a loop: each chunk takes that many, and only the first does the work
CPU_SPREAD = 512
CPU_PARTS, GPU_PARTS = 64, 1024  # of the counts, that are added up in parallel


@dataclass(frozen=True, eq=False)
class Lists:
    """Where lists start, for kernels. While entries are stored, start[k + 1] is the next free place of key k."""

    start: Any  # (keys + 2) i32; the last one is the number of all entries once counts are added up
    sums: Any  # (parts) i32: of the counts
    parts: int
    serial: bool
    spread: int  # loop iterations per part


def spread_on(on_cpu: bool, serial: bool) -> int:
    """Loop iterations per chunk. on_cpu: whether not on the GPU path; serial: whether one thread runs the loop."""
    return CPU_SPREAD if on_cpu and not serial else 1


def make_lists(arena: FieldArena, name: str, n_keys: int, serial: bool) -> Lists:
    """Allocate lists of up to n_keys keys."""
    parts = 1 if serial else gpu_threads(GPU_PARTS) if on_gpu_path() else CPU_PARTS
    spread = spread_on(not on_gpu_path(), serial)
    start, sums = (arena.field(f"{name}_{what}", ti.i32, n) for what, n in (("start", n_keys + 2), ("sums", parts)))
    return Lists(start, sums, parts, serial, spread)


@ti.func
def part_first(c, n, parts: ti.template()):
    """Return the start of part c of a list of n entries divided into equal parts."""
    return c * (n // parts) + ti.min(c, n % parts)


@ti.func
def sum_before(numbers: ti.template(), c):
    """Return the sum of the first c numbers. Many threads that sum take less time than one that stores prefix sums."""
    total = 0
    for k in range(c):
        total += numbers[k]
    return total


@ti.func
def clear_counts(lists: ti.template(), n_keys):
    """Begin lists of n_keys keys."""
    ti.loop_config(serialize=lists.serial)
    for k in range(n_keys + 2):
        lists.start[k] = 0


@ti.func
def keys_if(go, n_keys):
    """Return the number of keys with which these loops do nothing if go is 0, n_keys if it is 1."""
    return go * (n_keys + 2) - 2


@ti.func
def count_entry(lists: ti.template(), key):
    """Count an entry of a key."""
    ti.atomic_add(lists.start[key + 2], 1)


@ti.func
def count_entries(lists: ti.template(), key, n):
    """Count n entries of a key that only one thread counts."""
    lists.start[key + 2] += n


@ti.func
def add_up_counts(lists: ti.template(), n_keys):
    """Find where the lists start."""
    if ti.static(lists.parts > 1):
        for task in range(lists.parts * lists.spread):
            if task % lists.spread == 0:
                c, total = task // lists.spread, 0
                for k in range(part_first(c, n_keys + 2, lists.parts), part_first(c + 1, n_keys + 2, lists.parts)):
                    total += lists.start[k]
                lists.sums[c] = total
    ti.loop_config(serialize=lists.serial)
    for task in range(lists.parts * lists.spread):
        if task % lists.spread == 0:
            c = task // lists.spread
            total = sum_before(lists.sums, c)
            for k in range(part_first(c, n_keys + 2, lists.parts), part_first(c + 1, n_keys + 2, lists.parts)):
                total += lists.start[k]
                lists.start[k] = total


@ti.func
def place_of_entry(lists: ti.template(), key):
    """Return where to store the next entry of a key."""
    return ti.atomic_add(lists.start[key + 1], 1)


@ti.func
def sort_lists(lists: ti.template(), n_keys, entry: ti.template()):
    """Sort each list: not on one thread, which has stored its entries in order."""
    if ti.static(not lists.serial):
        for k in range(n_keys):
            sort_range(entry, lists.start[k], lists.start[k + 1])


@ti.func
def sort_range(entry: ti.template(), first, last):
    """Sort entry[first:last] in place by Shell sort: ranges are mostly short, but not always."""
    step = 1
    while step < (last - first) // 9:
        step = 3 * step + 1
    while step > 0:
        for i in range(first + step, last):
            value = entry[i]
            j = i - step
            while j >= first and entry[ti.max(j, first)] > value:
                entry[j + step] = entry[j]
                j -= step
            entry[j + step] = value
        step //= 3


@ti.func
def bucket_of(a, b, c, mask):
    """Bucket of three integers, one of mask + 1, a power of two. Source: Teschner et al. 2003."""
    x, y, z = ti.cast(a, ti.i64), ti.cast(b, ti.i64), ti.cast(c, ti.i64)
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return ti.cast((h ^ (h >> 15)) & mask, ti.i32)
