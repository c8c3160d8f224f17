"""Errors that users can get. Each message is one sentence: the object, the index, the rule it breaks."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

MAX_TEXT, MAX_LISTED = 120, 20  # in a message, maximum number of characters of a text or value, and of items of a list


class TaisoftError(Exception):
    """Base of every error that taisoft raises on purpose."""


class MeshError(TaisoftError):
    """A mesh, or a file that should hold one, breaks a rule."""


class SceneError(TaisoftError):
    """A scene, a material or a setting breaks a rule."""


class MissingPackage(SceneError):
    """A scene needs an optional package."""


class OutputError(TaisoftError):
    """A result could not be written."""


class SimulationError(TaisoftError):
    """A run cannot start, or a step failed; the state stays the last good one."""


@contextmanager
def reworded(
    caught: type[TaisoftError] | tuple, prefix: str = "", raised: type[TaisoftError] | None = None, without: str = ""
) -> Iterator[None]:
    """Raise an error of the block with a prefix, without what its text may begin with, and as another kind if one is given."""
    try:
        yield
    except caught as error:
        raise (raised or type(error))(prefix + str(error).removeprefix(without)) from error.__cause__


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """Yield a list that holds the distinct texts of the block's UserWarnings at its end; others are shown after it."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield texts
    texts += dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, UserWarning))
    for one in (one for one in caught if not issubclass(one.category, UserWarning)):
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)


def no_memory(what: str, error: MemoryError) -> SimulationError:
    """Return the SimulationError for a MemoryError; NumPy's text gives the requested size."""
    from taisoft.machine import available_memory, format_bytes  # rarely needed, and every module imports this one

    reason = str(error).rstrip(".") or "the system refused more"
    return SimulationError(f"not enough memory for {what}: {reason}; available: {format_bytes(available_memory())}")


def one_line(text: str) -> str:
    """Return the text on one line with single spaces, shortened to MAX_TEXT characters."""
    text = " ".join(text.split())
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 3] + "..."


def value_text(value) -> str:
    """Return a value that breaks a rule as short text on one line."""
    return one_line(repr(value))


def reason(error: BaseException) -> str:
    """Return the type and the text of an error of other code, such as a user's function, on one line."""
    return one_line(f"{type(error).__name__}: {error}")


def listed(items: Sequence, limit: int = MAX_LISTED) -> str:
    """Return items as text, at most `limit` of them."""
    text = ", ".join(map(str, items[:limit]))
    return text if len(items) <= limit else f"{text}, ... ({len(items)} in all)"
