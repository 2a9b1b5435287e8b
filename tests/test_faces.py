"""The faces of Logic: names exported for type checkers exist at run time, and are imported only when used."""

from __future__ import annotations

import ast
import compileall
import importlib
import importlib.util
import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import SlicerUSSim.Logic

LOGIC = Path(inspect.getfile(SlicerUSSim.Logic)).parent
FACES = sorted(
    ".".join(["SlicerUSSim.Logic", *path.parent.relative_to(LOGIC).parts])
    for path in LOGIC.rglob("__init__.py")
    if "lazy_exports(globals())" in path.read_text()
)
#: Those of DESIGN
PUBLIC = {
    "ConvexProbe", "DisplaySettings", "Frame", "LinearProbe", "PhasedProbe", "Segmentation", "SimulationError",
    "SimulationSettings", "Tissue", "TissueTable", "TrackedSequence", "UltrasoundSimulator", "Volume", "list_devices",
    "optimize_appearance", "segment_mri", "similarity",
}  # fmt: skip
#: What users needed besides
ALSO_PUBLIC = {
    "AppearanceResult", "CtSegmentation", "Membrane", "Preset", "Proposal", "Texture", "grow_lesion", "propose_lesions",
    "seed_of_pose", "segment_ct",
}  # fmt: skip


def declared(package: str) -> dict[str, str]:
    """{name: module it comes from} of a face's imports under `if TYPE_CHECKING`, read independently of lazy.py."""
    specification = importlib.util.find_spec(package)
    assert specification is not None and specification.origin is not None
    (block,) = (
        node
        for node in ast.parse(Path(specification.origin).read_text()).body
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


def fresh(code: str) -> str:
    """The output of a new interpreter."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def needs_scene_libraries(package: str) -> None:
    if package.endswith(".mrml"):
        pytest.importorskip("slicer", reason="needs Slicer's libraries: pip install '.[slicer]'")


def test_there_is_a_face_for_the_package_and_for_every_room():
    rooms = {f"SlicerUSSim.Logic.{path.parent.name}" for path in LOGIC.glob("*/__init__.py")}
    assert {"SlicerUSSim.Logic", *rooms} <= set(FACES)


@pytest.mark.parametrize("package", FACES)
def test_every_declared_name_is_there_and_is_that_of_its_module(package):
    needs_scene_libraries(package)
    face = importlib.import_module(package)
    for name, home in declared(package).items():
        assert getattr(face, name) is vars(importlib.import_module(home))[name]
    assert dir(face) == face.__all__ == sorted(declared(package))


@pytest.mark.slow
@pytest.mark.parametrize("package", FACES)
def test_a_name_is_the_same_when_the_module_it_comes_from_was_imported_first(package):
    needs_scene_libraries(package)
    names = declared(package)
    code = f"""
import importlib, types
for home in {sorted(set(names.values()))!r}:
    importlib.import_module(home)
face = importlib.import_module({package!r})
print([name for name in {sorted(names)!r} if isinstance(getattr(face, name), types.ModuleType)])
"""
    assert fresh(code) == "[]"


def test_a_star_import_gives_the_public_names_and_no_others():
    found: dict[str, object] = {}
    exec("from SlicerUSSim.Logic import *", found)
    del found["__builtins__"]
    assert set(found) == PUBLIC | ALSO_PUBLIC
    assert not any(isinstance(value, ModuleType) for value in found.values())


def test_similarity_is_a_function_whatever_was_imported_before():
    code = """
import SlicerUSSim.Logic.fitting.image_similarity
import SlicerUSSim.Logic
from SlicerUSSim.Logic import similarity
from SlicerUSSim.Logic.fitting import similarity as the_same
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
print(similarity.__name__, similarity is the_same is SlicerUSSim.Logic.similarity)
"""
    assert fresh(code) == "similarity True"


def test_importing_the_faces_imports_nothing_heavy():
    code = f"""
import importlib, json, sys
for face in {FACES!r}:
    importlib.import_module(face)
print(json.dumps(sorted({{name.split(".")[0] for name in sys.modules}})))
"""
    heavy = {"numpy", "scipy", "vtk", "vtkmodules", "pyopencl", "SimpleITK", "matplotlib", "skimage", "nlopt", "slicer"}
    assert not heavy & set(json.loads(fresh(code)))


@pytest.mark.parametrize("package", FACES)
def test_an_unknown_name_is_an_error_that_names_package_and_name(package):
    name = "UltrasoundSimulater"
    with pytest.raises(AttributeError, match=rf"'{package}' has no attribute '{name}'"):
        getattr(importlib.import_module(package), name)
    with pytest.raises(ImportError, match=name):
        exec(f"from {package} import {name}")


@pytest.mark.slow
def test_a_type_checker_knows_what_the_package_exports(tmp_path):
    if importlib.util.find_spec("pyright") is None:
        pytest.skip("needs pyright: pip install '.[test]'")
    script = tmp_path / "script.py"
    script.write_text(
        "from SlicerUSSim.Logic import UltrasoundSimulator\n"
        "from SlicerUSSim.Logic.probe import PROBES\n"
        "reveal_type(UltrasoundSimulator.simulate)\n"
        "reveal_type(PROBES['phased'].depth_mm)\n"
        "reveal_type(PROBES['phased'].focus_mm)\n"
    )
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(LOGIC.parents[1])]}))
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    report = json.loads(done.stdout)
    assert report["summary"]["errorCount"] == 0, report["generalDiagnostics"]
    revealed = [entry["message"] for entry in report["generalDiagnostics"] if entry["severity"] == "information"]
    assert revealed[0].startswith('Type of "UltrasoundSimulator.simulate" is "(self: UltrasoundSimulator, probe: Probe')
    assert revealed[0].endswith('-> Frame"')
    assert [text.split(" is ")[-1] for text in revealed[1:]] == ['"float"', '"float"']


@pytest.mark.slow
def test_faces_work_in_a_build_without_source_files(tmp_path):
    """Slicer can be packaged with compiled files alone."""
    copy = tmp_path / "SlicerUSSim" / "Logic"
    shutil.copytree(LOGIC, copy, ignore=shutil.ignore_patterns("__pycache__"))
    assert compileall.compile_dir(copy, quiet=1, legacy=True)
    for source in copy.rglob("*.py"):
        source.unlink()
    names = {face: sorted(declared(face)) for face in FACES if not face.endswith(".mrml")}
    code = f"""
import importlib, sys
sys.path.insert(0, {str(tmp_path)!r})
for face, names in {names!r}.items():
    package = importlib.import_module(face)
    assert package.__file__.startswith({str(tmp_path)!r}) and dir(package) == names, face
    for name in names:
        getattr(package, name)
print("fine")
"""
    assert fresh(code) == "fine"
