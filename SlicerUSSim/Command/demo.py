"""`ussim demo`."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.additions import Additions, add_option
from SlicerUSSim.Command.mri_options import also_option, read_also, read_mri
from SlicerUSSim.Command.options import check_results, device_option, mask_option, parameter_option
from SlicerUSSim.Command.progress import Steps, note
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings

if TYPE_CHECKING:
    from SlicerUSSim.Logic.mri import Segmentation


class ProbeName(click.Choice):
    """A name of probe.PROBES, which imports numpy and therefore waits until a choice is made or --help asks for it."""

    def __init__(self) -> None:
        self.case_sensitive = True

    @cached_property
    def choices(self) -> tuple[str, ...]:
        from SlicerUSSim.Logic.probe.arrays import PROBES

        return tuple(PROBES)


def _tell(segmentation: Segmentation) -> None:
    """Say how the MRI was segmented, and into what."""
    for line in (*segmentation.notes, *segmentation.table().splitlines()):
        note(line)


@click.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default="ussim-demo", show_default=True, help="Folder for the results."
)
@click.option("--mri", type=click.Path(), help="MRI of a head or a brain (default: the MNI152 brain of nilearn).")
@parameter_option(SegmentationSettings, "contrast")
@parameter_option(SegmentationSettings, "skull_strip")
@mask_option
@click.option("--probe", "kind", type=ProbeName(), default="phased", show_default=True, help="Preset of the probe.")
@parameter_option(SimulationSettings, "seed")
@also_option
@add_option
@device_option
def demo(
    out: Path, mri: str | None, contrast: str, skull_strip: str, mask: str | None, kind: str, seed: int,
    also: tuple[str, ...], additions: tuple[str, ...], device: str | None,
) -> None:  # fmt: skip
    """Segment a brain MRI, simulate a view through a craniotomy, and write figures."""
    from SlicerUSSim.Command.whole_line import RESULTS, SUMMARY, run_whole_line
    from SlicerUSSim.Logic.mri.kept_mask import mask_beside
    from SlicerUSSim.Logic.mri.masks import read_mask
    from SlicerUSSim.Logic.mri.samples import demo_mri
    from SlicerUSSim.Logic.probe.arrays import PROBES

    check_results(out, RESULTS, SUMMARY)
    settings = SimulationSettings(seed=seed)
    masks = Additions.read(additions)
    volume, source = demo_mri() if mri is None else (
        read_mri(mri, mask=mask, skull_strip=skull_strip), os.path.abspath(mri),
    )  # fmt: skip
    note(f"MRI: {source}, {volume.size_text} voxels")
    brain = {
        "contrast": contrast, "skull_strip": skull_strip, "mask": read_mask(mask) if mask else None,
        "others": read_also(also, mri), "keep_mask_at": mask_beside(mri) if mri else None,
    }  # fmt: skip
    with Steps(5) as step:
        summary = run_whole_line(
            out, volume, source, PROBES[kind], settings, DisplaySettings(), device, step,
            segmentation_options=brain, found=_tell, additions=masks,
        )  # fmt: skip
    times = summary["milliseconds"]
    note(f"device: {summary['device']}")
    note(f"segmentation {times['segmentation']:.0f} ms, one frame {times['frame']:.1f} ms")
    note(f"wrote {out / 'figure.png'} and nine more files in this folder")
    click.echo(out / "figure.png")
