"""The function of `run_many`, by name so that other processes import it, and the child process that calls it for each row.

A script is imported by its path under the name __mp_main__, as multiprocessing does. The process reports the digests that the
files of the function and of the modules beside it had when it first saw them, and starts Taichi only if the function needs it.
"""

import os
import random
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, reduce
from importlib import import_module, util
from importlib.machinery import SourceFileLoader
from pathlib import Path

import numpy as np

from taisoft.errors import SceneError, collected_warnings, value_text
from taisoft.many.store import code_digest, digest, sources
from taisoft.processes import serve
from taisoft.records import RunReport

STATUSES = ("ok", "degraded", "failed")  # from the best to the worst
COLUMNS = ("status", "problem", "wall_seconds")  # of every table, behind the parameters
SCRIPT = "__mp_main__"  # name under which a script is imported


@dataclass(frozen=True)
class Make:
    """A function that other processes can import.

    module: its name, empty for a file that is imported by its path; function: the name in it; folder: that of the modules
    beside it, whose files count as its source.
    """

    module: str
    file: str
    function: str
    folder: str

    @property
    def name(self) -> str:
        """Name in files and messages."""
        return f"{self.module or Path(self.file).name}:{self.function}"

    def load(self) -> Callable:
        """Import the function."""
        if self.module:
            module = import_module(self.module)
            if Path(module.__file__).resolve() != Path(self.file):
                raise ImportError(f"it imports {module.__file__} by this name, not {self.file}: give the file another name")
        else:
            spec = util.spec_from_file_location(SCRIPT, self.file, loader=SourceFileLoader(SCRIPT, self.file))
            module = sys.modules[SCRIPT] = sys.modules["__main__"] = util.module_from_spec(spec)
            spec.loader.exec_module(module)
        return reduce(getattr, self.function.split("."), module)

    def request(self) -> dict:
        """Return what every request to a child holds."""
        return asdict(self) | {"path": sys.path, "arguments": sys.argv, "working_folder": os.getcwd(), "code": code_digest(())}


def make_of(function: Callable) -> Make:
    """Return the function as it is imported elsewhere. Raises SceneError if it cannot be."""
    name, module = getattr(function, "__qualname__", ""), sys.modules.get(getattr(function, "__module__", None))
    try:
        found = reduce(getattr, name.split("."), module)
    except AttributeError:
        found = None
    if found is not function or not callable(function):
        raise SceneError(
            f"make must be a function that `def` defines at the top level of a module or script, which other processes can "
            f"import, not {value_text(function)}: put what varies into the parameters"
        )
    spec, file = module.__spec__, getattr(module, "__file__", None)
    if file is None or not Path(file).is_file():
        raise SceneError(
            f"make, {name}, is defined in a notebook or console, whose code other processes cannot import: write it to a file, "
            "such as my_runs.py (%%writefile my_runs.py in a notebook), and import it from there"
        )
    dotted = "" if spec is None or spec.name == "__main__" else spec.name
    if not any(finder.find_spec(dotted.partition(".")[0], None) for finder in sys.meta_path):
        dotted = ""  # a script, or a file that was imported under a name of its own
    path = Path(file).resolve()
    return Make(dotted, str(path), name, str(path.parents[dotted.count(".") + (path.name == "__init__.py")]))


_seen: dict[Make, dict[str, str]] = {}  # digests of source files


@cache
def _loaded(make: Make) -> tuple[Callable, str]:
    """Import the function; return it with the digest of the code of taisoft."""
    return make.load(), code_digest(())


@cache
def _see(make: Make, _n_modules: int) -> None:
    """Enter new files; called where modules may have been imported."""
    for name, found in sources(Path(make.file), Path(make.folder)).items():
        _seen.setdefault(make, {}).setdefault(name, found)


def answer(request: dict) -> dict:
    """Execute a row in a child: {"answer": its record}, or {"error": sentence} if the function cannot be called here at all.

    `raised` in a record: the function raised; `last` beside it: it left a simulator open, so that the process should end.
    """
    make = Make(**{name: request[name] for name in Make.__dataclass_fields__})
    try:
        os.chdir(request["working_folder"])
        sys.path[:], sys.argv[:] = request["path"], request["arguments"]
        function, code = _loaded(make)
        _see(make, len(sys.modules))
    except (Exception, SystemExit) as error:
        return {"error": f"{make.name} cannot be imported by another process: {type(error).__name__}: {error}"}
    if code != request["code"]:
        return {"error": "taisoft, Taichi or NumPy of the other process differs, or was changed meanwhile"}
    seed = int(digest(request["parameters"])[:8], 16)
    random.seed(seed)
    np.random.seed(seed)
    environment, errors = dict(os.environ), np.geterr()
    record = _row(function, request["parameters"], make)
    os.environ.clear()  # what one row sets must not reach the next
    os.environ.update(environment)
    np.seterr(**errors)
    _see(make, len(sys.modules))
    runtime = sys.modules.get("taisoft.backend.runtime")
    is_last = runtime is not None and runtime.open_kind() is not None
    return {"answer": record | {"sources": _seen[make], "code": request["code"]}, "last": is_last}


def _row(function: Callable, parameters: dict, make: Make) -> dict:
    """Return the record of a row: status, problems, values, arrays, and wall time [s]."""
    record = {"status": "ok", "problems": [], "values": {}, "arrays": {}, "raised": False}
    start = time.perf_counter()
    with collected_warnings() as texts:
        try:
            for name, value in _checked(function(**parameters), parameters).items():
                if isinstance(value, RunReport):
                    record["status"] = max(record["status"], value.status, key=STATUSES.index)
                    record["problems"] += value.problems
                elif isinstance(value, np.ndarray):
                    record["arrays"][name] = value
                else:
                    record["values"][name] = value
        except (Exception, SystemExit) as error:
            frames = traceback.extract_tb(error.__traceback__)
            lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == Path(make.file)]
            text = f"{type(error).__name__}: {' '.join(str(error).split())}"
            text += f" ({Path(make.file).name}, line {lines[-1]})" if lines else ""
            record |= {"status": "failed", "problems": [text], "raised": True}
    record["wall_seconds"] = time.perf_counter() - start
    record["problems"] += [f"warning: {text}" for text in texts]
    return record


def _checked(result, parameters: dict) -> dict:
    """Return what the function returned as numbers, texts, None, arrays and reports. Raises SceneError if it breaks a rule."""
    if not isinstance(result, Mapping):
        raise SceneError(f"make must return a mapping from names to values, not {value_text(result)}")
    found = {}
    for name, value in result.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise SceneError(f"make returned the name {value_text(name)}: it must be a word")
        if name in parameters or name in COLUMNS:
            other = "a parameter's" if name in parameters else "a column's of every table; a RunReport sets the status"
            raise SceneError(f"make returned the name '{name}', which is {other}")
        if isinstance(value, list | tuple):
            with suppress(ValueError):  # of different lengths
                value = np.asarray(value)
        value = value.item() if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 else value
        is_array = isinstance(value, np.ndarray) and value.dtype.kind in "biufc"
        if not is_array and not isinstance(value, bool | int | float | str | RunReport | None):
            rule = "it must be a number, a text, None or an array of numbers"
            raise SceneError(f"make returned {name} = {value_text(value)}: {rule}")
        found[name] = value
    return found


if __name__ == "__main__":
    from taisoft.many import make

    serve(make.answer)  # of the module that others import, too
