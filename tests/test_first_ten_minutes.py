"""The first ten minutes in Slicer's newest libraries, with the packages that the module installs and no others."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from SlicerUSSim.Logic.mri.brain import find_brain
from tests.test_brain import whole_head

ROOT = Path(__file__).parents[1]
#: SimpleITK is in every Slicer, but not in its wheel
_SLICER = ("slicer-core==5.13.31053", "SimpleITK")


@pytest.fixture(scope="module")
def bare_python(tmp_path_factory) -> Path:
    """A Python with Slicer's libraries and the packages of requirements.txt."""
    folder = tmp_path_factory.mktemp("bare")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    requirements = ROOT / "SlicerUSSim/Resources/USSim/requirements.txt"
    install = [str(python), "-m", "pip", "install", "-q", *_SLICER, "-r", str(requirements)]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"the package index is out of reach, or has no slicer-core for this Python: {done.stderr[-200:]}")
    return python


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the module brings an OpenCL runtime on Linux")
def test_the_first_ten_minutes_work_with_the_modules_packages(bare_python, tmp_path):
    """A whole head was refused: "no program for brain extraction is installed"."""
    head, brain = whole_head()
    mask = find_brain(head).mask.array > 0  # by what is installed here
    file = tmp_path / "head.npz"
    np.savez(file, head=head.array, brain=brain, mask=mask, ijk_to_ras=head.ijk_to_ras)
    environment = {name: text for name, text in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(bare_python), str(ROOT / "tests/first_ten_minutes.py"), str(file), str(tmp_path / "work")],
        capture_output=True, text=True, env={**environment, "PYTHONPATH": str(ROOT)}, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    result = json.loads(done.stdout.splitlines()[-1])
    print(json.dumps(result["seconds"], indent=1))
    found = result["found"]
    assert found["overlap"] > 0.95 and found["mask is the same"]
    assert "brain extracted by the atlas" in found["notes"] and "guided by the MNI152 atlas" in found["notes"]
    assert "Build kernels, once on this computer" in found["titles"] or result["seconds"]["Segment"] > 20
    assert found["changed"] > 0.02 and found["after close"] == ["", "", False, False]
    assert found["loaded"] == ["Head", "Head tissues", "Probe"] and found["images"] == 5
    assert found["gain"] == pytest.approx(9.0, abs=1.5)
