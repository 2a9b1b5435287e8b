"""Generates the reference from the code: a page per room with its public names, and a page of the command.

Nothing here imports Sphinx; conf.py calls it. It is written as reST into docs/reference, which is not in git.

Docstrings of this package are plain text with three conventions: names in `single backticks`, "Parameters" underlined
with hyphens and then `name : text`, and pages such as docs/physics.md, with or without a heading.
"""

from __future__ import annotations

import ast
import re
from dataclasses import fields, is_dataclass
from inspect import cleandoc, get_annotations
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[1]
LOGIC = ROOT / "SlicerUSSim" / "Logic"

PAGE = """{title}
{underline}

.. automodule:: {package}
   :no-members:

.. py:currentmodule:: {package}

.. autosummary::
   :nosignatures:

{summary}

{entries}
"""
INDEX = """API reference
=============

.. automodule:: SlicerUSSim.Logic
   :no-members:

Public names of ``SlicerUSSim.Logic``
-------------------------------------

.. autosummary::
   :nosignatures:

{summary}

Rooms
-----

.. toctree::
   :maxdepth: 1

{pages}
"""


def exports(room: str) -> dict[str, str]:
    """{public name: its module, such as "arrays"} of a room's face, or with "" of the face of Logic, in its order."""
    tree = ast.parse((LOGIC / room / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    return {
        alias.name: str(entry.module)
        for entry in block.body
        if isinstance(entry, ast.ImportFrom)
        for alias in entry.names
    }


def rooms() -> list[str]:
    """The rooms in the order of the table in docs/architecture.md."""
    table = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| \[\w+\]\(\.\./SlicerUSSim/Logic/(\w+)\)", table, flags=re.MULTILINE)
    there = {path.parent.name for path in LOGIC.glob("*/__init__.py")}
    if set(listed) != there:
        raise ValueError(f"docs/architecture.md lists the rooms {sorted(listed)}, expected {sorted(there)}")
    return listed


def homes() -> dict[str, str]:
    """{public name: where the reference has it, such as "SlicerUSSim.Logic.probe.ConvexProbe"} of all rooms."""
    return {name: f"SlicerUSSim.Logic.{room}.{name}" for room in rooms() for name in exports(room)}


def room_page(room: str) -> str:
    """The page of a room, in reST: its description, a table of its names, and each of them."""
    package = f"SlicerUSSim.Logic.{room}"
    names = exports(room)
    entries = {name: _entry(room, module, name) for name, module in names.items()}
    return PAGE.format(
        title=package,
        underline="=" * len(package),
        package=package,
        # autosummary would describe the type of a constant
        summary="\n".join(f"   ~{name}" for name in names if not entries[name].startswith(".. py:data::")),
        entries="\n".join(entries.values()),
    )


def index_page() -> str:
    """The first page of the reference: the public names of `SlicerUSSim.Logic`, and the rooms."""
    where = homes()
    return INDEX.format(
        summary="\n".join(f"   ~{where[name].removeprefix('SlicerUSSim.Logic.')}" for name in exports("")),
        pages="\n".join(f"   {room} <{room}>" for room in rooms()),
    )


def command_page(group: click.Group) -> str:
    """The page of the command: the --help texts of it and of its subcommands."""
    parts = ["The command", "===========", "", _help(group, "ussim")]
    for name, command in sorted(group.commands.items()):
        parts += [f"ussim {name}", "-" * len(f"ussim {name}"), "", _help(command, f"ussim {name}")]
    return "\n".join(parts)


def _help(command: click.Command, name: str) -> str:
    """Text, usage and options of one command, in reST."""
    context = click.Context(command, info_name=name)
    usage = " ".join(command.collect_usage_pieces(context))
    text = docstring_as_rest(cleandoc(command.help or "").splitlines())
    lines = [*text, "", ".. code-block:: text", "", f"   {name} {usage}", ""]
    records = [option.get_help_record(context) for option in command.params]
    for names, help_text in filter(None, records):
        if help_text:  # an argument has none
            lines += [f"``{names}``", f"   {_inline(help_text, None)}", ""]
    return "\n".join(lines)


def write_pages(folder: Path, group: click.Group) -> None:
    """Write all pages into a folder; unchanged files are not written."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = {"index": index_page(), "command": command_page(group), **{room: room_page(room) for room in rooms()}}
    for old in folder.glob("*.rst"):
        if old.stem not in pages:
            old.unlink()
    for name, text in pages.items():
        page = folder / f"{name}.rst"
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def _entry(room: str, module: str, name: str) -> str:
    """The directive that describes a public name, in reST."""
    text = (LOGIC / room / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
    body = ast.parse(text).body
    for node in body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return f".. autoclass:: {name}\n{_inheritance(node, body)}"
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return f".. autofunction:: {name}\n"
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if name in (target.id for target in targets if isinstance(target, ast.Name)):
            return f".. py:data:: {name}\n\n   {_comment_above(text.splitlines(), node.lineno - 1)}\n"
    raise ValueError(f"{room}/__init__.py exports {name}, which {module}.py does not define")


def _inheritance(node: ast.ClassDef, body: list[ast.stmt]) -> str:
    """Content of the directive of a class: its bases, or the methods of bases that are not public, in reST."""
    bases = {ast.unparse(base) for base in node.bases}
    hidden = [base for base in body if isinstance(base, ast.ClassDef) and base.name in bases and base.name[0] == "_"]
    if hidden or not bases:
        methods = [entry for base in hidden for entry in base.body if isinstance(entry, ast.FunctionDef)]
        public = [method.name for method in methods if method.name[0] != "_" and ast.get_docstring(method)]
        return "".join(f"\n   .. automethod:: {name}\n" for name in public)
    return "   :show-inheritance:\n"


def _comment_above(lines: list[str], number: int) -> str:
    """The `#:` comment above a line, in reST."""
    first = number
    while first and lines[first - 1].startswith("#:"):
        first -= 1
    return " ".join(docstring_as_rest([line[2:].strip() for line in lines[first:number]]))


# ---- docstrings ------------------------------------------------------------------------------------------------------


def docstring_as_rest(lines: list[str], where: dict[str, str] | None = None) -> list[str]:
    """The lines of a docstring as reST; names in `where` (see homes) become links."""
    out: list[str] = []
    in_parameters = in_example = False
    number = 0
    while number < len(lines):
        line = lines[number]
        underlined = number + 1 < len(lines) and re.fullmatch(r"-{3,}", lines[number + 1].strip())
        if underlined and line.strip() == "Parameters":
            out += ["", ":Parameters:"]
            in_parameters = True
            number += 2
            continue
        in_example = line.lstrip().startswith(">>>") or (in_example and bool(line.strip()))
        if in_parameters and not line.strip():
            in_parameters = False
        if in_example:
            out.append(line)
        elif in_parameters:
            out += _parameter(line, where)
        else:
            out.append(_inline(line, where))
        number += 1
    return out


def declared_fields(owner: type) -> dict[str, str]:
    """{field: text of its declaration} of the declared fields of a dataclass (metadata "parameter")."""
    own = get_annotations(owner) if is_dataclass(owner) else {}
    entries = [entry for entry in fields(owner) if entry.name in own and "parameter" in entry.metadata] if own else []
    return {entry.name: _described(entry.metadata["parameter"]) for entry in entries}


def _described(about: object) -> str:
    keys = ("symbol", "tip", "unit", "bounds", "choices", "note", "source")
    said = {key: getattr(about, key, None) or "" for key in keys}
    values = f"{said['bounds'][0]:.10g} to {said['bounds'][1]:.10g}" if said["bounds"] else ", ".join(said["choices"])
    brackets = "; ".join(filter(None, (said["symbol"], f"{values} {said['unit']}".strip())))
    first = f"{said['tip']}{f' ({brackets})' if brackets else ''}."
    return " ".join([first, *(f"{said[key]}." for key in ("note", "source") if said[key])])


def _parameter(line: str, where: dict[str, str] | None) -> list[str]:
    """A line below "Parameters": a term and the beginning of its text, or a continuation."""
    found = re.match(r"([\w*]+(?:, [\w*]+)*) : (.*)", line)
    if found is None:
        return ["        " + _inline(line.strip(), where)]
    names = ", ".join(f"``{name}``" for name in found[1].split(", "))
    return [f"    {names}", "        " + _inline(found[2], where)]


_MARKS = re.compile(
    r"(?P<literal>``.+?``)|`(?P<code>[^`]+)`(?P<glued>(?=\w))?|\bdocs/(?P<page>\w+)\.md(#[\w-]+)?"
    r"|(?<![.\w])(?P<name>[A-Z][a-z]+[A-Z]\w+)(?!\w)|(?P<bar>\|)"
)


def _inline(line: str, where: dict[str, str] | None) -> str:
    """`name` as code, or as a link if it is known, such as TissueTable; docs/page.md as a link."""
    known = where or {}

    def marked(found: re.Match) -> str:
        if found["code"]:
            end = "" if found["glued"] is None else r"\ "
            name, _, attribute = found["code"].removesuffix("()").partition(".")
            if name in known and re.fullmatch(r"\w*", attribute):
                return f":py:obj:`{found['code']} <{'.'.join(filter(None, (known[name], attribute)))}>`{end}"
            return f"``{found['code']}``{end}"
        if found["page"]:
            return f":doc:`docs/{found['page']}.md </docs/{found['page']}>`"
        if found["name"] in known:
            return f":py:obj:`{found['name']} <{known[found['name']]}>`"
        return r"\|" if found["bar"] else found[0]  # |r| is a magnitude here, and a substitution in reST

    return _MARKS.sub(marked, line)
