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

RULES = {"v": "v and three coordinates", "vt": "vt and one or two numbers"}  # of .obj
RULES["f"] = "f and at least 3 corners, all or none of them with a vt"
HEAD = re.compile(r"(?:ST)?C?N?OFF(\d*)$")  # of .off; some programs write no space before the counts


def read_obj(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray] | None, dict[str, list[int]]]:
    """Return positions, polygons, (1,k) each, their UVs, (1,k,2) each, and subsets of polygons by name, of a Wavefront file.

    UVs are NaN at polygons without any, and None if none has some. Subsets are those of `usemtl`, else of `g`, else of `o`.
    """
    lines = content_lines(name, data)
    points, polygons, texture, rows, n = [], [], [], [], sum(words[0] == "vt" for _, words in lines)  # rows of texture; n: none
    current, members = dict.fromkeys(("usemtl", "g", "o"), ""), {"usemtl": {}, "g": {}, "o": {}}
    for number, words in lines:
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                points.append((to_float(x), to_float(y), to_float(z)))
            elif words[0] == "vt":
                u, v = (*words[1:3], "0")[:2]
                texture.append((to_float(u), to_float(v)))
            elif words[0] in current:
                current[words[0]] = " ".join(words[1:])
            elif words[0] == "f":
                parts = [word.split("/", 2) for word in words[1:]]
                corners = [to_int(part[0]) for part in parts]
                given = [to_int(part[1]) for part in parts if len(part) > 1 and part[1]]
                if len(corners) < 3 or len(given) not in (0, len(corners)) or 0 in corners or max(map(abs, corners)) > len(data):
                    raise ValueError
                for k in given:
                    if not -len(texture) <= k <= n or k == 0:
                        raise MeshError(f"{name}: line {number}: vt {k} does not exist ({n} are given)")
                for kind, called in current.items():
                    if called:
                        members[kind].setdefault(called, []).append(len(polygons))
                polygons.append(np.array([[k - 1 if k > 0 else len(points) + k for k in corners]]))
                rows += [k - 1 if k > 0 else len(texture) + k for k in given or [n + 1] * len(corners)]
        except ValueError:
            raise MeshError(f"{name}: line {number}: expected {RULES[words[0]]}, not {one_line(' '.join(words))!r}") from None
    uvs = None
    if rows and min(rows) < n:
        ends = np.cumsum([one.shape[1] for one in polygons])
        uvs = np.split(np.array([*texture, (np.nan, np.nan)])[None, rows], ends[:-1], axis=1)
    return np.array(points, dtype=np.float64).reshape(-1, 3), polygons, uvs, next((of for of in members.values() if of), {})


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
