"""Lower bound of the memory traffic of steps, and the bandwidth of a memory copy.

A loop over the mesh must read each input array once and write each output array once: this lower bound follows from the sizes of
the fields. Repeated reads, partly used cache lines and fetches before writes are not counted. A small mesh in the caches can
exceed a copy; 100 % of a copy means that a step is limited by memory. LOOPS lists what each loop reads and writes. A sweep over
contacts reads the numbers of every contact, and reads and writes its impulse and the velocities `w` of the nodes.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel, open_runtime, threads

from .runner import repeated

ELEMENTS = ("x", "nodes", "Dm_inv", "volume", "block_body")
GATHER = ("element_force", "gather_start", "gather_entry", "mass", "free")
PCG = ("pcg_y", "pcg_r", "pcg_z", "pcg_p", "pcg_q")
MATRIX = ("stiffness_value", "stiffness_column", "stiffness_row_start")
EDGES = tuple(f"stiffness_{name}" for name in ("element", "edge_start", "edge_entry", "edge_upper", "edge_lower"))
PROBLEM = tuple(f"problem_{name}" for name in ("node", "arity", "weight", "normal", "tangent", "b", "friction", "factor", "r"))
LOOPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {  # reads, writes
    # an explicit step
    "drift": (("x", "v", "acceleration"), ("x", "v")),
    "elements": (ELEMENTS, ("element_force",)),
    "nodes": ((*GATHER, "v"), ("v", "acceleration")),
    "update": ((*GATHER, "x", "v"), ("x", "v")),
    # an implicit one
    "residual": ((*GATHER, "x", "x_hat", "v_hat"), ("change", "residual", "pcg_rhs")),
    "blocks": (ELEMENTS, ("stiffness_element",)),
    "edges": (EDGES, ("stiffness_value",)),
    "system": (("stiffness_value", "mass"), ("stiffness_value", "stiffness_diagonal")),
    "iteration": ((*MATRIX, "pcg_inverse", "pcg_block", "pcg_mirror", *PCG), PCG),
    # a search: boxes of triangles, and those of a tree or the cells of a grid
    "boxes": (("surface_triangle", "surface_x", "surface_move"), ("surface_lo", "surface_hi", "surface_normal", "surface_area")),
    "tree": (("surface_lo", "surface_hi", "bvh_link"), ("bvh_lo", "bvh_hi")),
    "cells": (("surface_lo", "surface_hi"), ("hash_first_cell", "hash_cell_count")),
    # a sweep over as many contacts as the buffers hold
    "sweep": (PROBLEM, ("problem_r",)),
}
GROUPS = ("elements and nodes", "matrix", "search", "contacts")
COPY_BYTES, COPY_ROUNDS = 2**28, 7  # size of one of the two arrays, larger than any cache
WIDTH = 16  # numbers that the kernel copies at a time


@dataclass(frozen=True)
class Copy:
    """A memory copy. rate: bytes read and written per second."""

    by: str
    threads: int
    rate: float


def floor_bytes(loops: Iterable[str], field_bytes: Mapping[str, int]) -> float:
    """Lower bound of the bytes that these loops read and write. Raises KeyError for an absent field."""
    return float(sum(field_bytes[name] for loop in loops for names in LOOPS[loop] for name in names))


def group_bytes(sim: ts.Simulator) -> dict[str, int]:
    """Bytes of the simulator's fields by GROUPS."""
    search = sim._dynamics.contact.detection.field_bytes if sim._dynamics.contact else {}
    contacts = (sim._dynamics.contact.field_bytes if sim._dynamics.contact else {}) | sim._dynamics.stepper.field_bytes
    found = dict.fromkeys(GROUPS, 0)
    for name, size in sim.field_bytes.items():
        group = "search" if name in search else "contacts" if name in contacts else GROUPS[name.startswith("stiffness_")]
        found[group] += size
    return found


# --- the copy ---------------------------------------------------------------------------------------------------------


@kernel
def copy_field(source: ti.template(), target: ti.template(), serial: ti.template()):
    """target = source."""
    ti.loop_config(serialize=serial)
    for i in range(source.shape[0]):
        target[i] = source[i]


def measure_copy(arch: str, n_bytes: int = COPY_BYTES) -> list[Copy]:
    """The best of several copies by NumPy and by a kernel, on one thread and on all; on CUDA by a kernel alone."""
    runtime, arena = open_runtime(arch, "f32", "the benchmark of scaling"), FieldArena()
    try:
        source, target = (arena.vectors(name, ti.f32, n_bytes // (4 * WIDTH), n=WIDTH) for name in ("source", "target"))
        if arch == "cuda":
            return [Copy("Taichi", threads(), _best(n_bytes, lambda: copy_field(source, target, 0)))]
        a, b, n = np.zeros(n_bytes // 4, np.float32), np.ones(n_bytes // 4, np.float32), threads()
        parts = list(zip(np.array_split(a, n), np.array_split(b, n)))
        with ThreadPoolExecutor(n) as pool:  # NumPy copies without the interpreter's lock
            return [
                Copy("NumPy", 1, _best(n_bytes, lambda: np.copyto(a, b))),
                Copy("NumPy", n, _best(n_bytes, lambda: list(pool.map(lambda part: np.copyto(*part), parts)))),
                Copy("Taichi", 1, _best(n_bytes, lambda: copy_field(source, target, 1))),
                Copy("Taichi", n, _best(n_bytes, lambda: copy_field(source, target, 0))),
            ]
    finally:
        arena.release()
        runtime.close()


def _best(n_bytes: int, call: Callable[[], object]) -> float:
    call()  # compiles, or allocates pages
    return 2 * n_bytes / min(repeated(call, COPY_ROUNDS, math.inf))


def copy_rate(copies: Iterable[Copy], n_threads: int) -> float:
    """The best copy [bytes/s] on at most as many threads."""
    return max(copy.rate for copy in copies if copy.threads <= n_threads)
