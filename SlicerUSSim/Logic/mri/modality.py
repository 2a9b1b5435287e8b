"""One call for MRIs and CTs: what commands, filters and scenes segment, by its contrast."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct import CtSegmentation, segment_ct
from SlicerUSSim.Logic.mri.ct_unit import settings_for
from SlicerUSSim.Logic.mri.segmentation import Segmentation, segment_mri
from SlicerUSSim.Logic.mri.segmentation_settings import CT, SegmentationSettings
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues


def segment_image(
    image: Volume,
    settings: SegmentationSettings | None = None,
    *,
    others: Mapping[str, Volume] | None = None,
    mask: Volume | None = None,
    organs: LabelledTissues | None = None,
    keep_mask_at: Path | None = None,
    device: DeviceChoice = None,
    progress: Callable[[float], None] | None = None,
    **values: Any,
) -> Segmentation | CtSegmentation:
    """segment_ct of a CT, and segment_mri of an MRI, which alone has `others`.

    A CT is what settings_for recognises, with a note, or what has the contrast "ct". `values` change those of
    `settings`. Raises SimulationError as they do, for other images beside a CT, and for organs beside an MRI.
    """
    settings, line = settings_for(image, SegmentationSettings.of(settings, **values))
    if settings.contrast == CT:
        names = " and ".join(others or ())
        require(not others, f"{names} cannot be classified together with a CT, expected the CT alone")
        found = segment_ct(image, settings, organs=organs, mask=mask, device=device, progress=progress)
        return found if line is None else replace(found, notes=(line, *found.notes))
    require(organs is None, f"organs are for a CT, and contrast is {settings.contrast}; a CT has the contrast ct")
    return segment_mri(
        image, settings, others=others, mask=mask, keep_mask_at=keep_mask_at, device=device, progress=progress
    )


def has_brain_mask(contrast: str) -> bool:
    """Whether a segmentation covers a brain alone, as from an MRI; see pathology.add_tissue."""
    return contrast != CT
