"""The falx in parts of heads without an atlas, compared with the falx of the whole head by the atlas.

    python -m benchmarks.falx_of_parts [remind022] [colin27] [FILE=CONTRAST ...]

ReMIND-022 needs ../shared, Colin27 Debian's mricron-data. Half a minute for each head, after its brain extraction.
"""

from __future__ import annotations

import argparse
import logging

import numpy as np
from scipy.spatial import KDTree

from benchmarks.brain_extraction import SHARED
from SlicerUSSim.Logic import SimulationError, Volume, segment_mri
from SlicerUSSim.Logic.mri.sheets import find_sheets
from validation.brain_phantoms import COLIN27, cut_to, part_box

#: From and to, of the brain's extent along R, A and S
PARTS = {
    "coronal slab, middle": ((0.0, 1.0), (0.45, 0.52), (0.0, 1.0)),
    "coronal slab, front": ((0.0, 1.0), (0.70, 0.78), (0.0, 1.0)),
    "coronal slab, back": ((0.0, 1.0), (0.15, 0.25), (0.0, 1.0)),
    "coronal slab without the left fifth": ((0.2, 1.0), (0.62, 0.69), (0.0, 1.0)),
    "coronal slab, upper right": ((0.0, 0.8), (0.30, 0.40), (0.3, 1.0)),
    "axial slab, high": ((0.0, 1.0), (0.0, 1.0), (0.75, 0.90)),
    "axial slab, middle": ((0.0, 1.0), (0.0, 1.0), (0.50, 0.65)),
    "axial slab, low": ((0.0, 1.0), (0.0, 1.0), (0.30, 0.42)),
    "sagittal slab": ((0.35, 0.65), (0.0, 1.0), (0.0, 1.0)),
    "quarter": ((0.3, 1.0), (0.5, 1.0), (0.5, 1.0)),
    "one hemisphere": ((0.6, 1.0), (0.0, 1.0), (0.0, 1.0)),
    "lateral slab": ((0.62, 1.0), (0.4, 0.6), (0.0, 1.0)),
    "temporal lobe": ((0.0, 0.38), (0.3, 0.7), (0.0, 0.6)),
}
#: Around the brain where a part reaches its end, voxels
_MARGIN = 8


def compare(name: str, mri: Volume, contrast: str) -> None:
    whole = segment_mri(mri, contrast=contrast, thin_sulci=False)
    mask = whole.brain.mask
    truth = find_sheets(mri, whole, contrast=contrast, kinds=["falx"]).surfels
    for title, part in PARTS.items():
        box = part_box(mask, part, _MARGIN)
        image, inside = cut_to(mri, box), cut_to(mask, box)
        try:
            segmentation = segment_mri(image, mask=inside, contrast=contrast, thin_sulci=False)
        except SimulationError as error:
            print(f"{name}, {title}: {error}")
            continue
        if segmentation.atlas is not None:
            print(f"{name}, {title}: the atlas leads")
            continue
        found = find_sheets(image, segmentation, contrast=contrast, kinds=["falx"]).surfels
        ijk = _voxels(image, truth.place)
        here = ((ijk >= 0) & (ijk <= np.array(image.array.shape[::-1]) - 1)).all(axis=1)
        there = f"{truth.area[here].sum() / 100:.1f} cm²"
        if not len(found):
            print(f"{name}, {title}: none, of {there}")
            continue
        away = KDTree(truth.place).query(found.place)[0]
        line = f"{name}, {title}: {found.area.sum() / 100:.1f} cm² of {there}, {np.median(away):.2f} mm, "
        line += f"{np.average(away > 5.0, weights=found.area):.0%} farther than 5 mm"
        if here.any():
            back = KDTree(found.place).query(truth.place[here])[0]
            line += f"; {np.average(back < 3.0, weights=truth.area[here]):.0%} of the falx within 3 mm"
        print(line, flush=True)


def _voxels(image: Volume, places: np.ndarray) -> np.ndarray:
    return places @ image.ras_to_ijk[:3, :3].T + image.ras_to_ijk[:3, 3]


def main() -> None:
    known = {
        "remind022": (SHARED / "remind022" / "t1_contrast.nii.gz", "t1gd"),
        "colin27": (COLIN27 / "ch2bet.nii.gz", "t1"),
    }
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("heads", nargs="*", default=list(known), metavar="HEAD")
    logging.disable(logging.WARNING)
    for head in parser.parse_args().heads:
        path, contrast = known[head] if head in known else head.rsplit("=", 1)
        name = head if head in known else str(path).rsplit("/", 1)[-1]
        compare(name, Volume.read(path), contrast)


if __name__ == "__main__":
    main()
