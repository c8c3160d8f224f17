"""Read TetGen's pair of text files: NAME.node holds the vertices, NAME.ele the tets.

Source: the TetGen manual, "File formats". Each file is a header line of counts followed by rows; # begins a comment.
Vertices count from 0 or 1, the first number in NAME.node. Attributes and boundary markers are skipped.
"""

from pathlib import Path

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.content import read_content


def read_tetgen(file: Path) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """Return points (n,3) and one block of tets with 4 or 10 nodes, indices from 0. file: either of the two.

    Raises MeshError.
    """
    header, rows = _table(file.with_suffix(".node"), "vertices")
    if header[1] != 3:
        raise MeshError(f"{file.with_suffix('.node')}: vertices must have 3 coordinates, not {header[1]}")
    first = _as_integers(rows[:, :1], file.with_suffix(".node"))[0, 0] if len(rows) else 0
    if first not in (0, 1):
        raise MeshError(f"{file.with_suffix('.node')}: vertices must count from 0 or 1, not from {first}")
    header, tets = _table(file.with_suffix(".ele"), "tets")
    kind = {4: "tetra", 10: "tetra10"}.get(header[1])
    if kind is None:
        raise MeshError(f"{file.with_suffix('.ele')}: tets must have 4 or 10 nodes, not {header[1]}")
    return rows[:, 1:4], [(kind, _as_integers(tets[:, 1 : 1 + header[1]], file.with_suffix(".ele")) - first)]


def _table(file: Path, what: str) -> tuple[list[int], np.ndarray]:
    """Return the header line as integers, and the declared rows, 1 + header[1] numbers each."""
    try:
        text = read_content(file).decode("utf-8", "replace")
    except MeshError as error:
        raise MeshError(f"{error}; TetGen's files come in pairs") from error
    lines = [(i, words) for i, line in enumerate(text.splitlines(), 1) if (words := line.split("#")[0].split())]
    if not lines:
        raise MeshError(f"{file}: the file is empty")
    number, words = lines[0]
    try:
        header = [int(word) for word in words]
    except ValueError:
        header = []
    if len(header) < 2 or header[0] < 0 or header[1] < 0:
        raise MeshError(f"{file}: line {number}: not a supported mesh: expected the counts of TetGen's format")
    if header[0] > len(lines) - 1:
        last, found = lines[-1][0], len(lines) - 1
        raise MeshError(f"{file}: line {last}: {header[0]} {what} were declared, but the file ends after {found}")
    n_columns = 1 + header[1]
    widest = max((len(words) for _, words in lines[1 : header[0] + 1]), default=0)
    rows = np.empty((header[0], min(n_columns, widest)))
    for k, (number, words) in enumerate(lines[1 : header[0] + 1]):
        try:
            if len(words) < n_columns:
                raise ValueError
            rows[k] = [float(word) for word in words[:n_columns]]
        except ValueError:
            raise MeshError(f"{file}: line {number}: expected {n_columns} numbers") from None
    return header, rows


def _as_integers(values: np.ndarray, file: Path) -> np.ndarray:
    bad = np.argwhere(~((np.floor(values) == values) & (np.abs(values) < 2.0**53)))
    if len(bad):
        raise MeshError(f"{file}: row {bad[0, 0]}: {values[tuple(bad[0])]:g} is not a whole number")
    return values.astype(np.int64)
