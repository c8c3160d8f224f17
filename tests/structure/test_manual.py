"""The manual and the README:

* every example is of a kind that `make docs` runs, compiles, and uses only options that exist;
* the API reference lists every public name, every argument of a Simulator and all its values;
* the page of the command line lists exactly the commands, options and keys that exist;
* every integrator and law has a row in the tables for choosing one;
* links and file names exist, the README is short, and images are small;
* pages are readable on code hosts: links have titles and lead to headings, and no directive or role of Sphinx shows, but where
  source and docstrings are filled in.
"""

import importlib.util
import inspect
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import taisoft as ts
from taisoft.cli import command_parser
from taisoft.contact import SOLVERS
from taisoft.dynamics.schemes import CHOICES
from taisoft.scene.laws import SHIPPED
from taisoft.settings import IMPLICIT_CONTACT, Settings
from taisoft.view.window.keys import KEYS, MOUSE

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "results" not in path.relative_to(DOCS).parts)
TESTED = {"python", "toml", "sh", "console"}  # kinds of blocks that docs/conftest.py runs or checks
UNTESTED = {"text", "{literalinclude}", "{eval-rst}"}  # kinds of blocks that are not examples
READERS_FILES = {"my_scene.py", "drop.py", "beams.py", "my_runs.py"}  # written by the reader
DOCUMENTS = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


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


def test_all_examples_are_tested_and_compile(runner):
    for page in PAGES:
        content = page.read_text(encoding="utf-8")
        kinds = re.findall(r"^ *```(\S+)", content, re.MULTILINE)
        assert set(kinds) <= TESTED | UNTESTED, page
        assert len(list(runner.SYBIL.parse(page).examples())) == sum(kind in TESTED for kind in kinds), page
        for code in re.findall(r"^```python\n(.*?)^```", content, re.DOTALL | re.MULTILINE):
            compile(code, str(page), "exec")


def test_commands_use_options_that_exist_and_links_lead_somewhere(runner):
    missing = []
    for path in DOCUMENTS:
        content = path.read_text(encoding="utf-8")
        for block in re.findall(r"^```(?:console|sh)?\n(.*?)^```", content, re.DOTALL | re.MULTILINE):
            runner.check_commands(block)
        for link in re.findall(r"\]\(([^)#\s]+)", content):
            if "://" not in link and not re.fullmatch(r"[a-z-]+", link) and not (path.parent / link).exists():
                missing.append(f"{path.name}: {link}")  # Sphinx checks labels
    assert missing == []


def slugs(path: Path) -> set[str]:
    """Anchors of a page's headings, as code hosts and Sphinx make them."""
    plain = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.+)$", plain, re.MULTILINE)}


def test_pages_are_readable_on_code_hosts():
    assert "{" not in re.sub(r"^```.*?^```", "", text("index.md"), flags=re.DOTALL | re.MULTILINE)
    wrong = []
    for path in DOCUMENTS:
        content = path.read_text(encoding="utf-8")
        syntax = re.findall(r"\[\]\(.*?\)|\{[\w:-]+\}`.*?`|^\([\w-]+\)=$|^: .*", content, re.MULTILINE)
        wrong += [f"{path.name}: {part}" for part in syntax]
        for link, anchor in re.findall(r"\]\(([^)#\s:]*\.md)?#([^)\s]+)\)", content):
            if anchor not in slugs(path.parent / link if link else path):
                wrong.append(f"{path.name}: {link}#{anchor}")
    assert wrong == []


def test_the_readme_is_short_and_images_are_small():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
    sizes = [path.stat().st_size for path in DOCS.rglob("*.png") if "results" not in path.relative_to(DOCS).parts]
    assert sizes and max(sizes) <= 60_000 and sum(sizes) <= 500_000


def test_every_public_name_is_in_the_reference():
    listed = re.findall(r"^\.\. auto(?:class|function|exception):: taisoft\.(\w+)$", text("api.md"), re.MULTILINE)
    assert sorted(listed) == sorted(set(ts.__all__) - {"__version__"}) and dir(ts) == sorted(ts.__all__)


def test_the_reference_and_the_docstring_list_arguments_values_and_methods_of_a_simulator():
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|(.*)\|$", section("api.md", "Simulator"), re.MULTILINE)
    parameters = inspect.signature(ts.Simulator).parameters
    assert [name for name, _, _ in rows] == list(parameters)
    values = {name: set(re.findall(r'"(\w+)"', documented)) for name, documented, _ in rows}
    assert values["integrator"] == set(CHOICES) and values["contact_solver"] == {"auto", *SOLVERS, *IMPLICIT_CONTACT}
    assert values["precision"] == {"f32", "f64"} and values["arch"] == {"cpu", "cuda"}
    for name, _, default in rows[1:]:
        assert eval(default.strip(" `")) == parameters[name].default
    assert set(Settings.__dataclass_fields__) == set(parameters) - {"scene"}
    names = set(re.findall(r'"(\w+)"', ts.Simulator.__doc__))
    assert names == {"auto", "f32", "f64", "cpu", "cuda", *CHOICES, *SOLVERS, *IMPLICIT_CONTACT}
    listed = re.search(r"autoclass:: taisoft\.Simulator\n +:members: (.*)", text("api.md"))[1].split(", ")
    own = {name for name in dir(ts.Simulator) if not name.startswith("_")}
    assert set(listed) <= own and own - set(listed) <= {"from_checkpoint", "draggable", "dragged"}


@pytest.mark.skipif(not (DOCS.parent / ".git").exists() or shutil.which("git") is None, reason="needs a git checkout")
def test_the_cylinder_patch_applies():
    command = ["git", "apply", "--check", "docs/examples/cylinder.diff"]
    done = subprocess.run(command, cwd=DOCS.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_named_files_exist():
    folders = ("taisoft", "benchmarks", "tests", "demos", "docs", "assets")
    own = {path.name for folder in folders for path in (ROOT / folder).rglob("*.py")}
    for page in PAGES:
        named = re.findall(r"`([\w./]+)`", page.read_text(encoding="utf-8"))
        missing = {name for name in named if name.split("/")[0] in folders and "/" in name and not (ROOT / name).exists()}
        missing |= {name for name in named if name.endswith(".py") and name != ".py" and Path(name).name not in own}
        missing = {name for name in missing - READERS_FILES if "NAME" not in name}  # a placeholder
        assert not missing, f"{page.name}: {missing}"


def test_the_page_lists_the_options_of_the_command():
    page = text("cli.md")
    commands = next(iter(command_parser()._subparsers._group_actions)).choices
    for name in commands:
        assert f"`taisoft {name}`" in page or f"taisoft {name} " in page or f"`{name}`" in page, name
    for name in ("run", "scene", "study", "tetrahedralize"):
        rows = re.findall(r"^\| (`--.*?) \|", section("cli.md", f"`taisoft {name}`"), re.MULTILINE)
        documented = {option for row in rows for option in re.findall(r"`(--[\w-]+)", row)}
        options = {option for a in commands[name]._actions for option in a.option_strings}
        assert documented == options - {"-h", "--help"}, name
    known = {option for parser in commands.values() for a in parser._actions for option in a.option_strings}
    assert set(re.findall(r"`(--[\w-]+)", page)) <= known | {"--version"}


def test_tables_list_keys_integrators_and_laws():
    for heading, names in (("Integrators", CHOICES), ("Material law", [law.name for law in SHIPPED])):
        rows = re.findall(r"^\| `(\w+)` \|", section("choosing.md", heading), re.MULTILINE)
        assert sorted(rows) == sorted(names)
    rows = re.findall(r"^\| (.*?) +\| (.*?) +\|", section("cli.md", "The live window"), re.MULTILINE)[2:]
    assert rows == [*MOUSE, *((key.label, key.text) for key in KEYS)]
    names = [name for key in KEYS for name in key.names]
    assert len(set(names)) == len(names), "each key has one action"
