"""The package's shape, read from its source without running it:

* what stands left in ORDER imports nothing of what stands right of it, and collision and contact never meet;
* only backend/runtime.py starts Taichi, only backend/private.py touches its private parts; records, meshes, scenes and reports
  know nothing of Taichi;
* nothing evaluates text, unpickles or starts a shell, and Taichi's faulty 3x3 decompositions stay unused;
* no kernel file postpones its annotations, which Taichi cannot compile;
* a public name is never the name of a module too, since importing the module would replace it.
"""

import ast
from pathlib import Path

import pytest

import taisoft

PACKAGE = Path(taisoft.__file__).parent
FILES = sorted(path for path in PACKAGE.rglob("*.py"))

# Modules and packages under taisoft/, left to right; those of one group may import one another unless FOREIGN says otherwise.
ORDER = (
    ("errors", "records", "files", "machine", "compile_message"),
    ("attributes",),
    ("backend.private",),
    ("backend.tracing", "backend.arrays"),
    ("backend.structure",),
    ("backend.launching",),
    ("backend.runtime",),
    ("mesh", "scene"),
    ("fem.state", "fem.math3", "fem.node_graph"),
    ("fem.laws", "fem.lanes", "fem.reference"),
    ("fem.terms",),
    ("fem.model",),
    ("fem.measure", "stability"),
    ("linear",),
    ("collision", "contact"),
    ("dynamics.schemes",),
    ("settings",),
    ("dynamics",),
    ("simulator", "queries", "changes", "energy_check", "running", "static", "checkpoint"),
    ("output", "view"),
    ("study",),
    ("cli",),
    ("__main__",),
)
LEVEL = {name: level for level, group in enumerate(ORDER) for name in group}
OWN_TEXT = {(file, call) for file in ("structure.py", "tracing.py") for call in ("compile", "exec")}  # of functions' own source
FOREIGN = {("mesh", "scene"), ("collision", "contact"), ("contact", "collision")}  # (importer, imported) of one group

WITHOUT_TAICHI = {"errors", "records", "files", "machine", "compile_message", "attributes", "mesh", "scene"}
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
def test_left_imports_nothing_of_right(path):
    if parts_of(path) in ((), ("backend",), ("fem",)):
        return  # taisoft/__init__.py imports nothing until a name is asked for, see below
    own = place_of(parts_of(path))
    assert own, f"taisoft/{'/'.join(parts_of(path))} has no place in ORDER yet: give it one"
    for name in imports(path):
        package, *parts = name.split(".")
        other = place_of(tuple(parts)) if package == "taisoft" else None
        if other is None or other == own:
            continue
        assert LEVEL[other] <= LEVEL[own], f"{path.name} imports taisoft.{other}, which stands right of it"
        assert (own, other) not in FOREIGN, f"{path.name} imports taisoft.{other}"


def test_import_scan_sees_every_form(tmp_path, monkeypatch):
    """The scan behind the layer test finds absolute, relative and nested imports."""
    (tmp_path / "mesh").mkdir()
    path = tmp_path / "mesh" / "a.py"
    path.write_text("import taisoft.cli.run\nfrom . import b\nfrom ..scene import plan\ndef f():\n    from taisoft import view\n")
    monkeypatch.setattr("test_layers.PACKAGE", tmp_path)
    assert {"taisoft.cli.run", "taisoft.mesh.b", "taisoft.scene.plan", "taisoft.view"} <= set(imports(path))


@each_file
def test_taichi_stays_where_it_belongs(path):
    if parts_of(path)[:1] and parts_of(path)[0] in WITHOUT_TAICHI:
        assert not [name for name in imports(path) if name.split(".")[0] == "taichi"]
    if path != PACKAGE / "backend" / "private.py":
        assert not [name for name in imports(path) if name.startswith("taichi.")], "Taichi's private parts: by backend/private.py"
    if path != PACKAGE / "backend" / "runtime.py":
        assert not [line for name, line, _ in calls(path) if name == "ti.init"]


@each_file
def test_nothing_runs_text_or_starts_a_shell(path):
    modules = {name.split(".")[0] for name in imports(path)}
    assert not modules & FORBIDDEN_MODULES
    for name, line, node in calls(path):
        assert name not in FORBIDDEN_CALLS or (path.name, name) in OWN_TEXT, f"line {line} calls {name}"
        for keyword in node.keywords:
            is_false = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            assert keyword.arg not in ("shell", "allow_pickle") or is_false, f"line {line}: {keyword.arg} is not False"
        if name.startswith(("np.load", "numpy.load")):  # the default, said
            assert "allow_pickle" in [keyword.arg for keyword in node.keywords], f"line {line}: {name} without allow_pickle"


@each_file
def test_kernel_files_keep_their_annotations(path):
    names = imports(path)
    assert not ("taichi" in names and "__future__.annotations" in names)


def test_importing_the_package_loads_nothing_heavy():
    assert imports(PACKAGE / "__init__.py") == ["os", "importlib", "importlib.import_module"]


def test_no_public_name_is_a_module():
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {path.name for path in PACKAGE.iterdir() if path.is_dir()}
    assert not modules & set(taisoft.__all__)


@pytest.mark.parametrize("name", taisoft.__all__)
def test_public_names_exist(name):
    assert getattr(taisoft, name) is not None
