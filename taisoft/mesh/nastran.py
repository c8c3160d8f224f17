"""Read Nastran bulk data (.bdf, .nas, .fem): nodes, in any coordinate systems, and tets.

meshio ignores coordinate systems, and cards in lower case or in the large format of elements.
Source: MSC Nastran quick reference guide, "Format of bulk data entries", GRID, GRDSET, CORD1R to CORD2S, CTETRA.
Weak: of elements other than tets only the number is read.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from meshio.nastran._nastran import nastran_to_meshio_type

from taisoft.mesh.node_numbers import LineReader, axes_from_points, blocks
from taisoft.mesh.safe_reading import FileContent
from taisoft.mesh.words import last_line, to_int

PROPERTY = "nastran:ref"  # meshio's name of the elements' property numbers
REFUSED = {"INCLUDE": "its entries out", "GRIDA": "GRID"}  # and what to write in place of it
MAX_DEPTH = 100  # of coordinate systems defined in one another
_SYSTEM = re.compile(r"CORD[12][RCS]")


class _Card(NamedTuple):
    """An entry: its first line, its name, and its fields from the second on, stripped."""

    line: int
    name: str
    fields: list[str]


@np.errstate(over="ignore", invalid="ignore")  # too large coordinates are refused later
def read_nastran(name: str, data: bytes) -> FileContent:
    """Return points, cells and the tets' property numbers. name: the file's, for messages. Raises MeshError."""
    return _Reader(name, data).content()


class _Reader(LineReader):
    def __init__(self, name: str, data: bytes):
        super().__init__(name)
        self._data = data
        self.systems: dict[int, _Card] = {}
        self.nodes: dict[int, tuple[int, int, np.ndarray]] = {}  # line, system and coordinates by number
        self.frames: dict[int, tuple[str, np.ndarray, np.ndarray]] = {0: ("R", np.eye(3), np.zeros(3))}  # kind, axes, origin

    def content(self) -> FileContent:
        tets: dict[str, list[tuple[int, list[int]]]] = {}
        properties: dict[str, list[int]] = {}
        others: dict[str, int] = {}
        default, elements = 0, set()  # of fields CP; numbers of tets
        cards = list(self._cards())
        for card in cards:
            if card.name == "GRDSET":
                default = self._int(card, 1, 0)
            elif card.name in REFUSED:
                raise self.error(card.line, f"{card.name} is not supported: write {REFUSED[card.name]}")
        for card in cards:
            if card.name == "GRID":
                number, x = self._int(card, 0), np.array([self._float(card, k) for k in (2, 3, 4)])
                if number in self.nodes:
                    raise self.error(card.line, f"expected the number of a new node, not {number}")
                self.nodes[number] = card.line, self._int(card, 1, default), x
            elif _SYSTEM.fullmatch(card.name):
                for first in (0, 4) if card.name[4] == "1" and any(card.fields[4:]) else (0,):  # CORD1R may hold two
                    own = card._replace(fields=card.fields[first:])
                    self.systems[self._int(own, 0)] = own
            elif card.name == "CTETRA":
                ids = [self._int(card, k) for k in range(2, len(card.fields))]
                if len(ids) not in (4, 10):
                    raise self.error(card.line, f"expected 4 or 10 nodes of CTETRA, not {len(ids)}")
                if (number := self._int(card, 0)) in elements:
                    raise self.error(card.line, f"expected the number of a new element, not {number}")
                elements.add(number)
                kind = "tetra" if len(ids) == 4 else "tetra10"
                tets.setdefault(kind, []).append((card.line, ids))
                properties.setdefault(kind, []).append(self._int(card, 1, 0))
            elif card.name in nastran_to_meshio_type:
                kind = nastran_to_meshio_type[card.name]
                others[kind] = others.get(kind, 0) + 1
        points = np.array([self._placed(*node) for node in self.nodes.values()]).reshape(-1, 3)
        index = {number: k for k, number in enumerate(self.nodes)}
        cells = blocks(self.name, index, tets, others)
        data = [np.array(properties.get(kind, [0] * len(nodes)), dtype=np.int64) for kind, nodes in cells]
        return FileContent(points, cells, {PROPERTY: data})

    def _cards(self) -> Iterator[_Card]:
        """Yield the entries between BEGIN BULK, if it is there, and ENDDATA; $ begins a comment."""
        text = self._data.decode("utf-8", "replace").splitlines()
        lines = [(k, line.split("$", 1)[0].rstrip()) for k, line in enumerate(text, 1)]
        begin = next((k for k, line in lines if re.fullmatch(r"\s*BEGIN(\s+BULK)?", line, re.IGNORECASE)), 0)
        card = None
        for number, line in lines[begin:]:
            if not line:
                continue
            head, fields = _fields(line)
            if line.count(",") > len(fields) + 1:
                raise self.error(number, f"expected at most {len(fields) + 2} fields in a line")
            if head[:1] in ("", "+", "*"):
                if card is None:
                    raise self.error(number, "not a supported mesh: expected an entry such as GRID, not its continuation")
                card.fields.extend(fields)
                continue
            if card is not None:
                yield _cut(card)
            if head == "ENDDATA":
                return
            if not re.fullmatch(r"[A-Z]\w*[* ]*", head, re.ASCII):
                raise self.error(number, f"not a supported mesh: expected the name of an entry, such as GRID, not {head[:40]!r}")
            card = _Card(number, head.rstrip("* "), fields)
        if begin:
            raise self.error(last_line(self._data), "expected ENDDATA before the file's end")
        if card is not None:
            yield _cut(card)

    def _int(self, card: _Card, k: int, blank: int | None = None) -> int:
        text = card.fields[k] if k < len(card.fields) else ""
        if not text and blank is not None:
            return blank
        try:
            return to_int(text)
        except ValueError:
            text = f"expected a whole number in field {k + 2} of {card.name}, not {text[:40]!r}"
            raise self.error(card.line, text) from None

    def _float(self, card: _Card, k: int) -> float:
        text = card.fields[k] if k < len(card.fields) else ""
        text = re.sub(r"(?<=[\d.])([+-]\d+)$", r"e\1", text)  # 7.0-1 is 0.7
        return self.finite(card.line, [text], f"a number in field {k + 2} of {card.name}")[0]

    def _placed(self, line: int, system: int, x: np.ndarray) -> np.ndarray:
        """Return coordinates of a system in the basic one."""
        kind, axes, origin = self._frame(line, system, ())
        if kind == "C":
            x = np.array([x[0] * np.cos(np.radians(x[1])), x[0] * np.sin(np.radians(x[1])), x[2]])
        elif kind == "S":
            theta, phi = np.radians(x[1:])
            x = x[0] * np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        return x @ axes + origin

    def _frame(self, line: int, system: int, above: tuple[int, ...]) -> tuple[str, np.ndarray, np.ndarray]:
        """Return kind, axes and origin of a coordinate system in the basic one. above: those that are defined by it."""
        if system in self.frames:
            return self.frames[system]
        card = self.systems.get(system)
        if card is None or system in above or len(above) > MAX_DEPTH:
            rule = "not in terms of itself or too many others" if card else "such as CORD2R"
            raise self.error(line, f"expected a definition of coordinate system {system}, {rule}")
        above = (*above, system)
        if card.name[4] == "1":
            numbers = [self._int(card, k) for k in (1, 2, 3)]
            if missing := [number for number in numbers if number not in self.nodes]:
                raise self.error(card.line, f"node {missing[0]} does not exist ({len(self.nodes)} nodes)")
            given = [self.nodes[number] for number in numbers]
        else:
            rows = np.array([self._float(card, k) for k in range(2, 11)]).reshape(3, 3)
            given = [(card.line, self._int(card, 1, 0), x) for x in rows]
        for line, other, _ in given:
            self._frame(line, other, above)
        origin, on_z, in_xz = (self._placed(*one) for one in given)
        axes = axes_from_points(origin, on_z, in_xz)
        if axes is None:
            raise self.error(card.line, f"expected three points of {card.name} that are not in line")
        z, x, y = axes
        self.frames[system] = card.name[5], np.array([x, y, z]), origin
        return self.frames[system]


def _fields(line: str) -> tuple[str, list[str]]:
    """Return the first field in capitals and the fields after it: eight, or four of the large format, without the last one."""
    if "," in line:
        head, *fields = (word.strip() for word in line.split(","))
        n = 4 if "*" in head else 8
    else:
        line = line.expandtabs(8)
        head, n = line[:8].strip(), 4 if "*" in line[:8] else 8
        fields = [line[at : at + 64 // n].strip() for at in range(8, 72, 64 // n)]
    return head.upper(), (fields + n * [""])[:n]


def _cut(card: _Card) -> _Card:
    """Return a card without blank fields at its end."""
    fields = card.fields
    while fields and not fields[-1]:
        fields.pop()
    return card
