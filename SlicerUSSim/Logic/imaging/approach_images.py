"""Images of the candidates of an approach, the contrast of the target in them, and the report (HTML)."""

from __future__ import annotations

import html
import os
from dataclasses import replace

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.imaging.figures import png_url
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.placement.approach import Approach, opened_for
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tissue.names import OUTSIDE, labels_of
from SlicerUSSim.Logic.tissue.presets import colour_of

#: The brain around a target is that so far from it in the image, mm; a mean needs so many pixels
_AROUND_MM, _FEWEST = (4.0, 12.0), 100
_YELLOW, _BLUE = (255, 200, 61), (89, 217, 255)
_STYLE = """body { background: #161616; color: #e4e4e4; font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto;
max-width: 900px; padding: 0 1rem } img { width: 49% } .dim { color: #9a9a9a } .advice { color: #ffc83d }"""


def simulated_approach(
    approach: Approach, simulator: UltrasoundSimulator, probe: Probe, display: DisplaySettings | None = None
) -> Approach:
    """The candidates with images, in which the target is outlined, and contrasts, from one batch of drafts.

    `simulator` belongs to the labels of the plan, which are closed. All openings are made in one label map, which the
    batch shares. Contrasts are between displayed levels; None where target or brain around it are not in the field.
    """
    medium, names = simulator.medium, simulator.medium.tissues.names_by_label()
    drafts = UltrasoundSimulator(
        opened_for(medium.labels, names, approach.candidates), medium.tissues,
        replace(simulator.settings, quality="draft", contact_gap_mm=None),  # saline fills the openings
        simulator.device, simulator.texture, medium.sheets,
    )  # fmt: skip
    shown = replace(display or DisplaySettings(), image_size=None, persistence=0.0, grey_map="linear")
    poses = [candidate.probe_to_ras for candidate in approach.candidates]
    batch = drafts.simulate_batch(probe, poses, display=shown, outputs=("image", "labels"))
    grid, seen = ImageGrid.for_probe(probe, None), []
    pixel_mm, target = grid.pixel_spacing_mm[1], approach.target
    colours = np.multiply([(0.0, 0.0, 0.0), *map(colour_of, names)], 255.0).astype(np.uint8)
    for candidate, image, tissues in zip(approach.candidates, batch["image"], batch["labels"], strict=True):
        pose, face = candidate.probe_to_ras, candidate.probe_to_ras[:3, 3]
        inside = slice_under_probe(target.region, grid, pose, order=0) > 0
        picture = np.repeat(image[..., None], 3, axis=2)
        picture[inside & ~ndimage.binary_erosion(inside)] = _YELLOW  # type: ignore[operator]
        in_brain = (tissues > 0) & ~np.isin(tissues, labels_of(names, OUTSIDE))
        away = np.asarray(ndimage.distance_transform_edt(~inside, sampling=grid.pixel_spacing_mm[::-1]))
        around = in_brain & (away > _AROUND_MM[0]) & (away <= _AROUND_MM[1])
        levels = image[inside & in_brain], image[around]
        contrast = None
        if min(map(len, levels)) >= _FEWEST:
            contrast = float(levels[0].mean() - levels[1].mean()) / 255.0 * shown.dynamic_range_db
        skin, depth = (int(np.linalg.norm(end - face) / pixel_mm) for end in (candidate.entry_ras, target.centre_ras))
        above = skin + 40  # the section and the path begin some pixels above the skin
        taller = replace(grid, rows=grid.rows + above, top_mm=-above * pixel_mm)
        volumes = medium.labels, opened_for(medium.labels, names, [candidate])
        closed, opened = (slice_under_probe(volume, taller, pose, order=0) for volume in volumes)
        section = colours[closed]
        section[closed != opened] = _BLUE
        section[: above + depth, grid.columns // 2 - 1 : grid.columns // 2 + 2] = _BLUE
        seen.append(replace(candidate, pictures=(picture, section), contrast_db=contrast))
    return replace(approach, candidates=tuple(seen))


def write_approach_report(path: str | os.PathLike, approach: Approach, subtitle: str = "") -> None:
    """Write simulated candidates with pictures and numbers as one HTML file; on failure an existing file is kept."""
    parts = "".join(
        f"<h2>Candidate {number}</h2><p>{html.escape(candidate.text)}</p>"
        + "".join(f'<img alt="candidate {number}" src="{png_url(picture)}">' for picture in candidate.pictures)
        for number, candidate in enumerate(approach.candidates, 1)
    )
    title = html.escape(f"Approach to the {approach.target.name}")
    text = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style></head><body>
<h1>{title}</h1><p class="dim">{html.escape(subtitle)}</p><p class="advice">{NO_ADVICE}</p>
<p>{html.escape(approach.target.text)}</p>{parts}</body></html>"""
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
