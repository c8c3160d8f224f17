"""Finished runs in a folder: files that are complete or absent, named by a key, and digests of what runs depend on.

A file holds a record and the record's digest; a damaged file is reported and its run repeated.
"""

import hashlib
import sys
import sysconfig
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from taisoft import __version__
from taisoft.files import write_bytes
from taisoft.machine import versions
from taisoft.nested import from_json, to_json
from taisoft.output.folder import make_folder

RUNS = "runs"
KIND, FORMAT = "taisoft run", 2
PACKAGE = Path(__file__).resolve().parents[1]
NOT_COMPUTING = ("cli", "view", "output", "many", "study")  # folders of the package that results do not depend on
COMPUTING = ("study/measure.py",)  # except these


def code_digest(ignored: Iterable[str] = NOT_COMPUTING) -> str:
    """Return a digest of the files of taisoft that results depend on and of the versions of taisoft, Taichi and NumPy.

    ignored: folders of the package that the results do not depend on.
    """
    found = versions("taichi", "numpy")
    total = hashlib.sha256(f"{__version__} {found['taichi']} {found['numpy']}".encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name in COMPUTING or name.split("/")[0] not in tuple(ignored):
            total.update(name.encode() + path.read_bytes())
    return total.hexdigest()


def sources(path: Path, folder: Path | None = None) -> dict[str, str]:
    """Return digests of a file and of the modules loaded from its folder, or another one that holds it, by relative path.

    Installed packages are left out.
    """
    path = path.resolve()
    folder = path.parent if folder is None else folder.resolve()
    places = (Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    installed = [PACKAGE, *places]
    loaded = {Path(file).resolve() for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))}
    own = (one for one in loaded if folder in one.parents and not any(place in one.parents for place in installed))
    names = sorted(one.relative_to(folder).as_posix() for one in {path, *own})
    return digests(folder, names)


def digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return digests of the named files in a folder; empty for one that cannot be read."""
    found = dict.fromkeys(names, "")
    for name in found:
        with suppress(OSError):
            found[name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    return found


def digest(values) -> str:
    """Return the SHA-256 digest of plain data and arrays."""
    return hashlib.sha256(to_json(values, sort_keys=True).encode()).hexdigest()


class Store:
    """Finished runs in a folder, which the caller has locked; without one nothing is kept.

    damaged: sentences on files that could not be used.
    """

    def __init__(self, folder: Path | None = None):
        self.folder, self.damaged = folder and make_folder(folder / RUNS), []
        for part in () if folder is None else (*self.folder.glob("*.part"), *folder.glob("*.part")):
            with suppress(OSError):  # left by a study that was killed; harmless if it cannot be removed
                part.unlink()

    def read(self, key: str) -> dict | None:
        """Return the record with this key, or None if it is absent or damaged."""
        if self.folder is None:
            return None
        path = self._path(key)
        try:
            content = from_json(path.read_bytes())
            if (content["kind"], content["format"]) != (KIND, FORMAT) or content["key"] != key:
                raise ValueError("it has another kind, format or key")
            if content["sha256"] != digest(content["record"]):
                raise ValueError("its digest does not match its content")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            self.damaged.append(f"{path} is damaged and its run is repeated: {reason}")
            return None
        return content["record"]

    def write(self, key: str, record: dict) -> dict:
        """Save a record, plain data and arrays, and return it. Raises OutputError."""
        if self.folder is not None:
            content = {"kind": KIND, "format": FORMAT, "key": key, "sha256": digest(record), "record": record}
            write_bytes(self._path(key), to_json(content).encode())
        return record

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.json"
