"""Advice: what a user can do about a label map, in the words of one door."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace

#: What the page calls the masks of several tissues
PAGE_SEVERAL = "labels by their names, or a BraTS map"


@dataclass(frozen=True)
class Advice:
    """What a user can do about a label map, in the words of one door."""

    #: About labels without a tissue, before the list of tissues; {label} is one of them
    unknown: str = "map them with --map {label}=TISSUE (0 removes a label), a .json file or a table of names, to one of"
    #: About several labels without a tissue
    leave_out: str = "leave them out with {maps}"
    #: About a label that is the background; {label} is its number
    background: str = "leave it out with --map {label}=0, or say what it is with --map {label}=TISSUE"
    #: About a mask or lesion without a patient; {added}, {tissue}, {source} and {maps} are for this label map
    lesion: str = "add it to a segmentation with --add {added}, or simulate it alone with {maps} (ussim simulate)"
    #: The same about one as large as a brain
    brain_mask: str = (
        "if it is the mask of a brain, give it with that brain's MRI as --mask {source}; or simulate it alone with "
        "{maps} (ussim simulate)"
    )
    #: A tissue that a mask may be of whose name tells none
    mask_tissue: str = "tumour"
    #: About numbers that several programs use; {key} is one of them
    ambiguous: str = "say which with --map {key}"
    #: About numbers whose tissues are likely, but not certain; {maps} are options
    likely: str = "if that is right, say so with {maps}"
    #: About numbers as of `ussim segment` without the tissues that it writes beside them; may be empty
    own: str = "if ussim segment wrote them, put the .json file that it wrote beside them there; otherwise "
    #: About voxels without a label between organs
    between: str = "--map 0=fat gives it a tissue"
    #: A mask that is added as {tissue}, and one of several tissues
    one_tissue: str = "{tissue}=FILE"
    several_tissues: str = "brats=FILE"
    #: By what a user gives labels tissues
    mapping: str = "--map"
    #: Whether the volumes of unknown labels are listed
    gives_sizes: bool = True
    #: Whether {maps} are in Python, and not options of the command
    is_python: bool = False
    #: Whether they are the content of a .json file
    is_json: bool = False

    def maps(self, texts: Iterable[str]) -> str:
        """{maps} of texts for LabelMapping.of: --map 1=csf --map 2=tumour."""
        if self.is_python:
            return f"mapping=LabelMapping.of({list(texts)})"
        if self.is_json:
            return json.dumps(dict(text.split("=", 1) for text in texts))
        return " ".join(f"--map {shlex.quote(text)}" for text in texts)


COMMAND = Advice()
#: Commands that expect an MRI, and have no --map
MRI_COMMAND = replace(
    COMMAND,
    lesion="add it to an MRI's tissues with --add {added}, or simulate it alone (ussim simulate) with {maps}",
    brain_mask=(
        "if it is the mask of a brain, give it with that brain's MRI as --mask {source}; or simulate it alone (ussim "
        "simulate) with {maps}"
    ),
    ambiguous="use ussim simulate with --map {key}",
)
#: The command of the workstation, where its MRI is a label map
SERVE_COMMAND = replace(
    MRI_COMMAND,
    lesion="add it to an MRI's tissues with MRI --add {added}, or simulate it alone (ussim simulate) with {maps}",
    ambiguous="use --labels with --map {key}",
)
#: The page of the workstation
PAGE = replace(
    COMMAND,
    leave_out="",
    own="",
    unknown=(
        "open it together with a table of its names (.txt, .ctbl), the tissue table of ussim segment (.json), or a "
        '.json file with {{"{label}": "TISSUE"}} (0 removes a label), one of'
    ),
    lesion="add it to a patient's tissues (Add a mask as), or open it together with a .json file with {maps}",
    brain_mask=(
        "if it is the mask of a brain, start ussim serve MRI --mask {source} with that brain's MRI, or open it "
        "together with a .json file with {maps}"
    ),
    background=(
        'open it together with a .json file with {{"{label}": 0}} that leaves it out, or {{"{label}": "TISSUE"}}'
    ),
    ambiguous="start ussim serve --labels with --map {key}",
    likely=(
        "if it is of ussim segment, open it together with the .json file that was written beside it; if that is right, "
        "with a .json file with {maps}"
    ),
    mapping="the .json file",
    is_json=True,
    one_tissue="{tissue!r}",
    several_tissues=repr(PAGE_SEVERAL),
)
_SAY_ORGAN = "say which organ it is with {maps}"
#: Organs of a CT: a mask of one of them is not a lesion
ORGANS_COMMAND = replace(COMMAND, lesion=_SAY_ORGAN, brain_mask=_SAY_ORGAN, mask_tissue="liver")
_OPEN_ORGAN = "open it together with a .json file that says which organ it is, such as {maps}"
#: The same on the page
ORGANS_PAGE = replace(
    PAGE, lesion=_OPEN_ORGAN, brain_mask=_OPEN_ORGAN, mask_tissue="liver",
    ambiguous="start ussim serve CT --ct --organs FILE with --map {key}",
)  # fmt: skip
#: 3D Slicer
SCENE = Advice(
    unknown="rename to one of",
    leave_out="",
    own="",
    background="set it to 0, or give the label map colours with the name of its tissue",
    lesion="add it to a segmentation as a segment",
    brain_mask="if it is the mask of a brain, choose it as the brain mask of that brain's MRI",
    ambiguous="give the label map colours with the names of its structures",
    likely="if that is right, give the label map colours with these names",
    between="a segment around them gives it a tissue",
    gives_sizes=False,
)
#: A script with the VTK filters
SCRIPT = replace(
    COMMAND,
    unknown="give its labels' tissues with SetTissues or set_tissue_names, of",
    leave_out="",
    background="set it to 0, or give its tissue with SetTissues",
    lesion="lay it over a segmentation with SegmentationFilter.AddTissueData, or give its tissue with SetTissues",
    brain_mask="if it is the mask of a brain, it is port 1 of the SegmentationFilter of that brain's MRI",
    ambiguous="read it with read_label_map and a LabelMapping of {key!r}",
    likely="if that is right, read it with read_label_map(volume, {maps})",
    between="read_label_map with a LabelMapping of 0=fat gives it a tissue",
    one_tissue="AddTissueData({tissue!r}, mask)",
    several_tissues="AddTissueData('brats', mask)",
    is_python=True,
)
#: A script with the VTK filter for an MRI
MRI_SCRIPT = replace(
    SCRIPT,
    lesion=(
        "lay it over an MRI's tissues with AddTissueData({tissue!r}, image), or simulate it alone with "
        "UltrasoundSimulationFilter.SetTissues"
    ),
    brain_mask="if it is the mask of a brain, give it with that brain's MRI (SetMaskData)",
    ambiguous="give it to the UltrasoundSimulationFilter with read_label_map and a LabelMapping of {key!r}",
)
