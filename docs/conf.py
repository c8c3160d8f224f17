"""Sphinx settings of the manual. `make docs` builds it into out/docs."""

import logging
import re
import shutil
from pathlib import Path

import taisoft

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES_OF_RESULTS = Path(__file__).parent / "results"  # copies, made anew by every build

project = "taisoft"
author = "the taisoft authors"
copyright = "the taisoft authors, MIT license"
version = release = taisoft.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]  # myst_nb reads Markdown, too, by myst_parser
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 120  # of a cell [s]
logging.getLogger("traitlets").setLevel(logging.WARNING)  # else nbclient announces each notebook
nb_output_stderr = "remove"  # what kernels are compiled depends on the cache on disk
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"taisoft {release}"
html_copy_source = False
html_show_sourcelink = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"
add_module_names = False


def copy_results(app) -> None:
    """The measured pages, with their plots, beside the pages of the manual."""
    shutil.rmtree(PAGES_OF_RESULTS, ignore_errors=True)
    shutil.copytree(RESULTS, PAGES_OF_RESULTS, ignore=shutil.ignore_patterns("*.json"))


def as_rest(app, what, name, obj, options, lines: list[str]) -> None:
    """Docstrings are plain text: escape what reStructuredText would take for markup, and keep indented blocks as they are."""
    plain, literal = [], False
    for line in lines:
        if re.match(r"\s{2,}\S", line):
            if not literal:
                plain += ["", "::", ""]
            literal = True
            plain.append("    " + line.strip())
            continue
        if literal and line.strip():
            plain.append("")
            literal = False
        text = re.sub(r"`([^`]+)`", r"``\1``", line)
        pieces = re.split(r"(``[^`]+``)", text)
        plain.append("".join(p if p.startswith("``") else re.sub(r"([*|\\]|_(?=\W|$))", r"\\\1", p) for p in pieces))
    lines[:] = [*plain, ""]


def setup(app) -> None:
    app.connect("builder-inited", copy_results)
    app.connect("autodoc-process-docstring", as_rest)
