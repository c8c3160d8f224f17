"""Finding and loading what `taisoft run` and `taisoft bench` name: demos, benchmarks and a user's own .toml and .py files.

A checkout keeps demos/ and benchmarks/ beside the package; an installed wheel carries them inside it. A .py file is run
as Python: only run files you trust. A .toml file is data.
"""

import ast
import functools
import importlib
import importlib.util
import inspect
import sys
import traceback
from pathlib import Path
from types import ModuleType

from taisoft.errors import MeshError, SceneError
from taisoft.scene.checks import nearest
from taisoft.scene.refine import refined, with_order
from taisoft.scene.scene import Scene

PACKAGE = Path(__file__).resolve().parents[1]


def shipped_files(folder: str) -> dict[str, Path]:
    """Name -> path of the .py files in the shipped folder `folder` ("demos" or "benchmarks"), sorted by name.

    A file in a subfolder is called subfolder.name; files that start with _ are helpers and have no name.
    """
    place = shipped_folder(folder)
    paths = sorted(place.rglob("[!_]*.py")) if place else []
    return {".".join(path.relative_to(place).with_suffix("").parts): path for path in paths}


def shipped_folder(folder: str) -> Path | None:
    """Path of a shipped folder: inside the package (a wheel), else beside it (a checkout), else None."""
    return next((place for place in (PACKAGE / folder, PACKAGE.parent / folder) if place.is_dir()), None)


def load_shipped(folder: str, name: str) -> ModuleType:
    """Imports the shipped file `name`; the folder is its package, so that it may import its neighbours relatively."""
    package = ModuleType(f"taisoft_{folder}")
    package.__path__ = [str(shipped_folder(folder))]
    sys.modules[package.__name__] = package
    return importlib.import_module(f"{package.__name__}.{name}")


def first_line(path: Path) -> str:
    """The first line of the docstring of a .py file, read without running it; empty if it has none."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def find_scene(name: str) -> Path:
    """Path of the file that SCENE names: a .toml or .py file, or a demo. Raises SceneError if there is none."""
    if name.endswith((".py", ".toml")):
        path = Path(name)
        if not path.is_file():
            raise SceneError(f"{name}: no such file")
        return path
    demos = shipped_files("demos")
    if name not in demos:
        raise SceneError(
            f"{name!r} is neither a demo nor a .toml or .py file{nearest(name, demos)}; `taisoft list` names the demos"
        )
    return demos[name]


def load_scene(
    name: str, allow_outside: bool = False, refine: int | None = None, order: int | None = None
) -> tuple[Scene, dict]:
    """The scene that SCENE names and its `solver` dict (empty if the file has none).

    allow_outside: let a .toml file name meshes outside of its folder. refine: how often the meshes are to be refined; order:
    that of all bodies; None for what the scene says. A build() with a parameter of that name does it itself, elsewhere it is
    done as `taisoft.scene.refine` says. Raises SceneError, or MeshError for a mesh, naming the file and, where its code is at
    fault, the line.
    """
    scene, solver, made = _built(name, allow_outside, {"refine": refine, "order": order})
    for _ in range(0 if "refine" in made else refine or 0):
        scene = refined(scene)
    return scene if order is None or "order" in made else with_order(scene, order), solver


def _built(name: str, allow_outside: bool, requested: dict) -> tuple[Scene, dict, set]:
    """Scene and `solver` dict, and which of the things asked for build() has seen to; None is not asked for."""
    path = find_scene(name)
    if path.suffix == ".toml":
        from taisoft.scene.toml import read_scene  # brings meshio along, which `taisoft list` does without

        return *read_scene(path, allow_outside), set()
    module = load_module(path)
    build = getattr(module, "build", None)
    if not callable(build):
        raise SceneError(f"{path}: no function build() that returns a Scene")
    takes = {key: value for key, value in requested.items() if value is not None and key in inspect.signature(build).parameters}
    scene = _call(path, functools.partial(build, **takes))
    if not isinstance(scene, Scene):
        raise SceneError(f"{path}: build() returned {type(scene).__name__}, a Scene is needed")
    solver = getattr(module, "solver", {})
    if not isinstance(solver, dict) or not all(isinstance(key, str) for key in solver):
        raise SceneError(f"{path}: solver must be a dict of Simulator arguments")
    return scene, dict(solver), set(takes)


def load_module(path: Path) -> ModuleType:
    """Runs a .py file as a module. Raises SceneError naming file and line if it cannot be run."""
    spec = importlib.util.spec_from_file_location(f"taisoft_file_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up by name
    # A file split in two imports its neighbour by name; last on the path, so that it hides no other module.
    folder = str(path.absolute().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    _call(path, spec.loader.exec_module, module)
    return module


def _call(path: Path, function, *arguments):
    """function(*arguments), with an exception of the file's code turned into one sentence."""
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:  # a file may raise anything
        kind = MeshError if isinstance(error, MeshError) else SceneError
        raise kind(f"{_place(path, error)}: {_sentence(error)}") from error


def _place(path: Path, error: BaseException) -> str:
    """ "file, line n": the innermost line of the file that led to the error, or the file alone."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f"{path}, line {error.lineno}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f"{path}, line {frames[-1].lineno}" if frames else str(path)


def _sentence(error: BaseException) -> str:
    """The error's text in one line; taisoft's own sentences stand alone, others are led by their type."""
    text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
    if isinstance(error, (MeshError, SceneError)):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
