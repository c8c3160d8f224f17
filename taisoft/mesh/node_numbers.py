"""What readers of files with numbered nodes share: Abaqus's and Nastran's."""

import math

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.safe_reading import Blocks, FileContent
from taisoft.mesh.words import to_float


class LineReader:
    """What readers of lines need. name: the file's, for messages."""

    def __init__(self, name: str):
        self.name = name

    def error(self, line: int, text: str) -> MeshError:
        return MeshError(f"{self.name}: line {line}: {text}")

    def finite(self, line: int, words: list[str], rule: str) -> list[float]:
        """Return words as finite numbers; a blank is 0. rule: what is expected, for messages."""
        try:
            found = [to_float(word or "0") for word in words]
        except ValueError:
            found = []
        if found and all(map(math.isfinite, found)):
            return found
        rule = "finite numbers" if found else rule
        raise self.error(line, f"expected {rule}, not {', '.join(words)[:60]!r}")


def blocks(name: str, numbers: dict[int, int], tets: dict[str, list[tuple[int, list[int]]]], others: dict[str, int]) -> Blocks:
    """Return tets as indices, and of other cells only the number.

    numbers: index by number of a node; tets: lines and numbers of nodes by kind; others: counts by kind.
    """
    cells = [(kind, _indices(name, numbers, rows)) for kind, rows in tets.items()]
    return cells + [(kind, np.empty((n, 0), dtype=np.int64)) for kind, n in others.items()]


def _indices(name: str, numbers: dict[int, int], rows: list[tuple[int, list[int]]]) -> np.ndarray:
    """Return cells (k,nodes) as indices. rows: line and numbers of each cell's nodes."""
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
