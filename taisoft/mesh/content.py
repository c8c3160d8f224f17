"""Read the bytes of a mesh file, and shorten text for error messages."""

from codecs import BOM_UTF8
from pathlib import Path

from taisoft.errors import MeshError

UTF16 = "the file is UTF-16 text; save it as UTF-8"
_HEAD = 64  # characters inspected to detect UTF-16 text


def read_content(file: Path) -> bytes:
    """Return the file's bytes without a UTF-8 byte-order mark. Raises MeshError if unreadable, blank or UTF-16 (XML excepted)."""
    try:
        if not file.exists():
            raise MeshError(f"{file}: there is no such file")
        if not file.is_file():
            raise MeshError(f"{file}: this is not a file")
        data = file.read_bytes()
    except (OSError, ValueError) as error:
        raise MeshError(f"{str(file)!r}: the file cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if data.startswith(BOM_UTF8) and b"\0" not in data:  # a binary .stl header may start with the same bytes
        data = data[len(BOM_UTF8) :]
    if not data.strip():
        raise MeshError(f"{file}: the file is empty")
    if (head := utf16_head(data)) and not head.startswith("<"):  # XML readers decode UTF-16
        raise MeshError(f"{file}: {UTF16}")
    return data


def utf16_head(data: bytes) -> str:
    """Return the first characters of UTF-16 text, with or without a byte-order mark; "" if data is not UTF-16 text."""
    for codec, mark in (("utf-16-le", b"\xff\xfe"), ("utf-16-be", b"\xfe\xff")):
        text = data.removeprefix(mark)[:_HEAD].decode(codec, "ignore").strip()
        if all(c.isprintable() or c.isspace() for c in text) and (data.startswith(mark) or text.isascii()):
            return text
    return ""


def one_line(text: str) -> str:
    """Return the text on one line with single spaces, shortened to 120 characters."""
    text = " ".join(text.split())
    return text if len(text) <= 120 else text[:117] + "..."
