"""Sphinx: README, docs and changelog of the repository, and the API reference from docstrings.

    sphinx-build -W --keep-going -c docs . build/docs

The source folder is the root of the repository, so that links and images work as on GitHub. No network is used.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import reference  # noqa: E402
from sphinx.pycode import ModuleAnalyzer  # noqa: E402

from SlicerUSSim.Command.cli import main  # noqa: E402
from SlicerUSSim.Logic.base.version import __version__  # noqa: E402

project = "SlicerUSSim"
author = "The SlicerUSSim developers"
release = version = __version__
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "docs/reference/**.rst"]
exclude_patterns = [".*"]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
]

html_theme = "furo"
html_title = f"SlicerUSSim {release}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
templates_path: list[str] = []

smartquotes = False  # quotation marks in docstrings are often code

myst_heading_anchors = 4  # the same anchors as on GitHub

autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "undoc-members": True}
autodoc_mock_imports = [] if importlib.util.find_spec("slicer") else ["slicer"]
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"

#: The four kinds of pages of https://diataxis.fr, and those for contributors
PAGES = {
    "Tutorials": [
        "docs/first-image",
        "docs/slicer",
        "docs/workstation",
        "docs/tracked-ultrasound",
        "docs/datasets",
        "docs/optimization",
        "docs/gallery",
    ],
    "How-to guides": [
        "docs/brain",
        "docs/ct",
        "docs/label-maps",
        "docs/probes",
        "docs/approach",
        "docs/device",
        "docs/scale",
        "docs/security",
    ],
    "Reference": ["docs/parameters", "docs/reference/command", "docs/reference/index"],
    "Explanation": [
        "docs/physics",
        "docs/segmentation",
        "docs/sheets",
        "docs/realism",
        "docs/performance",
        "docs/reliability",
        "docs/comparison",
    ],
    "Contribute": [
        "docs/architecture",
        "docs/developer",
        "CONTRIBUTING",
        "CODE_OF_CONDUCT",
        "TECH_DEBT",
        "docs/release",
        "CHANGELOG",
    ],
}
_NAMED = {page for pages in PAGES.values() for page in pages}
PAGES["Explanation"] += sorted({f"docs/{page.stem}" for page in (ROOT / "docs").glob("*.md")} - _NAMED)

REPOSITORY = json.loads((ROOT / "USSim.json").read_text(encoding="utf-8"))["scm_url"].removesuffix(".git")


def adapt_page(app, docname: str, source: list[str]) -> None:
    """Adapt a page of the repository to the site."""
    folder = (ROOT / docname).parent
    # The site has pages for rooms and none for folders.
    source[0] = re.sub(r"\]\(([\w./-]+)\)", lambda link: f"]({_without_folders(folder, link[1])})", source[0])
    if docname == root_doc:
        # The README is the first page; the table of contents is added at its end, only on the site.
        for caption, pages in PAGES.items():
            source[0] += "\n\n```{toctree}\n:hidden:\n:caption: " + caption + "\n\n" + "\n".join(pages) + "\n```\n"


def _without_folders(folder: Path, target: str) -> str:
    """Target of a link to a folder of the repository: the page of the room, or the folder on the web."""
    path = (folder / target).resolve()
    if not path.is_dir() or not path.is_relative_to(ROOT):
        return target
    page = {"Command": "command", **{room: room for room in reference.rooms()}}.get(path.name)
    return f"/docs/reference/{page}.rst" if page else f"{REPOSITORY}/tree/main/{path.relative_to(ROOT).as_posix()}"


def rewrite_docstring(app, what, name, obj, options, lines: list[str]) -> None:
    """Docstrings of this package as reST."""
    lines[:] = reference.docstring_as_rest(lines, reference.homes())


def skip_undocumented(app, what, name, obj, skip: bool, options) -> bool | None:
    """Show fields even without a comment, but methods only with a docstring, which excludes those of VTK."""
    return True if inspect.isroutine(obj) and not obj.__doc__ else None


def describe_declared_fields() -> None:
    """Use the description in a field's declaration instead of a comment."""
    for name, home in reference.homes().items():
        room = home.rpartition(".")[0]
        if room.endswith(".mrml"):  # cannot be imported everywhere
            continue
        for owner in getattr(getattr(importlib.import_module(room), name), "__mro__", ()):
            for field, text in reference.declared_fields(owner).items():
                analyzer = ModuleAnalyzer.for_module(owner.__module__)
                analyzer.analyze()
                analyzer.attr_docs[owner.__qualname__, field] = [text, ""]


def shorten_defaults(app, what, name, obj, options, signature: str | None, returns: str | None):
    """Shorten defaults that are objects, in a form that Sphinx can parse."""
    if signature is None:
        return None
    signature = signature.replace("<factory>", "...")
    return re.sub(r"(= ?[A-Z]\w+)\([^()]+\)", r"\1(...)", signature), returns


def write_first_page(app, exception) -> None:
    """Write index.html, which redirects to the first page."""
    if exception is None and app.builder.format == "html":
        text = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html"><title>{project}</title>\n'
        (Path(app.outdir) / "index.html").write_text(text, encoding="utf-8")


def setup(app) -> None:
    """Called by Sphinx."""
    describe_declared_fields()
    reference.write_pages(ROOT / "docs" / "reference", main)
    app.connect("source-read", adapt_page)
    app.connect("autodoc-process-docstring", rewrite_docstring)
    app.connect("autodoc-skip-member", skip_undocumented)
    app.connect("autodoc-process-signature", shorten_defaults)
    app.connect("build-finished", write_first_page)
