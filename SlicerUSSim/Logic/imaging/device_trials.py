"""Trials of the OpenCL devices in child processes: whether each makes an image, and in how many milliseconds.

A runtime that ends its process ends that of the trial only. The trial builds the kernels, which takes a minute with
PoCL; runtimes keep them on the disk, so that the first image of this process does not wait for them.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Thread
from time import perf_counter, sleep
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.reading import child_command
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.self_check import frame_ms, golden_scene
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.segmentation import segment_mri
from SlicerUSSim.Logic.opencl.devices import choose_device, list_devices
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.probe.poses import craniotomy_pose
from SlicerUSSim.Logic.tissue.table import TissueTable

#: Of a trial, for its progress, and between two looks at it
_USUAL_SECONDS, _POLL_SECONDS = 40.0, 0.1
#: Voxels of the patient, in which thin sulci have a separate label
_PATIENT_MM = 1.5
#: Before the line of a child that is its answer
_ANSWER = "ussim: "


@dataclass(frozen=True)
class TriedDevice:
    """A device and what its trial has found."""

    #: See DeviceInfo
    index: str
    name: str
    platform: str
    kind: str
    #: Milliseconds per image; None before the trial, and if it failed
    ms: float | None = None
    #: Why it failed
    error: str = ""

    @property
    def key(self) -> str:
        """Names it for choose_device, and in preferences: its index changes with the runtimes that are installed."""
        return f"{self.name} {self.platform}"


class DeviceTrials:
    """Runs the trials one after the other, the preferred device first, in the background.

    Parameters
    ----------
    known : milliseconds by TriedDevice.key, of devices that need no trial.
    chosen : key of the device that is tried first; by default the one that choose_device takes.
    """

    def __init__(self, known: dict[str, float] | None = None, chosen: str = "") -> None:
        self._known, self._chosen = known or {}, chosen
        self._process: subprocess.Popen | None = None
        self._is_stopped = False
        #: All devices, the preferred one first; None as long as they are not known
        self.devices: list[TriedDevice] | None = None
        #: Why there are none
        self.error = ""
        self._thread = Thread(target=self._try_all, daemon=True)
        self._thread.start()

    @property
    def isDone(self) -> bool:
        """Whether all devices were tried."""
        return not self._thread.is_alive()

    @property
    def used(self) -> TriedDevice | None:
        """The first device that does not fail; None before it has made an image."""
        first = next((device for device in self.devices or () if not device.error), None)
        return first if first is not None and first.ms is not None else None

    def wait(self, progress: Callable[[float], None]) -> None:
        """Return when a device is `used`, or all have failed. `progress` is called with a share of the usual time."""
        started = perf_counter()
        while self.used is None and not self.isDone:
            progress(1.0 - float(np.exp((started - perf_counter()) / _USUAL_SECONDS)))
            sleep(_POLL_SECONDS)

    def stop(self) -> None:
        """End the trials."""
        self._is_stopped = True
        if self._process is not None:
            self._process.kill()

    def _try_all(self) -> None:
        found = self._ask("print_devices()")
        self.error = found.get("error", "")
        devices = [TriedDevice(**entry) for entry in found.get("devices", ())]
        devices = [replace(device, ms=self._known.get(device.key)) for device in devices]
        self.devices = sorted(devices, key=lambda device: device.key != self._chosen)
        for place, device in enumerate(self.devices):
            if device.ms is None and not self._is_stopped:
                self.devices[place] = replace(device, **self._ask(f"print_ms({device.index!r})"))

    def _ask(self, call: str) -> dict[str, Any]:
        command, environment = child_command(f"from {__name__} import *; {call}")
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )  # fmt: skip
        written, errors = self._process.communicate()
        answers = [line for line in written.splitlines() if line.startswith(_ANSWER)]
        if answers:
            return json.loads(answers[-1].removeprefix(_ANSWER))
        lines = errors.strip().splitlines()
        return {"error": lines[-1] if lines else f"its runtime ended the process ({self._process.returncode})"}


# ---- child -----------------------------------------------------------------------------------------------------------


def print_devices() -> None:
    """All devices but emulators, the one that choose_device takes first; or why there are none."""
    try:
        chosen = choose_device()[0]
    except SimulationError as error:
        _answer(error=str(error))
        return
    devices = sorted(list_devices(), key=lambda info: info != chosen)
    names = ("index", "name", "platform", "kind")
    _answer(devices=[{name: getattr(info, name) for name in names} for info in devices if not info.is_emulator])


def print_ms(index: str) -> None:
    """Milliseconds per image of a device, after the kernels of a patient were built, from segmentation to image."""
    try:
        found, probe = segment_mri(head_mri(_PATIENT_MM), skull_strip="none", device=index), PROBES["phased"]
        tissues, settings = TissueTable.brain(found.tissue_names), SimulationSettings()
        patient = UltrasoundSimulator(found.labels, tissues, settings, index, found.texture())
        patient.simulate(probe, craniotomy_pose(found.labels, probe))
        _answer(ms=frame_ms(UltrasoundSimulator(*golden_scene(), device=index)))
    except SimulationError as error:
        _answer(error=str(error))


def _answer(**values: Any) -> None:
    print(_ANSWER + json.dumps(values), flush=True)
