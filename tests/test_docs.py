"""References in README, docs and comments exist: headings, links, files, options of the command, imports."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from SlicerUSSim.Command.cli import main

ROOT = Path(__file__).parents[1]
PAGES = [*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "TECH_DEBT")), *sorted(ROOT.glob("docs/*.md"))]
TOP_FOLDERS = ("SlicerUSSim", "kernels", "validation", "tests", "benchmarks", "examples", "docs")
#: {path: text}
SOURCES = {
    path: path.read_text(encoding="utf-8")
    for folder in TOP_FOLDERS
    for suffix in ("*.py", "*.cl", "*.clh", "*.js", "*.css", "*.html")
    for path in sorted((ROOT / folder).rglob(suffix))
}
EACH_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
#: Options in the text of other programs than `ussim`.
NOT_OURS = {"--no-deps", "--sheet"}
#: Files in the text that are written, not kept.
WRITTEN = {"report.html", "build/docs/README.html"}


def prose(page: Path) -> str:
    """The text without its code blocks and without addresses in the web."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"https?://[^\s)\"`]+", "", text)


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


@cache
def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@cache
def file_names() -> set[str]:
    """Every path of the repository, and all that it ends with: Logic/mri/segmentation.py, mri/segmentation.py, ..."""
    folders = (ROOT / folder for folder in TOP_FOLDERS)
    paths = [path.relative_to(ROOT).parts for folder in folders for path in folder.rglob("*") if path.is_file()]
    nested = {"/".join(parts[first:]) for parts in paths for first in range(len(parts))}
    return nested | {path.name for path in ROOT.iterdir()}


# ---- from code to docs -----------------------------------------------------------------------------------------------


def test_sources_refer_to_headings_that_exist_and_not_by_number():
    found = 0
    for source, text in SOURCES.items():
        for page, anchor in re.findall(r"\bdocs/(\w+\.md)#([\w-]+)", text):
            found += 1
            assert (ROOT / "docs" / page).is_file(), f"{source}: docs/{page}"
            assert anchor in anchors(ROOT / "docs" / page), f"{source}: docs/{page}#{anchor}"
        number = re.search(r"(PHYSICS|physics\.md)\W+sections?\W+\d", text)
        assert number is None, f"{source}: {number.group()!r}, expected such as docs/physics.md#3-rays"
    assert found > 25


def test_files_that_comments_name_exist():
    """Every source or page that a docstring or comment names."""
    missing = set()
    for source, text in SOURCES.items():
        if source.is_relative_to(ROOT / "tests"):  # those name files that they write
            continue
        comments = re.findall(r'"""(?s:.*?)"""|#.*' if source.suffix == ".py" else r"//.*", text)
        for name in re.findall(r"(?<![\w./{*-])[\w/-]+\.(?:py|cl|clh)\b", "\n".join(comments)):
            if name not in file_names():
                missing.add(f"{source.relative_to(ROOT)}: {name}")
    assert not missing


# ---- from docs to files and headings ---------------------------------------------------------------------------------


@EACH_PAGE
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), target
        assert not anchor or anchor in anchors(there), target


@EACH_PAGE
def test_files_in_the_text_exist(page):
    text = prose(page) + "".join(blocks(page, "bash"))
    sources = re.findall(r"(?<![\w./-])(?:[\w-]+/)*[\w-]+\.(?:py|cl|clh|ui|html)\b", text)
    others = re.findall(rf"`((?:{'|'.join(TOP_FOLDERS)})/[\w./-]+\.\w+)`", text)
    assert not {path for path in [*sources, *others] if path not in file_names()} - WRITTEN


def test_checks_that_the_model_names_are_made():
    from validation.run import all_checks

    text = " ".join(prose(ROOT / "docs" / "physics.md").split())
    made = {check.name for check in all_checks()}
    named = {
        name for names in re.findall(r"[Cc]hecks?:? ((?:\*[^*]+\*[, ]*)+)", text) for name in names.split("*")[1::2]
    }
    assert len(named) > 15 and named <= made


# ---- the command -----------------------------------------------------------------------------------------------------


def options_of(command) -> set[str]:
    """--names of a command's options."""
    given = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
    return given | {"--help", "-h"}


def commands_in(page: Path) -> list[list[str]]:
    """The words of every call of `ussim` in a page's shell blocks and in backticks."""
    shell = "".join(blocks(page, "bash")).replace("\\\n", " ")
    spans = re.findall(r"`(ussim [^`]+)`", " ".join(prose(page).split()))
    lines = re.findall(r"(?:^|[\s/])(ussim \w.*)", shell)
    return [shlex.split(line, comments=True) for line in [*spans, *lines]]


@EACH_PAGE
def test_commands_and_their_options_exist(page):
    for _, name, *words in commands_in(page):
        if name.startswith("-"):
            continue
        assert name in main.commands, f"ussim {name}"
        known = options_of(main.commands[name])
        for word in words:
            assert not word.startswith("-") or word.partition("=")[0] in known, f"ussim {name} {word}"


@EACH_PAGE
def test_options_named_in_the_text_exist(page):
    known = set().union(*map(options_of, main.commands.values())) | NOT_OURS
    for span in re.findall(r"`(--[^`]+)`", " ".join(prose(page).split())):
        assert span.split()[0] in known, span


# ---- Python ----------------------------------------------------------------------------------------------------------


def require_imports(code: str) -> None:
    """Every imported module exists, and those of this package have the imported names."""
    if "Logic.mrml" in code:
        pytest.importorskip("slicer", reason="MRML needs slicer-core: pip install '.[slicer]'")
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                assert importlib.util.find_spec(alias.name.partition(".")[0]), alias.name
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("SlicerUSSim"):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                assert hasattr(module, alias.name), f"from {node.module} import {alias.name}"


@pytest.mark.parametrize(
    "code", [pytest.param(code, id=page.name) for page in PAGES for code in blocks(page, "python")]
)
def test_python_snippets_compile_and_import_what_there_is(code):
    compile(code, "snippet", "exec")
    require_imports(code)
