"""Read TetGen's files: meshio knows neither comments nor tets of ten nodes.

Every count is checked against the file's content before memory is allocated, and errors name their line.
Source: the TetGen manual, "File formats".
Weak: attributes are skipped, so a mesh has no regions.
"""

from pathlib import Path

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.safe_reading import FileContent, content_lines, read_content
from taisoft.mesh.words import MAX_EXACT_INT, to_float, to_int


def read_tetgen(file: Path) -> FileContent:
    """Return points (n,3) and one block of tets with 4 or 10 nodes. file: NAME.node (vertices) or NAME.ele (tets).

    Each file is a header line of counts followed by rows. Vertices count from 0 or 1, the first number in NAME.node.
    Attributes and boundary markers are skipped. Raises MeshError.
    """
    node, ele = file.with_suffix(".node"), file.with_suffix(".ele")
    rows = _tetgen_rows(node, "vertices", "3 coordinates", (3,))
    first = _whole(rows[:1, 0], node)[0] if len(rows) else 0
    if first not in (0, 1):
        raise MeshError(f"{node}: row 0: vertices must count from 0 or 1, not from {first}")
    tets = _tetgen_rows(ele, "tets", "4 or 10 nodes", (4, 10))
    return FileContent(rows[:, 1:], [("tetra" if tets.shape[1] == 5 else "tetra10", _whole(tets[:, 1:], ele) - first)])


def _tetgen_rows(file: Path, what: str, rule: str, allowed: tuple[int, ...]) -> np.ndarray:
    """Return the rows that the header declares, a number and then as many as the header's second count, one of `allowed`."""
    try:
        lines = content_lines(str(file), read_content(file))
    except MeshError as error:
        raise MeshError(f"{error}; TetGen's files come in pairs") from error
    try:
        n_rows, n_columns = [to_int(word) for word in lines[0][1]][:2]
        if min(n_rows, n_columns) < 0:
            raise ValueError
    except ValueError:
        raise MeshError(f"{file}: line {lines[0][0]}: not a supported mesh: expected the counts of TetGen's format") from None
    if n_columns not in allowed:
        raise MeshError(f"{file}: line {lines[0][0]}: {what} must have {rule}, not {n_columns}")
    last, found = lines[-1][0], len(lines) - 1
    if n_rows > found:
        raise MeshError(f"{file}: line {last}: {n_rows} {what} were declared, but the file ends after {found}")
    rows = np.empty((n_rows, 1 + n_columns))
    for row, (number, words) in zip(rows, lines[1:]):
        try:
            if len(words) <= n_columns:
                raise ValueError
            row[:] = [to_float(word) for word in words[: 1 + n_columns]]
        except ValueError:
            raise MeshError(f"{file}: line {number}: expected {1 + n_columns} numbers") from None
    return rows


def _whole(values: np.ndarray, file: Path) -> np.ndarray:
    bad = np.argwhere((np.floor(values) != values) | ~(np.abs(values) < MAX_EXACT_INT))
    if len(bad):
        raise MeshError(f"{file}: row {bad[0, 0]}: {values[tuple(bad[0])]:g} is not a whole number")
    return values.astype(np.int64)
