"""The package's structure, read from its source without running it:

* imports go one way, from right to left in ORDER, and collision and contact do not import each other;
* only backend/runtime.py initialises Taichi, only backend/private.py imports its private modules, and meshes, scenes and records
  do not import Taichi at all;
* nothing evaluates text, unpickles or starts a shell, and Taichi's faulty 3x3 decompositions are not used;
* no file with kernels postpones its annotations, since Taichi cannot compile them;
* no public name is also a module's name, since importing the module would replace it.
"""

import ast
from pathlib import Path

import pytest

import taisoft

PACKAGE = Path(taisoft.__file__).parent
FILES = sorted(path for path in PACKAGE.rglob("*.py"))

# Modules and packages under taisoft/, left to right; those of one group may import one another, except the pairs in FORBIDDEN.
ORDER = (
    ("errors", "records", "files", "nested", "ranges", "machine", "compile_message", "display"),
    ("attributes",),
    ("backend.private",),
    ("backend.tracing", "backend.device_memory"),
    ("backend.arrays",),
    ("backend.structure",),
    ("backend.launching",),
    ("backend.runtime",),
    ("backend.parallel",),
    ("mesh", "scene"),
    ("fem.state", "fem.math3", "fem.node_graph", "fem.chunks"),
    (
        *("fem.laws", "fem.lanes", "fem.dependents", "fem.reference", "fem.loads", "fem.springs", "fem.pressure"),
        *("fem.mean_dilatation", "fem.spring_table", "fem.rigid_tets"),
    ),
    ("fem.terms",),
    ("fem.model", "fem.pattern"),
    ("fem.measure", "stability"),
    ("linear",),
    ("collision", "contact"),
    ("dynamics.schemes",),
    ("settings",),
    ("dynamics",),
    ("output.camera", "output.nodal_fields"),
    ("output.appearance", "view.shading"),
    ("view.colouring", "view.raster"),
    ("output.connection_lines",),
    ("view.connection_layer", "view.ground"),
    ("view.scene_view", "view.shadow"),
    (
        *("simulator", "queries", "contact_queries", "changes", "energy_check", "frames", "running", "static"),
        *("checkpoint", "estimation"),
        *("output.vtu", "view.offscreen"),  # for methods of Simulator
    ),
    ("output", "view"),
    ("study",),
    ("cli",),
    ("__main__",),
)
LEVEL = {name: level for level, group in enumerate(ORDER) for name in group}
ALLOWED_CALLS = {(file, call) for file in ("structure.py", "tracing.py") for call in ("compile", "exec")}  # of functions' source
FORBIDDEN = {("mesh", "scene"), ("collision", "contact"), ("contact", "collision")}  # (importer, imported) within a group

WITHOUT_TAICHI = {*ORDER[0], "attributes", "mesh", "scene"}
FAULTY = {"ti.svd", "ti.sym_eig", "ti.polar_decompose"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.load"} | FAULTY
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "shelve", "marshal", "yaml"}


def parts_of(path: Path) -> tuple[str, ...]:
    """("mesh", "shapes") for taisoft/mesh/shapes.py, ("mesh",) for taisoft/mesh/__init__.py."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def place_of(parts: tuple[str, ...]) -> str | None:
    """The entry of ORDER that holds a module, such as "fem.laws" for ("fem", "laws", "evaluate"); None if there is none."""
    return next((name for n in (2, 1) if (name := ".".join(parts[:n])) in LEVEL), None)


def imports(path: Path) -> list[str]:
    """Absolute names of all modules that a file imports, at any depth of its code."""
    package = ["taisoft", *path.relative_to(PACKAGE).parent.parts]
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names += [module, *(f"{module}.{alias.name}" for alias in node.names)]
    return names


def calls(path: Path) -> list[tuple[str, int, ast.Call]]:
    """(dotted name, line, node) of every call in a file whose function is a plain dotted name."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            found.append((name.replace("taichi.", "ti.", 1) if name.startswith("taichi.") else name, node.lineno, node))
    return found


def each_file(test):
    return pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))(test)


@each_file
def test_imports_go_one_way(path):
    if parts_of(path) in ((), ("backend",), ("fem",)):
        return  # taisoft/__init__.py imports lazily, see below
    own = place_of(parts_of(path))
    assert own, f"taisoft/{'/'.join(parts_of(path))} is missing in ORDER"
    for name in imports(path):
        package, *parts = name.split(".")
        other = place_of(tuple(parts)) if package == "taisoft" else None
        if other is None or other == own:
            continue
        assert LEVEL[other] <= LEVEL[own], f"{path.name} imports taisoft.{other}, which is right of it in ORDER"
        assert (own, other) not in FORBIDDEN, f"{path.name} imports taisoft.{other}"


def test_the_import_scan_finds_absolute_relative_and_nested_imports(tmp_path, monkeypatch):
    (tmp_path / "mesh").mkdir()
    path = tmp_path / "mesh" / "a.py"
    path.write_text("import taisoft.cli.run\nfrom . import b\nfrom ..scene import plan\ndef f():\n    from taisoft import view\n")
    monkeypatch.setattr("tests.structure.test_layers.PACKAGE", tmp_path)
    assert {"taisoft.cli.run", "taisoft.mesh.b", "taisoft.scene.plan", "taisoft.view"} <= set(imports(path))


@each_file
def test_taichi_is_used_only_where_allowed(path):
    if parts_of(path)[:1] and parts_of(path)[0] in WITHOUT_TAICHI:
        assert not [name for name in imports(path) if name.split(".")[0] == "taichi"]
    if path != PACKAGE / "backend" / "private.py":
        assert not [name for name in imports(path) if name.startswith("taichi.")], "use backend/private.py"
    if path != PACKAGE / "backend" / "runtime.py":
        assert not [line for name, line, _ in calls(path) if name == "ti.init"]


@each_file
def test_nothing_evaluates_text_unpickles_or_starts_a_shell(path):
    modules = {name.split(".")[0] for name in imports(path)}
    assert not modules & FORBIDDEN_MODULES
    for name, line, node in calls(path):
        assert name not in FORBIDDEN_CALLS or (path.name, name) in ALLOWED_CALLS, f"line {line} calls {name}"
        for keyword in node.keywords:
            is_false = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            assert keyword.arg not in ("shell", "allow_pickle") or is_false, f"line {line}: {keyword.arg} is not False"
        if name.startswith(("np.load", "numpy.load")):  # explicitly False
            assert "allow_pickle" in [keyword.arg for keyword in node.keywords], f"line {line}: {name} without allow_pickle"


@each_file
def test_kernel_files_do_not_postpone_annotations(path):
    names = imports(path)
    assert not ("taichi" in names and "__future__.annotations" in names)


def test_the_package_imports_lazily():
    assert imports(PACKAGE / "__init__.py") == ["os", "importlib", "importlib.import_module"]


def test_no_public_name_is_a_module():
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {path.name for path in PACKAGE.iterdir() if path.is_dir()}
    assert not modules & set(taisoft.__all__)


@pytest.mark.parametrize("name", taisoft.__all__)
def test_public_names_exist(name):
    assert getattr(taisoft, name) is not None
