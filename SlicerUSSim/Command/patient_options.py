"""PatientOptions: options for patient and probe of every command that simulates; Examination: the resulting inputs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.options import (
    also_option,
    declared,
    declared_parameters,
    device_option,
    mask_option,
    read_others,
)
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Command.set_option import Changes, set_option
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.mri.settings import SegmentationSettings

if TYPE_CHECKING:
    import numpy as np

    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.imaging import Preset, UltrasoundSimulator
    from SlicerUSSim.Logic.mri import Segmentation
    from SlicerUSSim.Logic.probe import Probe
    from SlicerUSSim.Logic.tissue import TissueTable

pose_option = click.option(
    "--pose", required=True,
    help='File with probe_to_ras (4 x 4 in JSON, 16 numbers in text, or a Slicer transform), or "auto".',
)  # fmt: skip


@dataclass(frozen=True)
class PatientOptions:
    """Patient, probe and display. Files are given by their paths."""

    mri_or_labels: str = declared(click.argument("mri_or_labels", type=click.Path()))
    #: None: determined from the input
    is_labels: bool | None = declared(
        click.option(
            "--labels/--mri", "is_labels", default=None,
            help="Type of the input (default: labels if it has few different whole numbers).",
        )
    )  # fmt: skip
    preset: str | None = declared(
        click.option(
            "--preset", type=click.Path(),
            help="Probe, display, settings and tissues as JSON, from `ussim demo` or the Slicer module; the options "
            "below override it.",
        )
    )  # fmt: skip
    probe: str | None = declared(
        click.option("--probe", type=click.Path(), help="Probe as JSON (default: the preset's, a phased array).")
    )
    tissues: str | None = declared(
        click.option(
            "--tissues", type=click.Path(),
            help="Tissue table as JSON (default: the preset's, the file beside the labels, or brain).",
        )
    )  # fmt: skip
    #: {parameter: value}
    segmentation: Mapping[str, Any] = declared_parameters(SegmentationSettings, ("contrast", "thin_sulci"))
    #: CONTRAST=FILE
    also: tuple[str, ...] = declared(also_option)
    mask: str | None = declared(mask_option)
    #: {parameter: value} of the options that were given
    display: Mapping[str, Any] = declared_parameters(DisplaySettings, of_preset=True)
    settings: Mapping[str, Any] = declared_parameters(SimulationSettings, of_preset=True)
    #: NAME=VALUE
    changes: tuple[str, ...] = declared(set_option)
    device: str | None = declared(device_option)

    @property
    def gives_probe(self) -> bool:
        """Whether the probe was given, and is not the default."""
        return bool(self.probe or self.preset) or Changes.of(self.changes).gives_geometry

    @property
    def source(self) -> str:
        """The MRI or label map, for a report."""
        return os.path.abspath(self.mri_or_labels)

    def changed_preset(self) -> Preset:
        """--preset, or the default one, with the changes of the options for probe, display and settings.

        Raises SimulationError for files that cannot be read and values out of range.
        """
        from SlicerUSSim.Logic.base.files import read_json
        from SlicerUSSim.Logic.imaging.preset import Preset
        from SlicerUSSim.Logic.probe.arrays import probe_from_dict

        changes = Changes.of(self.changes)
        preset = Preset.read(self.preset) if self.preset else Preset()
        preset = preset.changed("display", **self.display).changed("settings", **self.settings)
        if self.probe:
            preset = replace(preset, probe=probe_from_dict(read_json(self.probe), self.probe))
        return changes.to_preset(preset)


@dataclass(frozen=True, eq=False)
class Examination:
    """A simulator for one patient, the probe, and the display settings."""

    simulator: UltrasoundSimulator
    probe: Probe
    display: DisplaySettings
    #: Whether the input was a label map, and not an MRI
    is_labels: bool


def open_examination(patient: PatientOptions) -> Examination:
    """The Examination of a command's options. An MRI is segmented, with a progress bar.

    Fast checks come before slow computations. Raises SimulationError for inconsistent options.
    """
    import logging  # imported here to keep --help fast

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
    from SlicerUSSim.Logic.tissue.presets import TISSUES

    log = logging.getLogger(__name__)
    preset = patient.changed_preset()
    volume = Volume.read(patient.mri_or_labels)
    is_labels = volume.looks_like_labels() if patient.is_labels is None else patient.is_labels
    if patient.is_labels is None:
        kinds = ("a label map", "--mri") if is_labels else ("an MRI, to be segmented", "--labels")
        log.info("%s is read as %s; use %s if it is not", patient.mri_or_labels, *kinds)
    if is_labels and preset.settings.needs_texture:
        raise SimulationError(
            f"{patient.mri_or_labels}: is a label map; --partial-volume and --mri-modulation need an MRI"
        )
    changes = Changes.of(patient.changes)
    table = _tissues_from_file(patient, is_labels)
    if table is None:
        log.info("tissues: %s", "the preset's" if patient.preset else "presets of the brain")
    else:
        log.info("tissues: %s", patient.tissues or "the table next to the label map")
    tissues = preset.tissues if table is None else table
    is_known = is_labels or table is not None
    if is_known:
        tissues = changes.to_tissues(tissues)
    else:  # the tissues are not known before the segmentation
        changes.check_tissues((*(tissue.name for tissue in tissues.all_tissues()), *TISSUES))
    labels, texture = volume, None
    if not is_labels:
        segmentation = _segmented(volume, patient)
        labels = segmentation.labels
        if not is_known:
            tissues = changes.to_tissues(tissues.for_names(segmentation.tissue_names))
        texture = segmentation.texture() if preset.settings.needs_texture else None
    simulator = UltrasoundSimulator(labels, tissues, preset.settings, patient.device, texture)
    return Examination(simulator, preset.probe, preset.display, is_labels)


def open_examination_at(patient: PatientOptions, pose: str) -> tuple[Examination, np.ndarray]:
    """(Examination, (4, 4) probe_to_ras) of a command's options; the pose "auto" is a view through a craniotomy."""
    from SlicerUSSim.Logic.probe.placement import craniotomy_pose
    from SlicerUSSim.Logic.tracked.pose_files import read_pose

    given = None if pose == "auto" else read_pose(pose)
    examination = open_examination(patient)
    if given is not None:
        return examination, given
    return examination, craniotomy_pose(examination.simulator.medium.labels, examination.probe)


def _tissues_from_file(patient: PatientOptions, is_labels: bool) -> TissueTable | None:
    """The table of --tissues, or of the file next to a label map; None if there is none or a preset overrides it."""
    from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

    if patient.tissues:
        return TissueTable.read(patient.tissues)
    beside = tissues_beside(Path(patient.mri_or_labels))
    return TissueTable.read(beside) if is_labels and not patient.preset and beside.exists() else None


def _segmented(mri: Volume, patient: PatientOptions) -> Segmentation:
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.segmentation import segment_mri

    with Share("segment") as progress:
        result = segment_mri(
            mri, **patient.segmentation, others=read_others(patient.also),
            mask=Volume.read(patient.mask) if patient.mask else None, device=patient.device, progress=progress,
        )  # fmt: skip
    for line in result.notes:
        note(line)
    for line in result.warnings:
        note(f"warning: {line}")
    return result
