"""Values of a scene file: what is stored of records and chosen nodes, and how TOML writes it."""

import dataclasses

import numpy as np

from taisoft.scene.body import Body
from taisoft.scene.tables import key_path, key_text, quote

MAX_LINE = 100  # maximum number of characters of numbers in a line


def fields_of(record) -> dict:
    """Return the fields of a record that are not None."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return {key: value for key, value in values.items() if value is not None}


def ids_of(ids: np.ndarray, n: int) -> str | np.ndarray:
    """Return the ids of some of n items, "all" for all."""
    return "all" if np.array_equal(ids, np.arange(n)) else ids


def nodes_of(body: Body, nodes: np.ndarray) -> dict:
    """Return the entry of nodes that a method chose; none for those of a rigid body's tet, which stand for its centre."""
    rows = body.selectable
    return {} if nodes.max() < rows.start else {"nodes": ids_of(nodes - rows.start, rows.stop - rows.start)}


def toml_of(tables: dict) -> str:
    """Return nested dicts as TOML: numbers, booleans, strings, lists, arrays, dicts, and lists of dicts."""
    return "\n".join(_lines(tables, "")).lstrip("\n") + "\n"


def _lines(table: dict, place: str) -> list[str]:
    subtables = {key: value for key, value in table.items() if isinstance(value, dict) or _is_tables(value)}
    lines = [
        f"{key_text(key)} = {_toml(value)}"
        for key, value in table.items()
        if key not in subtables and not (isinstance(value, list) and not value)
    ]
    for key, value in subtables.items():
        path = key_path(place, key)
        for subtable in value if isinstance(value, list) else [value]:
            header = f"[[{path}]]" if isinstance(value, list) else f"[{path}]"
            inner = _lines(subtable, path)
            # a table that contains only tables needs no header
            lines += inner if not isinstance(value, list) and inner[:1] == [""] else ["", header, *inner] if inner else []
    return lines


def _is_tables(value) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _toml(value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return quote(value)
    if isinstance(value, (int, float)):
        return repr(value)
    entries = value.tolist() if isinstance(value, np.ndarray) else value
    if entries and isinstance(entries[0], list):
        return "".join(["[", *(f"\n  {_toml(row)}," for row in entries), "\n]"])
    lines = [""]
    for text in map(_toml, entries):
        if lines[-1] and len(lines[-1]) + len(text) > MAX_LINE:
            lines.append("")
        lines[-1] += f"{text}, "
    return f"[{lines[0][:-2]}]" if len(lines) == 1 else "".join(["[", *(f"\n  {line[:-1]}" for line in lines), "\n]"])
