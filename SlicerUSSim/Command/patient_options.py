"""PatientOptions: options for patient and probe of every command that simulates; Examination: the resulting inputs."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.additions import Additions
from SlicerUSSim.Command.craniotomy_options import GEL_MM, Craniotomy
from SlicerUSSim.Command.mri_options import (
    ImageOptions,
    also_files,
    require_no_map,
    require_no_sequence,
    segmented_file,
)
from SlicerUSSim.Command.options import declared, declared_parameters, require_no_mri_options
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.set_option import Changes
from SlicerUSSim.Command.sheet_options import DrawnSheets
from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings

if TYPE_CHECKING:
    import numpy as np

    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.imaging import Preset, UltrasoundSimulator
    from SlicerUSSim.Logic.mri import Added
    from SlicerUSSim.Logic.probe import Probe
    from SlicerUSSim.Logic.tissue import Surfels, Texture, TissueTable

#: A pose that is chosen; and those of mri.views.VIEWS
AUTO = "auto"
STANDARD_VIEWS = ("temporal", "temporal-left", "fontanelle", "fontanelle-sagittal")
_VIEWS = f"{', '.join(STANDARD_VIEWS)} (temporal: from the right)"
_POSE: dict[str, Any] = dict(
    help='File with probe_to_ras (4 x 4 in JSON, 16 numbers in text, or a Slicer transform), "auto": a coronal '
    "view through a craniotomy, of what --add laid over the labels if there is something, or a standard view: "
    f"{_VIEWS}.",
)  # fmt: skip
pose_option = click.option("--pose", required=True, **_POSE)
pose_or_approach = click.option("--pose", **_POSE)


#: Parameters that no command has an option for, and those that a command with further options has none for
RARE = (
    "classes thin_sulci bias_correction filter_radius no_sheets tgc_db_cm_mhz tgc_reach near_gain_db noise_db grey_map "
    "contact_gap_mm partial_volume mri_modulation_db"
)
RARE_BESIDE = "skull_strip outside organs tissues seed"


@dataclass(frozen=True)
class PatientOptions(ImageOptions):
    """Patient, probe and display. Files are given by their paths."""

    mri_or_labels: str = declared(type=click.Path())
    #: None: determined from the input
    is_labels: bool | None = declared(
        "--labels/--mri", default=None, help="Type of the input (default: labels if it has few different whole "
        "numbers).",
    )  # fmt: skip
    probe: str | None = declared(
        "--probe", metavar="NAME|PATH", help="Name of a probe (docs/probes.md), as neonatal, or a probe as JSON "
        "(default: the preset's, a phased array).",
    )  # fmt: skip
    tissues: str | None = declared(
        "--tissues", type=click.Path(),
        help="Tissue table as JSON (default: the preset's, the file beside the labels, or brain).",
    )  # fmt: skip
    #: {parameter: value} of the options that were given
    display: Mapping[str, Any] = declared_parameters(DisplaySettings, of_preset=True)
    settings: Mapping[str, Any] = declared_parameters(SimulationSettings, of_preset=True)

    @property
    def gives_probe(self) -> bool:
        """Whether the probe was given, and is not the default."""
        return bool(self.probe or self.preset) or Changes.of(self.changes).gives_geometry

    @property
    def gives_contact(self) -> bool:
        """Whether the user said, by an option, --set or a preset, what gel fills; "none" counts, too."""
        changed = (text.partition("=")[0].strip().rpartition(".")[2] for text in self.changes)
        return bool(self.preset) or "contact_gap_mm" in (*self.settings, *changed)

    @property
    def source(self) -> str:
        """The MRI or label map, for a report."""
        return os.path.abspath(self.mri_or_labels)

    def changed_preset(self) -> Preset:
        """--preset, or the default one, with the changes of the options for probe, display and settings.

        Raises SimulationError for files that cannot be read and values out of range.
        """
        from SlicerUSSim.Logic.imaging.preset import Preset

        changes = Changes.of(self.changes)
        preset = Preset.read(self.preset) if self.preset else Preset()
        preset = preset.changed("display", **self.display).changed("settings", **self.settings)
        if self.probe:
            preset = replace(preset, probe=named_probe(self.probe))
        return changes.to_preset(preset)


def target_of(text: str | None) -> str | list[float] | None:
    """A tissue, or the numbers of "12,-15,8". Raises SimulationError for what is none."""
    try:
        return [float(part) for part in text.split(",")] if text and "," in text else text
    except ValueError:
        raise SimulationError(f"the target is {text!r}, expected a tissue, or R, A, S in mm: 12,-15,8") from None


def named_probe(name_or_path: str) -> Probe:
    """The probe of PROBES by its name, or read from a JSON file.

    Raises SimulationError for what is neither, with the names, and for a file that cannot be read.
    """
    from SlicerUSSim.Logic.base.files import read_json
    from SlicerUSSim.Logic.probe.arrays import PROBES, probe_from_dict

    if name_or_path in PROBES:
        return PROBES[name_or_path]
    place = Path(name_or_path)
    wrong = f"--probe is {name_or_path!r}, which does not exist, expected a JSON file or one of {', '.join(PROBES)}"
    require(place.exists() or bool(place.suffix) or os.path.dirname(name_or_path) != "", wrong)
    return probe_from_dict(read_json(name_or_path), name_or_path)


@dataclass(frozen=True, eq=False)
class Examination:
    """A simulator for one patient, the probe, and the display settings."""

    simulator: UltrasoundSimulator
    probe: Probe
    display: DisplaySettings
    #: (4, 4) probe_to_ras, if open_examination was given one
    probe_to_ras: np.ndarray | None = None


def open_examination(
    patient: PatientOptions, pose: np.ndarray | str | tuple | None = None, *, one_image: bool = False
) -> Examination:
    """The Examination of a command's options. An MRI is segmented, with a progress bar.

    `pose` is a (4, 4) probe_to_ras, one of STANDARD_VIEWS, (target, weights) of an approach, or AUTO: a view
    through a craniotomy, of what --add laid over the labels if there is something. With `one_image` only what an image
    at this pose shows is prepared.
    Fast checks come before slow computations. Raises SimulationError for inconsistent options.
    """
    import logging  # imported here to keep --help fast

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.imaging.found_sheets import with_their_tissue
    from SlicerUSSim.Logic.tissue.label_sources import is_label_file
    from SlicerUSSim.Logic.tissue.presets import TISSUES
    from SlicerUSSim.Logic.tissue.table import TissueTable

    log = logging.getLogger(__name__)
    preset = patient.changed_preset()
    require_no_sequence(patient.mri_or_labels)
    _import_nibabel()
    volume = Volume.read(patient.mri_or_labels)
    craniotomy = Craniotomy.of(patient.craniotomy)
    path, is_labels = patient.mri_or_labels, False if patient.is_ct else patient.is_labels
    if is_labels is None:
        is_labels = is_label_file(Path(path), volume)
        kinds = ("a label map", "--mri") if is_labels else ("an MRI, to be segmented", "--labels")
        log.info("%s is read as %s; use %s if it is not", path, *kinds)
    if is_labels:
        need = f"{path}: is a label map; partial_volume and mri_modulation_db need an MRI"
        require(not preset.settings.needs_texture, need)
        require_no_mri_options(path, "leave it out, or use --mri if it is one")
    else:
        require_no_map(path, patient.maps, patient.organs)
        patient = patient.for_image(volume)
        craniotomy.require_head(patient)
    also_files(patient.also)
    chosen, is_ct = patient.segmentation, patient.is_ct
    if chosen.outside and not is_ct:
        from SlicerUSSim.Logic.mri.outside import require_findable  # labels alone do not wait for it

        require_findable(chosen.contrast, chosen.skull_strip, patient.mask is not None)
    sheets = DrawnSheets.of(patient.sheets, patient.no_sheets, is_labels=is_labels, contrast=chosen.contrast)
    changes = Changes.of(patient.changes)
    table = TissueTable.read(patient.tissues) if patient.tissues else None
    if is_labels:
        labels, tissues = _labelled(volume, patient, table, preset.tissues)
        added = Additions.read(patient.additions, tissues.names()).on(
            labels, tissues.names_by_label(), has_brain_mask=False
        )
        tissues = changes.to_tissues(with_their_tissue(added.table(tissues), sheets.read))
        return _placed(patient, craniotomy, preset, added, labels, pose, tissues, None, sheets.read, one_image)
    from SlicerUSSim.Logic.mri.pathology import texture_below
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

    log.info("tissues: %s", patient.tissues or ("the preset's" if patient.preset else "presets of the brain"))
    tissues = preset.tissues if table is None else table
    additions = Additions.read(patient.additions, (tissue.name for tissue in tissues.all_tissues()))
    changes.check_tissues((*(tissue.name for tissue in tissues.all_tissues()), *TISSUES))
    segmentation = segmented_file(path, volume, patient)
    labels, names, surfels = segmentation.labels, segmentation.tissue_names, sheets.read
    if isinstance(segmentation, Segmentation):
        surfels, labels, names = sheets.found(path, volume, segmentation, patient.contrast)
    added = additions.on(labels, names, has_brain_mask=not is_ct)
    known, tissues = tissues, tissues.for_names(added.tissue_names)
    if table is not None:
        found = set(table.names()) & set(tissues.names())
        expected = f"expected tissues called {', '.join(added.tissue_names)}"
        require(bool(found - {"coupling"}), f"{patient.tissues}: lacks the patient's tissues, {expected}")
    tissues = with_their_tissue(tissues, surfels, known)
    texture = texture_below(segmentation.texture(), volume, segmentation.labels, added.labels)
    tissues = changes.to_tissues(tissues)
    return _placed(patient, craniotomy, preset, added, labels, pose, tissues, texture, surfels, one_image)


def _import_nibabel() -> None:
    """Import nibabel without pydicom, which it looks for to read an extension of NIfTI that is not used here.

    pydicom imports its network libraries and decoders, a fifth of the time of a command. While it is hidden no other
    thread may import it.
    """
    import sys

    if "pydicom" in sys.modules or importlib.util.find_spec("nibabel") is None:
        return
    sys.modules["pydicom"] = None  # type: ignore[assignment]
    try:
        import nibabel  # noqa: F401
    finally:
        del sys.modules["pydicom"]


def _placed(
    patient: PatientOptions, craniotomy: Craniotomy, preset: Preset, added: Added, before: Volume,
    pose: np.ndarray | str | tuple | None, tissues: TissueTable, texture: Texture | None, sheets: Surfels | None,
    one_image: bool,
) -> Examination:  # fmt: skip
    """A patient with the craniotomy, and the probe at its pose with gel between them; says what bone is before it.

    `before` are the labels without what --add laid over them.
    """
    from SlicerUSSim.Logic.imaging.found_sheets import beside_image
    from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
    from SlicerUSSim.Logic.placement.bone_before_probe import about_bone
    from SlicerUSSim.Logic.tissue.names import BRAIN_TISSUES

    labels, names, settings, probe = added.labels, added.tissue_names, preset.settings, preset.probe
    at, is_open, line = None, craniotomy.is_wanted, ""
    if isinstance(pose, tuple):
        from SlicerUSSim.Logic.placement.approach import opened_for, plan_approach
        from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE

        require(not is_open, f"--craniotomy is {craniotomy.text} with --approach, expected none: it opens the head")
        plan = plan_approach(labels, names, probe, target_of(pose[0]), weights=pose[1])
        best = plan.candidates[0]
        labels, pose, is_open = opened_for(labels, names, [best]), best.probe_to_ras, best.opening_mm > 0.0
        for line in (plan.target.text, best.text, NO_ADVICE):
            note(f"approach: {line}")
    elif isinstance(pose, str):
        from SlicerUSSim.Logic.placement.craniotomy import default_pose, middle_of  # a pose from a file does not wait

        if craniotomy.is_file:
            labels = craniotomy.on(added.labels, names, probe, None)
            at = middle_of(added.labels, labels)
        target = added.centre_ras(before)
        if pose == AUTO and not set(names) & {*BRAIN_TISSUES, "brain"}:
            note("--pose is auto, and no tissue of a brain is labelled: the probe is placed on top of the others")
        if at is not None and pose == AUTO:
            from SlicerUSSim.Logic.placement.aiming import opening_pose

            pose, line = opening_pose(labels, names, probe, at, target)
        elif pose == AUTO:
            pose = default_pose(labels, names, probe, is_open=is_open, target_ras=target)
        else:
            from SlicerUSSim.Logic.placement.views import opened_view_pose, view_pose

            if at is None:
                pose, line = view_pose(labels, names, pose, is_open=is_open)
            else:
                pose, line = opened_view_pose(labels, names, pose)
        if line:
            note(f"probe: {line}")
    if at is None:
        labels = craniotomy.on(labels, names, probe, pose)
    if "skin" in names and not is_open and not patient.gives_contact:
        note(f"gel fills gaps of up to {GEL_MM:g} mm between skin and probe (--set settings.contact_gap_mm)")
        settings = replace(settings, contact_gap_mm=GEL_MM)
    if pose is not None:
        for line in about_bone(labels, names, tissues.all_tissues(), probe, pose, is_open=is_open):
            note(line)
    if one_image and sheets is not None and pose is not None:
        sheets = beside_image(sheets, pose)
    simulator = UltrasoundSimulator(labels, tissues, settings, patient.device, texture, sheets)
    return Examination(simulator, probe, preset.display, pose)


def say_contact(examination: Examination, probe: Probe, poses: Sequence[np.ndarray]) -> None:
    """Say that a probe's face does not touch the patient at poses (4, 4), or with little of it."""
    from SlicerUSSim.Logic.imaging.contact import about_contact

    simulator = examination.simulator
    for line in about_contact(simulator.medium.labels, probe, poses, simulator.settings.contact_gap_mm):
        note(line)


def open_examination_at(
    patient: PatientOptions, pose: np.ndarray | str | tuple, *, one_image: bool = False
) -> tuple[Examination, np.ndarray]:
    """(Examination, (4, 4) probe_to_ras) of a command's options.

    The pose is a file, AUTO, one of STANDARD_VIEWS, or (target, weights), see open_examination.
    """
    from SlicerUSSim.Logic.tracked.pose_files import read_pose

    if isinstance(pose, str) and pose not in (AUTO, *STANDARD_VIEWS):
        require(
            pose != "" and Path(pose).exists(),
            f"--pose is {pose!r} (no such file), expected a file with the pose (.json, .txt, .tfm, .h5), {AUTO}, "
            f"or a view: {_VIEWS}",
        )
        pose = read_pose(pose)
    examination = open_examination(patient, pose, one_image=one_image)
    return examination, required(examination.probe_to_ras, "the examination has no pose")


def _labelled(
    volume: Volume, patient: PatientOptions, table: TissueTable | None, preset: TissueTable
) -> tuple[Volume, TissueTable]:
    """The labels of a label map and their tissues; says what was recognised."""
    import logging

    from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
    from SlicerUSSim.Logic.tissue.label_sources import read_label_file

    log = logging.getLogger(__name__)
    mapping = LabelMapping.of(patient.maps, table or preset)
    given = preset if patient.preset else None
    found = read_label_file(
        Path(patient.mri_or_labels), volume, mapping, table=table, preset=given, default=preset
    )  # fmt: skip
    if found.has_own_table:  # as `ussim segment` wrote it: nothing to report
        log.info("%s: %s", patient.mri_or_labels, found.message)
    else:
        note(f"{patient.mri_or_labels}: {found.message}")
    for warning in found.warnings:
        log.warning("%s", warning)
    return found.labels, found.tissues
