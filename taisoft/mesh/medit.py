"""Read Medit's text files (.mesh): words in which line breaks mean nothing.

meshio reads them line by line and refuses files with other sections than it knows. Elements become blocks with their
references; other known sections are skipped, unknown words refused with their line.
Source: Frey 2001, MEDIT, INRIA RT-0253; libMeshb, whose table of keywords meshio holds.
"""

import re

import numpy as np
from meshio.medit._medit_internal import medit_codes

from taisoft.mesh.safe_reading import Blocks, FileContent
from taisoft.mesh.words import Words

REFERENCE = "medit:ref"  # meshio's name of the elements' references

_FORMATS = {name.removeprefix("Gmf"): columns for name, _, columns in medit_codes.values()} | {"Hexaedra": 9 * "i"}
_KINDS = {  # meshio's names, as far as taisoft knows them; others keep Medit's
    "Edges": "line",
    "EdgesP2": "line3",
    "Triangles": "triangle",
    "TrianglesP2": "triangle6",
    "Quadrilaterals": "quad",
    "Tetrahedra": "tetra",
    "TetrahedraP2": "tetra10",
    "Prisms": "wedge",
    "Pyramids": "pyramid",
    "Hexahedra": "hexahedron",
    "Hexaedra": "hexahedron",
}
_ELEMENTS = re.compile(r"(Edges|Triangles|Quadrilaterals|Tetrahedra|Prisms|Pyramids|Hexahedra|Hexaedra)([PQ]\d)?$")
_SKIPPED = re.compile(  # sections that libMeshb does not list
    r"(Required|Parallel|Cracked|Equivalent)[A-Z]\w*|SubDomain(FromMesh)?|(Vertex|Edge)OnGeometric(Vertex|Edge)|Geometry|Identifier"
    r"|MeshSupportOfVertices|TangentAtEdges|MaximalAngleOfCorner|HVertices|MetricVertices|Colors"
)


def read_medit(name: str, data: bytes) -> FileContent:
    """Return points, elements and their references. name: the file's, for messages. Raises MeshError."""
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    words = Words(name, re.sub(rb'"[^"\n]*"|#[^\n]*', b" ", data))
    if words.next("MeshVersionFormatted") != "MeshVersionFormatted":
        raise words.error(f"not a supported mesh: expected MeshVersionFormatted, not {words.quoted(0)}")
    if words.count() > 4:
        raise words.error(f"expected version 1 to 4, not {words.quoted(1)}")
    points, blocks, references, dimension, notes = None, Blocks(), [], 0, []
    while words.left():
        keyword = words.next("a keyword")
        at = words.at - 1
        if keyword == "End":
            break
        if keyword == "Dimension":
            dimension = words.count()
            if dimension != 3:
                raise words.error(f"expected Dimension 3, not {dimension}")
        elif keyword == "Vertices":
            if dimension != 3 or points is not None:
                raise words.error("expected Vertices once, after Dimension", at)
            points = words.floats(4 * words.count()).reshape(-1, 4)[:, :3]
        elif _ELEMENTS.match(keyword) and keyword in _FORMATS:
            columns = len(_FORMATS[keyword])
            rows = words.ints(columns * words.count()).reshape(-1, columns)
            n_points = 0 if points is None else len(points)
            bad = np.argwhere((rows[:, :-1] < 1) | (rows[:, :-1] > n_points))
            if len(bad):
                at = words.at - rows.size + int(bad[0] @ (columns, 1))
                raise words.error(f"expected vertices from 1 to {n_points}, not {words.quoted(at)}", at)
            blocks.append((_KINDS.get(keyword, keyword), rows[:, :-1] - 1))
            references.append(rows[:, -1])
        elif keyword in _FORMATS or _SKIPPED.fullmatch(keyword):
            words.skip_numbers()
        else:
            raise words.error(f"expected a keyword of Medit's format, not {words.quoted(at)}", at)
    else:
        notes.append("the keyword End is missing, so the file may have been cut off")
    if points is None:
        raise words.error("expected Vertices before the file's end")
    return FileContent(points, blocks, {REFERENCE: references} if blocks else {}, notes=notes)
