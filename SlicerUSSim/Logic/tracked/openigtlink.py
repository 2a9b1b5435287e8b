"""TrackerLink: poses and commands come, and images go, over OpenIGTLink, with reconnection; uses pyigtl's messages.

pyigtl's client and server detect a lost peer only when sending to it fails, so TrackerLink has a loop of its own.
"""

from __future__ import annotations

import importlib.util
import logging
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import check_rigid, nearest_rotation
from SlicerUSSim.Logic.base.volume import Volume

_log = logging.getLogger(__name__)

#: The default port of OpenIGTLink.
DEFAULT_PORT = 18944
#: Seconds between attempts to connect; seconds until a peer that stops within a message is disconnected.
_RETRY_S, _STALLED_S = 0.25, 5.0
#: Seconds without a pose after which another client may move the probe
_SILENT_S = 2.0
#: Limits of the message size, and of that of messages that are read; a larger size in a header means that the data are
#: not OpenIGTLink.
_LARGEST_BYTES, _LARGEST_READ = 1 << 28, 1 << 20
#: Most clients, and most commands of one that wait for their replies to be sent
_MOST_CLIENTS, _MOST_UNANSWERED = 32, 16
#: Bytes that the system keeps for a client, of which an image is a part
_SEND_BUFFER = 1 << 17
#: Kinds of messages that are read, besides commands in STRING, and those that are known
_READ = ("TRANSFORM", "COMMAND", "GET_STATUS", "GET_CAPABIL")
_CAPABILITIES = ("IMAGE", "STATUS", "CAPABILITY", "RTS_COMMAND", "STRING", *_READ)
#: Code, subcode, name and text of STATUS
_STATUS_OK = struct.pack(">Hq20sx", 1, 0, b"")
#: Messages with poses that are not read
_OTHER_POSES = ("TDATA", "QTDATA", "POSITION")
#: In metadata, whether a pose is valid: 1 or 0, and OK or else what is wrong (Plus)
_VALID = ("1", "TRUE", "OK", "VALID")

#: A name or IPv4 address, or an IPv6 address in brackets.
_HOST = r"\[[^\[\]]*:[^\[\]]*\]|[^\[\]:]+"
_ADDRESS = re.compile(rf"(?:listen:(?P<ours>{_HOST})|(?!listen:)(?P<theirs>{_HOST})|):(?P<port>[0-9]{{1,5}})")


class Address(NamedTuple):
    """One end of a connection."""

    host: str
    port: int
    #: Whether this is the local end, which waits for the peer to connect
    listen: bool

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def parse_address(text: str) -> Address:
    """Parse --igtl: HOST:PORT to connect to, :PORT to wait on loopback, listen:HOST:PORT to wait at an address.

    IPv6 hosts are in brackets: [::1]:18944. Raises SimulationError for an invalid address.
    """
    match = _ADDRESS.fullmatch(text)
    require(
        match is not None and 0 < int(match["port"]) < 65536,
        f"--igtl is {text!r}, expected HOST:PORT to connect to (such as 127.0.0.1:{DEFAULT_PORT}), :PORT to wait for a "
        "connection from this computer, or listen:HOST:PORT to wait at another address; IPv6 hosts in brackets",
    )
    assert match is not None
    host = (match["ours"] or match["theirs"] or "127.0.0.1").strip("[]")
    return Address(host, int(match["port"]), listen=match["theirs"] is None)


def require_usable(address: Address) -> None:
    """Raise SimulationError if pyigtl is missing, or if it is not possible to listen at the address."""
    _require_pyigtl()
    if address.listen:
        _listening(address).close()


class Message(NamedTuple):
    """A message other than images and poses, such as a command and its reply. Metadata are left out of version 1."""

    kind: str
    device: str
    content: bytes = b""
    metadata: Mapping[str, str] = MappingProxyType({})
    #: Of the header of one that came
    version: int = 1

    def packed(self, version: int) -> bytes:
        """The message with a header of this version."""
        from pyigtl.messages import MessageBase

        base: Any = MessageBase(device_name=self.device)
        base._message_type, base.header_version = self.kind, version
        base._pack_content = lambda: self.content
        if version > 1:  # pyigtl writes ASCII alone
            plain = (text.encode("ascii", "xmlcharrefreplace").decode() for text in self.metadata.values())
            base.metadata = dict(zip(self.metadata, plain, strict=True))
        return base.pack()


#: Answers the messages of one client with others
Answer = Callable[[Message], Sequence[Message]]


class TrackerLink:
    """An OpenIGTLink connection that is maintained until stop(): to one peer, or with `listen` to several clients.

    No image waits for another: a client that is slow, or does not read, gets the newest when it has taken the last.

    Parameters
    ----------
    host, port : of the peer, or with `listen` the local address.
    moved : called with every pose, (4, 4) probe_to_ras in mm, in the thread of the link.
    device : name of the TRANSFORM to follow (default: the first received). One client at a time moves the probe.
    listen : wait for clients to connect, instead of connecting to a peer.
    image_name : device name of the IMAGE messages.
    answering : called for every client; answers its COMMAND messages and those in STRING, in a thread of their own.

    Raises SimulationError without pyigtl, and with `listen` for a port that is in use.
    """

    def __init__(
        self, host: str, port: int, moved: Callable[[np.ndarray], None], *, device: str | None = None,
        listen: bool = False, image_name: str = "SlicerUSSim", answering: Callable[[], Answer] | None = None,
    ) -> None:  # fmt: skip
        self._address, self._moved = Address(host, port, listen), moved
        _require_pyigtl()
        self._chosen = self._device = device
        self._image_name, self._answering = image_name, answering
        #: State of the connection, for display
        self.status = ""
        #: Numbers of poses used, of poses dropped because they are damaged, not valid or not rigid, of images sent to
        #: a client, and of those left out because it was busy with the last
        self.received = self.dropped = self.sent = self.left_out = 0
        self._refused = 0  # poses since the last that was used
        self._passed_over: set[str] = set()
        self._peers: list[_Peer] = []
        self._leader: tuple[_Peer, float] | None = None  # who moves the probe, and since when it is silent
        self._newest: _Outgoing | None = None
        self._lock = threading.Lock()
        # Wakes the loop to send an image or to stop.
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_in.setblocking(False)
        self._stopping = False
        self._listener = _listening(self._address) if listen else None
        self._worker = ThreadPoolExecutor(1, "OpenIGTLink commands")
        self._thread = threading.Thread(target=self._run, name="OpenIGTLink", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        """The number of peers that are connected."""
        return len(self._peers)

    def send(
        self, image: Volume, transforms: Mapping[str, np.ndarray] = MappingProxyType({}), *, stamp: float | None = None
    ) -> None:
        """Send an image with its position (RAS) to all; one that is still waiting to be sent is replaced.

        Before it go `transforms` {name: (4, 4)} with the same time, of which ImageToProbe to each client once and when
        it changes. `stamp` are seconds since 1970, by default now.
        """
        frame = _Outgoing(self._image_name, image, dict(transforms), time.time() if stamp is None else stamp)
        with self._lock:
            self._newest = frame
            for peer in self._peers:
                self.left_out += peer.frame is not None
                peer.frame = frame
        self._wake()

    def stop(self) -> None:
        """Close the connections and wait for the threads to end; further calls have no effect."""
        if self._stopping:
            return
        self._stopping = True
        self._wake()
        self._thread.join()
        self._worker.shutdown(wait=False, cancel_futures=True)
        for end in (self._listener, self._wake_in, self._wake_out):
            if end is not None:
                end.close()

    # ---- the loop, in a separate thread ------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping:
            try:
                if self._peers or self._listener is not None:
                    self._attend()
                else:
                    self._say(self.status or f"connecting to {self._address}")
                    self._accept(socket.create_connection(self._address[:2], timeout=_STALLED_S))
            except OSError as error:
                self._lost(error)
        for peer in self._peers:
            peer.socket.close()

    def _attend(self) -> None:
        """Wait until something can be read or sent, and do so."""
        if not self._peers:
            self._say(f"waiting for a connection at {self._address}")
        reads = [peer for peer in self._peers if peer.unanswered < _MOST_UNANSWERED]
        writes = [peer for peer in self._peers if peer.has_news]
        ends = [self._wake_in] if self._listener is None else [self._wake_in, self._listener]
        patience = _STALLED_S if any(peer.waits for peer in self._peers) else None
        readable, writable, _ = select.select([*ends, *reads], writes, [], patience)
        if self._wake_in in readable:
            self._awake()
        if self._listener is not None and self._listener in readable:
            self._accept(self._listener.accept()[0])
        now = time.monotonic()
        for peer in list(self._peers):
            try:
                if peer in readable:
                    for header, packed, body in peer.receive(now):
                        self._take(peer, header, packed, body)
                if peer in writable:
                    self._send_to(peer)
                is_stuck = peer.waits and now - peer.heard > _STALLED_S and peer not in readable
                require(not is_stuck, "it stopped within a message")
            except Exception as error:  # pyigtl raises various exceptions for a message that it cannot parse
                self._drop(peer, error)

    def _accept(self, end: socket.socket) -> None:
        if len(self._peers) >= _MOST_CLIENTS:
            _log.warning("OpenIGTLink: a client is turned away, %d are connected", _MOST_CLIENTS)
            end.close()
            return
        end.setblocking(False)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)  # in which images would wait
        peer = _Peer(end, None if self._answering is None else self._answering())
        with self._lock:
            peer.frame = self._newest
            self._peers.append(peer)
        self._tell()

    def _drop(self, peer: _Peer, error: Exception) -> None:
        peer.socket.close()
        with self._lock:
            self._peers.remove(peer)
        if self._leader is not None and self._leader[0] is peer:
            self._leader = None
            if self._listener is not None:
                self._device = self._chosen
        if self._listener is None:
            self._lost(error)
        else:
            _log.info("OpenIGTLink: a client has gone (%s)", error)
            self._tell()

    def _lost(self, error: Exception) -> None:
        self._say(f"connection to {self._peer_name} lost ({error}), reconnecting", logging.WARNING)
        select.select([self._wake_in], [], [], _RETRY_S)
        self._awake()

    def _tell(self) -> None:
        """Say who is connected."""
        if self._peers:
            following = f", following {self._device}" if self._leader is not None else ""
            self._say(f"connected to {self._peer_name}{following}")

    def _say(self, status: str, level: int = logging.INFO) -> None:
        """Another status, which the log has once."""
        if status != self.status:
            self.status = status
            _log.log(level, "OpenIGTLink: %s", status)

    def _notice(self, what: str) -> None:
        """Something in the stream that is passed over, which the log has once."""
        if what not in self._passed_over:
            self._passed_over.add(what)
            _log.info("OpenIGTLink: %s", what)

    def _refuse(self, reason: str) -> None:
        """A pose that is not used. Trackers send many, so the log has the first as a warning."""
        self.dropped += 1
        self.status = f"{reason} ({self.dropped} pose{'s' * (self.dropped > 1)} dropped)"
        _log.log(logging.DEBUG if self._refused else logging.WARNING, "OpenIGTLink: pose refused: %s", reason)
        self._refused += 1

    # ---- messages ----------------------------------------------------------------------------------------------

    def _send_to(self, peer: _Peer) -> None:
        if not peer.sending:
            with self._lock:
                peer.begin()
        with suppress(BlockingIOError):
            peer.sending = peer.sending[peer.socket.send(peer.sending) :]
        if not peer.sending and peer.is_image:
            self.sent += 1

    def _take(self, peer: _Peer, header: dict[str, Any], packed: bytes, body: bytes | None) -> None:
        """A message; `body` is None for a kind that is not read."""
        kind = header["message_type"]
        peer.version = max(peer.version, min(header["header_version"], 2))
        if body is None:
            self._notice(f"messages of type {kind} are passed over")
            if kind in _OTHER_POSES and not self.received:
                remedy = "expected TRANSFORM: configure it to send TRANSFORM messages of the probe's pose"
                self._say(f"{self._peer_name} sends {kind} messages, {remedy}", logging.WARNING)
        elif kind == "TRANSFORM":
            self._take_pose(peer, header, packed, body)
        elif kind == "GET_STATUS":
            peer.replies.append(Message("STATUS", "", _STATUS_OK).packed(peer.version))
        elif kind == "GET_CAPABIL":  # whose reply has no other version
            kinds = b"".join(struct.pack("12s", name.encode()) for name in _CAPABILITIES)
            peer.replies.append(Message("CAPABILITY", "", kinds).packed(1))
        elif peer.answer is not None:
            answer = peer.answer
            peer.asked += 1
            self._worker.submit(lambda: self._reply(peer, lambda: answer(_unpacked(header, body))))

    def _reply(self, peer: _Peer, answer: Callable[[], Sequence[Message]]) -> None:
        """Answer a command, in the worker: some take long. One that cannot be read is not answered."""
        found: Sequence[Message] = ()
        try:
            found = answer()
        except Exception as error:
            _log.warning("OpenIGTLink: a command is not answered: %r", error)
        with self._lock:
            peer.replies += [reply.packed(peer.version) for reply in found]
            peer.asked -= 1
        if not self._stopping:
            self._wake()

    def _take_pose(self, peer: _Peer, header: dict[str, Any], packed: bytes, body: bytes) -> None:
        from pyigtl.messages import CRC64, TransformMessage

        device, now = header["device_name"], time.monotonic()
        if self._device is None and packed[-8:].hex() == f"{CRC64(body):016x}":
            self._device = device
            _log.info("OpenIGTLink: no transform was chosen, the first that came is followed: %r", device)
        if self._device not in (None, device):
            self._notice(f"transform {device!r} is passed over, {self._device!r} is followed")
            return
        if self._leader is not None and self._leader[0] is not peer and now - self._leader[1] < _SILENT_S:
            self._say(f"connected to {self._peer_name}, of which two send {device}: the first is followed")
            return
        message, name, crc, expected = TransformMessage(), f"transform {device!r}", packed[-8:].hex(), CRC64(body)
        try:
            require(crc == f"{expected:016x}", f"{name} is damaged: its CRC is {crc}, expected {expected:016x}")
            message.unpack(header, body)
            _require_valid(name, device, message.metadata)
            pose = check_rigid(name, message.matrix)
        except SimulationError as error:  # a tracker may send any matrix while it does not see its tool
            self._refuse(str(error))
            return
        pose[:3, :3] = nearest_rotation(pose[:3, :3])  # without the rounding of single precision
        is_new, self._refused = self._leader is None or self._leader[0] is not peer or self._refused > 0, 0
        self._leader = peer, now
        if is_new or not self.received:
            self._tell()
        self.received += 1
        self._moved(pose)

    @property
    def _peer_name(self) -> str:
        if self._listener is None:
            return str(self._address)
        return "the client" if len(self._peers) < 2 else f"{len(self._peers)} clients"

    def _wake(self) -> None:
        with suppress(OSError):  # it has been woken often enough, or was stopped
            self._wake_out.send(b"!")

    def _awake(self) -> None:
        try:
            while self._wake_in.recv(1024):
                pass
        except BlockingIOError:
            pass


class _Peer:
    """One connection: what has come of a message, and what is to be sent."""

    def __init__(self, end: socket.socket, answer: Answer | None) -> None:
        self.socket, self.answer = end, answer
        #: The highest version of a header that came, and when something came
        self.version, self.heard = 1, time.monotonic()
        self._incoming, self._skip = bytearray(), 0
        #: What is being sent, whether it is an image, and what comes after it
        self.sending, self.is_image = memoryview(b""), False
        self.replies: list[bytes] = []
        self.frame: _Outgoing | None = None
        #: Commands that the worker has
        self.asked = 0
        self._calibration = b""

    def fileno(self) -> int:
        return self.socket.fileno()

    @property
    def unanswered(self) -> int:
        """Commands without a reply that the peer has taken: with many, no more are read."""
        return self.asked + len(self.replies)

    @property
    def has_news(self) -> bool:
        return bool(self.sending or self.replies or self.frame is not None)

    @property
    def waits(self) -> bool:
        """Whether the rest of a message is to come."""
        return bool(self._incoming or self._skip)

    def begin(self) -> None:
        """Begin to send the next reply, or the newest image."""
        self.is_image = not self.replies
        if self.replies:
            self.sending = memoryview(self.replies.pop(0))
        elif self.frame is not None:
            frame, self.frame = self.frame, None
            parts = dict(frame.packed(self.version))
            if frame.calibration == self._calibration:
                parts.pop("ImageToProbe", None)
            self._calibration = frame.calibration
            self.sending = memoryview(b"".join(parts.values()))

    def receive(self, now: float) -> Iterator[tuple[dict[str, Any], bytes, bytes | None]]:
        """(fields of the header, header, body) of every message that is complete; None for bodies that are not read.

        Raises ConnectionError if the peer has closed the connection, and SimulationError for what is no message.
        """
        from pyigtl.messages import MessageBase

        data = self.socket.recv(1 << 18)
        if not data:
            raise ConnectionError("closed by the peer")
        self.heard = now
        self._incoming += data
        size = MessageBase.IGTL_HEADER_SIZE
        while True:
            skipped = min(self._skip, len(self._incoming))
            del self._incoming[:skipped]
            self._skip -= skipped
            if len(self._incoming) < size:
                return
            packed = bytes(self._incoming[:size])
            header = MessageBase.parse_header(packed)
            kind, length = header["message_type"], header["body_size"]
            is_read = kind in _READ or (kind == "STRING" and _is_command(header["device_name"]))
            most = _LARGEST_READ if is_read else _LARGEST_BYTES
            require(length <= most, f"message size is {length} bytes, expected at most {most}")
            if not is_read:
                del self._incoming[:size]
                self._skip = length
                yield header, packed, None
                continue
            if len(self._incoming) < size + length:
                return
            body = bytes(self._incoming[size : size + length])
            del self._incoming[: size + length]
            yield header, packed, body


class _Outgoing:
    """An image and its transforms, packed once for all clients with the same version."""

    def __init__(self, name: str, image: Volume, transforms: dict[str, np.ndarray], stamp: float) -> None:
        self._name, self._image, self._transforms, self._stamp = name, image, transforms, stamp
        #: Changes with ImageToProbe; empty without
        self.calibration = transforms["ImageToProbe"].tobytes() if "ImageToProbe" in transforms else b""
        self._packed: dict[int, dict[str, bytes]] = {}

    def packed(self, version: int) -> dict[str, bytes]:
        """{name: message}, in the order in which they are sent."""
        from pyigtl import ImageMessage, TransformMessage

        if version not in self._packed:
            parts: dict[str, Any] = {name: TransformMessage(matrix) for name, matrix in self._transforms.items()}
            if version > 1:
                for part in parts.values():
                    part.metadata = {"TransformStatus": "OK", "TransformValid": "1"}  # as Plus
            parts[self._name] = ImageMessage(self._image.array, self._image.ijk_to_ras, "ras")
            for name, part in parts.items():
                part.device_name, part.timestamp, part.header_version = name, self._stamp, version
            self._packed[version] = {name: part.pack() for name, part in parts.items()}
        return self._packed[version]


def _is_command(device: str) -> bool:
    """Whether a STRING with this name is a command, as in version 1 and 2 of the protocol."""
    return device.partition("_")[0].upper() == "CMD"


def _unpacked(header: dict[str, Any], body: bytes) -> Message:
    """Content and metadata of a message. Raises what pyigtl does for a damaged one."""
    from pyigtl.messages import MessageBase

    base, content = cast(Any, MessageBase()), []
    base._unpack_content = content.append
    base.unpack(header, body)
    return Message(base._message_type, base.device_name, content[0], base.metadata, base.header_version)


def _require_pyigtl() -> None:
    require(
        importlib.util.find_spec("pyigtl") is not None,
        'OpenIGTLink needs pyigtl; install it with: pip install "SlicerUSSim[serve]"',
    )


def _listening(address: Address) -> socket.socket:
    """A socket that listens at an address. Raises SimulationError if that is not possible."""
    try:
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        return socket.create_server((address.host, address.port), family=family)
    except OSError as error:
        raise SimulationError(f"cannot wait for a tracker at {address} ({error}); choose another address") from None


def _require_valid(name: str, device: str, metadata: dict[str, str]) -> None:
    """Raise SimulationError for a pose that the tracker itself calls invalid, as of a tool that it does not see."""
    keys = {first + last for first in ("Transform", device, f"{device}Transform") for last in ("Valid", "Status")}
    for key, value in metadata.items():
        if key in keys:
            require(value.upper() in _VALID, f"{name} has {key} {value}, expected OK: the last valid pose stays")
