"""Options that several commands share, and what they make of them: a simulator, a probe, a pose."""

from __future__ import annotations

import os
from pathlib import Path

import click

from SlicerUSSim.Command.progress import Share
from SlicerUSSim.Logic.base.errors import SimulationError

PROBE_NAMES = ["phased", "convex", "linear", "microconvex", "abdominal"]  # probe.PROBES, which would import numpy
device_option = click.option(
    "--device", help='OpenCL device: "platform:device" or part of its name (see `ussim devices`).'
)
seed_option = click.option("--seed", type=int, default=0, show_default=True, help="Which speckle and noise.")
contrast_option = click.option(
    "--contrast",
    type=click.Choice(["t1", "t1gd", "t2", "flair"]),
    default="t1",
    show_default=True,
    help="MRI contrast.",
)
mask_option = click.option("--mask", type=click.Path(), help="Foreground on the MRI's grid (default: found by Otsu).")
sulci_option = click.option(
    "--thin-sulci/--no-thin-sulci", default=True, show_default=True,
    help="Label sulci too narrow to reach CSF intensity as leptomeninges.",
)  # fmt: skip

pose_option = click.option(
    "--pose", required=True, help='File with probe_to_ras (JSON, 16 numbers, or a Slicer transform), or "auto".'
)
_SCENE_OPTIONS = (
    click.argument("mri_or_labels", type=click.Path()),
    click.option(
        "--labels/--mri", "is_labels", default=None, help="What the input is (default: few whole numbers are labels)."
    ),
    click.option(
        "--preset", "preset_file", type=click.Path(),
        help="Probe, display, settings and tissues as JSON, from `ussim demo` or the Slicer module; the options below "
        "go before it.",
    ),
    click.option(
        "--probe", "probe_file", type=click.Path(), help="Probe as JSON (default: the preset's, a phased array)."
    ),
    click.option(
        "--tissues", "tissue_file", type=click.Path(),
        help="Tissue table as JSON (default: the preset's, the file beside the labels, or brain).",
    ),
    contrast_option,
    mask_option,
    sulci_option,
    click.option(
        "--partial-volume/--hard-labels", default=None,
        help="Scatterers take their tissue by the segmentation's probabilities (from an MRI only).",
    ),
    click.option(
        "--mri-modulation", type=float,
        help="Scatterers follow the MRI inside tissues, dB per standard deviation (from an MRI only).",
    ),
    click.option("--gain", type=float, help="Gain [dB] (default: the preset's, 0)."),
    click.option("--dynamic-range", type=float, help="Dynamic range [dB] (default: the preset's, 55)."),
    click.option("--tgc", type=float, help="Time-gain compensation [dB/(cm MHz)] (default: the preset's, 0.5)."),
    click.option("--seed", type=int, help="Which speckle and noise (default: the preset's, 0)."),
    device_option,
)  # fmt: skip


def scene_options(command):
    """What every command that simulates takes; Scene makes a simulator, a probe and a pose of it."""
    for option in reversed(_SCENE_OPTIONS):
        command = option(command)
    return command


class Scene:
    """A simulator for one patient, a probe, where it is (unless a sequence says it), and how its images are shown."""

    def __init__(
        self, mri_or_labels, is_labels, preset_file, probe_file, tissue_file, contrast, mask, thin_sulci,
        partial_volume, mri_modulation, gain, dynamic_range, tgc, seed, device, pose=None,
    ) -> None:  # fmt: skip
        from SlicerUSSim.Logic.base.files import read_json
        from SlicerUSSim.Logic.base.volume import Volume
        from SlicerUSSim.Logic.imaging.preset import Preset
        from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
        from SlicerUSSim.Logic.mri.segmentation import segment_mri
        from SlicerUSSim.Logic.probe.arrays import probe_from_dict
        from SlicerUSSim.Logic.probe.placement import craniotomy_pose
        from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside
        from SlicerUSSim.Logic.tracked.pose_files import read_pose

        self.source = os.path.abspath(mri_or_labels)
        # What is cheap to check comes before what takes time.
        preset = Preset.read(preset_file) if preset_file else Preset()
        preset = preset.changed("display", **_given(gain_db=gain, dynamic_range_db=dynamic_range, tgc_db_cm_mhz=tgc))
        preset = preset.changed(
            "settings", **_given(seed=seed, partial_volume=partial_volume, mri_modulation_db=mri_modulation)
        )
        self.display, settings = preset.display, preset.settings
        self.probe = probe_from_dict(read_json(probe_file), str(probe_file)) if probe_file else preset.probe
        self.probe_is_given = bool(probe_file or preset_file)
        self.pose = None if pose in (None, "auto") else read_pose(pose)
        volume = Volume.read(mri_or_labels)
        self.is_labels = volume.looks_like_labels() if is_labels is None else is_labels
        texture = None
        if self.is_labels:
            if settings.needs_texture:
                raise SimulationError(
                    f"{mri_or_labels}: is a label map; --partial-volume and --mri-modulation need the MRI it came from"
                )
            labels, tissues = volume, preset.tissues
            beside = tissues_beside(Path(mri_or_labels))
            tissue_file = tissue_file or (beside if beside.exists() and not preset_file else None)
        else:
            with Share("segment") as progress:
                result = segment_mri(
                    volume, contrast=contrast, mask=Volume.read(mask) if mask else None, thin_sulci=thin_sulci,
                    device=device, progress=progress,
                )  # fmt: skip
            labels, tissues = result.labels, preset.tissues.for_names(result.tissue_names)
            texture = result.texture() if settings.needs_texture else None
        if tissue_file:
            tissues = TissueTable.read(tissue_file)
        self.simulator = UltrasoundSimulator(labels, tissues, settings, device, texture)
        if pose == "auto":
            self.pose = craniotomy_pose(labels, self.probe)


def _given(**options) -> dict:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}


def check_output(out: Path, png: bool = False) -> None:
    """Refuse an output that cannot be written now rather than after the work."""
    from SlicerUSSim.Logic.base.files import require_place
    from SlicerUSSim.Logic.base.volume import require_image_name

    if not (png and out.suffix.lower() == ".png"):
        require_image_name(out)
    require_place(out)
