"""Settings of the site. Sphinx reads the pages where they are; they stay plain Markdown, for a git host.

make docs
"""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx

import photonpano

ROOT = Path(__file__).parents[2]
INDEX = ROOT / "docs" / "README.md"
SITE_ONLY = {"Reference": ["docs/site/api"]}
"""Pages that only the site has, at the end of their section."""
FENCE = re.compile(r"^( *)```(\w+)\n(.*?)\n *```$", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"!\[(?P<text>[^\]]*)\]\((?P<file>[^)]+\.png)\)")

project = "photonpano"
version = release = photonpano.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

root_doc = "README"
include_patterns = [
    "README.md",
    "CONTRIBUTING.md",
    "CODE_OF_CONDUCT.md",
    "SECURITY.md",
    "CHANGELOG.md",
    "docs/README.md",
    "docs/**/*.md",
    "docs/**/*.ipynb",
    "docs/site/*.rst",
    "examples/**/README.md",
]
exclude_patterns = ["**/runs/**"]
myst_heading_anchors = 4  # as a git host
nb_execution_mode = "off"  # it is saved with its output

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True}
napoleon_use_ivar = True

toc_object_entries = False  # the side bar would list every name

html_theme = "furo"
html_title = f"photonpano {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_show_sourcelink = False
html_copy_source = False


def sections() -> Iterator[tuple[str, list[str]]]:
    """Yield the sections of the index of all pages, each with its pages, in their order."""
    for caption, items in re.findall(
        r"^##+ ([^\n]+)\n\n(?:\w[^\n]*\n\n)?((?:- .*\n)+)", INDEX.read_text(encoding="utf-8"), re.MULTILINE
    ):
        names = re.findall(r"^- \[[^\]]*\]\(([^)]+)\.(?:md|ipynb)\)", items, re.MULTILINE)
        pages = [page for name in names for page in (f"docs/{name}", *parts_of(f"docs/{name}"))]
        yield caption, pages + SITE_ONLY.get(caption, [])


def parts_of(page: str) -> list[str]:
    """Return the pages that a page is divided into: those in the folder of its name."""
    return sorted(path.with_suffix("").relative_to(ROOT).as_posix() for path in (ROOT / page).glob("*.md"))


def contents() -> Iterator[str]:
    """Yield the tables of contents, which the home page does not show."""
    examples = sorted(path.with_suffix("").relative_to(ROOT).as_posix() for path in ROOT.glob("examples/**/README.md"))
    others = "Other versions <https://photonpano.github.io/photonpano/>"
    project = ["CONTRIBUTING", "CODE_OF_CONDUCT", "SECURITY", "CHANGELOG"]
    yield toctree("Overview", ["docs/README", "docs/site/gallery", *project, others])
    for caption, pages in sections():
        yield toctree(caption, pages)
    yield toctree("Examples", examples)


def toctree(caption: str, pages: list[str]) -> str:
    """Return a table of contents in Markdown."""
    return "\n".join(["", "```{toctree}", ":hidden:", ":maxdepth: 1", f":caption: {caption}", "", *pages, "```", ""])


def gallery() -> Iterator[str]:
    """Yield a figure for each picture of a page, which links the page."""
    for page in ["README", *(name for _, pages in sections() for name in pages)]:
        path = ROOT / f"{page}.md"
        if not path.exists():
            continue
        for picture in PICTURE.finditer(path.read_text(encoding="utf-8")):
            file = (path.parent / picture["file"]).resolve().relative_to(ROOT)
            yield f"\n.. figure:: /{file.as_posix()}\n   :alt: {picture['text']}\n\n   :doc:`/{page}`: {picture['text']}\n"


def complete(app: Sphinx, name: str, text: list[str]) -> None:
    """Add to a page what the site has and its file has not."""
    if app.env.doc2path(name).suffix == ".md":
        # Directives of the tests. The number of lines stays, for messages.
        text[0] = re.sub("<!--.*?-->", lambda comment: "\n" * comment[0].count("\n"), text[0], flags=re.DOTALL)
    if name == root_doc:
        text[0] += "".join(contents())
    elif name == "docs/site/gallery":
        text[0] += "".join(gallery())


def as_text(app: Sphinx, kind: str, name: str, documented: object, options: object, lines: list[str]) -> None:
    """Make reStructuredText of a docstring: backticks mark code, and no other character has a meaning."""
    del app, name, documented, options
    if kind == "property" and lines:
        lines[0] = lines[0].replace(": ", " \N{EN DASH} ")  # what stands before a colon would become its type
    parts = FENCE.split("\n".join(lines))  # text, indent, language, code, text, ...
    blocks = (
        f"{indent}.. code-block:: {language}\n\n{textwrap.indent(code, '    ')}\n"
        for indent, language, code in zip(parts[1::4], parts[2::4], parts[3::4], strict=True)
    )
    texts = map(escaped, parts[::4])
    lines[:] = "".join(part for pair in zip(texts, [*blocks, ""], strict=True) for part in pair).split("\n")


def escaped(text: str) -> str:
    """Return text whose names in backticks are code."""
    parts = re.split(r"`+([^`]+)`+", text)  # text, code, text, ...
    parts[::2] = [re.sub(r"[*|\\]|(?<=\w)_(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
    parts[1::2] = [f"``{' '.join(part.split())}``" for part in parts[1::2]]
    return "".join(parts)


def add_index(app: Sphinx, error: Exception | None) -> None:
    """Have the folder of the site open at the home page."""
    if error is None:
        shutil.copy(app.outdir / f"{root_doc}.html", app.outdir / "index.html")


def setup(app: Sphinx) -> None:
    """Complete pages and docstrings as they are read."""
    app.connect("source-read", complete)
    app.connect("autodoc-process-docstring", as_text, priority=100)  # before the sections are read
    app.connect("build-finished", add_index)
