"""All steps from a brain MRI to figures, for `ussim demo`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Command.additions import Additions
from SlicerUSSim.Command.mri_options import segmented_file
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import (
    make_folder,
    move_into,
    partial_folder,
    write_json,
)
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.figures import draw_views, require_matplotlib, write_png
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, slice_under_probe
from SlicerUSSim.Logic.tissue.table import TissueTable, write_label_files
from SlicerUSSim.Logic.tracked.pose_files import write_pose

if TYPE_CHECKING:
    from SlicerUSSim.Command.demo import DemoOptions

#: Files of the results, and the one that says what was done
RESULTS = (
    "figure.png", "mri.png", "labels.png", "bmode.png", "bmode.mha", "labels.nii.gz", "labels.json", "pose.json",
    "preset.json",
)  # fmt: skip
SUMMARY = "demo.json"


def run_whole_line(
    out: Path, mri: Volume, source: str, preset: Preset, patient: DemoOptions, additions: Additions,
    progress: Callable[[str], None] = lambda stage: None,
) -> dict:  # fmt: skip
    """Segment, place the probe, simulate, and write figures, volumes and a summary to the folder `out`.

    `progress` is called with the name of every step at its start. Returns the content of demo.json.
    Raises SimulationError for errors that the caller can correct.
    """
    require_matplotlib()  # before the computation, not after it
    timings: dict[str, float] = {}
    probe, display, settings = preset.probe, preset.display, preset.settings

    progress("segment the MRI")
    start = perf_counter()
    path = patient.mri or mri.name
    segmentation = segmented_file(
        path, mri, patient, additions=additions, tell_all=True, is_file=patient.mri is not None
    )
    if not isinstance(segmentation, Segmentation):
        raise SimulationError(f"{path}: is a CT, expected an MRI; use ussim simulate")
    timings["segmentation"] = (perf_counter() - start) * 1e3

    progress("build the acoustic medium")
    start = perf_counter()
    added = additions.on(segmentation.labels, segmentation.tissue_names, has_brain_mask=True)
    labels, names = added.labels, added.tissue_names
    for line in replace(segmentation, labels=labels, tissue_names=names).table().splitlines():
        note(line)
    tissues = TissueTable.brain(names)
    simulator = UltrasoundSimulator(labels, tissues, settings, patient.device)
    pose = craniotomy_pose(labels, probe, target_ras=added.centre_ras(segmentation.labels))
    timings["medium"] = (perf_counter() - start) * 1e3

    progress("simulate")
    simulator.profiling = True
    start = perf_counter()
    simulator.simulate(probe, pose, display)
    timings["first frame"] = (perf_counter() - start) * 1e3
    frames = [simulator.simulate(probe, pose, display) for _ in range(3)]
    frame = frames[-1]
    stages = {stage: min(f.timings_ms[stage] for f in frames) for stage in frame.timings_ms}
    timings |= {"frame": sum(stages.values())}

    with results_of(out, SUMMARY) as (folder, summary):
        progress("draw")
        bounds = probe.image_bounds_mm()
        seen = ("MRI under the probe", slice_under_probe(mri, frame.grid, pose), "mri")
        labelled = ("Tissues", slice_under_probe(labels, frame.grid, pose, order=0), "labels")
        simulated = ("Simulated B-mode", frame.image, "bmode")
        draw_views(folder / "figure.png", [seen, labelled, simulated], probe, bounds, names)
        draw_views(folder / "mri.png", [seen], probe, bounds, names)
        draw_views(folder / "labels.png", [labelled], probe, bounds, names)

        progress("write")
        write_png(folder / "bmode.png", frame.image)
        frame.to_volume().write(folder / "bmode.mha")
        write_label_files(folder / "labels.nii.gz", labels, tissues)
        write_pose(folder / "pose.json", pose)
        Preset(probe, display, settings, tissues).write(folder / "preset.json")
        summary |= {
            "mri": source,
            "device": str(simulator.device.info),
            "probe": probe.to_dict(),
            "probe_to_ras": pose.tolist(),
            "settings": asdict(settings),
            "display": asdict(display),
            "segmentation": {
                "tissue_names": list(names),
                "brain": {
                    "method": segmentation.brain.method,
                    "message": segmentation.brain.message,
                    "warnings": list(segmentation.brain.warnings),
                    "volume_ml": segmentation.brain.volume_ml,
                },
                "means": segmentation.means.tolist(),
                "standard_deviations": segmentation.standard_deviations.tolist(),
                "weights": segmentation.weights.tolist(),
                "noise": segmentation.noise,
                "added": list(added.messages),
                "voxels": np.bincount(labels.array.ravel()).tolist(),
            },
            "tissues": tissues.to_dict(),
            "milliseconds": {name: round(value, 3) for name, value in timings.items()},
            "milliseconds_per_stage": {name: round(value, 3) for name, value in stages.items()},
        }
    return summary


@contextmanager
def results_of(folder: Path, summary: str) -> Iterator[tuple[Path, dict]]:
    """(a temporary folder for files, the summary to be filled): both are moved to `folder` if the block succeeds.

    So a run that fails or is interrupted changes nothing. Raises SimulationError if the folder cannot be created or a
    file cannot be written, naming it by its later place.
    """
    is_new = not folder.exists()
    make_folder(folder)
    content: dict = {}
    try:
        with partial_folder(folder, "cannot be written to") as partial:
            try:
                yield partial, content
                files = sorted(file for file in partial.iterdir() if file.name != summary)
                write_json(partial / summary, content)
            except SimulationError as error:  # the user knows no temporary folder
                raise SimulationError(str(error).replace(str(partial), str(folder))) from None
            move_into(folder, [*files, partial / summary])
    except BaseException:
        if is_new:
            with suppress(OSError):  # not empty
                folder.rmdir()
        raise
