"""Validate values given to meshes, to a scene, and to its `solver` dict: arguments of Simulator, and the run's seconds and fps.

Each check returns the converted value or raises SceneError, or the given error, with one sentence that starts with `what`. The
Simulator itself validates names of integrators and contact solvers and their combinations.
"""

import difflib
import operator
from collections.abc import Callable, Sequence
from numbers import Real

import numpy as np

from taisoft.errors import SceneError, reason, value_text

LARGEST, SMALLEST = float(np.finfo(np.float32).max), float(np.finfo(np.float32).tiny)  # limits of 32-bit floats
UNIT_TOLERANCE = 8 * np.finfo(np.float64).eps  # squared lengths this close to 1 are kept, so vectors read back unchanged
POSITIVE = range(1, 2**31)
MAX_TOLERANCE = {"newton_tolerance": 0.1}  # a residual of a tenth of the forces is no solution; others: 1


def number(value, what: str, *, above=None, minimum=None, maximum=None, below=None, unit: str = "", error=SceneError) -> float:
    """Return value as a finite float in the 32-bit range, > above, >= minimum, <= maximum, < below where given."""
    value = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise error(f"{what} must be a number, not {value_text(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = float("inf")
    if not np.isfinite(result):
        raise error(f"{what} must be finite, not {value_text(value)}")
    rules = [("greater than", operator.gt, above), ("at least", operator.ge, minimum)]
    rules += [("at most", operator.le, maximum), ("below", operator.lt, below)]
    rules = [rule for rule in rules if rule[2] is not None]
    if not all(holds(result, limit) for _, holds, limit in rules):
        rule = " and ".join(f"{words} {limit:g}" for words, _, limit in rules)
        raise error(f"{what} must be {rule}{unit and ' ' + unit}, not {value_text(value)}")
    if abs(result) > LARGEST or (above == 0.0 and result < SMALLEST):
        raise error(f"{what} is {result:g}, too {'large' if abs(result) > 1.0 else 'small'} for a 32-bit float")
    return result


def array(value, what: str, shapes: tuple[tuple[int, ...], ...], error: Callable[[str], Exception] = SceneError) -> np.ndarray:
    """Return a float64 copy of finite numbers in one of the shapes. what: start of the message."""
    shapes_text = " or ".join(str(shape) for shape in shapes)
    numbers_text = "a number" if shapes == ((),) else f"numbers of shape {shapes_text}"
    try:
        result = np.asarray(value)
    except (ValueError, TypeError, OverflowError):
        result = np.empty(0, dtype=object)
    if result.dtype.kind not in "fiu":
        raise error(f"{what} must be {numbers_text}, not {value_text(value)}")
    if result.shape not in shapes and shapes == ((),):
        raise error(f"{what} must be a number, not of shape {result.shape}")
    if result.shape not in shapes:
        raise error(f"{what} must have shape {shapes_text}, not {result.shape}")
    result = np.array(result, dtype=np.float64)
    for rule, bad in (("not finite", ~np.isfinite(result)), ("too large for a 32-bit float", np.abs(result) > LARGEST)):
        if bad.any():
            at = np.argwhere(bad)[0]
            entry = f"{what}: entry {at.tolist()}" if result.ndim else what
            raise error(f"{entry} is {result[tuple(at)]:g}, {rule}")
    return result


def vector(value, what: str, above: float | None = None, error: type[Exception] = SceneError) -> np.ndarray:
    """Return a float64 copy of three finite numbers, > above where given. what: start of the message."""
    result = array(value, what, ((3,),), error)
    if above is not None and not (result > above).all():
        raise error(f"{what} must be greater than {above:g}, not {value_text(value)}")
    return result


def unit(vector: np.ndarray, rule: str) -> np.ndarray:
    """Return the unit vector (3,). Raises SceneError with the rule for a zero or infinite vector."""
    largest = float(np.abs(vector).max())
    if largest == 0.0 or not np.isfinite(largest):
        raise SceneError(rule)
    if largest <= 1.0 and abs(vector @ vector - 1.0) <= UNIT_TOLERANCE:
        return vector.copy()
    scaled = vector / largest
    return scaled / np.linalg.norm(scaled)


def direction(value, what: str) -> np.ndarray:
    """Return a (3,) vector, not zero, as a unit vector."""
    return unit(vector(value, what), f"{what} must not be zero")


def path_value(path: Callable, t: float, what: str, quantity: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray | None:
    """Return what a path, a function of time [s], gives at t, checked as `array` does; None for None.

    what: start of the message, quantity: what it should give.
    """
    try:
        value = path(t)
    except SceneError:  # of a path that names itself
        raise
    except Exception as error:  # a user's function may raise anything
        raise SceneError(f"{what}: the path failed at t = {t:g}: {reason(error)}") from error
    return None if value is None else array(value, f"{what}: the path's {quantity} at t = {t:g}", shapes)


def times(value, what: str) -> np.ndarray:
    """Return ascending times (k,) [s], k > 0."""
    k = value.size if isinstance(value, np.ndarray) else len(value) if hasattr(value, "__len__") else 1
    result = array(value, what, ((max(k, 1),),))
    if (descends := np.diff(result) <= 0.0).any():
        first = int(np.argmax(descends))
        raise SceneError(f"{what} must ascend, but {result[first + 1]:g} follows {result[first]:g}")
    return result


def choice(value, what: str, allowed: Sequence[str], error: type[Exception] = SceneError) -> str:
    """Return value if it is one of the allowed words; otherwise the message suggests the closest one."""
    if isinstance(value, str) and value in allowed:
        return value
    near = difflib.get_close_matches(value.lower(), allowed, n=1) if isinstance(value, str) and len(allowed) > 2 else []
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise error(f"{what} must be one of {', '.join(allowed)}, not {value_text(value)}{hint}")


def nearest(name: str, known) -> str:
    """Return " (did you mean X?)" for the known name closest to `name`, or an empty string."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean {close[0]}?)" if close else ""


def index(name, known: Sequence[str], what: str, error=SceneError) -> int:
    """Return the index of a known name. what: start of the message, such as "robot 'arm': no joint"; or raise the error."""
    if not isinstance(name, str) or name not in known:
        raise error(f"{what} is called {value_text(name)}{nearest(str(name), known)}; there are {', '.join(known) or 'none'}")
    return list(known).index(name)


def flag(value, what: str) -> bool:
    """Return value if it is True or False."""
    if not isinstance(value, bool):
        raise SceneError(f"{what} must be True or False, not {value_text(value)}")
    return value


def whole(value, what: str, allowed: tuple[int, ...] | range = POSITIVE, error: type[Exception] = SceneError) -> int:
    """Return value as an int if it is one of the allowed integers."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or int(value) not in allowed:
        limits = "of at least 1" if allowed is POSITIVE else f"from {allowed[0]} to {allowed[-1]}"
        rule = f"a whole number {limits}" if isinstance(allowed, range) else " or ".join(map(str, allowed))
        raise error(f"{what} must be {rule}, not {value_text(value)}")
    return int(value)


def instance(value, what: str, kind: type, optional: bool = False, error: type[Exception] = SceneError):
    """Return value if it is of a kind, or None where that is allowed."""
    if not isinstance(value, kind) and not (optional and value is None):
        raise error(f"{what} must be a {kind.__name__}{' or None' * optional}, not {type(value).__name__}")
    return value


def text(value, what: str) -> str:
    """Return value if it is a string."""
    if not isinstance(value, str):
        raise SceneError(f"{what} must be a text, not {value_text(value)}")
    return value


def name(value, what: str, taken: list[str]) -> str:
    """Return value if it is a non-blank string that is not in `taken`."""
    if not isinstance(value, str) or not value.strip():
        raise SceneError(f"{what} must be a text that is not empty, not {value_text(value)}")
    if value in taken:
        raise SceneError(f"{what} {value_text(value)} is taken; names must be unique")
    return value


def free_name(value, kind: str, taken: list[str], what: str = "") -> str:
    """Return value as a `name` of a scene's kind of thing, or, if it is None, the first free one of kind0, kind1 and so on.

    what: start of messages, by default that of the scene.
    """
    if value is None:
        value = next(free for free in (f"{kind}{i}" for i in range(len(taken) + 1)) if free not in taken)
    return name(value, what or f"scene: {kind} name", taken)


def axes(value, what: str) -> np.ndarray:
    """Return (3,) bool for a string such as "xz": some of x, y, z, without repetition."""
    if not isinstance(value, str) or not value or set(value) - set("xyz") or len(set(value)) != len(value):
        raise SceneError(f"{what}: axes must be some of 'x', 'y', 'z' without repetition, not {value_text(value)}")
    return np.array([axis in value for axis in "xyz"])


def selection(where, points: np.ndarray, what: str, items: str, *, repeats: bool = True) -> np.ndarray:
    """Return the ids (k,) int64 of the chosen items, k > 0.

    where: ids, a bool mask (n,), or a callable that gets a copy of points (n,3) and returns such a mask. items: singular noun
    for the items. repeats: True drops repeated ids, False refuses them.
    """
    n = len(points)
    if callable(where):
        try:
            mask = np.asarray(where(points.copy()))
        except Exception as error:
            raise SceneError(f"{what}: the selection function failed: {reason(error)}") from error
        if mask.dtype != bool or mask.shape != (n,):
            raise SceneError(
                f"{what}: the selection function must return a bool mask of shape ({n},), not {mask.dtype} of shape {mask.shape}"
            )
        ids = np.flatnonzero(mask)
    else:
        ids = _ids(where, n, what, items)
    if not len(ids):
        raise SceneError(f"{what}: no {items} is chosen")
    distinct, first = np.unique(ids, return_index=True)
    if len(distinct) < len(ids) and not repeats:
        twice = np.setdiff1d(np.arange(len(ids)), first)[0]
        raise SceneError(f"{what}: {items} {ids[twice]} is chosen twice")
    return ids[np.sort(first)]


def _ids(where, n: int, what: str, items: str) -> np.ndarray:
    try:
        ids = np.asarray(where)
    except (ValueError, TypeError, OverflowError) as error:
        raise SceneError(f"{what}: choose by {items} ids, a bool mask or a function, not {value_text(where)}") from error
    if ids.size == 0:
        return np.empty(0, dtype=np.int64)
    if ids.dtype == bool:
        if ids.shape != (n,):
            raise SceneError(f"{what}: a mask must have shape ({n},), not {ids.shape}")
        return np.flatnonzero(ids)
    return item_ids(where, n, what, items)


def item_ids(given, n: int, what: str, items: str) -> np.ndarray:
    """Return ids of some of n items, one or (k,), as (k,) int64. Raises SceneError, also for a mask of integers.

    More than two numbers that are all 0 or 1, or 0 or 255 as in pictures, are a mask: as ids they would repeat two items.
    """
    ids = np.asarray(given)
    has_flag = isinstance(given, (list, tuple)) and any(isinstance(one, (bool, np.bool_)) for one in given)
    if ids.dtype.kind not in "iu" or ids.ndim > 1 or has_flag:
        raise SceneError(f"{what}: {items} ids must be a list of integers, not {value_text(given)}")
    ids = np.atleast_1d(ids)
    for one in (1, 255):
        if ids.size > 2 and np.isin(ids, (0, one)).all():
            raise SceneError(f"{what}: {ids.size} {items} ids that are all 0 or {one} are a mask: give it as bool")
    bad = np.flatnonzero((ids < 0) | (ids >= n))
    if len(bad):
        raise SceneError(f"{what}: {items} {ids[bad[0]]} does not exist (there are {n}, counted from 0)")
    return ids.astype(np.int64)


def store(record, **values) -> None:
    """Set fields of a frozen record to validated values; arrays become read-only, since copies of a scene share them."""
    for field, value in values.items():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(record, field, value)


def attribute(name: str, check: Callable | None, doc: str) -> property:
    """Return a property of a class that stores check(value, "LABEL: name") when a value is assigned to it.

    A method `_check_NAME(value)` of the class or of a subclass takes the place of `check` where that is None.
    """

    def assign(owner, value) -> None:
        checked = check(value, f"{owner._label()}: {name}") if check else getattr(owner, f"_check_{name}")(value)
        setattr(owner, f"_{name}", checked)

    return property(operator.attrgetter(f"_{name}"), assign, doc=doc)


def _positive(value, what: str) -> None:
    number(value, what, above=0.0)


def _tolerance(value, what: str) -> None:
    limit = MAX_TOLERANCE.get(what.rpartition(".")[2], 1.0)
    if value is not None and number(value, what, above=0.0) >= limit:
        raise SceneError(f"{what} must be below {limit:g}, or None for the default, not {value_text(value)}")


def _named_quantities(value, what: str) -> dict:
    """Return a dict of names and texts, or functions. What the texts say is checked where the run begins."""
    for key, one in value.items() if isinstance(value, dict) else [("", value)]:
        if not key or not isinstance(key, str) or not (isinstance(one, str) or callable(one)):
            raise SceneError(f"{what} must be texts or functions by name, not {value_text(one)}")
    return value


SOLVER_CHECKS = {  # key of the `solver` dict -> check
    "dt": _positive,
    "integrator": text,
    "contact_solver": text,
    "self_collision": flag,
    "precision": lambda value, what: choice(value, what, ("f32", "f64")),
    "arch": lambda value, what: choice(value, what, ("cpu", "cuda")),
    "allow_unstable": flag,
    "draggable": flag,
    "newton_tolerance": _tolerance,
    "linear_tolerance": _tolerance,
    "contact_tolerance": _tolerance,
    "tolerance": _tolerance,
    "ramp": lambda value, what: value is None or _positive(value, what),
    "budget": lambda value, what: value is None or number(value, what, minimum=0.0, unit="s"),
    "sleep": flag,
    "seconds": _positive,
    "fps": lambda value, what: value is None or _positive(value, what),
    "quantities": _named_quantities,
}


def check_solver(**solver) -> dict:
    """Return the settings unchanged. Raises SceneError, whose text starts with the key. Keys must be in SOLVER_CHECKS."""
    for key, value in solver.items():
        SOLVER_CHECKS[key](value, key)
    return solver
