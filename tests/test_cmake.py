"""The extension: built and installed with a substitute for Slicer, loaded from there, valid for the Extensions Index.

tests/slicer_cmake/SlicerConfig.cmake lays files out as Slicer's build does. The Index's rules are in
scripts/check_description_files.py and schemas/slicer-extension-catalog-entry-schema-v1.0.2.json in
Slicer/ExtensionsIndex, as far as they can be held without the network.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.test_slicer_loading import assert_loaded_from, load, needs_slicer

ROOT = Path(__file__).parents[1]
MODULES = "lib/Slicer-5.10/qt-scripted-modules"
CMAKE_TEXT = (ROOT / "CMakeLists.txt").read_text()
ENTRY_FILE = ROOT / "USSim.json"


def tool(name: str) -> str | None:
    """The program of a pip package, next to this Python, or of the system."""
    return shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)


CMAKE, NINJA = tool("cmake"), tool("ninja")
needs_cmake = pytest.mark.skipif(None in (CMAKE, NINJA), reason="CMake is missing: pip install cmake ninja")


def run_cmake(*arguments) -> str:
    return subprocess.run([CMAKE, *map(str, arguments)], check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def build(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("build")
    run_cmake(
        *("-S", ROOT, "-B", folder, "-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={NINJA}", "-DBUILD_TESTING=ON"),
        *(f"-DSlicer_DIR={ROOT / 'tests/slicer_cmake'}", f"-DCMAKE_INSTALL_PREFIX={folder / 'installed'}"),
    )
    run_cmake("--build", folder)
    return folder


@pytest.fixture(scope="module")
def installed(build) -> Path:
    """The installed module folder, where another extension has files of its own already."""
    folder = build / "installed" / MODULES
    for name in ("Resources/requirements.txt", "Resources/Icons/Other.png", "Logic/__init__.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("another extension's\n")
    run_cmake("--install", build)
    return folder


@pytest.fixture(scope="module")
def record(build) -> dict[str, list[str]]:
    asked: dict[str, list[str]] = {}
    for line in (build / "record.txt").read_text().splitlines():
        name, _, value = line.partition(" ")
        asked.setdefault(name, []).append(value)
    return asked


def files(folder: Path, pattern: str = "*") -> set[str]:
    found = (path for path in folder.rglob(pattern) if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in found}


# ---- build and install -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@needs_cmake
def test_the_module_its_resources_and_one_folder_are_installed(build, installed):
    package = ROOT / "SlicerUSSim"
    wanted = {"USSim.py"} | {f"Resources/{path}" for path in files(package / "Resources")}
    for folder in ("Logic", "Widget"):  # Slicer has no use for the command and the workstation in the browser
        wanted |= {f"SlicerUSSim/{folder}/{path}" for path in files(package / folder)}
    wanted |= {f"SlicerUSSim/kernels/{path}" for path in files(ROOT / "kernels")}
    data = {
        "Logic/fitting/report.html",
        "Logic/imaging/golden/convex.png",
        "Logic/mri/mni152.npz",
        "Logic/mri/mni152.txt",
        "Logic/py.typed",
        "Logic/tissue/labels/spm.csv",
    }
    assert {f"SlicerUSSim/{path}" for path in data} | {"Resources/Icons/USSim.png"} <= wanted
    # Resources of other extensions are in the same folders: a name such as Resources/UI/Settings.ui could conflict.
    mine = files(package / "Resources")
    assert all("USSim" in Path(path).parts or Path(path).stem == "USSim" for path in mine)
    assert files(build / MODULES) == wanted
    others = {"Resources/requirements.txt", "Resources/Icons/Other.png", "Logic/__init__.py"}
    assert files(installed) == wanted | others
    assert all((installed / name).read_text() == "another extension's\n" for name in others)


@pytest.mark.slow
@needs_cmake
def test_slicer_is_asked_for_the_module_and_its_test(record):
    assert record["NAME"] == ["USSim", "SlicerUSSim"] and record["TEST"] == ["USSim.py"]


@needs_cmake
@needs_slicer
@pytest.mark.slow
def test_the_installed_module_loads_beside_other_extensions(installed):
    """Another extension's Logic on sys.path is not affected."""
    package = installed / "SlicerUSSim"
    assert_loaded_from(load(installed), installed / "USSim.py", package, package / "kernels")


@needs_cmake
@needs_slicer
@pytest.mark.slow
def test_a_build_without_source_files_loads_too(build, tmp_path):
    """CTK_COMPILE_PYTHON_SCRIPT_KEEP_ONLY_PYC: .pyc files in the place of .py files."""
    folder = shutil.copytree(build / MODULES, tmp_path / "compiled")
    subprocess.run([sys.executable, "-m", "compileall", "-q", "-b", folder], check=True)
    for file in folder.rglob("*.py"):
        file.unlink()
    package = folder / "SlicerUSSim"
    assert_loaded_from(load(folder), folder / "USSim.pyc", package, package / "kernels")


# ---- the Extensions Index --------------------------------------------------------------------------------------------


def entry() -> dict:
    return json.loads(ENTRY_FILE.read_text())


def test_the_entry_has_the_fields_of_the_schema_and_no_others():
    required = {"$schema", "category", "scm_url"}
    kinds = {
        "$schema": str, "category": str, "scm_url": str, "scm_revision": str, "scm_type": str,
        "build_dependencies": list, "dicom_support_rule": str, "build_subdirectory": str, "enabled": bool, "tier": int,
    }  # fmt: skip
    values = entry()
    assert required <= set(values) <= set(kinds)
    assert all(type(value) is kinds[name] for name, value in values.items())
    assert values["scm_type"] == "git" and 1 <= values["tier"] <= 5 and values["build_dependencies"] == []
    assert values["category"] == "Ultrasound"  # of ACCEPTED_EXTENSION_CATEGORIES
    assert re.search(r"/slicer-extension-catalog-entry-schema-v1\.0\.[12]\.json#$", values["$schema"])
    assert b"\r" not in ENTRY_FILE.read_bytes()


def test_the_extension_is_called_as_the_index_wants():
    name = ENTRY_FILE.stem
    assert not name.lower().startswith("slicer")
    assert re.findall(r"project\s*\(\s*([^\s\)\n\r]+)", CMAKE_TEXT, re.IGNORECASE)[0] == name
    url = urlsplit(entry()["scm_url"])
    assert url.scheme in ("git", "https") and Path(url.path).stem == f"Slicer{name}"  # the repository's name


@pytest.mark.parametrize("variable", ["ICONURL", "SCREENSHOTURLS"])
def test_the_pictures_lie_where_their_addresses_say(variable):
    """The Index reads them from CMakeLists.txt with these expressions, and loads them."""
    (text,) = re.findall(rf'set\s*\(EXTENSION_{variable}\s*"([^"]+)"[ ]*\)', CMAKE_TEXT, re.IGNORECASE)
    urls = text.split()
    assert urls
    for url in urls:
        base = "https://raw.githubusercontent.com/SlicerUSSim/SlicerUSSim/main/"
        assert url.startswith(base) and url.endswith(".png")
        assert (ROOT / url.removeprefix(base)).read_bytes().startswith(b"\x89PNG"), url


@pytest.mark.slow
@needs_cmake
def test_the_build_and_the_entry_say_the_same(record):
    for name in ("HOMEPAGE", "CATEGORY", "CONTRIBUTORS", "DESCRIPTION", "DEPENDS"):
        assert record[f"EXTENSION_{name}"][0].strip(), name
    assert Path(record["EXTENSION_LICENSE_FILE"][0]).exists() and Path(record["EXTENSION_README_FILE"][0]).exists()
    assert entry()["category"] == record["EXTENSION_CATEGORY"][0]
    assert entry()["scm_url"] == record["EXTENSION_HOMEPAGE"][0] + ".git"
    assert record["EXTENSION_DEPENDS"] == ["NA"] and entry()["build_dependencies"] == []
