"""Ranges of consecutive items, such as the entries of a sparse matrix's rows, without loops over them."""

import numpy as np


def owners(counts) -> np.ndarray:
    """Return the range (n,) that each item belongs to, if range k has counts[k] items."""
    return np.repeat(np.arange(len(counts)), counts)


def expand(starts: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the range (n,) that each item belongs to, and the items (n,): starts[k], starts[k] + 1, ... counts[k] of them."""
    owner = owners(counts)
    return owner, np.arange(len(owner)) + (starts - (np.cumsum(counts) - counts))[owner]


def entries_of(start: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the indices of all entries of some rows, row by row. start: (n + 1) first index of each row."""
    return expand(start[rows], start[rows + 1] - start[rows])[1]
