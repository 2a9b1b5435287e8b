"""A scanner's floor: side lobes, ring-down and contact (kernels/side_lobes.cl, bmode.cl, harmonic.cl)."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.arrays import ConvexProbe, Probe
from tests.reference.acquisition import (
    harmonic_level,
    line_roots,
    received_wavelength_mm,
)
from tests.reference.beam import Beam
from tests.reference.elementary import f32, hash_mix
from tests.reference.lobes import lateral_table

_COARSER = 4.0
_MOST_NODES = 128
#: Samples with one width of the lobes
_TOGETHER = 16


def lobe_lattice(acquisition: np.ndarray) -> np.ndarray:
    """The record for what elevational side lobes receive: a coarser lattice with its own scatterers."""
    record = acquisition.copy()
    record["cell_mm"] = _COARSER * float(acquisition["cell_mm"])
    record["seed"] = hash_mix(np.array([acquisition["seed"] ^ np.uint32(0x51DE10BE)], np.uint32))[0]
    record["speckle_scale"] = float(acquisition["speckle_scale"]) * _COARSER**1.5
    return record


def quiet_labels(tissues: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(labels,) bool: less than a quarter of the variance that echoes of the volume come from on average."""
    variance = tissues["scatterer_variance"].astype(float)
    echoes = variance[labels.ravel()]
    return variance < 0.25 * (echoes**2).sum() / max(echoes.sum(), 1e-30)


def lines_of_a_path(acquisition: np.ndarray, probe: Probe) -> int:
    """Neighbouring lines within three sigmas of the beam in the middle of the image, whose lobes have one path."""
    beam, middle = Beam(acquisition), f32(0.5 * probe.depth_mm)
    return min(max(round(3.0 * float(beam.lateral_sigma(middle) / beam.line_distance(middle))), 1), 9)


def add_lateral_lobes(acquisition: np.ndarray, probe: Probe, scanned: np.ndarray) -> np.ndarray:
    """(scan lines, samples) complex64: with the lobes in quadrature, and the power of the main beam before."""
    beam, table = Beam(acquisition), lateral_table(acquisition, probe)
    lines, samples = scanned.shape
    roots = line_roots(acquisition)[int(acquisition["guard_lines"]) :: int(acquisition["lateral_rays"])]
    result = np.empty(scanned.shape, np.complex128)
    line, start = np.arange(lines), beam.line_start(f32(0.5 * (lines - 1)))
    for first in range(0, samples, _TOGETHER):
        depth = f32((first + 0.5 * _TOGETHER) * acquisition["sample_mm"])
        s = np.maximum(depth - start, f32(0))
        apart = float(beam.line_distance(depth)) * int(acquisition["lateral_rays"])
        main = float(beam.lateral_sigma(s))
        unit = received_wavelength_mm(probe) * max(probe.receive_f_number, float(s) / probe.aperture_mm)
        together = int(np.clip(int(unit / apart), -(-lines // _MOST_NODES), lines))
        nodes = -(-lines // together)
        averaging = (np.arange(nodes)[:, None] == line // together) / together
        steps = np.arange(together)
        # Of exp(-y^2 / 2 main^2 + i curvature y^2 / 2) with itself
        narrow = main**-2 + (float(beam.lateral_curvature(s)) * main) ** 2
        correlation = np.exp(-0.25 * narrow * ((steps[:, None] - steps) * apart) ** 2)
        distance = np.abs(np.subtract.outer(np.arange(nodes), np.arange(nodes)))
        weights = table.at(np.full(distance.shape, float(s)), distance * together * apart / unit)
        shown = np.minimum(np.arange(nodes) * together + together // 2, lines - 1)
        cell = f32(4) * f32(received_wavelength_mm(probe) * probe.receive_f_number)
        places = _bits_at(acquisition, beam, roots, shown, depth, cell)
        bits = hash_mix(distance.astype(np.uint32) * np.uint32(0x9E3779B1) + np.uint32(0x3C6EF372))
        turned = (bits << np.uint32(16)) | (bits >> np.uint32(16))
        offsets = np.where(np.arange(nodes)[:, None] > np.arange(nodes), bits, turned)  # to the left, to the right
        weights *= np.sqrt(together * apart / unit / correlation.mean())
        weights *= np.where(distance == 0, 1.0, _signs(offsets & places))
        of_nodes = weights @ averaging @ scanned[:, first : first + _TOGETHER]
        place = (line + 0.5) / together - 0.5
        before = np.floor(place).astype(int)
        part = (place - before)[:, None]
        left, right = (of_nodes[np.clip(before + n, 0, nodes - 1)] for n in (0, 1))
        between = (1.0 - part) * left + part * right
        has_two = ((before >= 0) & (before < nodes - 1))[:, None]
        between /= np.where(has_two, np.sqrt((1.0 - part) ** 2 + part**2), 1.0)
        kept = 1.0 / np.sqrt(1.0 + correlation.mean() * (weights**2).sum(axis=1))
        near, far = (kept[np.clip(before + n, 0, nodes - 1), None] for n in (0, 1))
        both = scanned[:, first : first + _TOGETHER] + 1j * between
        result[:, first : first + _TOGETHER] = ((1.0 - part) * near + part * far) * both
    return result.astype(np.complex64)


def _bits_at(
    acquisition: np.ndarray, beam: Beam, roots: np.ndarray, line: np.ndarray, depth: np.ndarray, cell_mm: np.ndarray
) -> np.ndarray:
    """(lines,) uint32 random bits of the cells of the patient in which scan lines are at a displayed depth."""
    along = np.maximum(depth - beam.line_start(line), f32(0))
    x, y = roots[line, 0] + along * roots[line, 2], roots[line, 1] + along * roots[line, 3]
    to_ras, per_cell = acquisition["probe_to_ras"].reshape(3, 4), f32(1) / cell_mm / f32(3)
    p = [(row[0] * x + row[1] * y + row[3]) * per_cell for row in to_ras]
    turned = [f32(2) * (p[0] + p[2]) - p[1], f32(2) * (p[0] + p[1]) - p[2], f32(2) * (p[1] + p[2]) - p[0]]
    key = np.zeros(len(line), np.uint32)
    for along, step in zip(turned, (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D), strict=True):
        key += np.floor(along + f32(0.37)).astype(np.int32).astype(np.uint32) * np.uint32(step)
    return hash_mix(key ^ acquisition["seed"])


def _signs(bits: np.ndarray) -> np.ndarray:
    """-1 where the number of bits that are set is odd, else 1."""
    for shift in (16, 8, 4, 2, 1):
        bits = bits ^ (bits >> np.uint32(shift))
    return 1.0 - 2.0 * (bits & np.uint32(1))


def ring_down(acquisition: np.ndarray, probe: Probe, axial_sigma_mm: float) -> np.ndarray:
    """(samples,) complex64: pulses one width apart, of alternating sign, that fall by 40 dB over the ring-down."""
    depth = np.arange(int(acquisition["samples"])) * float(acquisition["sample_mm"])
    signal = np.zeros(len(depth), np.complex128)
    if probe.ring_down_mm > 0.0:
        apart, sign, place = np.sqrt(8.0 * np.log(2.0)) * axial_sigma_mm, 1.0, 0.0
        while place < 2.0 * probe.ring_down_mm:
            level = 10.0 ** ((probe.ring_down_db - 40.0 * place / probe.ring_down_mm) / 20.0)
            carrier = np.exp(-2j * np.pi * float(acquisition["cycles_per_mm"]) * place)
            signal += sign * level * carrier * np.exp(-0.5 * ((depth - place) / axial_sigma_mm) ** 2)
            sign, place = -sign, place + apart
    if probe.harmonic:
        signal *= harmonic_level(probe, depth)
    return signal.astype(np.complex64)


def contact(
    acquisition: np.ndarray, labels: Volume, probe: Probe, probe_to_ras: np.ndarray, gap_mm: float
) -> np.ndarray:
    """(scan lines,) float32: the square of the part of every line's aperture that has tissue within a gap."""
    line = float(acquisition["first_line"]) + float(acquisition["line_spacing"]) * np.arange(probe.scan_lines)
    along = probe.aperture_mm * ((np.arange(100) + 0.5) / 100 - 0.5)
    if isinstance(probe, ConvexProbe):
        angle = line[:, None] + along / probe.radius_mm
        face = probe.radius_mm * np.stack([np.sin(angle), np.cos(angle) - 1.0], axis=-1)
        normal = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    else:
        radius = float(acquisition["apex_radius_mm"])
        middle = line / float(acquisition["steering_cos"]) if acquisition["linear"] else radius * np.tan(line)
        face = np.stack([middle[:, None] + along, np.zeros((len(line), 100))], axis=-1)
        normal = np.broadcast_to([0.0, 1.0], face.shape)
    to_ijk, touching = labels.ras_to_ijk @ probe_to_ras, np.zeros((5, *face.shape[:-1]), bool)
    for row, share in enumerate((np.arange(5) - 2.0) / 5.0):
        for away in np.linspace(0.0, gap_mm, int(np.ceil(4.0 * gap_mm / labels.spacing_mm.min())) + 1):
            lateral, depth = np.moveaxis(face + away * normal, -1, 0)
            place = np.stack([lateral, depth, np.full_like(depth, share * probe.elevation_aperture_mm)], axis=-1)
            i, j, k = np.moveaxis(np.rint(place @ to_ijk[:3, :3].T + to_ijk[:3, 3]).astype(int), -1, 0)
            nk, nj, ni = labels.array.shape
            inside = (i >= 0) & (i < ni) & (j >= 0) & (j < nj) & (k >= 0) & (k < nk)
            touching[row][inside] |= labels.array[k[inside], j[inside], i[inside]] > 0
    return (touching.mean(axis=(0, 2)) ** 2).astype(np.float32)
