"""Find and load demos, benchmarks and a user's own .toml and .py files; `taisoft list`, `bench`, `docs` and `completion`.

A checkout has demos/ and benchmarks/ beside the package; an installed wheel has them inside it. A .py file is executed as
Python: only run files you trust. A .toml file is data.
"""

import ast
import functools
import importlib
import importlib.util
import inspect
import sys
import traceback
import webbrowser
from argparse import Namespace
from pathlib import Path
from types import ModuleType

from taisoft.errors import MeshError, MissingPackage, SceneError, reworded
from taisoft.scene import checks
from taisoft.scene.checks import SOLVER_CHECKS, check_solver, nearest
from taisoft.scene.refine import refined, with_order
from taisoft.scene.scene import Scene

PACKAGE = Path(__file__).resolve().parents[1]
OF_SCENE = "the scene's solver dict: "


def shipped_files(folder: str) -> dict[str, Path]:
    """Return name -> path of the .py files in the shipped folder ("demos" or "benchmarks"), sorted by name.

    A file in a subfolder is called subfolder.name; files that start with _ are helpers and left out.
    """
    place = shipped_folder(folder)
    paths = sorted(place.rglob("[!_]*.py")) if place else []
    return {".".join(path.relative_to(place).with_suffix("").parts): path for path in paths}


def shipped_folder(folder: str) -> Path | None:
    """Return a shipped folder: inside the package (a wheel), else beside it (a checkout), else None."""
    return next((place for place in (PACKAGE / folder, PACKAGE.parent / folder) if place.is_dir()), None)


def load_shipped(folder: str, name: str) -> ModuleType:
    """Import the shipped file `name`; the folder is its package, so relative imports work."""
    package = ModuleType(f"taisoft_{folder}")
    package.__path__ = [str(shipped_folder(folder))]
    sys.modules[package.__name__] = package
    return importlib.import_module(f"{package.__name__}.{name}")


def first_line(path: Path) -> str:
    """Return the first docstring line of a .py file without running it; empty if there is none."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def list_demos(_: Namespace) -> int:
    """Print the name and first docstring line of every demo, without running any."""
    _print_table(shipped_files("demos"))
    return 0


def bench(arguments: Namespace) -> int:
    """Run main(argv) -> exit status of a benchmark, or list all of them if none is named. Raises SceneError."""
    # files in subfolders, and files without main(), are parts of benchmarks
    files = {name: path for name, path in shipped_files("benchmarks").items() if "." not in name}
    benchmarks = {name: path for name, path in files.items() if "def main(" in path.read_text()}
    if arguments.name in (None, "-h", "--help"):
        print("usage: taisoft bench NAME [arguments of the benchmark]")
        _print_table(benchmarks)
        return 0
    checks.index(arguments.name, list(benchmarks), "no benchmark")
    return load_shipped("benchmarks", arguments.name).main(arguments.rest) or 0


def docs(arguments: Namespace) -> int:
    """Print the path of a page of the manual, and open it where there is a browser. Raises SceneError without it."""
    folder = shipped_folder("out/docs")  # by `make docs`
    paths = () if folder is None else folder.rglob("*.html")
    pages = {path.relative_to(folder).with_suffix("").as_posix(): path for path in paths}
    if not pages:
        raise SceneError("the manual was not built with this installation: `make docs` builds it from docs/ of the sources")
    name = arguments.page.removesuffix(".html").removesuffix(".md")
    page = pages.get(name) or next((path for page, path in pages.items() if page.endswith(f"/{name}")), None)
    if page is None:
        raise SceneError(f"the manual has no page {arguments.page!r}{nearest(arguments.page, pages)}")
    print(page)
    if not arguments.path:
        webbrowser.open(page.as_uri())
    return 0


def _print_table(files: dict[str, Path]) -> None:
    width = max(map(len, files), default=0)
    for name, path in files.items():
        print(f"{name:<{width}}  {first_line(path)}".rstrip())


def completion(arguments: Namespace) -> int:
    """Print the script by which a shell completes commands; it calls the command itself with _ARGCOMPLETE set."""
    try:
        import argcomplete
    except ImportError:
        raise SceneError("completion needs argcomplete: pip install 'taisoft[completion]'") from None
    print(argcomplete.shellcode(["taisoft"], True, arguments.shell))
    return 0


def fitting_scenes(prefix: str, **_) -> list[str]:
    """Return what may complete a SCENE that begins with prefix: demos, scene files and folders."""
    from argcomplete.completers import FilesCompleter

    return [*shipped_files("demos"), *FilesCompleter(("toml", "py"))(prefix)]


def find_scene(name: str) -> Path:
    """Return the path of SCENE: a .toml or .py file, or a demo. Raises SceneError if there is none."""
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


def load_scene(name: str, allow_outside: bool = False, refine: int | None = None, order: int | None = None) -> tuple[Scene, dict]:
    """Load the scene named SCENE and its `solver` dict (empty if the file has none).

    allow_outside: let a .toml file name meshes outside its folder. refine: number of mesh refinements; order: element order of
    all bodies; None keeps the scene's own. They are passed to a build() with a parameter of that name, else applied by
    `taisoft.scene.refine`. Raises SceneError, or MeshError for a mesh, naming the file and, for errors in its code, the line.
    """
    scene, solver, handled = _load(name, allow_outside, {"refine": refine, "order": order})
    for _ in range(0 if "refine" in handled else refine or 0):
        scene = refined(scene)
    return scene if order is None or "order" in handled else with_order(scene, order), solver


def _load(name: str, allow_outside: bool, requested: dict) -> tuple[Scene, dict, set]:
    """Return the scene, the `solver` dict, and the keys of `requested` passed to build(); None values are not requested."""
    path = find_scene(name)
    if path.suffix == ".toml":
        from taisoft.scene.toml import read_scene  # imports meshio, which `taisoft list` does not need

        return *read_scene(path, allow_outside), set()
    module = load_module(path)
    build = getattr(module, "build", None)
    if not callable(build):
        raise SceneError(f"{path}: no function build() that returns a Scene")
    passed = {key: value for key, value in requested.items() if value is not None and key in inspect.signature(build).parameters}
    scene = _call(path, functools.partial(build, **passed))
    if not isinstance(scene, Scene):
        raise SceneError(f"{path}: build() returned {type(scene).__name__}, a Scene is needed")
    solver = getattr(module, "solver", {})
    if not isinstance(solver, dict) or not all(isinstance(key, str) for key in solver):
        raise SceneError(f"{path}: solver must be a dict of Simulator arguments")
    return scene, dict(solver), set(passed)


def check_scene_solver(solver: dict) -> None:
    """Raise SceneError if a scene's `solver` dict has unknown keys or invalid values."""
    refuse_unknown(solver, list(SOLVER_CHECKS), OF_SCENE)
    with reworded(SceneError, OF_SCENE):
        check_solver(**solver)


def refuse_unknown(names, keys: list[str], where: str) -> None:
    """Raise SceneError if one of the names is no key of a `solver` dict. where: start of the message."""
    for name in names:
        checks.index(name, keys, f"{where}no setting")


def load_module(path: Path) -> ModuleType:
    """Execute a .py file as a module. Raises SceneError naming file and line if it fails."""
    spec = importlib.util.spec_from_file_location(f"taisoft_file_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module by name
    # A file may import modules in its folder; last on the path, so that it hides no other module.
    folder = str(path.absolute().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    _call(path, spec.loader.exec_module, module)
    return module


def _call(path: Path, function, *arguments):
    """Return function(*arguments); an exception in the file's code becomes a one-sentence error."""
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:  # a file may raise anything
        kind = type(error) if isinstance(error, (MeshError, MissingPackage)) else SceneError
        raise kind(f"{_place(path, error)}: {_sentence(error)}") from error


def _place(path: Path, error: BaseException) -> str:
    """Return "file, line n", the innermost line of the file in the traceback, or the file alone."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f"{path}, line {error.lineno}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f"{path}, line {frames[-1].lineno}" if frames else str(path)


def _sentence(error: BaseException) -> str:
    """Return the error's text in one line, prefixed with its type unless it is taisoft's own."""
    text = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
    if isinstance(error, (MeshError, SceneError)):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
