"""Each page in docs says first what it is for, and its first example runs and writes the files that it names."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import HTTPCookieProcessor, build_opener

import nibabel
import numpy as np
import pytest
from PIL import Image

from SlicerUSSim.Logic.tracked.pose_files import write_pose
from tests.conftest import coarse_chest
from tests.test_brain import ellipsoid, whole_head
from tests.test_docs import ROOT
from tests.test_label_maps import head as labelled_head

pytestmark = pytest.mark.slow

PAGES = sorted(ROOT.glob("docs/*.md"))
#: Lines that install what this environment has.
INSTALLS = re.compile(r"^pip install .*\n", re.MULTILINE)
FILE = re.compile(r"(?<![\w.])[\w./-]+\.(?:nii\.gz|html|igs\.mha|json|mgz|mrb|png|py|tfm|toml|vtp)\b")
#: Libraries that optional parts of the package need
NEEDS = {
    "datasets": "zarr", "device": "pyigtl", "scale": "distributed", "security": "trame_slicer", "slicer": "slicer",
    "tracked-ultrasound": "pyigtl", "workstation": "trame_slicer",
}  # fmt: skip
RECIPE = """
images = 8
shard = 4
[[patients]]
file = "labels.nii.gz"
[settings]
quality = "draft"
"""


@pytest.fixture(scope="module")
def inputs(files, tmp_path_factory) -> Path:
    """The files that the examples read, by the names that they use."""
    folder = tmp_path_factory.mktemp("inputs")
    for name, source in {"brain": "head", "labels": "labels", "untrusted": "labels"}.items():
        shutil.copy(files / f"{source}.nii.gz", folder / f"{name}.nii.gz")
    for name in ("sweep.igs.mha", "probe.json"):
        shutil.copy(files / name, folder)
    write_pose(folder / "reference-to-mri.tfm", np.eye(4))
    grid, radius = ellipsoid((70, 85, 65))
    chest, labelled = coarse_chest(), labelled_head()
    nibabel.save(nibabel.MGHImage(labelled.array.T, labelled.ijk_to_ras), folder / "aseg.mgz")
    for name, volume in {
        "head": whole_head()[0], "ct": chest.ct, "total": chest.organs,
        "tumour": grid.with_array((radius < 0.15).astype(np.uint8)),
    }.items():  # fmt: skip
        volume.write(folder / f"{name}.nii.gz")
    (folder / "recipe.toml").write_text(RECIPE)
    return folder


def first_example(page: Path) -> tuple[str, str]:
    """(language, code) of the first example, without lines that install."""
    found = re.search(r"^```(bash|python)\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert found, "a page has an example, in bash or Python"
    return found[1], INSTALLS.sub("", found[2])


def first_answer(said: str) -> bytes:
    """What a server answers at the address that it prints."""
    if url := re.search(r"http://\S+", said):
        return build_opener(HTTPCookieProcessor()).open(url[0], timeout=60).read()  # the token becomes a cookie
    host, port = re.search(r"may connect to (\S+):(\d+)", said).groups()
    with socket.create_connection((host, int(port)), timeout=60) as connection:
        return connection.recv(100)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_begins_with_its_purpose_and_an_example(page):
    text = page.read_text(encoding="utf-8")
    assert re.match(r"# .+\n\nThis page ", text)
    assert text.partition(f"```{first_example(page)[0]}\n")[0].count("\n") < 25


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_first_example_of_a_page_runs(page, inputs, tmp_path):
    if page.stem in NEEDS:
        pytest.importorskip(NEEDS[page.stem])
    language, code = first_example(page)
    commands = re.sub(r"\s#.*", "", code)
    written = re.findall(r"-o (\S+)", commands)
    for path in ROOT.glob("[!.]*"):  # examples of developers run in a checkout
        (tmp_path / path.name).symlink_to(path)
    for path in inputs.iterdir():
        if path.name not in written:
            shutil.copy(path, tmp_path)
    log = tmp_path / "log"
    search = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", code] if language == "python" else ["bash", "-e", "-c", code],
            cwd=tmp_path, env={**os.environ, "PATH": search, "PYTHONPATH": str(ROOT)}, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
        )  # fmt: skip
    try:
        if re.search(r"^ussim (serve|device)", code, re.MULTILINE):
            while process.poll() is None and not re.search(r"http://|may connect to", log.read_text()):
                time.sleep(0.2)
            assert process.poll() is None, log.read_text()
            assert first_answer(log.read_text())
        else:
            assert process.wait(timeout=600) == 0, log.read_text()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(timeout=60)
    assert [name for name in [*written, *FILE.findall(commands)] if not (tmp_path / name).exists()] == []
    pictures = re.findall(r"\(images/(.+?/.+?)\)", page.read_text(encoding="utf-8"))
    drawn = [name for name in pictures if Path(name).parent.name in written]
    assert [name for name in drawn if np.asarray(Image.open(tmp_path / name))[30:].std() < 20] == []
    printed = re.findall(r"^print\(.*\)  # (.+)", code, re.MULTILINE)
    assert [text for text in printed if text not in log.read_text()] == []
