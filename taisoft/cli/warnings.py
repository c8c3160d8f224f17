"""Warnings of a command, as sentences on stderr."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def printed_warnings() -> Iterator[list[str]]:
    """Prints each warning as one sentence, and yields the list of them, which the report repeats."""
    told: list[str] = []

    def tell(message, category, filename, lineno, file=None, line=None) -> None:
        is_ours = category is UserWarning
        text = str(message) if is_ours else f"{filename}, line {lineno}: {category.__name__}: {message}"
        told.append(text)
        print(f"taisoft: warning: {text}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = tell
        yield told
