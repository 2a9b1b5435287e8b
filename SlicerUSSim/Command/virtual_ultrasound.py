"""`ussim device`: a virtual ultrasound device for clients of OpenIGTLink."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import declared, gathered, given_options, out_option
from SlicerUSSim.Command.patient_options import AUTO, RARE, RARE_BESIDE, PatientOptions, open_examination_at
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.serve import require_workstation
from SlicerUSSim.Logic.base.errors import require, required

if TYPE_CHECKING:
    import numpy as np

    from SlicerUSSim.Logic.imaging import Preset, UltrasoundSimulator

#: Transform of a path
_POSE = "ProbeToReference"
#: Parameters that are not about a patient, his ultrasound or settings
_OWN = {"mri_or_labels", "port", "host", "path", "out", "device"}


@dataclass(frozen=True)
class DeviceOptions(PatientOptions):
    """Arguments and options of `ussim device`."""

    mri_or_labels: str = declared(type=click.Path(), required=False)
    port: int = declared(
        "--port", type=click.IntRange(1, 65535), default=18944, show_default=True, help="Port at which clients connect."
    )
    host: str = declared(
        "--host", default="127.0.0.1", show_default=True,
        help="Address to listen at. OpenIGTLink has no authentication: anyone who can reach it can use the device.",
    )  # fmt: skip
    pose: str = declared("--pose", default=AUTO, show_default=True, help="Pose at the start, as of ussim simulate.")
    path: str | None = declared(
        "--path", type=click.Path(), help=f"Sequence with {_POSE}: the probe goes through these poses, to and fro, "
        "until a client moves it.",
    )  # fmt: skip


@click.command()
@gathered(f"{RARE} {RARE_BESIDE} maps craniotomy", patient=DeviceOptions)
@out_option("Folder for recordings.", default=".", show_default=True)
def device(patient: DeviceOptions, out: Path) -> None:
    """A virtual ultrasound device that Slicer and clients of Plus connect to (OpenIGTLink).

    It takes an MRI, a label map, or a scene of the module (.mrb); without one it shows the demo brain. It sends IMAGE,
    ProbeToReference and ImageToProbe, follows a TRANSFORM, and answers the commands of PlusServer.
    """
    from SlicerUSSim.Logic.base.files import make_folder, require_folder
    from SlicerUSSim.Logic.device.virtual_device import VirtualDevice
    from SlicerUSSim.Logic.mri.samples import demo_mri
    from SlicerUSSim.Logic.tracked.openigtlink import Address, require_usable

    address = Address(patient.host, patient.port, listen=True)
    require_usable(address)
    require_folder(out)
    path = _poses(patient.path) if patient.path else []  # before the MRI is segmented
    with TemporaryDirectory(prefix="ussim-device-") as folder:
        if not patient.mri_or_labels:
            patient = replace(patient, mri_or_labels=str(Path(folder) / "MNI152.nii.gz"))
            demo_mri()[0].write(patient.mri_or_labels)
        if patient.mri_or_labels.lower().endswith(".mrb"):
            simulator, preset, pose = _opened_scene(patient)
        else:
            examination, pose = open_examination_at(patient, patient.pose)
            simulator, preset = examination.simulator, patient.changed_preset()
    simulator.simulate(preset.probe, pose, preset.display)  # builds kernels
    made = VirtualDevice(simulator, preset, path or [pose], address, make_folder(out.resolve()))
    note(f"a client may connect to {address}; recordings go to {out.resolve()} (-v logs clients that connect)")
    try:
        made.run()
    finally:
        made.stop()


def _opened_scene(patient: DeviceOptions) -> tuple[UltrasoundSimulator, Preset, np.ndarray]:
    """(simulator, probe and display, (4, 4) probe_to_ras) of a scene.

    Raises SimulationError for one without labels or a probe, and for options of a patient or settings.
    """
    path, given = patient.mri_or_labels, given_options(*set(click.get_current_context().params) - _OWN)
    require(not given, f"{path} is a scene, which has a patient and settings, expected no {', '.join(given)}")
    require_workstation()
    import slicer

    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Logic.mrml.scene_record import put_nodes, put_values
    from SlicerUSSim.Workstation.scene_files import read_scene

    record, logic = read_scene(path), UltrasoundSceneLogic(slicer.vtkMRMLScene(), patient.device)
    missing = f"{path}: expected labels of tissues and a probe; press Segment and Simulate, and save it again"
    pose, nodes = required(record.pose, missing), put_nodes(logic.scene, record)
    for node in nodes.values():
        node.HardenTransform()  # so that the patient's frame is the world
    put_values(logic.parameters, record.values)
    logic.parameters.sheets = nodes.get("sheets")
    imaged = logic.patients.imaged(required(nodes.get("labels"), missing))
    return logic.patients.simulator(imaged), imaged.preset, pose


def _poses(path: str) -> list[np.ndarray]:
    """(4, 4) probe_to_ras of --path."""
    from SlicerUSSim.Logic.base.transforms import check_rigid
    from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

    sequence = TrackedSequence.read(path)
    poses = [sequence.pose(number, _POSE) for number in range(len(sequence)) if sequence.has_pose(number, _POSE)]
    require(poses, f"{path}: has no {_POSE}, expected poses of the probe")
    return [check_rigid(f"{path}: {_POSE}", pose) for pose in poses]
