"""Dependencies between rooms, from the imports in the sources.

    python -m tests.test_architecture [ROOT]

prints rooms with their lines, levels and imports of the tree that holds SlicerUSSim/, to compare two states of it. A
room is a package of Logic/ (or a single file there), Widget, Workstation, Command or the file that Slicer loads.
Imports count at the top of a file, inside functions and for types alone; but not what a face re-exports, since an
import of a name from a face counts as an import of the module that defines it.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "SlicerUSSim"
#: The rooms in the order of the table in docs/architecture.md, each of which may import earlier ones. The module's
#: file is not one of them, and may import all but the workstation and the command.
_PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
_TABLE = re.findall(r"^\| \[(\w+)\]\(\.\./SlicerUSSim", _PAGE, re.MULTILINE)
ORDER = [room for entry in _TABLE for room in (["module", entry] if entry == "Workstation" else [entry])]
#: Libraries that take long to import, and the rooms whose files may do so at their top. Elsewhere it is left to the
#: functions that need them, so that other uses do not wait for them.
HEAVY = {
    "pyopencl": set(),
    "SimpleITK": set(),
    "matplotlib": set(),
    "vtk": {"base", "probe", "vtk", "mrml", "Widget", "module", "Workstation"},
    "skimage": set(),
    "nlopt": set(),
    "slicer": {"mrml", "module", "Widget", "Workstation"},
    "distributed": set(),
    "zarr": set(),
    "h5py": set(),
    "gymnasium": {"gym"},
}
#: Lines of Python that a room, or a folder beside the product, may have. Raising one is a decision: the commit says
#: what users get for it.
BUDGETS = {
    "base": 3335, "opencl": 1310, "probe": 1735, "tissue": 2065, "tracked": 2100, "mri": 7460, "placement": 1205,
    "imaging": 5540, "device": 395, "datasets": 1480, "fitting": 3680, "vtk": 485, "mrml": 4895, "Widget": 3390,
    "Workstation": 5835, "Command": 3070, "gym": 125, "module": 430, "validation": 6625, "benchmarks": 3995,
    "tests": 31250, "tests/reference": 505,
}  # fmt: skip
#: Lines of all of SlicerUSSim/, and of kernels/
LARGEST_PRODUCT, LARGEST_KERNELS = 48_500, 5_860
#: Packages of the checkout that use the product and are not installed with it
CHECKOUT = {"validation", "benchmarks", "tests", "examples"}


@dataclass(frozen=True)
class Import:
    """One import of one thing."""

    #: Module that imports, and the module or library that is imported
    importer: str
    imported: str
    #: At the top of the file, so that it happens when the file is imported
    at_top: bool


class Tree:
    """The modules of a source tree and their imports. Each file is parsed once.

    Parameters
    ----------
    root : the folder that holds SlicerUSSim/.
    """

    def __init__(self, root: Path) -> None:
        self.paths = {_module_name(path, root): path for path in sorted((root / PACKAGE).rglob("*.py"))}
        texts = {name: path.read_text(encoding="utf-8") for name, path in self.paths.items()}
        self.sources = {name: ast.parse(text) for name, text in texts.items()}
        #: {package: {name: module that defines it}}
        self.faces = {
            name: _exports(name, self.sources[name])
            for name, text in texts.items()
            if re.search(r"^lazy_exports\(", text, re.MULTILINE)
        }
        self.imports = [found for name in self.paths for found in self.imports_of(name, self.sources[name])]

    def imports_of(self, importer: str, source: ast.Module) -> Iterator[Import]:
        """Every import of a file, with names from faces resolved."""
        types_only = set(map(id, _in_type_checking(source)))
        at_top = set(map(id, _executed(source))) - types_only
        is_package = importer in self.paths and self.paths[importer].name == "__init__.py"
        for node in ast.walk(source):
            if id(node) in types_only and importer in self.faces:
                continue
            for imported in self._imported(node, importer, is_package):
                yield Import(importer, imported, id(node) in at_top)

    def _imported(self, node: ast.AST, importer: str, is_package: bool) -> Iterator[str]:
        if isinstance(node, ast.Import):
            yield from (self._home(alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = node.module or ""
            if node.level:
                parts = importer.split(".")
                base = parts[: len(parts) - node.level + is_package]
                package = ".".join([*base, *([node.module] if node.module else [])])
            yield from (self._home(f"{package}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and _called(node) == "import_module":
            yield from (self._home(str(name.value)) for name in node.args[:1] if isinstance(name, ast.Constant))

    def _home(self, name: str) -> str:
        """The module that `name` is or comes from; for what is not of this tree, the library."""
        library = name.split(".")[0]
        if library != PACKAGE:
            return "vtk" if library == "vtkmodules" else library
        while name not in self.paths:
            package, _, last = name.rpartition(".")
            if last in self.faces.get(package, {}):
                return self.faces[package][last]
            if not package:
                return PACKAGE
            name = package
        return name

    @cached_property
    def edges(self) -> set[tuple[str, str]]:
        """(importer, imported), both modules of this tree, neither a face."""
        return {
            (found.importer, found.imported)
            for found in self.imports
            if found.imported in self.paths and found.imported not in self.faces and found.importer not in self.faces
            and found.importer != found.imported
        }  # fmt: skip

    @cached_property
    def rooms(self) -> dict[str, list[str]]:
        """{room: its modules}."""
        rooms: dict[str, list[str]] = {}
        for name in self.paths:
            if name not in self.faces:
                rooms.setdefault(room_of(name), []).append(name)
        return rooms

    @cached_property
    def room_edges(self) -> dict[str, set[str]]:
        """{room: rooms that it imports}."""
        found: dict[str, set[str]] = {room: set() for room in self.rooms}
        for importer, imported in self.edges:
            if room_of(importer) != room_of(imported):
                found[room_of(importer)].add(room_of(imported))
        return found

    def importers(self, library: str, *, at_top: bool = False) -> set[str]:
        """Modules that import a library, anywhere or at the top of their files."""
        return {found.importer for found in self.imports if found.imported == library and found.at_top >= at_top}


def _module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def lines_of(paths: Iterable[Path]) -> int:
    """Lines of some files, blank ones and comments included."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def lines_of_rooms(tree: Tree) -> dict[str, int]:
    """{room: lines of its files, its face included}."""
    found: dict[str, int] = {}
    for name, path in tree.paths.items():
        room = room_of(name)
        found[room] = found.get(room, 0) + lines_of([path])
    return found


def room_of(module: str) -> str:
    """The room of a module: the package of Logic, or a file directly in it; the folder beside it; "module"."""
    parts = module.split(".")[1:]
    if not parts:
        return PACKAGE
    if parts[0] == "Logic":
        return parts[1] if len(parts) > 1 else "Logic"
    return parts[0] if parts[0] in ("Widget", "Workstation", "Command", "gym") else "module"


def _called(node: ast.Call) -> str:
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def _in_type_checking(source: ast.Module) -> Iterator[ast.AST]:
    for node in source.body:
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            for statement in node.body:
                yield from ast.walk(statement)


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """The statements that run when the file is imported: all outside functions."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.expr)):
            yield child
            yield from _executed(child)


def _exports(package: str, source: ast.Module) -> dict[str, str]:
    return {
        alias.asname or alias.name: f"{package}.{node.module}"
        for node in _in_type_checking(source)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def levels(edges: dict[str, set[str]]) -> dict[str, int]:
    """{room: 1 for one that imports none, else one more than the highest it imports}.

    Raises graphlib.CycleError, which names the rooms, if rooms import each other in a circle.
    """
    found: dict[str, int] = {}
    for room in TopologicalSorter(edges).static_order():
        found[room] = 1 + max((found[other] for other in edges[room]), default=0)
    return found


@pytest.fixture(scope="module")
def tree() -> Tree:
    return Tree(ROOT)


def test_the_rooms_are_those_of_the_design(tree):
    assert set(tree.rooms) == set(ORDER)


def test_no_room_imports_one_that_stands_on_it(tree):
    wrong = {
        f"{room} -> {other}" for room, others in tree.room_edges.items() for other in others
        if ORDER.index(other) >= ORDER.index(room)
    }  # fmt: skip
    assert wrong == set() and tree.room_edges["base"] == set()
    assert {other for other, imported in tree.room_edges.items() if "Workstation" in imported} == {"Command"}


def test_no_modules_of_a_room_import_each_other_in_a_circle(tree):
    edges: dict[str, set[str]] = {module: set() for members in tree.rooms.values() for module in members}
    for importer, imported in tree.edges:
        if room_of(importer) == room_of(imported):
            edges[importer].add(imported)
    levels(edges)


def test_the_product_imports_nothing_of_the_checkout_alone(tree):
    assert {library: tree.importers(library) for library in CHECKOUT} == {name: set() for name in CHECKOUT}


def test_examples_and_benchmarks_know_no_workstation_and_no_panel(tree):
    """Except for the benchmark of the workstation itself."""
    for path in [*(ROOT / "examples").glob("*.py"), *(ROOT / "benchmarks").glob("*.py")]:
        if path.stem == "dragging":
            continue
        found = tree.imports_of(f"{path.parent.name}.{path.stem}", ast.parse(path.read_text(encoding="utf-8")))
        rooms = {room_of(entry.imported) for entry in found if entry.imported in tree.paths}
        assert not rooms & {"Workstation", "Widget", "Command"}, path.name


def test_no_room_exceeds_its_budget_of_lines(tree):
    rooms = lines_of_rooms(tree)
    assert sum(rooms.values()) <= LARGEST_PRODUCT
    rooms["module"] += rooms.pop("Logic")  # the face of all rooms
    for folder in ("validation", "benchmarks", "tests", "tests/reference"):
        rooms[folder] = lines_of((ROOT / folder).glob("*.py"))
    assert set(rooms) == set(BUDGETS)
    for room, lines in rooms.items():
        advice = "remove something, or raise BUDGETS in a commit with its reason"
        assert lines <= BUDGETS[room], f"{room} has {lines} lines, budget {BUDGETS[room]}: {advice}"
    assert lines_of((ROOT / "kernels").glob("*.cl*")) <= LARGEST_KERNELS


def test_file_names_are_unique_and_no_module_is_a_fragment(tree):
    """A module of fewer than 60 lines with one importer belongs into that."""
    stems = [path.stem for path in tree.paths.values() if path.name != "__init__.py"]
    assert sorted({stem for stem in stems if stems.count(stem) > 1}) == []
    importers = Counter(imported for _, imported in tree.edges)
    assert {name for name, path in tree.paths.items() if importers[name] == 1 and lines_of([path]) < 60} == set()


def test_names_of_tests_are_short_sentences():
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py")]
    names = [name for text in texts for name in re.findall(r"^def (test_\w+)", text, re.MULTILINE)]
    assert [name for name in names if len(name) > 70] == []


def test_slicer_and_qt_stay_where_they_belong(tree):
    logic = {name for name in tree.paths if name.startswith(f"{PACKAGE}.Logic")}
    assert {room_of(name) for name in tree.importers("slicer") & logic} == {"mrml"}
    for library in ("qt", "ctk", "PySide6", "trame", "click"):
        assert not tree.importers(library) & logic, library


def test_heavy_libraries_are_imported_at_the_top_only_where_they_may_be(tree):
    for library, rooms in HEAVY.items():
        assert set(map(room_of, tree.importers(library, at_top=True))) <= rooms, library


def test_what_reads_the_imports_finds_them_all(tmp_path):
    """Relative and lazy imports, names from faces, imports for types alone, circles and levels."""
    files = {
        "Logic/low/__init__.py": "from x import lazy_exports\nif TYPE_CHECKING:\n    from .a import A as A\n"
        "lazy_exports(globals())\n",
        "Logic/low/a.py": "import json\nclass A: ...\n",
        "Logic/high/b.py": "from SlicerUSSim.Logic.low import A\ndef f():\n    import vtkmodules.util\n",
        "Logic/high/c.py": "from . import b\nif TYPE_CHECKING:\n    from ..low.a import A\n",
        "Logic/round.py": "import importlib\nimportlib.import_module('SlicerUSSim.Logic.high.c')\n",
        "Widget/d.py": "import SlicerUSSim.Logic.round\ndef f():\n    from tests.conftest import block\n",
    }
    for name, text in files.items():
        path = tmp_path / PACKAGE / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    found = Tree(tmp_path)
    names = {(a.removeprefix(f"{PACKAGE}."), b.removeprefix(f"{PACKAGE}.")) for a, b in found.edges}
    assert names == {
        ("Logic.high.b", "Logic.low.a"), ("Logic.high.c", "Logic.high.b"), ("Logic.high.c", "Logic.low.a"),
        ("Logic.round", "Logic.high.c"), ("Widget.d", "Logic.round"),
    }  # fmt: skip
    assert levels(found.room_edges) == {"low": 1, "high": 2, "round": 3, "Widget": 4}
    assert found.importers("vtk") == {f"{PACKAGE}.Logic.high.b"} and not found.importers("vtk", at_top=True)
    assert found.importers("json", at_top=True) == {f"{PACKAGE}.Logic.low.a"}
    assert found.importers("tests") == {f"{PACKAGE}.Widget.d"}
    with pytest.raises(CycleError):
        levels({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}})


def main(root: Path) -> None:
    """Print rooms, levels and imports."""
    tree = Tree(root)
    edges = tree.room_edges
    floor, lines = levels(edges), lines_of_rooms(tree)
    for room in sorted(edges, key=lambda name: (floor[name], name)):
        imported = ", ".join(sorted(edges[room], key=lambda name: floor[name]))
        print(f"{floor[room]:3d}  {room:12s} {lines[room]:6d} of {BUDGETS.get(room, 0):5d} lines  {imported}")
    between = sum(room_of(a) != room_of(b) for a, b in tree.edges)
    print(
        f"{len(tree.paths) - len(tree.faces)} modules, {len(edges)} rooms, {max(floor.values())} levels, "
        f"{sum(map(len, edges.values()))} imports between rooms, {between} between modules of different rooms, "
        f"{sum(lines.values())} lines"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
