"""What the manual and the README promise:

* every example is a block of a kind that `make docs` runs, compiles, and names options that exist;
* every public name, every argument of a Simulator and every value that it may have is in the API reference;
* every command, option and key of the window is on the page of the command line, and no other;
* every integrator and law has its row where one chooses;
* links between files lead somewhere, the README is short, and pictures are small.
"""

import argparse
import importlib.util
import inspect
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import taisoft as ts
from taisoft.cli import _parser
from taisoft.contact import SOLVERS
from taisoft.dynamics.schemes import INTEGRATORS
from taisoft.fem.laws import LAWS
from taisoft.settings import IMPLICIT_CONTACT, Settings

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "results" not in path.relative_to(DOCS).parts)
RUN = {"python", "toml", "sh", "console"}  # kinds of blocks that docs/conftest.py runs or reads
SHOWN = {"text", "{toctree}", "{literalinclude}", "{eval-rst}"}  # that are no examples
EXAMPLES = {"my_scene.py", "drop.py", "taisoft/fem/laws/modified_svk.py"}  # files that a reader writes
KEYS = {" ": "Space", "Escape": "Escape", "Right": "right arrow"}  # as the page calls them
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(DOCS)))


def text(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def section(page: str, heading: str) -> str:
    return re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text(page), re.DOTALL | re.MULTILINE)[1]


@pytest.fixture(scope="module")
def runner():
    """docs/conftest.py, which runs the examples."""
    pytest.importorskip("sybil")
    spec = importlib.util.spec_from_file_location("docs_conftest", DOCS / "conftest.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@each_page
def test_examples(page, runner):
    """All blocks are of known kinds, and what the runner finds is all of those it must run."""
    content = page.read_text(encoding="utf-8")
    kinds = re.findall(r"^ *```(\S+)", content, re.MULTILINE)
    assert set(kinds) <= RUN | SHOWN
    found = list(runner.SYBIL.parse(page).examples())
    assert len(found) == sum(kind in RUN for kind in kinds)
    for code in re.findall(r"^```python\n(.*?)^```", content, re.DOTALL | re.MULTILINE):
        compile(code, str(page), "exec")


@pytest.mark.parametrize("path", [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_commands_name_options_that_exist(path, runner):
    for block in re.findall(r"^```(?:console|sh)?\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
        runner.check_commands(block)


@pytest.mark.parametrize("path", [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    links = re.findall(r"\]\(([^)#\s]+)", path.read_text(encoding="utf-8"))
    for link in links:
        if "://" not in link and not re.fullmatch(r"[a-z-]+", link):  # a label is checked by Sphinx
            assert (path.parent / link).exists(), link


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_pictures_are_small():
    sizes = [path.stat().st_size for path in DOCS.rglob("*.png") if "results" not in path.relative_to(DOCS).parts]
    assert sizes and max(sizes) <= 60_000 and sum(sizes) <= 500_000


def test_every_public_name_is_in_the_reference():
    listed = re.findall(r"^\.\. auto(?:class|function|exception):: taisoft\.(\w+)$", text("api.md"), re.MULTILINE)
    assert sorted(listed) == sorted(set(ts.__all__) - {"__version__"})


def test_arguments_of_a_simulator():
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|(.*)\|$", section("api.md", "Simulator"), re.MULTILINE)
    parameters = inspect.signature(ts.Simulator).parameters
    assert [name for name, _, _ in rows] == list(parameters)
    values = {name: set(re.findall(r'"(\w+)"', documented)) for name, documented, _ in rows}
    assert values["integrator"] == set(INTEGRATORS) and values["contact_solver"] == {"auto", *SOLVERS, *IMPLICIT_CONTACT}
    assert values["precision"] == {"f32", "f64"} and values["arch"] == {"cpu", "cuda"}
    for name, _, default in rows[1:]:
        assert eval(default.strip(" `")) == parameters[name].default
    assert set(Settings.__dataclass_fields__) == set(parameters) - {"scene"}


def test_help_lists_the_allowed_values():
    names = set(re.findall(r'"(\w+)"', ts.Simulator.__doc__))
    assert names == {"auto", "f32", "f64", "cpu", "cuda", *INTEGRATORS, *SOLVERS, *IMPLICIT_CONTACT}
    assert dir(ts) == sorted(ts.__all__)


def test_methods_of_a_simulator():
    listed = re.search(r"autoclass:: taisoft\.Simulator\n +:members: (.*)", text("api.md"))[1].split(", ")
    own = {name for name in dir(ts.Simulator) if not name.startswith("_")}
    assert set(listed) <= own and own - set(listed) <= {"from_checkpoint", "draggable", "dragged"}


@pytest.mark.skipif(not (DOCS.parent / ".git").exists() or shutil.which("git") is None, reason="needs a git checkout")
def test_the_cylinder_applies():
    command = ["git", "apply", "--check", "docs/examples/cylinder.diff"]
    done = subprocess.run(command, cwd=DOCS.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_files_that_are_named_exist():
    folders = ("taisoft", "benchmarks", "tests", "demos", "docs", "assets")
    own = {path.name for folder in folders for path in (ROOT / folder).rglob("*.py")}
    for page in PAGES:
        named = re.findall(r"`([\w./]+)`", page.read_text(encoding="utf-8"))
        missing = {name for name in named if name.split("/")[0] in folders and "/" in name and not (ROOT / name).exists()}
        missing |= {name for name in named if name.endswith(".py") and name != ".py" and Path(name).name not in own}
        missing = {name for name in missing - EXAMPLES if "NAME" not in name}  # which stands for the reader's own
        assert not missing, f"{page.name}: {missing}"


def test_where_one_chooses():
    for heading, names in (("Integrators", INTEGRATORS), ("Material law", LAWS)):
        rows = re.findall(r"^\| `(\w+)` \|", section("choosing.md", heading), re.MULTILINE)
        assert sorted(rows) == sorted(names)


def commands() -> dict[str, argparse.ArgumentParser]:
    action = next(a for a in _parser()._actions if isinstance(a, argparse._SubParsersAction))
    return action.choices


def test_options_of_the_command():
    page = text("cli.md")
    for name in commands():
        assert f"`taisoft {name}`" in page or f"taisoft {name} " in page or f"`{name}`" in page, name
    for name in ("run", "scene", "study", "tetrahedralize"):
        rows = re.findall(r"^\| (`--.*?) \|", section("cli.md", f"`taisoft {name}`"), re.MULTILINE)
        documented = {option for row in rows for option in re.findall(r"`(--[\w-]+)", row)}
        options = {option for a in commands()[name]._actions for option in a.option_strings}
        assert documented == options - {"-h", "--help"}, name
    known = {option for parser in commands().values() for a in parser._actions for option in a.option_strings}
    assert set(re.findall(r"`(--[\w-]+)", page)) <= known | {"--version"}


def test_keys_of_the_window():
    from taisoft.view.window import KEYS as keys

    rows = re.findall(r"^\| (.*?) \|", section("cli.md", "The live window"), re.MULTILINE)[2:]
    documented = {key for row in rows if "button" not in row for key in row.split(", ")}
    assert documented == {KEYS.get(key, key.upper()) for key in keys}
