"""The rules by which 3D Slicer finds and loads scripted modules, without Slicer.

Sources, in Slicer/Slicer: Base/QTGUI/qSlicerScriptedLoadableModuleFactory.cxx (which files),
Base/QTCore/qSlicerUtils.cxx (which are command-line modules), Base/QTGUI/qSlicerScriptedLoadableModule.cxx and
Base/QTCore/qSlicerScriptedUtils.cxx (how a file becomes a module),
Modules/Scripted/ExtensionWizard/ExtensionWizardLib/ModuleInfo.py (what the Extension Wizard and drag-and-drop find); in
commontk/CTK: Libs/Core/ctkAbstractFileBasedFactory.tpp (names, first come first served).
"""

from __future__ import annotations

import ast
import importlib.util
import sys
import traceback
import types
from pathlib import Path


class Factory:
    """Registers the files of module paths, puts their folders on sys.path, then makes a module of each.

    What Slicer would write to its log is in `errors`; the modules' instances are in `modules`, by name.
    """

    def __init__(self, *module_paths: Path) -> None:
        self.files: dict[str, Path] = {}
        self.modules: dict[str, object] = {}
        self.errors: list[str] = []
        for folder in module_paths:
            for file in sorted(folder.iterdir()):
                file = file.resolve() if file.is_symlink() else file
                if is_scripted_module(file):
                    self.files.setdefault(_base_name(file), file)

    def start(self) -> None:
        for file in self.files.values():
            if str(file.parent) not in sys.path:
                sys.path.append(str(file.parent))
        for name, file in self.files.items():
            self._instantiate(name, file)

    def _instantiate(self, name: str, file: Path) -> None:
        if not hasattr(sys.modules.get(name), name):
            try:
                load_source_as_module(name, file)
            except BaseException:
                self.errors.append(f"Failed to load file {file} as module {name}!\n{traceback.format_exc()}")
                return
        module_class = getattr(sys.modules[name], name, None)
        if module_class is None:
            self.errors.append(f"Failed to load scripted loadable module: class {name} was not found in file {file}")
            return
        self.modules[name] = module_class(types.SimpleNamespace(path=str(file)))


def is_scripted_module(file: Path) -> bool:
    """Whether the factory treats a file as a module: .py, or .pyc without its .py, but no file that begins with #!."""
    if not file.is_file() or is_command_line_module(file):
        return False
    suffix = file.suffix.lower()
    return suffix == ".py" or (suffix == ".pyc" and not file.with_suffix(".py").exists())


def is_command_line_module(file: Path) -> bool:
    """Whether another factory would run a file to query its interface: a script with #!, a name without a dot."""
    if file.suffix.lower() == ".py":
        return file.read_bytes().removeprefix(b"\xef\xbb\xbf").startswith(b"#!")
    return "." not in file.name


def load_source_as_module(name: str, file: Path):
    """The module is in sys.modules before its file runs, and stays there if that fails."""
    spec = importlib.util.spec_from_file_location(name, str(file))
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def found_by_wizard(path: Path, depth: int = 1) -> list[Path]:
    """The modules that the Extension Wizard lists for a folder, or that Slicer finds in a dropped folder or file.

    A folder with an __init__.py is a library, and nothing in it is a module. Elsewhere a module is a file with a class
    of its name, derived from ScriptedLoadableModule by that very name.
    """
    entries = [path] if path.is_file() else list(path.iterdir())
    if path.is_dir() and any(entry.name.endswith("__init__.py") for entry in entries):
        return []
    found = []
    if depth > 0:
        for entry in entries:
            found += found_by_wizard(entry, depth - 1) if entry.is_dir() else []
    return found + [entry for entry in entries if entry.is_file() and entry.suffix == ".py" and _is_module(entry)]


def _is_module(file: Path) -> bool:
    classes = [node for node in ast.parse(file.read_text(encoding="utf-8")).body if isinstance(node, ast.ClassDef)]
    bases = [base for node in classes if node.name == file.stem for base in node.bases]
    return any(isinstance(base, ast.Name) and base.id == "ScriptedLoadableModule" for base in bases)


def _base_name(file: Path) -> str:
    """QFileInfo::baseName: up to the first dot."""
    return file.name.split(".")[0]
