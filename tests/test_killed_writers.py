"""Writers that are killed, or fail, at every step: the file is the old or the new one, and the next run cleans up."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")

_STEPS = """
import errno, os, shutil, sys
from pathlib import Path
import numpy as np
from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Logic.base.files import write_json
from SlicerUSSim.Logic.tissue import Surfels
from SlicerUSSim.Logic.mri.sheets.polydata import read_surfels, write_surfels
from SlicerUSSim.Logic.tracked.pose_files import read_pose, write_pose
import SimpleITK, nrrd

place, how, *names = sys.argv[1:]


def write(value):
    if name.startswith("p."):
        pose = np.eye(4)
        pose[:3, 3] = value
        write_pose(path, pose)
    elif name.endswith(".vtp"):
        points = np.full((20, 3), value, np.float32)
        write_surfels(path, Surfels.of("falx", points, np.tile([0.0, 0.0, 1.0], (20, 1)), 0.3, 1.0, 1.0))
    elif name.endswith(".json"):
        write_json(path, {"values": [value] * 500})
    elif ".seq." in name or ".igs." in name:
        images = np.full((3, 20, 30), value, np.uint8)
        TrackedSequence(images, ({"ImageToReference": np.eye(4)},) * 3, np.arange(3.0)).write(path)
    else:
        Volume(np.full((6, 7, 8), value, np.int16), np.eye(4)).write(path)


def value_of():
    if name.startswith("p."):
        values = read_pose(path)[:3, 3].round(6).tolist()
    elif name.endswith(".vtp"):
        values = read_surfels(path).place.ravel().tolist()
    elif name.endswith(".json"):
        values = eval(path.read_text())["values"]
    elif ".seq." in name or ".igs." in name:
        values = TrackedSequence.read(path).images.ravel().tolist()
    else:
        values = Volume.read(path).array.ravel().tolist()
    assert len(set(values)) == 1, "halves of two runs"
    return values[0]


def stop_at(step):
    left = [step]

    def counted(function):
        def call(*arguments, **more):
            left[0] -= 1
            if left[0] < 0:
                if how == "kill":
                    os._exit(9)
                if left[0] == -1:
                    raise OSError(errno.ENOSPC, "as the disk says")
            return function(*arguments, **more)
        return call

    for owner, function in ((os, "fsync"), (os, "replace"), (os, "rename"), (os, "mkdir"), (os, "unlink")):
        setattr(owner, function, counted(getattr(owner, function)))
    for function in ("write_bytes", "write_text", "unlink"):
        setattr(Path, function, counted(getattr(Path, function)))


for name in names:
    path = Path(place, name, name)
    path.parent.mkdir()
    write(1)
    steps = 0
    for step in range(60):
        child = os.fork()
        if child == 0:
            stop_at(step)
            try:
                write(2)
            except SimulationError as error:
                assert str(path) in str(error) and "\\n" not in str(error)
                os._exit(7)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert status in (0, 7, 9), status
        found = value_of()
        assert found in (1, 2) and (status != 0 or found == 2), (step, status, found)
        if how != "kill":
            assert not list(path.parent.glob(".ussim-*")), "something is left of a run that failed"
        if status == 0:
            break
        steps += 1
        write(1)
        left = sorted(file.name for file in path.parent.iterdir())
        assert len(left) <= 2 and value_of() == 1, left
    else:
        raise AssertionError("it never succeeds")
    assert steps >= 3, name
"""


NAMES = ("p.tfm", "p.h5", "s.vtp", "t.json", "s.igs.mha", "v.nii.gz", "v.nrrd", "v.vti")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["kill", "fail"])
def test_at_every_step_the_file_is_the_old_or_the_new_one(how, tmp_path: Path):
    done = subprocess.run([sys.executable, "-c", _STEPS, tmp_path, how, *NAMES], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-1500:]
