"""Prints the warnings of a command as sentences on stderr."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def printed_warnings() -> Iterator[list[str]]:
    """Print each warning as one sentence; yield the list of their texts, which goes into the report."""
    texts: list[str] = []

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        is_ours = category is UserWarning
        text = str(message) if is_ours else f"{filename}, line {lineno}: {category.__name__}: {message}"
        texts.append(text)
        print(f"taisoft: warning: {text}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield texts
