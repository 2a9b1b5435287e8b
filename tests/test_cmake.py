"""The extension's build: configured with a stand-in for Slicer, complete, and what it makes runs."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = "lib/Slicer-5.10/qt-scripted-modules"


def tool(name: str) -> str | None:
    """The program of a pip package, beside this Python, or of the system."""
    return shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)


CMAKE, NINJA = tool("cmake"), tool("ninja")
pytestmark = pytest.mark.skipif(None in (CMAKE, NINJA), reason="CMake is missing: pip install cmake ninja")


@pytest.fixture(scope="module")
def build(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("build")
    subprocess.run(
        [
            *(CMAKE, "-S", ROOT, "-B", folder, "-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={NINJA}"),
            *(f"-DSlicer_DIR={ROOT / 'tests/slicer_cmake'}", "-DBUILD_TESTING=ON"),
            f"-DCMAKE_INSTALL_PREFIX={folder / 'installed'}",
        ],
        check=True,
        capture_output=True,
        text=True,
    )
    return folder


@pytest.fixture(scope="module")
def record(build) -> dict[str, list[str]]:
    asked: dict[str, list[str]] = {}
    for line in (build / "record.txt").read_text().splitlines():
        name, _, value = line.partition(" ")
        asked.setdefault(name, []).append(value)
    return asked


def files(folder: Path, pattern: str) -> set[str]:
    found = (path for path in folder.rglob(pattern) if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in found}


def test_every_script_and_resource_of_the_package_is_listed(record):
    package = ROOT / "SlicerUSSim"
    # Slicer has no use for the command and for the workstation in the browser; CMakeLists.txt itself is not installed.
    scripts = {
        path
        for path in files(package, "*.py")
        if path != "__init__.py" and not path.startswith(("Command/", "Widget/browser/"))
    }
    assert set(record["SCRIPTS"]) == scripts and len(scripts) == len(record["SCRIPTS"])
    assert set(record["RESOURCES"]) == {f"Resources/{path}" for path in files(package / "Resources", "*")}
    assert record["NAME"] == ["SlicerUSSim"] and record["TEST"] == ["SlicerUSSim.py"]


def test_every_kernel_is_beside_the_module_in_the_build_and_the_installed_tree(build):
    kernels = files(ROOT / "kernels", "*")
    assert len(kernels) > 8 and files(build / MODULES / "kernels", "*") == kernels
    subprocess.run([CMAKE, "--install", build], check=True, capture_output=True)
    assert files(build / "installed" / MODULES / "kernels", "*") == kernels


def test_the_extension_says_what_the_extensions_index_wants(record):
    for name in ("HOMEPAGE", "CATEGORY", "CONTRIBUTORS", "DESCRIPTION", "DEPENDS"):
        assert record[f"EXTENSION_{name}"][0].strip(), name
    for url in [*record["EXTENSION_ICONURL"], *record["EXTENSION_SCREENSHOTURLS"][0].split()]:
        base = "https://raw.githubusercontent.com/SlicerUSSim/SlicerUSSim/main/"
        assert url.startswith(base) and (ROOT / url.removeprefix(base)).exists(), url
    assert Path(record["EXTENSION_LICENSE_FILE"][0]).exists()
    entry = json.loads((ROOT / "SlicerUSSim.json").read_text())
    assert entry["category"] == record["EXTENSION_CATEGORY"][0]
    assert entry["scm_url"] == record["EXTENSION_HOMEPAGE"][0] + ".git"


def test_the_built_module_simulates_with_its_own_kernels(build):
    pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
    pytest.importorskip("PySide6", reason="the panel is tested on Qt for Python: pip install PySide6-Essentials")
    code = f"""
        import os, sys
        from pathlib import Path
        os.environ["QT_QPA_PLATFORM"] = "offscreen"
        from tests import slicer_stand_in as stand_in
        stand_in.MODULE_FILE = Path({str(build / MODULES / "SlicerUSSim.py")!r})
        stand_in.start()
        for name in [name for name in sys.modules if name.split(".")[0] == "SlicerUSSim"]:
            del sys.modules[name]
        module = stand_in.load_module()
        import slicer
        slicer.mrmlScene = slicer.vtkMRMLScene()
        module.SlicerUSSimTest().runTest()
        from SlicerUSSim.Logic.opencl.device import kernel_folder
        assert kernel_folder() == stand_in.MODULE_FILE.parent / "kernels", kernel_folder()
        print("fine")
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and done.stdout.strip().endswith("fine"), done.stderr[-2000:]
