"""The virtual ultrasound device, with a client of its own on loopback: what PlusServer answers, and what it sends."""

from __future__ import annotations

import json
import socket
import struct
import threading
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, TissueTable, TrackedSequence, Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.probe.poses import turned
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import write_label_files
from tests.conftest import block, simulator
from tests.openigtlink_client import StrictClient, packed
from tests.test_tracking import free_port, until

pyigtl = pytest.importorskip("pyigtl", reason="OpenIGTLink comes with pyigtl: pip install '.[serve]'")

from SlicerUSSim.Logic.device import Recorder, VirtualDevice  # noqa: E402
from SlicerUSSim.Logic.tracked import openigtlink  # noqa: E402
from SlicerUSSim.Logic.tracked.openigtlink import Address, TrackerLink  # noqa: E402

POSE = turned(np.eye(4), rock_deg=20)
POSE[:3, 3] = [2.0, -25.0, 1.0]
PRESET = Preset().changed("display", image_size=(96, 80)).changed("probe", scan_lines=32, depth_mm=50.0)


class Running:
    """A device with its port, whose images go on in a thread."""

    def __init__(self, folder: Path) -> None:
        made = simulator(block(lambda x, y, z: 1.0 + (x > 0)), TISSUES["liver"], TISSUES["fat"])
        self.port = free_port()
        address = Address("127.0.0.1", self.port, listen=True)
        self.device = VirtualDevice(made, PRESET, [POSE], address, folder)
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


# ---- what it sends ---------------------------------------------------------------------------------------------------


def test_image_and_pose_have_one_time_and_the_calibration_comes_once(client):
    kinds = [client.receive() for _ in range(7)]
    assert [(one.kind, one.device) for one in kinds] == [
        ("TRANSFORM", "ImageToProbe"), *[("TRANSFORM", "ProbeToReference"), ("IMAGE", "Image_Reference")] * 3
    ]  # fmt: skip
    calibration, pose, image = kinds[:3]
    assert calibration.stamp == pose.stamp == image.stamp < kinds[3].stamp
    pixels, matrix = image.image
    assert pixels.shape == (96, 80) and pixels.max() > 50
    place, placed = pose.matrix @ calibration.matrix, matrix
    assert np.allclose(place[:3, [0, 1, 3]], placed[:3, [0, 1, 3]], atol=1e-3)
    assert np.allclose(pose.matrix, POSE, atol=1e-5)


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
    scene, above = slicer.vtkMRMLScene(), None
    for message in (pose, calibration):
        node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", message.device_name)
        node.SetMatrixTransformToParent(vtk_matrix(message.matrix))
        node.SetAndObserveTransformNodeID(None if above is None else above.GetID())
        above = node
    placed = node_to_world(above)
    assert np.allclose(placed[:, [0, 1, 3]], image.ijk_to_world_matrix[:, [0, 1, 3]], atol=1e-3)


def test_status_and_capabilities_are_told(client):
    client.send("GET_STATUS", "Any", b"", version=1)
    status = client.next("STATUS")
    assert struct.unpack(">Hq20s", status.content[:30]) == (1, 0, bytes(20)) and status.content[30:] == b"\0"
    client.send("GET_CAPABIL", "", b"")
    content = client.next("CAPABILITY").content
    names = {content[n : n + 12].rstrip(b"\0").decode() for n in range(0, len(content), 12)}
    assert {"IMAGE", "TRANSFORM", "COMMAND", "STATUS"} < names


def test_any_client_moves_the_probe_one_at_a_time(running):
    with StrictClient(running.port) as first, StrictClient(running.port) as second:
        one, other = POSE @ np.diag([1.0, 1, 1, 1]), turned(POSE, tilt_deg=5.0)
        one[:3, 3] += [1.0, 0.0, 0.0]
        first.move(one)
        until(lambda: np.allclose(second.next("TRANSFORM", "ProbeToReference").matrix, one, atol=1e-4))
        before = running.device.link.received
        second.move(other)
        second.move(other, "StylusToReference")
        until(lambda: "of which two send ProbeToReference: the first is followed" in running.device.link.status)
        assert running.device.link.received == before
    with StrictClient(running.port) as third:  # the others have gone
        until(lambda: running.device.len(link.peers) == 1)
        third.move(POSE, "RobotToReference")
        until(lambda: np.allclose(third.next("TRANSFORM", "ProbeToReference").matrix, POSE, atol=1e-4))


def test_another_client_moves_the_probe_when_the_tracker_has_stopped(running, monkeypatch):
    monkeypatch.setattr(openigtlink, "_SILENT_S", 0.0)
    with StrictClient(running.port) as first, StrictClient(running.port) as second:
        for client, x in ((first, 1.0), (second, 2.0), (first, 3.0)):
            pose = POSE.copy()
            pose[0, 3] = x
            client.move(pose)
            until(lambda pose=pose: np.allclose(running.device.pose, pose, atol=1e-5))
        second.move(np.diag([2.0, 2.0, 2.0, 1.0]))
        until(lambda: "is not rigid" in running.device.link.status)
        assert np.allclose(running.device.pose, pose, atol=1e-5)
        first.move(POSE)
        until(lambda: np.allclose(running.device.pose, POSE, atol=1e-5))


def test_a_client_that_does_not_read_holds_nobody():
    """It gets the newest image when it reads again, and what waits for it is one image."""
    port = free_port()
    link = TrackerLink("127.0.0.1", port, print, listen=True)
    try:
        with StrictClient(port, receive_buffer=4096) as idle, StrictClient(port) as other:
            idle.checks_crc = other.checks_crc = False
            until(lambda: len(link.peers) == 2)
            for number in range(60):
                link.send(Volume(np.full((1, 700, 700), number, np.uint8), np.eye(4)))
                while other.next("IMAGE").image[0][0, 0] != number:
                    pass
            got = []
            while not got or got[-1] != 59:
                got.append(int(idle.next("IMAGE").image[0][0, 0]))
            assert len(got) < 10 and got == sorted(got)
    finally:
        link.stop()


# ---- commands --------------------------------------------------------------------------------------------------------


def test_parameters_are_read_as_plus_writes_them(client):
    names = ("DepthMm", "GainPercent", "FrequencyMhz", "DynRangeDb", "FocusDepthPercent", "FocusDepthMm")
    reply = client.command(command("GetUsParameter", parameters(*names), UsDeviceId="VideoDevice"))
    uid, name, element = reply.command
    assert (uid, name, reply.device, reply.version, element.tag) == (1, "GetUsParameter", "", 2, "CommandReply")
    frequency = f"{PRESET.probe.frequency_mhz:g}"
    values = dict(zip(names, ("50", "50", frequency, "55", "60", "30"), strict=True))
    assert reply.metadata == {**values, "Status": "SUCCESS"}
    found = [(one.tag, one.get("Name"), one.get("Success"), one.get("Value")) for one in element]
    assert found == [("Parameter", name, "true", values[name]) for name in names]


def test_parameters_that_are_not_there_fail_in_the_words_of_plus(client):
    reply = client.command(command("GetUsParameter", parameters("PowerDb", "DepthMm", "Depth"), UsDeviceId=""))
    assert reply.metadata == {
        "DepthMm": "50", "Error": "PowerDb is not set. Invalid parameter Depth. ", "Status": "FAIL"
    }  # fmt: skip
    assert [one.get("Success") for one in reply.command[2]] == ["false", "true", "false"]
    reply = client.command(command("GetUsParameter", parameters("DepthMm"), UsDeviceId="Sonix"))
    assert reply.metadata == {
        "Error": "Device Sonix is not found.", "Message": "Command failed. See error message.", "Status": "FAIL"
    }  # fmt: skip
    _, _, element = reply.command
    assert element.attrib == {
        "Name": "GetUsParameter", "Status": "FAIL", "Error": "Device Sonix is not found.",
        "Message": "Command failed. See error message.",
    }  # fmt: skip


def test_parameters_that_are_set_change_image_and_calibration(client, running):
    wanted = parameters(GainPercent="75", DepthMm="40", TimeGainCompensation="-3 0 6", FocusDepthPercent="50")
    reply = client.command(command("SetUsParameter", wanted, UsDeviceId="VideoDevice"))
    names = ["DepthMm", "FocusDepthPercent", "GainPercent", "TimeGainCompensation"]
    assert [one.get("Name") for one in reply.command[2]] == names  # in the order of std::map
    assert reply.metadata == {**dict.fromkeys(names, "SUCCESS"), "Status": "SUCCESS"}
    calibration = client.next("TRANSFORM", "ImageToProbe").matrix
    assert client.next("IMAGE").image[0].shape == (96, 80)  # as before, in other millimetres
    assert np.isclose(calibration[1, 1] * 96, PRESET.changed("probe", depth_mm=40.0).probe.image_bounds_mm()[3], rtol=0.1)
    reply = client.command(command("GetUsParameter", parameters(*names), UsDeviceId=""))
    assert [reply.metadata[name] for name in names] == ["40", "50", "75", "-3 0 6 "]
    undo = parameters(GainPercent="50", DepthMm="50", FocusDepthMm="30", TimeGainCompensation="0 0 0")
    assert client.command(command("SetUsParameter", undo)).metadata["Status"] == "SUCCESS"


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("DepthMm", "deep", "Failed to parse DepthMm. "),
        ("DepthMm", "-5", "Failed to set DepthMm. "),
        ("DepthMm", "nan", "Failed to set DepthMm. "),
        ("GainPercent", "1200", "Failed to set GainPercent. "),
        ("PowerDb", "3", "Failed to set PowerDb. "),
        ("Depth", "50", "Invalid parameter Depth. "),
        ("TimeGainCompensation", "1 2", "Failed to parse TimeGainCompensation."),
    ],
)
def test_what_cannot_be_set_is_said_and_changes_nothing(client, running, name, value, error):
    before = running.device.transforms()["ImageToProbe"]
    reply = client.command(command("SetUsParameter", parameters(**{name: value}), UsDeviceId="VideoDevice"))
    assert reply.metadata == {name: "FAIL", "Error": error, "Status": "FAIL"}
    assert np.array_equal(running.device.transforms()["ImageToProbe"], before)


@pytest.mark.parametrize(
    ("text", "message", "error"),
    [
        (command("RequestDeviceIds"), "VideoDevice,CaptureDevice", None),
        (command("RequestDeviceIds", DeviceType="VirtualCapture"), "CaptureDevice", None),
        (command("RequestDeviceIds", DeviceType="VirtualVolumeReconstructor"), "", None),
        (command("RequestDeviceIds", DeviceType="Toaster"), "Command failed, see error message.",
         "Unknown device type requested."),
        (command("RequestChannelIds"), "TrackedVideoStream", None),
        (command("requestchannelids"), None, None),
        (command("GetTransform", TransformName="ProbeToTracker"), "Command failed. See error message.",
         "GetTransform (ProbeToTracker) Failed. Transform not found."),
        (command("StartRecording", CaptureDeviceId="Other"), "Command failed. See error message.",
         "VirtualCapture has not been found (Other), StartRecording"),
        (command("StopRecording", CaptureDeviceId="CaptureDevice"), "Command failed. See error message.",
         "VirtualCapture (CaptureDevice) StopRecording No frames to record."),
        (command("StartRecording"), "Command failed. See error message.",
         "VirtualCapture has not been found (auto-detect), StartRecording"),
    ],
)  # fmt: skip
def test_other_commands_are_answered_in_the_words_of_plus(client, text, message, error):
    reply = client.command(text)
    element = reply.command[2]
    if message is None:  # names of commands are as they are written
        error, message = "Unknown command type requested.", ""
    assert element.get("Message") == reply.metadata["Message"] == message
    assert element.get("Error") == reply.metadata.get("Error") == error
    assert element.get("Status") == reply.metadata["Status"] == ("SUCCESS" if error is None else "FAIL")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("GetUsParameter", "<Command Name="), ("GetUsParameter", "no XML"), ("ReconstructVolume", None),
        ("GetUsParameter", "<Order Name='GetUsParameter'/>"), ("GetUsParameter", command("SetUsParameter")),
        ("GetUsParameter", "<!DOCTYPE x [<!ENTITY a 'b'>]>" + command("GetUsParameter")),
    ],
)  # fmt: skip
def test_bad_xml_and_unknown_commands_get_the_answer_of_plus(client, name, text):
    reply = client.command(text or command(name), name)
    uid, no_name, element = reply.command
    assert (uid, no_name) == (1, "")
    said = {"Name": "", "Status": "FAIL", "Error": "Unknown command type requested.", "Message": ""}
    assert element.attrib == said
    assert reply.metadata == {"Error": said["Error"], "Message": "", "Status": "FAIL"}


def test_what_plus_does_not_answer_is_not_answered(client, running):
    """A command that came before, one without a name or text, half a message, a kind that nobody knows."""
    client.command(command("Version"), uid=7)
    client.send_command(command("Version"), uid=7)
    client.send_command(command("Version"), name="", uid=8)
    client.send("COMMAND", "", struct.pack(">I128sHI", 9, b"Version", 3, 0))
    client.send("COMMAND", "", b"short")
    client.socket.sendall(
        packed("COMMAND", "", b"no extended header", version=1).replace(b"\0\1COMMAND", b"\0\2COMMAND")
    )
    client.send("NDARRAY", "x", bytes(1000))
    assert client.command(command("Version"), uid=10).command[0] == 10  # the next that comes
    with StrictClient(running.port) as other:
        whole = packed("COMMAND", "", struct.pack(">I128sHI", 1, b"Version", 3, 26) + command("Version")[:26].encode())
        other.socket.sendall(whole[:100])
        assert client.command(command("Version"), uid=11).command[0] == 11
        other.next("IMAGE")  # goes on
        other.socket.sendall(whole[100:])
        assert other.next("RTS_COMMAND").metadata["Status"] == "FAIL"


def test_older_clients_get_strings(client):
    reply = client.string_command(command("RequestChannelIds"), "CMD_12")
    assert (reply.device, reply.version) == ("ACK_12", 1)
    assert reply.string == '<CommandReply Status="SUCCESS" Message="TrackedVideoStream" />'
    reply = client.string_command("<x", "cmd_13")
    assert reply.device == "cmd"
    assert reply.string == '<CommandReply Status="FAIL" Message="Error attempting to process command." />'
    reply = client.string_command(command("Version"), "CMD")
    words = "Malformed DeviceName. Expected CMD_cmdId (ex: CMD_001)"
    assert (reply.device, reply.string) == ("ACK", f'<CommandReply Status="FAIL" Message="{words}" />')
    reply = client.string_command(command("GetUsParameter", parameters("DepthMm")), "CMD_14")
    assert "&lt;Parameter Name=&quot;DepthMm&quot; Success=&quot;true&quot; Value=&quot;50&quot;/&gt;" in reply.string


def test_transforms_are_composed_on_request(client, running):
    reply = client.command(command("GetTransform", TransformName="ImageToReference"))
    known = running.device.transforms()
    values = np.array(reply.metadata["ImageToReference"].split(), float).reshape(4, 4)
    assert np.allclose(values, known["ProbeToReference"] @ known["ImageToProbe"], atol=1e-4)
    assert (reply.metadata["persistent"], reply.metadata["error"]) == ("false", "-1")
    assert reply.metadata["Message"] == "GetTransform (ImageToReference) Command successful."


# ---- recordings ------------------------------------------------------------------------------------------------------


def test_what_was_sent_is_recorded_and_read_again(client, running):
    folder, first = running.device.recorder._folder, {}
    start = command("StartRecording", CaptureDeviceId="CaptureDevice", OutputFilename="../../sweep.igs.mha")
    reply = client.command(start)
    assert reply.metadata["Message"] == "VirtualCapture (CaptureDevice) StartRecording successful."
    assert "already in progress" in client.command(start).metadata["Error"]
    until(lambda: running.device.recorder.count > 5)
    client.command(command("SuspendRecording", CaptureDeviceId="CaptureDevice"))
    count = running.device.recorder.count
    for _ in range(4):
        client.next("IMAGE")
    assert running.device.recorder.count == count
    client.command(command("ResumeRecording", CaptureDeviceId="CaptureDevice"))
    until(lambda: running.device.recorder.count > count)
    seen = {image.stamp: image.image[0] for image in (client.next("IMAGE") for _ in range(8))}
    reply = client.command(command("StopRecording", CaptureDeviceId="CaptureDevice"))
    path = folder / "sweep.igs.mha"
    sequence = TrackedSequence.read(path)
    words = f"VirtualCapture (CaptureDevice) StopRecording Recording {len(sequence)} frames successful to file {path}"
    assert reply.metadata["Message"] == words and not (folder.parent.parent / "sweep.igs.mha").exists()
    assert np.allclose(sequence.pose(0, "ProbeToReference"), POSE, atol=1e-5) and sequence.is_simulated
    assert sequence.has_pose(0, "ImageToReference")
    first = {round(stamp, 4): number for number, stamp in enumerate(sequence.timestamps.tolist())}
    both = [(first[key], image) for stamp, image in seen.items() if (key := round(stamp / 2**32, 4)) in first]
    assert len(both) > 3 and all(np.array_equal(sequence.images[number], image) for number, image in both)
    again = client.command(start)  # an existing file stays
    assert again.metadata["Error"].endswith("StartRecording Failed to open file ../../sweep.igs.mha.")


def test_a_recording_that_was_not_stopped_is_written_at_the_end(tmp_path, caplog):
    with Running(tmp_path) as made:
        made.device.recorder.start("sweep.igs.mha")
        until(lambda: made.device.recorder.count > 2)
    assert len(TrackedSequence.read(tmp_path / "sweep.igs.mha")) > 2 and "was not stopped" in caplog.text


def test_a_recording_that_cannot_be_written_is_kept_for_another_name(tmp_path):
    recorder = Recorder(tmp_path)
    with pytest.raises(SimulationError, match="unknown sequence format"):
        recorder.start("sweep.avi")
    recorder.start("sweep.igs.mha", compress=True)
    for number in range(3):
        recorder.add(np.full((4, 5), number, np.uint8), float(number), {"ProbeToReference": POSE})
    with pytest.raises(SimulationError, match="expected \\(4, 5\\)"):
        recorder.add(np.zeros((5, 5), np.uint8), 3.0, {})
    with pytest.raises(SimulationError, match="unknown sequence format"):
        recorder.stop("sweep.xyz")
    assert recorder.stop("other.igs.mha") == (tmp_path / "other.igs.mha", 3)
    assert TrackedSequence.read(tmp_path / "other.igs.mha").images[:, 0, 0].tolist() == [0, 1, 2]
    assert [path.name for path in tmp_path.iterdir()] == ["other.igs.mha"]
    with pytest.raises(SimulationError, match="nothing was recorded"):
        recorder.stop()


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def command_device(monkeypatch, tmp_path):
    """The device of `ussim device` with these arguments, after which it does not run; and what was said."""

    def make(*arguments: object) -> tuple[VirtualDevice | None, str]:
        made: list[VirtualDevice] = []
        monkeypatch.setattr(VirtualDevice, "run", lambda device: made.append(device))
        port = [] if "--port" in arguments else ["--port", free_port()]
        done = CliRunner().invoke(main, [*map(str, ("device", *arguments, "-o", tmp_path / "out", *port))])
        assert done.exit_code == (0 if made else 2), done.output
        return (made[0] if made else None), done.stderr

    return make


@pytest.fixture(scope="module")
def labels(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("labels") / "labels.nii.gz"
    tissues = TissueTable.named(["grey matter", "white matter"])
    volume = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 25**2, 1.0 + (x > 0), 0.0), spacing_mm=2.0)
    write_label_files(path, volume, tissues)
    return path


def test_the_command_opens_labels_with_a_path_of_poses(command_device, labels, tmp_path):
    poses = [turned(POSE, tilt_deg=float(tilt)) for tilt in range(3)]
    path = tmp_path / "path.seq.mha"
    transforms = tuple({"ProbeToReference": pose} for pose in poses)
    TrackedSequence(np.zeros((3, 1, 1), np.uint8), transforms, np.arange(3.0)).write(path)
    device, said = command_device(labels, "--path", path, "--gain", 4, "--probe", "linear")
    assert device is not None and "a client may connect to 127.0.0.1:" in said
    assert np.allclose(device._poses, poses, atol=1e-6)
    assert device._preset.display.gain_db == 4.0 and device._preset.probe.is_linear
    assert any(np.allclose(device.pose, pose, atol=1e-6) for pose in poses)
    curve = {"markups": [{"type": "Curve", "coordinateSystem": "RAS", "coordinateUnits": "mm", "controlPoints": [
        {"position": [-10.0, 0.0, 24.0]}, {"position": [10.0, 0.0, 24.0]}]}]}  # fmt: skip
    (tmp_path / "path.mrk.json").write_text(json.dumps(curve))
    device, _ = command_device(labels, "--path", tmp_path / "path.mrk.json")
    assert device is not None and len(device._poses) > 15


@pytest.mark.slow
def test_the_command_without_a_file_has_the_demo_brain(command_device):
    device, said = command_device("--set", "segmentation.classes=3")
    assert device is not None and "skull-stripped brain" in said


def test_the_command_refuses_what_cannot_be_used(command_device, labels, tmp_path):
    (tmp_path / "poses.txt").write_text("1 2 3")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for arguments, words in (
            ((labels, "--port", taken.getsockname()[1]), "choose another address"),
            ((labels, "--path", tmp_path / "poses.txt"), "poses.txt"),
            ((labels, "--path", labels), "has no ProbeToReference, expected poses of the probe"),
            ((tmp_path / "nothing.nii.gz",), "nothing.nii.gz"),
            ((tmp_path / "nothing.mrb",), "nothing.mrb"),
        ):
            device, said = command_device(*arguments)
            assert device is None and words in said and len(said.strip().splitlines()[-1:]) == 1, said


@pytest.mark.slow
def test_the_command_opens_a_scene_of_the_module(command_device, tmp_path):
    slicer = pytest.importorskip("slicer")
    core = pytest.importorskip("trame_slicer.core", reason="scenes come with: pip install '.[serve]'")
    from SlicerUSSim.Logic.mrml.label_nodes import write_labels
    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Logic.mrml.nodes import set_node_to_world

    app = core.SlicerApp()
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
    logic = UltrasoundSceneLogic(app.scene)
    node = app.scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Tissues")
    volume = block(lambda x, y, z: 1.0 + (x > 0), spacing_mm=3.0)
    write_labels(node, volume, ["grey matter", "white matter"], node)
    probe = app.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
    set_node_to_world(probe, POSE)
    logic.parameters.labels, logic.parameters.probe_transform = node, probe
    logic.preset = logic.preset.changed("display", gain_db=5.0).changed("probe", kind="linear", depth_mm=40.0)
    assert app.io_manager.write_scene(tmp_path / "study.mrb")
    device, _ = command_device(tmp_path / "study.mrb")
    assert device is not None and np.allclose(device.pose, POSE, atol=1e-5)
    assert device._preset.display.gain_db == 5.0 and device._preset.probe == logic.preset.probe
    frame = device._simulator.simulate(device._preset.probe, device.pose, device._preset.display)
    image = app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Image")
    assert np.array_equal(frame.labels(), logic.simulate(node, probe, image).labels())
