"""Regions of a tetrahedral mesh: a whole number for each tet, and names for these numbers. They say where which material is."""

import difflib
from collections import Counter
from collections.abc import Callable

import numpy as np

from taisoft.errors import MeshError, listed, one_line, value_text

LARGEST_ID = 2**31 - 1  # of a region: mesh files hold 32-bit integers
FIBRES = ("fibres", "fibers")  # names of cell data in files that hold the directions of fibres


def as_array(values, what: str, kinds: str, error: Callable[[str], MeshError]) -> np.ndarray:
    """Return values as an array. kinds: what it should hold; error: makes an error of its text."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError, OverflowError) as reason:
        raise error(f"{what} must be an array of {kinds}: {one_line(str(reason))}") from reason


def checked_regions(values, n_tets: int, error: Callable[[str], MeshError]) -> np.ndarray | None:
    """Return a copy (m,) int64 of the regions of all tets; None for None. error: makes an error of its text."""
    if values is None:
        return None
    array = as_array(values, "regions", "integers", error)
    if array.dtype.kind not in "iu":
        raise error(f"regions must be integers, not of type {array.dtype}")
    if array.shape != (n_tets,):
        raise error(f"regions must have shape ({n_tets},), one for each tet, not {array.shape}")
    bad = np.flatnonzero(np.abs(array.astype(np.float64)) > LARGEST_ID)
    if len(bad):
        raise error(f"tet {bad[0]}: region {array[bad[0]]} does not fit into 32 bits")
    return array.astype(np.int64)


def checked_names(names, ids: tuple[int, ...], error: Callable[[str], MeshError]) -> dict[int, str]:
    """Return a copy of the names, {id: name} by ascending id. ids: the regions of a mesh, ascending."""
    if names is not None and not isinstance(names, dict):
        raise error(f"region_names must be a dict of names by region, not {value_text(names)}")
    if not names:
        return {}
    if not ids:
        raise error("region_names are given without regions")
    present = set(ids)
    numbers = {str(region) for region in present}  # as scene files write regions without names
    found: dict[int, str] = {}
    taken: set[str] = set()
    for key, name in names.items():
        if isinstance(key, bool) or not isinstance(key, (int, np.integer)) or int(key) not in present:
            raise error(f"region_names: no tet is in region {value_text(key)}")
        if not isinstance(name, str) or not _is_name(name):
            raise error(f"region_names: the name of region {key} must be a line of text without quotes, not {value_text(name)}")
        if name in taken:
            raise error(f"region_names: {value_text(name)} is the name of two regions")
        if name in numbers and name != str(key):
            raise error(f"region_names: {value_text(name)}, the name of region {key}, is the number of another region")
        found[int(key)] = name
        taken.add(name)
    return dict(sorted(found.items()))


def usable_names(given: dict[int, str], ids: list[int]) -> tuple[dict[int, str], list[str]]:
    """Return names of some of the regions `ids`, ascending, that a mesh can have, and a warning if they differ from given ones.

    given: of any regions, from a file; single surrogates stand for bytes that are not UTF-8. Blank names are left out.
    """
    printable, changes = {}, []
    for region in ids:
        text = given.get(region, "")
        try:
            text.encode()
        except UnicodeEncodeError:
            text = text.encode("utf-8", "surrogateescape").decode("latin-1")
        if not _is_name(text):
            text = " ".join("".join(c if c.isprintable() and c != '"' else " " for c in text).split())
        if text:
            printable[region] = text
    shared, numbers, names = Counter(printable.values()), {str(region) for region in ids}, {}
    for region, text in printable.items():
        if shared[text] > 1 or (text in numbers and text != str(region)):
            text = f"{text} ({region})"
            while text in shared:
                text += "'"
        names[region] = text
    for region in ids:
        old, new = given.get(region, ""), names.get(region)
        if new != old and old.strip():
            becomes = "without a name" if new is None else f"called {value_text(new)}"
            changes.append(f"region {region} is {becomes} instead of {value_text(old)}")
    rule = "names of regions must be different lines of UTF-8 text, and not numbers of other regions"
    return names, [f"{rule}: {listed(changes, 3)}"] if changes else []


def _is_name(text: str) -> bool:
    return bool(text.strip()) and text.isprintable() and '"' not in text


def region_id(key, region_of: dict[int | str, int], error: Callable[[str], MeshError]) -> int:
    """Return the id of a region given by its name or id. region_of: the ids by ids and by names."""
    if not region_of:
        raise error("the mesh has no regions")
    if isinstance(key, (str, int, np.integer)) and not isinstance(key, bool) and key in region_of:
        return region_of[key]
    names = {region: name for name, region in region_of.items() if isinstance(name, str)}
    there_are = listed([one_line(region_text(region, names)) for region in region_of if not isinstance(region, str)])
    if not isinstance(key, str):
        raise error(f"no tet is in region {value_text(key)}; there are {there_are}")
    near = difflib.get_close_matches(key, names.values(), n=1)
    hint = f"did you mean {value_text(near[0])}?" if near else f"there are {there_are}"
    raise error(f"no region is called {value_text(key)}; {hint}")


def region_text(region: int, names: dict[int, str]) -> str:
    """Return a region's name in quotes, or its id."""
    return repr(names[region]) if region in names else str(region)
