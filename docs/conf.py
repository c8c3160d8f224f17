"""Sphinx settings of the manual. `make docs` builds it into out/docs."""

import logging
import re
import shutil
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert

import taisoft

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES_OF_RESULTS = Path(__file__).parent / "results"  # copies, made anew by every build

project = "taisoft"
author = "the taisoft authors"
copyright = "the taisoft authors, MIT license"
version = release = taisoft.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc"]  # myst_nb reads Markdown, too, by myst_parser
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 120  # of a cell [s]
logging.getLogger("traitlets").setLevel(logging.WARNING)  # else nbclient announces each notebook
nb_output_stderr = "remove"  # what kernels are compiled depends on the cache on disk
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
html_math_renderer = "mathml"  # of this file
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


def add_contents(app, page: str, source: list[str]) -> None:
    """Add the tables of contents, which people who read the pages elsewhere would see as code: on the index that of its lists."""
    if page == "index":
        for caption, items in re.findall(r"^### (.+)\n((?:\n| *\* .*\n)+)", source[0], re.MULTILINE):
            source[0] += contents([":hidden:", f":caption: {caption}"], re.findall(r"\]\((.+?)\.\w+\)", items))
    elif page == "benchmarks":
        source[0] += contents([":glob:", ":maxdepth: 1"], ["results/*", "results/*/README"])


def contents(options: list[str], pages: list[str]) -> str:
    return "\n".join(["", "```{toctree}", *options, "", *pages, "```", ""])


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


def write_math(self, node) -> None:
    """Write a formula as MathML, which browsers show without a script from elsewhere: the manual is read offline, too."""
    if isinstance(node, nodes.math_block):
        self.body.append(f'<div class="math" style="padding: 0.4em 0">{convert(node.astext(), display="block")}</div>')
    else:
        self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def setup(app) -> None:
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("builder-inited", copy_results)
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", as_rest)
