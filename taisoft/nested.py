"""Nested dicts and lists of plain values and arrays, parted into what JSON can hold and a flat dict of arrays."""

import numpy as np

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
