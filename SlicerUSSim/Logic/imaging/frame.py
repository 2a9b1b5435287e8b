"""Frame: one simulated image with its geometry and signals."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.ultrasound_dicom import ultrasound_dicom
from SlicerUSSim.Logic.base.volume import Volume, require_image_name
from SlicerUSSim.Logic.imaging.batch import geometric_labels, on_carrier
from SlicerUSSim.Logic.imaging.figures import write_png
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import NOMINAL_SPEED_M_S
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Fields that may be on the device still
_SIGNALS = ("iq", "envelope", "bmode")
#: Largest of the numbers of Echoes, well within float16
_LARGEST = 2.0**15


@dataclass(frozen=True, eq=False)
class Frame:
    """One simulated image with its geometry and the signals from which it was computed.

    Simulated signals (iq, envelope, bmode) are downloaded from the device when they are first asked for.

    Parameters
    ----------
    iq : (scan_lines, samples) complex64 baseband (I/Q) signal before ring-down, noise and TGC.
    envelope : (scan_lines, samples) float32 after noise and TGC.
    bmode : (scan_lines, samples) uint8 grey levels along the scan lines.
    image : (rows, columns) uint8 scan-converted image, its first row next to the probe; outside the field 0.
    sample_interval_mm : depth between samples.
    cycles_per_mm : carrier cycles per millimetre of depth.
    grid : the pixels in the probe frame.
    probe_to_ras : (4, 4) pose of the probe.
    timings_ms : {stage: milliseconds, the host waiting for each}, with "upload" and "download"; empty unless
        `simulator.profiling` is on.
    probe : that of the image; its field is where the image has pixels. A draft may have fewer scan lines.
    patient : the Volume of tissue labels that was imaged.
    reference_speed_m_s : the speed of sound that turns time into depth.
    """

    iq: np.ndarray = field(repr=False)
    envelope: np.ndarray = field(repr=False)
    bmode: np.ndarray = field(repr=False)
    image: np.ndarray = field(repr=False)
    sample_interval_mm: float
    cycles_per_mm: float
    grid: ImageGrid
    probe_to_ras: np.ndarray
    timings_ms: dict[str, float] = field(default_factory=dict, repr=False)
    probe: Probe | None = field(default=None, repr=False)
    patient: Volume | None = field(default=None, repr=False)
    reference_speed_m_s: float = NOMINAL_SPEED_M_S

    def download(self) -> None:
        """Take what is still on the device to the host, for example before a fork."""
        for name in _SIGNALS:
            getattr(self, name)

    def __getstate__(self) -> dict:
        self.download()
        return self.__dict__

    @cached_property
    def rf(self) -> np.ndarray:
        """(scan_lines, samples) complex64 analytic RF signal; its real part is the sampled echo signal.

        Raises SimulationError for a draft, whose two samples per cycle cannot hold it: take `iq`, or quality "full".
        """
        return on_carrier(self.iq, round(1.0 / (self.cycles_per_mm * self.sample_interval_mm)))

    @property
    def sampling_rate_hz(self) -> float:
        """Samples per second of the signals along the scan lines."""
        return 500.0 * self.reference_speed_m_s / self.sample_interval_mm

    @property
    def pixel_spacing_mm(self) -> tuple[float, float]:
        """(column, row) spacing of the image."""
        return self.grid.pixel_spacing_mm

    @property
    def image_to_probe(self) -> np.ndarray:
        """(4, 4) from (column, row, 0, 1) to the probe frame in millimetres."""
        return self.grid.image_to_probe

    def labels(self) -> np.ndarray:
        """(rows, columns) tissue labels of the patient in the image plane, at the places of the pixels.

        They are 0 outside the imaged field and the patient's volume; `simulator.medium.tissues.names_by_label()` has
        their names. Where refraction and travel time put them is labels_as_imaged of simulate_batch.

        Raises SimulationError for a frame without its probe and patient.
        """
        why = "the frame has no patient, expected a simulated one"
        return geometric_labels(required(self.patient, why), required(self.probe, why), self.grid, self.probe_to_ras)

    def save(self, path: str | os.PathLike) -> None:
        """Write the image as PNG, as a DICOM ultrasound image (.dcm) or as a volume of one slice (.nrrd, .nii.gz, ...).

        DICOM has the millimetres per pixel and no patient; a volume its place. On failure an existing file is kept.
        Raises SimulationError for another suffix, and if the file cannot be written.
        """
        require_image_name(Path(path), (".png", ".dcm"))
        suffix = Path(path).suffix.lower()
        if suffix == ".png":
            write_png(path, self.image)
        elif suffix == ".dcm":
            rows, columns = self.image.shape
            content = ultrasound_dicom(self.image[None], (0, 0, columns - 1, rows - 1), self.pixel_spacing_mm)
            with written_whole(path) as partial:
                Path(partial).write_bytes(content)
        else:
            self.to_volume().write(path)

    def show(self) -> None:
        """Open the image in the viewer of pictures of this computer; a notebook shows a frame by itself."""
        self._picture().show("B-mode")

    def _repr_png_(self) -> bytes | None:
        return self._picture()._repr_png_()

    def _picture(self):
        """The image with square pixels."""
        from PIL import Image

        (across, down), (rows, columns) = self.pixel_spacing_mm, self.image.shape
        return Image.fromarray(self.image).resize((max(round(columns * across / down), 1), rows))

    def to_volume(self) -> Volume:
        """The image as a Volume of one slice in patient space; the slice thickness is the pixel height."""
        return Volume(self.image[None], self.probe_to_ras @ self.grid.slice_to_probe)

    def to_vtk(self):
        """The image as a vtkImageData of one slice in patient space (RAS); save() has it the right way up."""
        return self.to_volume().to_vtk()


def _on_demand(name: str) -> property:
    """A field that may be given as a function, which is called for its value once."""

    def value(frame: Frame) -> np.ndarray:
        held: Any = frame.__dict__[name]
        if callable(held):
            held = frame.__dict__[name] = held()
        return held

    return property(value, lambda frame, held: frame.__dict__.__setitem__(name, held))


for _name in _SIGNALS:
    setattr(Frame, _name, _on_demand(_name))


@dataclass(frozen=True, eq=False)
class Echoes:
    """The baseband signal of a frame in half of its memory, from which it can be displayed again."""

    #: (scan_lines, samples, 2) float16 real and imaginary part: exact within 0.005 dB at all levels, since attenuation,
    #: which TGC compensates, can be 100 dB
    parts: np.ndarray = field(repr=False)
    #: Value of 1 in `parts`
    unit: float
    #: (4, 4)
    probe_to_ras: np.ndarray

    @classmethod
    def of(cls, frame: Frame) -> Echoes:
        """Those of a frame."""
        parts = frame.iq.view(np.float32).reshape(*frame.iq.shape, 2)
        unit = float(np.abs(parts).max(initial=0.0)) / _LARGEST or 1.0
        return cls((parts * np.float32(1.0 / unit)).astype(np.float16), unit, frame.probe_to_ras)

    def iq(self, samples: int) -> np.ndarray:
        """(scan_lines, samples) complex64; behind the image the last sample is repeated."""
        behind = samples - self.parts.shape[1]
        signal = np.pad(self.parts, ((0, 0), (0, behind), (0, 0)), "edge").astype(np.float32)
        return (signal * np.float32(self.unit)).view(np.complex64)[..., 0]
