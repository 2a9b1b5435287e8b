"""Sheets found in an MRI, as rays and scatterers meet them (kernels/sheet_hits.cl, kernels/scattering.cl).

Which voxels have a plane, and which gaps are closed, is taken from imaging/found_sheets.py, which works on the host;
what its words mean is decoded here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.found_sheets import found_sheets
from SlicerUSSim.Logic.mri.sheets.surfels import Surfels
from SlicerUSSim.Logic.opencl.layout import HIT
from SlicerUSSim.Logic.tissue.table import TissueTable
from tests.reference.beam import Beam
from tests.reference.elementary import f32


@dataclass(frozen=True, eq=False)
class DrawnPlanes:
    """A plane per voxel of a padded label map, flat arrays of all its voxels."""

    #: (k, j, i) uint8 labels with closed gaps, and bool where they were
    label: np.ndarray
    closed: np.ndarray
    #: Whether there is a plane; (n, 3) unit gradients in voxels; distance in voxels
    is_drawn: np.ndarray
    gradient: np.ndarray
    distance: np.ndarray
    #: Half the thickness, mm; amplitude of scatterers, and whether they are of the dura's tissue; reflection
    #: coefficient; label beside
    half: np.ndarray
    level: np.ndarray
    is_dura: np.ndarray
    reflection: np.ndarray
    beside: np.ndarray
    #: Whether a scatterer of the cell that starts at a voxel may lie in a sheet
    near_cell: np.ndarray

    @classmethod
    def of(cls, sheets: Surfels | None, grid: Volume, padded: np.ndarray, tissues: TissueTable) -> DrawnPlanes | None:
        membrane = tissues.membrane
        if sheets is None or not len(sheets) or membrane is None or membrane.thickness_mm == 0:
            return None
        fluids = tuple(label for label, tissue in tissues.items() if label and tissue.name in membrane.fluids)
        found = found_sheets(sheets, padded, grid, fluids, tissues)
        if not len(found.voxels):
            return None
        plane, look = found.words.T.astype(np.int64)
        u, v = ((plane >> shift & 511) / 255.0 - 256.0 / 255.0 for shift in (0, 9))
        z = 1.0 - np.abs(u) - np.abs(v)
        folded = np.maximum(-z, 0.0)
        gradient = np.stack([u - np.copysign(folded, u), v - np.copysign(folded, v), z], axis=1)
        gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
        near_cell = np.zeros(padded.shape, bool)
        k, j, i = np.unravel_index(found.voxels[found.is_near], padded.shape)
        for corner in np.ndindex(2, 2, 2):
            near_cell[k - corner[0], j - corner[1], i - corner[2]] = True

        def spread(values: np.ndarray) -> np.ndarray:
            result = np.zeros((padded.size, *values.shape[1:]), np.float32)
            result[found.voxels] = values
            return result

        return cls(
            found.labels, found.closed, spread(np.ones(len(plane))) > 0, spread(gradient),
            spread(((look & 2047) - 1024) / 64.0), spread((look >> 11 & 255) / 128.0),
            spread(10.0 ** (0.25 * ((look >> 19 & 255) - 192) / 20.0)), spread(look >> 27 & 1) > 0,
            spread(0.008 * (look >> 28)), spread(plane >> 26), near_cell.ravel(),
        )  # fmt: skip


def sheet_hits(
    acquisition: np.ndarray, planes: DrawnPlanes, quantiles: np.ndarray, segments: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(layout.HIT, traced lines) where rays at (traced lines, rays) quantiles of the elevational beam meet dura."""
    beam, voxel_mm = Beam(acquisition), acquisition["voxel_mm"]
    stride, dims = f32(0.5) * voxel_mm, acquisition["dims"].astype(np.int64)
    matrix = acquisition["ras_to_voxel"].reshape(3, 4)
    hits, hit_lines = [], []
    for segment, line in zip(segments, lines, strict=True):
        middle = (np.arange(np.ceil(segment["length_mm"] / stride), dtype=np.float32) + f32(0.5)) * stride
        on_axis = segment["start"] + middle[:, None] * segment["direction"]
        for quantile in quantiles[line]:
            aside = quantile * beam.elevation_sigma(segment["path_mm"] + middle)
            place = (on_axis + aside[:, None] * segment["elevational"]) @ matrix[:, :3].T + matrix[:, 3]
            nearest = np.floor(place + f32(0.5)).astype(np.int64)
            inside = ((nearest >= 0) & (nearest < dims)).all(axis=1)
            flat = np.where(inside, nearest @ [1, dims[0], dims[0] * dims[1]], 0)
            gradient, reflection = planes.gradient[flat], planes.reflection[flat]
            rate = gradient @ (matrix[:, :3] @ segment["direction"])
            away = ((place - nearest) * gradient).sum(axis=1) - planes.distance[flat]
            ahead = -away / np.where(np.abs(rate) < 1e-6, f32(1e-6), rate)
            along = middle + ahead
            meets = inside & (reflection > 0) & (np.abs(ahead) <= f32(0.75) * stride)
            meets &= (along >= 0) & (along <= segment["length_mm"])
            last = -np.inf
            for n in np.flatnonzero(meets):
                if along[n] < last + voxel_mm:
                    continue
                last = along[n]
                normal = gradient[n] @ matrix[:, :3]
                hits.append(segment_hit(acquisition, beam, segment, quantile, along[n], normal, reflection[n]))
                phase = acquisition["membrane_phase"] * hits[-1]["cos_incidence"]
                hits[-1]["echo"] *= np.exp(-0.5 * phase**2)
                hit_lines.append(line)
    return np.array(hits, HIT), np.array(hit_lines, int)


def segment_hit(acquisition, beam: Beam, segment, quantile, along, normal, reflection) -> np.ndarray:
    """The layout.HIT where a ray meets a smooth surface at a length along a segment (kernels/hits.clh)."""
    hit = np.zeros((), HIT)
    direction, depth_per_mm = segment["direction"], segment["depth_per_mm"]
    normal = normal / np.linalg.norm(normal)
    normal = -normal if normal @ direction > 0 else normal
    cosine = np.clip(-normal @ direction, 0.01, 1.0)
    tube = segment["tube"] + along * segment["tube"][[1, 1, 3, 3]] * [1, 0, 1, 0]
    hit["path_mm"], hit["depth_mm"] = segment["path_mm"] + along, segment["depth_mm"] + along * depth_per_mm
    offset = hit["elevational_mm"] = quantile * beam.elevation_sigma(hit["path_mm"])
    hit["position"] = segment["start"] + along * direction + offset * segment["elevational"]
    hit["normal"], hit["cos_incidence"], hit["reflectance"] = normal, cosine, reflection**2
    hit["weight"], hit["loss"] = segment["weight"], segment["loss"] + along * segment["loss_per_mm"]
    hit["attenuation"] = segment["attenuation"] * np.exp(-segment["decay_per_mm"] * along)
    for name, size in (("lateral", tube[0]), ("elevational", tube[2])):
        hit[f"{name}_slope"] = depth_per_mm * size * -(normal @ segment[name]) / min(normal @ direction, -0.05)
    echo = hit["reflectance"] if acquisition["interface_is_energy"] else reflection
    hit["echo"] = (
        hit["weight"] * hit["attenuation"] * echo * cosine ** acquisition["specular_exponent"]
        * acquisition["interface_gain"] / (acquisition["elevational_rays"] * tube[0] * tube[2])
    )  # fmt: skip
    hit["reflections"], hit["label_before"], hit["label_behind"] = (
        segment[n] for n in ("reflections", "label", "label")
    )
    return hit
