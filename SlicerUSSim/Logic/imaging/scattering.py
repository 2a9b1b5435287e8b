"""Host code of kernels/scattering.cl, interfaces.cl and beam.cl: echoes as baseband impulses along every line."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.imaging.diffraction import plane_echoes
from SlicerUSSim.Logic.imaging.raytracing import ray_centres
from SlicerUSSim.Logic.imaging.side_lobes import DARK, Tables, elevational_lobe_record, lines_together
from SlicerUSSim.Logic.imaging.signals import EchoLines
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import ACQUISITION, CONSTANTS, WALL

if TYPE_CHECKING:
    from pyopencl import Buffer

    from SlicerUSSim.Logic.base.settings import SimulationSettings
    from SlicerUSSim.Logic.probe.arrays import Probe

#: Of the paper's lattice of scatterers
PAPER_SITES_PER_MM3 = 0.02**-3
# In the probe's smallest resolution cell, for developed speckle; thin structures need some too, whatever the probe
_SITES_PER_CELL, _LEAST_PER_MM3 = 5.0, 4.0
_LOBE_CHUNKS = 4  # samples of a work-item for elevational side lobes, per sample for the main beam
_SLICES = 16  # of a scan line for the interfaces on GPUs, which have more work-items than scan lines

#: Extent of a cell of the lattice along a line of any direction, in its edges: between 1 and the root of 3
_OBLIQUE = 1.3


class Scatterers(Stage):
    """Adds speckle: the scatterers near every ray segment."""

    name = "scatterers"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.lines = EchoLines(device)
        size = 4 * (3 + CONSTANTS["UNEVEN_WORDS"]) * CONSTANTS["MAX_TISSUES"]
        self._sites = [device.empty(size) for _ in range(2)]
        # What the tables in them depend on, and whether some tissue varies
        self._tables_made_for: tuple | None = None
        self._is_uneven = False
        self._lobes = device.empty(ACQUISITION.itemsize)
        self._beams = [Tables(device) for _ in range(2)]  # the main beam's and that of its lobes

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the speckle of one frame: its `traced` impulses, zero if scattering is off."""
        frame.traced = self.lines
        self.lines.prepare(2 * int(frame.acquisition["traced_lines"]), frame.line_shape[1])  # two edges of each strip
        if frame.settings.scattering:
            self.scatter(frame, self.lines, frame.medium.rows)
        else:
            self.lines.clear()

    def scatter(self, frame: DeviceFrame, lines: EchoLines, tissues: np.ndarray, part_of: Buffer | None = None) -> None:
        """Enqueue the speckle of one frame with these tissues (layout.TISSUE per label); it overwrites `lines`.

        With `part_of`, a device buffer (MAX_TISSUES,) int32, it comes in CONSTANTS["PARTS"] consecutive parts: see
        kernels/scattering.cl and appearance.py.
        """
        samples, traced = frame.line_shape[1], int(frame.acquisition["traced_lines"])
        end = [] if part_of is None else [part_of]
        variant = (["TEXTURE"] if frame.medium.has_texture else []) + (["VARIED"] if part_of is not None else [])
        variant += ["FOUND"] if frame.medium.found is not None else []
        main, lobes = (
            buffer.get(frame.probe, table) for buffer, table in zip(self._beams, beam_tables(frame.probe), strict=True)
        )
        record = elevational_lobe_record(frame.acquisition)
        made_for = frame.medium.version, tissues.tobytes(), float(record["cell_mm"])
        if self._tables_made_for != made_for:
            table = unevenness_table(tissues)
            self._is_uneven, self._tables_made_for = is_uneven(table), made_for
            of_darkness = np.zeros(CONSTANTS["MAX_TISSUES"]), frame.medium.quieter(DARK)
            for buffer, of, dark in zip(self._sites, (frame.acquisition, record), of_darkness, strict=True):
                parts = lattice_sites(tissues, of).ravel(), dark.astype(np.float32), table.ravel()
                self.device.write(buffer, np.concatenate(parts))
        variant += ["UNEVEN"] if self._is_uneven else []
        self._enqueue(
            frame, lines, frame.acquisition_buffer, self._sites[0],
            [*variant, f"CHUNK={self.device.chunk}"], (samples // self.device.chunk, traced), [main, *end],
        )  # fmt: skip
        if frame.settings.side_lobes:
            self.device.write(self._lobes, record)
            chunk, together = _LOBE_CHUNKS * self.device.chunk, lines_together(int(record["lateral_rays"]), frame.probe)
            self._enqueue(
                frame, lines, self._lobes, self._sites[1], [*variant, "LOBES", f"CHUNK={chunk}"],
                (-(-samples // chunk), -(-traced // together)), [lobes, *end, np.int32(together)],
            )  # fmt: skip

    def _enqueue(
        self, frame: DeviceFrame, lines: EchoLines, record: Buffer, sites: Buffer, variant: list[str],
        size: tuple[int, int], end: list,
    ) -> None:  # fmt: skip
        medium = frame.medium
        self.device.run(
            self.device.kernels("scattering.cl", self.device.lanes, *variant)["scatter"],
            size,
            record,
            medium.voxel_buffer,
            medium.sheet_buffer,
            medium.texture_buffer,
            sites,
            frame.tree.segments,
            frame.tree.segment_counts,
            lines.re,
            lines.im,
            np.int32(lines.stride),
            *end,
            heavy=True,
        )


class InterfaceEchoes(Stage):
    """Adds the echoes of interfaces to the scan lines, from the hits of the elevational rays near each."""

    name = "interfaces"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        kernels = device.kernels("interfaces.cl")
        self._find, self._add = kernels["find_walls"], kernels["interface_echoes"]
        self.workspace = Workspace(device)
        self._planes = Tables(device)
        self._centres_of = 0  # rays
        self._centres: Buffer

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the interface echoes of one frame, unless they are off; they are added to `scanned`."""
        if not frame.settings.interfaces:
            return
        traced, rays = (int(frame.acquisition[name]) for name in ("traced_lines", "elevational_rays"))
        get = self.workspace.get
        walls = get("walls", traced * rays * CONSTANTS["MAX_HITS"] * WALL.itemsize), get("counts", 4 * traced)
        reach = get("reach", 4 * traced)
        tree, scanned = frame.tree, frame.scanned
        if self._centres_of != rays:
            self._centres, self._centres_of = self.device.upload(ray_centres(rays)), rays
        self.device.run(
            self._find, (traced,), frame.acquisition_buffer, tree.hits, tree.hit_counts, self._centres,
            self._planes.get(frame.probe, plane_echoes(frame.probe)), *walls, reach, few=True,
        )  # fmt: skip
        self.device.run(
            self._add,
            (_SLICES if self.device.info.kind == "GPU" else 1, frame.line_shape[0]),
            frame.acquisition_buffer,
            *walls,
            reach,
            scanned.re,
            scanned.im,
            np.int32(scanned.stride),
            few=True,
        )


class LateralBeam(Stage):
    """Distributes the impulses of the traced lines to the scan lines by the lateral beam profile."""

    name = "beam"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        kernels = device.kernels("beam.cl", device.lanes)
        self._join, self._spread = kernels["join_edges"], kernels["lateral_beam"]
        self.lines, self._edges = EchoLines(device), EchoLines(device)

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the lateral convolution of one frame: its `scanned` impulses."""
        scan_lines, samples = frame.line_shape
        scanned = frame.scanned = self.lines
        scanned.prepare(scan_lines, samples)
        traced, vectors = int(frame.acquisition["traced_lines"]), samples // self.device.lanes
        edges, stride = self._edges, np.int32(frame.traced.stride)
        edges.prepare(traced, samples)
        if traced > 1:
            echoes = frame.traced.re, frame.traced.im
            self.device.run(self._join, (vectors, traced - 1), *echoes, edges.re, edges.im, stride)
        self.device.run(
            self._spread,
            (vectors, scan_lines),
            frame.acquisition_buffer,
            edges.re,
            edges.im,
            frame.spreads,
            frame.losses,
            scanned.re,
            scanned.im,
            stride,
        )


@lru_cache(maxsize=16)
def beam_tables(probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """The tables of the main beam and of its lobes (lens.LensBeam), and where they end, as kernels take them."""
    lens = probe.lens()
    main, lobes = (
        np.concatenate([table.ravel(), reach_mm, [reach_mm.max()]])
        for table, reach_mm in ((lens.main, lens.main_mm), (lens.lobes, lens.lobes_mm))
    )
    return main, lobes


def sites_per_mm3(settings: SimulationSettings, probe: Probe) -> float:
    """Density of the lattice of scatterers: the one set, or by the probe's smallest resolution cell."""
    if settings.scatterers_per_mm3 is not None:
        return settings.scatterers_per_mm3
    return float(np.clip(_SITES_PER_CELL / probe.smallest_cell_mm3(), _LEAST_PER_MM3, PAPER_SITES_PER_MM3))


def _integral(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Along the first axis; scipy.integrate takes 0.3 s to import."""
    return (0.5 * (values[1:] + values[:-1]) * np.diff(places, axis=0)).sum(axis=0)


@lru_cache(maxsize=16)
def cells_in_view(
    settings: SimulationSettings, probe: Probe, traced_lines: int, lateral_rays: int, chunk_mm: float
) -> float:
    """Cells of the scatterer lattice that are looked at for one image in tissue without reflections.

    Around the strip of each of the `traced_lines`, of which each scan line has `lateral_rays`, and around its parts of
    `chunk_mm`, these are cells that reach into it: many times those in it where lines are closer than cells.
    """
    density = sites_per_mm3(settings, probe)
    slack = _OBLIQUE * density ** (-1.0 / 3.0)
    reach = probe.lens().main_mm
    depth = np.linspace(0.0, probe.displayed_mm, len(reach))
    height = 2.0 * reach + slack
    width = probe.line_distance_mm(depth) / lateral_rays + slack
    return density * traced_lines * (1.0 + slack / chunk_mm) * float(_integral(height * width, depth))


def lattice_sites(tissues: np.ndarray, acquisition: np.ndarray) -> np.ndarray:
    """(labels, 2) float32: share of lattice cells with a scatterer, in 1/65536, and its amplitude, by layout.TISSUE.

    A cell stands for N sites of the paper's lattice of 20 um. With the share p of them it has a scatterer with the
    probability q = 1 - (1 - p)^N, whose amplitude is sqrt(Var / q) with a random sign (docs/physics.md#5-scatterers).
    """
    fine_sites = max(PAPER_SITES_PER_MM3 * float(acquisition["cell_mm"]) ** 3, 1.0)
    with np.errstate(divide="ignore"):
        q = -np.expm1(fine_sites * np.log1p(-tissues["scatterer_share"].astype(float)))
    share = np.round(65536.0 * q)
    # Of the share as the kernel draws it
    amplitude = np.sqrt(65536.0 * tissues["scatterer_variance"] / np.maximum(share, 1.0)) * (share > 0.0)
    return np.stack([share, amplitude], axis=1).astype(np.float32)


# ---- echogenicity that varies within a tissue (docs/physics.md#uneven-tissue) ----------------------------------------
# The level of a tissue's scatterers, in dB, is a random field of unit variance times texture_db, plus specks: spheres
# of the diameter texture_mm that are speck_db brighter in their middle, less by the square of the distance from there.
# Both come from hashes of lattice indices and are fixed in the patient. Amplitudes are divided by the root of the mean
# power, so that the tissue keeps its echogenicity.

#: Distance, in steps of the lattice of g, at which its correlation is one half
HALF_CORRELATION = 0.754
#: Decibels to exponents of two of an amplitude
_LOG2_PER_DB = np.log2(10.0) / 20.0


def unevenness_table(tissues: np.ndarray) -> np.ndarray:
    """(labels, 8) float32 by layout.TISSUE, CONSTANTS["UNEVEN_WORDS"] numbers each.

    Steps of the lattice of g per mm, 0 for none; exponent of two of the amplitude per standard deviation; of all
    scatterers, which keeps the mean power; lattice cells of specks per mm, 0 for none; share of cells with one, in
    1/65536; exponent in their middle.
    """
    deviation, length, number, bright = (
        tissues[name].astype(float) for name in ("texture_db", "texture_mm", "specks_per_mm3", "speck_db")
    )
    table = np.zeros((len(tissues), CONSTANTS["UNEVEN_WORDS"]))
    has_texture = deviation > 0.0
    has_specks = (number > 0.0) & (bright > 0.0)
    per_mm = 1.0 / np.where(length > 0.0, length, 1.0)
    table[:, 0] = np.where(has_texture, HALF_CORRELATION * per_mm, 0.0)
    table[:, 1] = np.where(has_texture, _LOG2_PER_DB * deviation, 0.0)
    table[:, 3] = np.where(has_specks, per_mm, 0.0)
    share = np.minimum(np.rint(65536.0 * number * length**3), 65536.0)
    table[:, 4] = np.where(has_specks, share, 0.0)
    table[:, 5] = np.where(has_specks, _LOG2_PER_DB * bright, 0.0)
    # The mean of 10^(d g / 10) of a normal g is exp((d ln 10 / 10)^2 / 2)
    neper = np.log(10.0) / 10.0 * np.where(has_texture, deviation, 0.0)
    power = np.exp(0.5 * neper**2)
    power *= 1.0 + table[:, 4] / 65536.0 * (np.array([speck_power(float(db)) for db in bright]) - 1.0)
    table[:, 2] = -0.5 * np.log2(power)
    return table.astype(np.float32)


def is_uneven(table: np.ndarray) -> bool:
    """Whether some tissue of an unevenness_table varies."""
    return bool((table[:, [0, 3]] > 0.0).any())


@cache
def speck_power(speck_db: float) -> float:
    """Mean power, relative to tissue, in a lattice cell with a speck: 10^(db max(0, 1 - r^2) / 10), r from 0 in
    the middle to 1 at the faces."""
    axis = (np.arange(64) + 0.5) / 32.0 - 1.0
    squared = axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2
    return float((10.0 ** (0.1 * speck_db * np.maximum(1.0 - squared, 0.0))).mean())
