"""Races between work-items and accesses out of bounds, which Oclgrind finds while it interprets the kernels."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

LIBRARY = next(Path("/usr/lib").rglob("liboclgrind-rt-icd.so"), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(LIBRARY is None, reason="Oclgrind is missing: apt-get install oclgrind"),
]
SCENES = Path(__file__).parents[1] / "benchmarks" / "small_scenes.py"
#: What it says of a kernel
FOUND = ("Invalid read", "Invalid write", "data race", "divergence", "Uninitialized")
#: Writes behind its buffer, where its neighbour writes, too
WRONG = """
import numpy as np, pyopencl as cl
context = cl.Context(cl.get_platforms()[0].get_devices())
queue, numbers = cl.CommandQueue(context), np.zeros(4, np.float32)
buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=numbers)
program = cl.Program(context, '''kernel void wrong(global float *out) {
  const int i = get_global_id(0);
  out[i / 2] = i;
  if (i == 3) out[5] = 1.0f;
}''').build()
program.wrong(queue, (4,), (1,), buffer)
queue.finish()
"""


@pytest.fixture
def oclgrind(tmp_path):
    """The environment in which it is the only device."""
    (tmp_path / "vendors").mkdir()
    (tmp_path / "vendors" / "oclgrind.icd").write_text(f"{LIBRARY}\n")
    return {
        **os.environ, "OCL_ICD_VENDORS": str(tmp_path / "vendors"), "OCLGRIND_DATA_RACES": "1",
        "PYOPENCL_NO_CACHE": "1", "USSIM_DEVICE": "Oclgrind",
    }  # fmt: skip


def run(environment: dict[str, str], *arguments: object) -> str:
    """The output of a Python program that ends well."""
    found = subprocess.run([sys.executable, *map(str, arguments)], env=environment, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    return found.stdout + found.stderr


def test_it_finds_what_is_wrong(oclgrind):
    said = run(oclgrind, "-c", WRONG)
    assert "Invalid write" in said and "data race" in said


def test_kernels_have_no_races_and_stay_in_their_buffers(oclgrind, tmp_path):
    """Random small scenes: probes, settings, tissues, sheets, texture, turned voxels."""
    seeds = (tmp_path / "signals", "--seeds", 0, 2)
    said = run(oclgrind, SCENES, *seeds)
    assert len(list((tmp_path / "signals").glob("*.npy"))) == 2
    assert not [line for line in said.splitlines() if any(words in line for words in FOUND)], said
    here = {name: value for name, value in os.environ.items() if name != "USSIM_DEVICE"}
    differences = [float(text) for text in re.findall(r"differs by (\S+)", run(here, SCENES, *seeds))]
    assert len(differences) == 2
    # It rounds divisions and roots in its own way: 1.6e-5 and 3.5e-2 of the largest value of a scene.
    assert min(differences) < 2e-5 and max(differences) < 6e-2
