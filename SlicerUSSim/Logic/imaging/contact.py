"""Contact: which part of a scan line's aperture touches the patient (docs/physics.md#contact).

Gel fills a gap of some millimetres between a transducer and the skin. An element over a wider gap has air before it: it
neither sends nor receives. With the part c of its aperture in contact, a line has c^2 of its amplitude: c of what is
sent, and c of what is received.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import sample

#: Places along the face per aperture, and across it; steps through the gap in voxels
_ALONG, _ACROSS, _STEP = 25, 5, 0.5
#: Without a gap, a face further from the patient than a bath or a cavity needs triggers a warning, mm
_BATH_MM = 30.0


def line_contact(labels: Volume, probe: Probe, probe_to_ras: np.ndarray, gap_mm: float) -> np.ndarray:
    """(scan_lines,) float32 factor of every line's amplitude, 0 to 1.

    Parameters
    ----------
    labels : (k, j, i) whole numbers; 0 is the coupling medium.
    probe_to_ras : (4, 4) rigid.
    gap_mm : the widest gap that gel fills; 0 or more.
    """
    middles, half = _line_middles(probe), 0.5 * probe.aperture_mm
    edges, touching = _touching(labels, probe, probe_to_ras, gap_mm)
    # The mean over an aperture is the difference of two sums along the face.
    sums = np.append(0.0, np.cumsum(touching * np.diff(edges)))
    share = (np.interp(middles + half, edges, sums) - np.interp(middles - half, edges, sums)) / (2.0 * half)
    return (share.clip(0.0, 1.0) ** 2).astype(np.float32)


def touching_share(labels: Volume, probe: Probe, probe_to_ras: np.ndarray, gap_mm: float) -> float:
    """Share of the face, over all of its apertures, that touches the patient, 0 to 1; at 0 no line has an echo.

    Parameters as in line_contact.
    """
    return float(_touching(labels, probe, probe_to_ras, gap_mm)[1].mean())


def about_contact(labels: Volume, probe: Probe, poses: Sequence[np.ndarray], gap_mm: float | None) -> tuple[str, ...]:
    """A line about a face no part of which touches the patient, at one pose (4, 4) or more; nothing if all do.

    Without a gap (None) the patient lies in the coupling medium, and a face far from it triggers a warning. The others
    are as in line_contact.
    """
    reach = _BATH_MM if gap_mm is None else gap_mm
    steps = (0.1 * reach, reach)  # most faces are near, which takes a tenth of the time to see
    off = sum(not any(touching_share(labels, probe, pose, mm) > 0.0 for mm in steps) for pose in poses)
    if not off:
        return ()
    which = "" if len(poses) == 1 else f"in {off} of {len(poses)} images "
    if gap_mm is None:
        return (
            f"{which}the probe's face is more than {_BATH_MM:g} mm from the patient, across the coupling medium, as in "
            "a water bath; if it should touch, move it onto the patient",
        )
    black = "the image is black" if len(poses) == 1 else "they are black"
    return (
        f"{which}0% of the probe's face touches the patient (contact gap: {gap_mm:g} mm): {black}; move the probe onto "
        "the patient",
    )


def _touching(labels: Volume, probe: Probe, probe_to_ras: np.ndarray, gap_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """((n + 1,) edges of n parts along the face in mm, (n,) share of each that touches the patient)."""
    middles, half = _line_middles(probe), 0.5 * probe.aperture_mm
    count = int(np.ceil(_ALONG * (np.ptp(middles) + 2.0 * half) / (2.0 * half)))
    edges = np.linspace(middles.min() - half, middles.max() + half, count + 1)
    points, outward = _on_face(probe, 0.5 * (edges[1:] + edges[:-1]))
    steps = int(np.ceil(gap_mm / (_STEP * float(labels.spacing_mm.min())))) + 1
    away = np.linspace(0.0, gap_mm, steps)[:, None, None, None]
    ras = (points + away * outward) @ probe_to_ras[:3, :3].T + probe_to_ras[:3, 3]
    return edges, (sample(labels, ras, order=0) > 0).any(axis=0).mean(axis=1)


def _line_middles(probe: Probe) -> np.ndarray:
    """(scan_lines,) where the apertures of lines have their middles, in mm along the face."""
    position, radius = probe.line_positions(), probe.apex_radius_mm
    if probe.is_linear:
        return position / np.cos(probe.steering_rad)
    return radius * (np.tan(position) if probe.has_flat_face else position)


def _on_face(probe: Probe, along_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(points on the face, directions into the patient), (along, across, 3) in the probe frame, in mm and unit."""
    across = probe.elevation_aperture_mm * ((np.arange(_ACROSS) + 0.5) / _ACROSS - 0.5)
    turn = np.zeros_like(along_mm) if probe.has_flat_face else along_mm / probe.apex_radius_mm
    radius = 0.0 if probe.has_flat_face else probe.apex_radius_mm
    lateral = along_mm if probe.has_flat_face else radius * np.sin(turn)
    points = np.stack(np.broadcast_arrays(lateral[:, None], radius * (np.cos(turn[:, None]) - 1.0), across), axis=-1)
    outward = np.stack([np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=-1)[:, None]
    return points, outward
