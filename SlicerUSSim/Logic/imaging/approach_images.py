"""Images of the candidates of an approach, the contrast of the target in them, and the report (HTML)."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.figures import html_table, png_url
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.placement.approach import Approach, Candidate, Target, opened_for
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import sample, slice_under_probe
from SlicerUSSim.Logic.tissue.names import OUTSIDE, labels_of
from SlicerUSSim.Logic.tissue.presets import colour_of
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

#: (rows, columns) of the images
_PIXELS = (256, 256)
#: The brain around a target is that so far from its voxels, mm
_AROUND_MM = (4.0, 12.0)
_YELLOW, _WHITE = (255, 200, 61), (255, 255, 255)
#: What a picture of the tissues shows around the field: to both sides, and behind the face, mm
_WIDE_MM, _BEHIND_MM, _PIXEL_MM = 60.0, 40.0, 0.5
_STYLE = """body { background: #161616; color: #e4e4e4; font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto;
max-width: 1180px; padding: 0 1rem } table { border-collapse: collapse } td, th { text-align: left;
padding: .2rem .7rem; border-bottom: 1px solid #3a3a3a } .pair { display: flex; gap: 1rem; align-items: end }
img { height: 380px; background: #000 } figure { margin: 0 }
.dim, figcaption { color: #9a9a9a } .advice { color: #ffc83d }"""
#: Fewer samples are no mean; an envelope has at least this much noise
_FEWEST, _LEAST = 30, 1e-6


def simulated_approach(
    approach: Approach,
    labels: Volume,
    tissues: TissueTable,
    probe: Probe,
    settings: SimulationSettings | None = None,
    display: DisplaySettings | None = None,
    *,
    device: DeviceChoice = None,
    texture: Texture | None = None,
    sheets: Surfels | None = None,
) -> Approach:
    """The candidates with their images and the contrasts of the target, from one batch of drafts.

    `labels` are those of the closed head, or of the brain alone, and with what follows as for UltrasoundSimulator. All
    openings are made in one label map, which the batch shares. A contrast is None where target or brain around it are
    not in the field.
    """
    names = tissues.names_by_label()
    drafts = UltrasoundSimulator(
        opened_for(labels, names, approach.candidates), tissues,
        replace(settings or SimulationSettings(), quality="draft", contact_gap_mm=None),  # saline fills the openings
        device, texture, sheets,
    )  # fmt: skip
    shown = replace(display or DisplaySettings(), image_size=_PIXELS, persistence=0.0)
    poses = [candidate.probe_to_ras for candidate in approach.candidates]
    batch = drafts.simulate_batch(probe, poses, display=shown, outputs=("image", "envelope"))
    brain = labels.with_array(np.isin(labels.array, labels_of(names, OUTSIDE), invert=True) & (labels.array > 0))
    seen = []
    for candidate, image, envelope in zip(approach.candidates, batch["image"], batch["envelope"], strict=True):
        contrast = _contrast_db(envelope, probe, candidate.probe_to_ras, approach.target, brain)
        seen.append(replace(candidate, image=image, contrast_db=contrast))
    return replace(approach, candidates=tuple(seen))


def _contrast_db(
    envelope: np.ndarray, probe: Probe, probe_to_ras: np.ndarray, target: Target, brain: Volume
) -> float | None:
    """Mean level, dB, of an envelope (scan_lines, samples) in the target above that in the brain around it."""
    lines, samples = envelope.shape
    origin, direction = probe.line_at(replace(probe, scan_lines=lines).line_positions())
    along = (np.arange(samples) + 0.5) * probe.displayed_mm / samples
    points = origin[:, None] + along[:, None] * direction[:, None]
    ras = points @ probe_to_ras[:3, :3].T + probe_to_ras[:3, 3]
    near = np.linalg.norm(ras - target.centre_ras, axis=-1) <= target.size_mm + _AROUND_MM[1]
    level, places = 20.0 * np.log10(np.maximum(envelope[near], _LEAST)), ras[near]
    if not len(places):
        return None
    inside, away = target.holds(places), KDTree(target.points_ras).query(places)[0]
    low, high = _AROUND_MM
    around = ~inside & (away > low) & (away <= high) & (sample(brain, places, order=0) > 0)
    if inside.sum() < _FEWEST or around.sum() < _FEWEST:
        return None
    return float(level[inside].mean() - level[around].mean())


# ---- pictures and report ---------------------------------------------------------------------------------------------


def outlined(candidate: Candidate, target: Target, probe: Probe) -> np.ndarray:
    """(rows, columns, 3) uint8: the simulated image of a candidate with the outline of the target.

    Raises SimulationError for a candidate without an image.
    """
    image = required(candidate.image, "the candidate has no image, simulate the approach first")
    grid = ImageGrid.for_probe(probe, (image.shape[0], image.shape[1]))
    return _with_outline(np.repeat(image[..., None], 3, axis=2), candidate, target, grid)


def tissues_in_plane(
    candidate: Candidate, target: Target, labels: Volume, names: Sequence[str], probe: Probe
) -> np.ndarray:
    """(rows, columns, 3) uint8: the tissues around the field of a candidate, its way (white) and the target's outline.

    `labels` are those with the opening.
    """
    rows, columns = (int(mm / _PIXEL_MM) for mm in (_BEHIND_MM + probe.depth_mm, 2.0 * _WIDE_MM))
    grid = ImageGrid(rows, columns, -_WIDE_MM, -_BEHIND_MM, (_PIXEL_MM, _PIXEL_MM))
    colours = (255 * np.array([(0.0, 0.0, 0.0), *map(colour_of, names)])).astype(np.uint8)
    picture = colours[slice_under_probe(labels, grid, candidate.probe_to_ras, order=0)]
    field = grid.field(probe)
    picture[field ^ ndimage.binary_erosion(field)] = _WHITE  # type: ignore[operator]
    ends = np.array([candidate.entry_ras, target.centre_ras])
    depths = ((ends - candidate.probe_to_ras[:3, 3]) @ candidate.probe_to_ras[:3, 1] + _BEHIND_MM) / _PIXEL_MM
    low, high = np.clip(depths.astype(int), 0, rows)
    picture[low:high, columns // 2 - 1 : columns // 2 + 1] = _WHITE
    return _with_outline(picture, candidate, target, grid)


def _with_outline(picture: np.ndarray, candidate: Candidate, target: Target, grid: ImageGrid) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    matrix = candidate.probe_to_ras @ grid.image_to_probe
    ras = np.stack([columns, rows], axis=-1) @ matrix[:3, :2].T + matrix[:3, 3]
    inside = target.holds(ras)
    picture = picture.copy()
    picture[inside & ~ndimage.binary_erosion(inside)] = _YELLOW  # type: ignore[operator]
    return picture


def write_approach_report(
    path: str | os.PathLike, approach: Approach, labels: Volume, names: Sequence[str], probe: Probe, *,
    subtitle: str = "", weights: Mapping[str, float] | None = None,
) -> None:  # fmt: skip
    """Write the candidates with pictures and numbers as one HTML file; on failure an existing file is kept.

    `labels` are the closed ones, called `names`. Raises SimulationError for candidates without images.
    """
    target = approach.target
    planes = [
        tissues_in_plane(candidate, target, opened_for(labels, names, [candidate]), names, probe)
        for candidate in approach.candidates
    ]
    parts = [
        f"""<h2>Candidate {number}</h2><p>{html.escape(candidate.text)}</p><div class="pair"><figure>
<img alt="simulated image {number}" src="{png_url(outlined(candidate, target, probe))}">
<figcaption>simulated</figcaption></figure><figure><img alt="tissues {number}"
src="{png_url(plane)}">
<figcaption>tissues in its plane, with the opening, the way and the field</figcaption></figure></div>"""
        for number, (candidate, plane) in enumerate(zip(approach.candidates, planes, strict=True), 1)
    ]
    heads = ["candidate", "cost", *approach.candidates[0].costs]
    rows = [
        [str(number), f"{candidate.cost:.1f}", *(f"{part:.1f}" for part in candidate.costs.values())]
        for number, candidate in enumerate(approach.candidates, 1)
    ]
    rows += [["weight", "", *(f"{value:g}" for value in weights.values())]] if weights else []
    title = html.escape(f"Approach to the {approach.target.name}")
    text = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style></head><body>
<h1>{title}</h1><p class="dim">{html.escape(subtitle)}</p><p class="advice">{NO_ADVICE}</p>
<p>{html.escape(approach.target.text)}; {approach.compared} ways compared.</p>
{"".join(parts)}
<h2>Cost</h2><p class="dim">In millimetres of brain that are as bad; the lower, the better.</p>
{html_table(heads, rows)}</body></html>"""
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
