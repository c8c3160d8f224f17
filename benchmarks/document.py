"""What every benchmark does with its results: header, text as it comes, and files named after the machine."""

import os
from datetime import datetime
from pathlib import Path

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.files import make_folder
from taisoft.output.report import json_text
from taisoft.timing import machine, versions

from .elasticity_table import slug

RESULTS = Path(__file__).resolve().parent / "results"


class Document:
    """What is printed, kept for the file."""

    def __init__(self) -> None:
        self.parts: list[str] = []

    def add(self, text: str) -> None:
        """Print a part and keep it."""
        self.parts.append(text)
        print(text, end="\n\n", flush=True)

    def text(self) -> str:
        """All parts."""
        return "\n\n".join(self.parts) + "\n"

    def write(self, out: Path, numbers: dict) -> None:
        """The numbers into `out`, a .json file, and the page beside it. Raises OutputError where they cannot be written."""
        write_bytes(out, json_text(numbers).encode())
        write_bytes(out.with_suffix(".md"), self.text().encode())
        print(f"written: {out} and {out.with_suffix('.md').name}")


def header(title: str, *how: str, packages: tuple[str, ...] = ("taichi", "numpy", "scipy")) -> tuple[str, dict]:
    """What is measured where and how, as text and as data."""
    found = machine() | {"date": datetime.now().isoformat(timespec="minutes")}
    used = {"taisoft": ts.__version__, **versions(*packages)}
    numbers = found | {"versions": used}
    return header_text(title, numbers, *how), numbers


def header_text(title: str, numbers: dict, *how: str) -> str:
    """What stored numbers tell of where and how they were measured."""
    return (
        f"# {title}\n\n{', '.join([numbers['processor'], str(numbers['cores']) + ' cores', *how])}, "
        f"load {load_text(numbers['load'])} at the start; {numbers['date']}\n"
        + ", ".join(f"{name} {version or 'absent'}" for name, version in numbers["versions"].items())
    )


def load_text(value: float | None) -> str:
    """A load average."""
    return "unknown" if value is None else f"{value:.1f}"


def check_out(path: Path | None, suffix: str) -> None:
    """Raises OutputError, before minutes of measuring, where a file could not be written."""
    if path is None:
        return
    if path.suffix != suffix:
        raise OutputError(f"{path}: the name must end in {suffix}")
    if not os.access(make_folder(path.parent), os.W_OK):
        raise OutputError(f"cannot write {path}: its folder is not writable")


def default_out(arch: str, what: str, suffix: str = ".json") -> Path:
    """results/<what>-<machine><suffix> beside this file; without a suffix a folder."""
    where = machine()
    return RESULTS / f"{what}-{slug(where['processor'])}-{where['cores']}-cores{'-cuda' if arch == 'cuda' else ''}{suffix}"
