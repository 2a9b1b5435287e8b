"""AppearanceModel: images at fixed poses as a function of the parameters that an optimiser varies.

Constant parts are computed once (docs/optimization.md#efficient-evaluation). The ray tree depends on none of these
parameters. The echoes of a tissue are linear in the amplitude of its scatterers, so one baseband image, its *basis*,
represents them for all values of mu0, mu1 and sigma0:

    iq = [ base + sum over varied tissues sqrt(Var) B ] exp(-sum over tissues (alpha - alpha_0) path)

- B has the scatterers that the anchor's mu1 has. As long as sites without any are rare, as for every mu1 that a fit
  tries, this is exact; sparser tissue is as sparse as at the anchor. Elevational side lobes are computed where tissue
  is dark at the anchor (side_lobes.py).
- Another attenuation changes the amplitude of each sample by the loss along the direct path. This is an approximation
  where the beam covers the edge of a shadow, and for echoes of reflected rays. At the anchor alpha_0 the model is
  exact; `anchor` changes it.

An image is therefore computed from a weighted sum and the display stages (stages.py).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.fitting.parameters import SCATTERING
from SlicerUSSim.Logic.imaging import stages
from SlicerUSSim.Logic.imaging.scattering import InterfaceEchoes, Scatterers
from SlicerUSSim.Logic.imaging.signals import EchoLines
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.imaging.stage import DeviceFrame
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.table import TissueTable

if TYPE_CHECKING:
    from pyopencl import Buffer

_log = logging.getLogger(__name__)

_ATTENUATION = "attenuation_db_cm_mhz"
#: Tissue parameters whose effect on an image the bases and paths have
VARIABLE = SCATTERING | {_ATTENUATION}
#: Limit for the memory of bases and paths of all images.
_MOST_BYTES = 4 * 2**30
#: Attenuation over the image depth for measuring path lengths: large compared to the tracer's tolerance, small compared
#: to its threshold.
_PROBING_DB = 100.0


class AppearanceModel:
    """The images of one patient at given poses, for any display and any values of the varied tissue parameters.

    Parameters
    ----------
    simulator : its labels, tissues and settings; the tissues are the first anchor.
    probe, poses : the probe and its (4, 4) probe_to_ras, one per image.
    varied : {tissue name: parameter names among parameters.TISSUE_BOUNDS}.
    grid : the pixels of the images (default: the bounding box of the imaged field, with display.image_size pixels).

    Raises SimulationError for a tissue that the simulator does not have, a parameter outside VARIABLE, a pose that is
    not rigid, and if the images and parameters need too much memory.
    """

    def __init__(
        self,
        simulator: UltrasoundSimulator,
        probe: Probe,
        poses: Iterable[np.ndarray],
        varied: Mapping[str, Iterable[str]],
        grid: ImageGrid | None = None,
    ) -> None:
        self.simulator, self.probe, self._grid = simulator, probe, grid
        self.device: Device = simulator.device
        self.poses = [check_rigid(f"pose {number}", pose) for number, pose in enumerate(poses)]
        self.varied = {name: frozenset(parameters) for name, parameters in varied.items()}
        for name in self.varied:
            simulator.medium.tissues.tissue(name)
            others = sorted(self.varied[name] - VARIABLE)
            require(
                not others, f"{name}: a fit cannot vary {', '.join(others)}, expected {', '.join(sorted(VARIABLE))}"
            )
        #: Tissues with varied scatterers, in the order of the bases, and with varied attenuation, in that of the paths
        self.scattering = [n for n, p in self.varied.items() if p & SCATTERING]
        self.attenuating = [n for n, p in self.varied.items() if _ATTENUATION in p]
        simulator.warn_if_slow(probe)
        self._check_memory()
        device = self.device
        mixing = device.kernels("appearance.cl", device.lanes)
        self._mix_bases = mixing["mix_bases"]
        self._direct_path = device.kernels("appearance.cl")["direct_path"]
        self._parts, self._part = EchoLines(device), EchoLines(device)
        self._scatterers, self._interfaces = simulator.stage(Scatterers), simulator.stage(InterfaceEchoes)
        self._display_stages = [stage(device) for stage in stages.DISPLAY_STAGES]
        self._workspace = Workspace(device)
        self._weights = device.empty(4 * self._base_count)
        self._decays = device.empty(4 * max(len(self.attenuating), 1))
        self.anchor(simulator.medium.tissues)

    def anchor(self, tissues: TissueTable) -> None:
        """Recompute the bases for these tissues, for which the model is then exact."""
        started = perf_counter()
        simulator = self.simulator
        self.tissues = tissues
        self._weighted: TissueTable | None = None  # tissues of the weights on the device
        self._frames = [simulator.device_frame(self.probe, pose) for pose in self.poses]
        simulator.forget_echoes()  # the bases use its stages
        with simulator.with_tissues(tissues):
            for number in range(len(self.poses)):
                self._measure_paths(number)
                self._compute_bases(number)
        _log.debug(
            "bases of %d images, %d each: computed in %.0f ms", len(self.poses), self._base_count,
            (perf_counter() - started) * 1e3,
        )  # fmt: skip

    def image(self, number: int, tissues: TissueTable, display: DisplaySettings) -> np.ndarray:
        """(rows, columns) uint8 image at pose `number`."""
        return self._rendered(number, tissues, display).download("image")

    def grid(self, display: DisplaySettings) -> ImageGrid:
        """The pixels of the images."""
        return self._grid or ImageGrid.for_probe(self.probe, display.image_size)

    def run(self, number: int, tissues: TissueTable, display: DisplaySettings) -> Buffer:
        """Enqueue the image at pose `number`; returns its device buffer, which the next image overwrites."""
        return self._rendered(number, tissues, display).image

    def _rendered(self, number: int, tissues: TissueTable, display: DisplaySettings) -> DeviceFrame:
        frame = replace(self._frames[number], display=display, grid=self.grid(display))
        lines, samples = frame.line_shape
        if tissues is not self._weighted:  # the write waits for earlier images
            self.device.write(self._weights, self._base_weights(tissues))
            self.device.write(self._decays, self._path_weights(tissues))
            self._weighted = tissues
        frame.iq = self._workspace.get("iq", lines * samples * 8)
        self.device.run(
            self._mix_bases,
            (samples // self.device.lanes, lines),
            self._buffer("bases", number),
            self._weights,
            np.int32(self._base_count),
            self._buffer("paths", number),
            self._decays,
            np.int32(len(self.attenuating)),
            frame.acquisition_buffer,
            self._buffer("losses", number),
            frame.iq,
            np.int32(samples),
        )
        for stage in self._display_stages:
            stage.run(frame)
        return frame

    # ---- bases -------------------------------------------------------------------------------------------------

    @property
    def _base_count(self) -> int:
        return 1 + len(self.scattering)

    def _check_memory(self) -> None:
        simulator = self.simulator
        if not self.poses:
            return
        acquisition = simulator.acquisition(self.probe, self.poses[0])
        values = int(acquisition["scan_lines"]) * int(acquisition["samples"])
        needed = 4 * values * (2 * self._base_count + len(self.attenuating)) * len(self.poses)
        require(
            needed <= _MOST_BYTES,
            f"{len(self.poses)} images with {self._base_count} parts each need {needed / 2**30:.1f} GB, expected at "
            f"most {_MOST_BYTES / 2**30:.0f}; choose fewer images or free parameters",
        )

    def _buffer(self, kind: str, number: int) -> Buffer:
        lines, samples = self._frames[number].line_shape
        if kind == "losses":
            return self._workspace.get(f"{kind} {number}", lines * (samples // CONSTANTS["LOSS_STEP"] + 1) * 12)
        count = 2 * self._base_count if kind == "bases" else max(len(self.attenuating), 1)
        return self._workspace.get(f"{kind} {number}", 4 * count * lines * samples)

    def _compute_bases(self, number: int) -> None:
        """Trace, compute the scatterers of several tissues at once, and apply beam and pulse to each."""
        device, frame = self.device, self._frames[number]
        self.simulator.trace_rays(frame)
        lines, (_, samples) = 2 * int(frame.acquisition["traced_lines"]), frame.line_shape
        parts = CONSTANTS["PARTS"]
        self._parts.prepare(parts * lines, samples)
        self._part.prepare(lines, samples)
        bases, tissues = self._bases(), self._unit_tissues(frame)
        device.copy(frame.losses, self._buffer("losses", number), self._buffer("losses", number).size)
        for first in range(0, self._base_count, parts):
            if frame.settings.scattering:
                part_of = np.where((bases >= first) & (bases < first + parts), bases - first, -1).astype(np.int32)
                self._scatterers.scatter(frame, self._parts, tissues, device.upload(part_of))
            else:
                self._parts.clear()
            for base in range(first, min(first + parts, self._base_count)):
                self._keep(number, base, base - first)

    def _keep(self, number: int, base: int, part: int) -> None:
        """One base: beam and pulse of a part; the first one also has the interfaces."""
        device, frame = self.device, self._frames[number]
        nbytes = 4 * self._part.stride * 2 * int(frame.acquisition["traced_lines"])
        device.copy(self._parts.re, self._part.re, nbytes, source_offset=part * nbytes)
        device.copy(self._parts.im, self._part.im, nbytes, source_offset=part * nbytes)
        frame.traced = self._part
        for stage in self.simulator.linear_stages:
            if base == 0 or stage is not self._interfaces:
                stage.run(frame)
        lines, samples = frame.line_shape
        nbytes = lines * samples * 8
        device.copy(frame.iq, self._buffer("bases", number), nbytes, base * nbytes)

    def _bases(self) -> np.ndarray:
        """(MAX_TISSUES,) number of the base of each label's scatterers: 0 for fixed tissues."""
        bases = np.zeros(CONSTANTS["MAX_TISSUES"], int)
        members = dict(self.tissues)
        if self.tissues.membrane is not None:
            members[CONSTANTS["MEMBRANE_LABEL"]] = self.tissues.membrane.tissue
        for label, tissue in members.items():
            if tissue.name in self.scattering:
                bases[label] = 1 + self.scattering.index(tissue.name)
        return bases

    def _unit_tissues(self, frame: DeviceFrame) -> np.ndarray:
        """layout.TISSUE per label, with scatterers of unit variance where they are varied."""
        rows = frame.medium.rows.copy()
        rows["scatterer_variance"][self._bases() > 0] = 1.0
        return rows

    def _base_weights(self, tissues: TissueTable) -> np.ndarray:
        deviations = [np.sqrt(tissues.tissue(name).scatterer_variance) for name in self.scattering]
        return np.array([1.0, *deviations], np.float32)

    # ---- paths -------------------------------------------------------------------------------------------------

    @property
    def _probing_db_cm_mhz(self) -> float:
        return _PROBING_DB / (2.0 * self.probe.received_mhz * 0.1 * self.probe.depth_mm)

    def _measure_paths(self, number: int) -> None:
        """Loss in nepers in each varied tissue along the path to every sample, at the probing attenuation."""
        simulator, device = self.simulator, self.device
        frame, paths = self._frames[number], self._buffer("paths", number)
        lines, samples = frame.line_shape
        nbytes = lines * samples * 4
        one = self._workspace.get("path", nbytes)
        for place, name in enumerate(self.attenuating):
            with simulator.with_tissues(_only_attenuating(self.tissues, name, self._probing_db_cm_mhz)):
                simulator.trace_rays(frame, with_level=False)
            device.run(
                self._direct_path,
                (lines,),
                frame.acquisition_buffer,
                frame.tree.segments,
                frame.tree.segment_counts,
                one,
            )
            device.copy(one, paths, nbytes, place * nbytes)

    def _path_weights(self, tissues: TissueTable) -> np.ndarray:
        """(attenuating tissues,) exponent of two per neper of the paths."""
        change = [
            tissues.tissue(name).attenuation_db_cm_mhz - self.tissues.tissue(name).attenuation_db_cm_mhz
            for name in self.attenuating
        ]
        return -np.array(change or [0.0], np.float32) / np.float32(self._probing_db_cm_mhz * np.log(2.0))


def _only_attenuating(tissues: TissueTable, name: str, attenuation_db_cm_mhz: float) -> TissueTable:
    """The same tissues, with attenuation in only one of them."""
    for tissue in tissues.all_tissues():
        value = attenuation_db_cm_mhz if tissue.name == name else 0.0
        tissues = tissues.with_tissue(replace(tissue, attenuation_db_cm_mhz=value))
    return tissues
