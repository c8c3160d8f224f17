"""Read .stl files, text and binary.

meshio fails on text in capitals, on names that are not UTF-8, and on binary files whose header begins with "solid" when a byte
is missing. A file is binary if its size is the one that its number of triangles makes, else text if it begins with "solid".
Source: StereoLithography Interface Specification, 3D Systems, 1989. Normals and attributes are not used.
"""

import re

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.topology import merged_points
from taisoft.mesh.words import Words, last_line

HEADER, FACET = 84, 50  # bytes of the header with the number of facets, and of a facet
RULE = "not a supported surface: expected text that begins with solid, or"
_TEXT = re.compile(rb"\s*(solid|facet)\b", re.IGNORECASE)
_END = re.compile(rb"[ \t]*end[ \t]*solid\b", re.IGNORECASE)
_NAMES = re.compile(rb"^[ \t]*(end[ \t]*)?solid\b[^\n]*", re.MULTILINE | re.IGNORECASE)
_FACET = "facet normal n n n outer loop vertex x x x vertex x x x vertex x x x endloop endfacet".split()
_FACET_DTYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return positions (n,3) and an array of triangles (k,3). Raises MeshError."""
    n = int.from_bytes(data[80:HEADER], "little")
    if len(data) != HEADER + FACET * n:
        if _TEXT.match(data) and (b"\0" not in data or b"endfacet" in data[HEADER:].lower()):
            return _read_text(name, data.replace(b"\r\n", b"\n").replace(b"\r", b"\n"))
        if len(data) < HEADER:
            raise MeshError(f"{name}: byte {len(data)}: {RULE} at least {HEADER} bytes")
        raise MeshError(f"{name}: byte 80: {RULE} {HEADER + FACET * n} bytes for {n} triangles, but there are {len(data)}")
    return _shared(np.frombuffer(data, _FACET_DTYPE, n, HEADER)["corners"].reshape(-1, 3).astype(np.float64))


def _read_text(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    words, size = Words(name, _NAMES.sub(b"", data)), len(_FACET)
    n = -(-len(words.words) // size)
    wrong = []
    for k, expected in enumerate(_FACET):
        if expected not in "xn":
            column = (word.lower() == expected.encode() for word in words.words[k::size])
            wrong.append((next((i for i, right in enumerate(column) if not right), n) * size + k, expected))
    at, expected = min(wrong)
    if at < len(words.words):
        raise words.error(f"expected {expected!r}, not {words.quoted(at)}", at)
    if len(words.words) < n * size or not _END.match(data.rstrip().rsplit(b"\n", 1)[-1]):
        expected = _FACET[len(words.words) % size] if len(words.words) % size else "endsolid"
        raise MeshError(f"{name}: line {last_line(data)}: the file ends where {expected!r} should follow")
    corners = [words.numbers(k, n * size, size) for k, expected in enumerate(_FACET) if expected == "x"]
    return _shared(np.array(corners).T.reshape(-1, 3))


def _shared(corners: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the different corners in the order of the file, and triangles of them."""
    first, vertex = merged_points(corners, 0.0)
    return corners[first], [vertex.reshape(-1, 3)]
