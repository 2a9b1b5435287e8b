"""Ctrl-C: a command ends with one line, and leaves the files as they were or complete; and signals in libraries."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from benchmarks.twins import make_twin
from SlicerUSSim.Logic import PhasedProbe, TissueTable, segment_mri
from SlicerUSSim.Logic.base.files import write_json
from SlicerUSSim.Logic.mri.samples import head_mri

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send")]


@pytest.fixture(autouse=True)
def heard():
    """Where tests run in the background of a script, SIGINT is ignored, also by the processes that they start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupted_fit_leaves_nothing_half_done(tmp_path):
    segmentation = segment_mri(head_mri(3.5), thin_sulci=False)
    probe = PhasedProbe(70.0, 50.0, scan_lines=80)
    twin = make_twin(segmentation.labels, TissueTable.brain(segmentation.tissue_names), 3, probe=probe)
    twin.simulator.medium.labels.write(tmp_path / "labels.nii.gz")
    twin.simulator.medium.tissues.write(tmp_path / "labels.json")
    twin.sequence().write(tmp_path / "tracked.igs.mha")
    write_json(tmp_path / "probe.json", probe.to_dict())
    inputs = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    command = (
        "optimize labels.nii.gz --sequence tracked.igs.mha --probe probe.json "
        "--set fit.restarts=0 --set fit.evaluations=100000 -o out.json"
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "SlicerUSSim.Command", *command.split()], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    assert process.stdout is not None
    while not process.stdout.readline().startswith("global: cost"):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate()
    assert process.returncode == 130 and said.rstrip().endswith("ussim: interrupted") and "Traceback" not in said
    assert {path.name for path in tmp_path.iterdir()} == set(inputs)
    for file, content in inputs.items():
        assert (tmp_path / file).read_bytes() == content


_IN_A_LIBRARY = """
import sqlite3, sys
from SlicerUSSim.Command import cli

@cli.main.command()
def compute():
    print("begun", flush=True)  # then a library, which ignores signals, computes forever, as a kernel may
    sqlite3.connect(":memory:").execute(
        "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT count(*) FROM c"
    ).fetchall()

cli.main(["compute"])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize(
    ("number", "before"),
    [
        (signal.SIGINT, ""),
        # As in the background of a shell script
        (signal.SIGTERM, "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"),
    ],
)
def test_a_signal_ends_the_process_while_a_library_computes(number, before):
    with subprocess.Popen(
        [sys.executable, "-c", before + _IN_A_LIBRARY], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "begun\n"
            process.send_signal(number)
            _, said = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 128 + number
    assert said in ("ussim: interrupted\n", "")


_IN_AN_IMPORT = """
import sys, time
import click
from SlicerUSSim.Command import cli

@cli.main.command()
def load():
    import loaded
    print("imported", flush=True)
    time.sleep(60)

sys.argv = ["ussim", "load"]
cli.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_an_import_waits_for_its_end(number, tmp_path):
    """VTK's modules, and others in C, end the process by SIGSEGV where what they import raises KeyboardInterrupt."""
    (tmp_path / "loaded.py").write_text(f"import signal\nsignal.raise_signal({int(number)})\nsum(range(10**5))\n")
    done = subprocess.run(
        [sys.executable, "-c", _IN_AN_IMPORT], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])},
    )  # fmt: skip
    assert done.returncode == 128 + number and done.stdout == "imported\n"
    assert done.stderr == ("ussim: interrupted\n" if number == signal.SIGINT else "")


_ENDS_DURING_A_CALL_BACK = """
import threading, time, types
import SimpleITK as sitk
from SlicerUSSim.Command.serve import _run
from SlicerUSSim.Workstation.tasks import Tasks

begun, tasks = threading.Event(), Tasks(print)

def compute():
    smooth = sitk.CurvatureFlowImageFilter()
    smooth.SetNumberOfIterations(10**8)
    smooth.AddCommand(sitk.sitkProgressEvent, begun.set)  # from C++ back to Python, again and again
    smooth.Execute(sitk.Image(16, 16, 16, sitk.sitkFloat32))

class Slow:  # Python's end takes a while
    def __del__(self):
        time.sleep(0.5)

time.slow = Slow()
tasks._worker.submit(compute)
handlers = types.SimpleNamespace(add=lambda function: None)
_run(
    types.SimpleNamespace(
        server=types.SimpleNamespace(
            controller=types.SimpleNamespace(on_server_bind=handlers, on_server_ready=handlers),
            start=lambda **options: begun.wait() and print("served"),
        )
    ),
    "127.0.0.1", 0, None,
)
"""


def test_the_server_ends_without_a_word_while_a_library_calls_back():
    """ "FATAL: exception not rethrown", or an abort."""
    pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
    ended = subprocess.run(
        [sys.executable, "-c", _ENDS_DURING_A_CALL_BACK], capture_output=True, text=True, timeout=300
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "served\n", "")
