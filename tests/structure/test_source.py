"""The source of the package and of its tests, read without running it. Each test lists every violation:

* imports go one way, from right to left in ORDER, and collision and contact do not import each other; no modules of the core
  import one another in a circle, be it inside functions or for type checkers;
* only backend/runtime.py initialises Taichi, only backend/private.py imports its private modules, and meshes, scenes and records
  do not import Taichi at all;
* nothing evaluates text, unpickles or starts a shell, and Taichi's faulty 3x3 decompositions are not used;
* no file with kernels postpones its annotations, since Taichi cannot compile them;
* no public name is also a module's name, since importing the module would replace it;
* former names do not return, and tests use no private names;
* there is a test folder for every package, and no test file is longer than 400 lines.
"""

import ast
import io
import re
import tokenize
from functools import cache
from pathlib import Path

import taisoft

PACKAGE = Path(taisoft.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
TESTS = Path(__file__).parents[1]
TEST_FILES = sorted(TESTS.rglob("*.py"))

# Modules and packages under taisoft/, left to right; those of one group may import one another, except the pairs in FORBIDDEN.
ORDER = (
    ("errors", "records", "files", "nested", "ranges", "machine", "processes", "compile_message", "display", "view.choices"),
    ("attributes",),
    ("backend.private", "backend.blas"),
    ("backend.tracing", "backend.device_memory"),
    ("backend.arrays",),
    ("backend.structure",),
    ("backend.pack",),
    ("backend.compiled",),
    ("backend.launching", "backend.paths"),
    ("backend.counters",),
    ("backend.runtime",),
    ("backend.parallel", "backend.lists", "backend.team", "backend.reader"),
    ("scene.checks",),
    ("mesh", "scene"),
    ("fem.state", "fem.math3", "fem.chunks", "fem.spring_table", "fem.dependent_table"),
    ("fem.node_graph", "fem.model", "fem.reference"),
    ("fem.laws", "fem.pressure", "fem.masses", "fem.dependents", "fem.rigid_tets"),
    ("fem.lanes", "fem.loads"),
    ("fem.mean_dilatation", "fem.springs", "fem.fibres", "fem.viscosity"),
    ("fem.pattern",),
    ("fem.elements", "fem.terms"),
    ("fem.build", "fem.measure", "stability"),
    ("linear",),
    ("collision", "contact"),
    ("dynamics.schemes",),
    ("settings",),
    ("dynamics",),
    ("output.viewpoint", "output.nodal_fields"),
    ("output.appearance", "output.smoothing", "view.shading", "view.drawn"),
    ("view.colouring", "view.raster"),
    ("output.connection_lines",),
    ("view.ground", "view.sampling"),
    ("view.layers",),
    ("view.scene_view", "view.shadow"),
    (
        *("simulator", "queries", "contact_queries", "changes", "commanding", "energy_check", "frame_steps", "running", "static"),
        *("checkpoint", "estimation", "details"),
        *("output.vtu", "view.offscreen"),  # for methods of Simulator
    ),
    ("output", "view"),
    ("many",),
    ("study",),
    ("cli",),
    ("gym",),
    ("__main__",),
)
LEVEL = {name: level for level, group in enumerate(ORDER) for name in group}
ALLOWED_CALLS = {
    (file, call) for file in ("structure.py", "tracing.py", "launching.py") for call in ("compile", "exec")
}  # of functions' source
CORE = ("backend", "fem", "linear", "collision", "contact", "dynamics")
FORBIDDEN = {("mesh", "scene"), ("collision", "contact"), ("contact", "collision")}  # (importer, imported) within a group

WITHOUT_TAICHI = {*ORDER[0], "attributes", "mesh", "scene"}
FAULTY = {"ti.svd", "ti.sym_eig", "ti.polar_decompose"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.load"} | FAULTY
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "shelve", "marshal", "yaml"}
FORMER = set(  # names before the standard terms of the field
    "led led_nodes leads let_go letting_go told told_warnings tell_locking World Motion Pull Grip pullable pulled Stretch "
    "Strip Ask Left Shown SUNK SANK sinking HASTE survey find_way way_out STANDOFF standoff short_of_goal carry lag misfit "
    "go_beyond against obey sticks_out hit_by unfinite fence read_fenced scene_marks MAX_PARTS".split()
)


def parts_of(path: Path) -> tuple[str, ...]:
    """("mesh", "shapes") for taisoft/mesh/shapes.py, ("mesh",) for taisoft/mesh/__init__.py."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def place_of(parts: tuple[str, ...]) -> str | None:
    """The entry of ORDER that holds a module, such as "fem.laws" for ("fem", "laws", "evaluate"); None if there is none."""
    return next((name for n in (2, 1) if (name := ".".join(parts[:n])) in LEVEL), None)


@cache
def tree(path: Path) -> ast.Module:
    """A file's syntax tree."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path) -> list[str]:
    """Absolute names of all modules that a file imports, at any depth of its code."""
    package = ["taisoft", *path.relative_to(PACKAGE).parent.parts]
    names = []
    for node in ast.walk(tree(path)):
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
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            found.append((name.replace("taichi.", "ti.", 1) if name.startswith("taichi.") else name, node.lineno, node))
    return found


def short(path: Path) -> str:
    """A file's name below the package."""
    return str(path.relative_to(PACKAGE))


def test_imports_go_one_way():
    found = []
    for path in FILES:
        if parts_of(path) in ((), ("backend",), ("fem",)):
            continue  # taisoft/__init__.py imports lazily, see below
        own = place_of(parts_of(path))
        if own is None:
            found.append(f"{short(path)} is missing in ORDER")
            continue
        for name in imports(path):
            package, *parts = name.split(".")
            other = place_of(tuple(parts)) if package == "taisoft" else None
            if other is None or other == own:
                continue
            if LEVEL[other] > LEVEL[own]:
                found.append(f"{short(path)} imports {name}, which is right of it in ORDER")
            if (own, other) in FORBIDDEN:
                found.append(f"{short(path)} imports {name}")
    assert found == []


def test_the_core_has_no_circles():
    core = {".".join(("taisoft", *parts_of(path))): path for path in FILES if parts_of(path)[:1] and parts_of(path)[0] in CORE}
    remaining = {name: {other for other in imports(path) if other in core and other != name} for name, path in core.items()}
    for package in CORE:  # whose own modules import it only for names that are modules
        for others in remaining.values():
            others.discard(f"taisoft.{package}")
    while free := [name for name, others in remaining.items() if not others]:
        remaining = {name: others - set(free) for name, others in remaining.items() if name not in free}
    assert remaining == {}


def test_taichi_is_used_only_where_allowed():
    found = []
    for path in FILES:
        if parts_of(path)[:1] and parts_of(path)[0] in WITHOUT_TAICHI:
            found += [f"{short(path)} imports {name}" for name in imports(path) if name.split(".")[0] == "taichi"]
        if path != PACKAGE / "backend" / "private.py":
            found += [f"{short(path)} imports {name}" for name in imports(path) if name.startswith("taichi.")]
        if path != PACKAGE / "backend" / "runtime.py":
            found += [f"{short(path)}, line {line}: ti.init" for name, line, _ in calls(path) if name == "ti.init"]
        if {"taichi", "__future__.annotations"} <= set(imports(path)):
            found.append(f"{short(path)} postpones annotations")
    assert found == []


def test_nothing_evaluates_text_unpickles_or_starts_a_shell():
    found = []
    for path in FILES:
        found += [f"{short(path)} imports {name}" for name in imports(path) if name.split(".")[0] in FORBIDDEN_MODULES]
        for name, line, node in calls(path):
            place = f"{short(path)}, line {line}: {name}"
            if name in FORBIDDEN_CALLS and (path.name, name) not in ALLOWED_CALLS:
                found.append(place)
            for keyword in node.keywords:
                is_false = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
                if keyword.arg in ("shell", "allow_pickle") and not is_false:
                    found.append(f"{place} with {keyword.arg}")
            if name.startswith(("np.load", "numpy.load")) and "allow_pickle" not in [keyword.arg for keyword in node.keywords]:
                found.append(f"{place} without allow_pickle=False")
    assert found == []


def test_public_names():
    assert imports(PACKAGE / "__init__.py") == ["os", "importlib", "importlib.import_module"], "the package imports lazily"
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {path.name for path in PACKAGE.iterdir() if path.is_dir()}
    assert not modules & set(taisoft.__all__)
    assert [name for name in taisoft.__all__ if getattr(taisoft, name) is None] == []


def identifiers(path: Path) -> set[str]:
    """All names in a file's code, as Python's tokenizer finds them, and the name of the file: no comments, no strings."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
    return {token.string for token in tokens if token.type == tokenize.NAME} | {path.stem}


def test_no_former_names():
    assert [f"{short(path)}: {name}" for path in FILES for name in identifiers(path) & FORMER] == []


def test_tests_use_no_private_names():
    """Neither imports nor attributes, but a class's own, and those of libraries that have no other name for them."""
    allowed = set("_exit _replace _fields _actions _subparsers _group_actions _asdict _repr_html_ _assign_work_unit".split())
    found = []
    for path in TEST_FILES:
        for node in ast.walk(tree(path)):
            names = []
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("taisoft", "benchmarks"):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                names = [node.attr]
            private = [name for name in names if re.match(r"_(?!_)", name) and name not in allowed]
            found += [f"{path.relative_to(TESTS)}, line {node.lineno}: {name}" for name in private]
    assert found == []


def test_every_package_has_a_folder_of_tests_and_files_are_short():
    packages = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    folders = {path.name for path in TESTS.iterdir() if path.is_dir()}
    assert packages - folders == set()
    lines = {str(path.relative_to(TESTS)): len(path.read_text(encoding="utf-8").splitlines()) for path in TEST_FILES}
    assert {name: n for name, n in lines.items() if n > 400} == {}
    assert {str(p.relative_to(TESTS)) for p in TESTS.glob("test_*.py")} == set(), "a test lies in the folder of its package"
