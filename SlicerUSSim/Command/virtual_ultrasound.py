"""`ussim device`: a virtual ultrasound device for clients of OpenIGTLink."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.options import declared, gathered, out_option
from SlicerUSSim.Command.patient_options import (
    AUTO,
    RARE,
    RARE_BESIDE,
    PatientOptions,
    open_examination_at,
    say_contact,
)
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import require, required

if TYPE_CHECKING:
    import numpy as np

    from SlicerUSSim.Logic.base import Volume

_PORT = 18944
#: Transform of a path
_POSE = "ProbeToReference"


@dataclass(frozen=True)
class DeviceOptions(PatientOptions):
    """Arguments and options of `ussim device`."""

    mri_or_labels: str | None = declared(type=click.Path(), required=False)  # type: ignore[assignment]
    port: int = declared(
        "--port", type=click.IntRange(1, 65535), default=_PORT, show_default=True,
        help="Port at which clients connect, on this computer.",
    )  # fmt: skip
    host: str = declared(
        "--host", default="127.0.0.1", show_default=True,
        help="Address to listen at. OpenIGTLink has no authentication: anyone who can reach it can use the device.",
    )  # fmt: skip
    igtl_device: str | None = declared(
        "--igtl-device", help="Name of the transform that moves the probe (default: the first one received)."
    )
    pose: str = declared(
        "--pose", default=AUTO, show_default=True, help="Pose at the start, as of ussim simulate.",
    )  # fmt: skip
    path: str | None = declared(
        "--path", type=click.Path(), help="Poses that the probe goes through, to and fro, until a client moves it: a "
        "sequence with ProbeToReference, or a curve of Markups on the skin or brain (.mrk.json).",
    )  # fmt: skip


@click.command()
@gathered(f"{RARE} {RARE_BESIDE} maps craniotomy igtl_device", patient=DeviceOptions)
@out_option("Folder for recordings.", default=".", show_default=True)
def device(patient: DeviceOptions, out: Path) -> None:
    """A virtual ultrasound device that Slicer and clients of Plus connect to (OpenIGTLink).

    It takes an MRI, a label map, or a scene of the module (.mrb); without one it shows the demo brain. It sends IMAGE,
    ProbeToReference and ImageToProbe, follows a TRANSFORM, and answers the commands of PlusServer.
    """
    from SlicerUSSim.Logic.base.files import make_folder, require_folder
    from SlicerUSSim.Logic.device.virtual_device import VirtualDevice
    from SlicerUSSim.Logic.tracked.openigtlink import Address, require_usable

    address = Address(patient.host, patient.port, listen=True)
    require_usable(address)
    require_folder(out)
    with TemporaryDirectory(prefix="ussim-device-") as folder:
        patient = _with_file(patient, Path(folder))
        examination, pose = open_examination_at(patient, patient.pose)
        preset = patient.changed_preset()
    poses = [pose] if patient.path is None else _poses(patient.path, examination.simulator.medium.labels)
    say_contact(examination, preset.probe, poses[:1])
    examination.simulator.simulate(preset.probe, poses[0], preset.display)  # builds kernels
    made = VirtualDevice(examination.simulator, preset, poses, address, make_folder(out.resolve()), patient.igtl_device)
    note(f"a client may connect to {address}; recordings go to {out.resolve()} (-v tells who comes and goes)")
    try:
        made.run()
    finally:
        made.stop()


def _with_file(patient: DeviceOptions, folder: Path) -> DeviceOptions:
    """The options with a file: those without, and those of a scene, get what they stand for, in a temporary folder."""
    source = patient.mri_or_labels
    if source is None:
        from SlicerUSSim.Logic.mri.samples import demo_mri

        demo_mri()[0].write(folder / "MNI152.nii.gz")
        return replace(patient, mri_or_labels=str(folder / "MNI152.nii.gz"))
    if not source.lower().endswith(".mrb"):
        return patient
    require(
        importlib.util.find_spec("trame_slicer") is not None,
        f'{source}: scenes need trame_slicer; install it with: pip install "SlicerUSSim[serve]"',
    )
    import numpy as np

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.mri.sheets.polydata import write_surfels
    from SlicerUSSim.Logic.mrml.parameter_node import preset_texts
    from SlicerUSSim.Logic.tissue.table import write_label_files
    from SlicerUSSim.Logic.tracked.pose_files import write_pose
    from SlicerUSSim.Workstation.scene_files import read_scene

    scene = read_scene(source)
    preset, node = Preset.from_texts(preset_texts(scene.values), source), scene.nodes.get("labels")
    preset.write(folder / "preset.json")
    options: dict[str, Any] = {"preset": patient.preset or str(folder / "preset.json")}
    if scene.pose is not None and patient.pose == AUTO:
        write_pose(folder / "pose.json", scene.pose)
        options["pose"] = str(folder / "pose.json")
    sheets, role = scene.nodes.get("sheets"), node or scene.nodes["mri"]
    if sheets is not None and sheets.surfels is not None and np.allclose(sheets.to_world, role.to_world):
        write_surfels(folder / "sheets.vtp", sheets.surfels)
        options["sheets"] = str(folder / "sheets.vtp")
    volume = required(role.volume, f"{source}: {role.name} has no voxels")
    volume = Volume(volume.array, role.to_world @ volume.ijk_to_ras)
    file = folder / f"{'labels' if node else 'mri'}.nii.gz"
    if node is None:
        volume.write(file)
    else:
        names = [entry[0] for entry in node.colours or ()][1:]
        write_label_files(file, volume, preset.tissues.for_names(names))
    return replace(patient, mri_or_labels=str(file), is_labels=node is not None, **options)


def _poses(path: str, labels: Volume) -> list[np.ndarray]:
    """(4, 4) probe_to_ras of --path."""
    from SlicerUSSim.Logic.base.transforms import check_rigid
    from SlicerUSSim.Logic.mri.markups import is_markup_name, markup_points
    from SlicerUSSim.Logic.probe.surface import PatientSurface
    from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

    if is_markup_name(path):
        _, points = markup_points(path, ("Curve", "ClosedCurve", "Line"), "a curve on the skin")
        return PatientSurface(labels).along(points)
    sequence = TrackedSequence.read(path)
    numbers = [number for number in range(len(sequence)) if sequence.has_pose(number, _POSE)]
    require(bool(numbers), f"{path}: has no {_POSE}, expected poses of the probe")
    return [check_rigid(f"{path}: {_POSE}", sequence.pose(number, _POSE)) for number in numbers]
