"""SegmentationSettings: how an MRI becomes tissues."""

from __future__ import annotations

from dataclasses import dataclass

from SlicerUSSim.Logic.base.declaration import Declared, Shown, parameter


@dataclass(frozen=True)
class SegmentationSettings(Declared):
    """What segmentation.segment_mri has to know beside the MRI and its mask."""

    contrast: str = parameter(
        "t1", "Contrast", "Contrast of the MRI; it orders the tissues by intensity",
        choices=("t1", "t1gd", "t2", "flair"), shown=True, option="contrast",
    )  # fmt: skip
    classes: int = parameter(
        3, "Classes", "Number of tissues that intensity tells apart (3; 4 with t1gd and flair)", bounds=(3, 4),
        shown=Shown(3, 4), option="classes",
    )  # fmt: skip
    thin_sulci: bool = parameter(
        True, "Label thin sulci",
        "Label sulci too narrow to reach CSF intensity as leptomeninges, one voxel thick", shown=True,
        option="thin-sulci/no-thin-sulci", note="Off where segment_mri is called without it",
    )  # fmt: skip
    bias_correction: bool = parameter(
        False, "Correct the bias field", "Run N4 first, for scans that are brighter on one side; some seconds",
        shown=True, option="bias-correction/no-bias-correction",
    )  # fmt: skip
    filter_radius: int = parameter(
        1, "Filter radius", "Radius of the guided filter; 0: none", unit="voxels", bounds=(0, 64), option="radius"
    )
    filter_epsilon: float | None = parameter(
        None, "Filter epsilon", "Strength of the guided filter, squared intensity; none: from the noise in the image",
        bounds=(0, 1e30),
    )  # fmt: skip

    def _owner(self) -> str:
        return "segmentation"
