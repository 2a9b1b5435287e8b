"""SegmentationSettings: the segmentation of an MRI into tissues."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import Any

from SlicerUSSim.Logic.base.declaration import Declared, Shown, built, parameter
from SlicerUSSim.Logic.base.errors import require_kind

#: Contrasts of MRIs, which segment_mri has; and the name of a CT, which is segment_ct's
MRI_CONTRASTS, CT = ("t1", "t1gd", "t2", "flair"), "ct"

#: Default width of the gap between skin and probe that gel fills, mm
GEL_MM = 3.0


@dataclass(frozen=True)
class SegmentationSettings(Declared):
    """Parameters of segmentation.segment_mri and ct.segment_ct, other than the image and its mask."""

    contrast: str = parameter(
        "t1", "Contrast", "Contrast of the MRI; ct: a CT in Hounsfield units", choices=(*MRI_CONTRASTS, CT), shown=True,
        option="contrast", note="For a CT, only the parameters of the filter apply",
    )  # fmt: skip
    classes: int | None = parameter(
        None, "Classes", "Number of tissues by intensity: 3, or 4 with t1gd and flair; none: 3, and 4 with t1gd",
        bounds=(3, 4), shown=Shown(2, 4, none_at=2), option="classes",
    )  # fmt: skip
    skull_strip: str = parameter(
        "atlas", "Brain extraction", "How the brain is found in a head; none: everything brighter than the background "
        "is brain", option="skull-strip", shown=True, choices=("atlas", "none"),
    )  # fmt: skip
    thin_sulci: bool = parameter(
        True, "Label thin sulci",
        "Label sulci too narrow to show CSF as leptomeninges, one voxel thick",
        option="thin-sulci/no-thin-sulci",
    )  # fmt: skip
    outside: bool = parameter(
        False, "Label tissues outside the brain",
        "Also label skin, scalp, skull, its marrow and air in the T1 of a head, for a probe on the skin", shown=True,
        option="outside/no-outside",
    )  # fmt: skip
    bias_correction: bool | None = parameter(
        None, "Correct the bias field", "Remove an intensity gradient of the scan; none: decided from the image",
        option="bias-correction/no-bias-correction",
    )  # fmt: skip
    filter_radius: int = parameter(
        1, "Filter radius", "Radius of the guided filter; 0: none", unit="voxels", bounds=(0, 64), option="radius"
    )
    filter_epsilon: float | None = parameter(
        None, "Filter epsilon", "Strength of the guided filter, squared intensity; none: from the image noise",
        bounds=(0, 1e30),
    )  # fmt: skip

    @classmethod
    def of(cls, settings: SegmentationSettings | None, **values: Any) -> SegmentationSettings:
        """Settings, by default the defaults, with values changed by name.

        Raises SimulationError for another type, an unknown name and an invalid value.
        """
        settings = cls() if settings is None else settings
        require_kind("settings", settings, cls, 'or single values by name, such as contrast="t2"')
        return built(cls, {**asdict(settings), **values}, "segmentation")

    def _owner(self) -> str:
        return "segmentation"


@dataclass(frozen=True)
class SheetSettings(Declared):
    """What a scene looks for with sheets.find_sheets, and what its images show of it."""

    find: bool = parameter(
        False, "Find sheets and vessels", "Segment also finds sheets, choroid plexus and vessels, in a T1 or T2 (about "
        "a minute); off: images have the lines of the labels, as in the paper", shown=True,
    )  # fmt: skip
    sulcus: bool = parameter(True, "Sulci", "Sulci as thin sheets, also closed ones")
    falx: bool = parameter(True, "Falx", "Falx as a thin sheet")
    tentorium: bool = parameter(True, "Tentorium", "Tentorium as a thin sheet")
    ependyma: bool = parameter(True, "Ependyma", "Walls of the ventricles as thin sheets")
    corpus_callosum: bool = parameter(True, "Corpus callosum", "Corpus callosum as a tissue, from the next Segment on")
    choroid_plexus: bool = parameter(
        True, "Choroid plexus", "Choroid plexus as enhancing tissue in a T1 with gadolinium, from the next Segment on",
    )  # fmt: skip
    vessels: bool = parameter(
        True, "Vessels", "Vessels as enhancing tissue in a T1 with gadolinium, from the next Segment on",
    )  # fmt: skip

    @property
    def kinds(self) -> tuple[str, ...]:
        """Those of sheets.finding.ALL_KINDS that are ticked."""
        names = (entry.name for entry in fields(self) if entry.name != "find")
        return tuple(name.replace("_", " ") for name in names if getattr(self, name))

    @classmethod
    def of_kinds(cls, kinds: Iterable[str], *, find: bool) -> SheetSettings:
        """With these kinds ticked and the others not."""
        wanted = set(kinds)
        names = (entry.name for entry in fields(cls) if entry.name != "find")
        return cls(find=find, **{name: name.replace("_", " ") in wanted for name in names})

    def _owner(self) -> str:
        return "sheets"
