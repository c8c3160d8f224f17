"""Directions of the fibres in the tets of a mesh."""

from collections.abc import Callable

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.regions import as_array

FIBRES = ("fibres", "fibers")  # names of the cell data that hold them in files


def checked_fibres(values, n_tets: int, error: Callable[[str], MeshError]) -> np.ndarray | None:
    """Return a copy (m,3) float64 of the directions of all tets; None for None. error: makes an error of its text."""
    if values is None:
        return None
    array = as_array(values, "fibres", "numbers", error)
    if array.dtype.kind not in "fiu" or array.shape != (n_tets, 3):
        raise error(f"fibres must be numbers of shape ({n_tets}, 3), one row for each tet, not {array.dtype} of {array.shape}")
    return np.array(array, dtype=np.float64)
