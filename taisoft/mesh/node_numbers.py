"""What readers of files with numbered nodes share: Abaqus's and Nastran's."""

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.safe_reading import FileContent


def indices(name: str, numbers: dict[int, int], rows: list[tuple[int, list[int]]]) -> np.ndarray:
    """Return cells (k,nodes) as indices. numbers: index by number of a node; rows: line and numbers of each cell's nodes."""
    try:
        return np.array([[numbers[node] for node in nodes] for _, nodes in rows], dtype=np.int64)
    except KeyError:
        line, node = next((line, node) for line, nodes in rows for node in nodes if node not in numbers)
        raise MeshError(f"{name}: line {line}: node {node} does not exist ({len(numbers)} nodes)") from None


def axes_from_points(origin: np.ndarray, on_first: np.ndarray, in_plane: np.ndarray) -> np.ndarray | None:
    """Return right-handed unit axes (3,3), in rows, from points: the second on the first axis, the third in the plane of both.

    None if the points are in line.
    """
    first = on_first - origin
    third = np.cross(first, in_plane - origin)
    lengths = np.linalg.norm(first), np.linalg.norm(third)
    if not (0.0 < min(lengths) and max(lengths) < np.inf):
        return None
    first, third = first / lengths[0], third / lengths[1]
    return np.array([first, np.cross(third, first), third])


def merged(contents: list[FileContent]) -> FileContent:
    """Return points and cells of all contents in one."""
    shifts = np.cumsum([0, *(len(one.points) for one in contents)]).tolist()
    cells = [(kind, nodes + shift) for one, shift in zip(contents, shifts) for kind, nodes in one.cells]
    return FileContent(np.concatenate([one.points for one in contents]), cells)
