"""The bytes of a mesh file, and its words for messages."""

from pathlib import Path

from taisoft.errors import MeshError


def read_content(file: Path) -> bytes:
    """The file's bytes, at least one that is not blank. Raises MeshError."""
    try:
        if not file.exists():
            raise MeshError(f"{file}: there is no such file")
        if not file.is_file():
            raise MeshError(f"{file}: this is not a file")
        data = file.read_bytes()
    except (OSError, ValueError) as error:
        raise MeshError(f"{str(file)!r}: the file cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not data.strip():
        raise MeshError(f"{file}: the file is empty")
    return data


def one_line(text: str) -> str:
    """The text's words with single blanks, shortened to 120 characters."""
    text = " ".join(text.split())
    return text if len(text) <= 120 else text[:117] + "..."
