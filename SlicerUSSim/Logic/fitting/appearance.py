"""AppearanceModel: images at fixed poses as a function of the parameters that an optimiser varies.

Constant parts are computed once (docs/optimization.md#efficient-evaluation). The ray tree depends on none of these
parameters. The echoes of a tissue are linear in mu0 and sigma0, so a few baseband images, its *bases*, represent them
for all values:

    iq = [ base + sum over varied tissues (mu0 M + sigma0 S) ] exp(-sum over tissues (alpha - alpha_0) path)

- M and S for another mu1 are sums over bands of T1, since scatterers exist where T1 >= mu1. A band that mu1 divides is
  weighted so that the variance p (1 - p) mu0^2 + p sigma0^2, the only quantity visible in developed speckle, is exact.
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
from SlicerUSSim.Logic.tissue.tissue import Tissue

if TYPE_CHECKING:
    from pyopencl import Buffer

_log = logging.getLogger(__name__)

_ATTENUATION = "attenuation_db_cm_mhz"
#: Tissue parameters whose effect on an image the bases and paths have
VARIABLE = SCATTERING | {_ATTENUATION}
_BANDS = CONSTANTS["BANDS"]
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
        self._check_memory()
        device = self.device
        mixing = device.kernels("appearance.cl", device.lanes)
        self._mix_parts, self._mix_bases = mixing["mix_parts"], mixing["mix_bases"]
        self._direct_path = device.kernels("appearance.cl")["direct_path"]
        self._parts, self._mixed = EchoLines(device), EchoLines(device)
        self._scatterers, self._interfaces = simulator.stage(Scatterers), simulator.stage(InterfaceEchoes)
        self._display_stages = [stage(device) for stage in stages.DISPLAY_STAGES]
        self._workspace = Workspace(device)
        self._part_weights_buffer = device.empty(4 * CONSTANTS["PARTS"])
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
            frame.iq,
            np.int32(samples),
        )
        for stage in self._display_stages:
            stage.run(frame)
        return frame

    # ---- bases -------------------------------------------------------------------------------------------------

    @property
    def _base_count(self) -> int:
        return 1 + sum(self._bases_of(name) for name in self.scattering)

    def _bases_of(self, name: str) -> int:
        return 2 * _BANDS if "mu1" in self.varied[name] else 2

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
        count = 2 * self._base_count if kind == "bases" else max(len(self.attenuating), 1)
        return self._workspace.get(f"{kind} {number}", 4 * count * lines * samples)

    def _compute_bases(self, number: int) -> None:
        """Trace, compute the scatterers tissue by tissue, and apply beam and pulse to the parts of the bases."""
        device, frame = self.device, self._frames[number]
        self.simulator.trace_rays(frame)
        lines, (_, samples) = 2 * int(frame.acquisition["traced_lines"]), frame.line_shape
        self._parts.prepare(CONSTANTS["PARTS"] * lines, samples)
        self._mixed.prepare(lines, samples)
        done = 0
        for place in range(max(len(self.scattering), 1)):
            name = self.scattering[place] if self.scattering else None
            if frame.settings.scattering:
                roles, tops = device.upload(self._roles(place)), device.upload(self._band_tops(name))
                self._scatterers.scatter(frame, self._parts, varied=(roles, tops))
            else:
                self._parts.clear()
            if place == 0:
                self._keep(number, done, _only(0), with_interfaces=True)
                done += 1
            if name is not None:
                for weights in self._part_weights(name):
                    self._keep(number, done, weights)
                    done += 1

    def _keep(self, number: int, base: int, weights: np.ndarray, with_interfaces: bool = False) -> None:
        """One base: a weighted sum of the parts, then the linear stages beam and pulse."""
        device, frame = self.device, self._frames[number]
        values = self._mixed.stride * 2 * int(frame.acquisition["traced_lines"])
        device.write(self._part_weights_buffer, weights)
        for parts, mixed in ((self._parts.re, self._mixed.re), (self._parts.im, self._mixed.im)):
            device.run(
                self._mix_parts, (values // device.lanes,), parts, self._part_weights_buffer, np.int32(weights.size),
                np.int32(values), mixed,
            )  # fmt: skip
        frame.traced = self._mixed
        for stage in self.simulator.linear_stages:
            if with_interfaces or stage is not self._interfaces:
                stage.run(frame)
        lines, samples = frame.line_shape
        nbytes = lines * samples * 8
        device.copy(frame.iq, self._buffer("bases", number), nbytes, base * nbytes)

    def _roles(self, place: int) -> np.ndarray:
        """(MAX_TISSUES,) int32: role of each tissue's scatterers while tissue `place` is computed."""
        # Fixed tissues are computed once, with the first varied tissue.
        fixed = CONSTANTS["ROLE_FIXED" if place == 0 else "ROLE_SILENT"]
        roles = np.full(CONSTANTS["MAX_TISSUES"], fixed, np.int32)
        members = dict(self.tissues)
        if self.tissues.membrane is not None:
            members[CONSTANTS["MEMBRANE_LABEL"]] = self.tissues.membrane.tissue
        for label, tissue in members.items():
            if tissue.name in self.scattering:
                is_its = tissue.name == self.scattering[place]
                roles[label] = CONSTANTS["ROLE_VARIED" if is_its else "ROLE_SILENT"]
        return roles

    def _band_tops(self, name: str | None) -> np.ndarray:
        """(BANDS,) float32 tops of the bands; one is the anchor's, so that its mu1 does not divide a band."""
        tops = np.ones(_BANDS, np.float32)
        if name is not None:
            share = self.tissues.tissue(name).scatterer_share
            half = _BANDS // 2
            tops[:half] = share * np.arange(1, half + 1) / half
            tops[half:] = share + (1.0 - share) * np.arange(1, _BANDS - half + 1) / (_BANDS - half)
        return tops

    def _part_weights(self, name: str) -> list[np.ndarray]:
        """Weights of the parts in the bases of a tissue: single parts if mu1 varies, else M and S for its mu1."""
        parts = CONSTANTS["PARTS"]
        if "mu1" in self.varied[name]:
            return [_only(part) for part in range(1, parts)]
        mean, deviation = np.zeros(parts, np.float32), np.zeros(parts, np.float32)
        mean[1::2], deviation[2::2] = self._band_weights(name, self.tissues.tissue(name))
        return [mean, deviation]

    def _band_weights(self, name: str, tissue: Tissue) -> tuple[np.ndarray, np.ndarray]:
        """((BANDS,), (BANDS,)) weights of the bands' scatterers of amplitude 1 and of amplitude T0."""
        share = tissue.scatterer_share
        tops = self._band_tops(name).astype(float)
        widths = np.diff(tops, prepend=0.0)
        exists = np.clip((share - (tops - widths)) / np.maximum(widths, 1e-12), 0.0, 1.0)
        variance = float(widths @ exists**2 - (widths @ exists) ** 2)
        kept = np.sqrt(share * (1.0 - share) / variance) if variance > 1e-9 else 1.0
        return kept * (exists - share), np.sqrt(exists)

    def _base_weights(self, tissues: TissueTable) -> np.ndarray:
        weights = [1.0]
        for name in self.scattering:
            tissue = tissues.tissue(name)
            if "mu1" in self.varied[name]:
                mean, deviation = self._band_weights(name, tissue)
                weights += np.stack([tissue.mu0 * mean, tissue.sigma0 * deviation], axis=1).ravel().tolist()
            else:
                weights += [tissue.mu0, tissue.sigma0]
        return np.array(weights, np.float32)

    # ---- paths -------------------------------------------------------------------------------------------------

    @property
    def _probing_db_cm_mhz(self) -> float:
        return _PROBING_DB / (2.0 * self.probe.frequency_mhz * 0.1 * self.probe.depth_mm)

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


def _only(part: int) -> np.ndarray:
    weights = np.zeros(CONSTANTS["PARTS"], np.float32)
    weights[part] = 1.0
    return weights


def _only_attenuating(tissues: TissueTable, name: str, attenuation_db_cm_mhz: float) -> TissueTable:
    """The same tissues, with attenuation in only one of them."""
    for tissue in tissues.all_tissues():
        value = attenuation_db_cm_mhz if tissue.name == name else 0.0
        tissues = tissues.with_tissue(replace(tissue, attenuation_db_cm_mhz=value))
    return tissues
