"""Self test of OpenCL devices (`ussim check`): golden images, three physical numbers, milliseconds per frame.

One image per probe family is compared with the one that golden/ has, pixel by pixel: it holds every stage at its
defaults. The speed of sound, attenuation and speckle of a plate behind even tissue are compared with theory, which
does not depend on any earlier image. Times are information only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.errors import Cancelled, user_message
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.opencl.devices import DeviceInfo, devices_to_measure
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.probe.poses import pose_looking_at
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue

if TYPE_CHECKING:
    from SlicerUSSim.Logic.imaging.frame import Frame

#: One probe of each family; GOLDEN/NAME.png is its accepted image
FAMILIES = ("phased", "convex", "linear")
GOLDEN = Path(__file__).parent / "golden"

#: Rows and columns of golden images: pixels of 0.2 to 1 mm
_SIZE = (224, 192)
#: Height of the golden patient's surface and of its middle, and its voxels, mm
_TOP_MM, _SPACING_MM = 84.0, 1.5
_POSE = pose_looking_at((0.0, 0.0, _TOP_MM + 1.0), (0.0, 0.0, 0.0))

#: Tissue between the probe and the plate, and the true depth of the plate
_TISSUE = Tissue("even tissue", speed_of_sound_m_s=1450.0, impedance_mrayl=1.6, attenuation_db_cm_mhz=0.5, mu0=0.33)
_PLATE = Tissue("plate", speed_of_sound_m_s=1450.0, impedance_mrayl=46.0, attenuation_db_cm_mhz=0.0)
_PLATE_MM = 30.0
#: 0.3 % of the speed. The plate lies between voxels, where flat borders are placed to 0.02 mm; its echo is 0.2 mm long.
_DEPTH_TOLERANCE_MM = 0.1
#: Images with different scatterers, over which attenuation and speckle are averaged
_SEEDS = 4
#: Relative; other seeds differ by 0.35 % (one standard deviation)
_ATTENUATION_TOLERANCE = 0.02
#: Mean / standard deviation of a Rayleigh variable; other seeds differ by 0.0045, and eight scatterers in the smallest
#: resolution cell are not infinitely many
_RAYLEIGH_RATIO, _RATIO_TOLERANCE = float(np.sqrt(np.pi / (4.0 - np.pi))), 0.04

#: Frames of which the fastest counts
_TIMED_FRAMES = 5
#: Findings about a device: images, three numbers, time
_COUNT = len(FAMILIES) + 4


@dataclass(frozen=True)
class Finding:
    """One line about a device: what was looked at, what was found in plain words, and whether that is wrong."""

    name: str
    text: str
    is_wrong: bool = False


@dataclass(frozen=True)
class CheckedDevice:
    """The findings about one device, in the order in which they were made; the last is an error if it failed."""

    info: DeviceInfo
    findings: tuple[Finding, ...]

    @property
    def wrong(self) -> list[str]:
        """A line for everything that is wrong, with the device's name; empty if it computes correctly."""
        name = f"{self.info.index} {self.info.name}"
        return [f"{name}: {found.name}: {found.text}" for found in self.findings if found.is_wrong]


@dataclass(frozen=True)
class SelfCheck:
    """What `check_devices` found."""

    devices: tuple[CheckedDevice, ...]

    @property
    def wrong(self) -> list[str]:
        """As CheckedDevice.wrong, of all devices."""
        return [line for device in self.devices for line in device.wrong]

    @property
    def lines(self) -> list[str]:
        """Aligned lines per device, then which devices compute wrongly and what to do, or that none does."""
        found = []
        for device in self.devices:
            found.append(str(device.info))
            found += [f"  {one.name:14s}  {'WRONG: ' if one.is_wrong else ''}{one.text}" for one in device.findings]
        bad = [f"{device.info.index} {device.info.name}" for device in self.devices if device.wrong]
        if bad:
            advice = "Choose another device (--device, USSIM_DEVICE) or update the driver, and report this."
            return [*found, f"{len(bad)} of {len(self.devices)} devices compute wrongly: {', '.join(bad)}. {advice}"]
        count = len(self.devices)
        return [*found, "The device computes correctly." if count == 1 else f"All {count} devices compute correctly."]


def check_devices(device: str | None = None, progress: Callable[[float], None] | None = None) -> SelfCheck:
    """Test the device chosen by `device` ("0:1" or part of a name), or without a choice all devices except emulators.

    `progress` is called with the fraction done, 0 to 1, and may raise Cancelled. A device that fails while it computes
    is a finding, and the next one is tested. Raises SimulationError if there is no device or none fits the choice.
    """
    chosen = devices_to_measure(device)
    checked = []
    for place, info in enumerate(chosen):
        findings: list[Finding] = []
        try:
            for finding in _findings(info):
                findings.append(finding)
                if progress is not None:
                    progress((place + len(findings) / _COUNT) / len(chosen))
        except Cancelled:
            raise
        except Exception as error:
            message = user_message(error)
            if message is None:
                raise
            findings.append(Finding("stopped", message, is_wrong=True))
        checked.append(CheckedDevice(info, tuple(findings)))
    return SelfCheck(tuple(checked))


def _findings(info: DeviceInfo) -> Iterator[Finding]:
    device = Device.get(info)
    simulator = UltrasoundSimulator(*golden_scene(), device=device)
    for name in FAMILIES:
        what = difference(golden_view(simulator, PROBES[name]).image, golden_image(GOLDEN / f"{name}.png"))
        yield Finding(f"{name} image", what or "as expected", bool(what))
    yield from _physics(device)
    ms = frame_ms(simulator)
    yield Finding("time", f"{ms:.1f} ms per frame ({FAMILIES[0]} probe, best of {_TIMED_FRAMES})")


# ---- golden images ---------------------------------------------------------------------------------------------------


def golden_scene() -> tuple[Volume, TissueTable]:
    """Brain with ventricles, folded grey matter, a tumour and a plate that casts a shadow, in voxels of 1.5 mm."""
    half = np.array([57.0, 33.0, _TOP_MM])
    x, y, z = np.meshgrid(*[np.arange(-h, h + 0.1, _SPACING_MM) for h in half], indexing="ij")
    depth = _TOP_MM - z
    labels = np.full(x.shape, 3, np.uint8)
    folds = 7.0 + 2.5 * np.sin(x / 4.0 + 1.0) * np.cos(y / 5.0)
    labels[depth < folds] = 2
    labels[(depth < folds - 3.5) & (np.abs((x + 3.0) % 17.0 - 8.5) < 1.6)] = 1
    for centre, radius in (((-9, 0, 22), 5.0), ((12, 4, 38), 8.0), ((-22, -3, 62), 11.0), ((18, 0, 110), 16.0)):
        labels[(x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (depth - centre[2]) ** 2 < radius**2] = 1
    labels[(x - 2) ** 2 + y**2 + (depth - 14) ** 2 < 16.0] = 4
    labels[(x + 24) ** 2 + y**2 + (depth - 92) ** 2 < 196.0] = 4
    labels[(np.abs(depth - 50 - 0.3 * x) < 1.5) & (x > 22) & (x < 34)] = 5
    ijk_to_ras = np.diag([_SPACING_MM, _SPACING_MM, _SPACING_MM, 1.0])
    ijk_to_ras[:3, 3] = -half
    tissues = TissueTable.brain(("csf", "grey matter", "white matter", "tumour", "bone"))
    return Volume(np.ascontiguousarray(labels.transpose(2, 1, 0)), ijk_to_ras), tissues


def golden_view(simulator: UltrasoundSimulator, probe: Probe) -> Frame:
    """The frame of a probe 1 mm above the brain of `golden_scene`, with the size and the noise of golden images."""
    return simulator.simulate(probe, _POSE, DisplaySettings(image_size=_SIZE), noise_seed=1)


def golden_image(path: Path) -> np.ndarray:
    """(rows, columns) uint8 of an accepted image."""
    from PIL import Image

    return np.asarray(Image.open(path))


def difference(one: np.ndarray, other: np.ndarray) -> str:
    """How much two images differ, in words; "" if as much as those of two devices may."""
    if one.shape != other.shape:
        return f"has {one.shape[1]}x{one.shape[0]} pixels, before {other.shape[1]}x{other.shape[0]}"
    levels = np.abs(one.astype(int) - other)
    if np.mean(levels > 1) <= 0.002 and np.mean(levels > 8) <= 0.0002:
        return ""
    return (
        f"{np.mean(levels > 1):.1%} of the pixels differ by more than a level, by {levels[levels > 0].mean():.1f} on "
        f"average and by {levels.max()} at most; mean {other.mean():.1f} -> {one.mean():.1f}"
    )


# ---- physics ---------------------------------------------------------------------------------------------------------


def _physics(device: Device) -> Iterator[Finding]:
    """Speed, attenuation and speckle in one image of a plate (docs/physics.md#3-rays, #5-scatterers).

    Attenuation at the centre frequency: without the downshift of the band the level falls by 2 a f d.
    """
    probe, settings = PROBES["linear"], SimulationSettings(frequency_downshift=False)
    labels = np.zeros((46, 21, 61), np.uint8)  # label 0 continues beyond the volume
    labels[:10] = 1
    ijk_to_ras = np.eye(4)
    ijk_to_ras[:3, 3] = -30.0, -10.0, -9.5  # the plate's surface is at z = 0
    tissues = TissueTable({0: _TISSUE, 1: _PLATE})
    simulator = UltrasoundSimulator(Volume(labels, ijk_to_ras), tissues, settings, device)
    frames = []
    for seed in range(_SEEDS):
        simulator.settings = replace(settings, seed=seed)
        frames.append(simulator.simulate(probe, pose_looking_at((0.0, 0.0, _PLATE_MM), (0.0, 0.0, 0.0))))
    amplitude = np.concatenate([np.abs(frame.iq) for frame in frames]).astype(float)
    depth = frames[0].sample_interval_mm * np.arange(amplitude.shape[1])
    stretch = settings.reference_speed_m_s / _TISSUE.speed_of_sound_m_s  # displayed re true depth
    with np.errstate(all="ignore"):  # a device that computes zeros or NaN is wrong by the comparisons
        power = (amplitude**2).mean(axis=0)
        echo = np.where(depth > 0.8 * _PLATE_MM * stretch, power, 0.0)
        echo[echo < 0.25 * echo.max()] = 0.0  # of the plate, between its -6 dB points
        plate_mm = (echo * depth).sum() / echo.sum()
        even = (depth > 5.0) & (depth < _PLATE_MM * stretch - 3.0)
        level, along = 10.0 * np.log10(power[even]), depth[even] - depth[even].mean()
        db_per_mm = (level * along).sum() / (along**2).sum()  # of displayed depth
        attenuation = -db_per_mm * stretch / (0.2 * probe.frequency_mhz)
        speckle = amplitude[:, even] * 10.0 ** (-0.05 * db_per_mm * along)
        ratio = speckle.mean() / speckle.std()
    where = f"a plate {_PLATE_MM:.0f} mm deep, behind {_TISSUE.speed_of_sound_m_s:.0f} m/s, is shown at"
    yield _number("speed", where, plate_mm, "mm", _PLATE_MM * stretch, _DEPTH_TOLERANCE_MM)
    alpha = _TISSUE.attenuation_db_cm_mhz
    yield _number("attenuation", "", attenuation, "dB/(cm MHz)", alpha, _ATTENUATION_TOLERANCE * alpha)
    yield _number("speckle", "mean / standard deviation", ratio, "", _RAYLEIGH_RATIO, _RATIO_TOLERANCE)


def _number(name: str, before: str, found: float, unit: str, expected: float, tolerance: float) -> Finding:
    text = f"{before} {found:.3f} {unit}".strip() + f", expected {expected:.3f} ± {tolerance:.3f}"
    return Finding(name, text, not abs(found - expected) <= tolerance)  # also if it is NaN


def frame_ms(simulator: UltrasoundSimulator) -> float:
    """Milliseconds of the fastest of some frames, of a simulator of golden_scene."""
    seconds = []
    for _ in range(_TIMED_FRAMES):
        simulator.forget_echoes()
        start = perf_counter()
        simulator.simulate(PROBES[FAMILIES[0]], _POSE)
        seconds.append(perf_counter() - start)
    return 1e3 * min(seconds)
