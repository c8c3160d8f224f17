"""Arrays of a simulator into NumPy's and back."""

import numpy as np

from taisoft.arrays import Array


def upload(pairs: list[tuple[Array, np.ndarray]]) -> None:
    """pairs: an array, and numbers of its shape. Raises ValueError for another shape, before anything is written."""
    for array, data in pairs:
        array.check(data)
    for array, data in pairs:
        array.from_numpy(data)


def download(arrays: list[Array], rows: int | None = None) -> list[np.ndarray]:
    """Copies, of the first `rows` rows if that is given."""
    return [array.to_numpy(rows) for array in arrays]
