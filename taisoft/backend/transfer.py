"""Copy arrays between a simulator and NumPy."""

import numpy as np

from taisoft.backend.arrays import Array


def upload(pairs: list[tuple[Array, np.ndarray]]) -> None:
    """Copy data into arrays of the same shape. Raises ValueError for a wrong shape, before anything is written."""
    for array, data in pairs:
        array.check(data)
    for array, data in pairs:
        array.from_numpy(data)


def download(arrays: list[Array], rows: int | None = None) -> list[np.ndarray]:
    """Copy arrays to NumPy; only the first `rows` rows if given."""
    return [array.to_numpy(rows) for array in arrays]
