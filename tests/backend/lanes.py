"""3x3 matrices into test kernels and out of them: blocks of SIMD lanes, as the package keeps them."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

from taisoft.backend.runtime import Runtime, open_runtime


@contextmanager
def opened(precision: str, arch: str = "cpu") -> Iterator[Runtime]:
    """A runtime of that precision, for a while."""
    machine = open_runtime(arch, precision, "a test")
    try:
        yield machine
    finally:
        machine.close()


@ti.func
def load(A: ti.template(), b, lanes: ti.template(), count: ti.template()):
    """Block b of A (blocks, count, lanes) as a list of lane vectors."""
    return [ti.Vector([A[b, k, q] for q in ti.static(range(lanes))]) for k in ti.static(range(count))]


@ti.func
def store(A: ti.template(), b, first: ti.template(), values, lanes: ti.template()):
    """A list of lane vectors into the components of block b of A from `first` on."""
    for k in ti.static(range(len(values))):
        for q in ti.static(range(lanes)):
            A[b, first + k, q] = values[k][q]


def packed(values: np.ndarray, lanes: int, dtype) -> np.ndarray:
    """(k, ...) as (blocks, components, lanes); the last entry is repeated where lanes are left over."""
    rows = np.asarray(values).reshape(len(values), -1)
    rows = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % lanes, axis=0)])
    return np.ascontiguousarray(rows.reshape(-1, lanes, rows.shape[1]).transpose(0, 2, 1).astype(dtype))


def unpacked(blocks: np.ndarray, count: int) -> np.ndarray:
    """(blocks, components, lanes) as (count, components) float64."""
    return blocks.transpose(0, 2, 1).reshape(-1, blocks.shape[1])[:count].astype(np.float64)
