"""The faces of Logic: names exported for type checkers exist at run time, and are imported only when used."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import SlicerUSSim.Logic

LOGIC = Path(inspect.getfile(SlicerUSSim.Logic)).parent
#: {package: its folder}
FACES = {
    ".".join(["SlicerUSSim.Logic", *path.parent.relative_to(LOGIC).parts]): path.parent
    for path in sorted(LOGIC.rglob("__init__.py"))
    if "lazy_exports(globals())" in path.read_text(encoding="utf-8")
}
PUBLIC = {
    "AppearanceResult", "ConvexProbe", "CtSegmentation", "DisplaySettings", "Frame", "GrownLesion", "LinearProbe",
    "Membrane", "PhasedProbe", "Preset", "Segmentation", "SimulationError", "SimulationSettings", "Texture", "Tissue",
    "TissueTable", "TrackedSequence", "UltrasoundSimulator", "Volume", "grow_lesion", "list_devices",
    "optimize_appearance", "seed_of_pose", "segment_ct", "segment_mri", "similarity",
}  # fmt: skip
HEAVY = {
    "numpy", "scipy", "nibabel", "PIL", "vtk", "vtkmodules", "pyopencl", "SimpleITK", "matplotlib", "skimage", "nlopt",
    "slicer", "trame",
}  # fmt: skip


def declared(package: str) -> dict[str, str]:
    """{name: module it comes from} of a face's imports under `if TYPE_CHECKING`, read independently of lazy.py."""
    (block,) = (
        node
        for node in ast.parse((FACES[package] / "__init__.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    names = {}
    for entry in block.body:
        assert isinstance(entry, ast.ImportFrom) and entry.level == 1, ast.unparse(entry)
        for alias in entry.names:
            # `import X as X` is what makes a name public to type checkers
            assert alias.asname == alias.name, f"{package}: {alias.name}"
            names[alias.name] = f"{package}.{entry.module}"
    return names


def test_there_is_a_face_for_the_package_and_for_every_room():
    rooms = {f"SlicerUSSim.Logic.{path.parent.name}" for path in LOGIC.glob("*/__init__.py")}
    assert {"SlicerUSSim.Logic", *rooms} <= set(FACES)


@pytest.mark.parametrize("package", FACES)
def test_every_declared_name_is_there_and_is_that_of_its_module(package):
    if package.endswith(".mrml"):
        pytest.importorskip("slicer", reason="needs Slicer's libraries: pip install '.[slicer]'")
    face = importlib.import_module(package)
    for name, home in declared(package).items():
        assert getattr(face, name) is vars(importlib.import_module(home))[name]
    assert dir(face) == face.__all__ == sorted(declared(package))
    with pytest.raises(AttributeError, match=rf"'{package}' has no attribute 'UltrasoundSimulater'"):
        face.UltrasoundSimulater  # noqa: B018
    # Python sets an imported module as an attribute of its package, in the place of a name that is exported.
    assert not set(declared(package)) & {path.stem for path in FACES[package].iterdir()}


def test_a_star_import_gives_the_public_names_and_no_others():
    found: dict[str, object] = {}
    exec("from SlicerUSSim.Logic import *", found)
    del found["__builtins__"]
    assert set(found) == PUBLIC
    assert not any(isinstance(value, ModuleType) for value in found.values())


def test_faces_and_help_import_no_library_that_takes_long():
    code = f"""
import importlib, json, sys
for face in {[*FACES]!r}:
    importlib.import_module(face)
from click.testing import CliRunner
from SlicerUSSim.Command.cli import main
for arguments in (["--help"], ["simulate", "--help"], ["segment", "--help"], ["optimize", "--help"]):
    assert CliRunner().invoke(main, arguments).exit_code == 0
print(json.dumps(sorted({{name.split(".")[0] for name in sys.modules}})))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(json.loads(done.stdout))
