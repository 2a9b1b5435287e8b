"""The virtual ultrasound device, with a separate client on loopback: what PlusServer answers, and what it sends."""

from __future__ import annotations

import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import TissueTable, TrackedSequence, Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.probe.poses import turned
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import write_label_files
from tests.conftest import block, simulator
from tests.openigtlink_client import StrictClient, command_content, packed
from tests.test_tracking import free_port, until

pyigtl = pytest.importorskip("pyigtl", reason="OpenIGTLink comes with pyigtl: pip install '.[serve]'")

from SlicerUSSim.Logic.device import VirtualDevice  # noqa: E402
from SlicerUSSim.Logic.device.recorder import Recorder  # noqa: E402
from SlicerUSSim.Logic.tracked import openigtlink  # noqa: E402
from SlicerUSSim.Logic.tracked.openigtlink import Address, TrackerLink  # noqa: E402

POSE = turned(np.eye(4), rock_deg=20)
POSE[:3, 3] = [2.0, -25.0, 1.0]
PRESET = Preset().changed("display", image_size=(96, 80)).changed("probe", scan_lines=32, depth_mm=50.0)
FAILED = "Command failed. See error message."


class Running:
    """A device with its port, which makes images in a thread."""

    def __init__(self, folder: Path) -> None:
        made = simulator(block(lambda x, y, z: 1.0 + (x > 0)), TISSUES["liver"], TISSUES["fat"])
        self.port = free_port()
        self.device = VirtualDevice(made, PRESET, [POSE], Address("127.0.0.1", self.port, listen=True), folder)
        self.thread = threading.Thread(target=self.device.run)

    def __enter__(self) -> Running:
        self.thread.start()
        return self

    def __exit__(self, *_) -> None:
        self.device.stop()
        self.thread.join()


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    with Running(tmp_path_factory.mktemp("recordings")) as made:
        yield made


@pytest.fixture
def client(running):
    with StrictClient(running.port) as made:
        yield made


def command(name: str, inner: str = "", **attributes: str) -> str:
    text = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f'<Command Name="{name}"{text}>{inner}</Command>'


def parameters(*names: str, **values: str) -> str:
    asked = [f'<Parameter Name="{name}"/>' for name in names]
    return "".join(asked + [f'<Parameter Name="{name}" Value="{value}"/>' for name, value in values.items()])


# ---- what it sends, and who moves it ---------------------------------------------------------------------------------


def test_image_and_pose_have_one_time_and_the_calibration_comes_once(client):
    kinds = [client.receive() for _ in range(7)]
    assert [(one.kind, one.device) for one in kinds] == [
        ("TRANSFORM", "ImageToProbe"), *[("TRANSFORM", "ProbeToReference"), ("IMAGE", "Image_Reference")] * 3
    ]  # fmt: skip
    calibration, pose, image = kinds[:3]
    assert calibration.stamp == pose.stamp == image.stamp < kinds[3].stamp
    pixels, matrix = image.image
    assert pixels.shape == (96, 80) and pixels.max() > 50 and np.allclose(pose.matrix, POSE, atol=1e-5)
    assert np.allclose((pose.matrix @ calibration.matrix)[:3, [0, 1, 3]], matrix[:3, [0, 1, 3]], atol=1e-3)


def test_pyigtl_and_nodes_of_slicer_place_the_image_as_its_matrix(running):
    """As in SlicerIGT: the image in pixels below ImageToProbe below ProbeToReference."""
    slicer = pytest.importorskip("slicer")
    from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
    from SlicerUSSim.Logic.mrml.nodes import node_to_world

    client = pyigtl.OpenIGTLinkClient("127.0.0.1", running.port)
    try:
        names = "ProbeToReference", "ImageToProbe", "Image_Reference"
        pose, calibration, image = (until(lambda name=name: client.wait_for_message(name, timeout=1)) for name in names)
    finally:
        client.stop()
    scene = slicer.vtkMRMLScene()
    above, node = (scene.AddNewNodeByClass("vtkMRMLLinearTransformNode") for _ in range(2))
    above.SetMatrixTransformToParent(vtk_matrix(pose.matrix))
    node.SetMatrixTransformToParent(vtk_matrix(calibration.matrix))
    node.SetAndObserveTransformNodeID(above.GetID())
    assert np.allclose(node_to_world(node)[:, [0, 1, 3]], image.ijk_to_world_matrix[:, [0, 1, 3]], atol=1e-3)


@pytest.mark.parametrize("version", [1, 2])
def test_status_and_capabilities_are_told(client, version):
    client.send("GET_STATUS", "Any", b"", version)
    status = client.next("STATUS")
    assert struct.unpack(">Hq20s", status.content[:30]) == (1, 0, bytes(20)) and status.content[30:] == b"\0"
    client.send("GET_CAPABIL", "", b"", version)
    content = client.next("CAPABILITY").content
    names = {content[n : n + 12].rstrip(b"\0").decode() for n in range(0, len(content), 12)}
    assert {"IMAGE", "TRANSFORM", "COMMAND", "STATUS"} < names and status.version == version


def test_any_client_moves_the_probe_one_at_a_time(running, monkeypatch):
    device = running.device
    monkeypatch.setattr(openigtlink, "_SILENT_S", 60.0)  # on a busy machine, too
    with StrictClient(running.port) as first, StrictClient(running.port) as second:
        first.move(turned(POSE, rock_deg=5.0))
        until(lambda: np.allclose(device.pose, turned(POSE, rock_deg=5.0), atol=1e-5))
        before = device.link.received
        second.move(POSE)
        second.move(POSE, "StylusToReference")
        until(lambda: "of which two send ProbeToReference: the first is followed" in device.link.status)
        assert device.link.received == before
        monkeypatch.setattr(openigtlink, "_SILENT_S", 0.0)  # the first has stopped
        second.move(turned(POSE, tilt_deg=5.0))
        until(lambda: np.allclose(device.pose, turned(POSE, tilt_deg=5.0), atol=1e-5))
        first.move(np.diag([2.0, 2.0, 2.0, 1.0]))
        until(lambda: "is not rigid" in device.link.status)
        assert np.allclose(device.pose, turned(POSE, tilt_deg=5.0), atol=1e-5)
    with StrictClient(running.port) as third:  # the others have gone
        until(lambda: len(device.link.peers) == 1)
        third.move(POSE, "RobotToReference")
        until(lambda: np.allclose(third.next("TRANSFORM", "ProbeToReference").matrix, POSE, atol=1e-4))


def test_a_client_that_does_not_read_holds_nobody():
    """It moves the probe, gets the newest image when it reads again, and what waits for it is one image."""
    port, poses = free_port(), []
    link = TrackerLink("127.0.0.1", port, poses.append, listen=True)
    try:
        with StrictClient(port, receive_buffer=4096) as idle, StrictClient(port) as other:
            until(lambda: len(link.peers) == 2)
            for peer in link.peers:
                peer.socket.settimeout(0.02)  # in place of seconds
            for number in range(60):
                link.send(Volume(np.full((1, 700, 700), number, np.uint8), np.eye(4)))
                while other.next("IMAGE").image[0][0, 0] != number:
                    pass
                idle.move(POSE)
            until(lambda: len(poses) == 60)
            got = []
            while not got or got[-1] != 59:
                got.append(int(idle.next("IMAGE").image[0][0, 0]))
            assert len(got) < 10 and got == sorted(got)
    finally:
        link.stop()


# ---- commands --------------------------------------------------------------------------------------------------------


def test_parameters_are_read_in_the_words_of_plus(client):
    names = ("DepthMm", "GainPercent", "FrequencyMhz", "DynRangeDb", "FocusDepthPercent", "FocusDepthMm")
    reply = client.command(command("GetUsParameter", parameters(*names), UsDeviceId="VideoDevice"))
    uid, name, element = reply.command
    assert (uid, name, reply.device, reply.version, element.tag) == (1, "GetUsParameter", "", 2, "CommandReply")
    values = dict(zip(names, ("50", "50", f"{PRESET.probe.frequency_mhz:g}", "55", "60", "30"), strict=True))
    assert reply.metadata == {**values, "Status": "SUCCESS"}
    found = [(one.tag, one.get("Name"), one.get("Success"), one.get("Value")) for one in element]
    assert found == [("Parameter", name, "true", values[name]) for name in names]
    reply = client.command(command("GetUsParameter", parameters("PowerDb", "DepthMm", "Depth"), UsDeviceId=""))
    wrong = "PowerDb is not set. Invalid parameter Depth. "
    assert reply.metadata == {"DepthMm": "50", "Error": wrong, "Status": "FAIL"}
    assert [one.get("Success") for one in reply.command[2]] == ["false", "true", "false"]
    reply = client.command(command("GetUsParameter", parameters("DepthMm"), UsDeviceId="Sonix"))
    said = {"Error": "Device Sonix is not found.", "Message": FAILED, "Status": "FAIL"}
    assert reply.metadata == said and reply.command[2].attrib == {"Name": "GetUsParameter", **said}


def test_parameters_that_are_set_change_image_and_calibration(client):
    before = client.next("TRANSFORM", "ImageToProbe").matrix
    wanted = parameters(GainPercent="75", DepthMm="40", TimeGainCompensation="-3 0 6", FocusDepthPercent="50")
    reply = client.command(command("SetUsParameter", wanted, UsDeviceId="VideoDevice"))
    names = ["DepthMm", "FocusDepthPercent", "GainPercent", "TimeGainCompensation"]
    assert [one.get("Name") for one in reply.command[2]] == names  # in the order of std::map
    assert reply.metadata == {**dict.fromkeys(names, "SUCCESS"), "Status": "SUCCESS"}
    calibration = client.next("TRANSFORM", "ImageToProbe").matrix
    assert client.next("IMAGE").image[0].shape == (96, 80)  # as before, in other millimetres
    assert np.isclose(calibration[1, 1], 0.8 * before[1, 1], rtol=0.05)
    reply = client.command(command("GetUsParameter", parameters(*names), UsDeviceId=""))
    assert [reply.metadata[name] for name in names] == ["40", "50", "75", "-3 0 6 "]
    undo = parameters(GainPercent="50", DepthMm="50", FocusDepthMm="30", TimeGainCompensation="0 0 0")
    assert client.command(command("SetUsParameter", undo)).metadata["Status"] == "SUCCESS"


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("DepthMm", "deep", "Failed to parse DepthMm. "),
        ("DepthMm", "nan", "Failed to set DepthMm. "),
        ("GainPercent", "1200", "Failed to set GainPercent. "),
        ("PowerDb", "3", "Failed to set PowerDb. "),
        ("Depth", "50", "Invalid parameter Depth. "),
        ("TimeGainCompensation", "1 2", "Failed to parse TimeGainCompensation."),
    ],
)
def test_what_cannot_be_set_is_said_and_changes_nothing(client, running, name, value, error):
    before = running.device.preset
    reply = client.command(command("SetUsParameter", parameters(**{name: value}), UsDeviceId="VideoDevice"))
    assert reply.metadata == {name: "FAIL", "Error": error, "Status": "FAIL"} and running.device.preset == before


@pytest.mark.parametrize(
    ("text", "message", "error"),
    [
        (command("RequestDeviceIds"), "VideoDevice,CaptureDevice", None),
        (command("RequestDeviceIds", DeviceType="VirtualCapture"), "CaptureDevice", None),
        (command("RequestDeviceIds", DeviceType="VirtualVolumeReconstructor"), "", None),
        (command("RequestDeviceIds", DeviceType="Toaster"), "Command failed, see error message.",
         "Unknown device type requested."),
        (command("RequestChannelIds"), "TrackedVideoStream", None),
        (command("GetTransform", TransformName="ProbeToTracker"), FAILED,
         "GetTransform (ProbeToTracker) Failed. Transform not found."),
        (command("StartRecording", CaptureDeviceId="Other"), FAILED,
         "VirtualCapture has not been found (Other), StartRecording"),
        (command("StopRecording", CaptureDeviceId="CaptureDevice"), FAILED,
         "VirtualCapture (CaptureDevice) StopRecording No frames to record."),
    ],
)  # fmt: skip
def test_other_commands_are_answered_in_the_words_of_plus(client, text, message, error):
    reply = client.command(text)
    element = reply.command[2]
    assert element.get("Message") == reply.metadata["Message"] == message
    assert element.get("Error") == reply.metadata.get("Error") == error
    assert element.get("Status") == reply.metadata["Status"] == ("SUCCESS" if error is None else "FAIL")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("GetUsParameter", "<Command Name="), ("GetUsParameter", "no XML"), ("ReconstructVolume", None),
        ("GetUsParameter", "<Order Name='GetUsParameter'/>"), ("GetUsParameter", command("SetUsParameter")),
        ("GetUsParameter", "<!DOCTYPE x [<!ENTITY a 'b'>]>" + command("GetUsParameter")), ("requestchannelids", None),
    ],
)  # fmt: skip
def test_bad_xml_and_unknown_commands_get_the_answer_of_plus(client, name, text):
    reply = client.command(text or command(name), name)
    uid, no_name, element = reply.command
    said = {"Status": "FAIL", "Error": "Unknown command type requested.", "Message": ""}
    assert (uid, no_name, element.attrib, reply.metadata) == (1, "", {"Name": "", **said}, said)


def test_what_plus_does_not_answer_is_not_answered(client, running):
    """A command without a name or text, one that is cut off, half a message, a kind that nobody knows."""
    text = command("RequestChannelIds")
    for content in (command_content(text, name=""), struct.pack(">I128sHI", 9, b"RequestChannelIds", 3, 0), b"short"):
        client.send("COMMAND", "", content)
    client.socket.sendall(packed("COMMAND", "", b"short", 1).replace(b"\0\1COMMAND", b"\0\2COMMAND"))
    client.send("NDARRAY", "x", bytes(1000))
    assert client.command(text, uid=10).command[0] == 10  # the next that comes
    with StrictClient(running.port) as other:
        whole = packed("COMMAND", "", command_content(text, uid=12))
        other.socket.sendall(whole[:100])
        assert client.command(text, uid=11).command[0] == 11
        other.next("IMAGE")  # continues
        other.socket.sendall(whole[100:])
        assert other.next("RTS_COMMAND").command[0] == 12
        for peer in running.device.link.peers:
            peer.socket.settimeout(0.1)  # in place of seconds
        other.socket.sendall(whole[:100])
        with pytest.raises(ConnectionError):
            while other.receive():
                pass


def test_transforms_are_composed_on_request(client, running):
    reply = client.command(command("GetTransform", TransformName="ImageToReference"))
    known = running.device.transforms()
    values = np.array(reply.metadata["ImageToReference"].split(), float).reshape(4, 4)
    assert np.allclose(values, known["ProbeToReference"] @ known["ImageToProbe"], atol=1e-4)
    assert (reply.metadata["persistent"], reply.metadata["error"]) == ("false", "-1")
    assert reply.metadata["Message"] == "GetTransform (ImageToReference) Command successful."


# ---- recordings ------------------------------------------------------------------------------------------------------


def test_what_was_sent_is_recorded_and_read_again(client, running):
    folder, recorder = running.device.recorder._folder, running.device.recorder
    start = command("StartRecording", CaptureDeviceId="CaptureDevice", OutputFilename="../../sweep.igs.mha")
    reply = client.command(start)
    assert reply.metadata["Message"] == "VirtualCapture (CaptureDevice) StartRecording successful."
    assert "already in progress" in client.command(start).metadata["Error"]
    until(lambda: len(recorder.frames) > 5)
    seen = {image.stamp: image.image[0] for image in (client.next("IMAGE") for _ in range(8))}
    reply = client.command(command("StopRecording", ChannelId="TrackedVideoStream"))
    path = folder / "sweep.igs.mha"
    sequence = TrackedSequence.read(path)
    words = f"VirtualCapture (CaptureDevice) StopRecording Recording {len(sequence)} frames successful to file {path}"
    assert reply.metadata["Message"] == words and not (folder.parent.parent / "sweep.igs.mha").exists()
    assert np.allclose(sequence.pose(0, "ProbeToReference"), POSE, atol=1e-5) and sequence.is_simulated
    assert sequence.has_pose(0, "ImageToReference")
    first = {round(stamp, 4): number for number, stamp in enumerate(sequence.timestamps.tolist())}
    both = [(first[key], image) for stamp, image in seen.items() if (key := round(stamp / 2**32, 4)) in first]
    assert len(both) > 3 and all(np.array_equal(sequence.images[number], image) for number, image in both)
    for file in ("../../sweep.igs.mha", "sweep.avi"):  # an existing file stays
        wrong = client.command(command("StartRecording", CaptureDeviceId="CaptureDevice", OutputFilename=file))
        assert wrong.metadata["Error"].endswith(f"StartRecording Failed to open file {file}.")


def test_a_recording_that_was_not_stopped_is_written_at_the_end(tmp_path, caplog):
    with Running(tmp_path) as made:
        made.device.recorder.start("")
        until(lambda: len(made.device.recorder.frames) > 2)
    (path,) = tmp_path.glob("Recording_*.igs.mha")
    assert len(TrackedSequence.read(path)) > 2 and "was not stopped" in caplog.text


def test_a_long_recording_is_written_soon_and_without_holding_images(tmp_path, monkeypatch):
    recorder, write, begun = Recorder(tmp_path), TrackedSequence.write, time.process_time()
    frame = np.zeros((4, 5), np.uint8), 0.0, {"ImageToProbe": np.eye(4), "ProbeToReference": POSE}

    def write_while_adding(*arguments) -> None:
        adding = threading.Thread(target=recorder.add, args=frame, daemon=True)
        adding.start()
        adding.join(30.0)
        assert not adding.is_alive()
        write(*arguments)

    monkeypatch.setattr(TrackedSequence, "write", write_while_adding)
    recorder.start("long.igs.mha")
    for _ in range(4000):
        recorder.add(*frame)
    assert recorder.stop() == (tmp_path / "long.igs.mha", 4000)
    assert time.process_time() - begun < 8.0  # 1 s where this was written; half a minute with SimpleITK
    assert recorder.stop()[1] == 0 and [path.name for path in tmp_path.iterdir()] == ["long.igs.mha"]


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def command_device(monkeypatch, tmp_path):
    """The device of `ussim device` with these arguments, which does not run; and the messages."""

    def make(*arguments: object) -> tuple[VirtualDevice | None, str]:
        made: list[VirtualDevice] = []
        monkeypatch.setattr(VirtualDevice, "run", lambda device: made.append(device))
        done = CliRunner().invoke(main, [*map(str, ("device", *arguments, "-o", tmp_path, "--port", free_port()))])
        assert done.exit_code == (0 if made else 2), done.output
        return (made[0] if made else None), done.stderr

    return make


def test_the_command_opens_labels_with_a_path_of_poses(command_device, tmp_path):
    labels = tmp_path / "labels.nii.gz"
    volume = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 25**2, 1.0 + (x > 0), 0.0), spacing_mm=2.0)
    write_label_files(labels, volume, TissueTable.named(["grey matter", "white matter"]))
    poses = [turned(POSE, tilt_deg=float(tilt)) for tilt in range(3)]
    transforms, path = tuple({"ProbeToReference": pose} for pose in poses), tmp_path / "path.seq.mha"
    TrackedSequence(np.zeros((3, 1, 1), np.uint8), transforms, np.arange(3.0)).write(path)
    device, said = command_device(labels, "--path", path, "--gain", 4, "--probe", "linear")
    assert device is not None and "a client may connect to 127.0.0.1:" in said
    assert np.allclose(device._path, [*poses, poses[1]], atol=1e-6)  # and back
    assert device.preset.display.gain_db == 4.0 and device.preset.probe.is_linear
    for arguments, words in (
        ((labels, "--path", labels), "has no ProbeToReference, expected poses of the probe"),
        ((tmp_path / "nothing.mrb",), "nothing.mrb"),
        ((tmp_path / "nothing.mrb", "--path", tmp_path / "none.igs.mha"), "none.igs.mha: no such file"),
        ((tmp_path / "nothing.mrb", "--gain", "3"), "is a scene, which has a patient and settings, expected no --gain"),
    ):
        device, said = command_device(*arguments)
        assert device is None and words in said, said


@pytest.mark.slow
def test_the_command_without_a_file_has_the_demo_brain(command_device):
    device, said = command_device("--set", "segmentation.classes=3")
    assert device is not None and "skull-stripped brain" in said


@pytest.mark.slow
def test_the_command_opens_a_scene_of_the_module(command_device, tmp_path):
    slicer = pytest.importorskip("slicer")
    core = pytest.importorskip("trame_slicer.core", reason="scenes come with: pip install '.[serve]'")
    from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
    from SlicerUSSim.Logic.mrml.label_nodes import write_labels
    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Logic.mrml.nodes import set_node_to_world

    app = core.SlicerApp()
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
    logic = UltrasoundSceneLogic(app.scene)
    node = app.scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Tissues")
    write_labels(node, block(lambda x, y, z: 1.0 + (x > 0), spacing_mm=3.0), ["grey matter", "white matter"], node)
    place, probe = (app.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", name) for name in ("Place", "Probe"))
    place.SetMatrixTransformToParent(vtk_matrix(turned(np.eye(4), rotate_deg=90.0)))
    node.SetAndObserveTransformNodeID(place.GetID())
    set_node_to_world(probe, POSE)
    logic.parameters.labels, logic.parameters.probe_transform = node, probe
    logic.preset = logic.preset.changed("display", gain_db=5.0).changed("probe", kind="linear", depth_mm=40.0)
    assert app.io_manager.write_scene(tmp_path / "study.mrb")
    device, _ = command_device(tmp_path / "study.mrb")
    assert device is not None and np.allclose(device.pose, POSE, atol=1e-5)
    assert device.preset.display.gain_db == 5.0 and device.preset.probe == logic.preset.probe
    frame = device._simulator.simulate(device.preset.probe, POSE, device.preset.display)
    image = app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Image")
    assert (frame.labels() == logic.simulate(node, probe, image).labels()).mean() > 0.99
