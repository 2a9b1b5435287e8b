"""`ussim check` passes on a device that computes correctly, and tells what is wrong with one that does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import UltrasoundSimulator
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.imaging import device_trials, self_check
from SlicerUSSim.Logic.imaging.device_trials import DeviceTrials
from SlicerUSSim.Logic.imaging.self_check import Finding, SelfCheck, check_devices
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.opencl.devices import choose_device

NAMES = ["phased image", "convex image", "linear image", "speed", "attenuation", "speckle", "time"]


@pytest.fixture(scope="module")
def info():
    return choose_device()[0]


@pytest.fixture
def distort(monkeypatch):
    """A function that makes every frame of the self test what `change` makes of it."""

    def distort_with(change):
        class Distorted(UltrasoundSimulator):
            def simulate(self, *arguments, **named):
                return change(super().simulate(*arguments, **named))

        monkeypatch.setattr(self_check, "UltrasoundSimulator", Distorted)

    return distort_with


def ussim_check(*arguments):
    return CliRunner().invoke(main, ["check", *arguments])


def test_a_device_that_computes_correctly_passes(info):
    result = ussim_check("--device", info.index)
    assert result.exit_code == 0, result.output
    first, *findings, last = result.stdout.splitlines()
    assert first == str(info) and last == "The device computes correctly."
    assert [line[2:16].strip() for line in findings] == NAMES
    assert "ms per frame" in findings[-1]


def test_wrong_pixels_are_reported_per_image_and_exit_with_one(info, distort):
    distort(lambda frame: replace(frame, image=np.roll(frame.image, 2, axis=0)))
    result = ussim_check("--device", info.index)
    assert result.exit_code == 1 and "correctly" not in result.stdout
    assert len([line for line in result.stdout.splitlines() if "WRONG: " in line and "pixels differ" in line]) == 3
    assert result.stdout.splitlines()[-1].startswith(
        f"1 of 1 devices compute wrongly: {info.index} {info.name}. Choose"
    )


def _attenuated(frame):
    depth_mm = frame.sample_interval_mm * np.arange(frame.iq.shape[1])
    return replace(frame, iq=frame.iq * 10.0 ** (-0.0015 * depth_mm))  # 3 % more


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (lambda frame: frame, []),
        (lambda frame: replace(frame, sample_interval_mm=1.005 * frame.sample_interval_mm), ["speed"]),
        (_attenuated, ["attenuation"]),
        (lambda frame: replace(frame, iq=frame.iq / np.abs(frame.iq) ** 0.05), ["attenuation", "speckle"]),
        (lambda frame: replace(frame, iq=0.0 * frame.iq), ["speed", "attenuation", "speckle"]),
        (lambda frame: replace(frame, iq=np.nan * frame.iq), ["speed", "attenuation", "speckle"]),
    ],
    ids=["right", "shown too deep", "attenuated too much", "too even", "zeros", "no numbers"],
)
def test_a_wrong_physical_number_is_found(distort, change, wrong):
    distort(change)
    assert [found.name for found in self_check._physics(Device.get()) if found.is_wrong] == wrong


def test_a_device_that_fails_is_a_line_and_the_next_is_tested(info, monkeypatch):
    import pyopencl

    def findings(device):
        yield Finding("phased image", "as expected")
        if device.index == "9:9":
            raise pyopencl.MemoryError("clEnqueueNDRangeKernel", -4)

    monkeypatch.setattr(self_check, "devices_to_measure", lambda device: [replace(info, index="9:9"), info])
    monkeypatch.setattr(self_check, "_findings", findings)
    result = ussim_check()
    assert result.exit_code == 1
    assert result.stdout.count("as expected") == 2
    assert "  stopped         WRONG: the OpenCL device failed (" in result.stdout
    assert result.stdout.splitlines()[-1].startswith(f"1 of 2 devices compute wrongly: 9:9 {info.name}. Choose")


def test_the_check_reports_progress_and_can_be_cancelled(info, monkeypatch):
    monkeypatch.setattr(self_check, "_findings", lambda device: (Finding(name, "") for name in NAMES))
    shares = []
    done = check_devices(info.index, shares.append)
    assert shares == pytest.approx(np.arange(1, 8) / 7)
    assert SelfCheck(2 * done.devices).lines[-1] == "All 2 devices compute correctly."

    def cancel(share):
        raise Cancelled

    with pytest.raises(Cancelled):
        check_devices(info.index, cancel)


def test_a_device_that_does_not_exist_exits_with_two():
    result = ussim_check("--device", "no such device")
    assert result.exit_code == 2 and "no OpenCL device fits 'no such device'" in result.stderr


def test_a_trial_in_a_child_process_measures_a_device():
    trials, shares = DeviceTrials(), []
    trials.wait(shares.append)
    assert trials.used is not None and 0 < trials.used.ms < 60_000 and not trials.used.error
    assert choose_device(trials.used.key)[0] == choose_device()[0]
    assert shares == sorted(shares) and shares[-1] < 1.0


def test_a_runtime_that_ends_its_process_ends_the_trial_alone(monkeypatch):
    child_command = device_trials.child_command

    def failing(code):
        return child_command(code.replace("print_ms", "import os; os.abort() or "))

    monkeypatch.setattr(device_trials, "child_command", failing)
    trials = DeviceTrials()
    trials.wait(lambda share: None)
    assert trials.used is None and trials.isDone and trials.devices
    assert {device.error for device in trials.devices} == {"its runtime ended the process (-6)"}
