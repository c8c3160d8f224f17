"""Read .obj and .off files, both text by lines.

meshio refuses .obj files with fewer texture coordinates than positions, and of .off files it knows neither polygons and colours
nor headers such as COFF or OFF8.
Sources: Wavefront Advanced Visualizer manual, appendix B1; Geomview manual, "OFF Files".
"""

import re

import numpy as np

from taisoft.errors import MeshError, one_line
from taisoft.mesh.safe_reading import content_lines
from taisoft.mesh.words import to_float, to_int

HEAD = re.compile(r"(?:ST)?C?N?OFF(\d*)$")  # of .off; some programs write no space before the counts


def read_obj(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return positions and polygons, (1,k) each, of a Wavefront file."""
    points, polygons = [], []
    for number, words in content_lines(name, data):
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                points.append((to_float(x), to_float(y), to_float(z)))
            elif words[0] == "f":
                corners = [to_int(word.split("/", 1)[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners or max(map(abs, corners)) > len(data):
                    raise ValueError
                polygons.append(np.array([[k - 1 if k > 0 else len(points) + k for k in corners]]))
        except ValueError:
            rule = "v and three coordinates, or f and at least 3 corners"
            raise MeshError(f"{name}: line {number}: expected {rule}, not {one_line(' '.join(words))!r}") from None
    return np.array(points, dtype=np.float64).reshape(-1, 3), polygons


def read_off(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return positions and polygons, (1,k) each, of an Object File Format file.

    OFF, counts of vertices and faces, then one line each. Data after a position or a face, such as colours, are skipped.
    """
    (number, words), *rows = content_lines(name, data)
    head = HEAD.match(words[0])
    if not head:
        raise MeshError(f"{name}: line {number}: not a supported surface: expected OFF, not {one_line(words[0])!r}")
    counts = [*filter(None, head.groups()), *words[1:]]
    if not counts and rows:
        (number, counts), *rows = rows
    try:
        n_points, n_faces = to_int(counts[0]), to_int(counts[1])
        if min(n_points, n_faces) < 0:
            raise ValueError
    except (ValueError, IndexError):
        raise MeshError(f"{name}: line {number}: expected the counts of vertices and faces") from None
    if n_points + n_faces > len(rows):
        raise MeshError(f"{name}: line {number} declares {n_points} vertices and {n_faces} faces, but {len(rows)} lines follow")
    points, polygons = [], []
    for number, words in rows[: n_points + n_faces]:
        try:
            if len(points) < n_points:
                x, y, z = words[:3]
                points.append((to_float(x), to_float(y), to_float(z)))
                continue
            n_corners = to_int(words[0])
            corners = [to_int(word) for word in words[1 : 1 + n_corners]]
            if n_corners < 3 or len(corners) < n_corners:
                raise ValueError
        except ValueError:
            what = "three coordinates" if len(points) < n_points else "a number of at least 3 corners and as many vertices"
            raise MeshError(f"{name}: line {number}: expected {what}, not {one_line(' '.join(words))!r}") from None
        missing = [corner for corner in corners if not 0 <= corner < n_points]
        if missing:
            raise MeshError(f"{name}: line {number}: vertex {missing[0]} does not exist ({n_points} vertices)")
        polygons.append(np.array([corners]))
    return np.array(points, dtype=np.float64).reshape(-1, 3), polygons
