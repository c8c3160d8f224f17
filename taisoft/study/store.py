"""Finished runs of a study on disk: one JSON file each, complete or absent, keyed by everything it depends on.

A run's key is a digest of the content of the scene as it is run, its file and the modules beside it, the settings, the code
that computes, the versions of Taichi and NumPy, the machine and its threads. A file holds its record and the record's digest;
a damaged file is reported and its run repeated.
"""

import base64
import hashlib
import json
import sys
import sysconfig
import zlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from taisoft import __version__
from taisoft.files import write_bytes
from taisoft.output.files import make_folder
from taisoft.output.report import json_text
from taisoft.timing import versions

RUNS = "runs"
KIND, FORMAT = "taisoft study run", 1
PACKAGE = Path(__file__).resolve().parents[1]
NOT_COMPUTING = ("cli", "view", "output", "study")  # folders of the package that results do not depend on
COMPUTING = ("study/measure.py", "study/timed_run.py")  # except these


def code_digest() -> str:
    """Return a digest of the files of taisoft that results depend on and of the versions of taisoft, Taichi and NumPy."""
    found = versions("taichi", "numpy")
    total = hashlib.sha256(f"{__version__} {found['taichi']} {found['numpy']}".encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name in COMPUTING or name.split("/")[0] not in NOT_COMPUTING:
            total.update(name.encode() + path.read_bytes())
    return total.hexdigest()


def sources(path: Path) -> dict[str, str]:
    """Return digests of a scene file and of modules loaded from its folder, by relative path, without installed packages."""
    path = path.absolute()
    installed = [PACKAGE, *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))]
    loaded = {Path(file).absolute() for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))}
    own = (one for one in loaded if path.parent in one.parents and not any(place in one.parents for place in installed))
    names = sorted(one.relative_to(path.parent).as_posix() for one in {path, *own})
    return digests(path, names)


def digests(path: Path, names: Iterable[str]) -> dict[str, str]:
    """Return digests of the named files in the folder of a scene file; empty for one that cannot be read."""
    found = dict.fromkeys(names, "")
    for name in found:
        with suppress(OSError):
            found[name] = hashlib.sha256((path.parent / name).read_bytes()).hexdigest()
    return found


def digest(values) -> str:
    """Return the SHA-256 digest of plain data."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


class Store:
    """Finished runs in a study's folder, which the caller has locked. damaged: sentences on files that could not be used."""

    def __init__(self, folder: Path):
        self._folder = make_folder(folder / RUNS)
        for part in (*self._folder.glob("*.part"), *folder.glob("study.*.part")):
            with suppress(OSError):  # left by a study that was killed; harmless if it cannot be removed
                part.unlink()
        self.damaged: list[str] = []

    def read(self, key: str) -> dict | None:
        """Return the record with this key, or None if it is absent or damaged."""
        path = self._folder / f"{key}.json"
        try:
            content = json.loads(path.read_bytes())
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
        """Save a record; return it as it will be read back. Raises OutputError."""
        plain = json.loads(json_text(record))  # numbers that are not finite become null, here as in the file
        content = {"kind": KIND, "format": FORMAT, "key": key, "sha256": digest(plain), "record": plain}
        write_bytes(self._folder / f"{key}.json", json.dumps(content).encode())
        return plain


class NoStore:
    """Store of a study without a folder: keeps nothing."""

    damaged: list[str] = []

    def read(self, key: str) -> None:
        """Return None."""

    def write(self, key: str, record: dict) -> dict:
        """Return the record as Store.write does."""
        return json.loads(json_text(record))


def pack(values: np.ndarray) -> dict:
    """Encode an array of float64 as text, losslessly."""
    data = zlib.compress(np.ascontiguousarray(values, dtype="<f8").tobytes(), 1)
    return {"shape": list(values.shape), "zlib_base64": base64.b64encode(data).decode()}


def unpack(packed: dict) -> np.ndarray:
    """Decode an array from `pack`. Raises ValueError for invalid data."""
    try:
        data = zlib.decompress(base64.b64decode(packed["zlib_base64"], validate=True))
        return np.frombuffer(data, dtype="<f8").reshape(packed["shape"])
    except (zlib.error, KeyError, TypeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None
