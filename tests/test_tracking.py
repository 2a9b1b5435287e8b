"""Receiving poses and sending images over OpenIGTLink, with pyigtl as the peer, on loopback."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

import numpy as np
import pytest

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.probe.poses import turned

pyigtl = pytest.importorskip("pyigtl", reason="OpenIGTLink comes with pyigtl: pip install '.[serve]'")

from SlicerUSSim.Logic.tracked.openigtlink import TrackerLink, parse_address  # noqa: E402

POSE = turned(np.eye(4), rock_deg=20, tilt_deg=-30, rotate_deg=70)
POSE[:3, 3] = [12.5, -40.25, 60.0]
IMAGE = Volume(np.arange(12 * 20, dtype=np.uint8).reshape(1, 12, 20), POSE @ np.diag([0.5, 0.25, 1.0, 1.0]))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def until(condition, seconds: float = 120.0):
    """Wait until `condition` returns a true value, and return it; this may take long on a busy machine."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        result = condition()
        if result:
            return result
        time.sleep(0.01)
    raise AssertionError("it never came")


@pytest.fixture
def link():
    made = []

    def make(*arguments, **options):
        poses = []
        made.append(TrackerLink(*arguments, poses.append, **options))
        return made[-1], poses

    yield make
    for one in made:
        one.stop()


def transform(name: str = "ProbeToReference", matrix=POSE):
    return pyigtl.TransformMessage(matrix, device_name=name)


def test_a_server_moves_the_probe_and_gets_the_image_with_its_place(link):
    server = pyigtl.OpenIGTLinkServer(port=free_port(), local_server=True)
    try:
        ours, poses = link("127.0.0.1", server.port)
        until(lambda: server.is_connected())
        server.send_message(transform())
        until(lambda: poses)
        assert np.allclose(poses[-1], POSE, atol=1e-5)
        ours.send(IMAGE)
        message = until(lambda: server.wait_for_message("SlicerUSSim", timeout=1))
        assert np.array_equal(message.image, IMAGE.array)
        assert message.world_coordinate_system == "ras"
        assert np.allclose(message.ijk_to_world_matrix, IMAGE.ijk_to_ras, atol=1e-4)
        until(lambda: ours.sent == 1)  # counted after it has left
        assert "following ProbeToReference" in ours.status and ours.received == 1
    finally:
        server.stop()


def test_a_client_that_connects_to_us_can_go_and_come_back(link):
    port = free_port()
    ours, poses = link("127.0.0.1", port, listen=True)
    for n in range(1, 4):
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
        until(lambda client=client: client.is_connected())
        client.send_message(transform())
        until(lambda n=n: len(poses) == n)
        ours.send(IMAGE)
        message = until(lambda client=client: client.wait_for_message("SlicerUSSim", timeout=1))
        assert message.image.shape == (1, 12, 20)
        client.stop()
        until(lambda: "waiting" in ours.status)


def test_a_server_that_goes_is_found_again_when_it_comes_back(link):
    port = free_port()
    ours, poses = link("127.0.0.1", port)  # before there is anyone
    until(lambda: "reconnecting" in ours.status)
    for n in range(1, 4):
        with socket.create_server(("127.0.0.1", port)) as listener:
            peer, _ = listener.accept()
            with peer:
                message = transform().pack()
                peer.sendall(message + message[:30])  # in pieces, as networks do
                until(lambda n=n: len(poses) == 2 * n - 1)
                peer.sendall(message[30:])
                until(lambda n=n: len(poses) == 2 * n)
                peer.sendall(message[:70])  # and gone in the middle of a message
        until(lambda: "reconnecting" in ours.status)
    ours.send(IMAGE)  # to nobody: not an error


def test_only_the_chosen_transform_moves_the_probe_where_it_is_rigid(link):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours, poses = link(*listener.getsockname()[:2], device="ProbeToReference")
        peer, _ = listener.accept()
        with peer:
            for message in (
                transform("StylusToReference"),
                pyigtl.StringMessage("hello", device_name="Text"),
                transform(matrix=np.diag([2.0, 1.0, 1.0, 1.0])),
                transform(matrix=np.full((4, 4), np.nan)),
                transform(matrix=np.eye(4) + 1e6 * np.eye(4, k=3)),  # what trackers send of a tool they have lost
            ):
                peer.sendall(message.pack())
            until(lambda: ours.dropped == 3)
            assert "moves by 1e+06 mm, expected at most 100000 mm along every axis (3 poses dropped)" in ours.status
            peer.sendall(transform().pack())
            until(lambda: poses)
            assert len(poses) == 1 and np.allclose(poses[0], POSE, atol=1e-5)


def test_the_probe_is_followed_instead_of_what_came_first(link):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours, poses = link(*listener.getsockname()[:2])
        for other, followed in (("ProbeToReference", "ProbeToReference"), ("RobotToReference", "StylusToReference")):
            peer, _ = listener.accept()  # the second time any name again, since the first peer has gone
            with peer:
                peer.sendall(transform("ImageToProbe", np.diag([0.2, 0.2, 0.2, 1.0])).pack())  # not a pose
                for name in ("StylusToReference", other, "StylusToReference"):
                    peer.sendall(transform(name).pack())
                until(lambda followed=followed: f"following {followed}" in ours.status)
        until(lambda: "reconnecting" in ours.status)
        assert len(poses) == 2 + 2 and ours.dropped == 2


def test_damaged_and_invalid_poses_are_not_used_and_counted(link):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours, poses = link(*listener.getsockname()[:2])
        peer, _ = listener.accept()
        with peer:
            peer.sendall(transform().pack())
            until(lambda: poses)
            damaged = bytearray(transform(matrix=np.eye(4)).pack())
            damaged[-1] ^= 1
            peer.sendall(damaged)
            until(lambda: ours.dropped == 1)
            assert "transform 'ProbeToReference' is damaged: its CRC is " in ours.status
            lost = ("TransformValid", "0"), ("TransformStatus", "OUT_OF_VIEW"), ("ProbeToReferenceStatus", "INVALID")
            for number, (key, value) in enumerate(lost, 2):
                message = transform(matrix=np.eye(4))
                message.header_version, message.metadata = 2, {"Depth": "60", key: value}
                peer.sendall(message.pack())
                until(lambda number=number: ours.dropped == number)
                words = f"has {key} {value}, expected OK: the last valid pose stays ({number} poses dropped)"
                assert ours.status == f"transform 'ProbeToReference' {words}"
            message.metadata = {"TransformValid": "1", "TransformStatus": "OK", "Status": "live"}  # as Plus
            peer.sendall(message.pack())
            until(lambda: len(poses) == 2)
            assert np.allclose(poses[0], POSE, atol=1e-5) and np.array_equal(poses[1], np.eye(4))
            assert "following ProbeToReference" in ours.status


def test_a_tracker_that_sends_only_tracking_data_is_reported_with_a_remedy(link):
    class TrackingData(pyigtl.messages.MessageBase):
        def _pack_content(self):
            return struct.pack(">20sBB12f", b"Probe", 1, 0, *POSE[:3].T.ravel())

    message = TrackingData(device_name="Tracker")
    message._message_type = "TDATA"
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours, poses = link(*listener.getsockname()[:2])
        peer, _ = listener.accept()
        with peer:
            peer.sendall(message.pack())
            until(lambda: "sends TDATA messages, expected TRANSFORM: configure it" in ours.status)
            peer.sendall(transform().pack() + message.pack() + transform().pack())
            until(lambda: len(poses) == 2)
            assert "following" in ours.status


def test_who_does_not_speak_openigtlink_is_dropped_and_the_next_one_heard(link):
    nonsense = struct.pack(">H12s20sQQQ", 1, b"TRANSFORM", b"x", 0, 1 << 60, 0) + b"x" * 100
    port = free_port()
    _, poses = link("127.0.0.1", port, listen=True)
    with socket.create_connection(("127.0.0.1", port)) as other:
        other.sendall(nonsense)
        other.settimeout(120)
        with contextlib.suppress(ConnectionResetError):  # with what was not read, closing is a reset
            assert other.recv(1) == b""
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
    until(lambda: client.is_connected())
    client.send_message(transform())
    until(lambda: poses)
    client.stop()


def test_of_images_that_wait_only_the_newest_is_sent(link):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours, _ = link(*listener.getsockname()[:2])
        for value in range(50):  # nobody has accepted, or read, anything yet
            ours.send(Volume(np.full((1, 400, 400), value, np.uint8), np.eye(4)))
        peer, _ = listener.accept()
        with peer:
            peer.settimeout(120)
            stream, last = peer.makefile("rb"), None
            while last != 49:
                header = pyigtl.messages.MessageBase.parse_header(stream.read(58))
                message = pyigtl.ImageMessage()
                message.unpack(header, stream.read(header["body_size"]))
                last = int(message.image.max())
            assert ours.sent < 50


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("tracker.local:18944", ("tracker.local", 18944, False)),
        (":18944", ("127.0.0.1", 18944, True)),
        ("listen:0.0.0.0:18944", ("0.0.0.0", 18944, True)),
        ("listen:[::]:18944", ("::", 18944, True)),
    ],
)
def test_an_address_says_where_and_who_connects(text, address):
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["tracker", "tracker:99999", "tracker:x", "::1:18944", "listen:18944", ""])
def test_what_is_not_an_address_is_reported(text):
    with pytest.raises(SimulationError, match="expected HOST:PORT") as caught:
        parse_address(text)
    assert repr(text) in str(caught.value) and "listen:HOST:PORT" in str(caught.value)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [("0.0.0.0", "127.0.0.2"), ("[::1]", "[::1]")],  # the first is this computer too, but not where :PORT waits
)
def test_it_listens_where_it_is_asked_to_and_connects_there(link, ours, theirs):
    port = free_port()
    try:
        family = socket.AF_INET6 if "[" in theirs else socket.AF_INET
        socket.create_server((theirs.strip("[]"), port), family=family).close()
    except OSError:
        pytest.skip(f"this computer has no address {theirs}")
    host, _, listen = parse_address(f"listen:{ours}:{port}")
    here, poses = link(host, port, listen=listen)
    host, _, listen = parse_address(f"{theirs}:{port}")
    there, _ = link(host, port, listen=listen)
    until(lambda: there.status == f"connected to {theirs}:{port}" and here.status == "connected to the client")
    with socket.create_connection((host, port)) as late:  # one at a time: heard when the first has gone
        late.sendall(transform().pack())
        there.stop()
        until(lambda: poses)


def test_a_port_that_is_taken_is_reported():
    with socket.create_server(("127.0.0.1", 0)) as listener, pytest.raises(SimulationError, match="choose another"):
        TrackerLink("127.0.0.1", listener.getsockname()[1], print, listen=True)
