"""3D Slicer finds and loads the module from all locations: the sources, a renamed folder, a wheel, both at once.

Each time in a separate Python, where sys.path has nothing of this package but what Slicer puts there
(slicer_factory.py says which sources of Slicer are imitated). test_cmake.py does the same with the build and the
installed tree.
"""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.slicer_factory import found_by_wizard, is_command_line_module, is_scripted_module

ROOT = Path(__file__).parents[1]
_IGNORED = shutil.ignore_patterns("__pycache__")
needs_slicer = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("slicer", "PySide6"))),
    reason="MRML nodes and Qt are missing: pip install '.[slicer]' PySide6-Essentials",
)

_DRIVER = """
import importlib.util, json, os, sys
from pathlib import Path

options = json.loads(sys.argv[1])
os.environ["QT_QPA_PLATFORM"] = "offscreen"
sys.path[:] = [path for path in sys.path if path and not Path(path, "SlicerUSSim", "Logic").is_dir()]
sys.path[:0] = options["site"] + [options["tests"]]
import slicer_factory, slicer_stand_in
app = slicer_stand_in.start()
for statement in options["first"]:
    exec(statement)
factory = slicer_factory.Factory(*map(Path, options["paths"]))
factory.start()

result = {"files": list(map(str, factory.files.values())), "errors": factory.errors, "modules": list(factory.modules)}
if factory.modules:
    result["early"] = [name for name in sys.modules if name.startswith("SlicerUSSim.")]
    import slicer
    from SlicerUSSim.Logic.opencl.device import kernel_folder
    slicer.mrmlScene = slicer.vtkMRMLScene()
    sequences = slicer.vtkSlicerSequencesLogic()
    sequences.SetMRMLScene(slicer.mrmlScene)  # as Slicer does
    module = sys.modules["USSim"]
    parent = slicer_stand_in.QtWidgets.QWidget()
    slicer_stand_in.QtWidgets.QVBoxLayout(parent)
    parent.isEntered = True
    widget = module.USSimWidget(parent)
    widget.setup()
    if options["self_test"]:
        module.USSimTest().runTest()
    import SlicerUSSim.Logic.fitting.report
    report = Path(sys.modules["SlicerUSSim.Logic.fitting.report"].__file__).parent
    result |= {
        "kernels": str(kernel_folder()), "shown": app.shown, "messages": app.errors,
        "html": (report / "report.html").exists(),
        "imported": [m.__file__ for name, m in sys.modules.items() if name.startswith("SlicerUSSim.")],
        "module_spec": importlib.util.find_spec("SlicerUSSim").name,
        "tops": [name for name in ("Logic", "Widget") if name in sys.modules],
        "icon": Path(factory.files["USSim"].parent, "Resources", "Icons", "USSim.png").exists(),
    }
    widget.cleanup()
print(json.dumps(result))
"""


def load(*module_paths: Path, site: Path | None = None, first: str = "", self_test: bool = False) -> dict:
    """The result of starting Slicer with these module paths and opening the panel, or running the self test.

    `site` is an installed wheel's folder, before all others; the statement `first` is executed before Slicer's factory
    is at work.
    """
    options = {
        "paths": [str(path) for path in module_paths],
        "site": [] if site is None else [str(site)],
        "first": [first] if first else [],
        "tests": str(ROOT / "tests"),
        "self_test": self_test,
    }
    done = subprocess.run(
        [sys.executable, "-I", "-c", _DRIVER, json.dumps(options)], capture_output=True, text=True, cwd="/"
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1]) | {"log": done.stderr}


def assert_loaded_from(result: dict, module_file: Path, package: Path, kernels: Path) -> None:
    """The module is USSim, the log is empty, and all modules of the package come from `package`."""
    assert result["errors"] == [] and result["modules"] == ["USSim"]
    assert result["files"] == [str(module_file)] and result["icon"] and result["html"]
    assert result["early"] == [], "imported at start-up"
    assert len(result["imported"]) > 20
    assert [path for path in result["imported"] if not Path(path).is_relative_to(package)] == []
    assert result["kernels"] == str(kernels) and not result["messages"]
    assert result["module_spec"] == "SlicerUSSim" and not result["tops"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """site-packages as the wheel is laid out, by the rules in pyproject.toml."""
    tomllib = pytest.importorskip("tomllib")
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    site = tmp_path_factory.mktemp("site-packages")
    for package in rules["packages"]:
        shutil.copytree(ROOT / package, site / package, ignore=_IGNORED)
    for source, target in rules["force-include"].items():
        shutil.copytree(ROOT / source, site / target, ignore=_IGNORED)
    return site


@pytest.fixture
def stale_wheel(wheel, tmp_path) -> Path:
    """An older version in site-packages, a package with an __init__.py."""
    site = tmp_path / "stale"
    shutil.copytree(wheel, site)
    (site / "SlicerUSSim" / "__init__.py").write_text("")
    (site / "SlicerUSSim" / "Logic" / "base" / "version.py").write_text('__version__ = "0.0.1"\n')
    return site


@pytest.mark.slow
@needs_slicer
def test_from_a_folder_of_another_name(tmp_path):
    folder = tmp_path / "SlicerUSSim-main" / "xyz"
    shutil.copytree(ROOT / "SlicerUSSim", folder, ignore=_IGNORED)
    shutil.copytree(ROOT / "kernels", folder.parent / "kernels")
    assert_loaded_from(load(folder), folder / "USSim.py", folder, folder.parent / "kernels")


@pytest.mark.slow
@needs_slicer
def test_from_a_wheel(wheel):
    folder = wheel / "SlicerUSSim"
    result = load(folder, site=wheel, self_test=True)
    assert_loaded_from(result, folder / "USSim.py", folder, folder / "kernels")
    assert result["shown"][-1] == "Test passed" and "deprecated" not in result["log"]


@pytest.mark.slow
@needs_slicer
def test_the_folder_counts_where_another_version_was_imported_first(stale_wheel):
    folder = ROOT / "SlicerUSSim"
    first = "from SlicerUSSim.Logic.base import version; assert version.__version__ == '0.0.1'"
    result = load(folder, site=stale_wheel, first=first)
    assert_loaded_from(result, folder / "USSim.py", folder, ROOT / "kernels")


def test_a_wheel_holds_what_is_not_python_too(wheel):
    files = {path.relative_to(wheel / "SlicerUSSim").as_posix() for path in wheel.rglob("*") if path.is_file()}
    assert {
        "USSim.py", "Resources/Icons/USSim.png", "Resources/USSim/requirements.txt", "Logic/fitting/report.html",
        "Logic/py.typed", "Logic/mri/mni152.npz", "Logic/mri/mni152.txt", "Workstation/static/workstation.js",
        "kernels/common.clh", "kernels/bmode.cl",
    } <= files  # fmt: skip
    assert "__init__.py" not in files


def test_a_wheel_holds_data_and_the_notice_has_their_licences(wheel):
    files = {path for path in wheel.rglob("*") if path.is_file()}
    licences = re.search(r"^license-files = (\[.+\])$", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert licences and {"LICENSE", "NOTICE", "SlicerUSSim/Logic/mri/mni152.txt"} <= set(json.loads(licences[1]))
    listed = re.findall(r"^\S+/\S+$", (ROOT / "NOTICE").read_text(), re.MULTILINE)
    assert all(any(ROOT.glob(pattern)) for pattern in listed)
    data = {path for path in files if path.suffix in (".csv", ".gz", ".json", ".npy", ".npz", ".png", ".toml", ".ttf")}
    assert len(data) > 20 and data == {path for pattern in listed for path in wheel.glob(pattern)}


def test_the_wheels_module_is_found_as_the_documentation_says(wheel):
    """docs/slicer.md: the package has no __file__, being a namespace package, and its module is not imported yet."""
    text = (ROOT / "docs" / "slicer.md").read_text()
    line = next(line for line in text.splitlines() if line.startswith("module = "))
    code = f"import importlib.util, sys; {line}; print(module); assert 'SlicerUSSim.USSim' not in sys.modules"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd="/", env={"PYTHONPATH": str(wheel)}
    )
    assert done.stdout.strip() == str(wheel / "SlicerUSSim" / "USSim.py"), done.stderr


def test_nothing_beside_the_module_is_mistaken_for_another():
    """Slicer runs every .py file beside a module, and asks every file without a dot what it can do."""
    files = [path for path in (ROOT / "SlicerUSSim").iterdir() if path.is_file()]
    assert [path.name for path in files if is_scripted_module(path)] == ["USSim.py"]
    assert not any(map(is_command_line_module, files))


@pytest.mark.parametrize("dropped", [".", "SlicerUSSim", "SlicerUSSim/USSim.py"])
def test_the_extension_wizard_and_drag_and_drop_find_the_module(dropped):
    assert found_by_wizard(ROOT / dropped) == [ROOT / "SlicerUSSim" / "USSim.py"]
