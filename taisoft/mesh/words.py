"""Sequential reading of the words and numbers of a text; every error names its line."""

import re
from itertools import islice

import numpy as np

from taisoft.errors import MeshError

MAX_EXACT_INT = 2.0**53  # float64 holds every integer up to here exactly
MAX_QUOTED = 40  # characters of a word in a message


class Words:
    """The words of a text, from the first to the last.

    name: the file's, for messages; first_line: the text's first line in it; section: the part of the file, for messages.
    """

    def __init__(self, name: str, text: bytes, first_line: int = 1, section: str = ""):
        self.name, self.text, self.words, self.at = name, text, text.split(), 0
        self._first_line, self._section, self._underscores = first_line, section and f" ({section})", b"_" in text

    def error(self, text: str, index: int | None = None) -> MeshError:
        """Return the error at word number `index`, by default the last one read."""
        index = min(self.at - 1 if index is None else index, len(self.words) - 1)
        word = next(islice(re.finditer(rb"\S+", self.text), index, None)).start() if index >= 0 else 0
        line = self._first_line + self.text.count(b"\n", 0, word)
        return MeshError(f"{self.name}: line {line}{self._section}: {text}")

    def quoted(self, index: int) -> str:
        return repr(self.words[index].decode("utf-8", "replace")[:MAX_QUOTED])

    def next(self, expected: str) -> str:
        """Return the next word. expected: what it should be, for messages."""
        if self.at == len(self.words):
            raise self.error(f"expected {expected}, but the file ends")
        self.at += 1
        return self.words[self.at - 1].decode("utf-8", "replace")

    def left(self) -> int:
        return len(self.words) - self.at

    def floats(self, n: int) -> np.ndarray:
        """Return the next n numbers (n,) as float64."""
        if n > self.left():
            raise self.error(f"{n} numbers should follow, but only {self.left()} do")
        self.at += n
        return self.numbers(self.at - n, self.at)

    def numbers(self, first: int, end: int, step: int = 1) -> np.ndarray:
        """Return the words first, first + step, ... below end as float64."""
        found = self.words[first:end:step]
        try:
            if self._underscores and any(b"_" in word for word in found):
                raise ValueError
            return np.array(found, dtype=np.float64)
        except ValueError:
            values = []
        for k, word in enumerate(found):
            try:
                values.append(to_float(word.decode("utf-8", "replace")))
            except ValueError:
                bad = first + step * k
                raise self.error(f"expected a number, not {self.quoted(bad)}", bad) from None
        return np.array(values)

    def skip_numbers(self) -> None:
        """Go on to the next word that begins no number."""
        self.at = next((i for i in range(self.at, len(self.words)) if self.words[i][:1] not in b"+-.0123456789"), len(self.words))

    def ints(self, n: int, kind: str = "") -> np.ndarray:
        """Return the next n numbers (n,) as int64. kind: unused here; binary readers have several."""
        return self.as_ints(self.floats(n), self.at - n)

    def as_ints(self, values: np.ndarray, first: int, stride: int = 1) -> np.ndarray:
        """Return values as integers; they are the words first, first + stride, ..."""
        whole = (np.floor(values) == values) & (np.abs(values) <= MAX_EXACT_INT)
        if not whole.all():
            k = first + int(np.argmin(whole)) * stride
            raise self.error(f"expected a whole number, not {self.quoted(k)}", k)
        return values.astype(np.int64)

    def count(self, kind: str = "") -> int:
        """Return the next number, which counts something. kind: as for `ints`."""
        n = int(self.ints(1)[0])
        if n < 0:
            raise self.error(f"expected a number of at least 0, not {n}")
        return n

    def end(self) -> None:
        """Check that no word is left."""
        if self.left():
            raise self.error(f"{self.left()} numbers are left over", self.at)


def last_line(data: bytes) -> int:
    """Return the number of a text's last line that is not blank."""
    return data.rstrip().count(b"\n") + 1


def to_float(word: str) -> float:
    """Return a word's number; D may stand for E before its exponent. Raises ValueError, also for Python's 1_0."""
    if "_" in word or not word.isascii():
        raise ValueError
    try:
        return float(word)
    except ValueError:
        return float(re.sub(r"(?<=[\d.])[dD](?=[+-]?\d)", "e", word))


def to_int(word: str) -> int:
    """Return a word's whole number, of at most 15 digits. Raises ValueError."""
    if not re.fullmatch(r"[+-]?\d{1,15}", word, re.ASCII):
        raise ValueError
    return int(word)
