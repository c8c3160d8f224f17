"""Read Abaqus input files (.inp): nodes and tets of the model, and of its parts where their instances place them.

meshio keeps the last *NODE block alone and knows neither *SYSTEM nor parts and instances. Keywords that make, move or import
nodes or elements in other ways are refused by name; those of sets, analysis and output say nothing of the mesh.
Source: Abaqus keyword reference; Abaqus analysis guide, "Node definition" and "Assembly definition".
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from meshio.abaqus._abaqus import abaqus_to_meshio_type
from scipy.spatial.transform import Rotation

from taisoft.mesh.node_numbers import LineReader, axes_from_points, blocks, merged
from taisoft.mesh.safe_reading import FileContent
from taisoft.mesh.words import to_int

REFUSED = dict.fromkeys("NMAP INCLUDE IMPORT IMPERFECTION PARAMETER SYMMETRICMODELGENERATION".split(), "")
REFUSED |= dict.fromkeys(("NGEN", "NFILL", "NCOPY"), ": write its nodes out")
REFUSED |= dict.fromkeys(("ELGEN", "ELCOPY"), ": write its elements out")
USED = {"NODE": ("NSET", "SYSTEM"), "ELEMENT": ("TYPE", "ELSET"), "PART": ("NAME",), "INSTANCE": ("NAME", "PART")}  # and options
WHOLE = [*USED, *REFUSED, *"SYSTEM ENDPART ENDINSTANCE ASSEMBLY ENDASSEMBLY".split()]  # keywords that are not to be abbreviated
TET = re.compile(r"[ADQ]?C3D(4|10)[A-Z]*")
Place = tuple[np.ndarray, np.ndarray]  # matrix (3,3) and shift (3,): x -> matrix @ x + shift
AT_ORIGIN: Place = (np.eye(3), np.zeros(3))


class _Section(NamedTuple):
    """A keyword with its options, in capitals without blanks, and the lines of data that follow it, as words."""

    line: int
    keyword: str
    options: dict[str, str]
    rows: list[tuple[int, list[str]]]


@dataclass
class _Part:
    """The model, or a part.

    numbers: index by number of a node; elements: numbers of tets; tets: lines and nodes by kind; others: counts by type.
    """

    places: list[Place] = field(default_factory=list)
    numbers: dict[int, int] = field(default_factory=dict)
    elements: set[int] = field(default_factory=set)
    points: list[np.ndarray] = field(default_factory=list)
    tets: dict[str, list[tuple[int, list[int]]]] = field(default_factory=dict)
    others: dict[str, int] = field(default_factory=dict)

    def placed(self, name: str) -> list[FileContent]:
        """Return the part at each of its places."""
        points = np.array(self.points).reshape(-1, 3)
        cells = blocks(name, self.numbers, self.tets, self.others)
        return [FileContent(points @ matrix.T + shift, cells) for matrix, shift in self.places]


@np.errstate(over="ignore", invalid="ignore")  # too large coordinates are refused later
def read_abaqus(name: str, data: bytes) -> FileContent:
    """Return points and cells; of cells other than tets only the number. name: the file's, for messages. Raises MeshError."""
    reader = _Reader(name)
    for section in reader.sections(data.decode("utf-8", "replace")):
        reader.add(section)
    model, *parts = reader.parts.values()
    if parts and not any(part.places for part in parts):  # a file without instances
        for part in parts:
            part.places.append(AT_ORIGIN)
    notes = [f"part {key!r} has no *INSTANCE and is left out" for key, part in reader.parts.items() if not part.places]
    return merged([one for part in (model, *parts) for one in part.placed(name)])._replace(notes=notes)


class _Reader(LineReader):
    """part: to which nodes and elements belong, none inside an instance; system: in which nodes are given."""

    def __init__(self, name: str):
        super().__init__(name)
        self.parts, self.system = {"": _Part([AT_ORIGIN])}, AT_ORIGIN
        self.part: _Part | None = self.parts[""]

    def sections(self, text: str) -> Iterator[_Section]:
        """Yield the keywords with their data. A line that begins with two stars is a comment."""
        section, begun = None, ""  # a keyword that goes on in the next line
        for line, row in enumerate(text.splitlines(), 1):
            row = row.strip()
            if not row or row.startswith("**"):
                continue
            if begun or row.startswith("*"):
                begun += row
                if begun.endswith(","):
                    continue
                if section is not None:
                    yield section
                keyword, *options = begun[1:].upper().split(",")
                pairs = (one.partition("=") for one in options)
                options = {"".join(key.split()): " ".join(value.strip(" \t\"'").split()) for key, _, value in pairs}
                section, begun = _Section(line, "".join(keyword.split()), options, []), ""
            elif section is None:
                raise self.error(line, "not a supported mesh: expected a keyword that begins with *")
            else:
                section.rows.append((line, [word.strip() for word in row.split(",")]))
        if begun:
            raise self.error(line, "expected more options after the comma")
        if section is not None:
            yield section

    def add(self, section: _Section) -> None:
        """Take the nodes, elements or place of a section in."""
        key, options = section.keyword, section.options
        if key in REFUSED:
            raise self.error(section.line, f"*{key} is not supported{REFUSED[key]}")
        if key not in WHOLE and len(key) >= 3 and (whole := next((one for one in WHOLE if one.startswith(key)), None)):
            raise self.error(section.line, f"expected the whole keyword *{whole}, not *{key}")
        if wrong := [one for one in options if one and one not in USED.get(key, options)]:
            raise self.error(section.line, f"expected {' or '.join(USED[key])} as option of *{key}, not {wrong[0][:40]!r}")
        if key in ("NODE", "ELEMENT") and self.part is None:
            raise self.error(section.line, f"expected *{key} in the model or a part, not elsewhere")
        if key in ("PART", "ENDPART", "INSTANCE", "ENDINSTANCE"):
            self.system = AT_ORIGIN
        if key == "PART":
            self.part = self.parts[self._option(section, "NAME", known=False)] = _Part()
        elif key == "INSTANCE":
            self.parts[self._option(section, "PART", known=True)].places.append(self._place(section))
            self.part = None
        elif key in ("ENDPART", "ENDINSTANCE", "ASSEMBLY", "ENDASSEMBLY"):
            self.part = self.parts[""]
        elif key == "SYSTEM":
            self.system = self._system(section)
        elif key == "NODE":
            self._add_nodes(section)
        elif key == "ELEMENT":
            self._add_elements(section)

    def _option(self, section: _Section, key: str, known: bool) -> str:
        """Return the name of a part, one from above or a new one."""
        value = section.options.get(key, "")
        if not value or (value in self.parts) != known:
            rule = "the name of a part above" if known else "a new name"
            raise self.error(section.line, f"expected {rule} as {key} of *{section.keyword}, not {value[:40]!r}")
        return value

    def _floats(self, line: int, words: list[str], n: int, what: str) -> list[float]:
        """Return the first n words as numbers; a blank is 0."""
        if len(words) < n:
            raise self.error(line, f"expected {what}, not {', '.join(words)[:60]!r}")
        return self.finite(line, words[:n], what)

    def _ints(self, line: int, words: list[str]) -> list[int]:
        try:
            return [to_int(word) for word in words if word]
        except ValueError:
            raise self.error(line, f"expected whole numbers, not {', '.join(words)[:60]!r}") from None

    def _system(self, section: _Section) -> Place:
        """Return the place of *SYSTEM: the origin, and if there are more points, one on the x axis and one in the xy plane."""
        if not section.rows:
            return AT_ORIGIN
        (line, words), *more = section.rows
        origin = np.array(self._floats(line, words, 3, "the origin of *SYSTEM"))
        if not any(words[3:]) and not more:
            return np.eye(3), origin
        on_x = np.array(self._floats(line, words, 6, "two points of *SYSTEM")[3:])
        line, words = more[0] if more else (line, [])
        in_plane = np.array(self._floats(line, words, 3, "the third point of *SYSTEM"))
        matrix = axes_from_points(origin, on_x, in_plane)
        if matrix is None:
            raise self.error(line, "expected three points of *SYSTEM that are not in line")
        return matrix.T, origin

    def _place(self, section: _Section) -> Place:
        """Return the place of *INSTANCE: a translation, then a rotation [degrees] about an axis through two points."""
        what = "a translation", "two points on an axis and an angle"
        rows = [self._floats(line, words, n, text) for (line, words), n, text in zip(section.rows, (3, 7), what)]
        if len(section.rows) > 2:
            raise self.error(section.rows[2][0], "expected at most two lines of data of *INSTANCE")
        shift = np.array(rows[0]) if rows else np.zeros(3)
        if len(rows) < 2:
            return np.eye(3), shift
        a, b = np.array(rows[1][:3]), np.array(rows[1][3:6])
        length = np.linalg.norm(b - a)
        if not 0.0 < length < np.inf:
            raise self.error(section.rows[1][0], "expected two different points on the axis of *INSTANCE")
        matrix = Rotation.from_rotvec((b - a) / length * rows[1][6], degrees=True).as_matrix()
        return matrix, matrix @ (shift - a) + a

    def _add_nodes(self, section: _Section) -> None:
        if (kind := section.options.get("SYSTEM", "R")) != "R":
            raise self.error(section.line, f"expected SYSTEM=R of *NODE, not {kind[:40]!r}")
        matrix, shift = self.system
        for line, words in section.rows:
            number = self._ints(line, words[:1])
            x = self._floats(line, words[1:], 3, "the number of a node and three coordinates")
            if not number or number[0] in self.part.numbers:
                raise self.error(line, f"expected the number of a new node, not {words[0][:40]!r}")
            self.part.numbers[number[0]] = len(self.part.points)
            self.part.points.append(matrix @ x + shift)

    def _add_elements(self, section: _Section) -> None:
        kind, open_row = section.options.get("TYPE", ""), False
        if not kind:
            raise self.error(section.line, "expected TYPE of *ELEMENT")
        tet = TET.fullmatch(kind)
        if tet is None:
            kind = abaqus_to_meshio_type.get(kind, kind)
            ends = sum(bool(words[-1]) for _, words in section.rows)  # a line that ends with a comma goes on
            self.part.others[kind] = self.part.others.get(kind, 0) + ends
            return
        n_nodes = int(tet[1])
        rows = self.part.tets.setdefault("tetra" if n_nodes == 4 else "tetra10", [])
        for line, words in section.rows:
            numbers = self._ints(line, words)
            if open_row:
                rows[-1][1].extend(numbers)
            else:
                if not numbers or numbers[0] in self.part.elements:
                    raise self.error(line, f"expected the number of a new element, not {words[0][:40]!r}")
                self.part.elements.add(numbers[0])
                rows.append((line, numbers[1:]))
            open_row = words[-1] == "" and len(rows[-1][1]) < n_nodes
            if not open_row and len(rows[-1][1]) != n_nodes:
                raise self.error(line, f"expected the number of an element and {n_nodes} nodes")
        if open_row:
            raise self.error(line, f"expected more nodes of the element, {n_nodes} in all")
