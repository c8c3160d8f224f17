"""The bytes of a mesh file, and its words for messages."""

from codecs import BOM_UTF8
from pathlib import Path

from taisoft.errors import MeshError

UTF16 = "the file is UTF-16 text; save it as UTF-8"
_HEAD = 64  # bytes that show whether a file is UTF-16 text


def read_content(file: Path) -> bytes:
    """The file's bytes, at least one that is not blank, without the byte-order mark of UTF-8 text. Raises MeshError."""
    try:
        if not file.exists():
            raise MeshError(f"{file}: there is no such file")
        if not file.is_file():
            raise MeshError(f"{file}: this is not a file")
        data = file.read_bytes()
    except (OSError, ValueError) as error:
        raise MeshError(f"{str(file)!r}: the file cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if data.startswith(BOM_UTF8) and b"\0" not in data:  # the head of a binary .stl may hold any bytes
        data = data[len(BOM_UTF8) :]
    if not data.strip():
        raise MeshError(f"{file}: the file is empty")
    if (head := utf16_head(data)) and not head.startswith("<"):  # XML readers know UTF-16
        raise MeshError(f"{file}: {UTF16}")
    return data


def utf16_head(data: bytes) -> str:
    """The first characters of data that is UTF-16 text, with or without a byte-order mark; else nothing."""
    for codec, mark in (("utf-16-le", b"\xff\xfe"), ("utf-16-be", b"\xfe\xff")):
        text = data.removeprefix(mark)[:_HEAD].decode(codec, "ignore").strip()
        if all(c.isprintable() or c.isspace() for c in text) and (data.startswith(mark) or text.isascii()):
            return text
    return ""


def one_line(text: str) -> str:
    """The text's words with single blanks, shortened to 120 characters."""
    text = " ".join(text.split())
    return text if len(text) <= 120 else text[:117] + "..."
