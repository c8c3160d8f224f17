"""Nested dicts and lists of plain values and arrays: as JSON, or parted into what JSON can hold and a flat dict of arrays."""

import base64
import json
import zlib

import numpy as np

PACKED = "array, zlib, base64"  # key of a dict that stands for an array in JSON
ARRAY = "array of this file"  # key of a dict that stands for an array; its value is the array's name


def part_arrays(value, arrays: dict[str, np.ndarray], name: str = ""):
    """Return a nested value with {ARRAY: name} in place of its arrays, which are added to `arrays`, equal objects once.

    name: of the value; those of its entries are name/key, or name/#i for keys that are no words.
    """
    if isinstance(value, np.ndarray):
        kept = next((known for known, array in arrays.items() if array is value), name)
        arrays[kept] = value
        return {ARRAY: kept}
    start = f"{name}/" if name else ""
    if isinstance(value, dict):
        words = [key if key.isidentifier() or key.isdecimal() else f"#{i}" for i, key in enumerate(value)]
        return {key: part_arrays(inner, arrays, start + word) for (key, inner), word in zip(value.items(), words)}
    if isinstance(value, list):
        return [part_arrays(inner, arrays, f"{start}{i}") for i, inner in enumerate(value)]
    return value


def join_arrays(value, arrays: dict[str, np.ndarray]):
    """Return the nested value that `part_arrays` parted. Raises KeyError for an array that is missing."""
    if isinstance(value, dict):
        return arrays[value[ARRAY]] if ARRAY in value else {key: join_arrays(inner, arrays) for key, inner in value.items()}
    return [join_arrays(inner, arrays) for inner in value] if isinstance(value, list) else value


def pack(array: np.ndarray, level: int = 1) -> dict:
    """Return an array as plain data, losslessly. level: of compression, 0 for none."""
    data = zlib.compress(np.ascontiguousarray(array).tobytes(), level)
    return {"dtype": array.dtype.str, "shape": array.shape, PACKED: base64.b64encode(data).decode()}


def unpack(value: dict) -> np.ndarray | dict:
    """Return the array of `pack`, and any other dict as it is. Raises ValueError for invalid data."""
    if PACKED not in value:
        return value
    try:
        data = zlib.decompress(base64.b64decode(value[PACKED], validate=True))
        return np.frombuffer(data, dtype=value["dtype"]).reshape(value["shape"]).copy()
    except (zlib.error, KeyError, TypeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


def to_json(value, level: int = 1, sort_keys: bool = False) -> str:
    """Return a nested value as JSON on one line. level: see `pack`. Raises TypeError for values that are not plain."""

    def plain(inner):
        if isinstance(inner, np.generic):
            return inner.item()
        if isinstance(inner, np.ndarray):
            return pack(inner, level)
        raise TypeError(f"JSON cannot hold a {type(inner).__name__}")

    return json.dumps(value, default=plain, sort_keys=sort_keys)


def from_json(text: str | bytes):
    """Return the nested value of `to_json`. Raises ValueError."""
    return json.loads(text, object_hook=unpack)
